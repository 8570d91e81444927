//! LPIPS: how different two pictures look, by the features of an image classifier (Zhang et al., 2018, version 0.1).
//!
//! x in [-1, 1] is shifted and scaled per channel and run through AlexNet or VGG16; five feature maps are taken after
//! ReLUs, normalised over channels to unit length, and their squared differences are weighted by learnt heads, averaged
//! over the picture and summed. The weights are not shipped: `weights/README.md` of the reference data says what the
//! file holds and how to get it.

use std::{collections::HashMap, path::Path};

use candle_core::{DType, Device, Tensor};

use crate::{
    error::{Error, Result},
    kernels::conv::conv2d,
};

/// Per-channel mean of the classifiers' training pictures, in [-1, 1].
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
/// Per-channel deviation of the classifiers' training pictures, in [-1, 1].
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];
/// Added to squared norms before the root. The original adds 1e-10 after it, where the root has no gradient at 0.
const NORM_FLOOR: f64 = 1e-12;

/// The classifier whose features are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Backbone {
    /// Small and quick; the usual choice for reporting.
    AlexNet,
    /// The usual choice for training.
    Vgg16,
}

/// One step of a backbone.
#[derive(Clone, Copy)]
enum Step {
    /// Convolution number `.0` with stride `.1` and padding `.2`, then ReLU.
    Convolve(usize, usize, usize),
    /// Max-pooling with window `.0` and stride 2.
    Pool(usize),
    /// Keep the features as they are here.
    Tap,
}

impl Backbone {
    const ALEXNET: &[Step] = &[
        Step::Convolve(0, 4, 2),
        Step::Tap,
        Step::Pool(3),
        Step::Convolve(1, 1, 2),
        Step::Tap,
        Step::Pool(3),
        Step::Convolve(2, 1, 1),
        Step::Tap,
        Step::Convolve(3, 1, 1),
        Step::Tap,
        Step::Convolve(4, 1, 1),
        Step::Tap,
    ];
    const VGG16: &[Step] = &[
        Step::Convolve(0, 1, 1),
        Step::Convolve(1, 1, 1),
        Step::Tap,
        Step::Pool(2),
        Step::Convolve(2, 1, 1),
        Step::Convolve(3, 1, 1),
        Step::Tap,
        Step::Pool(2),
        Step::Convolve(4, 1, 1),
        Step::Convolve(5, 1, 1),
        Step::Convolve(6, 1, 1),
        Step::Tap,
        Step::Pool(2),
        Step::Convolve(7, 1, 1),
        Step::Convolve(8, 1, 1),
        Step::Convolve(9, 1, 1),
        Step::Tap,
        Step::Pool(2),
        Step::Convolve(10, 1, 1),
        Step::Convolve(11, 1, 1),
        Step::Convolve(12, 1, 1),
        Step::Tap,
    ];

    fn steps(self) -> &'static [Step] {
        match self {
            Self::AlexNet => Self::ALEXNET,
            Self::Vgg16 => Self::VGG16,
        }
    }

    /// Output channels, input channels and window of every convolution.
    fn convolutions(self) -> Vec<[usize; 3]> {
        match self {
            Self::AlexNet => vec![[64, 3, 11], [192, 64, 5], [384, 192, 3], [256, 384, 3], [256, 256, 3]],
            Self::Vgg16 => {
                let channels = [3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512];
                channels.windows(2).map(|pair| [pair[1], pair[0], 3]).collect()
            }
        }
    }

    /// Channels of the five taps.
    pub const fn channels(self) -> [usize; 5] {
        match self {
            Self::AlexNet => [64, 192, 384, 256, 256],
            Self::Vgg16 => [64, 128, 256, 512, 512],
        }
    }

    /// Smallest width and height of a picture, pixels.
    pub const fn smallest_side(self) -> usize {
        match self {
            Self::AlexNet => 31,
            Self::Vgg16 => 16,
        }
    }

    /// The name in reports: `lpips-alexnet` or `lpips-vgg16`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::AlexNet => "lpips-alexnet",
            Self::Vgg16 => "lpips-vgg16",
        }
    }
}

