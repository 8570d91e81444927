//! Pictures of a portrait: one ray through every pixel's centre, more where neighbours differ.

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{
    backdrop::Backdrop,
    clothes, hair, head,
    identity::Identity,
    palette::encode,
    scene::{BOUND, Builder, Scene, WORLD_PER_UNIT, gradient},
    shade::{Exposure, Studio, Surface},
};
use crate::{
    camera::{Camera, FAR, NEAR},
    region::Region,
};

/// Rays cast through a pixel on an edge before it is judged.
const PROBES: usize = 3;
/// Differences of colour that need no more rays.
const FLAT: f32 = 0.035;

/// How pictures are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RenderOptions {
    /// Further rays through a pixel at whose border label, depth, normal or colour change; 0 draws without
    /// anti-aliasing.
    pub edge_samples: usize,
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self { edge_samples: 11 }
    }
}

/// A portrait seen by a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct CartoonPicture {
    /// Width and height, pixels.
    pub size: usize,
    /// sRGB, `[size, size, 3]`.
    pub rgb: Vec<u8>,
    /// Region of every pixel's centre, `[size, size]`.
    pub labels: Vec<u8>,
    /// Distance of the surface along the view axis at every pixel's centre, world units, `[size, size]`; the background's
    /// is [`FAR`].
    pub depth: Vec<f32>,
    /// Unit normal (world) at every pixel's centre, `[size, size, 3]`; zero on the background.
    pub normal: Vec<f32>,
}

/// An identity made solid, ready to be seen by any number of cameras.
#[derive(Debug)]
pub struct Portrait {
    scene: Scene,
    studio: Studio,
    backdrop: Backdrop,
}

/// What one ray sees.
#[derive(Clone, Copy)]
struct Sample {
    /// Display-referred linear light.
    colour: Vec3,
    region: Region,
    /// World units along the view axis.
    depth: f32,
    normal: Vec3,
    /// The surface's part and the light on it; none for the background.
    lit: Option<(usize, Exposure)>,
}

/// What is the same for all rays of a picture.
struct Shot<'a> {
    camera: &'a Camera,
    size: usize,
    /// Width of a pixel at the head, head units.
    footprint: f32,
}

impl Portrait {
    /// Builds the solids.
    pub fn new(identity: &Identity) -> Self {
        let mut builder = Builder::default();
        let anatomy = head::build(&mut builder, identity);
        clothes::build(&mut builder, identity, &anatomy);
        hair::build(&mut builder, identity, &anatomy);
        Self {
            scene: builder.finish(),
            studio: Studio::new(identity, anatomy),
            backdrop: Backdrop::new(&identity.background),
        }
    }

    /// The picture `camera` takes, `size` pixels square. The same bytes at any number of threads.
    pub fn render(&self, camera: &Camera, size: usize, options: &RenderOptions) -> CartoonPicture {
        let half_tangent = (0.5 * camera.field_of_view_rad).tan() / camera.zoom;
        let footprint = (2.0 * half_tangent / size as f64 / f64::from(WORLD_PER_UNIT)) as f32;
        let shot = Shot { camera, size, footprint };
        let place = |index: usize| (index % size, index / size);
        let centres: Vec<Sample> = (0..size * size)
            .into_par_iter()
            .with_min_len(size.max(1))
            .map(|index| {
                let (x, y) = place(index);
                self.sample(&shot, x as f64 + 0.5, y as f64 + 0.5, &[])
            })
            .collect();
        let colours: Vec<[u8; 3]> = (0..size * size)
            .into_par_iter()
            .with_min_len(size.max(1))
            .map(|index| {
                let (x, y) = place(index);
                let light = self.filtered(&shot, &centres, x, y, options);
                encode(light).map(|value| (255.0 * value + 0.5) as u8)
            })
            .collect();
        CartoonPicture {
            size,
            rgb: colours.into_iter().flatten().collect(),
            labels: centres.iter().map(|sample| sample.region as u8).collect(),
            depth: centres.iter().map(|sample| sample.depth).collect(),
            normal: centres.iter().flat_map(|sample| sample.normal.to_array()).collect(),
        }
    }

    /// A pixel's light: its centre's, or the mean over the pixel where something ends in it.
    fn filtered(&self, shot: &Shot, centres: &[Sample], x: usize, y: usize, options: &RenderOptions) -> Vec3 {
        let size = shot.size;
        let around = [
            (x, y),
            (x.saturating_sub(1), y),
            ((x + 1).min(size - 1), y),
            (x, y.saturating_sub(1)),
            (x, (y + 1).min(size - 1)),
        ]
        .map(|(x, y)| centres[y * size + x]);
        let centre = around[0];
        if options.edge_samples == 0 || !around.iter().any(|there| centre.differs_from(there)) {
            return centre.colour;
        }
        // A few rays tell whether the border really crosses this pixel; only then all are cast.
        let (mut low, mut high, mut sum, mut count) = (centre.colour, centre.colour, centre.colour, 1);
        for number in 0..options.edge_samples {
            if number == PROBES && (high - low).max_element() < FLAT {
                break;
            }
            let (dx, dy) = spread(number);
            let colour = self.sample(shot, x as f64 + dx, y as f64 + dy, &around).colour;
            (low, high) = (low.min(colour), high.max(colour));
            sum += colour;
            count += 1;
        }
        sum / count as f32
    }

