//! One view rendered again after an edit: whole, and only what the edit changed.

use candle_core::Tensor;
use serde::Serialize;

use crate::{
    bench::{
        Machine,
        measure::{Timing, Way, in_turns},
        scene::{Scene, difference},
    },
    codes::{self, Aspect},
    error::Result,
    interop::chart::{Group, GroupedBars},
    kernels::Path,
    region::{Region, RegionSet},
    render::{
        RadianceField as _, RenderSettings,
        plan::{self, Session},
    },
};

/// One kind of edit, rendered again both ways.
#[derive(Clone, Debug, Serialize)]
pub struct EditReport {
    /// The edited region.
    pub region: &'static str,
    /// Whether its texture or its shape changed.
    pub aspect: &'static str,
    /// Median seconds of the whole exact frame.
    pub full_seconds: f64,
    /// Median seconds of the session's frame.
    pub incremental_seconds: f64,
    /// How many times faster.
    pub speedup: f64,
    /// Largest difference of the two, [0, 1] colour units.
    pub max_error: f64,
    /// Largest difference that the session said there could be.
    pub bound: f64,
    /// Spread of the session's frames.
    pub incremental: Timing,
}

/// All edits; the first, a texture edit, is the head.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Median seconds of the whole exact frame after a texture edit.
    pub full_seconds: f64,
    /// Median seconds of the session's frame after it.
    pub incremental_seconds: f64,
    /// Largest difference of the two, [0, 1] colour units.
    pub max_error: f64,
    /// How many times faster.
    pub speedup: f64,
    /// Largest difference allowed.
    pub budget: f64,
    /// Memory that the session keeps, bytes.
    pub session_bytes: usize,
    /// Every kind of edit.
    pub edits: Vec<EditReport>,
    /// What was rendered.
    pub scene: String,
    /// On which kernel path.
    pub path: &'static str,
    /// Where.
    pub machine: Machine,
}

/// Edits `region`'s texture, then its shape, back and forth; renders the view whole and incrementally in turns.
pub fn run(
    scene: &Scene,
    path: Path,
    region: Region,
    budget: f64,
    repeats: usize,
    machine: Machine,
    progress: &mut dyn FnMut(&str),
) -> Result<Report> {
    path.run(|| {
        let camera = scene.camera()?;
        let exact = RenderSettings { budget: 0.0, ..scene.settings.clone() };
        let mut session = Session::new(&camera, &RenderSettings { budget, ..scene.settings.clone() })?;
        let source = scene.generator.codes_from_seed(101, 0.7)?;
        let mut edits = Vec::new();
        for (aspect, name) in [(Aspect::Texture, "texture"), (Aspect::Shape, "shape")] {
            progress(&format!("{region} {name}"));
            let edited = codes::blend(&scene.codes, &source, RegionSet::from(region), aspect, 1.0)?;
            edits.push(edit(scene, &camera, &exact, &mut session, &edited, (region.name(), name), repeats)?);
        }
        let head = edits.first().cloned();
        let value = |of: &dyn Fn(&EditReport) -> f64| head.as_ref().map_or(0.0, of);
        Ok(Report {
            full_seconds: value(&|edit| edit.full_seconds),
            incremental_seconds: value(&|edit| edit.incremental_seconds),
            max_error: value(&|edit| edit.max_error),
            speedup: value(&|edit| edit.speedup),
            budget,
            session_bytes: session.memory(),
            edits,
            scene: scene.describe(),
            path: path.name(),
            machine,
        })
    })
}

fn edit(
    scene: &Scene,
    camera: &Tensor,
    exact: &RenderSettings,
    session: &mut Session,
    edited: &Tensor,
    (region, aspect): (&'static str, &'static str),
    repeats: usize,
) -> Result<EditReport> {
    let portrait = |codes: &Tensor| scene.generator.field().portraits(codes).map(|field| field.detached());
    let (before, after) = (portrait(&scene.codes)?, portrait(edited)?);
    session.render(&before)?;
    // Every call is an edit: there, and back again.
    let mut there = false;
    let incremental: Way<'_> = Box::new(|| {
        there = !there;
        session.render(if there { &after } else { &before }).map(drop)
    });
    let full: Way<'_> = Box::new(|| plan::render(&after, camera, exact).map(drop));
    let mut ways = [incremental, full];
    let timings = in_turns(repeats, &mut ways)?;
    drop(ways);
    session.render(&before)?;
    let found = session.render(&after)?;
    let expected = plan::render(&after, camera, exact)?;
    let (own, whole) = (timings[0], timings[1]);
    Ok(EditReport {
        region,
        aspect,
        full_seconds: whole.median_seconds,
        incremental_seconds: own.median_seconds,
        speedup: whole.median_seconds / own.median_seconds,
        max_error: difference(&found.frame.colour, &expected.frame.colour)?.0,
        bound: found.report.bound,
        incremental: own,
    })
}

/// The chart's file name.
pub const CHART: &str = "edit.svg";

/// Seconds a frame, whole and incremental, for each kind of edit.
pub fn chart(report: &Report) -> Result<String> {
    let subtitle = format!("{} · {}", report.scene, report.machine.describe());
    let title = format!("Rendering again after an edit, within {:.4} ({})", report.budget, report.path);
    let group = |edit: &EditReport| Group {
        label: format!("{} of the {}", edit.aspect, edit.region),
        bars: vec![
            ("whole exact frame".to_owned(), edit.full_seconds),
            ("what the edit changed".to_owned(), edit.incremental_seconds),
        ],
    };
    let groups: Vec<_> = report.edits.iter().map(group).collect();
    GroupedBars::seconds_a_frame(&title, &subtitle, &groups).svg()
}
