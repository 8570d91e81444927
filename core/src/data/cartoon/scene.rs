//! A portrait as solids: groups of parts joined by fillets, and a grid that says which parts matter where.

use glam::Vec3;

use super::shape::{Lock, Shape, smooth_max, smooth_min};
use crate::region::Region;

/// World units of one head unit: the unit in which portraits are modelled, about half a head's width.
pub(super) const WORLD_PER_UNIT: f32 = 0.056;
/// Nothing lies farther than this from the origin, head units.
pub(super) const BOUND: f32 = 2.8;
/// The lowest point of a bust, head units; the grid's edge.
pub(super) const FLOOR: f32 = -2.5;

/// Within this distance of a surface the parts are asked; farther away the grid knows enough.
const EXACT_WITHIN: f32 = 0.11;
/// Within this distance of a surface the grid's cells hold the true distance of their centres.
const GRID_EXACT_WITHIN: f32 = 0.45;
const CELL: f32 = 0.1;
const CELLS: usize = 48;
/// Lower corner of the grid.
const CORNER: Vec3 = Vec3::new(-2.4, -2.6, -2.4);
/// How far a cell's parts and distance must hold: half its diagonal, and 15 % more because the first-order distances of
/// flat ellipsoids change faster than the point moves.
const CELL_RADIUS: f32 = STEEPNESS * 0.5 * CELL * 1.732_051;
const STEEPNESS: f32 = 1.15;
const BLOCK: usize = 4;

/// What a part is made of: how it is shaded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Material {
    /// Skin of face, nose, ears, neck.
    Skin,
    /// Lips.
    Lip,
    /// Hollow of the mouth.
    MouthInside,
    /// Teeth.
    Teeth,
    /// Tongue.
    Tongue,
    /// Eyeball; 0 the eye at +x, 1 the eye at −x.
    Eyeball(u8),
    /// Lashes.
    Lash,
    /// Eyebrow.
    Brow,
    /// Hair.
    Hair,
    /// Short stubble close to the scalp.
    Stubble,
    /// Ribbons, ties and knitted hats.
    HairAccent,
    /// Garment.
    Garment,
    /// Second colour of the garment: ribs, collars, buttons, strings.
    Trim,
    /// Ornament of the ear.
    Metal,
}

/// How hair runs over a part: gives the direction and the coordinate across the strands.
#[derive(Clone, Copy, Debug)]
pub(super) enum Flow {
    /// No strands.
    None,
    /// Strands are meridians around an axis: they run from one pole to the other.
    Meridian {
        /// A point of the axis.
        origin: Vec3,
        /// Unit axis.
        axis: Vec3,
    },
    /// Strands run along an axis; on a tube they run along its curve whatever the flow.
    Along {
        /// A point of the axis.
        origin: Vec3,
        /// Unit axis.
        axis: Vec3,
    },
}

/// How a part changes what stands before it in its group.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Operation {
    /// Joined.
    Add,
    /// Cut away; the cut has the material of what was cut.
    Cut,
    /// Cut away; the cut's surface belongs to this part.
    Hollow,
}

/// One solid of a portrait.
#[derive(Clone, Debug)]
pub(super) struct Part {
    /// Its form.
    pub shape: Shape,
    /// Added or cut.
    pub operation: Operation,
    /// Width of the fillet with what stands before it.
    pub blend: f32,
    /// Whether its mirror image in x stands too.
    pub mirrored: bool,
    /// Label of its surface.
    pub region: Region,
    /// Look of its surface.
    pub material: Material,
    /// Direction of its strands.
    pub flow: Flow,
    group: u8,
    /// Widest fillet of the parts after this one in its group.
    later_blend: f32,
}

impl Part {
    #[inline]
    fn distance(&self, point: Vec3) -> f32 {
        if self.mirrored {
            self.shape.distance(Vec3::new(point.x.abs(), point.y, point.z))
        } else {
            self.shape.distance(point)
        }
    }
}

/// Parts under construction: later parts of a group act on what earlier ones left; groups are then united.
#[derive(Debug, Default)]
pub(super) struct Builder {
    parts: Vec<Part>,
    group: u8,
    region: Option<Region>,
    material: Option<Material>,
    flow: Option<Flow>,
    mirrored: bool,
    offset: Vec3,
}

