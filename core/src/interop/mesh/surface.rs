//! From a distance field to a closed surface: Naive Surface Nets on a grid, its vertices then moved onto the surface.

use fast_surface_nets::{SurfaceNetsBuffer, ndshape::RuntimeShape, surface_nets};

use super::{Mesh, cross, dot, manifold::separate_sheets, minus, norm};
use crate::{
    error::{Error, Result},
    region::Region,
};

const MAX_RESOLUTION: usize = 1024;
const MAX_GRID_POINTS: usize = 1 << 28;
const POINTS_PER_CALL: usize = 1 << 16;
const SECANT_STEPS: usize = 3;
/// A vertex may come this close to its cell's walls, in cells: two vertices never meet.
const CELL_MARGIN: f32 = 0.005;

/// The box in which a surface is looked for, and how finely.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Volume {
    /// Lowest corner, world.
    pub min: [f32; 3],
    /// Highest corner, world.
    pub max: [f32; 3],
    /// Cells along the longest side, 2 to 1024 (and at most 2^28 grid points in all).
    pub resolution: usize,
}

/// What a vertex looks like.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Appearance {
    /// sRGB as stored in pictures.
    pub colour: [u8; 3],
    /// The region seen there.
    pub region: Region,
}

/// The zero level of a distance field as a closed mesh.
///
/// `distances` takes world points in batches and gives their signed distances (negative inside; any function whose
/// sign and slope near the surface are right will do). `appearance` takes the final vertices and their outward
/// normals. What leaves the volume, such as a portrait's neck, is closed along the volume's walls; to cut along another
/// shape, take the maximum with its distance in `distances`.
///
/// Vertices lie on the surface up to a few secant steps within their grid cell. The mesh is closed and consistently
/// oriented ([`Mesh::boundary_edges`] is 0): where two sheets touch along an edge the vertices are doubled.
///
/// # Errors
/// [`Error::Config`] if the volume is empty, the resolution is out of bounds or there is no surface;
/// [`Error::NotFinite`] and [`Error::Shape`] if the closures' results are unfit; their own errors otherwise.
pub fn extract(
    volume: &Volume,
    distances: impl Fn(&[[f32; 3]]) -> Result<Vec<f32>>,
    appearance: impl Fn(&[[f32; 3]], &[[f32; 3]]) -> Result<Vec<Appearance>>,
) -> Result<Mesh> {
    let grid = Grid::new(volume)?;
    let field = Clipped { volume, distances };
    let samples = grid.sample(&field)?;
    let mut nets = SurfaceNetsBuffer::default();
    let last = grid.counts.map(|count| count - 1);
    surface_nets(&samples, &RuntimeShape::<u32, 3>::new(grid.counts), [0; 3], last, &mut nets);
    drop(samples);
    if nets.indices.is_empty() {
        return Err(Error::config("export", "there is no surface inside the volume; is the portrait's model trained?"));
    }

    let positions = grid.refine(&field, &nets)?;
    let (quads, _) = nets.indices.as_chunks::<6>();
    let triangles: Vec<[u32; 3]> = quads.iter().flat_map(|quad| split(quad, &positions)).collect();
    let (positions, triangles) = separate_sheets(positions, triangles);
    let normals = normals(&field, &positions, &triangles, grid.spacing)?;

    let mut mesh = Mesh { positions, normals, triangles, ..Mesh::default() };
    for (points, normals) in mesh.positions.chunks(POINTS_PER_CALL).zip(mesh.normals.chunks(POINTS_PER_CALL)) {
        let seen = appearance(points, normals)?;
        if seen.len() != points.len() {
            return Err(Error::shape("mesh appearance", [points.len()], &[seen.len()]));
        }
        mesh.colours.extend(seen.iter().map(|vertex| vertex.colour));
        mesh.regions.extend(seen.iter().map(|vertex| vertex.region));
    }
    Ok(mesh)
}

/// The field within the volume's walls: the maximum of its distance and the box's.
struct Clipped<'a, D> {
    volume: &'a Volume,
    distances: D,
}

impl<D: Fn(&[[f32; 3]]) -> Result<Vec<f32>>> Clipped<'_, D> {
    fn wall(&self, point: [f32; 3]) -> f32 {
        let Volume { min, max, .. } = self.volume;
        (0..3).map(|axis| (min[axis] - point[axis]).max(point[axis] - max[axis])).fold(f32::NEG_INFINITY, f32::max)
    }

    fn at(&self, points: &[[f32; 3]]) -> Result<Vec<f32>> {
        let mut values = Vec::with_capacity(points.len());
        for batch in points.chunks(POINTS_PER_CALL) {
            let distances = (self.distances)(batch)?;
            if distances.len() != batch.len() {
                return Err(Error::shape("mesh distances", [batch.len()], &[distances.len()]));
            }
            for (point, distance) in batch.iter().zip(distances) {
                if !distance.is_finite() {
                    let context = Some(format!("at {point:?}; the model's weights are damaged"));
                    return Err(Error::NotFinite { quantity: "signed distance".into(), context });
                }
                values.push(distance.max(self.wall(*point)));
            }
        }
        Ok(values)
    }
}

