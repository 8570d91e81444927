//! The head's solids: skull, face, nose, ears, eyes with lids and lashes, eyebrows, mouth.

use glam::{Mat3, Vec3, vec3};

use super::{
    identity::Identity,
    scene::{Builder, Material},
    shape::{MouthBand, MouthFrame, Shape},
};
use crate::region::Region;

/// Measures of a head that hair, clothes and shading need.
#[derive(Clone, Debug)]
pub(super) struct Anatomy {
    /// Middle of the skull.
    pub skull: Vec3,
    /// Its radii.
    pub skull_radii: Vec3,
    /// The eyes: +x first.
    pub eyes: [Eye; 2],
    /// Middles of the cheeks at +x; the other side mirrors it.
    pub cheek: Vec3,
    /// Tip of the nose.
    pub nose_tip: Vec3,
    /// Radius of the neck.
    pub neck_radius: f32,
}

/// An eyeball.
#[derive(Clone, Copy, Debug)]
pub(super) struct Eye {
    /// Centre.
    pub centre: Vec3,
    /// Radius.
    pub radius: f32,
    /// Unit direction of the pupil.
    pub gaze: Vec3,
    /// Axes of the socket as columns: outwards to +x, up, forward.
    pub axes: Mat3,
}

impl Anatomy {
    /// Point over the skull: `polar_rad` from the crown, `azimuth_rad` from the front to +x, `lift` off the skull.
    pub fn scalp(&self, polar_rad: f32, azimuth_rad: f32, lift: f32) -> Vec3 {
        let (sin_polar, cos_polar) = polar_rad.sin_cos();
        let (sin_azimuth, cos_azimuth) = azimuth_rad.sin_cos();
        let direction = vec3(sin_polar * sin_azimuth, cos_polar, sin_polar * cos_azimuth);
        self.skull + (self.skull_radii + Vec3::splat(lift)) * direction
    }
}

/// Adds the head to an empty builder: its first groups are skin, eyes and mouth.
pub(super) fn build(builder: &mut Builder, identity: &Identity) -> Anatomy {
    let face = &identity.face;
    let skull = vec3(0.0, 0.25, -0.12);
    let skull_radii = vec3(0.92 * face.head_width, 0.92 * face.head_height, 0.98 * face.head_depth);
    let chin = vec3(0.0, 0.12 - 0.98 * face.face_length, 0.44 + face.chin_forward);
    let jaw_middle = vec3(0.0, -0.3 - 0.3 * (face.face_length - 1.0), 0.12);
    let jaw_height = jaw_middle.y - chin.y + 0.14;
    let cheek = vec3(0.4 * face.head_width, -0.36 + face.cheek_height, 0.4);

    builder.paint(Region::Face, Material::Skin).mirrored(true);
    builder.add(Shape::ellipsoid(skull, skull_radii), 0.0);
    builder.add(Shape::ellipsoid(jaw_middle, vec3(0.7 * face.jaw_width, jaw_height, 0.7)), 0.34);
    builder.add(Shape::sphere(cheek, 0.32 * face.cheek_size), 0.3);
    builder.add(Shape::sphere(chin + vec3(0.0, 0.07, 0.0), 0.17 * face.chin_size), 0.25);

    let eyes = place_eyes(builder, identity);
    for eye in eyes {
        let socket = eye.centre + eye.axes * vec3(0.0, -0.03, 0.66 * eye.radius);
        let radii = eye.radius * vec3(1.1, 0.75, 0.4);
        builder.mirrored(false).cut(Shape::turned_ellipsoid(socket, radii, eye.axes), 0.22);
    }
    for eye in &eyes {
        lids(builder, identity, eye);
    }
    builder.mirrored(true);

    let eye_height = eyes[0].centre.y;
    let nose_root = builder.front(0.0, eye_height - 0.02);
    let nose_tip = builder.front(0.0, eye_height - identity.nose.length) + vec3(0.0, 0.0, identity.nose.forward);
    let mouth = place_mouth(builder, identity, nose_tip, chin);
    nose(builder, identity, nose_root, nose_tip);
    ears(builder, identity, skull_radii);
    let neck_radius = 0.33 * identity.neck.width;
    builder.paint(Region::Neck, Material::Skin);
    let throat = vec3(0.0, -0.62, -0.22);
    builder.add(Shape::round_cone(throat, neck_radius, vec3(0.0, -1.6, -0.32), 1.06 * neck_radius), 0.1);

    lips(builder, identity, mouth);
    for eye in &eyes {
        eyeball(builder, identity, eye);
    }
    eyebrows(builder, identity, &eyes);
    Anatomy { skull, skull_radii, eyes, cheek, nose_tip, neck_radius }
}

