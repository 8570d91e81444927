//! What stands behind a portrait: soft colours on a sphere around it, so that they turn as cameras move.

use glam::{Vec3, vec3};

use super::{
    identity::{Background, BackgroundKind},
    palette::linear,
};
use crate::rng::Stream;

/// A soft-edged disc on the sphere.
#[derive(Clone, Copy, Debug)]
struct Disc {
    direction: Vec3,
    /// Cosine of the angular radius.
    rim: f32,
    /// Width of the edge, in cosine.
    edge: f32,
    colour: Vec3,
    opacity: f32,
}

/// A backdrop ready to be looked at.
#[derive(Clone, Debug)]
pub(super) struct Backdrop {
    kind: BackgroundKind,
    lower: Vec3,
    upper: Vec3,
    accent: Vec3,
    discs: Vec<Disc>,
    phases: [f32; 2],
}

impl Backdrop {
    /// Places the shapes.
    pub fn new(background: &Background) -> Self {
        let mut stream = Stream::new(background.arrangement, &[0xbac0]);
        let (lower, upper, accent) = (linear(background.lower), linear(background.upper), linear(background.accent));
        let mut discs = Vec::new();
        match background.kind {
            BackgroundKind::Bokeh => {
                for _ in 0..34 {
                    let azimuth = stream.range(-3.1, 3.1);
                    let height = stream.range(-0.75, 0.85);
                    let ring = (1.0 - height * height).sqrt();
                    let radius = stream.range(0.07, 0.2);
                    let mix = stream.uniform();
                    discs.push(Disc {
                        direction: vec3(ring * azimuth.sin(), height, ring * azimuth.cos()),
                        rim: radius.cos(),
                        edge: radius.sin() * stream.range(0.03, 0.08),
                        colour: accent.lerp(upper, 0.5 * mix),
                        opacity: stream.range(0.12, 0.42),
                    });
                }
            }
            BackgroundKind::Hills => {
                let azimuth = 3.1 + stream.range(-0.5, 0.5);
                let direction = vec3(azimuth.sin(), stream.range(0.28, 0.55), azimuth.cos()).normalize();
                discs.push(Disc { direction, rim: 0.965, edge: 0.012, colour: accent, opacity: 0.9 });
            }
            BackgroundKind::Flat | BackgroundKind::Gradient => {}
        }
        let phases = [stream.range(0.0, std::f32::consts::TAU), stream.range(0.0, std::f32::consts::TAU)];
        Self { kind: background.kind, lower, upper, accent, discs, phases }
    }

    /// Linear colour in a unit direction from the origin.
    pub fn colour(&self, direction: Vec3) -> Vec3 {
        let height = 0.5 + 0.75 * direction.y;
        let gradient = self.lower.lerp(self.upper, smooth_step(0.05, 0.95, height));
        let mut colour = match self.kind {
            BackgroundKind::Flat => {
                self.upper.lerp(self.lower, 0.35 * smooth_step(0.75, 0.0, (direction.y - 0.05).abs()))
            }
            _ => gradient,
        };
        for disc in &self.discs {
            let cosine = direction.dot(disc.direction);
            if cosine > disc.rim - disc.edge {
                let share = smooth_step(disc.rim - disc.edge, disc.rim + disc.edge, cosine);
                colour = colour.lerp(disc.colour, share * disc.opacity);
            }
        }
        if self.kind == BackgroundKind::Hills {
            let azimuth = direction.x.atan2(direction.z);
            for (layer, &phase) in self.phases.iter().enumerate() {
                let layer = layer as f32;
                let ridge = -0.02 - 0.2 * layer
                    + 0.09 * (3.0 * azimuth + phase).sin()
                    + 0.05 * ((5.0 + 2.0 * layer) * azimuth + 2.0 * phase).sin();
                let share = smooth_step(0.02, -0.02, direction.y - ridge);
                let hill = self.upper.lerp(self.lower, 0.3).lerp(self.accent * 0.5, 0.12 + 0.1 * layer);
                colour = colour.lerp(hill * (0.62 - 0.16 * layer), share);
            }
        }
        colour
    }
}

/// Cubic step from 0 at `from` to 1 at `to`, which may lie either way.
#[inline]
pub(super) fn smooth_step(from: f32, to: f32, value: f32) -> f32 {
    let share = ((value - from) / (to - from)).clamp(0.0, 1.0);
    share * share * (3.0 - 2.0 * share)
}
