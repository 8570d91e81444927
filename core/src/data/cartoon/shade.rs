//! How a portrait is lit and coloured: a soft key light with shadow, sky and bounce, a warm rim from behind, skin that
//! glows where light wraps around it, strands of hair, wet eyes and lips.

use glam::{Vec3, vec3};

use super::{
    backdrop::smooth_step,
    head::Anatomy,
    identity::{Identity, Pattern},
    palette::linear,
    scene::{Flow, Material, Part, Scene},
    shape::Shape,
};

/// A point to shade, head units.
#[derive(Clone, Copy, Debug)]
pub(super) struct Surface {
    /// The point.
    pub point: Vec3,
    /// Unit normal.
    pub normal: Vec3,
    /// Unit direction to the eye.
    pub to_eye: Vec3,
    /// Width of a pixel at the point: what is finer is not drawn.
    pub footprint: f32,
    /// Index of the part.
    pub part: usize,
}

/// Colours of a portrait in linear light, and where its features are.
#[derive(Clone, Debug)]
pub(super) struct Studio {
    anatomy: Anatomy,
    skin: Vec3,
    blush: f32,
    freckles: f32,
    lips: Vec3,
    iris: Vec3,
    iris_rad: f32,
    pupil_rad: f32,
    upper_lid_rad: f32,
    brow: Vec3,
    hair: Vec3,
    accent: Vec3,
    garment: Vec3,
    trim: Vec3,
    pattern: Pattern,
    shoulders: f32,
}

/// How much light reaches a point.
#[derive(Clone, Copy, Debug)]
pub(super) struct Exposure {
    /// Share of the surroundings that is not blocked nearby.
    pub occlusion: f32,
    /// Share of the key light that is seen.
    pub key: f32,
}

/// Unit direction to the key light: above, in front, to the portrait's right.
fn key_direction() -> Vec3 {
    vec3(-0.465_99, 0.577_83, 0.671_03)
}

/// What a surface does with light.
struct Look {
    albedo: Vec3,
    normal: Vec3,
    /// Share of light that gets through from the lit side, by channel.
    wrap: Vec3,
    /// Strength and exponent of the highlight.
    gloss: (f32, f32),
    /// Direction of strands, for hair.
    strand: Option<Vec3>,
    /// Strength of the glow at grazing angles.
    sheen: f32,
}

impl Studio {
    /// Prepares an identity's colours.
    pub fn new(identity: &Identity, anatomy: Anatomy) -> Self {
        let skin = linear(identity.face.skin);
        let natural = skin * vec3(0.94, 0.58, 0.56);
        let lips = natural.lerp(linear(identity.mouth.lip_colour), identity.mouth.tint.clamp(0.0, 1.0));
        Self {
            skin,
            blush: identity.face.blush,
            freckles: identity.face.freckles,
            lips,
            iris: linear(identity.eyes.iris),
            iris_rad: identity.eyes.iris_rad,
            pupil_rad: identity.eyes.iris_rad * identity.eyes.pupil,
            upper_lid_rad: identity.eyes.upper_lid_rad,
            brow: linear(identity.eyebrows.colour),
            hair: linear(identity.hair.colour),
            accent: linear(identity.hair.accent),
            garment: linear(identity.neck.colour),
            trim: linear(identity.neck.trim),
            pattern: identity.neck.pattern,
            shoulders: identity.neck.shoulders,
            anatomy,
        }
    }

    /// How much light reaches a surface: the costly part of shading, the same for all rays through a pixel that meet the
    /// same surface.
    pub fn exposure(scene: &Scene, surface: &Surface) -> Exposure {
        let facing = surface.normal.dot(key_direction());
        let lifted = surface.point + 0.035 * surface.normal;
        Exposure {
            occlusion: ambient_occlusion(scene, surface.point, surface.normal),
            key: if facing > -0.35 { scene.visibility(lifted, key_direction(), 5.5) } else { 0.0 },
        }
    }

