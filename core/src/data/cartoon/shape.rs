//! Signed distance primitives, in head units: negative inside, never steeper than 1, so that a sphere trace may
//! step by the value.

use glam::{Mat3, Vec3, Vec4};

/// A solid.
#[derive(Clone, Debug)]
pub(super) enum Shape {
    /// Ball.
    Sphere {
        /// Centre.
        centre: Vec3,
        /// Radius.
        radius: f32,
    },
    /// Ellipsoid with axes turned by a rotation.
    Ellipsoid {
        /// Centre.
        centre: Vec3,
        /// One over the radii.
        inverse_radii: Vec3,
        /// Local from head coordinates.
        local: Mat3,
    },
    /// Convex hull of two balls.
    RoundCone(RoundCone),
    /// Tapered tube along a curve.
    Lock(Lock),
    /// Ring around the local y axis.
    Torus {
        /// Centre.
        centre: Vec3,
        /// Local from head coordinates.
        local: Mat3,
        /// Radius of the ring.
        ring: f32,
        /// Radius of the tube.
        tube: f32,
    },
    /// Box with rounded edges.
    RoundBox {
        /// Centre.
        centre: Vec3,
        /// Local from head coordinates.
        local: Mat3,
        /// Half sizes, rounding included.
        half: Vec3,
        /// Radius of the edges.
        round: f32,
    },
    /// Points below a plane: `normal · p < offset`.
    HalfSpace {
        /// Unit normal.
        normal: Vec3,
        /// Distance of the plane from the origin along the normal.
        offset: f32,
    },
    /// Part of a ball above a plane through its centre, with a rounded edge: an eyelid.
    Lid {
        /// Centre.
        centre: Vec3,
        /// Radius.
        radius: f32,
        /// Unit normal of the plane, into the lid.
        normal: Vec3,
    },
    /// A band that follows the mouth's curve: a lip, the opening or a row of teeth.
    MouthBand(MouthBand),
}

/// Convex hull of two balls, with what its distance needs precomputed.
#[derive(Clone, Debug)]
pub(super) struct RoundCone {
    start: Vec3,
    start_radius: f32,
    end_radius: f32,
    axis: Vec3,
    length_squared: f32,
    radius_difference: f32,
    slant_squared: f32,
}

/// A tapered tube along a Catmull-Rom curve.
///
/// The closest point of a polyline is the first guess of the closest point of the curve; a Newton step makes the
/// distance as smooth as the curve.
#[derive(Clone, Debug)]
pub(super) struct Lock {
    /// Cubics between the knots: point and radius.
    spans: Vec<[Vec4; 4]>,
    nodes: Vec<LockNode>,
}

/// A node of a lock's polyline.
#[derive(Clone, Copy, Debug)]
struct LockNode {
    point: Vec3,
    /// To the next node.
    step: Vec3,
    inverse_length_squared: f32,
    /// Unit vector across the curve that turns as little as it can.
    across: Vec3,
    /// Length of the curve up to here.
    arc: f32,
}

/// Where a point lies on a lock.
#[derive(Clone, Copy, Debug)]
pub(super) struct LockPlace {
    /// Unit direction of the curve.
    pub tangent: Vec3,
    /// Angle around it, radians.
    pub angle_rad: f32,
    /// Length of the curve up to here.
    pub arc: f32,
}

/// The mouth's coordinate system: x along the lips, y off the smile's curve, z off the face's surface.
#[derive(Clone, Copy, Debug)]
pub(super) struct MouthFrame {
    /// Middle of the mouth, on the face's surface.
    pub centre: Vec3,
    /// How fast the corners rise: y = curve x².
    pub curve: f32,
    /// How fast the surface recedes to the sides: z = −recede x².
    pub recede: f32,
    /// How the surface runs up and down: z = slope y + bow y².
    pub slope: f32,
    /// See `slope`.
    pub bow: f32,
    /// Half the distance of the corners.
    pub half_width: f32,
}

