//! Hair styles: a cap over the skull with the face cut free, and locks, curls, tails and buns on it.

use std::f32::consts::PI;

use glam::{Mat3, Vec3, vec3};

use super::{
    head::Anatomy,
    identity::{HairStyle, Identity},
    scene::{Builder, Flow, Material},
    shape::Shape,
};
use crate::{region::Region, rng::Stream};

/// Directions of the spiral that spreads points evenly over a sphere.
const GOLDEN_ANGLE: f32 = 2.399_963;

/// What the styles share while one is built.
struct Barber<'a> {
    builder: &'a mut Builder,
    anatomy: &'a Anatomy,
    volume: f32,
    length: f32,
    side: f32,
    hairline: f32,
    stream: Stream,
}

/// Adds the hair as one group; nothing for a bald head.
pub(super) fn build(builder: &mut Builder, identity: &Identity, anatomy: &Anatomy) {
    let hair = &identity.hair;
    builder.group().paint(Region::Hair, Material::Hair).mirrored(false);
    let mut barber = Barber {
        builder,
        anatomy,
        volume: hair.volume,
        length: hair.length,
        side: hair.side,
        hairline: hair.hairline,
        stream: Stream::new(hair.tousle, &[0x4a1a]),
    };
    match hair.style {
        HairStyle::Bald => {}
        HairStyle::Buzz => {
            barber.builder.paint(Region::Hair, Material::Stubble);
            barber.short_cap(0.04);
        }
        HairStyle::Crop => barber.crop(),
        HairStyle::SidePart => barber.side_part(),
        HairStyle::Quiff => barber.quiff(),
        HairStyle::Bowl => barber.bowl(),
        HairStyle::Curly => barber.curls(0.185, 130, -0.25),
        HairStyle::Afro => barber.curls(0.27, 80, -0.5),
        HairStyle::Bun => barber.bun(),
        HairStyle::Bob => barber.bob(hair.fringe),
        HairStyle::Long => barber.long(hair.fringe, 0.0),
        HairStyle::Wavy => barber.long(hair.fringe, 1.0),
        HairStyle::Ponytail => barber.ponytail(hair.fringe),
        HairStyle::Pigtails => barber.pigtails(hair.fringe),
        HairStyle::Braids => barber.braids(),
        HairStyle::Mohawk => barber.mohawk(),
        HairStyle::Spiky => barber.spiky(),
        HairStyle::Beanie => barber.beanie(),
    }
}