fn place_eyes(builder: &Builder, identity: &Identity) -> [Eye; 2] {
    let eyes = &identity.eyes;
    [1.0f32, -1.0].map(|side| {
        let surface = builder.front(side * eyes.spacing, eyes.height);
        let outwards = 0.16 * side;
        let forward = vec3(outwards.sin(), 0.02, outwards.cos()).normalize();
        let tilted = vec3(1.0, side * eyes.tilt_rad.sin(), 0.0);
        let across = (tilted - forward * tilted.dot(forward)).normalize();
        let axes = Mat3::from_cols(across, forward.cross(across), forward);
        let (sin_azimuth, cos_azimuth) = eyes.gaze_azimuth_rad.sin_cos();
        let (sin_elevation, cos_elevation) = eyes.gaze_elevation_rad.sin_cos();
        // Both eyes look at the same far point; a touch of convergence keeps them friendly.
        let gaze = vec3(sin_azimuth * cos_elevation - 0.02 * side, sin_elevation, cos_azimuth * cos_elevation);
        Eye { centre: surface - 0.66 * eyes.size * forward, radius: eyes.size, gaze: gaze.normalize(), axes }
    })
}

fn nose(builder: &mut Builder, identity: &Identity, root: Vec3, tip: Vec3) {
    let nose = &identity.nose;
    let wing = tip + vec3(0.1 * nose.width, -0.03, -0.06 - 0.3 * nose.forward);
    builder.paint(Region::Nose, Material::Skin).mirrored(true);
    builder.add(Shape::round_cone(root - vec3(0.0, 0.0, 0.6 * nose.bridge), nose.bridge, tip, 0.72 * nose.bulb), 0.12);
    builder.add(Shape::sphere(tip, nose.bulb), 0.06);
    builder.add(Shape::sphere(wing, 0.62 * nose.bulb), 0.06);
    let nostril = tip + vec3(0.062 * nose.width, -0.62 * nose.bulb - 0.03, -0.02);
    builder.cut(Shape::ellipsoid(nostril, vec3(0.03, 0.025, 0.04)), 0.04);
}

fn ears(builder: &mut Builder, identity: &Identity, skull_radii: Vec3) {
    let ears = &identity.ears;
    let height = identity.eyes.height + ears.height - 0.04;
    // Hair that falls over the ears holds them against the head.
    let covered = identity.hair.style.covers_ears();
    let angle_rad = if covered { ears.angle_rad.min(0.12) } else { ears.angle_rad };
    let (sin, cos) = angle_rad.sin_cos();
    // The ear's plate leans back and opens to the front.
    let normal = vec3(cos, 0.0, sin);
    let lean = vec3(0.06, 1.0, -0.14).normalize();
    let forward = lean.cross(normal).normalize();
    let axes = Mat3::from_cols(lean.cross(forward).normalize(), lean, forward);
    let side = skull_radii.x * (1.0 - ((height - 0.25) / skull_radii.y).powi(2)).max(0.1).sqrt();
    let centre = vec3(side + 0.05 + 0.3 * ears.size * sin, height, -0.1);
    let at = |x: f32, y: f32, z: f32| centre + axes * (ears.size * vec3(x, y, z));
    builder.paint(Region::Ears, Material::Skin).mirrored(true);
    builder.add(Shape::turned_ellipsoid(centre, ears.size * vec3(0.27, 0.98, 0.66), axes), 0.1);
    builder.add(Shape::sphere(at(0.0, -0.72, 0.08), 0.3 * ears.size), 0.08);
    if ears.point > 0.0 {
        let tip = at(0.1, 1.15 + 0.75 * ears.point, -0.35 - 0.4 * ears.point);
        builder.add(Shape::round_cone(at(0.0, 0.4, -0.05), 0.34 * ears.size, tip, 0.07 * ears.size), 0.1);
    }
    // The bowl: whichever way the plate's normal points, the hollow goes outwards.
    let outwards = axes.x_axis.x.signum();
    builder.cut(Shape::turned_ellipsoid(at(0.36 * outwards, 0.12, 0.1), ears.size * vec3(0.3, 0.62, 0.38), axes), 0.05);
    builder.add(Shape::sphere(at(0.12 * outwards, -0.08, 0.5), 0.16 * ears.size), 0.06);
    if ears.studs && !covered {
        builder.paint(Region::Ears, Material::Metal);
        builder.add(Shape::sphere(at(0.3 * outwards, -0.84, 0.1), 0.045), 0.0);
    }
}

