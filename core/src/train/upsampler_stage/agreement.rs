//! What the upsampler adds must stay on the surface when the head turns: two views of a random portrait, one carried to
//! the other by the rendered depth, are to show the same colours where both see the head.
//!
//! Without it the network draws detail where the screen's pixels happen to fall; an orbit then crawls. The warp itself
//! is exact but for the render's depth, so that sharp detail costs nothing as long as it agrees.

use candle_core::Tensor;

use crate::{
    camera::Camera,
    error::Result,
    eval::warp::{Surface, Warp},
    render::Frame,
    rng::Stream,
};

/// Views of each random portrait.
pub(super) const VIEWS: usize = 2;

/// A camera turned from `camera` by up to `largest_turn_rad`. Small turns are drawn more often: there the same pixels
/// of the surface are compared, and an orbit's neighbouring frames differ by as little.
pub(super) fn turned(camera: Camera, largest_turn_rad: f64, random: &mut Stream) -> Camera {
    let share = f64::from(random.range(-1.0, 1.0));
    Camera { azimuth_rad: camera.azimuth_rad + largest_turn_rad * share * share.abs(), ..camera }
}

/// Mean absolute difference between the two views of each person where both see the head, each carried to the other.
/// `pictures` is `[VIEWS · people, 3, S, S]`, a person's views in a row; none if no pair shows a common surface.
pub(super) fn disagreement(pictures: &Tensor, frame: &Frame, cameras: &[Camera]) -> Result<Option<Tensor>> {
    let side = pictures.dim(2)?;
    let surface =
        |index: usize| Surface::new(cameras[index], &frame.try_map(|picture| Ok(picture.narrow(0, index, 1)?))?);
    let mut differences = Vec::new();
    for first in (0..cameras.len() / VIEWS).map(|person| VIEWS * person) {
        let surfaces = [surface(first)?, surface(first + 1)?];
        let views = [pictures.narrow(0, first, 1)?, pictures.narrow(0, first + 1, 1)?];
        for (target, source) in [(0, 1), (1, 0)] {
            let warp = Warp::new(&surfaces[target], &surfaces[source], side);
            if let Some([own, found]) = warp.seen_by_both(&views[target], &views[source])? {
                differences.push((own - found)?.abs()?.mean_all()?);
            }
        }
    }
    if differences.is_empty() {
        return Ok(None);
    }
    Ok(Some(Tensor::stack(&differences, 0)?.mean_all()?))
}
