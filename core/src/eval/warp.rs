//! One view seen from another's camera: each pixel of a target view is taken to the world by its rendered depth and
//! projected into a source view. Pixels that the source does not see are told apart by its own depth.

use candle_core::{DType, Device, Tensor};

use crate::{
    camera::{Camera, FAR},
    error::{Error, Result},
    render::Frame,
};

/// Pixels with less of the head in them lie on the outline or beyond: their depth is a mixture.
const OPAQUE: f64 = 0.95;
/// A pixel is seen in the source if the source's depth there is the pixel's, to this many world units: half of what
/// the nose stands out from the cheeks, a few times what depth changes between neighbouring pixels of a 64² render.
pub const DEPTH_TOLERANCE: f64 = 0.01;

/// Channels over a square picture, sampled at points in [-1, 1], x to the right and y up.
#[derive(Clone, Debug, PartialEq)]
pub struct Raster {
    side: usize,
    channels: Vec<Vec<f64>>,
}

impl Raster {
    /// A raster of `channels`, each of side² values in row order.
    ///
    /// # Errors
    /// [`Error::Shape`] if a channel has another length.
    pub fn new(side: usize, channels: Vec<Vec<f64>>) -> Result<Self> {
        match channels.iter().find(|channel| side == 0 || channel.len() != side * side) {
            Some(channel) => Err(Error::shape("raster", [side, side], &[channel.len()])),
            None => Ok(Self { side, channels }),
        }
    }

    /// The raster of `tensor` `[1, C, S, S]`.
    pub fn from_tensor(tensor: &Tensor) -> Result<Self> {
        let &[1, channels, height, width] = tensor.dims() else {
            return Err(Error::shape("picture", "[1, C, S, S]", tensor.dims()));
        };
        let values = tensor.detach().to_device(&Device::Cpu)?.to_dtype(DType::F64)?;
        let values = values.reshape((channels, height * width))?.to_vec2::<f64>()?;
        if height != width {
            return Err(Error::shape("picture", "[1, C, S, S]", tensor.dims()));
        }
        Self::new(width, values)
    }

    /// Width and height, pixels.
    pub fn side(&self) -> usize {
        self.side
    }

    /// The channels, each in row order.
    pub fn channels(&self) -> &[Vec<f64>] {
        &self.channels
    }

    /// The centre of pixel `index` in row order.
    pub fn centre(&self, index: usize) -> [f64; 2] {
        centre(index, self.side)
    }

    /// The pixel that holds a point; edge pixels reach beyond the picture.
    pub fn nearest(&self, [x, y]: [f64; 2]) -> usize {
        let place = |value: f64| (value.floor().max(0.0) as usize).min(self.side - 1);
        let half = 0.5 * self.side as f64;
        place((1.0 - y) * half) * self.side + place((x + 1.0) * half)
    }

    /// A channel between its pixels' centres, bilinear: exact for linear functions.
    pub fn bilinear(&self, channel: usize, point: [f64; 2]) -> f64 {
        self.sample(channel, taps(self.side, point, |share| [0.0, 1.0 - share, share, 0.0]))
    }

    /// A channel between its pixels' centres by the Catmull-Rom spline: exact for quadratic functions, and gentle to
    /// fine detail, which bilinear sampling blurs.
    pub fn cubic(&self, channel: usize, point: [f64; 2]) -> f64 {
        self.sample(channel, taps(self.side, point, catmull_rom))
    }

    fn sample(&self, channel: usize, taps: [(usize, f64); 16]) -> f64 {
        let Some(values) = self.channels.get(channel) else { return 0.0 };
        let weighted = taps.iter().filter(|(_, weight)| *weight != 0.0);
        weighted.map(|(index, weight)| weight * values.get(*index).copied().unwrap_or_default()).sum()
    }
}

/// Weights of the four pixels around a place `t` of the way from the second to the third.
fn catmull_rom(t: f64) -> [f64; 4] {
    [
        0.5 * t * (t * (2.0 - t) - 1.0),
        0.5 * (t * t * (3.0 * t - 5.0) + 2.0),
        0.5 * t * (t * (4.0 - 3.0 * t) + 1.0),
        0.5 * t * t * (t - 1.0),
    ]
}

