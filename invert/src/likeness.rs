//! How like a photo a picture looks, beyond pixel by pixel: LPIPS where the user brings its weights, else the features
//! of the built-in face parser, which knows eyes, mouths and outlines of hair.

use std::path::Path;

use candle_core::{Device, Tensor};
use cnerf_core::{eval::perceptual::Perceptual, parsing::FaceParser};

use crate::error::Result;

/// What the parser's distance counts of LPIPS: its four maps, not weighted by people's judgements, differ by several times
/// as much, and would cost colours.
const PARSER_SHARE: f64 = 0.05;

/// A perceptual distance.
#[derive(Clone, Debug)]
pub enum Likeness {
    /// Learnt from people's judgements; its weights come by path.
    Lpips(Perceptual),
    /// The built-in parser's features.
    Parser(Box<FaceParser>),
}

impl Likeness {
    /// LPIPS with the weights at `path`, if there is one; else the features of the parser in `built_in`, the bytes of its
    /// file.
    ///
    /// # Errors
    /// If `path` cannot be read or holds no LPIPS weights.
    pub fn load(path: Option<&Path>, built_in: &[u8], device: &Device) -> Result<Self> {
        Ok(match path {
            Some(path) => Self::Lpips(Perceptual::load(path, device)?),
            None => Self::Parser(Box::new(FaceParser::from_bytes("the built-in parser".as_ref(), built_in)?)),
        })
    }

    /// What it is called in reports.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Lpips(perceptual) => perceptual.backbone().name(),
            Self::Parser(_) => "parser",
        }
    }

    /// Whether pictures of `side` x `side` pixels can be compared.
    pub fn sees(&self, side: usize) -> bool {
        match self {
            Self::Lpips(perceptual) => side >= perceptual.backbone().smallest_side(),
            Self::Parser(_) => FaceParser::sees(side),
        }
    }

    /// Features of a picture `[1, 3, R, R]` in [-1, 1]. Differentiable.
    pub fn features(&self, rgb: &Tensor) -> Result<Vec<Tensor>> {
        Ok(match self {
            Self::Lpips(perceptual) => perceptual.features(rgb)?,
            Self::Parser(parser) => parser.features(rgb)?,
        })
    }

    /// The distance of two pictures by their features, a scalar.
    pub fn distance(&self, a: &[Tensor], b: &[Tensor]) -> Result<Tensor> {
        Ok(match self {
            Self::Lpips(perceptual) => perceptual.feature_distance(a, b)?.mean_all()?,
            Self::Parser(_) => (FaceParser::feature_distance(a, b)?.mean_all()? * PARSER_SHARE)?,
        })
    }

    /// LPIPS of two pictures `[1, 3, R, R]`, if this is LPIPS.
    pub fn lpips(&self, a: &Tensor, b: &Tensor) -> Result<Option<f64>> {
        match self {
            Self::Lpips(perceptual) => Ok(perceptual.distance(a, b)?.to_vec1::<f32>()?.first().copied().map(f64::from)),
            Self::Parser(_) => Ok(None),
        }
    }
}