/// A perceptual distance with its weights.
#[derive(Clone, Debug)]
pub struct Perceptual {
    backbone: Backbone,
    convolutions: Vec<(Tensor, Tensor)>,
    heads: Vec<Tensor>,
    shift: Tensor,
    scale: Tensor,
}

impl Perceptual {
    /// Reads weights from a safetensors file; the shapes tell which backbone it is.
    pub fn load(path: impl AsRef<Path>, device: &Device) -> Result<Self> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).map_err(|error| Error::io(path, error))?;
        let tensors = candle_core::safetensors::load_buffer(&bytes, device).map_err(|error| {
            Error::malformed(path, format!("not a whole safetensors file ({error}); copy it again"))
        })?;
        Self::from_tensors(&tensors).map_err(|error| {
            Error::malformed(
                path,
                format!("not LPIPS weights ({error}); give lpips_alexnet or lpips_vgg16.safetensors"),
            )
        })
    }

    fn from_tensors(tensors: &HashMap<String, Tensor>) -> Result<Self> {
        let get = |name: String, shape: &[usize]| match tensors.get(&name) {
            Some(tensor) if tensor.dims() == shape => Ok(tensor.to_dtype(DType::F32)?),
            Some(tensor) => Err(Error::shape(name, shape, tensor.dims())),
            None => Err(Error::shape(name, shape, &[])),
        };
        let first = tensors.get("conv0.weight").map(Tensor::dims);
        let backbone = if first == Some(&[64, 3, 11, 11]) { Backbone::AlexNet } else { Backbone::Vgg16 };
        let convolutions = backbone.convolutions().into_iter().enumerate().map(|(index, [output, input, window])| {
            let weight = get(format!("conv{index}.weight"), &[output, input, window, window])?;
            Ok((weight, get(format!("conv{index}.bias"), &[output])?))
        });
        let convolutions: Vec<(Tensor, Tensor)> = convolutions.collect::<Result<_>>()?;
        let heads = backbone.channels().into_iter().enumerate();
        let heads = heads.map(|(index, channels)| get(format!("lin{index}.weight"), &[1, channels, 1, 1]));
        let heads = heads.collect::<Result<_>>()?;
        let device = convolutions.first().map_or(Device::Cpu, |(weight, _)| weight.device().clone());
        let constant = |values: [f32; 3]| Tensor::new(&values, &device)?.reshape((1, 3, 1, 1));
        Ok(Self { backbone, convolutions, heads, shift: constant(SHIFT)?, scale: constant(SCALE)? })
    }

    /// An AlexNet of random weights.
    #[cfg(test)]
    pub(crate) fn of_noise(seed: u64) -> Result<Self> {
        let mut random = crate::rng::Stream::new(seed, &[]);
        let mut tensors = HashMap::new();
        for (index, [output, input, window]) in Backbone::AlexNet.convolutions().into_iter().enumerate() {
            let weight = random.normal_tensor(&[output, input, window, window], &Device::Cpu)?;
            let fan_in = (input * window * window) as f64;
            tensors.insert(format!("conv{index}.weight"), (weight * (2.0 / fan_in).sqrt())?);
            tensors.insert(format!("conv{index}.bias"), Tensor::zeros(output, DType::F32, &Device::Cpu)?);
        }
        for (index, channels) in Backbone::AlexNet.channels().into_iter().enumerate() {
            let head = Tensor::full(1.0 / channels as f32, (1, channels, 1, 1), &Device::Cpu)?;
            tensors.insert(format!("lin{index}.weight"), head);
        }
        Self::from_tensors(&tensors)
    }

    /// Which backbone this is.
    pub fn backbone(&self) -> Backbone {
        self.backbone
    }

    /// The same distance computed in another type; inputs must have it too.
    pub fn to_dtype(&self, dtype: DType) -> Result<Self> {
        let convert = |tensor: &Tensor| tensor.to_dtype(dtype);
        let convolutions = self.convolutions.iter().map(|(weight, bias)| Ok((convert(weight)?, convert(bias)?)));
        Ok(Self {
            backbone: self.backbone,
            convolutions: convolutions.collect::<Result<_>>()?,
            heads: self.heads.iter().map(convert).collect::<candle_core::Result<_>>()?,
            shift: convert(&self.shift)?,
            scale: convert(&self.scale)?,
        })
    }

    /// Five feature maps `[B, C, h, w]` after ReLUs, see [`Backbone::channels`], of pictures `[B, 3, H, W]` in
    /// [-1, 1]. Differentiable.
    pub fn features(&self, pictures: &Tensor) -> Result<Vec<Tensor>> {
        let smallest = self.backbone.smallest_side();
        match *pictures.dims() {
            [_, 3, height, width] if height >= smallest && width >= smallest => {}
            _ => {
                let expected = format!("[B, 3, H, W] of at least {smallest} pixels a side");
                return Err(Error::shape("pictures of a perceptual distance", expected, pictures.dims()));
            }
        }
        let mut features = pictures.broadcast_sub(&self.shift)?.broadcast_div(&self.scale)?;
        let mut taps = Vec::with_capacity(5);
        for &step in self.backbone.steps() {
            match step {
                Step::Convolve(index, stride, padding) => {
                    let Some((weight, bias)) = self.convolutions.get(index) else { continue };
                    features = conv2d(&features, weight, Some(bias), stride, padding)?.relu()?;
                }
                Step::Pool(window) => features = max_pool(&features, window, 2)?,
                Step::Tap => taps.push(features.clone()),
            }
        }
        Ok(taps)
    }

    /// LPIPS of each pair of pictures `[B, 3, H, W]` in [-1, 1]: `[B]`. Differentiable in both.
    pub fn distance(&self, a: &Tensor, b: &Tensor) -> Result<Tensor> {
        if a.dims() != b.dims() {
            return Err(Error::shape("pictures of a perceptual distance", a.dims(), b.dims()));
        }
        self.feature_distance(&self.features(a)?, &self.features(b)?)
    }

    /// LPIPS between features from [`Self::features`]: `[B]`. For a fixed target, take its features once.
    pub fn feature_distance(&self, a: &[Tensor], b: &[Tensor]) -> Result<Tensor> {
        let mut distance: Option<Tensor> = None;
        for ((a, b), head) in a.iter().zip(b).zip(&self.heads) {
            let difference = (unit_length(a)? - unit_length(b)?)?.sqr()?;
            let term = difference.broadcast_mul(head)?.sum(1)?.mean((1, 2))?;
            distance = Some(match distance {
                Some(sum) => (sum + term)?,
                None => term,
            });
        }
        distance.ok_or_else(|| Error::shape("features of a perceptual distance", "five maps", &[a.len(), b.len()]))
    }
}

