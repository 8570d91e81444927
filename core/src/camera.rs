//! Cameras on the unit sphere and the rays they cast.
//!
//! World: right-handed, y up, the face looks to +z, the head near the origin, one unit = the camera's distance.
//! A camera looks at the origin from (cos e sin a, sin e, cos e cos a). Axes are OpenGL's (-z forward, y up);
//! pixel centres lie at +0.5. Directions are not normalised: their component along the view axis is -1, so a
//! sample at depth z is `origin + z * direction`.

use candle_core::{D, DType, Device, Tensor};
use serde::{Deserialize, Serialize};

use crate::error::Result;

/// Full field of view of every camera the suite makes, radians (12 degrees).
pub const FIELD_OF_VIEW_RAD: f64 = 12.0 * std::f64::consts::PI / 180.0;
/// Distance along the view axis at which the volume begins.
pub const NEAR: f64 = 0.88;
/// Distance along the view axis at which the volume ends.
pub const FAR: f64 = 1.12;
/// World points are multiplied by this before they enter a network: the volume's half depth becomes 1.
pub const INPUT_SCALE: f64 = 2.0 / (FAR - NEAR);

/// A camera, and what an aligned photo may deviate by: roll, principal-point shift and zoom.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Camera {
    /// Angle around the head, radians; positive sees the head from its left (+x).
    pub azimuth_rad: f64,
    /// Angle above the horizon, radians.
    pub elevation_rad: f64,
    /// Rotation about the view axis, radians; positive turns the camera counter-clockwise (the picture clockwise).
    pub roll_rad: f64,
    /// Principal point to the right of the picture's centre, in half picture widths.
    pub shift_x: f64,
    /// Principal point above the picture's centre, in half picture heights.
    pub shift_y: f64,
    /// Magnification; 2 halves the field of view's tangent.
    pub zoom: f64,
    /// Full field of view at zoom 1, radians.
    pub field_of_view_rad: f64,
}

impl Default for Camera {
    fn default() -> Self {
        Self {
            azimuth_rad: 0.0,
            elevation_rad: 0.0,
            roll_rad: 0.0,
            shift_x: 0.0,
            shift_y: 0.0,
            zoom: 1.0,
            field_of_view_rad: FIELD_OF_VIEW_RAD,
        }
    }
}

/// Number of values in a camera's parameter vector, see [`Camera::parameters`].
pub const CAMERA_PARAMETERS: usize = 6;

impl Camera {
    /// A camera at these angles, upright and centred.
    pub fn at(azimuth_rad: f64, elevation_rad: f64) -> Self {
        Self { azimuth_rad, elevation_rad, ..Self::default() }
    }

    /// Azimuth, elevation, roll, shift x, shift y, ln zoom: what an optimiser may move.
    pub fn parameters(&self) -> [f64; CAMERA_PARAMETERS] {
        [self.azimuth_rad, self.elevation_rad, self.roll_rad, self.shift_x, self.shift_y, self.zoom.ln()]
    }

    /// The camera of a parameter vector, see [`Self::parameters`].
    pub fn from_parameters(parameters: [f64; CAMERA_PARAMETERS]) -> Self {
        let [azimuth_rad, elevation_rad, roll_rad, shift_x, shift_y, log_zoom] = parameters;
        Self { azimuth_rad, elevation_rad, roll_rad, shift_x, shift_y, zoom: log_zoom.exp(), ..Self::default() }
    }

    /// The camera that sees the mirrored scene as this one sees the scene.
    #[must_use]
    pub fn mirrored(&self) -> Self {
        Self { azimuth_rad: -self.azimuth_rad, roll_rad: -self.roll_rad, shift_x: -self.shift_x, ..*self }
    }

