//! Convolutions of the networks' shapes: the direct kernels against candle's own, both beside the ceiling.

use candle_core::{Device, Tensor};
use serde::Serialize;

use crate::{
    bench::{
        Machine,
        measure::{Way, in_turns},
    },
    error::Result,
    interop::chart::{Group, GroupedBars},
    kernels::{Path, conv},
    rng::Stream,
};

/// A convolution at a place of a network, batch 1, stride 1, same size.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Channels in and out.
    pub channels: usize,
    /// Width and height, pixels.
    pub size: usize,
    /// Width and height of the kernel.
    pub kernel: usize,
}

impl Shape {
    /// The shapes of shared/prototypes: where the authors' networks spend their time, and their 1 × 1 convolutions.
    pub const REFERENCE: [Self; 4] = [
        Self { channels: 256, size: 64, kernel: 3 },
        Self { channels: 64, size: 128, kernel: 3 },
        Self { channels: 32, size: 256, kernel: 3 },
        Self { channels: 256, size: 64, kernel: 1 },
    ];
    /// A fraction of those: for a first look, and for tests.
    pub const SMALL: [Self; 2] =
        [Self { channels: 32, size: 32, kernel: 3 }, Self { channels: 48, size: 64, kernel: 1 }];

    /// Operations of any of the three passes, a multiply-add counting two; products with the padding are counted, as
    /// everybody does.
    fn operations(&self) -> f64 {
        2.0 * (self.channels * self.channels * self.kernel * self.kernel * self.size * self.size) as f64
    }
}

impl std::fmt::Display for Shape {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { channels, size, kernel } = self;
        write!(f, "{channels} channels at {size}×{size}, {kernel}×{kernel}")
    }
}

/// Which of the three maps.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Pass {
    /// Input and weight to output.
    Forward,
    /// Output's gradient and weight to the input's.
    InputGradient,
    /// Input and output's gradient to the weight's.
    WeightGradient,
}

impl Pass {
    const ALL: [Self; 3] = [Self::Forward, Self::InputGradient, Self::WeightGradient];

    fn name(self) -> &'static str {
        match self {
            Self::Forward => "forward",
            Self::InputGradient => "input gradient",
            Self::WeightGradient => "weight gradient",
        }
    }
}

/// One pass at one shape on one path.
#[derive(Clone, Debug, Serialize)]
pub struct Row {
    /// The shape in words.
    pub shape: String,
    /// Which map.
    pub pass: Pass,
    /// 10⁹ operations a second of the direct kernel.
    pub gflops: f64,
    /// The same of candle's own operations.
    pub plain_gflops: f64,
    /// The ceiling of the kernel's instruction set on these threads, measured in this run.
    pub peak_gflops: f64,
    /// The kernel's path.
    pub path: &'static str,
    /// Seconds of the kernel's fastest round, as the ceiling is that of each thread's best stretch.
    pub seconds: f64,
    /// Seconds of the fastest round of candle's operations.
    pub plain_seconds: f64,
    /// Largest difference of the two results, relative to the largest value.
    pub largest_difference: f64,
    /// Where this was measured.
    pub machine: String,
}

/// Every pass at every shape on every path, each against candle's own in the same run.
pub fn run(
    shapes: &[Shape],
    paths: &[Path],
    repeats: usize,
    machine: &Machine,
    progress: &mut dyn FnMut(&str),
) -> Result<Vec<Row>> {
    let mut rows = Vec::new();
    for shape in shapes {
        let Shape { channels, size, kernel } = *shape;
        let mut random = Stream::new(17, &[channels as u64, size as u64]);
        let picture = |random: &mut Stream| random.normal_tensor(&[1, channels, size, size], &Device::Cpu);
        let (input, slope) = (picture(&mut random)?, picture(&mut random)?);
        let weight = random.normal_tensor(&[channels, channels, kernel, kernel], &Device::Cpu)?;
        for pass in Pass::ALL {
            progress(&format!("{shape}, {}", pass.name()));
            let compute = |path: Path| -> Result<Tensor> {
                path.run(|| {
                    Ok(match pass {
                        Pass::Forward => conv::conv2d(&input, &weight, None, 1, kernel / 2)?,
                        Pass::InputGradient => {
                            conv::conv2d_input_gradient(&slope, &weight, (size, size), 1, kernel / 2)?
                        }
                        Pass::WeightGradient => {
                            conv::conv2d_weight_gradient(&input, &slope, (kernel, kernel), 1, kernel / 2)?
                        }
                    })
                })
            };
            let expected = compute(Path::Composed)?;
            for path in paths {
                let difference = largest(&(compute(*path)? - &expected)?)? / largest(&expected)?;
                let way = |path: Path| -> Way<'_> { Box::new(move || compute(path).map(drop)) };
                let timings = in_turns(repeats, &mut [way(*path), way(Path::Composed)])?;
                let (own, plain) = (timings[0].least_seconds, timings[1].least_seconds);
                rows.push(Row {
                    shape: shape.to_string(),
                    pass,
                    gflops: shape.operations() / own / 1e9,
                    plain_gflops: shape.operations() / plain / 1e9,
                    peak_gflops: machine.peak_gflops(*path),
                    path: path.name(),
                    seconds: own,
                    plain_seconds: plain,
                    largest_difference: difference,
                    machine: machine.describe(),
                });
            }
        }
    }
    Ok(rows)
}

fn largest(tensor: &Tensor) -> Result<f64> {
    Ok(f64::from(tensor.abs()?.max_all()?.to_scalar::<f32>()?))
}

/// Speeds as bars, ceilings as lines.
pub fn chart(rows: &[Row], machine: &Machine) -> Result<String> {
    let mut groups: Vec<Group> = Vec::new();
    for row in rows {
        let label = format!("{} · {}", row.shape.replace(" channels", ""), row.pass.name());
        match groups.iter_mut().find(|group| group.label == label) {
            Some(group) => group.bars.insert(group.bars.len() - 1, (row.path.to_owned(), row.gflops)),
            None => groups.push(Group {
                label,
                bars: vec![(row.path.to_owned(), row.gflops), ("candle".to_owned(), row.plain_gflops)],
            }),
        }
    }
    let used = machine.peaks.iter().filter(|peak| rows.iter().any(|row| row.path == peak.name));
    let limits: Vec<_> = used.map(|peak| (format!("{} peak", peak.name), peak.gflops)).collect();
    GroupedBars {
        title: "Convolutions, batch 1",
        subtitle: &machine.describe(),
        unit: "10⁹ operations a second; longer is faster",
        groups: &groups,
        limits: &limits,
    }
    .svg()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pass_is_measured_on_every_path_and_agrees() {
        let machine = Machine::measure();
        let paths: Vec<_> = Path::available().filter(|path| !matches!(path, Path::Composed)).collect();
        let shapes = [Shape { channels: 8, size: 12, kernel: 3 }];
        let rows = run(&shapes, &paths, 1, &machine, &mut |_| ()).unwrap();
        assert_eq!(rows.len(), 3 * paths.len());
        for row in &rows {
            assert!(row.gflops > 0.0 && row.plain_gflops > 0.0 && row.largest_difference < 1e-5, "{row:?}");
        }
        assert!(chart(&rows, &machine).unwrap().contains("weight gradient"));
    }
}