impl Builder {
    /// Parts that follow form a new group, hard-edged against the others.
    pub fn group(&mut self) -> &mut Self {
        self.group += 1;
        self.flow = None;
        self
    }

    /// Region and material of the parts that follow; strands are reset.
    pub fn paint(&mut self, region: Region, material: Material) -> &mut Self {
        (self.region, self.material, self.flow) = (Some(region), Some(material), None);
        self
    }

    /// Strands of the parts that follow.
    pub fn flow(&mut self, flow: Flow) -> &mut Self {
        self.flow = Some(flow);
        self
    }

    /// Whether the parts that follow stand on both sides.
    pub fn mirrored(&mut self, mirrored: bool) -> &mut Self {
        self.mirrored = mirrored;
        self
    }

    /// Moves the parts that follow.
    pub fn offset(&mut self, offset: Vec3) -> &mut Self {
        self.offset = offset;
        self
    }

    /// Joins a solid.
    pub fn add(&mut self, shape: Shape, blend: f32) -> &mut Self {
        self.push(shape, blend, Operation::Add)
    }

    /// Cuts a solid away.
    pub fn cut(&mut self, shape: Shape, blend: f32) -> &mut Self {
        self.push(shape, blend, Operation::Cut)
    }

    /// Cuts a solid away and paints the cut.
    pub fn hollow(&mut self, shape: Shape, blend: f32) -> &mut Self {
        self.push(shape, blend, Operation::Hollow)
    }

    /// Joins a tapered tube along a smooth curve through `knots` (point, radius); the closest point is searched from
    /// `pieces` places a knot.
    pub fn lock(&mut self, knots: &[(Vec3, f32)], pieces: usize, blend: f32) -> &mut Self {
        self.add(Shape::Lock(Lock::new(knots, pieces)), blend)
    }

    /// A copy of a finished or current group, to place parts against.
    pub fn group_view(&self, group: u8) -> Self {
        let parts = self.parts.iter().filter(|part| part.group == group).cloned().collect();
        Self { parts, group, ..Self::default() }
    }

    /// Distance to what the current group holds so far.
    pub fn distance(&self, point: Vec3) -> f32 {
        let group = self.parts.iter().filter(|part| part.group == self.group);
        group.fold(1e3, |distance, part| combine(distance, part.distance(point), part))
    }

    /// Point of the current group's surface in front of (x, y); a point inside the head if there is none.
    pub fn front(&self, x: f32, y: f32) -> Vec3 {
        let mut z = 1.6;
        for _ in 0..64 {
            let distance = self.distance(Vec3::new(x, y, z));
            z -= distance;
            if distance < 1e-4 || z < -1.0 {
                break;
            }
        }
        Vec3::new(x, y, z.max(-0.2))
    }

    fn push(&mut self, shape: Shape, blend: f32, operation: Operation) -> &mut Self {
        self.parts.push(Part {
            shape: shape.moved(self.offset),
            operation,
            blend,
            mirrored: self.mirrored,
            region: self.region.unwrap_or(Region::Face),
            material: self.material.unwrap_or(Material::Skin),
            flow: self.flow.unwrap_or(Flow::None),
            group: self.group,
            later_blend: 0.0,
        });
        self
    }

    /// The finished scene.
    pub fn finish(self) -> Scene {
        Scene::new(self.parts)
    }
}

#[inline]
fn combine(distance: f32, part_distance: f32, part: &Part) -> f32 {
    match part.operation {
        Operation::Add => smooth_min(distance, part_distance, part.blend),
        Operation::Cut | Operation::Hollow => smooth_max(distance, -part_distance, part.blend),
    }
}

/// Gradient by four differences at the corners of a tetrahedron with half edge `step`, and the mean of the four values:
/// the distance in the middle, to second order.
#[inline]
pub(super) fn gradient(point: Vec3, step: f32, distance: impl Fn(Vec3) -> f32) -> (Vec3, f32) {
    const CORNERS: [Vec3; 4] =
        [Vec3::new(1.0, -1.0, -1.0), Vec3::new(-1.0, -1.0, 1.0), Vec3::new(-1.0, 1.0, -1.0), Vec3::new(1.0, 1.0, 1.0)];
    let (mut slope, mut sum) = (Vec3::ZERO, 0.0);
    for corner in CORNERS {
        let value = distance(point + step * corner);
        slope += value * corner;
        sum += value;
    }
    (slope / (4.0 * step), 0.25 * sum)
}