/// The sampling grid: the volume and points outside it on every side, one before and two after (the net makes no faces in
/// its last layer of cells), so that no surface reaches the grid's edge.
struct Grid {
    counts: [u32; 3],
    origin: [f32; 3],
    spacing: f32,
}

impl Grid {
    fn new(volume: &Volume) -> Result<Self> {
        let sides: [f32; 3] = std::array::from_fn(|axis| volume.max[axis] - volume.min[axis]);
        if !sides.iter().all(|side| side.is_finite() && *side > 0.0) {
            return Err(Error::config("volume", format!("{:?} to {:?} is empty", volume.min, volume.max)));
        }
        let resolution = volume.resolution;
        if !(2..=MAX_RESOLUTION).contains(&resolution) {
            return Err(Error::config("resolution", format!("{resolution} is not between 2 and {MAX_RESOLUTION}")));
        }
        let spacing = sides.iter().copied().fold(0.0, f32::max) / resolution as f32;
        let counts = sides.map(|side| (side / spacing).ceil() as u32 + 4);
        if counts.iter().map(|count| *count as usize).product::<usize>() > MAX_GRID_POINTS {
            let reason = format!("{resolution} makes a grid of more than {MAX_GRID_POINTS} points; ask for less");
            return Err(Error::config("resolution", reason));
        }
        Ok(Self { counts, origin: volume.min.map(|min| min - spacing), spacing })
    }

    fn point(&self, place: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|axis| self.origin[axis] + self.spacing * place[axis])
    }

    /// Distances at all grid points, x fastest. Points on or outside the walls are not asked for.
    fn sample<D: Fn(&[[f32; 3]]) -> Result<Vec<f32>>>(&self, field: &Clipped<'_, D>) -> Result<Vec<f32>> {
        let [width, height, depth] = self.counts;
        let mut samples = Vec::with_capacity((width * height * depth) as usize);
        let mut inside = Vec::new();
        for z in 0..depth {
            let layer = samples.len();
            inside.clear();
            for (y, x) in (0..height).flat_map(|y| (0..width).map(move |x| (y, x))) {
                let point = self.point([x as f32, y as f32, z as f32]);
                let wall = field.wall(point);
                samples.push(wall.max(0.0));
                if wall < 0.0 {
                    inside.push((layer + (y * width + x) as usize, point));
                }
            }
            let points: Vec<_> = inside.iter().map(|(_, point)| *point).collect();
            for ((place, _), distance) in inside.iter().zip(field.at(&points)?) {
                samples[*place] = distance;
            }
        }
        Ok(samples)
    }

    /// The net's vertices in the world, each moved along its normal to the zero of the field by secant steps that
    /// stay within its cell. The point with the least |distance| met is kept, so that no step makes a vertex worse.
    fn refine<D>(&self, field: &Clipped<'_, D>, nets: &SurfaceNetsBuffer) -> Result<Vec<[f32; 3]>>
    where
        D: Fn(&[[f32; 3]]) -> Result<Vec<f32>>,
    {
        let clamp = |place: [f32; 3], cell: [u32; 3]| -> [f32; 3] {
            std::array::from_fn(|axis| {
                let low = cell[axis] as f32;
                place[axis].clamp(low + CELL_MARGIN, low + 1.0 - CELL_MARGIN)
            })
        };
        let starts: Vec<_> =
            nets.positions.iter().zip(&nets.surface_points).map(|(p, cell)| clamp(*p, *cell)).collect();
        let world = |places: &[[f32; 3]]| places.iter().map(|place| self.point(*place)).collect::<Vec<_>>();
        let distances = field.at(&world(&starts))?;

        // Along the unit gradient a step of t cells changes the distance by slope * t.
        let gradients: Vec<([f32; 3], f32)> = nets
            .normals
            .iter()
            .map(|gradient| {
                let length = norm(gradient.map(f64::from)) as f32;
                if length > 1e-12 { (gradient.map(|g| g / length), length) } else { ([0.0; 3], 1.0) }
            })
            .collect();
        let mut steps: Vec<Step> = distances
            .iter()
            .zip(&gradients)
            .map(|(&distance, &(_, slope))| Step { best: (0.0, distance), last: (0.0, distance), slope })
            .collect();
        for _ in 0..SECANT_STEPS {
            let next: Vec<f32> = steps.iter().map(Step::next).collect();
            let places: Vec<_> = (0..next.len())
                .map(|vertex| {
                    let direction = gradients[vertex].0;
                    let moved = std::array::from_fn(|axis| starts[vertex][axis] + next[vertex] * direction[axis]);
                    clamp(moved, nets.surface_points[vertex])
                })
                .collect();
            for ((step, t), distance) in steps.iter_mut().zip(next).zip(field.at(&world(&places))?) {
                step.take(t, distance);
            }
        }
        let places: Vec<_> = (0..steps.len())
            .map(|vertex| {
                let (t, direction) = (steps[vertex].best.0, gradients[vertex].0);
                let moved = std::array::from_fn(|axis| starts[vertex][axis] + t * direction[axis]);
                clamp(moved, nets.surface_points[vertex])
            })
            .collect();
        Ok(world(&places))
    }
}

