//! `cnerf export`: a portrait's surface as a mesh.

use std::path::PathBuf;

use anyhow::bail;
use clap::Args;
use cnerf_core::{interop::surface, region::RegionSet};
use serde::Serialize;

use crate::{
    console::{Console, Outcome},
    options::{ModelOptions, OverwriteOptions},
    portraits,
};

/// Arguments of `cnerf export`.
#[derive(Args, Debug)]
pub struct ExportArguments {
    /// Portrait file
    portrait: PathBuf,
    /// Mesh to write: .glb, .ply or .obj
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Grid cells along the longest side
    #[arg(long, default_value_t = 128, value_parser = clap::value_parser!(u64).range(8..=512))]
    resolution: u64,
    /// Only the surface of these regions
    #[arg(long, default_value = "all", value_name = "R[,R]")]
    regions: RegionSet,
    #[command(flatten)]
    model: ModelOptions,
    #[command(flatten)]
    overwrite: OverwriteOptions,
}

#[derive(Serialize)]
struct Report {
    output: PathBuf,
    vertices: usize,
    triangles: usize,
    boundary_edges: usize,
    seconds: f64,
}

impl ExportArguments {
    /// Extracts and writes.
    pub fn run(self, console: &Console) -> anyhow::Result<Outcome> {
        let known = ["glb", "ply", "obj"];
        let extension = self.out.extension().map(|extension| extension.to_string_lossy().to_ascii_lowercase());
        if !extension.is_some_and(|extension| known.contains(&extension.as_str())) {
            bail!("{}: name the mesh .glb, .ply or .obj", self.out.display());
        }
        self.overwrite.check(&self.out)?;
        let began = std::time::Instant::now();
        let opened = portraits::open(&self.portrait, &self.model)?;
        let spinner = console.spinner("extracting the surface");
        let mut mesh = surface::extract(&opened.generator, &opened.codes, self.resolution as usize)?;
        if self.regions != RegionSet::ALL {
            mesh = mesh.restricted_to(self.regions);
            if mesh.is_empty() {
                bail!("--regions {}: none of the surface belongs to them", self.regions);
            }
        }
        mesh.save(&self.out)?;
        spinner.finish_and_clear();
        let report = Report {
            output: self.out,
            vertices: mesh.positions.len(),
            triangles: mesh.triangles.len(),
            boundary_edges: mesh.boundary_edges(),
            seconds: began.elapsed().as_secs_f64(),
        };
        console.result(&report, || {
            format!("{}: {} vertices, {} triangles", report.output.display(), report.vertices, report.triangles)
        })?;
        Ok(Outcome::Done)
    }
}