#[derive(Clone, Copy, Debug)]
struct Cell {
    /// Signed distance at the centre, or a lower bound of it.
    distance: f32,
    first: u32,
    /// Number of parts that can matter in the cell; `FAR_CELL` if its parts were not kept.
    count: u16,
}

const FAR_CELL: u16 = u16::MAX;

/// A portrait ready to be traced.
#[derive(Debug)]
pub(super) struct Scene {
    parts: Vec<Part>,
    cells: Vec<Cell>,
    members: Vec<u16>,
}

impl Scene {
    fn new(mut parts: Vec<Part>) -> Self {
        let (mut group, mut widest) = (u8::MAX, 0.0f32);
        for part in parts.iter_mut().rev() {
            if part.group != group {
                (group, widest) = (part.group, 0.0);
            }
            part.later_blend = widest;
            widest = widest.max(part.blend);
        }
        let mut scene = Self { parts, cells: Vec::new(), members: Vec::new() };
        scene.build_grid();
        scene
    }

    /// The part with this index.
    pub fn part(&self, index: usize) -> &Part {
        &self.parts[index]
    }

    /// Coarse blocks first: each hands its cells only the parts that can matter in it.
    fn build_grid(&mut self) {
        let empty = Cell { distance: 0.0, first: 0, count: FAR_CELL };
        self.cells = vec![empty; CELLS * CELLS * CELLS];
        let everything: Vec<u16> = (0..self.parts.len() as u16).collect();
        let (mut in_block, mut in_cell, mut distances) = (Vec::new(), Vec::new(), Vec::new());
        let block_radius = BLOCK as f32 * CELL_RADIUS;
        for block in 0..(CELLS / BLOCK).pow(3) {
            let corner = unravel(block, CELLS / BLOCK).map(|index| index * BLOCK);
            let middle = cell_centre(corner) + Vec3::splat(0.5 * CELL * (BLOCK - 1) as f32);
            let distance = self.cull(middle, block_radius, &everything, &mut in_block, &mut distances);
            let far = distance > GRID_EXACT_WITHIN + block_radius || distance < -0.2 - block_radius;
            for local in 0..BLOCK.pow(3) {
                let offset = unravel(local, BLOCK);
                let index = [corner[0] + offset[0], corner[1] + offset[1], corner[2] + offset[2]];
                let centre = cell_centre(index);
                let cell = if far {
                    Cell { distance: distance - STEEPNESS * (centre - middle).length(), ..empty }
                } else {
                    let distance = self.cull(centre, CELL_RADIUS, &in_block, &mut in_cell, &mut distances);
                    if !(-0.04 - CELL_RADIUS..=EXACT_WITHIN + CELL_RADIUS).contains(&distance) {
                        Cell { distance, ..empty }
                    } else {
                        let first = self.members.len() as u32;
                        self.members.extend_from_slice(&in_cell);
                        Cell { distance, first, count: in_cell.len() as u16 }
                    }
                };
                self.cells[ravel(index)] = cell;
            }
        }
    }

    /// Fills `kept` with those of `candidates` that can change the distance or the surface's part within `radius` of
    /// `centre`; returns the distance at the centre.
    ///
    /// All distances change by at most `radius` within the ball. An added part does nothing where it is farther than
    /// what stands before it by its fillet k; where it does something it leaves at least d − 1.25 k, which later parts
    /// overrule where they are closer by their own widest fillet. A group does nothing where another is closer.
    fn cull(
        &self,
        centre: Vec3,
        radius: f32,
        candidates: &[u16],
        kept: &mut Vec<u16>,
        distances: &mut Vec<(f32, f32)>,
    ) -> f32 {
        kept.clear();
        distances.clear();
        let parts = &self.parts;
        let groups =
            || candidates.chunk_by(|left, right| parts[usize::from(*left)].group == parts[usize::from(*right)].group);
        let mut closest = 1e3f32;
        for members in groups() {
            let mut distance = 1e3;
            for member in members {
                let part = &parts[usize::from(*member)];
                let part_distance = part.distance(centre);
                distances.push((part_distance, distance));
                distance = combine(distance, part_distance, part);
            }
            closest = closest.min(distance);
        }
        let mut start = 0;
        for members in groups() {
            let own = &distances[start..start + members.len()];
            start += members.len();
            let Some((last, &(last_distance, before_last))) = members.last().zip(own.last()) else { continue };
            let distance = combine(before_last, last_distance, &parts[usize::from(*last)]);
            if distance - radius > closest + radius {
                continue;
            }
            for (member, &(part_distance, before)) in members.iter().zip(own) {
                let part = &parts[usize::from(*member)];
                let matters = match part.operation {
                    Operation::Add => {
                        part_distance - before <= 2.0 * radius + part.blend
                            && part_distance - distance <= 2.0 * radius + 1.25 * part.blend + part.later_blend
                    }
                    Operation::Cut | Operation::Hollow => part_distance + before.min(10.0) <= 2.0 * radius + part.blend,
                };
                if matters {
                    kept.push(*member);
                }
            }
        }
        closest
    }