    /// Rows of the 3x4 matrix from camera to world: columns are the camera's x, y, z axes and its position.
    pub fn world_from_camera(&self) -> [[f64; 4]; 3] {
        let (sin_a, cos_a) = self.azimuth_rad.sin_cos();
        let (sin_e, cos_e) = self.elevation_rad.sin_cos();
        let (sin_r, cos_r) = self.roll_rad.sin_cos();
        // Written out, the axes stay orthonormal at the poles where "up x forward" vanishes.
        let right = [cos_a, 0.0, -sin_a];
        let up = [-sin_e * sin_a, cos_e, -sin_e * cos_a];
        let back = [cos_e * sin_a, sin_e, cos_e * cos_a];
        std::array::from_fn(|row| {
            [cos_r * right[row] + sin_r * up[row], cos_r * up[row] - sin_r * right[row], back[row], back[row]]
        })
    }

    /// Origin and un-normalised direction (world) of the ray through a point of the picture.
    /// `x` and `y` are in [-1, 1], x to the right, y up.
    pub fn ray(&self, x: f64, y: f64) -> ([f64; 3], [f64; 3]) {
        let tangent = (0.5 * self.field_of_view_rad).tan() / self.zoom;
        let local = [(x - self.shift_x) * tangent, (y - self.shift_y) * tangent, -1.0];
        let matrix = self.world_from_camera();
        let direction = matrix.map(|row| row[0] * local[0] + row[1] * local[1] + row[2] * local[2]);
        (matrix.map(|row| row[3]), direction)
    }

    /// Where a world point lies in the picture: x and y as in [`Self::ray`], and its depth along the view axis. None
    /// for a point that is not in front of the camera.
    pub fn project(&self, point: [f64; 3]) -> Option<([f64; 2], f64)> {
        let matrix = self.world_from_camera();
        let [x, y, z] = std::array::from_fn(|axis| {
            matrix.iter().zip(point).map(|(row, value)| row[axis] * (value - row[3])).sum::<f64>()
        });
        let depth = -z;
        let scale = depth * (0.5 * self.field_of_view_rad).tan() / self.zoom;
        (scale > 1e-9).then(|| ([x / scale + self.shift_x, y / scale + self.shift_y], depth))
    }

    /// The parameter vectors of `cameras` as a tensor `[B, 6]`, f32.
    pub fn parameter_tensor(cameras: &[Self], device: &Device) -> Result<Tensor> {
        let values: Vec<f32> =
            cameras.iter().flat_map(|camera| camera.parameters().map(|value| value as f32)).collect();
        Ok(Tensor::from_vec(values, (cameras.len(), CAMERA_PARAMETERS), device)?)
    }
}

/// Rays of several cameras.
#[derive(Clone, Debug)]
pub struct Rays {
    /// `[B, 1, 3]`, world.
    pub origins: Tensor,
    /// `[B, R, 3]`, world, un-normalised: the component along the view axis is -1.
    pub directions: Tensor,
}

/// Rays through points of pictures, differentiable in the cameras.
///
/// `parameters`: `[B, 6]`, see [`Camera::parameters`]. `pixels`: `[B, R, 2]` (or `[1, R, 2]`), x to the right and
/// y down in pixels, pixel centres at +0.5. `resolution`: the pictures' width and height in pixels.
pub fn cast(parameters: &Tensor, pixels: &Tensor, resolution: usize, field_of_view_rad: f64) -> Result<Rays> {
    let parameter = |index| parameters.narrow(1, index, 1);
    let (azimuth, elevation, roll) = (parameter(0)?, parameter(1)?, parameter(2)?);
    let (sin_a, cos_a) = (azimuth.sin()?, azimuth.cos()?);
    let (sin_e, cos_e) = (elevation.sin()?, elevation.cos()?);
    let (sin_r, cos_r) = (roll.sin()?, roll.cos()?);
    let right = Tensor::cat(&[&cos_a, &cos_a.zeros_like()?, &sin_a.neg()?], 1)?; // [B, 3]
    let up = Tensor::cat(&[&(&sin_e * &sin_a)?.neg()?, &cos_e, &(&sin_e * &cos_a)?.neg()?], 1)?;
    let back = Tensor::cat(&[&(&cos_e * &sin_a)?, &sin_e, &(&cos_e * &cos_a)?], 1)?;
    let rolled_right = (right.broadcast_mul(&cos_r)? + up.broadcast_mul(&sin_r)?)?;
    let rolled_up = (up.broadcast_mul(&cos_r)? - right.broadcast_mul(&sin_r)?)?;

    let half = resolution as f64 / 2.0;
    let tangent = ((parameter(5)?.neg()?.exp()? * (0.5 * field_of_view_rad).tan())?).unsqueeze(2)?; // [B, 1, 1]
    let x = (pixels.narrow(D::Minus1, 0, 1)?.affine(1.0 / half, -1.0))?;
    let y = (pixels.narrow(D::Minus1, 1, 1)?.affine(-1.0 / half, 1.0))?;
    let x = x.broadcast_sub(&parameter(3)?.unsqueeze(2)?)?.broadcast_mul(&tangent)?; // [B, R, 1]
    let y = y.broadcast_sub(&parameter(4)?.unsqueeze(2)?)?.broadcast_mul(&tangent)?;
    let sideways = x.broadcast_mul(&rolled_right.unsqueeze(1)?)?;
    let upwards = y.broadcast_mul(&rolled_up.unsqueeze(1)?)?;
    let directions = (sideways + upwards)?.broadcast_sub(&back.unsqueeze(1)?)?;
    Ok(Rays { origins: back.unsqueeze(1)?, directions })
}

