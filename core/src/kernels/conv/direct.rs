//! Convolution and transposed convolution without an intermediate matrix: strips of padded rows, tiles of up to 48
//! positions, all output channels over each tile.
//!
//! A transposed convolution of stride s is s² ordinary ones of stride 1, each with every s-th tap of the kernel
//! (in both axes) and writing every s-th row and column; so both are a [`Plan`] of one or more [`Phase`]s.

use std::borrow::Cow;
use std::cell::RefCell;
use std::ops::Range;

use rayon::prelude::*;

use super::InstructionSet;
use super::geometry::{Geometry, PaddedSource};
use super::tile::{self, MOST_ROWS, MOST_VECTORS, Product, Vector};

/// Values of one strip: about half of a second-level cache of 1 MB, the rest is for weights and sums.
const STRIP_VALUES: usize = 100_000;
/// Values of the strip that one block of summands may touch per tile: they stay in the first-level cache while all
/// output channels pass over them.
const BLOCK_VALUES: usize = 6_000;

/// The convolution of `input` by `weight`, row-major `[B, O, Ho, Wo]`.
pub(super) fn forward(
    instruction_set: InstructionSet,
    geometry: &Geometry,
    input: &[f32],
    weight: &[f32],
    bias: Option<&[f32]>,
) -> Vec<f32> {
    let source = PaddedSource::of_input(geometry).with_strips_of(STRIP_VALUES);
    let phase = Phase {
        weights: Cow::Borrowed(weight),
        offsets: channel_offsets(geometry.input_channels, source.channel_size(), |offsets| {
            for ky in 0..geometry.kernel_height {
                offsets.extend((0..geometry.kernel_width).map(|kx| source.offset(ky, kx)));
            }
        }),
        origin: [0, 0],
    };
    let plan = Plan {
        source,
        phases: vec![phase],
        step: 1,
        channels: geometry.output_channels,
        size: [geometry.output_height, geometry.output_width],
    };
    plan.run(instruction_set, geometry.batch, input, bias)
}

/// The adjoint of [`forward`] in its input: a transposed convolution of `grad_output`, row-major `[B, C, H, W]`.
pub(super) fn input_gradient(
    instruction_set: InstructionSet,
    geometry: &Geometry,
    grad_output: &[f32],
    weight: &[f32],
) -> Vec<f32> {
    let (stride, padding) = (geometry.stride, geometry.padding);
    let kernel = [geometry.kernel_height, geometry.kernel_width];
    let size = [geometry.input_height, geometry.input_width];
    // Input row Y meets output row q − t through tap φ + s·t, where q = ⌊(Y + p) / s⌋ and φ = (Y + p) mod s.
    let first = padding / stride;
    let most_taps = kernel.map(|k| k.div_ceil(stride));
    let source = PaddedSource {
        channels: geometry.output_channels,
        size: [geometry.output_height, geometry.output_width],
        stride: 1,
        lead: most_taps.map(|taps| taps as isize - 1 - first as isize),
        kernel: most_taps,
        grid: size.map(|size| (size - 1 + padding) / stride + 1 - first),
        strip: 1,
    }
    .with_strips_of(STRIP_VALUES);

    let mut phases = Vec::with_capacity(stride * stride);
    for row_phase in 0..stride {
        for column_phase in 0..stride {
            let taps = |axis: usize, phase: usize| (phase..kernel[axis]).step_by(stride).enumerate();
            let offsets = channel_offsets(geometry.output_channels, source.channel_size(), |offsets| {
                for (ty, _) in taps(0, row_phase) {
                    offsets.extend(
                        taps(1, column_phase)
                            .map(|(tx, _)| source.offset(most_taps[0] - 1 - ty, most_taps[1] - 1 - tx)),
                    );
                }
            });
            let mut weights = Vec::with_capacity(geometry.input_channels * offsets.len());
            for c in 0..geometry.input_channels {
                for o in 0..geometry.output_channels {
                    let at = (o * geometry.input_channels + c) * geometry.taps();
                    let kernel_of_pair = &weight[at..at + geometry.taps()];
                    for (_, ky) in taps(0, row_phase) {
                        weights.extend(taps(1, column_phase).map(|(_, kx)| kernel_of_pair[ky * kernel[1] + kx]));
                    }
                }
            }
            let origin = [row_phase, column_phase].map(|phase| (stride * first + phase) as isize - padding as isize);
            phases.push(Phase { weights: Cow::Owned(weights), offsets, origin });
        }
    }
    let plan = Plan { source, phases, step: stride, channels: geometry.input_channels, size };
    plan.run(instruction_set, geometry.batch, grad_output, None)
}