    /// What is seen through a point of the picture, in pixels from the upper left corner. The light on a surface is taken
    /// from `known` samples next to it if they lie on the same surface.
    fn sample(&self, shot: &Shot, x: f64, y: f64, known: &[Sample]) -> Sample {
        let half = 0.5 * shot.size as f64;
        let (origin, direction) = shot.camera.ray(x / half - 1.0, 1.0 - y / half);
        let (origin, direction) = (DVec3::from_array(origin), DVec3::from_array(direction));
        // Directions have unit depth: lengths along the ray are depths times this.
        let stretch = direction.length();
        let unit = direction / stretch;
        // From the point closest to the head, so that single precision is spent on the head.
        let closest_along = -origin.dot(unit);
        let closest = ((origin + closest_along * unit) / f64::from(WORLD_PER_UNIT)).as_vec3();
        let direction = unit.as_vec3();
        let reach_squared = BOUND * BOUND - closest.length_squared();
        let hit = (reach_squared > 0.0).then(|| {
            let reach = reach_squared.sqrt();
            // Between known samples nothing stands out farther than this.
            let nearest = known.iter().map(|sample| sample.depth).fold(f32::MAX, f32::min);
            let start = if known.is_empty() {
                -reach
            } else {
                let along = (f64::from(nearest) * stretch - closest_along) / f64::from(WORLD_PER_UNIT);
                (along as f32 - 0.12).max(-reach)
            };
            let tolerance = (0.06 * shot.footprint).clamp(2e-4, 1.5e-3);
            self.scene.trace(closest, direction, (start, reach), tolerance)
        });
        let surface = hit.flatten().and_then(|along| self.surface(closest, direction, along, shot.footprint));
        let Some((surface, along)) = surface else {
            let far = origin + FAR * stretch * unit;
            return Sample {
                colour: self.backdrop.colour(far.as_vec3().normalize_or(Vec3::NEG_Z)),
                region: Region::Background,
                depth: FAR as f32,
                normal: Vec3::ZERO,
                lit: None,
            };
        };
        let depth = (closest_along + f64::from(along * WORLD_PER_UNIT)) / stretch;
        let depth = depth.clamp(NEAR, FAR) as f32;
        let exposure = known
            .iter()
            .find_map(|sample| {
                let (part, exposure) = sample.lit?;
                let close = (sample.depth - depth).abs() < 3.0 * shot.footprint * WORLD_PER_UNIT;
                (part == surface.part && close && sample.normal.dot(surface.normal) > 0.93).then_some(exposure)
            })
            .unwrap_or_else(|| Studio::exposure(&self.scene, &surface));
        Sample {
            colour: self.studio.shade(&self.scene, &surface, exposure),
            region: self.scene.part(surface.part).region,
            depth,
            normal: surface.normal,
            lit: Some((surface.part, exposure)),
        }
    }

    /// The surface a ray hit, and its refined distance along the ray.
    fn surface(&self, origin: Vec3, direction: Vec3, along: f32, footprint: f32) -> Option<(Surface, f32)> {
        let point = origin + along * direction;
        // Differences over half a pixel smooth what a pixel cannot show.
        let step = (0.35 * footprint).clamp(0.0015, 0.01);
        let (slope, distance) = gradient(point, step, |point| self.scene.distance(point));
        let normal = slope.normalize_or(-direction);
        // What is left to the surface, taken along the ray where it does not graze.
        let towards = -normal.dot(direction);
        let rest = distance / slope.length().max(0.3);
        let along = along + if towards > 0.25 { (rest / towards).clamp(-0.01, 0.01) } else { 0.0 };
        let point = origin + along * direction;
        let part = self.scene.part_at(point)?;
        Some((Surface { point, normal, to_eye: -direction, footprint, part }, along))
    }
}

impl Sample {
    /// Whether two neighbours differ by more than smooth shading does.
    fn differs_from(&self, there: &Self) -> bool {
        self.region != there.region
            || (self.depth - there.depth).abs() > 0.004
            || (self.lit.is_some() && self.normal.dot(there.normal) < 0.8)
            || (self.colour - there.colour).abs().max_element() > 0.09
    }
}

/// Points spread evenly over the unit square: Roberts' R2 sequence.
fn spread(number: usize) -> (f64, f64) {
    let step = number as f64 + 1.0;
    ((0.5 + 0.754_877_666_246_693 * step).fract(), (0.5 + 0.569_840_290_998_053_2 * step).fract())
}