/// A band along the mouth whose height shrinks to its ends.
#[derive(Clone, Debug)]
pub(super) struct MouthBand {
    /// Where the mouth is.
    pub frame: MouthFrame,
    /// Half width of this band.
    pub half_width: f32,
    /// Height of the band's middle line over the mouth's curve, in the middle of the mouth.
    pub middle: f32,
    /// Half height in the middle of the mouth.
    pub half_height: f32,
    /// Depth of the band's middle, relative to the face's surface.
    pub depth: f32,
    /// Half depth for a slab; 0 for a lip, whose section is round.
    pub half_depth: f32,
    /// How much the middle dips at x = 0 (cupid's bow).
    pub dip: f32,
}

impl Shape {
    /// A ball.
    pub fn sphere(centre: Vec3, radius: f32) -> Self {
        Self::Sphere { centre, radius }
    }

    /// An ellipsoid along the axes.
    pub fn ellipsoid(centre: Vec3, radii: Vec3) -> Self {
        Self::turned_ellipsoid(centre, radii, Mat3::IDENTITY)
    }

    /// An ellipsoid whose axes are the columns of `turn`.
    pub fn turned_ellipsoid(centre: Vec3, radii: Vec3, turn: Mat3) -> Self {
        Self::Ellipsoid { centre, inverse_radii: radii.max(Vec3::splat(1e-3)).recip(), local: turn.transpose() }
    }

    /// The hull of two balls.
    pub fn round_cone(start: Vec3, start_radius: f32, end: Vec3, end_radius: f32) -> Self {
        let axis = end - start;
        let length_squared = axis.length_squared();
        let radius_difference = start_radius - end_radius;
        // One ball inside the other: the hull is the larger ball.
        if length_squared <= radius_difference * radius_difference + 1e-9 {
            return if start_radius >= end_radius {
                Self::sphere(start, start_radius)
            } else {
                Self::sphere(end, end_radius)
            };
        }
        Self::RoundCone(RoundCone {
            start,
            start_radius,
            end_radius,
            axis,
            length_squared,
            radius_difference,
            slant_squared: length_squared - radius_difference * radius_difference,
        })
    }

    /// The same solid, elsewhere.
    #[must_use]
    pub fn moved(mut self, by: Vec3) -> Self {
        match &mut self {
            Self::Sphere { centre, .. }
            | Self::Ellipsoid { centre, .. }
            | Self::Torus { centre, .. }
            | Self::RoundBox { centre, .. }
            | Self::Lid { centre, .. } => *centre += by,
            Self::RoundCone(cone) => cone.start += by,
            Self::Lock(lock) => {
                lock.nodes.iter_mut().for_each(|node| node.point += by);
                lock.spans.iter_mut().for_each(|span| span[0] += by.extend(0.0));
            }
            Self::HalfSpace { normal, offset } => *offset += normal.dot(by),
            Self::MouthBand(band) => band.frame.centre += by,
        }
        self
    }

    /// Distance from `point` to the surface.
    #[inline]
    pub fn distance(&self, point: Vec3) -> f32 {
        match self {
            Self::Sphere { centre, radius } => (point - *centre).length() - radius,
            Self::Ellipsoid { centre, inverse_radii, local } => ellipsoid(*local * (point - *centre), *inverse_radii),
            Self::RoundCone(cone) => cone.distance(point),
            Self::Lock(lock) => lock.distance(point),
            Self::Torus { centre, local, ring, tube } => {
                let local = *local * (point - *centre);
                let off_ring = (local.x * local.x + local.z * local.z).sqrt() - ring;
                (off_ring * off_ring + local.y * local.y).sqrt() - tube
            }
            Self::RoundBox { centre, local, half, round } => {
                let excess = (*local * (point - *centre)).abs() - (*half - Vec3::splat(*round));
                excess.max(Vec3::ZERO).length() + excess.max_element().min(0.0) - round
            }
            Self::HalfSpace { normal, offset } => normal.dot(point) - offset,
            Self::Lid { centre, radius, normal } => {
                let from_centre = point - *centre;
                smooth_max(from_centre.length() - radius, -normal.dot(from_centre), 0.03)
            }
            Self::MouthBand(band) => band.distance(point),
        }
    }
}