/// Fits the mouth's bent coordinates to the face before nose and lips are on it.
fn place_mouth(builder: &Builder, identity: &Identity, nose_tip: Vec3, chin: Vec3) -> MouthFrame {
    let mouth = &identity.mouth;
    let under_nose = nose_tip.y - identity.nose.bulb;
    let height = under_nose + mouth.place * (chin.y - 0.06 - under_nose);
    let centre = builder.front(0.0, height);
    let corner = builder.front(mouth.width, height + mouth.smile);
    let (rise, fall) = (0.1, 0.2);
    let above = (builder.front(0.0, height + rise).z - centre.z) / rise;
    let below = (builder.front(0.0, height - fall).z - centre.z) / fall;
    let bow = (above + below) / (rise + fall);
    let slope = above - bow * rise;
    let at_corner = slope * mouth.smile + bow * mouth.smile * mouth.smile;
    let inverse_square = mouth.width.powi(-2);
    MouthFrame {
        centre: centre - vec3(0.0, 0.45 * mouth.smile, 0.45 * mouth.smile * slope),
        curve: mouth.smile * inverse_square,
        recede: ((centre.z + at_corner - corner.z) * inverse_square).max(0.0),
        half_width: mouth.width,
        slope,
        bow,
    }
}

/// Lips, the opening between them, teeth and tongue.
fn lips(builder: &mut Builder, identity: &Identity, frame: MouthFrame) {
    let mouth = &identity.mouth;
    let band = |middle: f32, half_height: f32, depth: f32, half_depth: f32| MouthBand {
        frame,
        half_width: mouth.width,
        middle,
        half_height,
        depth,
        half_depth,
        dip: 0.0,
    };
    let lip = 0.042 * mouth.fullness;
    // A smiling mouth opens downwards.
    let (top, bottom) = (0.3 * mouth.open, -0.7 * mouth.open);
    builder.paint(Region::Mouth, Material::Lip).mirrored(false);
    let upper = MouthBand { dip: 0.2 * lip, ..band(top + 0.8 * lip, lip, -0.01, 0.0) };
    builder.add(Shape::MouthBand(upper), 0.035);
    builder.add(Shape::MouthBand(band(bottom - 0.95 * lip, 1.2 * lip, -0.01, 0.0)), 0.035);
    if mouth.open > 0.015 {
        builder.paint(Region::Mouth, Material::MouthInside);
        let opening = MouthBand {
            half_width: 0.93 * mouth.width,
            ..band(0.5 * (top + bottom), 0.5 * mouth.open + 0.1 * lip, -0.05, 0.24)
        };
        builder.hollow(Shape::MouthBand(opening), 0.02);
        builder.group().paint(Region::Mouth, Material::Teeth);
        let teeth_height = (0.45 * mouth.open).clamp(0.03, 0.075);
        let teeth =
            MouthBand { half_width: 1.05 * mouth.width, ..band(top - 0.6 * teeth_height, teeth_height, -0.1, 0.045) };
        builder.add(Shape::MouthBand(teeth), 0.0);
        if mouth.open > 0.12 {
            builder.paint(Region::Mouth, Material::Tongue);
            let tongue = frame.centre + vec3(0.0, bottom - 0.02, -0.16);
            builder.add(Shape::ellipsoid(tongue, vec3(0.5 * mouth.width, 0.3 * mouth.open, 0.12)), 0.0);
        }
    } else {
        // The line between closed lips.
        builder.paint(Region::Mouth, Material::MouthInside);
        builder.hollow(Shape::MouthBand(band(-0.05 * lip, 0.1 * lip, 0.03, 0.045)), 0.012);
    }
}

