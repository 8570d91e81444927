//! What the cartoon portraits promise to those who learn from them.

use super::*;
use crate::{
    camera::{FAR, NEAR},
    region::Region,
};

fn identity(seed: u64, style: HairStyle) -> Identity {
    let mut identity = Identity::sample(seed);
    identity.hair.style = style;
    identity
}

fn front(identity: &Identity, size: usize) -> CartoonPicture {
    render(identity, &Camera::default(), size, &RenderOptions::default())
}

#[test]
fn the_same_bytes_at_any_number_of_threads() {
    let options = SynthOptions { count: 3, size: 24, views: 2, ..SynthOptions::default() };
    let make = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| synth(5, options.clone(), RenderOptions::default()).unwrap().collect::<Vec<_>>())
    };
    let (one, three) = (make(1), make(3));
    assert_eq!(one.len(), options.len());
    for (index, (left, right)) in one.iter().zip(&three).enumerate() {
        assert_eq!((left.index, left.head, left.view), (index, index / 2, index % 2));
        assert_eq!(left.camera, right.camera);
        assert_eq!(left.picture, right.picture);
    }
    assert_ne!(one[0].picture.rgb, one[1].picture.rgb, "two cameras see different pictures");
    assert_ne!(one[0].picture.rgb, one[2].picture.rgb, "two heads differ");
}

#[test]
fn turned_cameras_follow_the_drawn_ones() {
    let turned = SynthOptions { count: 2, size: 8, views: 2, turns: vec![-0.4, 0.2], ..SynthOptions::default() };
    let drawn = SynthOptions { turns: Vec::new(), ..turned.clone() };
    let items = |options: SynthOptions| synth(5, options, RenderOptions::default()).unwrap().collect::<Vec<_>>();
    let (all, plain) = (items(turned), items(drawn));
    assert_eq!((all.len(), plain.len()), (12, 4));
    for (three, one) in all.chunks_exact(3).zip(&plain) {
        assert_eq!((three[0].camera, &three[0].picture), (one.camera, &one.picture));
        for (item, turn) in three.iter().zip([0.0, -0.4, 0.2]) {
            assert_eq!(item.camera, Camera::at(one.camera.azimuth_rad + turn, one.camera.elevation_rad));
            assert_eq!(item.head, one.head);
        }
    }
}

#[test]
fn a_frontal_face_shows_every_region() {
    for seed in 0..6 {
        let picture = front(&identity(seed, HairStyle::Crop), 128);
        for region in Region::ALL {
            let pixels = picture.labels.iter().filter(|label| **label == region as u8).count();
            assert!(pixels >= 12, "seed {seed}: {pixels} pixels of {region}");
        }
    }
    let bald = front(&identity(1, HairStyle::Bald), 64);
    assert!(!bald.labels.contains(&(Region::Hair as u8)));
}

#[test]
fn depth_lies_in_the_volume_and_normals_are_unit_vectors_at_any_camera() {
    use std::f64::consts::{FRAC_PI_2, PI};
    let portrait = Portrait::new(&identity(3, HairStyle::Long));
    let cameras = [
        Camera::default(),
        Camera::at(1.2, 0.6),
        Camera::at(-1.2, -0.6),
        Camera::at(PI, 0.0),
        Camera::at(0.3, FRAC_PI_2),
        Camera::at(0.0, -FRAC_PI_2),
        Camera { roll_rad: 1.0, shift_x: 0.4, shift_y: -0.3, zoom: 3.0, ..Camera::at(0.2, 0.1) },
    ];
    for camera in cameras {
        let picture = portrait.render(&camera, 33, &RenderOptions::default());
        assert_eq!((picture.rgb.len(), picture.labels.len()), (33 * 33 * 3, 33 * 33));
        for (index, &label) in picture.labels.iter().enumerate() {
            let depth = picture.depth[index];
            let length = picture.normal[3 * index..3 * index + 3].iter().map(|x| x * x).sum::<f32>().sqrt();
            if label == Region::Background as u8 {
                assert_eq!((depth, length), (FAR as f32, 0.0));
            } else {
                assert!((NEAR as f32..=FAR as f32).contains(&depth), "{camera:?}: depth {depth}");
                assert!((length - 1.0).abs() < 1e-4, "{camera:?}: normal of length {length}");
            }
        }
        assert!(picture.labels.iter().any(|label| *label != 0), "{camera:?} sees nobody");
    }
}

#[test]
fn a_picture_of_one_pixel_has_one_pixel() {
    let picture = front(&identity(0, HairStyle::Bob), 1);
    assert_eq!((picture.rgb.len(), picture.depth.len(), picture.normal.len()), (3, 1, 3));
    assert_ne!(picture.labels[0], Region::Background as u8);
}

