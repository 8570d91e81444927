//! Makes every edge of a closed triangle soup join exactly two triangles.
//!
//! A cell of the surface net has one vertex even when two sheets of the surface pass through it, so that four triangles
//! may share an edge. Slicers, boolean operations and area or volume integrals want two.

use std::collections::HashMap;

use super::{DisjointSets, cross, dot, minus, norm};

/// An edge of a triangle: from its `corner`-th vertex to the next.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Side {
    triangle: usize,
    corner: usize,
}

impl Side {
    fn start(self) -> usize {
        3 * self.triangle + self.corner
    }

    fn end(self) -> usize {
        3 * self.triangle + (self.corner + 1) % 3
    }
}

/// Doubles the vertices along which sheets touch, one for each sheet; edges whose two ends the sheets go on to share
/// get a point in the middle of their own instead. No triangle moves.
///
/// The triangles must be closed and consistently oriented: every edge is used as often in one direction as the other.
pub(super) fn separate_sheets(
    mut positions: Vec<[f32; 3]>,
    mut triangles: Vec<[u32; 3]>,
) -> (Vec<[f32; 3]>, Vec<[u32; 3]>) {
    let pairs = pair_sides(&positions, &triangles);

    // Corners of triangles that meet along an edge of one sheet are one vertex.
    let mut corners = DisjointSets::new(3 * triangles.len());
    for &(forward, backward) in &pairs {
        corners.join(forward.start(), backward.end());
        corners.join(forward.end(), backward.start());
    }
    let mut owner = vec![usize::MAX; positions.len()];
    let mut doubled = HashMap::new();
    for (index, triangle) in triangles.iter_mut().enumerate() {
        for (corner, vertex) in triangle.iter_mut().enumerate() {
            let root = corners.root(3 * index + corner);
            let old = *vertex as usize;
            if owner[old] == usize::MAX {
                owner[old] = root;
            } else if owner[old] != root {
                *vertex = *doubled.entry(root).or_insert_with(|| {
                    positions.push(positions[old]);
                    positions.len() as u32 - 1
                });
            }
        }
    }

    let mut seen = HashMap::new();
    let mut middles: HashMap<usize, [Option<u32>; 3]> = HashMap::new();
    for (forward, backward) in pairs {
        let ends = [forward.corner, (forward.corner + 1) % 3].map(|corner| triangles[forward.triangle][corner]);
        if seen.insert(ends, ()).is_some() {
            let [from, to] = ends.map(|end| positions[end as usize]);
            positions.push(std::array::from_fn(|axis| 0.5 * (from[axis] + to[axis])));
            let middle = Some(positions.len() as u32 - 1);
            for side in [forward, backward] {
                middles.entry(side.triangle).or_default()[side.corner] = middle;
            }
        }
    }
    if !middles.is_empty() {
        let whole = |index: usize| middles.get(&index).copied().unwrap_or_default();
        triangles = triangles.iter().enumerate().flat_map(|(index, corners)| divide(*corners, whole(index))).collect();
    }
    (positions, triangles)
}

/// Pairs every use of an edge in its forward direction (low to high vertex) with one in the backward direction.
fn pair_sides(positions: &[[f32; 3]], triangles: &[[u32; 3]]) -> Vec<(Side, Side)> {
    let mut uses: Vec<(u32, u32, Side)> = Vec::with_capacity(3 * triangles.len());
    for (index, triangle) in triangles.iter().enumerate() {
        for corner in 0..3 {
            let (from, to) = (triangle[corner], triangle[(corner + 1) % 3]);
            uses.push((from.min(to), from.max(to), Side { triangle: index, corner }));
        }
    }
    uses.sort_unstable();
    let mut pairs = Vec::with_capacity(uses.len() / 2);
    for shared in uses.chunk_by(|left, right| (left.0, left.1) == (right.0, right.1)) {
        let (low, high) = (shared[0].0, shared[0].1);
        let sides = shared.iter().map(|(_, _, side)| *side);
        let (forward, mut backward): (Vec<_>, Vec<_>) =
            sides.partition(|side| triangles[side.triangle][side.corner] == low);
        for side in forward {
            let turn = |other: &Side| turn(positions, triangles, [low, high], side, *other);
            let nearest = (0..backward.len()).min_by(|&a, &b| turn(&backward[a]).total_cmp(&turn(&backward[b])));
            if let Some(nearest) = nearest {
                pairs.push((side, backward.swap_remove(nearest)));
            }
        }
    }
    pairs
}

/// The angle, 0 to 2 pi, round the edge from one triangle through the solid to another. The backward triangle with the
/// least bounds the same piece of solid as the forward one: paired so, pieces that touch come apart.
fn turn(positions: &[[f32; 3]], triangles: &[[u32; 3]], edge: [u32; 2], from: Side, to: Side) -> f64 {
    let point = |vertex: u32| positions[vertex as usize].map(f64::from);
    let third = |side: Side| point(triangles[side.triangle][(side.corner + 2) % 3]);
    let [low, high] = edge.map(point);
    let axis = minus(high, low);
    let (from, to) = (cross(axis, minus(third(from), low)), cross(axis, minus(third(to), low)));
    let sine = dot(cross(to, from), axis) / norm(axis).max(f64::MIN_POSITIVE);
    sine.atan2(dot(from, to)).rem_euclid(std::f64::consts::TAU)
}

/// The parts of a triangle some of whose sides have a point in the middle.
fn divide(corners: [u32; 3], middles: [Option<u32>; 3]) -> Vec<[u32; 3]> {
    // Turned so that a side without a point comes last, and of two with a point none comes before.
    let turned = |by: usize| -> ([u32; 3], [Option<u32>; 3]) {
        (std::array::from_fn(|i| corners[(i + by) % 3]), std::array::from_fn(|i| middles[(i + by) % 3]))
    };
    let by = match middles {
        [None, Some(_), _] => 1,
        [_, None, Some(_)] => 2,
        _ => 0,
    };
    match turned(by) {
        ([a, b, c], [Some(ab), Some(bc), Some(ca)]) => vec![[a, ab, ca], [ab, b, bc], [bc, c, ca], [ab, bc, ca]],
        ([a, b, c], [Some(ab), Some(bc), None]) => vec![[ab, b, bc], [a, ab, bc], [a, bc, c]],
        ([a, b, c], [Some(ab), None, _]) => vec![[a, ab, c], [ab, b, c]],
        (whole, [None, ..]) => vec![whole],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pattern_of_middles_divides_a_triangle_into_its_whole() {
        for pattern in 0..8u32 {
            let middles = std::array::from_fn(|side| (pattern >> side & 1 == 1).then_some(3 + side as u32));
            let parts = divide([0, 1, 2], middles);
            assert_eq!(parts.len() as u32, 1 + pattern.count_ones());
            let place = [[0.0, 0.0], [2.0, 0.0], [0.0, 2.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
            let area = |[a, b, c]: [u32; 3]| {
                let [a, b, c]: [[f64; 2]; 3] = [a, b, c].map(|vertex| place[vertex as usize]);
                0.5 * ((b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]))
            };
            assert!(parts.iter().all(|part| area(*part) > 0.4), "{pattern}: {parts:?}");
            assert!((parts.iter().map(|part| area(*part)).sum::<f64>() - 2.0).abs() < 1e-12);
        }
    }
}