/// Features divided by their length over channels.
pub(crate) fn unit_length(features: &Tensor) -> Result<Tensor> {
    let length = (features.sqr()?.sum_keepdim(1)? + NORM_FLOOR)?.sqrt()?;
    Ok(features.broadcast_div(&length)?)
}

/// Largest value of each `window` × `window` patch, every `stride` pixels, without padding: `[B, C, H, W]` to
/// `[B, C, ⌊(H − window) / stride⌋ + 1, …]`. Equal values share the gradient.
///
/// candle's own `max_pool2d` has a silently wrong gradient for overlapping windows; this one takes the maximum of
/// shifted copies, rows first.
pub fn max_pool(input: &Tensor, window: usize, stride: usize) -> Result<Tensor> {
    let mut output = input.clone();
    for axis in [2, 3] {
        let size = output.dim(axis)?;
        if window == 0 || stride == 0 || size < window {
            return Err(Error::shape(
                "input of a max-pooling",
                format!("{window} pixels or more a side"),
                input.dims(),
            ));
        }
        let count = (size - window) / stride + 1;
        let mut largest: Option<Tensor> = None;
        for shift in 0..window {
            let places: Vec<u32> = (0..count).map(|place| (place * stride + shift) as u32).collect();
            let shifted = output.contiguous()?.index_select(&Tensor::new(places, input.device())?, axis)?;
            largest = Some(match largest {
                Some(largest) => largest.maximum(&shifted)?,
                None => shifted,
            });
        }
        output = largest.unwrap_or(output);
    }
    Ok(output)
}

