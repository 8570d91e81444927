//! Who knows which region a pixel belongs to: the seam for face parsers, and what is said of one on the command line.

use std::path::PathBuf;

use cnerf_core::data::labels::{LabelMap, LabelScheme};
use image::RgbImage;
use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

#[cfg(feature = "onnx")]
mod onnx;

#[cfg(feature = "onnx")]
pub use self::onnx::OnnxParser;
#[cfg(all(test, feature = "onnx"))]
pub(crate) use self::onnx::tests::identity as identity_network;

/// Finds the nine regions in an aligned portrait.
pub trait RegionParser {
    /// Width and height at which the parser sees best, pixels; portraits are cut at that size for it.
    fn side(&self) -> u32;

    /// The region of every pixel of `portrait`, which is square. The map is square too, of any size.
    fn parse(&self, portrait: &RgbImage) -> Result<LabelMap>;
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

/// A face parser's file, and what the file itself does not say.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
#[serde(default, deny_unknown_fields)]
pub struct ParserConfig {
    /// Face parser in ONNX format that finds the regions of each photo
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE.onnx", conflicts_with = "mask"))]
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

    /// The parser named, loaded; none if none is named.
    pub fn load(&self) -> Result<Option<Box<dyn RegionParser>>> {
        let Some(path) = &self.parser else { return Ok(None) };
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