impl Barber<'_> {
    fn scalp(&self, polar_rad: f32, azimuth_rad: f32, lift: f32) -> Vec3 {
        self.anatomy.scalp(polar_rad, azimuth_rad, lift)
    }

    /// Strands that run from a pole (the crown, a bun, a parting's end) over the head.
    fn meridians(&mut self, axis: Vec3) {
        let origin = self.anatomy.skull;
        self.builder.flow(Flow::Meridian { origin, axis: axis.normalize_or(Vec3::Y) });
    }

    /// The skull, `thickness` larger, reaching down the back of the head.
    fn cap(&mut self, thickness: f32) {
        let anatomy = self.anatomy;
        self.builder.mirrored(true);
        self.builder.add(Shape::ellipsoid(anatomy.skull, anatomy.skull_radii + Vec3::splat(thickness)), 0.0);
        let nape = anatomy.skull + vec3(0.0, -0.42, -0.14);
        let radii = anatomy.skull_radii * vec3(0.84, 0.74, 0.76) + Vec3::splat(thickness);
        self.builder.add(Shape::ellipsoid(nape, radii), 0.1);
    }

    /// Cuts the face free: forehead, temples, cheeks.
    fn free_face(&mut self, sideways: f32) {
        let wide = self.anatomy.skull_radii.x / 0.92;
        let tall = self.anatomy.skull_radii.y / 0.92;
        let centre = vec3(0.0, -0.42, 0.78);
        let radii = vec3(0.93 * wide * sideways, 0.42 + 0.66 * tall + self.hairline, 0.86);
        self.builder.mirrored(true).cut(Shape::ellipsoid(centre, radii), 0.07);
    }

    /// Cuts everything under a plane that falls from the temples to the nape, and room for the ears.
    fn free_neck(&mut self, drop: f32) {
        let normal = vec3(0.0, -0.9, -0.36).normalize();
        let through = vec3(0.0, -0.62 - drop, -0.85);
        self.builder.cut(Shape::HalfSpace { normal: -normal, offset: -normal.dot(through) }, 0.08);
        let ear = vec3(self.anatomy.skull_radii.x, -0.12, 0.02);
        self.builder.cut(Shape::ellipsoid(ear, vec3(0.3, 0.26, 0.2)), 0.06);
    }

    /// A cap of short hair.
    fn short_cap(&mut self, thickness: f32) {
        self.cap(thickness);
        self.free_face(1.0);
        self.free_neck(0.0);
    }

    /// A lock over the scalp through (polar, azimuth, lift, radius).
    fn scalp_lock(&mut self, keys: &[(f32, f32, f32, f32)], blend: f32) {
        let knots: Vec<_> =
            keys.iter().map(|&(polar, azimuth, lift, radius)| (self.scalp(polar, azimuth, lift), radius)).collect();
        self.builder.mirrored(false).lock(&knots, 2, blend);
    }

    /// Locks over the forehead from one temple to the other.
    fn fringe(&mut self, down_to: f32) {
        for index in 0..9 {
            let across = (index as f32 - 4.0) / 4.0;
            let ragged = 0.05 * self.stream.range(-1.0, 1.0);
            let azimuth = 0.78 * across;
            let end = down_to + ragged - 0.06 * (1.0 - across.abs());
            self.scalp_lock(
                &[
                    (0.35, 0.9 * azimuth + 0.05 * self.side, -0.06, 0.12),
                    (0.85, azimuth, 0.1, 0.115),
                    (end, 1.08 * azimuth + 0.06 * self.side, 0.04, 0.05),
                ],
                0.07,
            );
        }
    }

    fn crop(&mut self) {
        self.meridians(vec3(0.0, 1.0, -0.35));
        self.short_cap(0.1 + 0.06 * self.volume);
        // Tufts combed to the front, row behind row.
        for row in 0..3 {
            let count = 7 - row;
            for index in 0..count {
                let across = 2.0 * index as f32 / (count - 1) as f32 - 1.0;
                let jitter = self.stream.range(-0.06, 0.06);
                let start = 0.82 - 0.34 * row as f32 + jitter;
                let azimuth = (0.72 + 0.1 * row as f32) * across + 0.4 * jitter;
                let lift = 0.12 + 0.1 * self.volume;
                self.scalp_lock(
                    &[
                        (start - 0.25, azimuth * 1.2, -0.05, 0.13),
                        (start + 0.12, azimuth * 1.05, lift + 0.03, 0.15),
                        (start + 0.4, azimuth + 0.12 * self.side, lift, 0.03),
                    ],
                    0.05,
                );
            }
        }
    }

    fn side_part(&mut self) {
        self.meridians(vec3(0.55 * self.side, 1.0, -0.2));
        self.short_cap(0.1 + 0.04 * self.volume);
        let side = self.side;
        let lift = 0.1 + 0.1 * self.volume;
        // Locks rise along the parting and fall over the other side.
        for index in 0..7 {
            let back = index as f32 / 6.0;
            let polar = 0.92 - 0.9 * back;
            let start_azimuth = side * (0.45 + 0.5 * back);
            let end_azimuth = -side * (0.75 + 1.1 * back);
            let end_polar = 1.08 + 0.12 * back + self.stream.range(-0.04, 0.04);
            self.scalp_lock(
                &[
                    (polar, start_azimuth, 0.0, 0.09),
                    (0.75 - 0.5 * back, side * 0.1, lift + 0.06, 0.17),
                    (0.85 - 0.2 * back, -side * (0.42 + 0.5 * back), lift + 0.04, 0.17),
                    (end_polar, end_azimuth, 0.04, 0.06),
                ],
                0.06,
            );
        }
        for index in 0..4 {
            let back = index as f32 / 3.0;
            self.scalp_lock(
                &[
                    (0.82 - 0.35 * back, side * (0.6 + 0.5 * back), 0.05, 0.09),
                    (1.02, side * (0.95 + 0.45 * back), 0.08, 0.11),
                    (1.35, side * (1.15 + 0.5 * back), 0.02, 0.05),
                ],
                0.06,
            );
        }
    }

    fn quiff(&mut self) {
        self.meridians(vec3(0.0, 0.5, -1.0));
        self.short_cap(0.07);
        let height = 0.26 + 0.2 * self.volume;
        for index in 0..7 {
            let across = (index as f32 - 3.0) / 3.0;
            let round = 1.0 - 0.45 * across * across;
            let jitter = self.stream.range(-0.04, 0.04);
            self.scalp_lock(
                &[
                    (0.93, 0.62 * across, 0.04, 0.1),
                    (0.78 + jitter, 0.68 * across, height * round, 0.16),
                    (0.45, 0.9 * across, (height - 0.02) * round, 0.17),
                    (0.1, 1.6 * across, 0.16 * round + 0.03, 0.15),
                    (-0.45, -0.55 * across, 0.06, 0.09),
                ],
                0.06,
            );
        }
    }

    fn bowl(&mut self) {
        self.meridians(Vec3::Y);
        self.cap(0.17 + 0.06 * self.volume);
        let centre = vec3(0.0, -0.75, 0.75);
        let edge = 0.36 + 0.25 * self.hairline;
        self.builder.mirrored(true).cut(
            Shape::RoundBox {
                centre: vec3(0.0, edge - 1.0, centre.z),
                local: Mat3::from_rotation_x(-0.05),
                half: vec3(1.6, 1.0, 0.75),
                round: 0.3,
            },
            0.06,
        );
        let below = vec3(0.0, -0.34 - 0.1 * self.length, 0.0);
        self.builder.cut(Shape::HalfSpace { normal: Vec3::Y, offset: below.y }, 0.08);
        let ear = vec3(self.anatomy.skull_radii.x, -0.2, 0.04);
        self.builder.cut(Shape::ellipsoid(ear, vec3(0.5, 0.32, 0.22)), 0.06);
    }

    /// Balls over the scalp, evenly spread, wherever the face and neck are not.
    fn curls(&mut self, radius: f32, count: usize, nape: f32) {
        self.short_cap(0.08);
        let lift = 0.02 + (0.35 * radius + 0.3 * (radius - 0.1).max(0.0)) * (0.5 + self.volume);
        self.builder.mirrored(false);
        for index in 0..count {
            let height = 1.0 - 2.0 * (index as f32 + 0.5) / count as f32;
            let ring = (1.0 - height * height).sqrt();
            let azimuth = index as f32 * GOLDEN_ANGLE;
            let jitter = Vec3::from_array(std::array::from_fn(|_| self.stream.range(-1.0, 1.0)));
            let direction = (vec3(ring * azimuth.sin(), height, ring * azimuth.cos()) + 0.08 * jitter).normalize();
            let point = self.anatomy.skull + (self.anatomy.skull_radii + Vec3::splat(lift)) * direction;
            let size = radius * self.stream.range(0.82, 1.15);
            // Keep off the face and below the nape's line.
            let face = ((point - vec3(0.0, -0.5, 0.9)) / vec3(0.98, 1.12 + self.hairline, 1.05)).length();
            let low = point.y < nape - 0.25 + 0.35 * (point.z + 0.9).max(0.0);
            let ear = (point - vec3(self.anatomy.skull_radii.x * point.x.signum(), -0.15, 0.05)).length() < 0.33;
            if face > 1.0 + 0.55 * size && !low && !ear {
                self.builder.add(Shape::sphere(point, size), 0.055);
            }
        }
    }

    fn tight_cap(&mut self, gathered: Vec3, thickness: f32) {
        self.meridians(gathered - self.anatomy.skull);
        self.cap(thickness);
        self.free_face(0.98);
        self.free_neck(0.0);
    }

    fn tie(&mut self, centre: Vec3, direction: Vec3, ring: f32) {
        let turn = Mat3::from_quat(glam::Quat::from_rotation_arc(Vec3::Y, direction.normalize_or(Vec3::Y)));
        self.builder.paint(Region::Hair, Material::HairAccent);
        self.builder.add(Shape::Torus { centre, local: turn.transpose(), ring, tube: 0.06 }, 0.0);
        self.builder.paint(Region::Hair, Material::Hair);
    }

    fn bun(&mut self) {
        let back = 0.25 + 0.55 * self.length;
        let radius = 0.3 + 0.1 * self.volume;
        let direction = vec3(0.0, back.cos(), -back.sin());
        let seat = self.scalp(-back, 0.0, 0.02);
        self.tight_cap(seat, 0.07);
        let centre = seat + 0.8 * radius * direction;
        self.builder.mirrored(false).flow(Flow::Meridian { origin: centre, axis: vec3(0.5, 0.5, 0.7).normalize() });
        self.builder.add(Shape::sphere(centre, radius), 0.05);
        self.builder.add(Shape::sphere(centre + vec3(0.08, 0.09, 0.05), 0.9 * radius), 0.02);
        self.tie(seat + 0.12 * radius * direction, direction, 0.72 * radius);
        // Loose strands before the ears.
        for side in [1.0, -1.0] {
            self.scalp_lock(
                &[(1.15, side * 0.98, 0.05, 0.05), (1.5, side * 1.08, 0.06, 0.045), (1.95, side * 1.0, 0.02, 0.012)],
                0.04,
            );
        }
    }

    /// Cuts room for face and neck out of hair that falls down beside them.
    fn free_face_and_neck(&mut self, width: f32) {
        let wide = self.anatomy.skull_radii.x / 0.92;
        self.free_face(width);
        let throat = vec3(0.0, -0.62, 0.72);
        let below = vec3(0.0, -2.2, 0.74);
        self.builder.cut(Shape::round_cone(throat, 0.76 * wide * width, below, 0.6 * wide), 0.07);
    }

    fn bob(&mut self, fringe: bool) {
        let end = -0.72 - 0.45 * self.length;
        let thickness = 0.15 + 0.08 * self.volume;
        self.meridians(vec3(0.0, 1.0, -0.1));
        self.cap(thickness);
        let wide = self.anatomy.skull_radii.x / 0.92;
        self.builder
            .add(Shape::ellipsoid(vec3(0.0, end + 0.36, -0.2), vec3(1.0 * wide + 0.5 * thickness, 0.5, 0.86)), 0.35);
        self.free_face_and_neck(1.0);
        self.builder.cut(Shape::HalfSpace { normal: Vec3::Y, offset: end }, 0.12);
        self.finish_top(fringe);
    }

    /// A fringe, or two sweeps from a parting.
    fn finish_top(&mut self, fringe: bool) {
        if fringe {
            self.fringe(1.22);
            return;
        }
        let start = 0.22 * self.side;
        for (side, steps) in [(1.0f32, 4), (-1.0, 4)] {
            for index in 0..steps {
                let back = index as f32 / (steps - 1) as f32;
                let polar = 0.86 - 0.55 * back;
                self.scalp_lock(
                    &[
                        (polar, start, 0.02, 0.08),
                        (polar + 0.12, start + side * (0.45 + 0.2 * back), 0.13, 0.13),
                        (1.12, side * (0.95 + 0.3 * back), 0.12, 0.12),
                        (1.75, side * (1.18 + 0.3 * back), 0.12, 0.05),
                    ],
                    0.06,
                );
            }
        }
    }

    fn long(&mut self, fringe: bool, wave: f32) {
        let end = -1.15 - 0.45 * self.length;
        let thickness = 0.12 + 0.1 * self.volume;
        let wide = self.anatomy.skull_radii.x / 0.92;
        self.meridians(vec3(0.0, 1.0, -0.1));
        self.cap(thickness);
        let middle = 0.5 * (end - 0.2);
        self.builder.add(
            Shape::ellipsoid(vec3(0.0, middle, -0.42), vec3(0.92 * wide + 0.5 * thickness, 0.62 - middle, 0.62)),
            0.3,
        );
        self.free_face_and_neck(0.99);
        self.finish_top(fringe);
        // Locks fall around the neck, those in front over the shoulders.
        for side in [1.0f32, -1.0] {
            for index in 0..5 {
                let back = index as f32 / 4.0;
                let azimuth = 1.25 + 0.35 * index as f32;
                let top = self.scalp(1.45, side * azimuth, 0.07 + 0.04 * self.volume);
                let (sin, cos) = (azimuth + 0.1).sin_cos();
                let reach = 0.93 * wide + 0.12 * self.volume;
                let phase = self.stream.range(0.0, 2.0 * PI);
                let swing = 0.03 + 0.075 * wave;
                let knots: Vec<_> = (0..6)
                    .map(|step| {
                        let share = step as f32 / 5.0;
                        let y = top.y + share * (end - 0.1 - top.y - 0.12 * self.stream.uniform());
                        let spread = 1.0 + 0.08 * (PI * share).sin();
                        let waving = swing * (phase + 2.0 * PI * 1.4 * share).sin() * share.sqrt();
                        let point = vec3(
                            side * (top.x.abs() * (1.0 - share) + share * reach * sin.abs()) * spread + waving,
                            y,
                            top.z * (1.0 - share)
                                + share * (reach * cos * 0.75 - 0.12 + 0.2 * (1.0 - back))
                                + 0.7 * waving,
                        );
                        (point, (0.2 + 0.03 * self.volume) * (1.0 - 0.8 * share.powi(3)))
                    })
                    .collect();
                self.builder.mirrored(false).lock(&knots, 2, 0.1);
            }
        }
    }

    fn ponytail(&mut self, fringe: bool) {
        let seat = self.scalp(-0.75, 0.12 * self.side, 0.03);
        self.tight_cap(seat, 0.075);
        if fringe {
            self.fringe(1.15);
        }
        let side = self.side;
        let length = 0.7 + 0.6 * self.length;
        let out = (seat - self.anatomy.skull).normalize_or(Vec3::Y);
        let end = seat + vec3(0.25 * side, -length - 0.3, -0.3);
        let knots = [
            (seat, 0.13),
            (seat + 0.28 * out, 0.2 + 0.05 * self.volume),
            (seat + 0.42 * out + vec3(0.12 * side, -0.42 * length, -0.12), 0.27 + 0.06 * self.volume),
            (seat + vec3(0.22 * side, -0.85 * length, -0.38), 0.22),
            (end, 0.03),
        ];
        self.builder.mirrored(false).lock(&knots, 3, 0.05);
        self.tie(seat + 0.08 * out, out, 0.15);
    }

    fn pigtails(&mut self, fringe: bool) {
        self.meridians(vec3(1.0, 0.35, -0.2));
        self.builder.mirrored(true);
        self.cap(0.08);
        self.free_face(0.98);
        self.free_neck(0.0);
        if fringe {
            self.fringe(1.15);
        }
        let high = 1.15 - 0.3 * self.volume;
        for side in [1.0, -1.0] {
            let seat = self.scalp(high, side * 1.9, 0.03);
            let out = (seat - self.anatomy.skull).normalize_or(Vec3::X);
            let drop = 0.6 + 0.5 * self.length;
            let knots = [
                (seat, 0.11),
                (seat + 0.24 * out + vec3(0.0, 0.03, 0.0), 0.19),
                (seat + vec3(0.36 * side, -0.45 * drop, -0.02), 0.24),
                (seat + vec3(0.3 * side, -0.85 * drop, 0.05), 0.17),
                (seat + vec3(0.22 * side, -1.1 * drop, 0.08), 0.03),
            ];
            self.builder.mirrored(false).lock(&knots, 3, 0.05);
            self.tie(seat + 0.06 * out, out, 0.14);
        }
    }

    fn braids(&mut self) {
        self.meridians(vec3(1.0, 0.1, 0.0));
        self.cap(0.09);
        self.free_face(0.98);
        self.free_neck(0.1);
        self.finish_top(false);
        let knots = 11 + (3.0 * self.length) as usize;
        for side in [1.0f32, -1.0] {
            let top = self.scalp(1.75, side * 1.75, 0.02);
            let end = vec3(side * 0.8, -1.5 - 0.12 * self.length, 0.16);
            let at = |share: f32| top.lerp(end, share) + vec3(side * 0.16 * (PI * share).sin(), 0.0, 0.08 * share);
            let core = [(top, 0.09), (at(0.5), 0.08), (at(1.0), 0.06)];
            self.builder.mirrored(false).lock(&core, 3, 0.03);
            for index in 0..knots {
                let share = index as f32 / (knots - 1) as f32;
                let zigzag = if index % 2 == 0 { 1.0 } else { -1.0 };
                let turn = Mat3::from_rotation_z(0.65 * zigzag);
                let along = turn * Vec3::Y;
                self.builder.flow(Flow::Along { origin: at(share), axis: along });
                let radii = vec3(0.1, 0.165, 0.125) * (1.05 - 0.25 * share);
                let centre = at(share) + vec3(0.045 * zigzag, 0.0, 0.0);
                self.builder.add(Shape::turned_ellipsoid(centre, radii, turn), 0.02);
            }
            let tip = at(1.0);
            let brush = [(tip, 0.07), (tip + vec3(0.0, -0.14, 0.03), 0.1), (tip + vec3(0.0, -0.3, 0.04), 0.02)];
            self.builder.lock(&brush, 3, 0.03);
            self.tie(tip + vec3(0.0, -0.05, 0.01), Vec3::Y, 0.07);
        }
    }

    fn mohawk(&mut self) {
        self.builder.paint(Region::Hair, Material::Stubble);
        self.short_cap(0.035);
        self.builder.paint(Region::Hair, Material::Hair);
        let height = 0.3 + 0.25 * self.volume;
        for index in 0..11 {
            let share = index as f32 / 10.0;
            let polar = 0.85 - 2.6 * share;
            let rise = height * (0.75 + 0.25 * (PI * share).sin()) * self.stream.range(0.9, 1.08);
            let lean = -0.16;
            for across in [-0.07f32, 0.07] {
                let root = self.scalp(polar, 0.0, 0.0) + vec3(across, 0.0, 0.0);
                let tip = self.scalp(polar + lean, 0.0, rise) + vec3(0.6 * across, 0.0, 0.0);
                let knots = [(root, 0.15), (root.lerp(tip, 0.5), 0.12), (tip, 0.03)];
                self.builder.mirrored(false).lock(&knots, 2, 0.06);
            }
        }
    }

    fn spiky(&mut self) {
        self.meridians(vec3(0.0, 1.0, -0.3));
        self.short_cap(0.1);
        let count = 30;
        for index in 0..count {
            let height = 1.0 - 1.35 * (index as f32 + 0.5) / count as f32;
            let ring = (1.0 - height * height).max(0.0).sqrt();
            let azimuth = index as f32 * GOLDEN_ANGLE;
            let direction = vec3(ring * azimuth.sin(), height, ring * azimuth.cos());
            let root = self.anatomy.skull + self.anatomy.skull_radii * direction;
            let face = ((root - vec3(0.0, -0.42, 0.78)) / vec3(0.97, 1.12 + self.hairline, 0.92)).length();
            let low = root.y < -0.3 + 0.4 * (root.z + 0.9);
            if face < 1.0 || low {
                continue;
            }
            let reach = (0.34 + 0.2 * self.volume) * self.stream.range(0.8, 1.15);
            // Up and forward in front, down and back behind.
            let sweep = vec3(0.12 * self.side, 0.1 + 0.5 * direction.z, 0.1 + 0.3 * direction.z);
            let tip_direction = (direction + sweep + 0.1 * self.stream.range(-1.0, 1.0) * Vec3::X).normalize();
            let knots = [
                (root, 0.25),
                (root + 0.45 * reach * (direction + 0.3 * tip_direction), 0.17),
                (root + 0.3 * reach * direction + reach * tip_direction, 0.02),
            ];
            self.builder.mirrored(false).lock(&knots, 2, 0.08);
        }
    }

    fn beanie(&mut self) {
        let anatomy = self.anatomy;
        self.meridians(Vec3::Y);
        self.cap(0.06);
        self.free_face(1.0);
        let end = -0.35 - 0.75 * self.length;
        if self.length > 0.4 {
            self.builder.add(Shape::ellipsoid(vec3(0.0, end + 0.4, -0.35), vec3(0.95, 0.6, 0.66)), 0.2);
            self.free_face_and_neck(1.0);
            self.builder.cut(Shape::HalfSpace { normal: Vec3::Y, offset: end }, 0.1);
        } else {
            self.free_neck(0.0);
        }
        self.builder.paint(Region::Hair, Material::HairAccent).mirrored(true);
        self.builder.flow(Flow::Meridian { origin: anatomy.skull, axis: Vec3::Y });
        let tilt = Mat3::from_rotation_x(-0.2);
        let crown = anatomy.skull + vec3(0.0, 0.08, -0.04);
        let dome = anatomy.skull_radii + vec3(0.1, 0.16 + 0.14 * self.volume, 0.1);
        // The dome stands in its own group so that its brim does not trim the hair below.
        self.builder.group();
        self.builder.flow(Flow::Meridian { origin: anatomy.skull, axis: Vec3::Y });
        self.builder.add(Shape::turned_ellipsoid(crown, dome, tilt), 0.0);
        let normal = tilt * Vec3::Y;
        let rim = crown + normal * 0.22;
        self.builder.cut(Shape::HalfSpace { normal, offset: normal.dot(rim) }, 0.05);
        let level = (1.0 - (0.22 / dome.y).powi(2)).max(0.0).sqrt();
        for (step, tube) in [(0.0, 0.085), (0.1, 0.09), (0.2, 0.085)] {
            let centre = rim + normal * step;
            let squash = vec3(dome.x * level, 1.0, dome.z * level);
            self.brim(centre, tilt, squash, tube);
        }
        if self.side > 0.0 {
            let pompon = crown + normal * (dome.y + 0.1);
            self.builder.flow(Flow::None).add(Shape::sphere(pompon, 0.2), 0.03);
        }
    }

    /// An elliptic ring of round cones.
    fn brim(&mut self, centre: Vec3, turn: Mat3, radii: Vec3, tube: f32) {
        let knots: Vec<_> = (0..=16)
            .map(|step| {
                let (sin, cos) = (PI * step as f32 / 16.0).sin_cos();
                (centre + turn * vec3(radii.x * sin, 0.0, radii.z * cos), tube)
            })
            .collect();
        self.builder.mirrored(true).lock(&knots, 1, 0.04);
    }
}
