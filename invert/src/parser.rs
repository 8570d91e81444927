//! Who knows which region a pixel belongs to: the seam for face parsers, and what is said of one on the command line.

use std::path::PathBuf;

use cnerf_core::{
    camera::Camera,
    data::{
        labels::{LabelMap, LabelScheme},
        picture,
    },
    parsing::{self, FaceParser},
};
use image::RgbImage;
use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

#[cfg(feature = "onnx")]
pub(crate) mod onnx;

#[cfg(feature = "onnx")]
pub use self::onnx::OnnxParser;
#[cfg(all(test, feature = "onnx"))]
pub(crate) use self::onnx::tests::{identity as identity_network, mean as mean_network};

/// Finds the nine regions in an aligned portrait.
pub trait RegionParser {
    /// Width and height at which the parser sees best, pixels; portraits are cut at that size for it.
    fn side(&self) -> u32;

    /// Reads `portrait`, which is square.
    fn parse(&self, portrait: &RgbImage) -> Result<Parsed>;
}

/// What a parser saw in a portrait.
#[derive(Clone, Debug, PartialEq)]
pub struct Parsed {
    /// The region of every pixel: a square map of any size.
    pub labels: LabelMap,
    /// The camera that the head's pose suggests (azimuth, elevation and roll), if the parser reads it.
    pub camera: Option<Camera>,
}

/// The suite's own.
impl RegionParser for FaceParser {
    fn side(&self) -> u32 {
        parsing::SIDE as u32
    }

    fn parse(&self, portrait: &RgbImage) -> Result<Parsed> {
        let face = FaceParser::parse(self, portrait)?;
        Ok(Parsed { labels: face.labels, camera: Some(face.camera) })
    }
}

/// The classes of the face parsers trained on CelebAMask-HQ that most exporters publish (zllrunning's BiSeNet and its
/// descendants), in the order of their label values. Not the order of CelebAMask-HQ itself.
pub const BISENET_CLASSES: [&str; 19] = [
    "background",
    "skin",
    "l_brow",
    "r_brow",
    "l_eye",
    "r_eye",
    "glasses",
    "l_ear",
    "r_ear",
    "earring",
    "nose",
    "mouth",
    "u_lip",
    "l_lip",
    "neck",
    "necklace",
    "cloth",
    "hair",
    "hat",
];

/// What a network wants its colours as; bytes are x in 0 to 255.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum PixelScale {
    /// (x - 128) / 128
    #[default]
    Symmetric,
    /// x / 255
    Unit,
    /// x / 255, less ImageNet's mean, divided by its deviation
    Imagenet,
}

impl PixelScale {
    /// A channel's byte as the network wants it; channels are red, green, blue.
    pub fn apply(self, channel: usize, value: u8) -> f32 {
        const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
        const DEVIATION: [f32; 3] = [0.229, 0.224, 0.225];
        let value = f32::from(value);
        match self {
            Self::Symmetric => (value - 128.0) / 128.0,
            Self::Unit => value / 255.0,
            Self::Imagenet => {
                let pick = |of: [f32; 3]| of.get(channel).copied().unwrap_or(1.0);
                (value / 255.0 - pick(MEAN)) / pick(DEVIATION)
            }
        }
    }
}

/// The word that stands for no parser in place of a file.
const NO_PARSER: &str = "none";
/// Largest parser of our own kind that is read, bytes.
const LARGEST_PARSER: u64 = 64 << 20;

/// A face parser's file, and what the file itself does not say.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
#[serde(default, deny_unknown_fields)]
pub struct ParserConfig {
    /// Face parser that finds the regions of each photo, in ONNX format or of `train-parser`; `none` finds none
    /// [default: the built-in one]
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE|none"))]
    pub parser: Option<PathBuf>,
    /// The parser's classes in the order of its labels [default: background skin l_brow r_brow l_eye r_eye glasses
    /// l_ear r_ear earring nose mouth u_lip l_lip neck necklace cloth hair hat]
    #[cfg_attr(feature = "clap", arg(long, value_name = "A,B,C", value_delimiter = ',', requires = "parser"))]
    pub parser_classes: Vec<String>,
    /// What the parser wants its colours as
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value = "symmetric", requires = "parser"))]
    pub parser_input: PixelScale,
}

impl ParserConfig {
    /// The regions of the parser's label values.
    pub fn scheme(&self) -> Result<LabelScheme> {
        let scheme = match self.parser_classes.as_slice() {
            [] => LabelScheme::from_class_names(&BISENET_CLASSES),
            names => LabelScheme::from_class_names(names),
        };
        scheme.map_err(|error| match error {
            cnerf_core::Error::Config { reason, .. } => Error::config("--parser-classes", reason),
            other => other.into(),
        })
    }

    /// The parser named, loaded; `built_in` (the bytes of a parser's file) if none is named.
    ///
    /// # Errors
    /// If the file cannot be read or is no face parser.
    pub fn load(&self, built_in: &[u8]) -> Result<Option<Box<dyn RegionParser>>> {
        let Some(path) = &self.parser else {
            return Ok(Some(Box::new(FaceParser::from_bytes("the built-in parser".as_ref(), built_in)?)));
        };
        if path.as_os_str() == NO_PARSER {
            return Ok(None);
        }
        if path.extension().is_some_and(|extension| extension == "safetensors") {
            let bytes = picture::read_file(path, LARGEST_PARSER)?;
            return Ok(Some(Box::new(FaceParser::from_bytes(path, &bytes)?)));
        }
        #[cfg(feature = "onnx")]
        return Ok(Some(Box::new(OnnxParser::load(path, self.scheme()?, self.parser_input)?)));
        #[cfg(not(feature = "onnx"))]
        {
            let reason = format!("{}: this build reads no ONNX files; build with `--features onnx`", path.display());
            Err(Error::config("--parser", reason))
        }
    }
}

#[cfg(test)]
mod tests {
    use cnerf_core::region::Region;

    use super::*;

    #[test]
    fn classes_are_known_by_name_and_never_guessed() {
        let scheme = ParserConfig::default().scheme().unwrap();
        assert_eq!((scheme.region(2), scheme.region(17)), (Some(Region::Eyebrows), Some(Region::Hair)));
        let named = |names: &[&str]| ParserConfig {
            parser_classes: names.iter().map(|name| (*name).to_owned()).collect(),
            ..ParserConfig::default()
        };
        assert_eq!(named(&["background", "hair"]).scheme().unwrap().region(1), Some(Region::Hair));
        let error = named(&["background", "beard"]).scheme().unwrap_err().to_string();
        assert!(error.starts_with("--parser-classes: ") && error.contains("`beard`"), "{error}");
    }

    #[test]
    fn scales_are_the_published_ones() {
        // (0 - 128) / 128, 255 / 255, (1 - 0.406) / 0.225.
        for (scale, channel, byte, expected) in
            [(PixelScale::Symmetric, 0, 0, -1.0), (PixelScale::Unit, 1, 255, 1.0), (PixelScale::Imagenet, 2, 255, 2.64)]
        {
            assert!((scale.apply(channel, byte) - expected).abs() < 1e-6);
        }
    }
}
