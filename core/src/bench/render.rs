//! One frame: exact on every path against candle's own operations; under budgets of error; and how far sums of so many
//! samples are from the integral they stand for.

use candle_core::Tensor;
use serde::Serialize;

use crate::{
    bench::{
        Machine,
        generators::{self, Speed},
        measure::{Timing, Way, in_turns},
        scene::{Scene, difference, with_samples},
    },
    error::{Error, Result},
    eval::quality,
    interop::chart::{Axis, Group, GroupedBars, LineChart, Mark, Series},
    kernels::Path,
    model::field::PortraitField,
    render::{RadianceField as _, RenderSettings, TwoPass, plan},
};

/// Budgets that frames are rendered under, [0, 1] colour units: from below what a screen shows to twice it.
pub const BUDGETS: [f64; 6] = [5e-4, 1e-3, 2e-3, 1.0 / 255.0, 0.01, 0.03];
/// Samples of the sum that counts as the integral.
const CONVERGED_SAMPLES: usize = 1024;
/// Samples a ray whose sums are compared to it.
const SAMPLES: [usize; 8] = [4, 6, 8, 12, 16, 24, 48, 96];
/// Samples at the surface that are compared to it: regular distances, distances where those point to, colours.
const SURFACE_SAMPLES: [(usize, usize, usize); 8] =
    [(3, 1, 1), (3, 1, 2), (4, 1, 2), (4, 2, 2), (4, 2, 3), (8, 2, 3), (8, 4, 6), (12, 8, 12)];
/// Of the integral, dB: what placements are compared at.
const ENOUGH_DB: f64 = 40.0;

/// The exact frame on one path.
#[derive(Clone, Debug, Serialize)]
pub struct PathReport {
    /// Which.
    pub path: &'static str,
    /// Median seconds.
    pub seconds: f64,
    /// Times faster than candle's operations.
    pub speedup: f64,
    /// Largest difference from candle's picture, [0, 1] colour units.
    pub max_difference: f64,
    /// All measurements.
    pub timing: Timing,
}

/// A frame under a budget.
#[derive(Clone, Debug, Serialize)]
pub struct BudgetReport {
    /// Largest error allowed, [0, 1] colour units; 0 is the exhaustive path.
    pub budget: f64,
    /// Median seconds.
    pub seconds: f64,
    /// Times faster than the exact frame in this run.
    pub speedup: f64,
    /// Largest difference from the exact frame that was found.
    pub max_error: f64,
    /// The pixels' mean difference.
    pub mean_error: f64,
    /// Largest difference that the plan said there could be.
    pub bound: f64,
    /// (sample, region) pairs whose texture branch ran.
    pub regions_evaluated: usize,
    /// Samples where any branch ran.
    pub samples_evaluated: usize,
    /// (sample, region) pairs whose shape branch ran.
    pub shape_pairs_evaluated: usize,
    /// Pairs left out.
    pub pairs_skipped: usize,
}

/// A sum of so many samples against the integral.
#[derive(Clone, Debug, Serialize)]
pub struct DiscretisationReport {
    /// Samples a ray at which anything is evaluated, distance alone or colour too: the rays' mean.
    pub samples: f64,
    /// Samples at which colours are, of a ray that has any.
    pub colour_samples: usize,
    /// `uniform` or `surface`.
    pub placement: &'static str,
    /// Median seconds.
    pub seconds: f64,
    /// Of the picture against the one of 1024 samples, dB.
    pub psnr: f64,
}

