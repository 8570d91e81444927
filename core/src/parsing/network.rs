//! The network: a U-Net over pixels packed 2×2 into channels, so that its widest maps are 64×64, with a global branch
//! at its bottom that tells the head's pose and tells all pixels what it has seen of the whole.

use candle_core::Tensor;
use image::RgbImage;

use super::SIDE;
use crate::{
    data::picture,
    error::{Error, Result},
    kernels::activation::silu,
    model::layers::{Convolution, Resampling, linear},
    parameters::{Init, Parameters},
    region::REGION_COUNT,
};

/// Width and height of the widest maps.
pub(super) const GRID: usize = SIDE / 2;
/// Pixels packed into one place of the grid.
pub(super) const PACKED: usize = 4;
/// Channels of the packed picture.
pub(super) const INPUTS: usize = 3 * PACKED;
/// Numbers read of the whole picture, see [`super::Numbers`].
pub(super) const NUMBERS: usize = 9;
/// Channels at 64², 32², 16² and 8².
const CHANNELS: [usize; 4] = [24, 40, 64, 80];
/// Channels of the map that the global branch reads, and its width.
const GLOBAL: [usize; 2] = [16, 64];

/// What the network says of a batch of B pictures.
pub(super) struct Output {
    /// Logits `[B, 9 · 4, 64, 64]`: for each region, those of the four pixels packed there.
    pub logits: Tensor,
    /// `[B, 9]`, see [`super::Numbers`].
    pub numbers: Tensor,
}

/// See the [module](self).
#[derive(Clone, Debug)]
pub(super) struct Network {
    stem: Convolution,
    top: Block,
    downs: Vec<Down>,
    global: Global,
    bottom: Block,
    ups: Vec<Up>,
    head: Convolution,
}

/// Half the size, then blocks.
#[derive(Clone, Debug)]
struct Down {
    widen: Convolution,
    blocks: Vec<Block>,
}

/// Twice the size, the map of the way down added, then a block.
#[derive(Clone, Debug)]
struct Up {
    narrow: Convolution,
    block: Block,
}

/// x + conv(silu(conv(silu(x)))).
#[derive(Clone, Debug)]
struct Block {
    first: Convolution,
    second: Convolution,
}

/// From the coarsest map to numbers, and back to a shift of all its channels.
#[derive(Clone, Debug)]
struct Global {
    squeeze: Convolution,
    hidden: Linear,
    numbers: Linear,
    shift: Linear,
}

#[derive(Clone, Debug)]
struct Linear {
    weight: Tensor,
    bias: Tensor,
}

impl Network {
    pub fn new(parameters: &Parameters) -> Result<Self> {
        let [finest, .., coarsest] = CHANNELS;
        let steps: Vec<[usize; 2]> = CHANNELS.windows(2).map(|pair| [pair[0], pair[1]]).collect();
        let down = |(index, &[before, after]): (usize, &[usize; 2])| {
            let parameters = parameters.within(format_args!("down.{index}"));
            // The coarsest level has its second block after the global branch.
            let count = if after == coarsest { 1 } else { index + 1 };
            let block = |block| Block::new(after, &parameters.within(format_args!("block.{block}")));
            let widen = Convolution::new(before, after, 3, 1.0, &parameters.within("widen"))?;
            Ok(Down { widen, blocks: (0..count).map(block).collect::<Result<_>>()? })
        };
        let up = |(index, &[after, before]): (usize, &[usize; 2])| {
            let parameters = parameters.within(format_args!("up.{index}"));
            let narrow = Convolution::new(before, after, 1, 1.0, &parameters.within("narrow"))?;
            Ok(Up { narrow, block: Block::new(after, &parameters.within("block"))? })
        };
        Ok(Self {
            stem: Convolution::new(INPUTS, finest, 3, 1.0, &parameters.within("stem"))?,
            top: Block::new(finest, &parameters.within("top"))?,
            downs: steps.iter().enumerate().map(down).collect::<Result<_>>()?,
            global: Global::new(coarsest, &parameters.within("global"))?,
            bottom: Block::new(coarsest, &parameters.within("bottom"))?,
            ups: steps.iter().enumerate().rev().map(up).collect::<Result<_>>()?,
            head: Convolution::new(finest, REGION_COUNT * PACKED, 1, 1.0, &parameters.within("head"))?,
        })
    }

    /// The maps of the way down, `[B, C, 64, 64]` to `[B, C, 8, 8]`, of packed pictures `[B, 12, 64, 64]`.
    pub fn maps(&self, input: &Tensor) -> Result<Vec<Tensor>> {
        let mut maps = vec![self.top.forward(&self.stem.forward(input)?)?];
        for Down { widen, blocks } in &self.downs {
            let Some(fine) = maps.last() else { break };
            let coarse = widen.forward(&Resampling::AverageDown.apply(fine)?)?;
            maps.push(blocks.iter().try_fold(coarse, |hidden, block| block.forward(&hidden))?);
        }
        Ok(maps)
    }

