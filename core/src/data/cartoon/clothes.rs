//! Shoulders and what is worn on them.

use glam::{Mat3, Vec3, vec3};

use super::{
    head::Anatomy,
    identity::{Garment, Identity, Neck},
    scene::{Builder, FLOOR, Material},
    shape::Shape,
};
use crate::region::Region;

/// How far all of this stands higher than its numbers say: a short neck suits a large head.
const LIFT: f32 = 0.1;

/// Middle line of the neck at this height.
fn neck_axis(y: f32) -> Vec3 {
    vec3(0.0, y, -0.22 - 0.1 * (-0.62 - y) / 0.98)
}

/// Chest, slope of the shoulders and upper arms, `inflate` larger than the body.
fn torso(builder: &mut Builder, neck: &Neck, inflate: f32) {
    let width = neck.shoulders;
    builder.mirrored(true);
    builder.add(
        Shape::ellipsoid(vec3(0.0, -2.35, -0.24), vec3(0.96 * width + inflate, 0.93 + inflate, 0.54 + inflate)),
        0.0,
    );
    builder.add(
        Shape::round_cone(vec3(0.1, -1.5, -0.32), 0.16 + inflate, vec3(0.74 * width, -1.76, -0.3), 0.22 + inflate),
        0.24,
    );
    builder.add(
        Shape::round_cone(
            vec3(0.9 * width, -1.86, -0.28),
            0.25 + inflate,
            vec3(1.06 * width, -2.7, -0.22),
            0.23 + inflate,
        ),
        0.16,
    );
}

