//! An orbit around one portrait: every frame exact, and every frame over shared geometry.

use std::time::Instant;

use serde::Serialize;

use crate::{
    bench::{
        Machine,
        measure::Timing,
        scene::{Scene, difference},
    },
    camera::Camera,
    error::Result,
    interop::chart::{Group, GroupedBars},
    kernels::Path,
    render::{
        RadianceField as _, RenderSettings,
        plan::{self, Sequence},
        trajectory::Trajectory,
    },
};

/// An orbit, frame by frame both ways.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Frames of the orbit.
    pub frames: usize,
    /// Median seconds of an exact frame.
    pub exact_seconds_per_frame: f64,
    /// Median seconds of a frame over shared geometry, and its share of making that.
    pub shared_seconds_per_frame: f64,
    /// Largest difference of any pixel of any frame, [0, 1] colour units.
    pub max_error: f64,
    /// The mean difference.
    pub mean_error: f64,
    /// How many times faster the shared orbit is.
    pub speedup: f64,
    /// Largest difference allowed.
    pub budget: f64,
    /// Largest difference that the plans estimated.
    pub bound: f64,
    /// Seconds the shared geometry took to make.
    pub grid_seconds: f64,
    /// Memory it keeps, bytes.
    pub grid_bytes: usize,
    /// Median seconds of a frame under the same budget that shares nothing.
    pub planned_seconds_per_frame: f64,
    /// Spread of the exact frames.
    pub exact: Timing,
    /// Spread of the shared frames.
    pub shared: Timing,
    /// What was rendered.
    pub scene: String,
    /// On which kernel path.
    pub path: &'static str,
    /// Where.
    pub machine: Machine,
}

/// Renders `frames` frames of an orbit three ways in turns: exact, under `budget`, and under it over shared geometry.
pub fn run(
    scene: &Scene,
    path: Path,
    frames: usize,
    budget: f64,
    machine: Machine,
    progress: &mut dyn FnMut(usize),
) -> Result<Report> {
    path.run(|| {
        let cameras: Vec<Camera> = Trajectory::Orbit.cameras(Some(frames))?;
        let field = scene.generator.field().portraits(&scene.codes)?.detached();
        let device = scene.generator.device();
        let exact = RenderSettings { budget: 0.0, ..scene.settings.clone() };
        let settings = RenderSettings { budget, ..scene.settings.clone() };
        let one = |camera: &Camera| Camera::parameter_tensor(&[*camera], &device);
        if let Some(camera) = cameras.first() {
            // What is made on first use is not a frame's cost.
            plan::render(&field, &one(camera)?, &exact)?;
            plan::render(&field, &one(camera)?, &settings)?;
        }
        let began = Instant::now();
        let sequence = Sequence::new(&field, &Camera::parameter_tensor(&cameras, &device)?, &settings)?;
        let grid_seconds = began.elapsed().as_secs_f64();

        let (mut whole, mut planned, mut shared) = (Vec::new(), Vec::new(), Vec::new());
        let (mut max_error, mut mean_error, mut bound) = (0f64, 0.0, 0f64);
        for (index, camera) in cameras.iter().enumerate() {
            let camera = one(camera)?;
            let began = Instant::now();
            let expected = plan::render(&field, &camera, &exact)?;
            whole.push(began.elapsed().as_secs_f64());
            let began = Instant::now();
            plan::render(&field, &camera, &settings)?;
            planned.push(began.elapsed().as_secs_f64());
            let began = Instant::now();
            let found = sequence.render(&field, &camera)?;
            shared.push(began.elapsed().as_secs_f64());
            let (largest, mean) = difference(&found.frame.colour, &expected.frame.colour)?;
            max_error = max_error.max(largest);
            mean_error += mean / cameras.len() as f64;
            bound = bound.max(found.report.bound);
            progress(index + 1);
        }
        let (exact_timing, shared_timing) = (Timing::of(whole), Timing::of(shared));
        let shared_seconds_per_frame = shared_timing.median_seconds + grid_seconds / cameras.len().max(1) as f64;
        Ok(Report {
            frames: cameras.len(),
            exact_seconds_per_frame: exact_timing.median_seconds,
            shared_seconds_per_frame,
            max_error,
            mean_error,
            speedup: exact_timing.median_seconds / shared_seconds_per_frame,
            budget,
            bound,
            grid_seconds,
            grid_bytes: sequence.memory(),
            planned_seconds_per_frame: Timing::of(planned).median_seconds,
            exact: exact_timing,
            shared: shared_timing,
            scene: scene.describe(),
            path: path.name(),
            machine,
        })
    })
}

/// The chart's file name.
pub const CHART: &str = "sequence.svg";

/// Seconds a frame, three ways.
pub fn chart(report: &Report) -> Result<String> {
    let subtitle = format!("{} · {}", report.scene, report.machine.describe());
    let title = format!("{} frames of an orbit, largest error {:.4}", report.frames, report.max_error);
    let bars = vec![
        ("exact".to_owned(), report.exact_seconds_per_frame),
        (format!("within {:.4}", report.budget), report.planned_seconds_per_frame),
        ("over shared geometry, its making included".to_owned(), report.shared_seconds_per_frame),
    ];
    let groups = [Group { label: format!("a frame ({})", report.path), bars }];
    GroupedBars::seconds_a_frame(&title, &subtitle, &groups).svg()
}
