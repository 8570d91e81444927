//! Convolution and transposed convolution without an intermediate matrix: strips of padded rows, tiles of up to 48
//! positions, all output channels over each tile.
//!
//! A transposed convolution of stride s is s² ordinary ones of stride 1, each with every s-th tap of the kernel
//! (in both axes) and writing every s-th row and column; so both are a [`Plan`] of one or more [`Phase`]s.

use std::borrow::Cow;
use std::cell::RefCell;
use std::mem::MaybeUninit;
use std::ops::Range;

use rayon::prelude::*;

use super::InstructionSet;
use super::geometry::{Geometry, PaddedSource};
use super::tile::{self, MOST_ROWS, Product, Registers};

/// Values of one strip: about half of a second-level cache of 1 MB, the rest is for weights and sums.
const STRIP_VALUES: usize = 128_000;
/// Values of the strip that one block of summands may touch per tile.
const BLOCK_VALUES: usize = 6_000;
/// Tiles that are summed together, so that weights are fetched from afar once for all of them.
const TILES: usize = 4;

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
            let selected: Vec<usize> = taps(0, row_phase)
                .flat_map(|(_, ky)| taps(1, column_phase).map(move |(_, kx)| ky * kernel[1] + kx))
                .collect();
            let weights = Cow::Owned(transposed_weights(geometry, weight, &selected));
            let origin = [row_phase, column_phase].map(|phase| (stride * first + phase) as isize - padding as isize);
            phases.push(Phase { weights, offsets, origin });
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