/// Points seen by one camera, carried to another, never float before what that one sees, and mostly are what it sees.
#[test]
fn two_views_agree_on_the_surface() {
    let size = 128;
    let half = size as f64 / 2.0;
    for (seed, style) in [(2, HairStyle::SidePart), (4, HairStyle::Curly), (9, HairStyle::Bob)] {
        let portrait = Portrait::new(&identity(seed, style));
        let (first, second) = (Camera::at(-0.1, 0.05), Camera::at(0.15, -0.05));
        let [seen, other] = [&first, &second].map(|camera| portrait.render(camera, size, &RenderOptions::default()));
        let camera_from_world = second.world_from_camera();
        let tangent = (0.5 * second.field_of_view_rad).tan();
        let (mut compared, mut agreeing, mut floating) = (0, 0, 0);
        for index in 0..size * size {
            if seen.labels[index] == 0 {
                continue;
            }
            let (x, y) = ((index % size) as f64 + 0.5, (index / size) as f64 + 0.5);
            let (origin, direction) = first.ray(x / half - 1.0, 1.0 - y / half);
            let depth = f64::from(seen.depth[index]);
            let offset: [f64; 3] =
                std::array::from_fn(|axis| origin[axis] + depth * direction[axis] - camera_from_world[axis][3]);
            let local: [f64; 3] =
                std::array::from_fn(|axis| (0..3).map(|row| camera_from_world[row][axis] * offset[row]).sum());
            let expected = -local[2];
            let column = (local[0] / (expected * tangent) + 1.0) * half - 0.5;
            let row = (1.0 - local[1] / (expected * tangent)) * half - 0.5;
            if !(0.0..size as f64 - 1.0).contains(&column) || !(0.0..size as f64 - 1.0).contains(&row) {
                continue;
            }
            let corner = row as usize * size + column as usize;
            let depths = [corner, corner + 1, corner + size, corner + size + 1].map(|at| f64::from(other.depth[at]));
            let (low, high) = (depths.iter().copied().fold(2.0, f64::min), depths.iter().copied().fold(0.0, f64::max));
            if high - low > 0.004 {
                continue; // a border of the other view: nothing to interpolate
            }
            let (u, v) = (column.fract(), row.fract());
            let there =
                (depths[0] * (1.0 - u) + depths[1] * u) * (1.0 - v) + (depths[2] * (1.0 - u) + depths[3] * u) * v;
            compared += 1;
            // Half a pixel (0.0008) of play for surfaces that curve between pixels.
            agreeing += usize::from((expected - there).abs() < 0.0008);
            floating += usize::from(expected < there - 0.0016);
        }
        assert!(compared > 4000, "{compared} points compared");
        assert!(agreeing * 10 > compared * 8, "{style:?}: {agreeing} of {compared} agree");
        assert!(floating * 200 < compared, "{style:?}: {floating} of {compared} float");
    }
}

#[test]
fn redrawing_the_hair_moves_no_pixel_of_the_mouth() {
    for seed in 0..2 {
        let mut person = Identity::sample(seed);
        let before = front(&person, 72);
        for style in HairStyle::ALL {
            person.redraw(Region::Hair, 1000 + seed);
            person.hair.style = style;
            let after = front(&person, 72);
            let is_mouth = |labels: &[u8]| labels.iter().map(|label| *label == Region::Mouth as u8).collect::<Vec<_>>();
            assert_eq!(is_mouth(&before.labels), is_mouth(&after.labels), "seed {seed}, {style:?}");
        }
    }
}

#[test]
fn a_region_is_redrawn_alone() {
    let original = Identity::sample(11);
    for region in Region::ALL {
        let mut changed = original.clone();
        changed.redraw(region, 12);
        assert_ne!(changed, original, "{region} did not change");
        changed.redraw(region, 11);
        assert_eq!(changed, original, "more than {region} changed");
    }
}

#[test]
fn identities_survive_serialisation() {
    let identity = Identity::sample(77);
    let text = serde_json::to_string(&identity).unwrap();
    assert_eq!(serde_json::from_str::<Identity>(&text).unwrap(), identity);
    let misspelt = text.replace("\"fullness\"", "\"fulness\"");
    assert!(serde_json::from_str::<Identity>(&misspelt).is_err());
}

#[test]
fn cameras_are_gaussian_and_clamped() {
    let options = SynthOptions::default();
    let cameras: Vec<Camera> = (0..4000).map(|head| options.camera(3, head, 0)).collect();
    let deviation = |angle: fn(&Camera) -> f64| {
        (cameras.iter().map(|camera| angle(camera).powi(2)).sum::<f64>() / cameras.len() as f64).sqrt()
    };
    assert!((deviation(|camera| camera.azimuth_rad) - 0.4).abs() < 0.02);
    assert!((deviation(|camera| camera.elevation_rad) - 0.2).abs() < 0.01);
    assert!(cameras.iter().all(|camera| camera.azimuth_rad.abs() <= 1.2 && camera.elevation_rad.abs() <= 0.6));
}

#[test]
fn impossible_options_are_refused_by_name() {
    let refuse = |options: SynthOptions| synth(0, options, RenderOptions::default()).unwrap_err().to_string();
    assert!(refuse(SynthOptions { size: 0, ..SynthOptions::default() }).starts_with("size"));
    assert!(refuse(SynthOptions { views: 0, ..SynthOptions::default() }).starts_with("views"));
    assert!(refuse(SynthOptions { turns: vec![0.2, 9.0], ..SynthOptions::default() }).starts_with("turns"));
    assert!(refuse(SynthOptions { azimuth_sigma: f64::NAN, ..SynthOptions::default() }).starts_with("azimuth-sigma"));
}
