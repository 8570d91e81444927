//! Who is in a portrait: a small network that reads an aligned picture of 128×128 pixels and tells the region of every
//! pixel, where the head points, and where eyes and mouth are.
//!
//! A U-Net of some 600,000 weights with a global branch at its bottom ([`network`]), taught by
//! photos with region masks and by cartoons ([`training`]), both distorted so that neither framing nor lighting can be
//! relied on ([`augment`]).

mod augment;
mod network;
mod training;

use std::path::Path;

use candle_core::{DType, Device, Tensor};
use image::{RgbImage, imageops};
use serde::{Deserialize, Serialize};

use self::network::{Network, Output};
pub use self::training::{ParserStep, ParserTrainer, ParserTraining};
use crate::{
    camera::Camera,
    data::{labels::LabelMap, picture},
    error::{Error, Result},
    eval::perceptual::unit_length,
    model::{
        file::{self, Tensors},
        layers::Resampling,
    },
    parameters::Parameters,
    region::REGION_COUNT,
};

/// Width and height of the pictures the network reads and of the maps it gives, pixels.
pub const SIDE: usize = 128;
const FILE_KEY: &str = "cnerf-parser";
const FILE_VERSION: u32 = 1;

/// What a parser's file says of itself.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ParserHeader {
    /// Always 1 today; a reader refuses what it does not know.
    pub version: u32,
    /// Where the weights come from: data, steps, seed.
    pub provenance: String,
}

/// What was read in a portrait. Points are [right, down] from the centre, in half widths of the picture.
#[derive(Clone, Debug, PartialEq)]
pub struct ParsedFace {
    /// Region of every pixel, [`SIDE`] × [`SIDE`].
    pub labels: LabelMap,
    /// Azimuth, elevation and roll of the head, as the camera that sees it so.
    pub camera: Camera,
    /// The centres of the eyes: the one further left in the picture first.
    pub eyes: [[f64; 2]; 2],
    /// The mouth's centre.
    pub mouth: [f64; 2],
}

/// The trained network.
#[derive(Clone, Debug)]
pub struct FaceParser {
    header: ParserHeader,
    network: Network,
}

impl FaceParser {
    /// The parser in a file's bytes; `name` stands for the file in messages.
    pub fn from_bytes(name: &Path, bytes: &[u8]) -> Result<Self> {
        let (tensors, metadata) = file::parse_safetensors(name, bytes)?;
        let header: ParserHeader = file::header_of(name, &metadata, FILE_KEY, "a cnerf face parser")?;
        if header.version != FILE_VERSION {
            let reason = format!("parser version {} is not known; update cnerf", header.version);
            return Err(Error::malformed(name, reason));
        }
        let parameters = Parameters::loaded(tensors.into_iter().collect(), DType::F32, &Device::Cpu).frozen();
        let network = Network::new(&parameters).map_err(|error| Error::malformed(name, error))?;
        Ok(Self { header, network })
    }

    /// What the file says of itself.
    pub fn header(&self) -> &ParserHeader {
        &self.header
    }

    /// Reads a square portrait, framed as the training portraits are. The mean of what is seen in the picture and in
    /// its mirror image: what the network prefers of one side cancels.
    pub fn parse(&self, portrait: &RgbImage) -> Result<ParsedFace> {
        let (width, height) = portrait.dimensions();
        if width != height {
            return Err(Error::shape("portrait", "square", &[height as usize, width as usize]));
        }
        let portrait = picture::resize(portrait, SIDE as u32, SIDE as u32)?;
        let both = [network::packed(&portrait), network::packed(&imageops::flip_horizontal(&portrait))].concat();
        let input = Tensor::from_vec(both, (2, network::INPUTS, network::GRID, network::GRID), &Device::Cpu)?;
        let Output { logits, numbers } = self.network.forward(&input)?;
        let logits = logits.flatten_all()?.to_vec1::<f32>()?;
        let (plain, mirrored) = logits.split_at(logits.len() / 2);
        let (mut shares, mirrored) = (network::shares(plain), network::shares(mirrored));
        for (row, mirrored) in shares.chunks_exact_mut(SIDE).zip(mirrored.chunks_exact(SIDE)) {
            row.iter_mut().zip(mirrored.iter().rev()).for_each(|(share, other)| *share += other);
        }
        let shares = Tensor::from_vec(shares, (REGION_COUNT, SIDE, SIDE), &Device::Cpu)?;
        let numbers: Vec<Vec<f32>> = numbers.to_vec2()?;
        let read = |row: usize| {
            let mut values = [0.0; network::NUMBERS];
            values.iter_mut().zip(numbers.iter().skip(row).flatten()).for_each(|(value, n)| *value = f64::from(*n));
            Numbers::from_outputs(values)
        };
        let Numbers([azimuth, elevation, roll, left_x, left_y, right_x, right_y, mouth_x, mouth_y]) =
            read(0).mean(&read(1).mirrored());
        Ok(ParsedFace {
            labels: LabelMap::from_masks(&shares)?,
            camera: Camera { roll_rad: roll, ..Camera::at(azimuth, elevation) },
            eyes: [[left_x, left_y], [right_x, right_y]],
            mouth: [mouth_x, mouth_y],
        })
    }
}

