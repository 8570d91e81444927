//! The adjoint of a convolution in its weight: a sum over all positions of all images. Output channels lie along the
//! vectors, so that a value of the input is broadcast exactly like a weight is in the forward pass.
//!
//! Tasks share out input and output channels, never the positions: each sum runs through the whole batch in one
//! order, whatever the number of threads.

use std::cell::RefCell;
use std::ops::Range;

use rayon::prelude::*;

use super::InstructionSet;
use super::direct::SharedOutput;
use super::geometry::{Geometry, PaddedSource};
use super::tile::{self, MOST_ROWS, Product, Registers};

/// Positions summed between two visits to the sums in memory: their gradients, for three vectors of channels, fill
/// most of a first-level cache.
const STRIP_POSITIONS: usize = 192;

/// Sums of one task: they stay in the second-level cache beside the strip.
const SUMS: usize = 32_000;

/// `[O, C, kh, kw]`, row-major, from the input `[B, C, H, W]` and the gradient of the output `[B, O, Ho, Wo]`.
pub(super) fn weight_gradient(
    instruction_set: InstructionSet,
    geometry: &Geometry,
    input: &[f32],
    grad_output: &[f32],
) -> Vec<f32> {
    let mut source = PaddedSource::of_input(geometry);
    source.strip = (STRIP_POSITIONS / geometry.output_width).clamp(1, geometry.output_height);

    // Output channels in chunks of a product's vectors, as equal as can be; then input channels, as needed to keep
    // the sums near and to give every thread a share.
    let (lanes, most_vectors) = instruction_set.lanes_and_vectors();
    let vectors = geometry.output_channels.div_ceil(lanes);
    let chunks = vectors.div_ceil(most_vectors);
    let threads = rayon::current_num_threads();
    let groups = threads.div_ceil(chunks).min(geometry.input_channels);
    let most = (SUMS / (geometry.taps() * most_vectors * lanes)).max(1);
    let group = geometry.input_channels.div_ceil(groups).min(most);
    let groups = geometry.input_channels.div_ceil(group);

    let size = geometry.weight_shape().iter().product();
    let mut result = Vec::<f32>::with_capacity(size);
    let shared = SharedOutput(result.as_mut_ptr());
    (0..chunks * groups).into_par_iter().for_each(|task| {
        let (chunk, group_index) = (task / groups, task % groups);
        let output_channels = chunk * vectors / chunks * lanes..(chunk + 1) * vectors / chunks * lanes;
        // Bound as a whole, so that the closure captures the wrapper and not the bare pointer in it.
        let shared: SharedOutput = shared;
        SCRATCH.with_borrow_mut(|scratch| {
            let job = WeightJob {
                geometry,
                source: &source,
                input,
                grad_output,
                input_channels: group_index * group..((group_index + 1) * group).min(geometry.input_channels),
                output_channels: output_channels.start..output_channels.end.min(geometry.output_channels),
                result: shared,
                scratch,
            };
            tile::on(instruction_set, job);
        });
    });
    // SAFETY: the capacity is at least this, and the tasks' (input, output) channels cover all weights.
    unsafe { result.set_len(size) };
    result
}

/// Per-thread buffers that outlive a call.
#[derive(Default)]
struct Scratch {
    strip: Vec<f32>,
    gradients: Vec<f32>,
    sums: Vec<f32>,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

/// The weight's gradient for some input and some output channels.
struct WeightJob<'a> {
    geometry: &'a Geometry,
    source: &'a PaddedSource,
    input: &'a [f32],
    grad_output: &'a [f32],
    input_channels: Range<usize>,
    /// At most [`Registers::VECTORS`] vectors of them.
    output_channels: Range<usize>,
    result: SharedOutput,
    scratch: &'a mut Scratch,
}

