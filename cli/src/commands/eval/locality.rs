//! `cnerf eval locality`: whether edits stay in their region, and shape and texture apart.

use clap::Args;
use cnerf_core::{
    codes::Aspect,
    eval::{
        locality::{Locality, summary as gather, swap_each},
        separation::{self, Carried, Separation, swap_all},
    },
    interop::chart::{Axis, BarChart},
    region::Region,
};
use serde::Serialize;

use super::{PlotOptions, PortraitOptions, shown};
use crate::console::{Console, Outcome};

const CHARTS: [&str; 3] = ["shape", "texture", "depth"];

/// Arguments of `cnerf eval locality`.
#[derive(Args, Debug)]
pub struct LocalityArguments {
    #[command(flatten)]
    portraits: PortraitOptions,
    #[command(flatten)]
    plots: PlotOptions,
}

#[derive(Serialize)]
struct Report {
    count: usize,
    /// Every region's shape, then its texture.
    regions: Vec<Locality>,
    /// The largest depth change of any texture edit, world units.
    texture_depth_change: f64,
    /// What swapping all shape codes, or all texture codes, changes.
    separation: Separation,
    seconds: f64,
}

impl LocalityArguments {
    /// Swaps codes, measures, reports.
    pub fn run(self, seed: u64, console: &Console) -> anyhow::Result<Outcome> {
        let began = std::time::Instant::now();
        self.plots.check(&CHARTS)?;
        let portraits = self.portraits.open(seed)?;
        console.note(format_args!(
            "edits of {}: each region's shape and texture from another random one",
            portraits.described()
        ));
        let bar = console.bar(portraits.len() as u64, "locality");
        let (mut changes, mut swaps) = (Vec::new(), Vec::new());
        for index in 0..portraits.len() {
            let measure =
                portraits.visit(index, |subject, donor| Ok((swap_each(subject, donor)?, swap_all(subject, donor)?)));
            let (_, (change, swap)) = measure?;
            changes.push(change);
            swaps.push(swap);
            bar.inc(1);
        }
        bar.finish_and_clear();
        let regions = gather(&changes);
        draw(&self.plots, &regions)?;
        let of_texture = regions.iter().filter(|found| found.aspect == Aspect::Texture);
        let texture_depth_change = of_texture.map(|found| found.largest_depth_change).fold(0.0, f64::max);
        let report = Report {
            count: changes.len(),
            regions,
            texture_depth_change,
            separation: separation::summary(&swaps),
            seconds: began.elapsed().as_secs_f64(),
        };
        console.result(&report, || summary(&report))?;
        Ok(Outcome::Done)
    }
}

fn draw(plots: &PlotOptions, found: &[Locality]) -> anyhow::Result<()> {
    let names: Vec<String> = Region::ALL.iter().map(|region| region.name().to_owned()).collect();
    let column = |aspect: Aspect, value: fn(&Locality) -> Option<f64>| -> Vec<Option<f64>> {
        found.iter().filter(|found| found.aspect == aspect).map(value).collect()
    };
    for (name, aspect) in [("shape", Aspect::Shape), ("texture", Aspect::Texture)] {
        let Some(path) = plots.path(name) else { continue };
        let chart = BarChart {
            title: format!("What a {name} swap changes"),
            x_title: "region".into(),
            y: Axis::logarithmic("mean absolute colour change, colours in [0, 1]"),
            names: names.clone(),
            series: vec![
                ("inside the region".to_owned(), column(aspect, |found| found.inside_change)),
                ("outside".to_owned(), column(aspect, |found| found.outside_change)),
            ],
        };
        chart.save(path)?;
    }
    if let Some(path) = plots.path("depth") {
        let chart = BarChart {
            title: "What a shape swap moves".into(),
            x_title: "region".into(),
            y: Axis::logarithmic("mean absolute depth change, world units"),
            names,
            series: vec![
                ("everywhere".to_owned(), column(Aspect::Shape, |found| Some(found.depth_change))),
                ("head outside the region".to_owned(), column(Aspect::Shape, |found| found.outside_depth_change)),
            ],
        };
        chart.save(path)?;
    }
    Ok(())
}

fn summary(report: &Report) -> String {
    let heads = ["region", "codes", "inside", "outside", "share", "depth", "outside depth"];
    let mut lines = vec![format!(
        "{:<10} {:<8} {:>8} {:>9} {:>7} {:>10} {:>13}",
        heads[0], heads[1], heads[2], heads[3], heads[4], heads[5], heads[6]
    )];
    lines.extend(report.regions.iter().map(|found| {
        format!(
            "{:<10} {:<8} {:>8} {:>9} {:>7} {:>10} {:>13}",
            found.region.name(),
            found.aspect.to_string(),
            shown(found.inside_change, 4),
            shown(found.outside_change, 5),
            shown(found.outside_share, 3),
            shown(found.depth_change, 6),
            shown(found.outside_depth_change, 6),
        )
    }));
    lines.push(String::new());
    lines.push(format!(
        "{:<21} {:>7} {:>7} {:>7} {:>13} {:>8}",
        "share of both swapped", "masks", "depth", "colour", "region colour", "features"
    ));
    for (name, carried) in
        [("all shape codes", report.separation.shape), ("all texture codes", report.separation.texture)]
    {
        let Carried { masks, depth, colour, region_colour, features } = carried;
        lines.push(format!(
            "{name:<21} {:>7} {:>7} {:>7} {:>13} {:>8}",
            shown(masks, 3),
            shown(depth, 3),
            shown(colour, 3),
            shown(region_colour, 3),
            shown(features, 3)
        ));
    }
    lines.join("\n")
}