impl PaddedSource {
    /// The input of a convolution, in strips of one row.
    pub fn of_input(geometry: &Geometry) -> Self {
        Self {
            channels: geometry.input_channels,
            size: [geometry.input_height, geometry.input_width],
            stride: geometry.stride,
            lead: [geometry.padding as isize; 2],
            kernel: [geometry.kernel_height, geometry.kernel_width],
            grid: [geometry.output_height, geometry.output_width],
            strip: 1,
        }
    }
}

/// The taps of one channel (as `taps` lists them), repeated for every channel of the strip.
fn channel_offsets(channels: usize, channel_size: usize, taps: impl Fn(&mut Vec<usize>)) -> Vec<u32> {
    let mut of_one = Vec::new();
    taps(&mut of_one);
    // A strip holds a single row of the grid before it could outgrow u32; 2^32 values in one row of all channels
    // would be 16 GB.
    (0..channels).flat_map(|c| of_one.iter().map(move |tap| (c * channel_size + tap) as u32)).collect()
}

/// A convolution laid out for the strips of `source`.
struct Plan<'a> {
    source: PaddedSource,
    phases: Vec<Phase<'a>>,
    /// Distance of neighbouring grid positions in the result.
    step: usize,
    /// Channels of the result.
    channels: usize,
    /// Rows and columns of the result.
    size: [usize; 2],
}

/// A stride-1 convolution over the padded source that yields every `step`-th row and column of the result.
struct Phase<'a> {
    /// `[channels of the result, summands]`.
    weights: Cow<'a, [f32]>,
    /// Where each summand is found in the strip.
    offsets: Vec<u32>,
    /// Row and column of the result at grid position (0, 0).
    origin: [isize; 2],
}

/// Per-thread buffers that outlive a call: fresh memory costs more than the arithmetic of a small convolution.
#[derive(Default)]
struct Scratch {
    strip: Vec<f32>,
    sums: Vec<f32>,
    pieces: Vec<Piece>,
}

/// Neighbouring positions of a tile that lie in one row of the result.
struct Piece {
    /// First position in the tile.
    from: usize,
    /// First value in the result's channel.
    to: usize,
    /// Number of positions.
    count: usize,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

/// A result that tasks write side by side.
#[derive(Clone, Copy)]
pub(super) struct SharedOutput(pub *mut f32);

// SAFETY: the tasks that share a result write disjoint values of it, and nobody reads it before they are done.
unsafe impl Send for SharedOutput {}
// SAFETY: as above.
unsafe impl Sync for SharedOutput {}

impl Plan<'_> {
    fn run(&self, instruction_set: InstructionSet, batch: usize, input: &[f32], bias: Option<&[f32]>) -> Vec<f32> {
        let source = &self.source;
        let image_size = source.channels * source.size[0] * source.size[1];
        let result_size = self.channels * self.size[0] * self.size[1];
        let strips = source.strips();
        // Few strips (small pictures): share the channels out too. Every value is summed in the same order either way.
        let threads = rayon::current_num_threads();
        let wanted = if threads == 1 { 1 } else { (2 * threads).div_ceil(batch * strips) };
        let group = self.channels.div_ceil(wanted).next_multiple_of(MOST_ROWS);
        let groups = self.channels.div_ceil(group);

        let mut result = Vec::<f32>::with_capacity(batch * result_size);
        let shared = SharedOutput(result.as_mut_ptr());
        (0..batch * strips * groups).into_par_iter().for_each(|task| {
            let (image, strip, group_index) = (task / groups / strips, task / groups % strips, task % groups);
            // Bound as a whole, so that the closure captures the wrapper and not the bare pointer in it.
            let shared: SharedOutput = shared;
            SCRATCH.with_borrow_mut(|scratch| {
                let job = StripJob {
                    plan: self,
                    image: &input[image * image_size..][..image_size],
                    bias,
                    rows: source.rows_of_strip(strip),
                    channels: group_index * group..((group_index + 1) * group).min(self.channels),
                    // SAFETY: image < batch, so the image's result starts inside the allocation.
                    result: SharedOutput(unsafe { shared.0.add(image * result_size) }),
                    scratch,
                };
                tile::on(instruction_set, job);
            });
        });
        // SAFETY: the capacity is at least this, and every position (row, column) of the result belongs to exactly one
        // phase and grid position, all of which were visited for all images and channels.
        unsafe { result.set_len(batch * result_size) };
        result
    }
}