    /// Display-referred linear colour of a surface, in [0, 1].
    pub fn shade(&self, scene: &Scene, surface: &Surface, exposure: Exposure) -> Vec3 {
        let part = scene.part(surface.part);
        let look = self.look(part, surface);
        let normal = look.normal;
        let key = key_direction();
        let Exposure { mut occlusion, key: mut visible } = exposure;
        if part.material == Material::Teeth {
            // Light that bounces about in the mouth keeps teeth white.
            (occlusion, visible) = (occlusion.max(0.75), visible.max(0.6));
        }
        let facing = surface.normal.dot(key);

        // Light wraps farthest in the channel that skin scatters most; shadows keep some of it.
        let wrapped = |light: Vec3| {
            let cosine = normal.dot(light);
            ((Vec3::splat(cosine) + look.wrap) / (Vec3::ONE + look.wrap)).max(Vec3::ZERO)
        };
        let shadow = Vec3::splat(visible).powf_each(Vec3::ONE - 0.9 * look.wrap);
        let occluded = Vec3::splat(occlusion).powf_each(Vec3::ONE - 1.1 * look.wrap);
        let key_light = vec3(2.05, 1.93, 1.76) * wrapped(key) * shadow;
        let fill = vec3(0.34, 0.37, 0.44) * wrapped(vec3(0.75, 0.15, 0.65).normalize());
        let sky = vec3(0.62, 0.68, 0.78) * (0.5 + 0.5 * normal.y);
        let bounce = vec3(0.36, 0.3, 0.26) * (0.5 - 0.5 * normal.y);
        let back = vec3(0.55, 0.25, -0.8).normalize();
        let grazing = (1.0 - normal.dot(surface.to_eye).clamp(0.0, 1.0)).powi(3);
        let rim = vec3(1.2, 1.0, 0.8)
            * (wrapped(back) * 0.35 + Vec3::splat(grazing * look.sheen * (0.4 + 0.6 * normal.y.max(0.0))));
        let mut light = look.albedo * (key_light + (fill + sky + bounce) * occluded + rim * occlusion);

        let (strength, exponent) = look.gloss;
        if strength > 0.0 {
            let halfway = (key + surface.to_eye).normalize_or(key);
            let highlight = match look.strand {
                Some(strand) => {
                    let across = |shift: f32, exponent: f32| {
                        let cosine = (strand + shift * normal).normalize_or(strand).dot(halfway);
                        (1.0 - cosine * cosine).max(0.0).powf(0.5 * exponent)
                    };
                    let lit = smooth_step(-0.2, 0.5, facing);
                    (look.albedo.powf_each(Vec3::splat(0.5)) * across(0.1, exponent) * 0.8
                        + Vec3::splat(0.25 * across(-0.12, 3.0 * exponent)))
                        * lit
                }
                None => {
                    let cosine = normal.dot(halfway).max(0.0);
                    Vec3::splat(cosine.powf(exponent) * f32::from(u8::from(facing > 0.0)))
                }
            };
            light += highlight * strength * (0.25 + 0.75 * visible) * vec3(1.5, 1.45, 1.35) * occlusion;
        }
        if let Material::Eyeball(_) = part.material {
            light = self.wet_eye(part, surface, light);
        }
        tone(light)
    }

