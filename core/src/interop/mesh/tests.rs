use std::f64::consts::{PI, TAU};

use gltf_json::validation::Validate as _;

use super::*;
use crate::error::{Error, Result};

const VOLUME: Volume = Volume { min: [-0.12; 3], max: [0.12; 3], resolution: 48 };

fn sphere(point: &[f32; 3]) -> f32 {
    norm(point.map(f64::from)) as f32 - 0.1
}

fn torus(point: &[f32; 3]) -> f32 {
    let [x, y, z] = point.map(f64::from);
    ((x.hypot(z) - 0.07).hypot(y) - 0.03) as f32
}

/// Left of the middle it is hair, right of it face; colours tell the position.
fn appearance(points: &[[f32; 3]], normals: &[[f32; 3]]) -> Result<Vec<Appearance>> {
    assert_eq!(points.len(), normals.len());
    let look = |point: &[f32; 3]| Appearance {
        colour: point.map(|x| (128.0 + 1000.0 * x) as u8),
        region: if point[0] < 0.0 { Region::Hair } else { Region::Face },
    };
    Ok(points.iter().map(look).collect())
}

fn mesh_of(volume: &Volume, distance: impl Fn(&[f32; 3]) -> f32) -> Mesh {
    extract(volume, |points| Ok(points.iter().map(&distance).collect()), appearance).unwrap()
}

fn close(value: f64, expected: f64, relative: f64) {
    assert!((value / expected - 1.0).abs() < relative, "{value} is not within {relative} of {expected}");
}

fn assert_sound(mesh: &Mesh) {
    assert_eq!(mesh.boundary_edges(), 0);
    let smallest = (0..mesh.triangles.len()).map(|triangle| mesh.triangle_area(triangle)).fold(f64::MAX, f64::min);
    assert!(smallest > 1e-10, "smallest triangle {smallest:e}"); // cells are 2.5e-5 large
    for (normal, [a, b, c]) in mesh.triangles.iter().map(|t| t[0] as usize).zip(mesh.corners()) {
        assert!((norm(mesh.normals[normal].map(f64::from)) - 1.0).abs() < 1e-5);
        assert!(norm(cross(minus(b, a), minus(c, a))) > 0.0);
    }
}

#[test]
fn a_sphere_has_its_area_volume_and_normals() {
    let mesh = mesh_of(&VOLUME, sphere);
    assert_sound(&mesh);
    close(mesh.area(), 4.0 * PI * 0.01, 0.01);
    close(mesh.volume(), 4.0 / 3.0 * PI * 0.001, 0.01);
    // Secant steps: vertices lie on the sphere to rounding, or to the margin of cells (5e-3 wide) it only grazes.
    let mut errors: Vec<_> = mesh.positions.iter().map(|point| sphere(point).abs()).collect();
    errors.sort_by(f32::total_cmp);
    assert!(errors[errors.len() * 98 / 100] < 1e-7 && errors[errors.len() - 1] < 5e-5, "{:?}", errors.last());
    for (point, normal) in mesh.positions.iter().zip(&mesh.normals) {
        let cosine = dot(point.map(f64::from), normal.map(f64::from)) / norm(point.map(f64::from));
        assert!(cosine > 0.9999, "{cosine}");
    }
}

#[test]
fn a_torus_has_its_area_and_volume() {
    let mesh = mesh_of(&VOLUME, torus);
    assert_sound(&mesh);
    close(mesh.area(), TAU * 0.07 * TAU * 0.03, 0.01);
    close(mesh.volume(), TAU * 0.07 * PI * 0.03 * 0.03, 0.01);
}

#[test]
fn fields_that_are_not_distances_are_met_too() {
    // A slope of 7 and a bend: the secant finds what one Newton step with an assumed slope of 1 would miss.
    let mesh = mesh_of(&VOLUME, |point| 7.0 * sphere(point) + 20.0 * sphere(point).powi(2));
    let error = mesh.positions.iter().map(|point| sphere(point).abs()).fold(0.0, f32::max);
    assert!(error < 5e-5, "{error}");
}

#[test]
fn what_leaves_the_volume_is_closed_along_its_walls() {
    let neck = |point: &[f32; 3]| (f64::from(point[0]).hypot(f64::from(point[2])) - 0.05) as f32;
    let mesh = mesh_of(&VOLUME, neck);
    assert_sound(&mesh);
    close(mesh.volume(), PI * 0.05 * 0.05 * 0.24, 0.01);
    close(mesh.area(), TAU * 0.05 * 0.24 + TAU * 0.05 * 0.05, 0.02); // the net rounds the rims off
    let everything = mesh_of(&VOLUME, |_| -1.0);
    assert_sound(&everything);
    close(everything.volume(), 0.24f64.powi(3), 0.01);
}