/// The result's values for some channels and some rows of the grid.
struct StripJob<'a> {
    plan: &'a Plan<'a>,
    image: &'a [f32],
    bias: Option<&'a [f32]>,
    rows: Range<usize>,
    channels: Range<usize>,
    result: SharedOutput,
    scratch: &'a mut Scratch,
}

impl tile::Job for StripJob<'_> {
    #[inline(always)]
    unsafe fn run<V: Vector>(self) {
        let Self { plan, image, bias, rows, channels, result, scratch } = self;
        let source = &plan.source;
        let width = MOST_VECTORS * V::LANES;
        source.fill(image, 0..source.channels, rows.clone(), width, &mut scratch.strip);
        let sums_size = (channels.len() + MOST_ROWS) * width;
        if scratch.sums.len() < sums_size {
            scratch.sums.resize(sums_size, 0.0);
        }

        // Positions are numbered along the padded rows, so that tiles run on over the rows' ends; only where rows are
        // a whole number of vectors does each start its own tile, because then nothing is wasted.
        let (pitch, columns) = (source.pitch(), source.grid[1]);
        let all = (rows.len() - 1) * pitch + columns;
        let by_row = rows.len() * columns.div_ceil(V::LANES) <= all.div_ceil(V::LANES);
        let (segments, length) = if by_row { (rows.len(), columns) } else { (1, all) };
        for phase in &plan.phases {
            for segment in 0..segments {
                let mut at = 0;
                while at < length {
                    let vectors = (length - at).div_ceil(V::LANES).min(MOST_VECTORS);
                    let positions = segment * pitch + at..segment * pitch + length.min(at + vectors * V::LANES);
                    // SAFETY: the processor has V; the strip was filled for these rows with a tile of slack, the sums
                    // have a row per channel and MOST_ROWS more, and weights are [channels, summands].
                    unsafe { plan.sum_tile::<V>(phase, channels.clone(), positions.start, vectors, scratch) };
                    plan.pieces(phase, rows.start, positions, &mut scratch.pieces);
                    // SAFETY: the pieces lie inside the result's channels, and no other job has these rows and channels.
                    unsafe { plan.write_tile(&channels, bias, scratch, width, result) };
                    at += vectors * V::LANES;
                }
            }
        }
    }
}

