//! Sizes of a convolution, and the zero-padded copy of its input in which every tap of the kernel is one fixed
//! offset, whatever the stride.

use std::ops::Range;

use crate::{Error, Result};

/// The sizes of a convolution `[B, C, H, W] ∗ [O, C, kh, kw] → [B, O, Ho, Wo]`, known to fit each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Geometry {
    pub batch: usize,
    pub input_channels: usize,
    pub input_height: usize,
    pub input_width: usize,
    pub output_channels: usize,
    pub output_height: usize,
    pub output_width: usize,
    pub kernel_height: usize,
    pub kernel_width: usize,
    pub stride: usize,
    pub padding: usize,
}

impl Geometry {
    /// The convolution of an input of shape `input` by a weight of shape `weight`.
    pub fn new(input: &[usize], weight: &[usize], stride: usize, padding: usize) -> Result<Self> {
        let &[batch, input_channels, input_height, input_width] = input else {
            return Err(Error::shape("convolution input", "[batch, channels, height, width]", input));
        };
        let &[output_channels, weight_channels, kernel_height, kernel_width] = weight else {
            return Err(Error::shape("convolution weight", "[output channels, input channels, height, width]", weight));
        };
        if weight_channels != input_channels {
            let expected = [output_channels, input_channels, kernel_height, kernel_width];
            return Err(Error::shape("convolution weight", expected, weight));
        }
        if stride == 0 || kernel_height == 0 || kernel_width == 0 {
            return Err(Error::config("convolution", "stride and kernel size must be at least 1"));
        }
        let (Some(rows), Some(columns)) = (
            (input_height + 2 * padding).checked_sub(kernel_height),
            (input_width + 2 * padding).checked_sub(kernel_width),
        ) else {
            let expected = format!("at least {kernel_height} × {kernel_width} with {padding} of padding");
            return Err(Error::Shape { name: "convolution input".into(), expected, found: input.to_vec() });
        };
        let (output_height, output_width) = (rows / stride + 1, columns / stride + 1);
        Ok(Self {
            batch,
            input_channels,
            input_height,
            input_width,
            output_channels,
            output_height,
            output_width,
            kernel_height,
            kernel_width,
            stride,
            padding,
        })
    }

    /// `[B, C, H, W]`.
    pub fn input_shape(&self) -> [usize; 4] {
        [self.batch, self.input_channels, self.input_height, self.input_width]
    }

    /// `[O, C, kh, kw]`.
    pub fn weight_shape(&self) -> [usize; 4] {
        [self.output_channels, self.input_channels, self.kernel_height, self.kernel_width]
    }

    /// `[B, O, Ho, Wo]`.
    pub fn output_shape(&self) -> [usize; 4] {
        [self.batch, self.output_channels, self.output_height, self.output_width]
    }

    /// Values of one input image, all channels.
    pub fn input_size(&self) -> usize {
        self.input_channels * self.input_height * self.input_width
    }

    /// Values of one output image, all channels.
    pub fn output_size(&self) -> usize {
        self.output_channels * self.output_height * self.output_width
    }

    /// Taps of the kernel per pair of channels.
    pub fn taps(&self) -> usize {
        self.kernel_height * self.kernel_width
    }

    /// Rows and columns at the far end of the padded input that the convolution's last step does not reach.
    pub fn left_over(&self) -> [usize; 2] {
        [(self.input_height, self.kernel_height), (self.input_width, self.kernel_width)]
            .map(|(size, kernel)| (size + 2 * self.padding - kernel) % self.stride)
    }

    /// Whether any tensor of the convolution has no values at all.
    pub fn is_empty(&self) -> bool {
        self.input_size() * self.output_size() * self.batch == 0
    }
}

/// An image padded with zeros and split by the parity of rows and columns (in general: modulo the stride), so that
/// output position (y, x) and tap (ky, kx) meet at `offset(ky, kx) + y·pitch + x`: with unit steps along x, which
/// vectors need, for every stride.
///
/// Only a strip of rows is laid out at a time; it should stay in the second-level cache.
#[derive(Clone, Copy, Debug)]
pub(super) struct PaddedSource {
    /// Channels of the image.
    pub channels: usize,
    /// Rows and columns of the image.
    pub size: [usize; 2],
    /// Step of the output grid over the image.
    pub stride: usize,
    /// Zeros above and to the left of the image; negative where the grid starts inside it.
    pub lead: [isize; 2],
    /// Rows and columns of the kernel.
    pub kernel: [usize; 2],
    /// Rows and columns of the output grid.
    pub grid: [usize; 2],
    /// Rows of the output grid that one strip serves.
    pub strip: usize,
}