/// The `selected` taps of a weight `[O, C, taps]` as `[C, O, selected]`.
fn transposed_weights(geometry: &Geometry, weight: &[f32], selected: &[usize]) -> Vec<f32> {
    let (inputs, outputs) = (geometry.input_channels, geometry.output_channels);
    let row = outputs * selected.len();
    let mut transposed = Vec::<f32>::with_capacity(inputs * row);
    // A few input channels at a time: neighbours share the cache lines that are read.
    const TOGETHER: usize = 16;
    let chunks = transposed.spare_capacity_mut()[..inputs * row].par_chunks_mut((TOGETHER * row).max(1));
    chunks.enumerate().for_each(|(chunk, rows)| {
        for o in 0..outputs {
            let from = &weight[(o * inputs + chunk * TOGETHER) * geometry.taps()..];
            for (to, from) in rows.chunks_exact_mut(row).zip(from.chunks_exact(geometry.taps())) {
                let to = &mut to[o * selected.len()..][..selected.len()];
                match (to.first_chunk_mut::<9>(), from.first_chunk::<9>()) {
                    // All of a 3 × 3 kernel, by far the commonest, in two or three moves.
                    (Some(to), Some(from)) if selected.len() == 9 && geometry.taps() == 9 => {
                        *to = from.map(MaybeUninit::new);
                    }
                    _ => to.iter_mut().zip(selected).for_each(|(to, &tap)| _ = to.write(from[tap])),
                }
            }
        }
    });
    // SAFETY: every row has a run for every output channel, and each was written in full.
    unsafe { transposed.set_len(inputs * row) };
    transposed
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

/// Neighbouring positions of the padded grid, summed for all channels.
#[derive(Clone)]
struct Tile {
    /// First position.
    start: usize,
    /// Number of vectors.
    vectors: usize,
    /// Where the sums of the first channel go: into the result if that is as contiguous as the tile, else aside.
    out: *mut f32,
    /// Distance from one channel's sums to the next.
    out_stride: usize,
    /// What is to be copied into the result afterwards.
    pieces: Range<usize>,
}

/// Neighbouring positions of a tile that lie beside each other in the result.
#[derive(Clone, Copy, Default, PartialEq, Eq)]
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
    unsafe fn run<V: Registers>(self) {
        let Self { plan, image, bias, rows, channels, result, scratch: Scratch { strip, sums, pieces } } = self;
        let source = &plan.source;
        let width = V::VECTORS * V::COUNT;
        let strip = if source.is_in_place() {
            image[rows.start * source.pitch()..].as_ptr()
        } else {
            source.fill(image, 0..source.channels, rows.clone(), width, strip);
            strip.as_ptr()
        };
        let tile_sums = channels.len() * width;
        if sums.len() < TILES * tile_sums {
            sums.resize(TILES * tile_sums, 0.0);
        }
        let sums = sums.as_mut_ptr();
        let channel_size = plan.size[0] * plan.size[1];
        // SAFETY: `channels` starts inside the result.
        let result = unsafe { result.0.add(channels.start * channel_size) };

        // Positions are numbered along the padded rows, so that tiles run on over the rows' ends; only where rows are
        // a whole number of vectors does each start its own tile, because then nothing is wasted.
        let (pitch, columns) = (source.pitch(), source.grid[1]);
        let all = (rows.len() - 1) * pitch + columns;
        let by_row = pitch > columns && rows.len() * columns.div_ceil(V::COUNT) <= all.div_ceil(V::COUNT);
        let (segments, length) = if by_row { (rows.len(), columns) } else { (1, all) };
        // Tiles as equal as can be: four vectors are two and two, because a single one leaves the processor waiting.
        let vectors = length.div_ceil(V::COUNT);
        let per_segment = vectors.div_ceil(V::VECTORS);

        for phase in &plan.phases {
            let mut tile = 0;
            while tile < segments * per_segment {
                let count = TILES.min(segments * per_segment - tile);
                let mut tiles =
                    [const { Tile { start: 0, vectors: 0, out: std::ptr::null_mut(), out_stride: 0, pieces: 0..0 } };
                        TILES];
                pieces.clear();
                for (index, to) in tiles[..count].iter_mut().enumerate() {
                    let (segment, part) = ((tile + index) / per_segment, (tile + index) % per_segment);
                    let first = segment * pitch;
                    let end = length.min((part + 1) * vectors / per_segment * V::COUNT);
                    let positions = first + part * vectors / per_segment * V::COUNT..first + end;
                    to.start = positions.start;
                    to.vectors = positions.len().div_ceil(V::COUNT);
                    let first = pieces.len();
                    plan.add_pieces(phase, rows.start, positions, pieces);
                    let whole = Piece {
                        from: 0,
                        count: to.vectors * V::COUNT,
                        ..pieces.get(first).copied().unwrap_or_default()
                    };
                    if plan.step == 1 && pieces[first..] == [whole] {
                        // SAFETY: a piece is inside the result's channel.
                        to.out = unsafe { result.add(whole.to) };
                        to.out_stride = channel_size;
                        pieces.truncate(first);
                    } else {
                        // SAFETY: `sums` has room for TILES tiles.
                        to.out = unsafe { sums.add(index * tile_sums) };
                        to.out_stride = width;
                    }
                    to.pieces = first..pieces.len();
                }
                // SAFETY: the processor has V. The strip was filled for these rows with a tile of slack, or is an image of
                // whole vectors. Every tile's sums have a place for all channels, in `sums` or in the result, where no
                // other job writes these rows and channels.
                unsafe { plan.sum::<V>(phase, strip, &channels, bias, &tiles[..count]) };
                for tile in &tiles[..count] {
                    // SAFETY: the tile's sums were just written, and its pieces are inside the result's channels.
                    unsafe { plan.copy(tile, &pieces[tile.pieces.clone()], channels.len(), result) };
                }
                tile += count;
            }
        }
    }
}