impl RoundCone {
    /// Inigo Quilez, "Round cone" (iquilezles.org/articles/distfunctions), exact.
    #[inline]
    fn distance(&self, point: Vec3) -> f32 {
        let from_start = point - self.start;
        let along = from_start.dot(self.axis);
        let beyond = along - self.length_squared;
        let across = (from_start * self.length_squared - self.axis * along).length_squared();
        let along_squared = along * along * self.length_squared;
        let beyond_squared = beyond * beyond * self.length_squared;
        let slope = self.radius_difference.signum() * self.radius_difference * self.radius_difference * across;
        let inverse_length_squared = 1.0 / self.length_squared;
        if beyond.signum() * self.slant_squared * beyond_squared > slope {
            (across + beyond_squared).sqrt() * inverse_length_squared - self.end_radius
        } else if along.signum() * self.slant_squared * along_squared < slope {
            (across + along_squared).sqrt() * inverse_length_squared - self.start_radius
        } else {
            ((across * self.slant_squared * inverse_length_squared).sqrt() + along * self.radius_difference)
                * inverse_length_squared
                - self.start_radius
        }
    }
}

impl Lock {
    /// The tube through these knots (point, radius); its polyline has `pieces` nodes a knot.
    pub fn new(knots: &[(Vec3, f32)], pieces: usize) -> Self {
        let knot = |index: usize| knots.get(index).or(knots.last()).map_or(Vec4::ZERO, |(point, r)| point.extend(*r));
        let spans: Vec<[Vec4; 4]> = (0..knots.len().saturating_sub(1))
            .map(|index| {
                let [before, start, end, after] =
                    [knot(index.saturating_sub(1)), knot(index), knot(index + 1), knot(index + 2)];
                [
                    start,
                    0.5 * (end - before),
                    before - 2.5 * start + 2.0 * end - 0.5 * after,
                    1.5 * (start - end) + 0.5 * (after - before),
                ]
            })
            .collect();
        let mut lock = Self { spans, nodes: Vec::new() };
        let count = lock.spans.len() * pieces + 1;
        let mut arc = 0.0;
        for index in 0..count {
            let [here, slope, _] = lock.curve(index as f32 / pieces as f32);
            let next = if index + 1 < count { lock.curve((index + 1) as f32 / pieces as f32)[0] } else { here };
            let tangent = slope.truncate().normalize_or(Vec3::Y);
            let across = lock.nodes.last().map_or_else(|| tangent.any_orthonormal_vector(), |node| node.across);
            let across = (across - tangent * across.dot(tangent)).normalize_or(tangent.any_orthonormal_vector());
            let step = (next - here).truncate();
            lock.nodes.push(LockNode {
                point: here.truncate(),
                step,
                inverse_length_squared: step.length_squared().max(1e-9).recip(),
                across,
                arc,
            });
            arc += step.length();
        }
        lock
    }

    /// Point with radius, and its first two derivatives, at a parameter that counts knots.
    #[inline]
    fn curve(&self, parameter: f32) -> [Vec4; 3] {
        let index = (parameter.max(0.0) as usize).min(self.spans.len().saturating_sub(1));
        let Some([start, first, second, third]) = self.spans.get(index) else {
            return [Vec4::ZERO, Vec4::Y, Vec4::ZERO];
        };
        let t = parameter - index as f32;
        [
            *start + t * (*first + t * (*second + t * *third)),
            *first + t * (2.0 * *second + 3.0 * t * *third),
            2.0 * *second + 6.0 * t * *third,
        ]
    }

    /// Parameter of the curve's closest point, the distance there, and the place on the polyline it was found from.
    #[inline]
    fn closest(&self, point: Vec3) -> (f32, f32, usize, f32) {
        let mut best = (f32::MAX, 0, 0.0);
        for (index, node) in self.nodes.iter().enumerate() {
            let from = point - node.point;
            let share = (from.dot(node.step) * node.inverse_length_squared).clamp(0.0, 1.0);
            let distance = (from - share * node.step).length_squared();
            if distance < best.0 {
                best = (distance, index, share);
            }
        }
        let (_, index, share) = best;
        let last = self.spans.len() as f32;
        let pieces = (self.nodes.len().saturating_sub(1)) as f32 / last.max(1.0);
        let guess = ((index as f32 + share) / pieces.max(1.0)).min(last);
        let [here, slope, bend] = self.curve(guess);
        let (from, slope) = (point - here.truncate(), slope.truncate());
        // Far on the hollow side of a bend the distance has no single minimum: then the step is kept short.
        let speed = slope.length_squared().max(1e-9);
        let step = from.dot(slope) / (speed - from.dot(bend.truncate())).max(0.5 * speed);
        let parameter = (guess + step.clamp(-0.5, 0.5)).clamp(0.0, last);
        let [there, ..] = self.curve(parameter);
        let surface = |here: Vec4| (point - here.truncate()).length() - here.w.max(0.004);
        (parameter, surface(here).min(surface(there)), index, share)
    }

