//! Mesh files. Each is made in memory and written whole or not at all.

use std::{fmt::Write as _, path::Path};

use gltf_json::{
    Accessor, Asset, Buffer, Index, Material, Node, Root, Scene,
    accessor::{ComponentType, GenericComponentType, Type},
    buffer::{Target, View},
    mesh::{Mode, Primitive, Semantic},
    validation::{Checked::Valid, USize64},
};

use super::Mesh;
use crate::{
    error::{Error, Result},
    files::write_atomically,
    region::{Region, RegionSet},
};

impl Mesh {
    /// Writes the mesh in the format its name asks for: `.glb` (glTF 2.0: one node a region, named by it; vertex
    /// colours linear as the format demands), `.ply` (binary; sRGB colours and a `region` label a vertex) or `.obj`
    /// (sRGB colours after the coordinates; one group a region).
    ///
    /// # Errors
    /// [`Error::Config`] for another extension or a mesh too large for the format, [`Error::Shape`] if the mesh's
    /// vectors do not fit each other, [`Error::Io`] if it cannot be written.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        let path = path.as_ref();
        let extension = path.extension().and_then(|extension| extension.to_str()).unwrap_or_default();
        self.check()?;
        let bytes = match extension.to_ascii_lowercase().as_str() {
            "glb" => self.to_glb()?,
            "ply" => self.to_ply(),
            "obj" => self.to_obj().into_bytes(),
            _ => {
                let reason = format!("{}: a mesh's name must end in .glb, .ply or .obj", path.display());
                return Err(Error::config("out", reason));
            }
        };
        write_atomically(path, &bytes)
    }

    /// Every vector as long as `positions`, every index within it.
    fn check(&self) -> Result<()> {
        let count = self.positions.len();
        for (name, length) in
            [("normals", self.normals.len()), ("colours", self.colours.len()), ("regions", self.regions.len())]
        {
            if length != count {
                return Err(Error::shape(format!("mesh {name}"), [count], &[length]));
            }
        }
        if let Some(vertex) = self.triangles.iter().flatten().find(|vertex| **vertex as usize >= count) {
            return Err(Error::shape("mesh positions", format!("more than {vertex}"), &[count]));
        }
        Ok(())
    }

    /// A binary glTF file.
    fn to_glb(&self) -> Result<Vec<u8>> {
        let mut glb = Glb::default();
        let mut used = RegionSet::EMPTY;
        self.triangle_regions().into_iter().for_each(|region| used = used.with(region));
        glb.root.materials.push(Material {
            name: Some("portrait".into()),
            pbr_metallic_roughness: gltf_json::material::PbrMetallicRoughness {
                metallic_factor: gltf_json::material::StrengthFactor(0.0),
                roughness_factor: gltf_json::material::StrengthFactor(1.0),
                ..Default::default()
            },
            ..Default::default()
        });
        for region in used.iter() {
            glb.add(region, &self.restricted_to(region.into()));
        }
        glb.finish()
    }

    fn to_ply(&self) -> Vec<u8> {
        let labels: Vec<_> = Region::ALL.iter().map(|region| format!("{} {region}", region.index())).collect();
        let mut bytes = format!(
            "ply\nformat binary_little_endian 1.0\ncomment cnerf, regions: {}\nelement vertex {}\n\
             property float x\nproperty float y\nproperty float z\n\
             property float nx\nproperty float ny\nproperty float nz\n\
             property uchar red\nproperty uchar green\nproperty uchar blue\nproperty uchar region\n\
             element face {}\nproperty list uchar uint vertex_indices\nend_header\n",
            labels.join(", "),
            self.positions.len(),
            self.triangles.len()
        )
        .into_bytes();
        let colours = self.colours.iter().zip(&self.regions);
        for ((position, normal), (colour, region)) in self.positions.iter().zip(&self.normals).zip(colours) {
            bytes.extend_from_slice(bytemuck::cast_slice(&position.map(f32::to_le_bytes)));
            bytes.extend_from_slice(bytemuck::cast_slice(&normal.map(f32::to_le_bytes)));
            bytes.extend_from_slice(colour);
            bytes.push(*region as u8);
        }
        for triangle in &self.triangles {
            bytes.push(3);
            bytes.extend_from_slice(bytemuck::cast_slice(&triangle.map(u32::to_le_bytes)));
        }
        bytes
    }

    fn to_obj(&self) -> String {
        let mut text = String::from("# cnerf: x y z r g b, sRGB; one group a region\n");
        // Writing to a String cannot fail.
        let mut line = |arguments: std::fmt::Arguments<'_>| text.write_fmt(arguments).unwrap_or_default();
        for ([x, y, z], colour) in self.positions.iter().zip(&self.colours) {
            let [r, g, b] = colour.map(|channel| f32::from(channel) / 255.0);
            line(format_args!("v {x} {y} {z} {r:.4} {g:.4} {b:.4}\n"));
        }
        for [x, y, z] in &self.normals {
            line(format_args!("vn {x:.5} {y:.5} {z:.5}\n"));
        }
        let of_triangle = self.triangle_regions();
        for region in Region::ALL.into_iter().filter(|region| of_triangle.contains(region)) {
            line(format_args!("g {region}\n"));
            for (triangle, _) in self.triangles.iter().zip(&of_triangle).filter(|(_, of)| **of == region) {
                let [a, b, c] = triangle.map(|vertex| vertex + 1);
                line(format_args!("f {a}//{a} {b}//{b} {c}//{c}\n"));
            }
        }
        text
    }
}

/// A glTF document and its binary chunk under construction.
#[derive(Default)]
struct Glb {
    root: Root,
    binary: Vec<u8>,
}