impl FaceParser {
    /// Whether [`Self::features`] can be taken of pictures of `side` x `side` pixels: [`SIDE`] or a power of two times it.
    pub fn sees(side: usize) -> bool {
        side >= SIDE && side.is_multiple_of(SIDE) && (side / SIDE).is_power_of_two()
    }

    /// What the network makes of pictures `[B, 3, R, R]` in [-1, 1] on its way down: maps from 64² to 8². Faces that look
    /// alike have features that are alike, which serves where no LPIPS weights are at hand. Differentiable.
    ///
    /// # Errors
    /// For a side that [`Self::sees`] refuses.
    pub fn features(&self, pictures: &Tensor) -> Result<Vec<Tensor>> {
        if pictures.rank() != 4 || !Self::sees(pictures.dim(3)?) {
            return Err(Error::shape("pictures", format!("[B, 3, R, R], R = {SIDE} or 2^n times it"), pictures.dims()));
        }
        let mut pictures = pictures.clone();
        while pictures.dim(3)? > SIDE {
            pictures = Resampling::AverageDown.apply(&pictures)?;
        }
        self.network.maps(&network::packed_tensor(&pictures)?)
    }

    /// Between features from [`Self::features`]: squared differences of unit vectors over channels, averaged over each
    /// map and summed over maps (LPIPS without learnt heads). `[B]`.
    ///
    /// # Errors
    /// If there are no maps, or they differ in shape.
    pub fn feature_distance(a: &[Tensor], b: &[Tensor]) -> Result<Tensor> {
        let terms = a.iter().zip(b).map(|(a, b)| {
            let difference = (unit_length(a)? - unit_length(b)?)?.sqr()?.sum(1)?.mean((1, 2))?;
            Ok(difference)
        });
        let sum = terms.reduce(|sum: Result<Tensor>, term| Ok((sum? + term?)?));
        sum.unwrap_or_else(|| Err(Error::shape("features", "one map at least", &[0])))
    }
}

/// Writes a network's weights as f16 with a header.
fn write(path: &Path, parameters: &Parameters, provenance: &str) -> Result<()> {
    let halves = parameters.snapshot()?.into_iter().map(|(name, tensor)| Ok((name, tensor.to_dtype(DType::F16)?)));
    let header = ParserHeader { version: FILE_VERSION, provenance: provenance.to_owned() };
    let header = serde_json::to_string(&header).map_err(|error| Error::malformed(path, error))?;
    file::write_safetensors(path, &halves.collect::<Result<Tensors>>()?, &[(FILE_KEY, header)])
}

/// Azimuth, elevation, roll (radians), then left eye, right eye and mouth, each right and down.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Numbers([f64; network::NUMBERS]);

impl Numbers {
    /// One unit of the network's outputs: they have a deviation near 1.
    const UNIT: f64 = 0.2;

    fn from_outputs(outputs: [f64; network::NUMBERS]) -> Self {
        Self(outputs.map(|output| output * Self::UNIT))
    }

    /// Those of the mirrored picture.
    fn mirrored(&self) -> Self {
        let [azimuth, elevation, roll, left_x, left_y, right_x, right_y, mouth_x, mouth_y] = self.0;
        Self([-azimuth, elevation, -roll, -right_x, right_y, -left_x, left_y, -mouth_x, mouth_y])
    }