    /// Distance to the tube. Where it tapers the radius counts across the curve instead of across the slanted surface,
    /// which 0.93 makes safe for slopes of up to 0.4.
    #[inline]
    fn distance(&self, point: Vec3) -> f32 {
        0.93 * self.closest(point).1
    }

    /// Where the curve is closest to `point`.
    pub fn place(&self, point: Vec3) -> LockPlace {
        let (parameter, _, index, share) = self.closest(point);
        let [here, slope, _] = self.curve(parameter);
        let tangent = slope.truncate().normalize_or(Vec3::Y);
        let (across, arc) = self.nodes.get(index).map_or((Vec3::X, 0.0), |node| {
            let next = self.nodes.get(index + 1).unwrap_or(node);
            (node.across.lerp(next.across, share), node.arc + share * node.step.length())
        });
        let from = point - here.truncate();
        let angle_rad = from.dot(across).atan2(from.dot(tangent.cross(across)));
        LockPlace { tangent, angle_rad, arc }
    }
}

impl MouthFrame {
    /// Coordinates in which the mouth is straight and flat.
    #[inline]
    pub fn straighten(&self, point: Vec3) -> Vec3 {
        let from_centre = point - self.centre;
        // Beyond the corners the bend goes on straight, so that slopes stay bounded.
        let limit = 1.3 * self.half_width;
        let x = from_centre.x.clamp(-limit, limit);
        let y = from_centre.y.clamp(-0.3, 0.3);
        let surface = self.slope * y + self.bow * y * y - self.recede * x * x;
        Vec3::new(from_centre.x, from_centre.y - self.curve * x * x, from_centre.z - surface)
    }
}

impl MouthBand {
    /// Share of the height that is left at x, 1 in the middle to 0 at the ends.
    #[inline]
    fn taper(&self, x: f32) -> f32 {
        (1.0 - (x / self.half_width).powi(2)).max(0.0)
    }

    #[inline]
    fn distance(&self, point: Vec3) -> f32 {
        let local = self.frame.straighten(point);
        let taper = self.taper(local.x);
        let beyond = (local.x.abs() - self.half_width).max(0.0);
        let dip = self.dip / (1.0 + (local.x / (0.25 * self.half_width)).powi(4));
        let y = local.y - self.middle * taper + dip;
        let z = local.z - self.depth;
        // The bend and the taper stretch space; 0.72 bounds what is left of the slope at the widest smile.
        0.72 * if self.half_depth > 0.0 {
            let excess = Vec3::new(beyond, y.abs() - self.half_height * taper, z.abs() - self.half_depth);
            excess.max(Vec3::ZERO).length() + excess.y.max(excess.z).min(0.0)
        } else {
            Vec3::new(beyond, y, z).length() - self.half_height * taper.sqrt().max(0.12)
        }
    }
}

/// First-order distance to an ellipsoid: exact at the surface, an underestimate far away.
#[inline]
fn ellipsoid(local: Vec3, inverse_radii: Vec3) -> f32 {
    let scaled = local * inverse_radii;
    let level = scaled.length();
    let slope = (scaled * inverse_radii).length();
    if slope < 1e-6 { -inverse_radii.max_element().recip() } else { level * (level - 1.0) / slope }
}

/// Union of two solids with a fillet `blend` wide (quadratic polynomial).
#[inline]
pub(super) fn smooth_min(left: f32, right: f32, blend: f32) -> f32 {
    let overlap = (blend - (left - right).abs()).max(0.0);
    left.min(right) - if blend > 0.0 { overlap * overlap / (4.0 * blend) } else { 0.0 }
}

/// Intersection of two solids with a rounded edge `blend` wide.
#[inline]
pub(super) fn smooth_max(left: f32, right: f32, blend: f32) -> f32 {
    -smooth_min(-left, -right, blend)
}