/// The pixels around a point of a picture in row order, and their weights; beyond the edge its pixels are repeated.
fn taps(side: usize, [x, y]: [f64; 2], weights: impl Fn(f64) -> [f64; 4]) -> [(usize, f64); 16] {
    let half = 0.5 * side as f64;
    let (column, row) = ((x + 1.0) * half - 0.5, (1.0 - y) * half - 0.5);
    let (across, down) = (weights(column - column.floor()), weights(row - row.floor()));
    let clamped = |value: f64, step: usize| (value.floor() as i64 + step as i64 - 1).clamp(0, side as i64 - 1) as usize;
    std::array::from_fn(|tap| {
        let (step_down, step) = (tap / 4, tap % 4);
        (clamped(row, step_down) * side + clamped(column, step), down[step_down] * across[step])
    })
}

fn centre(index: usize, side: usize) -> [f64; 2] {
    let at = |place: usize| (2 * place + 1) as f64 / side as f64 - 1.0;
    [at(index % side), -at(index / side)]
}

/// What a view's camera sees the surface of.
#[derive(Clone, Debug)]
pub struct Surface {
    camera: Camera,
    /// Depth of the head alone along the view axis, world units; and opacity.
    raster: Raster,
}

impl Surface {
    /// The surface in a render of one portrait from `camera`. Depth is freed of what of the far plane is mixed in.
    pub fn new(camera: Camera, frame: &Frame) -> Result<Self> {
        let (depth, opacity) = (Raster::from_tensor(&frame.depth)?, Raster::from_tensor(&frame.opacity)?);
        let Some((depths, opacities)) = depth.channels.into_iter().next().zip(opacity.channels.into_iter().next())
        else {
            return Err(Error::shape("depth", "[1, 1, S, S]", frame.depth.dims()));
        };
        let head = |(depth, opacity): (f64, &f64)| (depth - (1.0 - opacity) * FAR) / opacity.max(0.05);
        let depths = depths.into_iter().zip(&opacities).map(head).collect();
        Ok(Self { camera, raster: Raster::new(depth.side, vec![depths, opacities])? })
    }

    /// A surface that is known: `raster` holds the head's depth along the view axis, world units, and its opacity.
    pub(super) fn of_head(camera: Camera, raster: Raster) -> Self {
        Self { camera, raster }
    }

    /// Where it is seen from.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// The head's depth along the view axis at a point of the picture, world units; none on its outline or beyond.
    pub fn depth(&self, point: [f64; 2]) -> Option<f64> {
        (self.raster.bilinear(1, point) >= OPAQUE).then(|| self.raster.bilinear(0, point))
    }
}

/// Where the pixels of a target view lie in a source view.
#[derive(Clone, Debug)]
pub struct Warp {
    /// For every pixel of the target in row order: the point of the source that shows the same place of the surface;
    /// none if it is background or hidden there.
    pub places: Vec<Option<[f64; 2]>>,
    /// Pixels of the target that show the head.
    pub foreground: usize,
}

impl Warp {
    /// The warp of a target picture of `side` × `side` pixels.
    pub fn new(target: &Surface, source: &Surface, side: usize) -> Self {
        let mut foreground = 0;
        let places = (0..side * side).map(|index| {
            let [x, y] = centre(index, side);
            let depth = target.depth([x, y])?;
            foreground += 1;
            let (origin, direction) = target.camera.ray(x, y);
            let point = std::array::from_fn(|axis| origin[axis] + depth * direction[axis]);
            let (place, expected) = source.camera.project(point)?;
            // Up to the centres of the edge pixels, their own rounding included.
            let inside = place.iter().all(|value| value.abs() <= 1.0 - 1.0 / side as f64 + 1e-9);
            let found = if inside { source.depth(place)? } else { return None };
            ((found - expected).abs() <= DEPTH_TOLERANCE).then_some(place)
        });
        let places = places.collect();
        Self { places, foreground }
    }

    /// The pixels that both views see: index in the target, point in the source.
    pub fn visible(&self) -> impl Iterator<Item = (usize, [f64; 2])> {
        self.places.iter().enumerate().filter_map(|(index, place)| Some((index, (*place)?)))
    }