#[test]
fn sheets_that_touch_are_kept_apart() {
    // Two cubes that share an edge of the grid: one net vertex a cell would join four triangles at an edge.
    let volume = Volume { resolution: 24, ..VOLUME };
    let cubes = |point: &[f32; 3]| {
        let cube =
            |centre: [f32; 3]| (0..3).map(|axis| (point[axis] - centre[axis]).abs() - 0.0298).fold(f32::MIN, f32::max);
        cube([-0.03, -0.03, 0.0]).min(cube([0.03 - 0.01, 0.03 - 0.01, 0.0]))
    };
    let mesh = mesh_of(&volume, cubes);
    assert_sound(&mesh);
    // A noisy field has every ambiguous cell there is.
    let noisy = |point: &[f32; 3]| {
        let hash = point.iter().fold(7u32, |hash, x| (hash ^ x.to_bits()).wrapping_mul(0x9e37_79b1).rotate_left(13));
        (hash >> 8) as f32 / (1 << 24) as f32 - 0.5
    };
    let noise = mesh_of(&volume, noisy);
    assert_eq!(noise.boundary_edges(), 0);
    assert!(noise.triangles.len() > 10_000);
}

#[test]
fn specks_go_and_regions_can_be_taken_out() {
    let two = |point: &[f32; 3]| {
        let [x, y, z] = *point;
        sphere(point).max(-0.12 - y).min(norm([x - 0.1, y - 0.1, z - 0.1].map(f64::from)) as f32 - 0.012)
    };
    let mesh = mesh_of(&VOLUME, two);
    let clean = mesh.without_specks(0.1);
    assert!(clean.positions.len() < mesh.positions.len());
    assert_sound(&clean);
    close(clean.volume(), 4.0 / 3.0 * PI * 0.001, 0.01);
    let hair = clean.restricted_to(Region::Hair.into());
    assert!(hair.boundary_edges() > 0);
    close(hair.area(), 2.0 * PI * 0.01, 0.03);
    assert!(hair.positions.iter().all(|point| point[0] < 0.005));
}

#[test]
fn unfit_volumes_and_fields_are_refused() {
    let fails = |volume: &Volume, distance: f32| {
        extract(volume, |points| Ok(vec![distance; points.len()]), appearance).unwrap_err()
    };
    assert!(matches!(fails(&VOLUME, 1.0), Error::Config { .. }));
    assert!(matches!(fails(&VOLUME, f32::NAN), Error::NotFinite { .. }));
    assert!(matches!(fails(&Volume { resolution: 100_000, ..VOLUME }, 1.0), Error::Config { .. }));
    assert!(matches!(fails(&Volume { max: [-0.12; 3], ..VOLUME }, 1.0), Error::Config { .. }));
    assert!(matches!(fails(&Volume { max: [f32::INFINITY; 3], ..VOLUME }, 1.0), Error::Config { .. }));
    assert!(matches!(extract(&VOLUME, |_| Ok(Vec::new()), appearance).unwrap_err(), Error::Shape { .. }));
}

