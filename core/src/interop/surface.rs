//! A portrait's surface as a mesh: the field's zero level, coloured by the field itself.

use candle_core::{DType, Tensor};

use crate::{
    error::Result,
    interop::mesh::{Appearance, Mesh, Volume, extract as extract_level},
    model::{field::PortraitField, generator::Generator},
    region::Region,
    render::{Outputs, RadianceField as _},
};

/// Half the side of the box the surface is looked for in, world units: what every training camera sees of the head.
const HALF_SIDE: f32 = 0.11;
/// Pieces of less than this share of the largest one's area are specks, not parts of a portrait.
const SPECK: f64 = 0.02;

/// The surface of the portrait with `codes` `[1, 9, 2, D]`, `resolution` cells along each side of its box.
///
/// # Errors
/// If there is no surface, or the resolution is out of bounds.
pub fn extract(generator: &Generator, codes: &Tensor, resolution: usize) -> Result<Mesh> {
    let field = generator.field().portraits(codes)?.detached();
    let volume = Volume { min: [-HALF_SIDE; 3], max: [HALF_SIDE; 3], resolution };
    let distances = |points: &[[f32; 3]]| {
        let views = toward(&field, points.len(), [0.0, 0.0, -1.0], generator)?;
        let evaluation = field.evaluate(&rows(points, generator)?, views.as_ref(), Outputs::default())?;
        Ok(evaluation.distance.flatten_all()?.to_dtype(DType::F32)?.to_vec1()?)
    };
    let appearance = |points: &[[f32; 3]], normals: &[[f32; 3]]| {
        let inward: Vec<[f32; 3]> = normals.iter().map(|normal| normal.map(|axis| -axis)).collect();
        let views = field.sees_view().then(|| rows(&inward, generator)).transpose()?;
        let outputs = Outputs { colour: true, ..Outputs::default() };
        let evaluation = field.evaluate(&rows(points, generator)?, views.as_ref(), outputs)?;
        let Some(colours) = &evaluation.colours else { return Ok(Vec::new()) };
        let logits = evaluation.masks.unsqueeze(2)?.broadcast_mul(colours)?.sum(1)?;
        let colours: Vec<Vec<f32>> = candle_nn::ops::sigmoid(&logits)?.squeeze(0)?.t()?.contiguous()?.to_vec2()?;
        let masks: Vec<Vec<f32>> = evaluation.masks.squeeze(0)?.t()?.contiguous()?.to_vec2()?;
        let regions: Vec<Region> = field.volume_regions().iter().collect();
        Ok(colours.iter().zip(&masks).map(|(colour, masks)| look(colour, masks, &regions)).collect())
    };
    Ok(extract_level(&volume, distances, appearance)?.without_specks(SPECK))
}

/// The colour of a vertex and the region whose mask is largest there.
fn look(colour: &[f32], masks: &[f32], regions: &[Region]) -> Appearance {
    let mut bytes = [0; 3];
    for (byte, value) in bytes.iter_mut().zip(colour) {
        *byte = (255.0 * value.clamp(0.0, 1.0)).round() as u8;
    }
    let largest = masks.iter().zip(regions).max_by(|left, right| left.0.total_cmp(right.0));
    Appearance { colour: bytes, region: largest.map_or(Region::Face, |(_, region)| *region) }
}

fn rows(points: &[[f32; 3]], generator: &Generator) -> Result<Tensor> {
    let values: Vec<f32> = points.iter().flatten().copied().collect();
    Ok(Tensor::from_vec(values, (1, points.len(), 3), &generator.device())?)
}

/// One view direction for all points, if the field reads any.
fn toward(field: &PortraitField, count: usize, direction: [f32; 3], generator: &Generator) -> Result<Option<Tensor>> {
    if !field.sees_view() {
        return Ok(None);
    }
    Ok(Some(Tensor::new(&[[direction]], &generator.device())?.expand((1, count, 3))?.contiguous()?))
}