    fn look(&self, part: &Part, surface: &Surface) -> Look {
        let plain = Look {
            albedo: Vec3::ONE,
            normal: surface.normal,
            wrap: Vec3::splat(0.12),
            gloss: (0.0, 1.0),
            strand: None,
            sheen: 0.25,
        };
        let skin_wrap = vec3(0.42, 0.24, 0.18);
        match part.material {
            Material::Skin => Look {
                albedo: self.skin_albedo(surface.point),
                wrap: skin_wrap,
                gloss: (0.07, 14.0),
                sheen: 0.35,
                ..plain
            },
            Material::Lip => Look { albedo: self.lips, wrap: skin_wrap, gloss: (0.3, 42.0), ..plain },
            Material::MouthInside => Look { albedo: vec3(0.14, 0.025, 0.03), sheen: 0.0, ..plain },
            Material::Teeth => {
                Look { albedo: vec3(0.9, 0.87, 0.8), wrap: Vec3::splat(0.5), gloss: (0.2, 40.0), sheen: 0.0, ..plain }
            }
            Material::Tongue => {
                Look { albedo: vec3(0.62, 0.17, 0.17), wrap: skin_wrap, gloss: (0.15, 24.0), sheen: 0.0, ..plain }
            }
            Material::Eyeball(side) => Look {
                albedo: self.eye_albedo(usize::from(side), surface.point),
                wrap: Vec3::splat(0.3),
                gloss: (0.0, 1.0),
                sheen: 0.0,
                ..plain
            },
            Material::Lash => Look { albedo: Vec3::splat(0.012), sheen: 0.05, ..plain },
            Material::Brow => {
                Look { albedo: self.brow, gloss: (0.04, 10.0), wrap: Vec3::splat(0.25), sheen: 0.15, ..plain }
            }
            Material::Stubble => {
                let grain = fade(0.05, surface.footprint) * (noise3(surface.point * 34.0) - 0.5);
                Look { albedo: self.hair.lerp(self.skin, 0.16) * (1.0 + 0.7 * grain), gloss: (0.04, 8.0), ..plain }
            }
            Material::Hair => self.strands(part, surface, self.hair, plain),
            Material::HairAccent => {
                let mut albedo = self.accent;
                if let Flow::Meridian { origin, axis } = part.flow {
                    let (angle, _) = meridian(surface.point - origin, axis);
                    let rib = 0.5 + 0.5 * (angle * 44.0).sin();
                    albedo *= 1.0 - 0.3 * fade(0.13, surface.footprint) * rib * rib;
                }
                Look { albedo, wrap: Vec3::splat(0.3), sheen: 0.5, ..plain }
            }
            Material::Garment => Look {
                albedo: self.cloth(surface.point, surface.footprint),
                wrap: Vec3::splat(0.22),
                sheen: 0.45,
                ..plain
            },
            Material::Trim => Look { albedo: self.trim, wrap: Vec3::splat(0.22), sheen: 0.4, ..plain },
            Material::Metal => Look { albedo: vec3(0.9, 0.68, 0.3), gloss: (1.2, 30.0), sheen: 0.6, ..plain },
        }
    }

    /// Skin: flushed cheeks, nose and ears, freckles.
    fn skin_albedo(&self, point: Vec3) -> Vec3 {
        let anatomy = &self.anatomy;
        let beside = vec3(point.x.abs(), point.y, point.z);
        let near = |centre: Vec3, radius: f32, at: Vec3| (-(at - centre).length_squared() / (radius * radius)).exp();
        let cheek_centre = anatomy.cheek + vec3(0.16, -0.1, 0.2);
        let cheek = near(cheek_centre, 0.21, beside);
        let nose = near(anatomy.nose_tip, 0.16, point);
        let ear = smooth_step(0.86, 1.1, beside.x) * smooth_step(-0.6, -0.4, point.y);
        let flush = (self.blush * (0.8 * cheek + 0.3 * nose) + 0.3 * ear).min(1.0);
        let mut albedo = self.skin.lerp(self.skin * vec3(1.12, 0.68, 0.66), flush);
        if self.freckles > 0.0 {
            let where_freckles = near(cheek_centre + vec3(-0.08, 0.05, 0.0), 0.28, beside)
                .max(0.9 * near(anatomy.nose_tip + vec3(0.0, 0.12, 0.0), 0.22, point));
            let spots = freckle(point.x * 15.0, point.y * 15.0);
            albedo = albedo.lerp(self.skin * vec3(0.62, 0.4, 0.3), 0.75 * self.freckles * spots * where_freckles);
        }
        albedo
    }