/// Everything about one frame.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Sample points a second of the exact frame on the first path.
    pub points_per_s: f64,
    /// 10⁹ operations a second of the local generators in that frame, everything else's time included.
    pub gflops: f64,
    /// The first path's ceiling.
    pub peak_gflops: f64,
    /// Candle's own operations, same allocator and matrix products: median seconds.
    pub plain_seconds: f64,
    /// The first path: median seconds.
    pub exact_seconds: f64,
    /// Frames under budgets.
    pub budgeted: Vec<BudgetReport>,
    /// Sums against the integral; none of a scene with random weights.
    pub discretisation: Vec<DiscretisationReport>,
    /// Samples a ray for 40 dB, uniform and at the surface, read off between those measured; none if none gets there.
    pub samples_for_40_db: Option<[f64; 2]>,
    /// The exact frame on every path.
    pub paths: Vec<PathReport>,
    /// The kernels alone on every path.
    pub generators: Vec<Speed>,
    /// What was rendered.
    pub scene: String,
    /// Where.
    pub machine: Machine,
}

/// Measures one frame of `scene`; `paths` are kernels, the first is the one that budgets and sums are measured on.
pub fn run(
    scene: &Scene,
    paths: &[Path],
    budgets: &[f64],
    repeats: usize,
    machine: Machine,
    progress: &mut dyn FnMut(&str),
) -> Result<Report> {
    let first = *paths.first().ok_or_else(|| Error::config("--paths", "name at least one kernel"))?;
    let field = scene.generator.field().portraits(&scene.codes)?.detached();
    let camera = scene.camera()?;
    let exact = RenderSettings { budget: 0.0, ..scene.settings.clone() };
    let picture = |path: Path, settings: &RenderSettings| -> Result<Tensor> {
        path.run(|| Ok(plan::render(&field, &camera, settings)?.frame.colour))
    };

    progress("exact frame");
    let all: Vec<Path> = paths.iter().copied().chain([Path::Composed]).collect();
    let mut ways: Vec<Way<'_>> =
        all.iter().map(|path| -> Way<'_> { Box::new(|| picture(*path, &exact).map(drop)) }).collect();
    let mut timings = in_turns(repeats, &mut ways)?;
    drop(ways);
    let plain = timings.pop().unwrap_or_else(|| Timing::of(Vec::new()));
    let reference = picture(Path::Composed, &exact)?;
    let mut path_reports = Vec::new();
    for (path, timing) in paths.iter().zip(timings) {
        path_reports.push(PathReport {
            path: path.name(),
            seconds: timing.median_seconds,
            speedup: plain.median_seconds / timing.median_seconds,
            max_difference: difference(&picture(*path, &exact)?, &reference)?.0,
            timing,
        });
    }
    let exact_seconds = path_reports.first().map_or(0.0, |report| report.seconds);

    let mut budgeted = Vec::new();
    let exact_picture = picture(first, &exact)?;
    for budget in budgets {
        progress(&format!("budget {budget:.4}"));
        budgeted.push(under_budget(&field, &camera, first, &exact, *budget, &exact_picture, repeats)?);
    }
    let discretisation = if scene.is_trained {
        discretisation(&field, &camera, first, &exact, repeats.min(3), progress)?
    } else {
        Vec::new()
    };
    let shape = generators::head_shape(&scene.generator.config().field);
    let generators = generators::run(shape, field.volume_regions().len(), paths, repeats, &machine, progress)?;

    let points = (exact.resolution * exact.resolution * exact.sampling.samples) as f64;
    let operations = operations_per_point(&scene.generator.config().field, exact.normals);
    let regions = field.volume_regions().len() as f64;
    Ok(Report {
        points_per_s: points / exact_seconds,
        gflops: points * regions * operations / exact_seconds / 1e9,
        peak_gflops: machine.peak_gflops(first),
        plain_seconds: plain.median_seconds,
        exact_seconds,
        budgeted,
        samples_for_40_db: samples_for(ENOUGH_DB, &discretisation, "uniform")
            .zip(samples_for(ENOUGH_DB, &discretisation, "surface"))
            .map(|(uniform, surface)| [uniform, surface]),
        discretisation,
        paths: path_reports,
        generators,
        scene: scene.describe(),
        machine,
    })
}

/// Operations at one point of one region for a picture, a multiply-add counting two; see [`generators::Work`].
fn operations_per_point(field: &crate::config::FieldConfig, normals: bool) -> f64 {
    let work = if normals { generators::Work::Gradient } else { generators::Work::Colour };
    work.operations(&generators::head_shape(field))
}

/// The frame under `budget`, in turns with the exact one.
fn under_budget(
    field: &PortraitField,
    camera: &Tensor,
    path: Path,
    exact: &RenderSettings,
    budget: f64,
    exact_picture: &Tensor,
    repeats: usize,
) -> Result<BudgetReport> {
    let settings = RenderSettings { budget, ..exact.clone() };
    let planned = path.run(|| plan::render(field, camera, &settings))?;
    let way = |settings: &RenderSettings| -> Way<'_> {
        let settings = settings.clone();
        Box::new(move || path.run(|| plan::render(field, camera, &settings)).map(drop))
    };
    let timings = in_turns(repeats, &mut [way(&settings), way(exact)])?;
    let (max_error, mean_error) = difference(&planned.frame.colour, exact_picture)?;
    let (own, whole) = (timings[0].median_seconds, timings[1].median_seconds);
    Ok(BudgetReport {
        budget,
        seconds: own,
        speedup: whole / own,
        max_error,
        mean_error,
        bound: planned.report.bound,
        regions_evaluated: planned.report.pairs_evaluated,
        samples_evaluated: planned.report.samples_evaluated,
        shape_pairs_evaluated: planned.report.shape_pairs_evaluated,
        pairs_skipped: planned.report.pairs_skipped,
    })
}