    #[inline]
    fn cell(&self, point: Vec3) -> (&Cell, Vec3) {
        let scaled = (point - CORNER) / CELL;
        let limit = (CELLS - 1) as f32;
        let index = [scaled.x, scaled.y, scaled.z].map(|value| value.clamp(0.0, limit) as usize);
        (&self.cells[ravel(index)], cell_centre(index))
    }

    /// Distance to the surface, interpolated between the grid's cells: cheap, and smooth enough for soft light.
    /// Beyond [`GRID_EXACT_WITHIN`] about a lower bound of it.
    #[inline]
    pub fn soft_distance(&self, point: Vec3) -> f32 {
        let scaled = (point - CORNER) / CELL - Vec3::splat(0.5);
        let scaled = scaled.clamp(Vec3::ZERO, Vec3::splat((CELLS - 1) as f32 - 1e-3));
        let low = scaled.floor();
        let share = scaled - low;
        let first = ravel(low.to_array().map(|value| value as usize));
        let row = |start: usize| {
            let (left, right) = (self.cells[start].distance, self.cells[start + 1].distance);
            left + share.x * (right - left)
        };
        let plane = |start: usize| {
            let (low, high) = (row(start), row(start + CELLS));
            low + share.y * (high - low)
        };
        let (near, far) = (plane(first), plane(first + CELLS * CELLS));
        near + share.z * (far - near)
    }

    /// Distance to the surface; beyond [`EXACT_WITHIN`] a lower bound of it.
    #[inline]
    pub fn distance(&self, point: Vec3) -> f32 {
        let (cell, centre) = self.cell(point);
        if cell.count == FAR_CELL {
            return cell.distance - STEEPNESS * (point - centre).length();
        }
        let mut closest = 1e3f32;
        let mut group_distance = 1e3f32;
        let mut group = u8::MAX;
        for member in &self.members[cell.first as usize..cell.first as usize + usize::from(cell.count)] {
            let part = &self.parts[usize::from(*member)];
            if part.group != group {
                closest = closest.min(group_distance);
                (group, group_distance) = (part.group, 1e3);
            }
            group_distance = combine(group_distance, part.distance(point), part);
        }
        closest.min(group_distance)
    }

    /// Index of the part whose surface is the one at `point`.
    pub fn part_at(&self, point: Vec3) -> Option<usize> {
        let (cell, _) = self.cell(point);
        if cell.count == FAR_CELL {
            return None;
        }
        let mut best: Option<(f32, usize)> = None;
        let mut running: Option<(f32, usize)> = None;
        let mut group = u8::MAX;
        let closer = |left: Option<(f32, usize)>, right: Option<(f32, usize)>| match (left, right) {
            (Some(left), Some(right)) => Some(if right.0 < left.0 { right } else { left }),
            (left, right) => left.or(right),
        };
        for member in &self.members[cell.first as usize..cell.first as usize + usize::from(cell.count)] {
            let index = usize::from(*member);
            let part = &self.parts[index];
            if part.group != group {
                best = closer(best, running.take());
                group = part.group;
            }
            let part_distance = part.distance(point);
            running = match (running, part.operation) {
                (None, Operation::Add) => Some((part_distance, index)),
                (None, _) => None,
                (Some((distance, owner)), operation) => {
                    let takes = match operation {
                        Operation::Add => part_distance < distance,
                        Operation::Cut => false,
                        Operation::Hollow => -part_distance > distance,
                    };
                    Some((combine(distance, part_distance, part), if takes { index } else { owner }))
                }
            };
        }
        closer(best, running).map(|(_, index)| index)
    }