#[cfg(test)]
mod tests {
    use candle_core::Var;

    use super::*;
    use crate::rng::Stream;

    #[test]
    fn pooling_is_exact_and_so_is_its_gradient() {
        for (height, width, window) in [(7, 9, 3), (8, 6, 3), (8, 6, 2), (7, 5, 2)] {
            let mut random = Stream::new(1, &[height as u64, window as u64]);
            let input =
                random.normal_tensor(&[2, 3, height, width], &Device::Cpu).unwrap().to_dtype(DType::F64).unwrap();
            let pooled = max_pool(&input, window, 2).unwrap();
            let values: Vec<f64> = input.flatten_all().unwrap().to_vec1().unwrap();
            let (rows, columns) = ((height - window) / 2 + 1, (width - window) / 2 + 1);
            assert_eq!(pooled.dims(), [2, 3, rows, columns]);
            let expected: Vec<f64> = (0..6 * rows * columns)
                .map(|at| {
                    let (plane, row, column) = (at / (rows * columns), at / columns % rows, at % columns);
                    let patch = (0..window * window).map(|inside| {
                        let (y, x) = (2 * row + inside / window, 2 * column + inside % window);
                        values[(plane * height + y) * width + x]
                    });
                    patch.fold(f64::NEG_INFINITY, f64::max)
                })
                .collect();
            assert_eq!(pooled.flatten_all().unwrap().to_vec1::<f64>().unwrap(), expected);

            // Gradient of Σ cᵢ·pool(x)ᵢ by central differences; a step of 1e-6 changes no maximum here.
            let weights = random.normal_tensor(pooled.dims(), &Device::Cpu).unwrap().to_dtype(DType::F64).unwrap();
            let loss = |input: &Tensor| (max_pool(input, window, 2).unwrap() * &weights).unwrap().sum_all().unwrap();
            let variable = Var::from_tensor(&input).unwrap();
            let gradients = loss(&variable).backward().unwrap();
            let gradient: Vec<f64> = gradients.get(&variable).unwrap().flatten_all().unwrap().to_vec1().unwrap();
            for at in 0..values.len() {
                let moved = |step: f64| {
                    let mut moved = values.clone();
                    moved[at] += step;
                    loss(&Tensor::from_vec(moved, input.dims(), &Device::Cpu).unwrap()).to_scalar::<f64>().unwrap()
                };
                let difference = (moved(1e-6) - moved(-1e-6)) / 2e-6;
                assert!((difference - gradient[at]).abs() < 1e-7, "{window} {at}: {difference} {}", gradient[at]);
            }
        }
        let tiny = Tensor::zeros((1, 1, 2, 2), DType::F32, &Device::Cpu).unwrap();
        assert!(max_pool(&tiny, 3, 2).is_err());
    }

    #[test]
    fn dead_features_have_finite_gradients() {
        let features = Var::zeros((1, 4, 2, 2), DType::F32, &Device::Cpu).unwrap();
        let gradients = unit_length(&features).unwrap().sum_all().unwrap().backward().unwrap();
        let gradient: Vec<f32> = gradients.get(&features).unwrap().flatten_all().unwrap().to_vec1().unwrap();
        assert!(gradient.iter().all(|value| value.is_finite()));
    }

    #[test]
    fn other_files_are_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("other.safetensors");
        assert!(Perceptual::load(&path, &Device::Cpu).unwrap_err().to_string().contains("other.safetensors"));
        std::fs::write(&path, b"not safetensors").unwrap();
        let error = Perceptual::load(&path, &Device::Cpu).unwrap_err().to_string();
        assert!(error.contains("other.safetensors") && error.contains("copy it again"), "{error}");
        let weight = Tensor::zeros((64, 3, 11, 11), DType::F32, &Device::Cpu).unwrap();
        candle_core::safetensors::save(&HashMap::from([("conv0.weight", weight)]), &path).unwrap();
        let error = Perceptual::load(&path, &Device::Cpu).unwrap_err().to_string();
        assert!(error.contains("other.safetensors") && error.contains("conv0.bias"), "{error}");
    }
}
