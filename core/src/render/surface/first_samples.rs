//! First distances of all rays of a picture, most of them lines between pixels.

use candle_core::{DType, Tensor};

use super::{POINTS_AT_ONCE, Probed};
use crate::{
    error::Result,
    render::{Outputs, RadianceField, RayBundle},
};

/// Distances of all rays of a picture at the same few depths.
pub struct FirstSamples {
    depths: Vec<f64>,
    /// Per picture and ray.
    distances: Vec<Vec<Vec<f64>>>,
    /// How many were evaluated.
    pub taken: usize,
}

impl FirstSamples {
    /// At `depths` `[1, 1, S]` of `rays`, those of all pixels in row order.
    pub fn new<F: RadianceField>(field: &F, rays: &RayBundle, depths: &Tensor, resolution: usize) -> Result<Self> {
        let (batch, _) = rays.dimensions()?;
        let samples = depths.dim(2)?;
        let depth_values: Vec<f64> = depths.to_dtype(DType::F64)?.flatten_all()?.to_vec1()?;
        let between_samples = depth_values.windows(2).map(|pair| pair[1] - pair[0]).fold(f64::INFINITY, f64::min);
        let step = if 2.0 * pixel_distance(rays)? <= between_samples { 2 } else { 1 };
        let chosen: Vec<u32> = (0..resolution)
            .step_by(step)
            .flat_map(|row| (0..resolution).step_by(step).map(move |column| (row * resolution + column) as u32))
            .collect();
        let mut distances = vec![Vec::with_capacity(chosen.len()); batch];
        for chosen in chosen.chunks((POINTS_AT_ONCE / (batch * samples).max(1)).max(1)) {
            let chosen = Tensor::new(chosen, rays.directions.device())?;
            let rays = RayBundle {
                origins: rays.origins.clone(),
                directions: rays.directions.contiguous()?.index_select(&chosen, 1)?,
                view_directions: rays.view_directions.contiguous()?.index_select(&chosen, 1)?,
            };
            let view = if field.sees_view() { Some(rays.view_directions_of(samples)?) } else { None };
            let found = field.evaluate(&rays.points(depths)?, view.as_ref(), Outputs::default())?.distance;
            let found = found.to_dtype(DType::F64)?.reshape((batch, (), samples))?.to_vec3()?;
            distances.iter_mut().zip(found).for_each(|(distances, found)| distances.extend(found));
        }
        let taken = batch * chosen.len() * samples;
        if step == 2 {
            distances = distances.iter().map(|grid| doubled(grid, resolution)).collect();
        }
        Ok(Self { depths: depth_values, distances, taken })
    }

    /// What is known of `rays`, the picture's from `first_ray` on.
    pub(super) fn of(&self, rays: &RayBundle, first_ray: usize) -> Result<Vec<Probed>> {
        let lengths: Vec<Vec<f64>> = rays.lengths()?.to_dtype(DType::F64)?.to_vec2()?;
        let images = self.distances.iter().zip(lengths).enumerate();
        let probed = images.flat_map(|(image, (distances, lengths))| {
            let rays = distances.iter().skip(first_ray).zip(lengths).enumerate();
            rays.map(move |(ray, (distances, length))| Probed {
                image,
                ray,
                length,
                samples: self.depths.iter().copied().zip(distances.iter().copied()).collect(),
            })
        });
        Ok(probed.collect())
    }
}

/// How far neighbouring rays are apart at most, world units at unit depth; none where there is one ray.
fn pixel_distance(rays: &RayBundle) -> Result<f64> {
    let (_, count) = rays.dimensions()?;
    if count < 2 {
        return Ok(f64::INFINITY);
    }
    let step = (rays.directions.narrow(1, 1, 1)? - rays.directions.narrow(1, 0, 1)?)?;
    Ok(crate::render::norm(&step)?.to_dtype(DType::F64)?.max_all()?.to_scalar()?)
}

/// A grid of rows of values at even pixels, row by row, as one of all `resolution`² pixels: straight lines between and,
/// on the far edge of an even resolution, beyond.
fn doubled(grid: &[Vec<f64>], resolution: usize) -> Vec<Vec<f64>> {
    let side = resolution.div_ceil(2);
    // The two even pixels that an odd one is on the line of, and the second's share.
    let line = |pixel: usize| match pixel / 2 {
        before if pixel.is_multiple_of(2) => (before, before, 0.0),
        before if before + 1 < side => (before, before + 1, 0.5),
        before => (before.saturating_sub(1), before, if before > 0 { 1.5 } else { 1.0 }),
    };
    let mut all = Vec::with_capacity(resolution * resolution);
    for (top, bottom, down) in (0..resolution).map(line) {
        for (left, right, along) in (0..resolution).map(line) {
            let corner = |row: usize, column: usize| grid.get(row * side + column).into_iter().flatten();
            let upper = corner(top, left).zip(corner(top, right)).map(|(left, right)| left + along * (right - left));
            let lower =
                corner(bottom, left).zip(corner(bottom, right)).map(|(left, right)| left + along * (right - left));
            all.push(upper.zip(lower).map(|(upper, lower)| upper + down * (lower - upper)).collect());
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_between_pixels_are_on_straight_lines() {
        for resolution in [1, 2, 5, 8] {
            let value = |row: usize, column: usize| 3.0 * row as f64 - 0.5 * column as f64 + 1.0;
            let even: Vec<Vec<f64>> = (0..resolution)
                .step_by(2)
                .flat_map(|row| (0..resolution).step_by(2).map(move |column| vec![value(row, column), 7.0]))
                .collect();
            let found = doubled(&even, resolution);
            assert_eq!(found.len(), resolution * resolution);
            for (pixel, found) in found.iter().enumerate() {
                // With a single even pixel there is no line to go on by.
                let expected = if resolution < 3 { value(0, 0) } else { value(pixel / resolution, pixel % resolution) };
                assert!((found[0] - expected).abs() < 1e-12 && found[1] == 7.0, "{resolution} {pixel} {found:?}");
            }
        }
    }
}