impl Plan<'_> {
    /// The sums of `tiles` for all channels, in blocks of summands, so that a block's weights are fetched once for all
    /// tiles and its part of the strip stays in the first-level cache.
    ///
    /// # Safety
    /// The processor has `V`'s instruction set, the strip can be read at all tiles, and each tile's `out` can be written
    /// for all channels.
    #[inline(always)]
    unsafe fn sum<V: Registers>(
        &self,
        phase: &Phase<'_>,
        strip: *const f32,
        channels: &Range<usize>,
        bias: Option<&[f32]>,
        tiles: &[Tile],
    ) {
        let summands = phase.offsets.len();
        let taps = (summands / self.source.channels).max(1);
        let tile_values = V::VECTORS * V::COUNT * self.source.kernel[0];
        let block = (BLOCK_VALUES / tile_values).max(1) * taps;
        let mut first = 0;
        loop {
            let last = (first + block).min(summands);
            let mut channel = channels.start;
            while channel < channels.end {
                let height = tile::rows_of_next::<V>(channels.end - channel);
                let stored = height.min(channels.end - channel);
                // SAFETY: `channel + m` is clamped to the weights' rows and `first..last` to their length; the bias has
                // a value per channel; tiles by the caller.
                unsafe {
                    let mut rows = [phase.weights.as_ptr(); MOST_ROWS];
                    let mut initial = [0.0; MOST_ROWS];
                    for m in 0..MOST_ROWS {
                        let channel = channel + m.min(stored - 1);
                        rows[m] = rows[m].add(channel * summands + first);
                        if let Some(bias) = bias {
                            initial[m] = *bias.get_unchecked(channel);
                        }
                    }
                    for tile in tiles {
                        let product = Product {
                            rows,
                            row_step: 0,
                            columns: strip.add(tile.start),
                            column_step: 0,
                            offsets: phase.offsets.get_unchecked(first..last),
                            repetitions: 1,
                            out: tile.out.add((channel - channels.start) * tile.out_stride),
                            out_stride: tile.out_stride,
                            stored,
                            initial: (first == 0).then_some(initial),
                        };
                        tile::multiply::<V>(height, tile.vectors, &product);
                    }
                }
                channel += height;
            }
            first = last;
            if first == summands {
                break;
            }
        }
    }

    /// Where the values at `positions` go in a channel of the result; those in the padding go nowhere.
    fn add_pieces(&self, phase: &Phase<'_>, first_row: usize, positions: Range<usize>, pieces: &mut Vec<Piece>) {
        let step = self.step as isize;
        let [height, width] = self.size.map(|size| size as isize);
        // Grid columns whose place in the result is inside it.
        let begin = (step - 1 - phase.origin[1]).div_euclid(step).max(0);
        let end = ((width - 1 - phase.origin[1]).div_euclid(step) + 1).min(self.source.grid[1] as isize);
        let others = pieces.len();
        let mut at = positions.start;
        while at < positions.end {
            let (row, column) = (at / self.source.pitch(), at % self.source.pitch());
            let next = positions.end.min((row + 1) * self.source.pitch());
            let to_row = step * (first_row + row) as isize + phase.origin[0];
            let from = (column as isize).max(begin);
            let until = ((column + next - at) as isize).min(end);
            if (0..height).contains(&to_row) && from < until {
                let piece = Piece {
                    from: (at - positions.start) + (from as usize - column),
                    to: (to_row * width + step * from + phase.origin[1]) as usize,
                    count: (until - from) as usize,
                };
                match pieces[others..].last_mut() {
                    Some(last) if last.is_continued_by(&piece, self.step) => last.count += piece.count,
                    _ => pieces.push(piece),
                }
            }
            at = next;
        }
    }

    /// Copies `pieces` of a tile that was summed aside to their places in `channels` channels of the result.
    ///
    /// # Safety
    /// The pieces are inside the tile, and inside the result's channels, which nobody else writes at these places.
    #[inline(always)]
    unsafe fn copy(&self, tile: &Tile, pieces: &[Piece], channels: usize, result: *mut f32) {
        let channel_size = self.size[0] * self.size[1];
        for channel in 0..channels {
            for piece in pieces {
                // SAFETY: the caller vouches for both places.
                unsafe {
                    let from = tile.out.add(channel * tile.out_stride + piece.from);
                    let to = result.add(channel * channel_size + piece.to);
                    if self.step == 1 {
                        to.copy_from_nonoverlapping(from, piece.count);
                    } else {
                        for i in 0..piece.count {
                            *to.add(i * self.step) = *from.add(i);
                        }
                    }
                }
            }
        }
    }
}

impl Piece {
    /// Whether `next` goes on where this piece ends, in the tile and in the result.
    fn is_continued_by(&self, next: &Self, step: usize) -> bool {
        next.from == self.from + self.count && next.to == self.to + self.count * step
    }
}
