//! The local generators' kernels alone, on every path: how much of the machine's ceiling they reach, forward and backward.

use serde::Serialize;

use crate::{
    bench::{
        Machine,
        measure::{Way, in_turns},
    },
    error::Result,
    interop::chart::{Axis, LineChart, Mark, Series},
    kernels::{self, Evaluation, Extent, FILM_LAYERS, Gradients, HeadShape, Outputs, Path},
    rng::Stream,
};

/// What of the local generators is computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Work {
    /// Masks and residual distances alone: what decides where the surface is.
    Shape,
    /// And colours: what a picture needs.
    Colour,
    /// And ∇mask and ∇residual.
    Gradient,
    /// The backward pass of colours, recomputing included, to weights, FiLM and points.
    Backward,
}

impl Work {
    const ALL: [Self; 4] = [Self::Shape, Self::Colour, Self::Gradient, Self::Backward];

    fn outputs(self) -> Outputs {
        Outputs { gradient: self == Self::Gradient, colour: self != Self::Shape, activations: false }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Shape => "shape",
            Self::Colour => "shape and colour",
            Self::Gradient => "with ∇mask and ∇residual",
            Self::Backward => "backward",
        }
    }

    /// Operations at one point of one region, a multiply-add counting two; sines are not counted.
    pub(super) fn operations(self, shape: &HeadShape) -> f64 {
        let width = shape.width as f64;
        // A sweep back to the point through three layers, of which two are square.
        let sweep = |layers: f64| 2.0 * ((layers - 1.0) * width * width + 3.0 * width);
        let layers = |depth: f64| 2.0 * (3.0 * width + (depth - 1.0) * width * width);
        let shape_layers = shape.residual_depth() as f64;
        match self {
            Self::Shape => layers(shape_layers) + 4.0 * width,
            Self::Colour => layers(FILM_LAYERS as f64) + 10.0 * width,
            Self::Gradient => layers(FILM_LAYERS as f64) + 10.0 * width + sweep(3.0) + sweep(shape_layers),
            // Recomputing, and two products of the forward pass's size: to inputs and to weights.
            Self::Backward => 3.0 * (layers(FILM_LAYERS as f64) + 10.0 * width),
        }
    }

    /// Bytes that must come from and go to memory at one point, for all regions.
    fn bytes(self, shape: &HeadShape, regions: usize) -> f64 {
        let rows = shape.rows(self.outputs()).count;
        let points = shape.point_columns();
        let values = match self {
            // The upstream is read and the points' gradient written once a region and once in all.
            Self::Backward => points + regions * rows + (2 * regions + 1) * points,
            _ => points + regions * rows,
        };
        4.0 * values as f64
    }
}

/// One kind of work on one path.
#[derive(Clone, Debug, Serialize)]
pub struct Speed {
    /// What was computed.
    pub work: Work,
    /// On which path.
    pub path: &'static str,
    /// 10⁹ operations a second.
    pub gflops: f64,
    /// The ceiling of the path's instruction set on these threads.
    pub peak_gflops: f64,
    /// The one over the other.
    pub share_of_peak: f64,
    /// Operations for each byte that passes memory.
    pub operations_per_byte: f64,
    /// The fastest round, as the ceiling is that of each thread's best stretch: what nothing else on the machine disturbs.
    pub seconds: f64,
}

/// Points evaluated at a time: as a renderer's chunk.
const POINTS: usize = 16_384;