#[test]
fn a_glb_reads_back_and_is_valid() {
    let mesh = mesh_of(&VOLUME, torus);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("torus.glb");
    mesh.save(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let word = |place: usize| u32::from_le_bytes(bytes[place..place + 4].try_into().unwrap()) as usize;
    assert_eq!((&bytes[..4], word(4), word(8)), (&b"glTF"[..], 2, bytes.len()));
    let json = &bytes[20..20 + word(12)];
    let binary = &bytes[28 + word(12)..];
    assert_eq!(
        (&bytes[16..20], word(12) % 4, word(20 + word(12)), binary.len() % 4),
        (&b"JSON"[..], 0, binary.len(), 0)
    );

    let root: gltf_json::Root = gltf_json::deserialize::from_slice(json).unwrap();
    println!("{}", root.to_string_pretty().unwrap());
    root.validate(&root, gltf_json::Path::new, &mut |path, error| panic!("{}: {error:?}", path()));
    let names: Vec<_> = root.nodes.iter().map(|node| node.name.clone().unwrap()).collect();
    assert_eq!(names, ["face", "hair"]);
    assert_eq!(root.buffers[0].byte_length.0 as usize, binary.len());

    let mut area = 0.0;
    for node in &root.nodes {
        let primitive = &root.meshes[node.mesh.unwrap().value()].primitives[0];
        let data = |accessor: gltf_json::Index<gltf_json::Accessor>, size: usize| {
            let accessor = &root.accessors[accessor.value()];
            let view = &root.buffer_views[accessor.buffer_view.unwrap().value()];
            let (start, length) = (view.byte_offset.unwrap().0 as usize, view.byte_length.0 as usize);
            assert_eq!((start % 4, length), (0, accessor.count.0 as usize * size));
            (accessor, binary[start..start + length].to_vec())
        };
        let attribute = |semantic| primitive.attributes[&gltf_json::validation::Checked::Valid(semantic)];
        let (accessor, positions) = data(attribute(gltf_json::mesh::Semantic::Positions), 12);
        let positions: Vec<[f32; 3]> = bytemuck::pod_collect_to_vec(&positions);
        for axis in 0..3 {
            let bound = |value: &Option<gltf_json::Value>| value.as_ref().unwrap()[axis].as_f64().unwrap() as f32;
            assert_eq!(bound(&accessor.min), positions.iter().map(|p| p[axis]).fold(f32::MAX, f32::min));
            assert_eq!(bound(&accessor.max), positions.iter().map(|p| p[axis]).fold(f32::MIN, f32::max));
        }
        let (accessor, colours) = data(attribute(gltf_json::mesh::Semantic::Colors(0)), 8);
        assert!(accessor.normalized);
        let colours: Vec<[u16; 4]> = bytemuck::pod_collect_to_vec(&colours);
        let srgb = (f64::from(colours[0][0]) / 65535.0).powf(1.0 / 2.4) * 1.055 - 0.055;
        let expected = (128.0 + 1000.0 * positions[0][0]) as u8;
        assert!((srgb * 255.0 - f64::from(expected)).abs() < 0.6, "{} {expected}", srgb * 255.0);
        let (_, normals) = data(attribute(gltf_json::mesh::Semantic::Normals), 12);
        assert_eq!(normals.len(), 12 * positions.len());
        let (_, indices) = data(primitive.indices.unwrap(), 4);
        let triangles: Vec<[u32; 3]> = bytemuck::pod_collect_to_vec(&indices);
        area += Mesh { positions, triangles, ..Mesh::default() }.area();
    }
    close(area, mesh.area(), 1e-6);
}

#[test]
fn ply_and_obj_say_what_the_mesh_holds() {
    let mesh = mesh_of(&Volume { resolution: 16, ..VOLUME }, sphere);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("sphere.ply");
    mesh.save(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let body = bytes.windows(11).position(|window| window == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&bytes[..body]).unwrap();
    assert!(header.contains(&format!("element vertex {}\n", mesh.positions.len())), "{header}");
    assert_eq!(bytes.len() - body, 28 * mesh.positions.len() + 13 * mesh.triangles.len());
    let second = &bytes[body + 28..body + 56];
    assert_eq!(second[..12], *bytemuck::cast_slice::<f32, u8>(&mesh.positions[1]));
    assert_eq!((&second[24..27], second[27]), (&mesh.colours[1][..], mesh.regions[1] as u8));

    let path = folder.path().join("sphere.OBJ");
    mesh.save(&path).unwrap();
    let text = std::fs::read_to_string(&path).unwrap();
    let count = |start: &str| text.lines().filter(|line| line.starts_with(start)).count();
    assert_eq!(
        (count("v "), count("vn "), count("f ")),
        (mesh.positions.len(), mesh.positions.len(), mesh.triangles.len())
    );
    let groups: Vec<_> = text.lines().filter(|line| line.starts_with("g ")).collect();
    assert_eq!(groups, ["g face", "g hair"]);
    let read: Vec<[f32; 3]> = text
        .lines()
        .filter_map(|line| line.strip_prefix("v "))
        .map(|line| {
            let mut numbers = line.split(' ').map(|number| number.parse().unwrap());
            std::array::from_fn(|_| numbers.next().unwrap())
        })
        .collect();
    assert_eq!(read, mesh.positions);

    assert!(matches!(mesh.save(folder.path().join("sphere.stl")), Err(Error::Config { .. })));
    let broken = Mesh { regions: Vec::new(), ..mesh };
    assert!(matches!(broken.save(folder.path().join("broken.glb")), Err(Error::Shape { .. })));
    assert!(!folder.path().join("broken.glb").exists());
}