impl Plan<'_> {
    /// All channels' sums over the tile that starts at `position`, in blocks of summands that stay in the first-level
    /// cache.
    ///
    /// # Safety
    /// The processor has `V`'s instruction set, `scratch.strip` is filled for the tile and `scratch.sums` has room
    /// for `channels` rounded up to whole products.
    #[inline(always)]
    unsafe fn sum_tile<V: Vector>(
        &self,
        phase: &Phase<'_>,
        channels: Range<usize>,
        position: usize,
        vectors: usize,
        scratch: &mut Scratch,
    ) {
        let summands = phase.offsets.len();
        let taps = (summands / self.source.channels).max(1);
        let block = (BLOCK_VALUES / (MOST_VECTORS * V::LANES * self.source.kernel[0])).max(1) * taps;
        let width = MOST_VECTORS * V::LANES;
        let mut first = 0;
        loop {
            let last = (first + block).min(summands);
            let mut channel = channels.start;
            while channel < channels.end {
                let height = tile::rows_of_next::<V>(channels.end - channel);
                // SAFETY: `channel` is clamped to the weights' rows, `first` to their length; positions by the caller.
                unsafe {
                    let row = |m: usize| (channel + m).min(channels.end - 1) * summands + first;
                    let weights = phase.weights.as_ptr();
                    let mut rows = [weights; MOST_ROWS];
                    for (m, start) in rows.iter_mut().enumerate() {
                        *start = weights.add(row(m));
                    }
                    let product = Product {
                        rows,
                        row_step: 0,
                        columns: scratch.strip.as_ptr().add(position),
                        column_step: 0,
                        offsets: phase.offsets.get_unchecked(first..last),
                        repetitions: 1,
                        out: scratch.sums.as_mut_ptr().add((channel - channels.start) * width),
                        out_stride: width,
                        accumulate: first > 0,
                    };
                    tile::multiply::<V>(height, vectors, &product);
                }
                channel += height;
            }
            first = last;
            if first == summands {
                break;
            }
        }
    }

    /// Where the tile's `positions` go in a channel of the result; positions in the padding go nowhere.
    fn pieces(&self, phase: &Phase<'_>, first_row: usize, positions: Range<usize>, pieces: &mut Vec<Piece>) {
        pieces.clear();
        let step = self.step as isize;
        let [height, width] = self.size.map(|size| size as isize);
        // Grid columns whose place in the result is inside it.
        let begin = (step - 1 - phase.origin[1]).div_euclid(step).max(0);
        let end = ((width - 1 - phase.origin[1]).div_euclid(step) + 1).min(self.source.grid[1] as isize);
        let mut at = positions.start;
        while at < positions.end {
            let (row, column) = (at / self.source.pitch(), at % self.source.pitch());
            let next = positions.end.min((row + 1) * self.source.pitch());
            let to_row = step * (first_row + row) as isize + phase.origin[0];
            let from = (column as isize).max(begin);
            let until = ((column + next - at) as isize).min(end);
            if (0..height).contains(&to_row) && from < until {
                pieces.push(Piece {
                    from: (at - positions.start) + (from as usize - column),
                    to: (to_row * width + step * from + phase.origin[1]) as usize,
                    count: (until - from) as usize,
                });
            }
            at = next;
        }
    }

    /// Copies the tile's sums to their places, adding the bias.
    ///
    /// # Safety
    /// `result` is writable for all channels, nobody else writes these pieces, and the sums are those of `channels`.
    #[inline(always)]
    unsafe fn write_tile(
        &self,
        channels: &Range<usize>,
        bias: Option<&[f32]>,
        scratch: &Scratch,
        width: usize,
        result: SharedOutput,
    ) {
        let channel_size = self.size[0] * self.size[1];
        for channel in channels.clone() {
            let bias = bias.map_or(0.0, |bias| bias[channel]);
            for piece in &scratch.pieces {
                // SAFETY: `pieces` keeps every piece inside the tile and inside the result's channel.
                unsafe {
                    let from = scratch.sums.as_ptr().add((channel - channels.start) * width + piece.from);
                    let to = result.0.add(channel * channel_size + piece.to);
                    if self.step == 1 {
                        for i in 0..piece.count {
                            *to.add(i) = *from.add(i) + bias;
                        }
                    } else {
                        for i in 0..piece.count {
                            *to.add(i * self.step) = *from.add(i) + bias;
                        }
                    }
                }
            }
        }
    }
}