impl PaddedSource {
    /// Whether the image can be read where it is: a 1 × 1 kernel moves nothing, and rows of whole vectors let no vector
    /// reach beyond the image.
    pub fn is_in_place(&self) -> bool {
        self.kernel == [1, 1]
            && self.stride == 1
            && self.lead == [0, 0]
            && self.grid == self.size
            && self.grid[1].is_multiple_of(16)
    }

    /// Distance of two rows of a plane.
    pub fn pitch(&self) -> usize {
        self.grid[1] + self.halo(1)
    }

    /// Size of one channel in the strip: all its planes.
    pub fn channel_size(&self) -> usize {
        self.phases(0) * self.phases(1) * self.plane_size()
    }

    /// Where tap (ky, kx) of channel 0 finds the value for position (0, 0) of the strip.
    pub fn offset(&self, ky: usize, kx: usize) -> usize {
        let plane = (ky % self.stride) * self.phases(1) + kx % self.stride;
        plane * self.plane_size() + (ky / self.stride) * self.pitch() + kx / self.stride
    }

    /// Sets the strip so that it holds about `budget` values (at least one row of the grid, at most all), in strips
    /// of nearly equal height.
    pub fn with_strips_of(mut self, budget: usize) -> Self {
        let row = self.channels * self.phases(0) * self.phases(1) * self.pitch();
        let most = (budget / row.max(1)).saturating_sub(self.halo(0)).clamp(1, self.grid[0]);
        self.strip = self.grid[0].div_ceil(self.grid[0].div_ceil(most));
        self
    }

    /// Number of strips.
    pub fn strips(&self) -> usize {
        self.grid[0].div_ceil(self.strip)
    }

    /// Rows of the output grid in strip number `index`.
    pub fn rows_of_strip(&self, index: usize) -> Range<usize> {
        index * self.strip..((index + 1) * self.strip).min(self.grid[0])
    }

    /// Lays out `channels` of `image` (one image, all channels) for `rows` of the output grid. `strip` grows to what
    /// is needed and to `slack` readable values more; what lies outside the tapped positions is unspecified.
    pub fn fill(&self, image: &[f32], channels: Range<usize>, rows: Range<usize>, slack: usize, strip: &mut Vec<f32>) {
        let needed = channels.len() * self.channel_size() + self.halo(1) + slack;
        if strip.len() < needed {
            strip.resize(needed, 0.0);
        }
        let [height, width] = self.size;
        let pitch = self.pitch();
        let mut planes = strip.chunks_exact_mut(self.plane_size());
        for channel in channels {
            let channel = &image[channel * height * width..][..height * width];
            for row_phase in 0..self.phases(0) {
                for column_phase in 0..self.phases(1) {
                    let Some(plane) = planes.next() else { return };
                    let used = rows.len() + self.halo(0);
                    for (row, to) in plane.chunks_exact_mut(pitch).take(used).enumerate() {
                        let from = (self.stride * (rows.start + row) + row_phase) as isize - self.lead[0];
                        if from < 0 || from >= height as isize {
                            to.fill(0.0);
                        } else {
                            let from = &channel[from as usize * width..][..width];
                            self.fill_row(from, column_phase as isize - self.lead[1], to);
                        }
                    }
                }
            }
        }
    }

    /// `to[j] = from[stride·j + first]`, zero outside `from`.
    fn fill_row(&self, from: &[f32], first: isize, to: &mut [f32]) {
        let stride = self.stride as isize;
        let inside = |column: isize| column.clamp(0, to.len() as isize) as usize;
        let begin = inside((stride - 1 - first).div_euclid(stride));
        let end = inside((from.len() as isize - 1 - first).div_euclid(stride) + 1).max(begin);
        to[..begin].fill(0.0);
        to[end..].fill(0.0);
        if begin < end {
            let from = &from[(stride * begin as isize + first) as usize..];
            if stride == 1 {
                to[begin..end].copy_from_slice(&from[..end - begin]);
            } else if stride == 2 {
                // Spelt out so that compilers make shuffles of it; the last value may have no neighbour.
                for (to, from) in to[begin..end].iter_mut().zip(from.chunks_exact(2)) {
                    *to = from[0];
                }
                to[end - 1] = from[2 * (end - 1 - begin)];
            } else {
                for (to, from) in to[begin..end].iter_mut().zip(from.iter().step_by(self.stride)) {
                    *to = *from;
                }
            }
        }
    }

    /// Rows (axis 0) or columns (axis 1) that a plane has beyond the grid.
    fn halo(&self, axis: usize) -> usize {
        (self.kernel[axis] - 1) / self.stride
    }

    /// Number of planes along an axis.
    fn phases(&self, axis: usize) -> usize {
        self.stride.min(self.kernel[axis])
    }

    fn plane_size(&self) -> usize {
        if self.is_in_place() {
            return self.size[0] * self.size[1];
        }
        (self.strip + self.halo(0)) * self.pitch()
    }
}