    /// White, limbal ring, iris with fibres, pupil.
    fn eye_albedo(&self, side: usize, point: Vec3) -> Vec3 {
        let eye = &self.anatomy.eyes[side.min(1)];
        let direction = (point - eye.centre).normalize_or(Vec3::Z);
        let off_axis = direction.dot(eye.gaze).clamp(-1.0, 1.0).acos();
        let white = vec3(0.9, 0.9, 0.9);
        if off_axis > self.iris_rad + 0.03 {
            return white;
        }
        let up = (eye.axes.y_axis - eye.gaze * eye.axes.y_axis.dot(eye.gaze)).normalize_or(Vec3::Y);
        let across = up.cross(eye.gaze);
        let (x, y) = (direction.dot(across), direction.dot(up));
        let angle = y.atan2(x);
        let fibres = 0.82 + 0.2 * noise1(angle * 7.0 + 3.0) + 0.1 * noise1(angle * 17.0);
        let share = off_axis / self.iris_rad;
        // Light enters above and comes out below: the lower half of the iris glows.
        let glow = 0.75 + 0.75 * smooth_step(0.5, -0.9, y / self.iris_rad.sin().max(0.05));
        let ring = smooth_step(0.78, 0.98, share);
        let iris = self.iris * fibres * glow * (1.0 - 0.78 * ring);
        let pupil = smooth_step(self.pupil_rad - 0.03, self.pupil_rad + 0.03, off_axis);
        let inner = Vec3::splat(0.006).lerp(iris, pupil);
        inner.lerp(white, smooth_step(self.iris_rad - 0.03, self.iris_rad + 0.03, off_axis))
    }

    /// Shade of the lid above, and the window's reflection: a large catchlight and its small echo.
    fn wet_eye(&self, part: &Part, surface: &Surface, light: Vec3) -> Vec3 {
        let Material::Eyeball(side) = part.material else { return light };
        let eye = &self.anatomy.eyes[usize::from(side).min(1)];
        let direction = (surface.point - eye.centre).normalize_or(Vec3::Z);
        let rise = direction.dot(eye.axes.y_axis).atan2(direction.dot(eye.axes.z_axis));
        let under_lid = smooth_step(self.upper_lid_rad, self.upper_lid_rad - 0.32, rise);
        let light = light * (0.55 + 0.45 * under_lid);
        // The catchlight moves with the eye's turn only half as far as the pupil, as on a real cornea.
        let middle = (eye.gaze + eye.axes.z_axis).normalize_or(eye.gaze);
        let spot = |across: f32, up: f32, radius: f32| {
            let centre = (middle + across * eye.axes.x_axis + up * eye.axes.y_axis).normalize_or(middle);
            let angle = direction.dot(centre).clamp(-1.0, 1.0).acos();
            smooth_step(radius * 1.12, radius * 0.85, angle)
        };
        let scale = self.iris_rad / 0.56;
        let catchlight = spot(-0.2 * scale, 0.24 * scale, 0.15 * scale);
        let echo = 0.5 * spot(0.2 * scale, -0.22 * scale, 0.075 * scale);
        light.lerp(Vec3::splat(1.6), catchlight.max(echo))
    }