/// How far the lids stand off the eyeball.
const LID_THICKNESS: f32 = 0.022;

/// Lids hinged on the eye's axis, grown into the skin around them.
fn lids(builder: &mut Builder, identity: &Identity, eye: &Eye) {
    let [up, forward] = [eye.axes.y_axis, eye.axes.z_axis];
    let hinge = |angle: f32| (up * angle.cos() - forward * angle.sin()).normalize();
    let radius = eye.radius + LID_THICKNESS;
    let (upper, lower) = (hinge(identity.eyes.upper_lid_rad), -hinge(-identity.eyes.lower_lid_rad));
    for (normal, blend) in [(upper, 0.08), (lower, 0.13)] {
        builder.add(Shape::Lid { centre: eye.centre, radius, normal }, blend);
    }
}

/// Eyeball, and lashes along the upper lid.
fn eyeball(builder: &mut Builder, identity: &Identity, eye: &Eye) {
    let eyes = &identity.eyes;
    let side = eye.centre.x.signum();
    let [across, up, forward] = [eye.axes.x_axis, eye.axes.y_axis, eye.axes.z_axis];
    let rim = eye.radius + LID_THICKNESS;
    builder.group().mirrored(false);
    builder.paint(Region::Eyes, Material::Eyeball(u8::from(side < 0.0)));
    builder.add(Shape::sphere(eye.centre, eye.radius), 0.0);

    // The upper lid's edge is an arc around the eye; the lashes thicken to the outer corner and leave it there.
    builder.paint(Region::Eyes, Material::Lash);
    let edge_direction = |angle: f32| {
        let ahead = forward * eyes.upper_lid_rad.cos() + up * eyes.upper_lid_rad.sin();
        across * (side * angle.sin()) + ahead * angle.cos()
    };
    let reach = 0.95;
    let thickness = 0.012 + 0.012 * eyes.lashes;
    let mut knots: Vec<_> = (0..7)
        .map(|step| {
            let share = step as f32 / 6.0;
            let angle = reach * (2.0 * share - 1.0);
            (eye.centre + (rim + 0.002) * edge_direction(angle), thickness * (0.35 + 0.65 * share.sqrt()))
        })
        .collect();
    if eyes.lashes > 0.25 {
        let corner = edge_direction(reach + 0.25) + 0.22 * eyes.lashes * up;
        knots.push((eye.centre + (rim + 0.01 + 0.05 * eyes.lashes) * corner.normalize_or(forward), 0.005));
    }
    builder.lock(&knots, 2, 0.01);
}

/// Curved tufts on the brow ridge, thick inside and thin outside.
fn eyebrows(builder: &mut Builder, identity: &Identity, eyes: &[Eye; 2]) {
    let brows = &identity.eyebrows;
    // Brows sit on the skin, so they are placed against a copy of the skin's group only.
    let mut placed: Vec<Vec<(Vec3, f32)>> = Vec::new();
    for eye in eyes {
        let side = eye.centre.x.signum();
        let raise = if side > 0.0 { brows.raise } else { 0.0 };
        let middle_y = eye.centre.y + 0.85 * eye.radius + brows.height + raise;
        let knots = (0..6)
            .map(|step| {
                let share = step as f32 / 5.0;
                let along = 2.0 * share - 1.0;
                let x = eye.centre.x.abs() + 0.02 + brows.length * along;
                let y = middle_y
                    + brows.arch * (0.6 - (along - 0.1).powi(2) * if along < 0.1 { 0.5 } else { 1.0 })
                    + brows.length * along * brows.tilt_rad.sin();
                let radius = brows.thickness * (1.0 - 0.55 * share.powi(2)) * if step == 0 { 0.8 } else { 1.0 };
                (vec3(side * x.max(0.05), y, 0.0), radius)
            })
            .collect();
        placed.push(knots);
    }
    builder.group();
    builder.paint(Region::Eyebrows, Material::Brow).mirrored(false);
    let skin = builder.group_view(0);
    for mut knots in placed {
        for (point, radius) in &mut knots {
            *point = skin.front(point.x, point.y) - vec3(0.0, 0.0, 0.25 * *radius);
        }
        builder.lock(&knots, 2, 0.02);
    }
}