/// Pictures of few samples against that of 1024, uniform and placed at the surface.
fn discretisation(
    field: &PortraitField,
    camera: &Tensor,
    path: Path,
    exact: &RenderSettings,
    repeats: usize,
    progress: &mut dyn FnMut(&str),
) -> Result<Vec<DiscretisationReport>> {
    // Colours alone: features and normals of 1024 samples would only take time.
    let colours = RenderSettings { features: false, normals: false, ..exact.clone() };
    let converged = path.run(|| plan::render(field, camera, &with_samples(&colours, CONVERGED_SAMPLES)))?.frame.colour;
    let uniform = SAMPLES.map(|samples| ("uniform", samples, None));
    let surface = SURFACE_SAMPLES.map(|(samples, refinements, colour_samples)| {
        ("surface", samples, Some(TwoPass { refinements, colour_samples, ..TwoPass::default() }))
    });
    let mut reports = Vec::new();
    for (placement, samples, two_pass) in uniform.into_iter().chain(surface) {
        progress(&format!("{samples} samples, {placement}"));
        let settings = RenderSettings { two_pass, ..with_samples(&colours, samples) };
        let render = || path.run(|| plan::render(field, camera, &settings));
        let planned = render()?;
        let timing = in_turns(repeats, &mut [Box::new(|| render().map(drop))])?;
        reports.push(DiscretisationReport {
            samples: planned.report.samples_evaluated as f64 / planned.report.rays as f64,
            colour_samples: two_pass.map_or(samples, |two_pass| two_pass.colour_samples),
            placement,
            seconds: timing.first().map_or(0.0, |timing| timing.median_seconds),
            psnr: quality::psnr(&planned.frame.colour, &converged)?.first().copied().unwrap_or_default(),
        });
    }
    Ok(reports)
}

/// Samples a ray at which pictures first get to `decibels`, by a straight line between the two that are around it.
fn samples_for(decibels: f64, reports: &[DiscretisationReport], placement: &str) -> Option<f64> {
    let curve: Vec<_> = reports.iter().filter(|report| report.placement == placement).collect();
    curve.windows(2).find_map(|pair| match pair {
        [from, to] if from.psnr < decibels && to.psnr >= decibels => {
            Some(from.samples + (decibels - from.psnr) / (to.psnr - from.psnr) * (to.samples - from.samples))
        }
        _ => None,
    })
}

/// The charts' file names.
pub const CHARTS: [&str; 4] = ["paths.svg", "budgets.svg", "discretisation.svg", "roofline.svg"];