/// One vertex's secant iteration along its normal; pairs are (cells moved, distance there).
struct Step {
    best: (f32, f32),
    last: (f32, f32),
    slope: f32,
}

impl Step {
    fn next(&self) -> f32 {
        (self.last.0 - self.last.1 / self.slope).clamp(-1.0, 1.0)
    }

    fn take(&mut self, t: f32, distance: f32) {
        let slope = (distance - self.last.1) / (t - self.last.0);
        // A flat or reversed slope means that the cell holds more than one sheet: keep the gradient's.
        if slope.is_finite() && slope > 0.1 * self.slope {
            self.slope = slope;
        }
        self.last = (t, distance);
        if distance.abs() < self.best.1.abs() {
            self.best = self.last;
        }
    }
}

/// A quad's two triangles, cut along the diagonal that leaves the larger smaller triangle: vertices have moved since the
/// net chose one. `quad` is [a, b, c, a', c', d]-like: two triangles that share a diagonal.
fn split(quad: &[u32; 6], positions: &[[f32; 3]]) -> [[u32; 3]; 2] {
    let [first, second] = [[quad[0], quad[1], quad[2]], [quad[3], quad[4], quad[5]]];
    let area = |[a, b, c]: [u32; 3]| {
        let [a, b, c] = [a, b, c].map(|vertex| positions[vertex as usize].map(f64::from));
        norm(cross(minus(b, a), minus(c, a)))
    };
    // Turn both so that they begin with the vertex the other lacks: [p, q, r] and [s, r, q].
    let begin = |triangle: [u32; 3], other: [u32; 3]| {
        let lone = triangle.iter().position(|vertex| !other.contains(vertex)).unwrap_or(0);
        [triangle[lone], triangle[(lone + 1) % 3], triangle[(lone + 2) % 3]]
    };
    let ([p, q, r], [s, _, _]) = (begin(first, second), begin(second, first));
    let turned = [[p, q, s], [p, s, r]];
    let least = |triangles: [[u32; 3]; 2]| area(triangles[0]).min(area(triangles[1]));
    if least(turned) > least([first, second]) { turned } else { [first, second] }
}

/// Unit gradients of the field by differences over half a cell; where that vanishes, of the triangles around.
fn normals<D: Fn(&[[f32; 3]]) -> Result<Vec<f32>>>(
    field: &Clipped<'_, D>,
    positions: &[[f32; 3]],
    triangles: &[[u32; 3]],
    spacing: f32,
) -> Result<Vec<[f32; 3]>> {
    // The four corners of a tetrahedron give a gradient with the fewest evaluations.
    const CORNERS: [[f32; 3]; 4] = [[1.0, -1.0, -1.0], [-1.0, -1.0, 1.0], [-1.0, 1.0, -1.0], [1.0, 1.0, 1.0]];
    let mut gradients = vec![[0f64; 3]; positions.len()];
    for corner in CORNERS {
        let points: Vec<[f32; 3]> = positions
            .iter()
            .map(|point| std::array::from_fn(|axis| point[axis] + 0.25 * spacing * corner[axis]))
            .collect();
        for (gradient, distance) in gradients.iter_mut().zip(field.at(&points)?) {
            *gradient = std::array::from_fn(|axis| gradient[axis] + f64::from(corner[axis] * distance));
        }
    }
    let mut around = vec![[0f64; 3]; positions.len()];
    for triangle in triangles {
        let [a, b, c] = triangle.map(|vertex| positions[vertex as usize].map(f64::from));
        let normal = cross(minus(b, a), minus(c, a));
        for vertex in triangle {
            let sum = &mut around[*vertex as usize];
            *sum = std::array::from_fn(|axis| sum[axis] + normal[axis]);
        }
    }
    Ok(gradients
        .into_iter()
        .zip(around)
        .map(|(gradient, around)| {
            let usable = |vector: [f64; 3]| norm(vector).is_normal().then(|| vector.map(|x| x / norm(vector)));
            let (gradient, around) = (usable(gradient), usable(around).unwrap_or([0.0, 0.0, 1.0]));
            // Thin parts: the difference may see the far side.
            let normal = gradient.filter(|gradient| dot(*gradient, around) > 0.0).unwrap_or(around);
            normal.map(|x| x as f32)
        })
        .collect())
}