    /// What both views show of the same places, `[C, visible]` each: the target's own pixels, and what the source has
    /// there (Catmull-Rom). Differentiable in both pictures `[1, C, side, side]`; none if nothing is seen by both.
    pub fn seen_by_both(&self, target: &Tensor, source: &Tensor) -> Result<Option<[Tensor; 2]>> {
        let &[1, channels, side, _] = target.dims() else {
            return Err(Error::shape("picture", "[1, C, S, S]", target.dims()));
        };
        let pixels: Vec<u32> = self.visible().map(|(index, _)| index as u32).collect();
        if pixels.is_empty() {
            return Ok(None);
        }
        let taps: Vec<(usize, f64)> = self.visible().flat_map(|(_, place)| taps(side, place, catmull_rom)).collect();
        let rows = |picture: &Tensor| picture.reshape((channels, side * side));
        let device = target.device();
        let count = pixels.len();
        let own = rows(target)?.index_select(&Tensor::from_vec(pixels, count, device)?, 1)?;
        let indices: Vec<u32> = taps.iter().map(|(index, _)| *index as u32).collect();
        let weights: Vec<f32> = taps.iter().map(|(_, weight)| *weight as f32).collect();
        let weights = Tensor::from_vec(weights, (1, count, 16), device)?.to_dtype(target.dtype())?;
        let found = rows(source)?.index_select(&Tensor::from_vec(indices, 16 * count, device)?, 1)?;
        let found = found.reshape((channels, count, 16))?.broadcast_mul(&weights)?.sum(2)?;
        Ok(Some([own, found]))
    }