impl Glb {
    /// Adds a node with a mesh of one primitive, both called like the region.
    fn add(&mut self, region: Region, part: &Mesh) {
        let name = Some(region.name().to_owned());
        let bounds = |fold: fn(f32, f32) -> f32| {
            let first = part.positions.first().copied().unwrap_or_default();
            let bound =
                part.positions.iter().fold(first, |bound, p| std::array::from_fn(|axis| fold(bound[axis], p[axis])));
            Some(gltf_json::Value::from(bound.to_vec()))
        };
        // Normalised 16 bits keep dark colours apart that 8 linear bits would merge, in two thirds of the floats' size.
        let colours: Vec<[u16; 4]> = part.colours.iter().map(|colour| linear(*colour)).collect();
        let vertices = part.positions.len();
        let vertex_data = Some(Target::ArrayBuffer);
        let positions = bytemuck::cast_slice(&part.positions);
        let positions = self.accessor(positions, vertices, ComponentType::F32, Type::Vec3, vertex_data);
        if let Some(accessor) = self.root.accessors.last_mut() {
            (accessor.min, accessor.max) = (bounds(f32::min), bounds(f32::max));
        }
        let normals = bytemuck::cast_slice(&part.normals);
        let normals = self.accessor(normals, vertices, ComponentType::F32, Type::Vec3, vertex_data);
        let colours =
            self.accessor(bytemuck::cast_slice(&colours), vertices, ComponentType::U16, Type::Vec4, vertex_data);
        if let Some(accessor) = self.root.accessors.last_mut() {
            accessor.normalized = true;
        }
        let indices: &[u32] = part.triangles.as_flattened();
        let index_data = Some(Target::ElementArrayBuffer);
        let indices =
            self.accessor(bytemuck::cast_slice(indices), indices.len(), ComponentType::U32, Type::Scalar, index_data);
        let attributes =
            [(Semantic::Positions, positions), (Semantic::Normals, normals), (Semantic::Colors(0), colours)];
        let primitive = Primitive {
            attributes: attributes.into_iter().map(|(semantic, accessor)| (Valid(semantic), accessor)).collect(),
            extensions: None,
            extras: Default::default(),
            indices: Some(indices),
            material: Some(Index::new(0)),
            mode: Valid(Mode::Triangles),
            targets: None,
        };
        let mesh = gltf_json::Mesh {
            extensions: None,
            extras: Default::default(),
            name: name.clone(),
            primitives: vec![primitive],
            weights: None,
        };
        let mesh = self.root.push(mesh);
        self.root.push(Node { mesh: Some(mesh), name, ..Node::default() });
    }

    /// Appends data (a multiple of four bytes, so that everything stays aligned) with its view and accessor.
    fn accessor(
        &mut self,
        data: &[u8],
        count: usize,
        component: ComponentType,
        kind: Type,
        target: Option<Target>,
    ) -> Index<Accessor> {
        let view = self.root.push(View {
            buffer: Index::new(0),
            byte_length: USize64::from(data.len()),
            byte_offset: Some(USize64::from(self.binary.len())),
            byte_stride: None,
            name: None,
            target: target.map(Valid),
            extensions: None,
            extras: Default::default(),
        });
        self.binary.extend_from_slice(data);
        self.root.push(Accessor {
            buffer_view: Some(view),
            byte_offset: Some(USize64(0)),
            count: USize64::from(count),
            component_type: Valid(GenericComponentType(component)),
            extensions: None,
            extras: Default::default(),
            type_: Valid(kind),
            min: None,
            max: None,
            name: None,
            normalized: false,
            sparse: None,
        })
    }

    /// Header, JSON chunk padded with spaces, binary chunk (whole words already).
    fn finish(mut self) -> Result<Vec<u8>> {
        let generator = Some(format!("cnerf {}", env!("CARGO_PKG_VERSION")));
        self.root.asset = Asset { generator, ..Asset::default() };
        self.root.buffers.push(Buffer {
            byte_length: USize64::from(self.binary.len()),
            name: None,
            uri: None,
            extensions: None,
            extras: Default::default(),
        });
        let nodes = (0..self.root.nodes.len() as u32).map(Index::new).collect();
        let scene = self.root.push(Scene { extensions: None, extras: Default::default(), name: None, nodes });
        self.root.scene = Some(scene);
        let mut json = self.root.to_vec().map_err(|error| Error::config("export", error))?;
        json.resize(json.len().next_multiple_of(4), b' ');
        let total = 12 + 8 + json.len() + 8 + self.binary.len();
        let words = [total, json.len(), self.binary.len()].map(u32::try_from);
        let [Ok(total), Ok(json_length), Ok(binary_length)] = words else {
            return Err(Error::config("resolution", "the mesh is larger than a .glb may be (4 GiB); ask for less"));
        };
        let mut bytes = Vec::with_capacity(total as usize);
        bytes.extend_from_slice(b"glTF");
        for word in [2, total, json_length] {
            bytes.extend_from_slice(&word.to_le_bytes());
        }
        bytes.extend_from_slice(b"JSON");
        bytes.extend_from_slice(&json);
        bytes.extend_from_slice(&binary_length.to_le_bytes());
        bytes.extend_from_slice(b"BIN\0");
        bytes.extend_from_slice(&self.binary);
        Ok(bytes)
    }
}

/// sRGB to linear light, opaque, as normalised 16-bit integers.
fn linear(colour: [u8; 3]) -> [u16; 4] {
    let [r, g, b] = colour.map(|channel| {
        let value = f64::from(channel) / 255.0;
        let linear = if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) };
        (linear * 65535.0).round() as u16
    });
    [r, g, b, u16::MAX]
}