    /// First surface along a ray with unit direction, between two distances; the hit's distance along the ray.
    /// A surface counts as hit within `tolerance`.
    pub fn trace(&self, origin: Vec3, direction: Vec3, range: (f32, f32), tolerance: f32) -> Option<f32> {
        let mut along = range.0;
        for _ in 0..160 {
            let distance = self.distance(origin + along * direction);
            if distance < tolerance {
                return Some(along);
            }
            along += 0.96 * distance;
            if along > range.1 {
                return None;
            }
        }
        // A ray that crawls along a surface this long is closer to it than a pixel.
        (self.distance(origin + along * direction) < 8.0 * tolerance).then_some(along)
    }

    /// Share of a soft light seen from `point` in unit direction `direction`, 0 in full shadow.
    /// `sharpness` is one over the light's angular radius.
    pub fn visibility(&self, point: Vec3, direction: Vec3, sharpness: f32) -> f32 {
        const EXACT_ALONG: f32 = 0.13;
        let mut share = 1.0f32;
        let mut along = 0.05;
        for _ in 0..40 {
            let ahead = point + along * direction;
            // Small features throw their shadow close by; farther away the grid is fine enough.
            let distance = if along < EXACT_ALONG { self.distance(ahead) } else { self.soft_distance(ahead) + 0.015 };
            if distance < 0.9 * EXACT_WITHIN || along >= EXACT_ALONG {
                share = share.min(sharpness * distance / along);
            }
            if share < 0.01 {
                return 0.0;
            }
            along += distance.clamp(0.025, 0.4);
            if along > 2.4 {
                break;
            }
        }
        share * share * (3.0 - 2.0 * share)
    }
}

fn unravel(index: usize, side: usize) -> [usize; 3] {
    [index % side, index / side % side, index / (side * side)]
}

#[inline]
fn ravel([x, y, z]: [usize; 3]) -> usize {
    (z * CELLS + y) * CELLS + x
}

#[inline]
fn cell_centre(index: [usize; 3]) -> Vec3 {
    let [x, y, z] = index.map(|value| value as f32 + 0.5);
    CORNER + CELL * Vec3::new(x, y, z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        data::cartoon::{HairStyle, Identity, clothes, hair, head},
        rng::Stream,
    };

    /// The grid leaves parts out only where they do nothing, and what it says of empty space is never too much.
    #[test]
    fn the_grid_agrees_with_all_parts_together() {
        let mut stream = Stream::new(1, &[]);
        for (seed, style) in HairStyle::ALL.into_iter().enumerate() {
            let mut identity = Identity::sample(seed as u64);
            identity.hair.style = style;
            let mut builder = Builder::default();
            let anatomy = head::build(&mut builder, &identity);
            clothes::build(&mut builder, &identity, &anatomy);
            hair::build(&mut builder, &identity, &anatomy);
            let scene = builder.finish();
            let whole = |point: Vec3| {
                scene
                    .parts
                    .chunk_by(|left, right| left.group == right.group)
                    .map(|group| group.iter().fold(1e3, |distance, part| combine(distance, part.distance(point), part)))
                    .fold(1e3, f32::min)
            };
            let mut near = 0;
            for _ in 0..4000 {
                let mut draw = |scale: f32| scale * stream.range(-1.0, 1.0);
                let point = Vec3::new(draw(1.6), draw(2.0) - 0.2, draw(1.6));
                let (truth, found) = (whole(point), scene.distance(point));
                if truth < 0.0 {
                    continue; // inside, where nothing looks
                }
                // Far from a flat ellipsoid its first-order distance is itself a few percent short of the true one.
                assert!(found <= 1.06 * truth + 1e-3, "{style:?} at {point}: {found} > {truth}");
                if truth < EXACT_WITHIN {
                    near += 1;
                    assert!((found - truth).abs() < 1e-3, "{style:?} at {point}: {found}, not {truth}");
                }
            }
            assert!(near > 100, "{near} points near the surface");
        }
    }
}