/// Centres of all pixels of a square picture in row order, `[1, resolution^2, 2]`, f32.
pub fn pixel_centres(resolution: usize, device: &Device) -> Result<Tensor> {
    let values: Vec<f32> = (0..resolution * resolution)
        .flat_map(|index| [(index % resolution) as f32 + 0.5, (index / resolution) as f32 + 0.5])
        .collect();
    Ok(Tensor::from_vec(values, (1, resolution * resolution, 2), device)?.to_dtype(DType::F32)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_are_orthonormal_even_at_the_poles() {
        for elevation in [-std::f64::consts::FRAC_PI_2, -0.3, 0.0, 1.0, std::f64::consts::FRAC_PI_2] {
            let camera = Camera { roll_rad: 0.4, ..Camera::at(2.1, elevation) };
            let matrix = camera.world_from_camera();
            for (left, right) in [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)] {
                let dot: f64 = matrix.iter().map(|row| row[left] * row[right]).sum();
                assert!((dot - f64::from(u8::from(left == right))).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn projection_undoes_the_ray() {
        let camera = Camera { roll_rad: 0.2, shift_x: 0.1, shift_y: -0.05, zoom: 1.3, ..Camera::at(0.4, -0.2) };
        let (origin, direction) = camera.ray(0.3, -0.7);
        let point = std::array::from_fn(|axis| origin[axis] + 0.97 * direction[axis]);
        let ([x, y], depth) = camera.project(point).unwrap();
        assert!((x - 0.3).abs() < 1e-12 && (y + 0.7).abs() < 1e-12 && (depth - 0.97).abs() < 1e-12);
        assert_eq!(camera.project(std::array::from_fn(|axis| origin[axis] - direction[axis])), None);
    }

    #[test]
    fn tensor_rays_are_the_scalar_rays() {
        let cameras = [
            Camera { roll_rad: 0.2, shift_x: 0.1, shift_y: -0.05, zoom: 1.3, ..Camera::at(0.4, -0.2) },
            Camera::at(-1.0, 0.7),
        ];
        let parameters = Camera::parameter_tensor(&cameras, &Device::Cpu).unwrap();
        let pixels = pixel_centres(4, &Device::Cpu).unwrap();
        let rays = cast(&parameters, &pixels, 4, FIELD_OF_VIEW_RAD).unwrap();
        let directions: Vec<Vec<Vec<f32>>> = rays.directions.to_vec3().unwrap();
        for (index, camera) in cameras.iter().enumerate() {
            for (pixel, found) in directions[index].iter().enumerate() {
                let x = ((pixel % 4) as f64 + 0.5) / 2.0 - 1.0;
                let y = 1.0 - ((pixel / 4) as f64 + 0.5) / 2.0;
                let (_, direction) = camera.ray(x, y);
                for axis in 0..3 {
                    assert!((direction[axis] - f64::from(found[axis])).abs() < 1e-6);
                }
            }
        }
    }
}