/// Adds body and garment, each a group.
pub(super) fn build(builder: &mut Builder, identity: &Identity, anatomy: &Anatomy) {
    let neck = &identity.neck;
    let radius = anatomy.neck_radius;
    builder.offset(LIFT * Vec3::Y);
    builder.group().paint(Region::Neck, Material::Skin);
    torso(builder, neck, 0.0);
    builder.add(Shape::round_cone(neck_axis(-0.9), radius, neck_axis(-1.65), 1.08 * radius), 0.22);
    builder.cut(floor(0.03), 0.04);

    builder.group().paint(Region::Neck, Material::Garment);
    torso(builder, neck, if neck.garment == Garment::Hoodie { 0.075 } else { 0.045 });
    let base = neck_axis(-1.46);
    // The neckline dips in front.
    let slope = Mat3::from_rotation_x(0.42);
    match neck.garment {
        Garment::TShirt | Garment::Scarf => {
            builder.add(Shape::round_cone(neck_axis(-1.3), radius + 0.07, neck_axis(-1.7), radius + 0.2), 0.14);
            let opening = base + vec3(0.0, 0.06, 0.02);
            builder.cut(Shape::turned_ellipsoid(opening, vec3(radius + 0.12, 0.17, radius + 0.14), slope), 0.03);
            builder.cut(half_space_above(opening + vec3(0.0, 0.05, 0.0), slope), 0.03);
            if neck.garment == Garment::Scarf {
                scarf(builder, radius);
            } else {
                builder.paint(Region::Neck, Material::Trim);
                let local = slope.transpose();
                let rib = base + vec3(0.0, 0.045, 0.09);
                builder.add(Shape::Torus { centre: rib, local, ring: radius + 0.13, tube: 0.045 }, 0.01);
            }
        }
        Garment::VNeck => {
            builder.add(Shape::round_cone(neck_axis(-1.3), radius + 0.06, neck_axis(-1.7), radius + 0.18), 0.14);
            builder.cut(half_space_above(base + vec3(0.0, 0.1, 0.0), slope), 0.03);
            let point = vec3(0.0, -1.92, 0.45);
            let shoulder = vec3(radius + 0.05, -1.25, 0.1);
            for x in [1.0, -1.0] {
                let corner = vec3(x * shoulder.x, shoulder.y, shoulder.z);
                builder.mirrored(false).cut(Shape::round_cone(point, 0.02, 0.5 * (corner + point), 0.12), 0.03);
            }
            builder.cut(Shape::round_cone(point, 0.02, vec3(0.0, -1.3, 0.0), radius + 0.08), 0.03);
            builder.paint(Region::Neck, Material::Trim).mirrored(true);
            let edge = [
                (neck_axis(-1.36) + vec3(radius + 0.12, 0.03, 0.06), 0.04),
                (vec3(radius * 0.72 + 0.02, -1.62, 0.22), 0.042),
                (vec3(0.0, -1.9, 0.33), 0.042),
            ];
            builder.lock(&edge, 3, 0.02);
        }
        Garment::Hoodie => {
            builder.add(Shape::round_cone(neck_axis(-1.3), radius + 0.1, neck_axis(-1.7), radius + 0.22), 0.14);
            builder.cut(half_space_above(base + vec3(0.0, 0.08, 0.0), slope), 0.04);
            // The hood lies around the neck as a thick roll, thicker behind.
            builder.mirrored(true);
            let roll = [
                (vec3(0.0, -1.62, 0.3), 0.11),
                (vec3(radius + 0.02, -1.5, 0.14), 0.15),
                (vec3(radius + 0.2, -1.32, -0.3), 0.19),
                (vec3(0.26, -1.22, -0.7), 0.22),
                (vec3(0.0, -1.22, -0.8), 0.23),
            ];
            builder.lock(&roll, 3, 0.08);
            builder.paint(Region::Neck, Material::Trim);
            let string =
                [(vec3(0.14, -1.6, 0.36), 0.028), (vec3(0.17, -1.78, 0.4), 0.026), (vec3(0.16, -1.98, 0.42), 0.03)];
            builder.lock(&string, 3, 0.0);
        }
        Garment::Shirt => {
            builder.add(Shape::round_cone(neck_axis(-1.3), radius + 0.05, neck_axis(-1.7), radius + 0.16), 0.12);
            builder.cut(half_space_above(base + vec3(0.0, 0.14, 0.0), slope), 0.03);
            // Two flaps that meet under the throat.
            builder.paint(Region::Neck, Material::Trim).mirrored(true);
            let stand = [
                (neck_axis(-1.26) + vec3(0.0, 0.02, -radius - 0.08), 0.06),
                (neck_axis(-1.3) + vec3(radius + 0.06, 0.0, -0.05), 0.06),
                (neck_axis(-1.42) + vec3(0.6 * radius, 0.0, 0.8 * radius + 0.06), 0.055),
            ];
            builder.lock(&stand, 4, 0.02);
            let outwards = vec3(0.22, 0.42, 0.88).normalize();
            let down = vec3(0.5, -0.8, 0.2);
            let down = (down - outwards * down.dot(outwards)).normalize();
            let axes = Mat3::from_cols(down, outwards.cross(down), outwards);
            let middle = neck_axis(-1.49) + vec3(0.55 * radius + 0.04, 0.0, 0.9 * radius + 0.2);
            builder.add(Shape::turned_ellipsoid(middle, vec3(0.25, 0.15, 0.055), axes), 0.05);
            builder.paint(Region::Neck, Material::Trim);
            for y in [-1.74, -1.92, -2.08] {
                let z = builder.front(0.0, y + LIFT).z;
                builder.add(Shape::ellipsoid(vec3(0.0, y, z), vec3(0.042, 0.042, 0.02)), 0.0);
            }
        }
        Garment::Turtleneck => {
            builder.add(Shape::round_cone(neck_axis(-1.05), radius + 0.07, neck_axis(-1.7), radius + 0.12), 0.1);
            builder.cut(half_space_above(neck_axis(-1.16), Mat3::from_rotation_x(0.2)), 0.04);
            let local = Mat3::from_rotation_x(-0.2);
            for (y, tube) in [(-1.2, 0.08), (-1.32, 0.085)] {
                builder.add(Shape::Torus { centre: neck_axis(y), local, ring: radius + 0.045, tube }, 0.05);
            }
        }
        Garment::Straps => {
            builder.cut(half_space_above(vec3(0.0, -1.86, 0.0), Mat3::from_rotation_x(0.1)), 0.04);
            builder.paint(Region::Neck, Material::Trim).mirrored(true);
            let x = 0.5 * neck.shoulders;
            let strap = [
                (vec3(x - 0.04, -1.95, 0.17), 0.045),
                (vec3(x, -1.66, 0.01), 0.045),
                (vec3(x, -1.5, -0.26), 0.045),
                (vec3(x, -1.66, -0.5), 0.045),
                (vec3(x - 0.04, -1.95, -0.65), 0.045),
            ];
            builder.lock(&strap, 3, 0.0);
        }
    }
    builder.cut(floor(0.0), 0.04).offset(Vec3::ZERO);
}

fn scarf(builder: &mut Builder, radius: f32) {
    builder.paint(Region::Neck, Material::Trim).mirrored(false);
    for (y, turn, tube) in [(-1.42, 0.28, 0.17), (-1.24, 0.2, 0.14)] {
        let local = Mat3::from_rotation_x(-turn) * Mat3::from_rotation_z(0.1);
        builder.add(Shape::Torus { centre: neck_axis(y), local, ring: radius + 0.13, tube }, 0.04);
    }
    let end = [(vec3(0.2, -1.5, 0.26), 0.12), (vec3(0.3, -1.75, 0.36), 0.13), (vec3(0.34, -2.1, 0.36), 0.14)];
    builder.lock(&end, 3, 0.05);
}

/// Everything below the bust's end.
fn floor(raised: f32) -> Shape {
    Shape::HalfSpace { normal: Vec3::Y, offset: FLOOR - LIFT + 0.02 + raised }
}

/// Everything above a plane through `point` whose normal is the turned y axis.
fn half_space_above(point: Vec3, turn: Mat3) -> Shape {
    let normal = turn * Vec3::Y;
    Shape::HalfSpace { normal: -normal, offset: -normal.dot(point) }
}