/// Times every kind of work on every path of `paths` that is a kernel, for one picture of `regions` regions.
pub fn run(
    shape: HeadShape,
    regions: usize,
    paths: &[Path],
    repeats: usize,
    machine: &Machine,
    progress: &mut dyn FnMut(&str),
) -> Result<Vec<Speed>> {
    let mut random = Stream::new(23, &[]);
    let mut draw = |count: usize, mean: f32, deviation: f32| -> Vec<f32> {
        (0..count).map(|_| mean + deviation * random.normal()).collect()
    };
    let points = draw(POINTS * shape.point_columns(), 0.0, 0.7);
    let weights = draw(regions * shape.parameter_count(), 0.0, 0.7 / (shape.width as f32).sqrt());
    let film = draw(regions * FILM_LAYERS * 2 * shape.width, 1.5, 0.7);
    let extent = Extent { images: 1, regions, points: POINTS };
    let mut speeds = Vec::new();
    for work in Work::ALL {
        progress(&format!("local generators, {}", work.name()));
        let evaluation = Evaluation::new(shape, work.outputs(), extent, &points, &weights, &film)?;
        let evaluation = &evaluation;
        let upstream = draw(evaluation.result_len(), 0.0, 1.0);
        let upstream = &upstream;
        let chosen: Vec<_> = paths.iter().filter_map(|path| kernel(*path).map(|kernel| (*path, kernel))).collect();
        let (points_len, weights_len, film_len) = (points.len(), weights.len(), film.len());
        let mut ways: Vec<Way<'_>> = chosen
            .iter()
            .map(|(_, kernel)| -> Way<'_> {
                let mut result = vec![0.0; evaluation.result_len()];
                let (mut to_points, mut to_weights, mut to_film) =
                    (vec![0.0; points_len], vec![0.0; weights_len], vec![0.0; film_len]);
                Box::new(move || {
                    if work != Work::Backward {
                        return Ok(kernel.forward(evaluation, &mut result)?);
                    }
                    let gradients =
                        Gradients { points: Some(&mut to_points), weights: &mut to_weights, film: &mut to_film };
                    Ok(kernel.backward(evaluation, upstream, gradients)?)
                })
            })
            .collect();
        let timings = in_turns(repeats, &mut ways)?;
        for ((path, _), timing) in chosen.iter().zip(timings) {
            let operations = work.operations(&shape) * (POINTS * regions) as f64;
            let (gflops, peak_gflops) = (operations / timing.least_seconds / 1e9, machine.peak_gflops(*path));
            speeds.push(Speed {
                work,
                path: path.name(),
                gflops,
                peak_gflops,
                share_of_peak: gflops / peak_gflops,
                operations_per_byte: work.operations(&shape) * regions as f64 / work.bytes(&shape, regions),
                seconds: timing.least_seconds,
            });
        }
    }
    Ok(speeds)
}

fn kernel(path: Path) -> Option<&'static dyn kernels::RegionKernel<f32>> {
    match path {
        // The reference's loops take minutes.
        Path::Kernel(kernel) if kernel.name() != "plain" => Some(kernel),
        _ => None,
    }
}

/// The roofline: speed over operations per byte, under the ceilings of arithmetic and memory.
pub fn roofline(speeds: &[Speed], machine: &Machine) -> Result<String> {
    let mut series: Vec<Series> = Vec::new();
    for speed in speeds {
        let point = (speed.operations_per_byte, speed.gflops);
        match series.iter_mut().find(|series| series.name == speed.path) {
            Some(series) => series.points.push(point),
            None => {
                series.push(Series { name: speed.path.to_owned(), points: vec![point], mark: Mark::Dots });
            }
        }
    }
    // Ceilings go on far beyond the dots: there the legend finds room.
    let most = speeds.iter().map(|speed| speed.operations_per_byte).fold(1.0, f64::max) * 1000.0;
    for peak in machine.peaks.iter().filter(|peak| speeds.iter().any(|speed| speed.path == peak.name)) {
        let knee = peak.gflops / machine.memory_gigabytes_per_second;
        let points = vec![(0.25, 0.25 * machine.memory_gigabytes_per_second), (knee, peak.gflops), (most, peak.gflops)];
        let name = format!("ceiling, {} and {:.0} GB/s memory", peak.name, machine.memory_gigabytes_per_second);
        series.push(Series { name, points, mark: Mark::Limit });
    }
    LineChart {
        title: "Local generators: shape, colour, ∇, backward".into(),
        subtitle: machine.describe(),
        x: Axis::logarithmic("operations for each byte that passes memory"),
        y: Axis::logarithmic("10⁹ operations a second"),
        series,
    }
    .svg()
}

/// The heads of a field's local generators.
pub fn head_shape(field: &crate::config::FieldConfig) -> HeadShape {
    HeadShape {
        width: field.width,
        sdf_head: field.sdf_head,
        mask_view: field.mask_view_input,
        colour_view: field.feature_view_input,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::SdfHead;

    #[test]
    fn operations_are_those_of_the_matrices() {
        let shape = HeadShape { width: 4, sdf_head: SdfHead::Shape, mask_view: false, colour_view: false };
        // 3·4 + 2·16 multiply-adds of three layers, two heads of 4; two more layers and three colours.
        assert_eq!(Work::Shape.operations(&shape), 2.0 * (12.0 + 32.0 + 8.0));
        assert_eq!(Work::Colour.operations(&shape), 2.0 * (12.0 + 64.0 + 20.0));
        assert_eq!(Work::Gradient.operations(&shape), 2.0 * (12.0 + 64.0 + 20.0 + 2.0 * (12.0 + 32.0)));
    }
}