    /// Reads packed pictures `[B, 12, 64, 64]`, see [`packed`].
    pub fn forward(&self, input: &Tensor) -> Result<Output> {
        let mut skips = self.maps(input)?;
        let Some(mut hidden) = skips.pop() else { return Err(Error::shape("parser maps", "4", &[0])) };
        let (numbers, shift) = self.global.forward(&hidden)?;
        hidden = self.bottom.forward(&hidden.broadcast_add(&shift)?)?;
        for (Up { narrow, block }, skip) in self.ups.iter().zip(skips.into_iter().rev()) {
            // 1×1 and bilinear commute: narrowing first is cheaper.
            hidden = block.forward(&(Resampling::BilinearUp.apply(&narrow.forward(&hidden)?)? + skip)?)?;
        }
        Ok(Output { logits: self.head.forward(&silu(&hidden)?)?, numbers })
    }
}

impl Block {
    fn new(channels: usize, parameters: &Parameters) -> Result<Self> {
        Ok(Self {
            first: Convolution::new(channels, channels, 3, 1.0, &parameters.within("first"))?,
            // Blocks start close to the identity.
            second: Convolution::new(channels, channels, 3, 0.3, &parameters.within("second"))?,
        })
    }

    fn forward(&self, input: &Tensor) -> Result<Tensor> {
        let hidden = self.first.forward(&silu(input)?)?;
        Ok((input + self.second.forward(&silu(&hidden)?)?)?)
    }
}

impl Global {
    fn new(channels: usize, parameters: &Parameters) -> Result<Self> {
        let [squeezed, width] = GLOBAL;
        let coarsest = GRID >> (CHANNELS.len() - 1);
        Ok(Self {
            squeeze: Convolution::new(channels, squeezed, 1, 1.0, &parameters.within("squeeze"))?,
            hidden: Linear::new(squeezed * coarsest * coarsest, width, &parameters.within("hidden"))?,
            numbers: Linear::new(width, NUMBERS, &parameters.within("numbers"))?,
            shift: Linear::new(width, channels, &parameters.within("shift"))?,
        })
    }

    /// The numbers `[B, 9]` and the shift `[B, C, 1, 1]` of a map `[B, C, 8, 8]`.
    fn forward(&self, map: &Tensor) -> Result<(Tensor, Tensor)> {
        let (batch, channels, _, _) = map.dims4()?;
        let squeezed = silu(&self.squeeze.forward(&silu(map)?)?)?;
        let hidden = silu(&self.hidden.forward(&squeezed.reshape((batch, ()))?)?)?;
        Ok((self.numbers.forward(&hidden)?, self.shift.forward(&hidden)?.reshape((batch, channels, 1, 1))?))
    }
}

impl Linear {
    fn new(inputs: usize, outputs: usize, parameters: &Parameters) -> Result<Self> {
        let bound = 1.0 / (inputs as f64).sqrt();
        Ok(Self {
            weight: parameters.get("weight", &[outputs, inputs], Init::Uniform(bound))?,
            bias: parameters.get("bias", &[outputs], Init::Constant(0.0))?,
        })
    }

    fn forward(&self, input: &Tensor) -> Result<Tensor> {
        Ok(linear(input, &self.weight)?.broadcast_add(&self.bias)?)
    }
}

/// The pixels of a picture of [`SIDE`]² as `[12, 64, 64]` in [-1, 1]: channel 4 c + 2 (y mod 2) + x mod 2.
pub(super) fn packed(picture: &RgbImage) -> Vec<f32> {
    let mut values = vec![0.0; INPUTS * GRID * GRID];
    for (x, y, pixel) in picture.enumerate_pixels() {
        for (channel, &value) in pixel.0.iter().enumerate() {
            if let Some(place) = values.get_mut(place(channel, x as usize, y as usize)) {
                *place = picture::signed(value);
            }
        }
    }
    values
}

/// Pictures `[B, 3, 128, 128]` as the network reads them, `[B, 12, 64, 64]`; see [`packed`]. Differentiable.
pub(super) fn packed_tensor(pictures: &Tensor) -> Result<Tensor> {
    let batch = pictures.dim(0)?;
    let cells = pictures.reshape(&[batch, 3, GRID, 2, GRID, 2][..])?.permute(&[0, 1, 3, 5, 2, 4][..])?;
    Ok(cells.contiguous()?.reshape((batch, INPUTS, GRID, GRID))?)
}

/// Where a pixel of a plane lies among packed planes.
pub(super) fn place(plane: usize, x: usize, y: usize) -> usize {
    ((plane * PACKED + 2 * (y % 2) + x % 2) * GRID + y / 2) * GRID + x / 2
}

/// Each region's share of every pixel, `[9, 128, 128]`, of one picture's logits `[36, 64, 64]`.
pub(super) fn shares(logits: &[f32]) -> Vec<f32> {
    let mut shares = vec![0.0; REGION_COUNT * SIDE * SIDE];
    for y in 0..SIDE {
        for x in 0..SIDE {
            let softmax = softmax(|region| logits.get(place(region, x, y)).copied().unwrap_or_default());
            for (region, share) in softmax.into_iter().enumerate() {
                shares[(region * SIDE + y) * SIDE + x] = share;
            }
        }
    }
    shares
}

/// The regions' shares of one pixel by their logits.
pub(super) fn softmax(logit: impl Fn(usize) -> f32) -> [f32; REGION_COUNT] {
    let logits: [f32; REGION_COUNT] = std::array::from_fn(logit);
    let largest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let powers = logits.map(|logit| (logit - largest).exp());
    let sum: f32 = powers.iter().sum();
    powers.map(|power| power / sum)
}