    /// Share of the target's head that the source sees; 0 if there is no head.
    pub fn visible_share(&self) -> f64 {
        self.visible().count() as f64 / self.foreground.max(1) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 48;

    /// The plane z = 0.02 + 0.3 x - 0.2 y, and perhaps a nearer one at z = 0.07 where x > 0.02.
    fn hit(camera: &Camera, [x, y]: [f64; 2], occluded: bool) -> (f64, bool) {
        let (origin, direction) = camera.ray(x, y);
        let meet = |normal: [f64; 3], constant: f64| {
            let dot = |v: [f64; 3]| v.iter().zip(normal).map(|(a, b)| a * b).sum::<f64>();
            (constant - dot(origin)) / dot(direction)
        };
        let near = meet([0.0, 0.0, 1.0], 0.07);
        let hidden = occluded && origin[0] + near * direction[0] > 0.02;
        if hidden { (near, true) } else { (meet([-0.3, 0.2, 1.0], 0.02), false) }
    }

    fn surface(camera: Camera, occluded: bool) -> Surface {
        let depths = (0..SIDE * SIDE).map(|index| hit(&camera, centre(index, SIDE), occluded).0).collect();
        Surface { camera, raster: Raster::new(SIDE, vec![depths, vec![1.0; SIDE * SIDE]]).unwrap() }
    }

    fn world(camera: &Camera, point: [f64; 2], depth: f64) -> [f64; 3] {
        let (origin, direction) = camera.ray(point[0], point[1]);
        std::array::from_fn(|axis| origin[axis] + depth * direction[axis])
    }

    #[test]
    fn sampling_is_exact_for_what_it_should_be() {
        let raster = |value: &dyn Fn(f64, f64) -> f64| {
            let values = (0..SIDE * SIDE).map(|index| centre(index, SIDE)).map(|[x, y]| value(x, y)).collect();
            Raster::new(SIDE, vec![values]).unwrap()
        };
        let (linear, square) = (|x: f64, y: f64| 0.3 + x - 2.0 * y, |x: f64, y: f64| x * x - 0.5 * x * y + y);
        let (linear_raster, square_raster) = (raster(&linear), raster(&square));
        for point in [[0.0, 0.0], [0.31, -0.77], [-0.9, 0.45]] {
            let [x, y] = point;
            assert!((linear_raster.bilinear(0, point) - linear(x, y)).abs() < 1e-12);
            assert!((linear_raster.cubic(0, point) - linear(x, y)).abs() < 1e-12);
            assert!((square_raster.cubic(0, point) - square(x, y)).abs() < 1e-12);
        }
        assert_eq!(linear_raster.nearest([-1.0, 1.0]), 0);
        assert_eq!(linear_raster.nearest([1.5, -1.5]), SIDE * SIDE - 1);
        assert_eq!(
            (0..SIDE * SIDE).map(|index| linear_raster.nearest(centre(index, SIDE))).max(),
            Some(SIDE * SIDE - 1)
        );
    }

    #[test]
    fn a_plane_is_warped_exactly() {
        let (target, source) = (Camera::at(0.3, 0.1), Camera { roll_rad: 0.1, zoom: 0.8, ..Camera::at(-0.2, -0.1) });
        let warp = Warp::new(&surface(target, false), &surface(source, false), SIDE);
        assert_eq!(warp.foreground, SIDE * SIDE);
        let mut seen = 0;
        for (index, place) in warp.visible() {
            // The same point of the plane, found from both sides.
            let from_target = world(&target, centre(index, SIDE), hit(&target, centre(index, SIDE), false).0);
            let from_source = world(&source, place, hit(&source, place, false).0);
            for axis in 0..3 {
                assert!((from_target[axis] - from_source[axis]).abs() < 1e-12, "{index}");
            }
            seen += 1;
        }
        assert!(seen > SIDE * SIDE / 2, "{seen}");
        let same = Warp::new(&surface(target, false), &surface(target, false), SIDE);
        assert!(same.visible().all(|(index, place)| Raster::nearest(&surface(target, false).raster, place) == index));
        assert_eq!(same.visible_share(), 1.0);
    }

    #[test]
    fn what_both_see_is_the_cubic_sample_and_differentiable() {
        let (target, source) = (Camera::at(0.2, 0.0), Camera::at(-0.1, 0.1));
        let warp = Warp::new(&surface(target, false), &surface(source, false), SIDE);
        let values =
            |phase: f64| -> Vec<f64> { (0..2 * SIDE * SIDE).map(|i| (i as f64 * 0.37 + phase).sin()).collect() };
        let picture = |values: &[f64]| Tensor::new(values, &Device::Cpu).unwrap().reshape((1, 2, SIDE, SIDE)).unwrap();
        let (first, second) = (values(0.0), values(1.0));
        let [own, found] = warp.seen_by_both(&picture(&first), &picture(&second)).unwrap().unwrap();
        let (own, found) = (own.to_vec2::<f64>().unwrap(), found.to_vec2::<f64>().unwrap());
        let raster = Raster::from_tensor(&picture(&second)).unwrap();
        for (place, (index, point)) in warp.visible().enumerate() {
            assert_eq!(own[1][place], first[SIDE * SIDE + index]);
            // Weights are f32 in the tensor.
            assert!((found[1][place] - raster.cubic(1, point)).abs() < 1e-6);
        }
        // The gradient of Σ found² in one pixel of the source against a central difference.
        let variable = candle_core::Var::from_tensor(&picture(&second)).unwrap();
        let loss = |source: &Tensor| {
            let [_, found] = warp.seen_by_both(&picture(&first), source).unwrap().unwrap();
            found.sqr().unwrap().sum_all().unwrap()
        };
        let gradients = loss(variable.as_tensor()).backward().unwrap();
        let gradient = gradients.get(variable.as_tensor()).unwrap().flatten_all().unwrap().to_vec1::<f64>().unwrap();
        let pixel = SIDE * SIDE / 2 + SIDE / 2;
        let at = |step: f64| {
            let mut moved = second.clone();
            moved[pixel] += step;
            loss(&picture(&moved)).to_scalar::<f64>().unwrap()
        };
        let difference = (at(1e-4) - at(-1e-4)) / 2e-4;
        assert!((gradient[pixel] - difference).abs() < 1e-5 * difference.abs(), "{} {difference}", gradient[pixel]);
    }

    #[test]
    fn hidden_pixels_are_left_out() {
        let (target, source) = (Camera::at(-0.25, 0.0), Camera::at(0.25, 0.0));
        let (target_surface, source_surface) = (surface(target, true), surface(source, true));
        let warp = Warp::new(&target_surface, &source_surface, SIDE);
        let mut checked = [0; 2];
        for (index, place) in warp.places.iter().enumerate() {
            let (depth, near) = hit(&target, centre(index, SIDE), true);
            let (point, expected) = source.project(world(&target, centre(index, SIDE), depth)).unwrap();
            if point.iter().any(|value| value.abs() > 0.95) {
                continue;
            }
            let (found, seen_near) = hit(&source, point, true);
            // Pixels at the occluder's edge mix both planes and may fall either way.
            let edge = [-0.06, 0.06].iter().any(|step| hit(&source, [point[0] + step, point[1]], true).1 != seen_near);
            let visible = (found - expected).abs() < 1e-9;
            if !edge && (visible || (found - expected).abs() > DEPTH_TOLERANCE) {
                assert_eq!(place.is_some(), visible, "{index} {near}");
                checked[usize::from(visible)] += 1;
            }
        }
        assert!(checked.iter().all(|count| *count > 20), "{checked:?}");
    }
}