/// What a person looks at, in the order of [`CHARTS`].
pub fn charts(report: &Report) -> Result<Vec<(&'static str, String)>> {
    let subtitle = format!("{} · {}", report.scene, report.machine.describe());
    let mut bars: Vec<_> = report.paths.iter().map(|path| (path.path.to_owned(), path.seconds)).collect();
    bars.push(("candle's operations".to_owned(), report.plain_seconds));
    let budgets = report.budgeted.iter().map(|budget| (format!("budget {:.4}", budget.budget), budget.seconds));
    let groups = [
        Group { label: "exact frame".into(), bars },
        Group { label: "within a budget".into(), bars: budgets.collect() },
    ];
    let groups: Vec<_> = groups.into_iter().filter(|group| !group.bars.is_empty()).collect();
    let paths = GroupedBars::seconds_a_frame("A frame on every path", &subtitle, &groups).svg()?;

    let curve = |name: &str, value: &dyn Fn(&BudgetReport) -> f64| {
        let mut points: Vec<_> = report.budgeted.iter().map(|budget| (budget.seconds, value(budget))).collect();
        points.sort_by(|left, right| left.0.total_cmp(&right.0));
        Series { name: name.into(), points, mark: Mark::LineAndDots }
    };
    let mut lines = vec![
        curve("largest error", &|budget| budget.max_error),
        curve("mean error", &|budget| budget.mean_error),
        curve("bound that the plan kept", &|budget| budget.bound),
    ];
    let most = report.budgeted.iter().map(|budget| budget.max_error.max(budget.bound)).fold(1e-2, f64::max);
    let points = vec![(report.exact_seconds, 1e-6), (report.exact_seconds, most)];
    lines.push(Series { name: "the exact frame's time".into(), points, mark: Mark::Limit });
    let budgets = LineChart {
        title: "Time against error".into(),
        subtitle: subtitle.clone(),
        x: Axis::logarithmic("seconds a frame"),
        y: Axis::logarithmic("difference from the exact frame, share of the colour range"),
        series: lines,
    }
    .svg()?;

    let placed = |placement: &str, name: &str| Series {
        name: name.into(),
        points: report
            .discretisation
            .iter()
            .filter(|sum| sum.placement == placement)
            .map(|sum| (sum.samples, sum.psnr))
            .collect(),
        mark: Mark::LineAndDots,
    };
    let all = report.discretisation.iter().map(|sum| sum.samples);
    let ends = (all.clone().fold(f64::INFINITY, f64::min), all.fold(1.0, f64::max));
    let discretisation = LineChart {
        title: "Samples against the converged integral (1024 samples)".into(),
        subtitle,
        x: Axis::logarithmic("samples a ray, of distance alone or of everything, mean over rays"),
        y: Axis::linear("PSNR, dB"),
        series: vec![
            placed("uniform", "uniform"),
            placed("surface", "at the surface"),
            Series { name: "40 dB".into(), points: vec![(ends.0, 40.0), (ends.1, 40.0)], mark: Mark::Limit },
        ],
    }
    .svg()?;
    let roofline = generators::roofline(&report.generators, &report.machine)?;
    let charts = CHARTS.into_iter().zip([paths, budgets, discretisation, roofline]);
    Ok(charts.filter(|(name, _)| *name != "discretisation.svg" || !report.discretisation.is_empty()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_read_off_between_measurements() {
        let report = |placement, samples, psnr| DiscretisationReport {
            samples,
            colour_samples: 1,
            placement,
            seconds: 0.0,
            psnr,
        };
        let reports = [
            report("uniform", 8.0, 36.0),
            report("uniform", 12.0, 38.0),
            report("uniform", 16.0, 42.0),
            report("surface", 6.0, 39.0),
        ];
        assert_eq!(samples_for(40.0, &reports, "uniform"), Some(14.0));
        assert_eq!(samples_for(40.0, &reports, "surface"), None);
    }
}