impl tile::Job for WeightJob<'_> {
    #[inline(always)]
    unsafe fn run<V: Registers>(self) {
        let (geometry, source) = (self.geometry, self.source);
        let vectors = self.output_channels.len().div_ceil(V::COUNT);
        let width = vectors * V::COUNT;
        let taps: Vec<usize> = (0..geometry.kernel_height)
            .flat_map(|ky| (0..geometry.kernel_width).map(move |kx| source.offset(ky, kx)))
            .collect();
        let weights = self.input_channels.len() * taps.len();
        // Where each weight meets the input at the strip's first position; the last one again to fill up a product.
        let starts: Vec<usize> = (0..weights + MOST_ROWS)
            .map(|weight| weight.min(weights - 1))
            .map(|weight| weight / taps.len() * source.channel_size() + taps[weight % taps.len()])
            .collect();
        let offsets: Vec<u32> = (0..geometry.output_width).map(|x| (x * width) as u32).collect();

        let Scratch { strip, gradients, sums } = self.scratch;
        let strip_positions = source.strip * geometry.output_width;
        if gradients.len() < strip_positions * width {
            gradients.resize(strip_positions * width, 0.0);
        }
        if sums.len() < weights * width {
            sums.resize(weights * width, 0.0);
        }

        for image in 0..geometry.batch {
            let input = &self.input[image * geometry.input_size()..][..geometry.input_size()];
            let grad_output = &self.grad_output[image * geometry.output_size()..][..geometry.output_size()];
            for index in 0..source.strips() {
                let rows = source.rows_of_strip(index);
                let strip = if source.is_in_place() {
                    let first = self.input_channels.start * source.channel_size() + rows.start * source.pitch();
                    input[first..].as_ptr()
                } else {
                    source.fill(input, self.input_channels.clone(), rows.clone(), 0, strip);
                    strip.as_ptr()
                };
                let plane = geometry.output_height * geometry.output_width;
                let first = self.output_channels.start * plane + rows.start * geometry.output_width;
                // Gradients as [position, channel].
                // SAFETY: these channels' rows are inside the image (`first` starts the first of them, checked by the
                // slice), and `gradients` has room for `width` channels at each position of a strip.
                unsafe {
                    tile::transpose::<V>(
                        (self.output_channels.len(), rows.len() * geometry.output_width),
                        (grad_output[first..].as_ptr(), plane),
                        (gradients.as_mut_ptr(), width),
                    );
                }
                let mut weight = 0;
                while weight < weights {
                    let height = tile::rows_of_next::<V>(weights - weight);
                    // SAFETY: `starts` has MOST_ROWS entries beyond `weights`, each of which stays inside the strip for
                    // all positions of `rows`; gradients and sums were sized for these vectors just above; the caller
                    // vouches for V.
                    unsafe {
                        let mut rows_of_product = [strip; MOST_ROWS];
                        for (m, row) in rows_of_product.iter_mut().enumerate() {
                            *row = row.add(*starts.get_unchecked(weight + m));
                        }
                        let product = Product {
                            rows: rows_of_product,
                            row_step: source.pitch(),
                            columns: gradients.as_ptr(),
                            column_step: geometry.output_width * width,
                            offsets: &offsets,
                            repetitions: rows.len(),
                            out: sums.as_mut_ptr().add(weight * width),
                            out_stride: width,
                            stored: height.min(weights - weight),
                            initial: (image == 0 && index == 0).then_some([0.0; MOST_ROWS]),
                        };
                        tile::multiply::<V>(height, vectors, &product);
                    }
                    weight += height;
                }
            }
        }

        let row = geometry.input_channels * taps.len();
        let first = self.output_channels.start * row + self.input_channels.start * taps.len();
        // SAFETY: the sums are [weights, width]; the result is [O, C·taps], and no other task has these input and output
        // channels.
        unsafe {
            tile::transpose::<V>(
                (weights, self.output_channels.len()),
                (sums.as_ptr(), width),
                (self.result.0.add(first), row),
            );
        }
    }
}
