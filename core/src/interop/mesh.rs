//! Surfaces as triangle meshes with a colour and a region at every vertex: extraction from a distance field, checks,
//! and GLB, PLY and OBJ files.

mod manifold;
mod surface;
mod write;

use std::collections::HashMap;

pub use surface::{Appearance, Volume, extract};

use crate::region::{Region, RegionSet};

/// A triangle mesh. Triangles are counter-clockwise seen from outside.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mesh {
    /// World coordinates.
    pub positions: Vec<[f32; 3]>,
    /// Outward unit vectors, one a vertex.
    pub normals: Vec<[f32; 3]>,
    /// sRGB as stored in pictures, one a vertex.
    pub colours: Vec<[u8; 3]>,
    /// The region each vertex belongs to.
    pub regions: Vec<Region>,
    /// Vertex indices.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Whether there is nothing to draw.
    pub fn is_empty(&self) -> bool {
        self.triangles.is_empty()
    }

    /// Edges that are not shared by exactly two triangles of opposite directions: 0 for a closed, consistently
    /// oriented surface.
    pub fn boundary_edges(&self) -> usize {
        let mut edges: HashMap<(u32, u32), (u32, u32)> = HashMap::with_capacity(self.triangles.len() * 3 / 2);
        for [a, b, c] in &self.triangles {
            for (from, to) in [(*a, *b), (*b, *c), (*c, *a)] {
                let count = edges.entry((from.min(to), from.max(to))).or_default();
                *(if from < to { &mut count.0 } else { &mut count.1 }) += 1;
            }
        }
        edges.values().filter(|count| **count != (1, 1)).count()
    }

    /// Surface area, square world units.
    pub fn area(&self) -> f64 {
        (0..self.triangles.len()).map(|triangle| self.triangle_area(triangle)).sum()
    }

    /// Enclosed volume, cubic world units; negative if the triangles face inwards. Only of meaning for closed meshes.
    pub fn volume(&self) -> f64 {
        self.corners().map(|[a, b, c]| dot(a, cross(b, c)) / 6.0).sum()
    }

    /// The region of every triangle: the one that two or more of its vertices share, else that of the first vertex.
    pub fn triangle_regions(&self) -> Vec<Region> {
        let region = |vertex: u32| self.regions.get(vertex as usize).copied().unwrap_or(Region::Background);
        self.triangles
            .iter()
            .map(|&[a, b, c]| {
                let (a, b, c) = (region(a), region(b), region(c));
                if b == c { b } else { a }
            })
            .collect()
    }

    /// The triangles of these regions alone. The surface is then open where a region that was left out began.
    #[must_use]
    pub fn restricted_to(&self, regions: RegionSet) -> Self {
        let of_triangle = self.triangle_regions();
        self.kept(|triangle| of_triangle.get(triangle).is_some_and(|region| regions.contains(*region)))
    }

    /// The mesh without its small loose parts: connected pieces of less than `fraction` of the largest piece's area.
    #[must_use]
    pub fn without_specks(&self, fraction: f64) -> Self {
        let mut pieces = DisjointSets::new(self.positions.len());
        for &[a, b, c] in &self.triangles {
            pieces.join(a as usize, b as usize);
            pieces.join(a as usize, c as usize);
        }
        let piece: Vec<usize> = self.triangles.iter().map(|triangle| pieces.root(triangle[0] as usize)).collect();
        let mut areas = vec![0.0; self.positions.len()];
        for (triangle, &piece) in piece.iter().enumerate() {
            areas[piece] += self.triangle_area(triangle);
        }
        let least = fraction * areas.iter().copied().fold(0.0, f64::max);
        self.kept(|triangle| areas[piece[triangle]] >= least)
    }

    /// The triangles for which `keep` holds and the vertices they use, in order.
    fn kept(&self, keep: impl Fn(usize) -> bool) -> Self {
        let mut kept = Self::default();
        let mut places = vec![u32::MAX; self.positions.len()];
        for (_, triangle) in self.triangles.iter().enumerate().filter(|(index, _)| keep(*index)) {
            let renumbered = triangle.map(|vertex| {
                let old = vertex as usize;
                if places[old] == u32::MAX {
                    places[old] = kept.positions.len() as u32;
                    kept.positions.push(self.positions[old]);
                    kept.normals.push(self.normals[old]);
                    kept.colours.push(self.colours[old]);
                    kept.regions.push(self.regions[old]);
                }
                places[old]
            });
            kept.triangles.push(renumbered);
        }
        kept
    }

    fn corners(&self) -> impl Iterator<Item = [[f64; 3]; 3]> {
        self.triangles.iter().map(|triangle| triangle.map(|vertex| self.positions[vertex as usize].map(f64::from)))
    }

    fn triangle_area(&self, triangle: usize) -> f64 {
        let [a, b, c] = self.triangles[triangle].map(|vertex| self.positions[vertex as usize].map(f64::from));
        0.5 * norm(cross(minus(b, a), minus(c, a)))
    }
}

/// Union-find with path halving.
struct DisjointSets(Vec<usize>);

impl DisjointSets {
    fn new(count: usize) -> Self {
        Self((0..count).collect())
    }

    fn root(&mut self, mut item: usize) -> usize {
        while self.0[item] != item {
            self.0[item] = self.0[self.0[item]];
            item = self.0[item];
        }
        item
    }

    /// The lower root becomes the root of both: results do not depend on the order of joins.
    fn join(&mut self, left: usize, right: usize) {
        let (left, right) = (self.root(left), self.root(right));
        self.0[left.max(right)] = left.min(right);
    }
}

fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|axis| a[axis] - b[axis])
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn norm(a: [f64; 3]) -> f64 {
    dot(a, a).sqrt()
}

#[cfg(test)]
mod tests;
