//! Who knows which region a pixel belongs to: the seam for face parsers.

use cnerf_core::data::labels::LabelMap;
use image::RgbImage;

use crate::error::Result;

/// Finds the nine regions in an aligned portrait.
pub trait RegionParser {
    /// The region of every pixel of `portrait`; the map has the portrait's size.
    fn parse(&self, portrait: &RgbImage) -> Result<LabelMap>;
}