    /// Bands of strands: colour, bent normals and direction of the highlight.
    fn strands(&self, part: &Part, surface: &Surface, colour: Vec3, plain: Look) -> Look {
        let beside =
            if part.mirrored { vec3(surface.point.x.abs(), surface.point.y, surface.point.z) } else { surface.point };
        let (axis, across, along) = match (&part.shape, part.flow) {
            (Shape::Lock(lock), _) => {
                let place = lock.place(beside);
                (place.tangent, place.angle_rad * 0.16 + 0.37 * (surface.part % 13) as f32, place.arc)
            }
            (_, Flow::None) => {
                // Curls: soft swirls.
                let swirl =
                    noise3(surface.point * 7.0) + 0.5 * fade(0.07, surface.footprint) * noise3(surface.point * 15.0);
                let albedo = colour * (0.72 + 0.36 * swirl);
                return Look { albedo, wrap: Vec3::splat(0.25), gloss: (0.1, 12.0), sheen: 0.35, ..plain };
            }
            (_, Flow::Meridian { origin, axis }) => {
                let from = (if part.mirrored { surface.point } else { beside }) - origin;
                let (angle, rise) = meridian(from, axis);
                (axis, angle * 0.9, rise)
            }
            (_, Flow::Along { origin, axis }) => {
                let from = beside - origin;
                let (angle, _) = meridian(from, axis);
                (axis, angle * 0.17 + 0.37 * (surface.part % 13) as f32, from.dot(axis))
            }
        };
        let direction = (axis - surface.normal * axis.dot(surface.normal)).normalize_or(axis);
        let side = surface.normal.cross(direction);
        let octaves = [(0.22, 0.5), (0.095, 0.35), (0.042, 0.22)];
        let pattern = |across: f32| {
            octaves
                .iter()
                .map(|&(wavelength, weight)| {
                    weight
                        * fade(wavelength, surface.footprint)
                        * (noise2(across / wavelength, along * 0.8 + 9.0 * wavelength) - 0.5)
                })
                .sum::<f32>()
        };
        let here = pattern(across);
        let slope = (pattern(across + 0.006) - here) / 0.006;
        let normal = (surface.normal - 0.035 * slope.clamp(-9.0, 9.0) * side).normalize_or(surface.normal);
        Look {
            albedo: colour * (1.0 + 0.75 * here),
            normal,
            wrap: Vec3::splat(0.2),
            gloss: (0.24, 24.0),
            strand: Some((direction + 0.25 * here * surface.normal).normalize_or(direction)),
            sheen: 0.4,
        }
    }

    fn cloth(&self, point: Vec3, footprint: f32) -> Vec3 {
        match self.pattern {
            Pattern::Plain => self.garment,
            Pattern::Stripes => {
                let level = (point.y * 4.6 + 0.25 * point.z).rem_euclid(1.0);
                let edge = (3.0 * footprint).clamp(0.02, 0.2);
                let stripe = smooth_step(0.3 - edge, 0.3 + edge, (level - 0.5).abs());
                self.trim.lerp(self.garment, 1.0 - stripe)
            }
            Pattern::Dots => {
                let (u, v) =
                    (point.x * 5.0 + if (point.y * 5.0).floor() as i32 % 2 == 0 { 0.5 } else { 0.0 }, point.y * 5.0);
                let (du, dv) = (u - u.floor() - 0.5, v - v.floor() - 0.5);
                let dot = smooth_step(0.27, 0.2, (du * du + dv * dv).sqrt());
                self.garment.lerp(self.trim, dot)
            }
            Pattern::Raglan => {
                let line = point.x.abs() - 0.62 * self.shoulders - 0.32 * (-1.62 - point.y);
                self.garment.lerp(self.trim, smooth_step(-0.01, 0.01, line))
            }
            Pattern::Ribs => {
                let angle = point.x.atan2(point.z + 0.24);
                let rib = 0.5 + 0.5 * (angle * 38.0).sin();
                self.garment * (1.0 - 0.28 * fade(0.1, footprint) * rib * rib)
            }
        }
    }
}

/// Component-wise powers.
trait PowEach {
    fn powf_each(self, exponent: Vec3) -> Vec3;
}

impl PowEach for Vec3 {
    #[inline]
    fn powf_each(self, exponent: Vec3) -> Vec3 {
        vec3(self.x.powf(exponent.x), self.y.powf(exponent.y), self.z.powf(exponent.z))
    }
}

/// How much of the sky is open above a surface: distances along the normal, compared to what they would be in the open.
fn ambient_occlusion(scene: &Scene, point: Vec3, normal: Vec3) -> f32 {
    let mut blocked = 0.0;
    let mut weight = 1.0;
    for (step, height) in [0.035, 0.09, 0.18, 0.32].into_iter().enumerate() {
        let above = point + height * normal;
        let distance = if step < 1 { scene.distance(above) } else { scene.soft_distance(above) }.min(height);
        blocked += weight * (height - distance) / height;
        weight *= 0.72;
    }
    let open = 1.0 - 0.33 * blocked;
    open.clamp(0.12, 1.0)
}