    fn mean(&self, other: &Self) -> Self {
        Self(std::array::from_fn(|index| 0.5 * (self.0[index] + other.0[index])))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fresh() -> (tempfile::TempDir, std::path::PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("parser.safetensors");
        let parameters = Parameters::fresh(1, DType::F32, &Device::Cpu);
        Network::new(&parameters).unwrap();
        write(&path, &parameters, "test").unwrap();
        (folder, path)
    }

    #[test]
    fn a_mirrored_portrait_is_read_as_the_mirror_image() {
        let (_folder, path) = fresh();
        let parser = FaceParser::from_bytes(&path, &file::read_bytes(&path).unwrap()).unwrap();
        let portrait = RgbImage::from_fn(128, 128, |x, y| image::Rgb([(2 * x) as u8, y as u8, (x * y / 64) as u8]));
        let face = parser.parse(&portrait).unwrap();
        let mirrored = parser.parse(&imageops::flip_horizontal(&portrait)).unwrap();
        let (labels, expected) = (face.labels.mirrored(), mirrored.labels);
        let differing = labels.labels().iter().zip(expected.labels()).filter(|(left, right)| left != right).count();
        // Sums of two shares in the other order differ by rounding, which decides where two regions tie.
        assert!(differing < 20, "{differing}");
        assert!((face.camera.azimuth_rad + mirrored.camera.azimuth_rad).abs() < 1e-5);
        assert!((face.eyes[0][0] + mirrored.eyes[1][0]).abs() < 1e-5);
    }

    #[test]
    fn features_are_of_the_picture_that_is_parsed_and_tell_pictures_apart() {
        let (_folder, path) = fresh();
        let parser = FaceParser::from_bytes(&path, &file::read_bytes(&path).unwrap()).unwrap();
        let portrait = RgbImage::from_fn(128, 128, |x, y| image::Rgb([(2 * x) as u8, y as u8, (x * y / 64) as u8]));
        let tensor = picture::to_tensor(std::slice::from_ref(&portrait), &Device::Cpu).unwrap();
        let packed: Vec<f32> = network::packed_tensor(&tensor).unwrap().flatten_all().unwrap().to_vec1().unwrap();
        assert_eq!(packed, network::packed(&portrait));
        let features = parser.features(&tensor).unwrap();
        let sides: Vec<usize> = features.iter().map(|map| map.dim(3).unwrap()).collect();
        assert_eq!(sides, [64, 32, 16, 8]);
        let distance = |other: &Tensor| -> f32 {
            let other = parser.features(other).unwrap();
            FaceParser::feature_distance(&features, &other).unwrap().to_vec1().unwrap()[0]
        };
        assert_eq!(distance(&tensor), 0.0);
        // Twice as large, each pixel four times: the same picture.
        let large = imageops::resize(&portrait, 256, 256, imageops::FilterType::Nearest);
        assert!(distance(&picture::to_tensor(&[large], &Device::Cpu).unwrap()) < 1e-6);
        let little = distance(&(&tensor * 0.95).unwrap());
        assert!(little > 0.0 && distance(&tensor.neg().unwrap()) > little);
        assert!(parser.features(&tensor.narrow(3, 0, 64).unwrap()).is_err());
    }

    #[test]
    fn files_that_are_no_parser_are_refused_by_name() {
        let (_folder, path) = fresh();
        let bytes = file::read_bytes(&path).unwrap();
        let error = FaceParser::from_bytes(Path::new("cut.safetensors"), &bytes[..bytes.len() - 1]).unwrap_err();
        assert!(error.to_string().starts_with("cut.safetensors: "), "{error}");
        let (mut tensors, metadata) = file::parse_safetensors(&path, &bytes).unwrap();
        tensors.remove("stem.weight");
        let header = metadata[FILE_KEY].clone();
        let damaged = file::safetensors_bytes(&path, &tensors, &[(FILE_KEY, header)]).unwrap();
        let error = FaceParser::from_bytes(Path::new("part.safetensors"), &damaged).unwrap_err().to_string();
        assert!(error.starts_with("part.safetensors: ") && error.contains("stem.weight"), "{error}");
    }
}