/// Khronos PBR Neutral tone mapping: true colours up to a shoulder, highlights that fade to white.
fn tone(light: Vec3) -> Vec3 {
    const SHOULDER: f32 = 0.72;
    const DESATURATION: f32 = 0.12;
    let peak = light.max_element();
    if peak < SHOULDER {
        return light.max(Vec3::ZERO);
    }
    let room = 1.0 - SHOULDER;
    let compressed = 1.0 - room * room / (peak + room - SHOULDER);
    let share = 1.0 - 1.0 / (DESATURATION * (peak - compressed) + 1.0);
    (light * (compressed / peak)).lerp(Vec3::splat(compressed), share).max(Vec3::ZERO)
}

/// How strongly a texture of this wavelength may be drawn at a pixel's footprint.
fn fade(wavelength: f32, footprint: f32) -> f32 {
    smooth_step(1.6, 4.0, wavelength / footprint.max(1e-6))
}

/// Angle around an axis, and cosine of the angle to it.
fn meridian(from: Vec3, axis: Vec3) -> (f32, f32) {
    let (first, second) = axis.any_orthonormal_pair();
    (from.dot(first).atan2(from.dot(second)), from.normalize_or(axis).dot(axis))
}

fn hash(x: i32, y: i32, z: i32) -> f32 {
    let mut state = (x as u32).wrapping_mul(0x8da6_b343)
        ^ (y as u32).wrapping_mul(0xd816_3841)
        ^ (z as u32).wrapping_mul(0xcb1a_b31f);
    state ^= state >> 15;
    state = state.wrapping_mul(0x2c1b_3c6d);
    state ^= state >> 12;
    state = state.wrapping_mul(0x297a_2d39);
    state ^= state >> 15;
    (state >> 8) as f32 / (1u32 << 24) as f32
}

fn ease(value: f32) -> f32 {
    value * value * (3.0 - 2.0 * value)
}

fn mix(from: f32, to: f32, share: f32) -> f32 {
    from + share * (to - from)
}

/// Value noise in [0, 1].
fn noise1(x: f32) -> f32 {
    noise2(x, 0.5)
}

/// Value noise in [0, 1].
fn noise2(x: f32, y: f32) -> f32 {
    let (cell_x, cell_y) = (x.floor(), y.floor());
    let (u, v) = (ease(x - cell_x), ease(y - cell_y));
    let at = |dx: i32, dy: i32| hash(cell_x as i32 + dx, cell_y as i32 + dy, 17);
    mix(mix(at(0, 0), at(1, 0), u), mix(at(0, 1), at(1, 1), u), v)
}

/// Value noise in [0, 1].
fn noise3(point: Vec3) -> f32 {
    let cell = point.floor();
    let [u, v, w] = (point - cell).to_array().map(ease);
    let [x, y, z] = cell.to_array().map(|value| value as i32);
    let plane = |dz: i32| {
        let at = |dx: i32, dy: i32| hash(x + dx, y + dy, z + dz);
        mix(mix(at(0, 0), at(1, 0), u), mix(at(0, 1), at(1, 1), u), v)
    };
    mix(plane(0), plane(1), w)
}

/// Small round spots, one to a cell, some cells without.
fn freckle(x: f32, y: f32) -> f32 {
    let (cell_x, cell_y) = (x.floor() as i32, y.floor() as i32);
    let mut spots = 0.0f32;
    for dy in -1..=1 {
        for dx in -1..=1 {
            let (column, row) = (cell_x + dx, cell_y + dy);
            if hash(column, row, 3) < 0.35 {
                continue;
            }
            let centre = (column as f32 + hash(column, row, 1), row as f32 + hash(column, row, 2));
            let distance = ((x - centre.0).powi(2) + (y - centre.1).powi(2)).sqrt();
            spots = spots.max(smooth_step(0.34, 0.14, distance));
        }
    }
    spots
}
