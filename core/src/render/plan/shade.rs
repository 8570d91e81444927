//! From selected pairs to pixels: texture branches, fusion, and the sums along rays.

use crate::{
    camera,
    error::Result,
    kernels::Rows,
    region::{REGION_COUNT, Region},
    render::plan::{
        Shown,
        features::Features,
        local::{LocalInitial, Ready, add_scaled, length, scaled, sigmoid},
        march::Marched,
        rays::Rays,
        select::Selection,
        state::{ChunkState, Room},
    },
};

/// Logits that are uncertain by less than this are taken as they are, others at the middle of their range's sigmoids:
/// up to here a quarter of it is the smaller bound.
const UNCERTAIN: f32 = 2.0;

/// Weights of samples whose masks, if nothing of them is evaluated, are not worth summing: a thousand of them would not
/// show in f32.
const TRACE: f32 = 1e-9;

/// A chunk's pixels, ray by ray.
#[derive(Default)]
pub struct Pixels {
    /// `[n, 3]` in [0, 1].
    pub colour: Vec<f32>,
    /// `[n, F]`; empty if nobody asked.
    pub features: Vec<f32>,
    /// `[n, 9]`.
    pub masks: Vec<f32>,
    /// Along the view axis, world units, `[n]`.
    pub depth: Vec<f32>,
    /// `[n, 3]`; empty if nobody asked.
    pub normal: Vec<f32>,
    /// Share of light from the volume, `[n]`.
    pub opacity: Vec<f32>,
    /// (sample, region) pairs whose texture branch ran, those of the background included.
    pub pairs: usize,
}

impl Pixels {
    /// More rays behind these.
    pub fn append(&mut self, more: Self) {
        let columns = [
            (&mut self.colour, more.colour),
            (&mut self.features, more.features),
            (&mut self.masks, more.masks),
            (&mut self.depth, more.depth),
            (&mut self.normal, more.normal),
            (&mut self.opacity, more.opacity),
        ];
        for (column, more) in columns {
            column.extend(more);
        }
        self.pairs += more.pairs;
    }
}

/// Evaluates the selected pairs and sums everything along the rays.
pub fn shade(
    field: &Ready,
    rays: &Rays,
    marched: &Marched,
    selection: &Selection,
    shown: &Shown,
    state: &mut ChunkState,
    room: &mut Room,
) -> Result<Pixels> {
    let (count, regions) = (rays.count(), field.regions.len());
    let feature_count = field.features.as_ref().map_or(0, Features::count);
    let mut pixels = Pixels {
        colour: vec![0.0; count * 3],
        features: vec![0.0; count * feature_count],
        masks: vec![0.0; count * REGION_COUNT],
        depth: vec![0.0; count],
        normal: vec![0.0; if shown.normals { count * 3 } else { 0 }],
        opacity: vec![0.0; count],
        pairs: 0,
    };
    let mut logits = vec![[0f32; 3]; count * rays.samples];
    for region in 0..regions {
        let (samples, prepared) = (&selection.samples[region], field.heads[region].as_ref());
        pixels.pairs += state.heads[region].fill(prepared, rays, samples, &mut room.inputs)?;
        let rows = prepared.rows();
        let visible = shown.regions.contains(field.regions[region]);
        let mut sums = RaySums::default();
        for sample in samples {
            let values = state.heads[region].at(*sample, rows.count);
            let sample = *sample as usize;
            let (weight, mask) = (marched.weights[sample], marched.masks[sample * regions + region]);
            let ray = sample / rays.samples;
            if let Some(colour) = rows.colour.as_ref().filter(|_| visible) {
                add_scaled(&mut logits[sample], mask, &values[colour.clone()]);
            }
            if let Some(activations) = rows.activations.as_ref().filter(|_| visible) {
                sums.add(ray as u32, weight * mask, &values[activations.clone()]);
            }
            if shown.normals {
                let share = NormalShare { mask, mean: marched.means[sample], weight };
                share.add(field, &rows, values, &mut pixels.normal[ray * 3..][..3]);
            }
        }
        if let Some(features) = &field.features {
            features.add(field.regions[region], &sums.rays, sums.activations, &mut pixels.features)?;
        }
    }
    let doubts = Doubts::new(field, shown);
    for ray in 0..count {
        let mut masks = [0f32; REGION_COUNT];
        let mut colour = [0f32; 3];
        let mut depth = 0.0;
        let samples = logits.iter().enumerate().skip(ray * rays.samples).take(marched.marched[ray] as usize);
        for (sample, logits) in samples {
            let weight = marched.weights[sample];
            if weight == 0.0 {
                continue;
            }
            depth += weight * rays.depths[sample];
            if weight <= TRACE && selection.left_out[sample] == doubts.every {
                add_scaled(&mut colour, weight, &[0.5; 3]);
                continue;
            }
            let sample_masks = &marched.masks[sample * regions..][..regions];
            for (row, mask) in field.rows().zip(sample_masks) {
                masks[row] += weight * mask;
            }
            let own = doubts.colour(logits, sample_masks, selection.left_out[sample]);
            add_scaled(&mut colour, weight, &own);
        }
        for region in Region::ALL.iter().filter(|region| !shown.regions.contains(**region)) {
            masks[region.index()] = 0.0;
        }
        let remaining = marched.remaining[ray];
        pixels.depth[ray] = depth + remaining * camera::FAR as f32;
        pixels.opacity[ray] = 1.0 - remaining;
        if field.local.volume != crate::region::RegionSet::ALL {
            if field.background.is_some() && shown.regions.contains(Region::Background) {
                masks[Region::Background.index()] += remaining;
            }
            let behind = field.background_range.filter(|_| shown.regions.contains(Region::Background));
            let unseen = behind.map_or([0.5; 3], |range| {
                std::array::from_fn(|channel| middle(range.middle[channel], range.radius[channel]))
            });
            add_scaled(&mut colour, remaining, &unseen);
        }
        if let Some(features) = &field.features {
            let row = &mut pixels.features[ray * feature_count..][..feature_count];
            features.add_constant(&masks, rays.views[ray], row);
        }
        pixels.masks[ray * REGION_COUNT..][..REGION_COUNT].copy_from_slice(&masks);
        pixels.colour[ray * 3..][..3].copy_from_slice(&colour);
    }
    shade_background(field, rays, marched, &selection.background, &mut pixels, room)?;
    if shown.normals {
        finish_normals(field, rays, marched, &mut pixels, room)?;
    }
    Ok(pixels)
}

/// Puts the far plane's true colour in the place of its range's middle.
fn shade_background(
    field: &Ready,
    rays: &Rays,
    marched: &Marched,
    selected: &[u32],
    pixels: &mut Pixels,
    room: &mut Room,
) -> Result<()> {
    let (Some(background), Some(range)) = (&field.background, field.background_range) else { return Ok(()) };
    let (rows, columns) = (background.rows(), background.shape().point_columns());
    let mut sums = RaySums::default();
    room.inputs.clear();
    for ray in selected {
        let (ray, far) = (*ray as usize, camera::FAR as f32);
        room.inputs.extend((0..3).map(|axis| scaled(rays.directions[ray][axis] * far + rays.origin[axis])));
        room.inputs.extend(rays.views[ray].iter().take(columns - 3));
    }
    room.values.resize(selected.len() * rows.count, 0.0);
    background.forward(&room.inputs, &mut room.values)?;
    for (ray, values) in selected.iter().zip(room.values.chunks_exact(rows.count)) {
        let ray = *ray as usize;
        let remaining = marched.remaining[ray];
        if let Some(colour) = &rows.colour {
            for (channel, logit) in values[colour.clone()].iter().enumerate() {
                let unseen = middle(range.middle[channel], range.radius[channel]);
                pixels.colour[ray * 3 + channel] += remaining * (sigmoid(*logit) - unseen);
            }
        }
        if let Some(activations) = &rows.activations {
            sums.add(ray as u32, remaining, &values[activations.clone()]);
        }
    }
    if let Some(features) = &field.features {
        features.add(Region::Background, &sums.rays, sums.activations, &mut pixels.features)?;
    }
    pixels.pairs += selected.len();
    Ok(())
}

/// Adds ∇d0 and scales to unit length, as [`crate::render::integrate::aggregate`] does.
fn finish_normals(field: &Ready, rays: &Rays, marched: &Marched, pixels: &mut Pixels, room: &mut Room) -> Result<()> {
    let density = field.local.density;
    let sign = if density == crate::config::DensityKind::Density { -1.0 } else { 1.0 };
    let lit = |ray: usize| {
        let first = ray * rays.samples;
        (first..first + marched.marched[ray] as usize).filter(|sample| marched.weights[*sample] != 0.0)
    };
    if let (Some(initial), crate::config::DensityKind::ResidualSdf) = (&field.initial, density) {
        let (rows, columns) = (initial.rows(), initial.shape().point_columns());
        let samples: Vec<usize> = (0..rays.count()).flat_map(lit).collect();
        room.inputs.clear();
        samples.iter().for_each(|sample| rays.push_input(*sample, columns, &mut room.inputs));
        room.values.resize(samples.len() * rows.count, 0.0);
        initial.forward(&room.inputs, &mut room.values)?;
        for (sample, values) in samples.iter().zip(room.values.chunks_exact(rows.count)) {
            let Some(slope) = &rows.residual_gradient else { continue };
            let normal = &mut pixels.normal[sample / rays.samples * 3..][..3];
            for (sum, slope) in normal.iter_mut().zip(&values[slope.clone()]) {
                *sum += marched.weights[*sample] * scaled(*slope);
            }
        }
    }
    let sphere = density == crate::config::DensityKind::ResidualSdf
        && matches!(field.local.initial, LocalInitial::Sphere { .. });
    for ray in 0..rays.count() {
        let normal = &mut pixels.normal[ray * 3..][..3];
        normal.iter_mut().for_each(|component| *component *= sign);
        if sphere {
            for sample in lit(ray) {
                let point = rays.point(sample);
                add_scaled(normal, marched.weights[sample] / length(point), &point);
            }
        }
        let square: f32 = normal.iter().map(|component| component * component).sum();
        let unit = (square + 1e-6).sqrt();
        normal.iter_mut().for_each(|component| *component /= unit);
    }
    Ok(())
}

/// One pair's share of a normal.
struct NormalShare {
    mask: f32,
    mean: f32,
    weight: f32,
}

impl NormalShare {
    fn add(&self, field: &Ready, rows: &Rows, values: &[f32], normal: &mut [f32]) {
        let (Some(mask_slope), Some(residual_slope)) = (&rows.mask_gradient, &rows.residual_gradient) else { return };
        let scale = field.local.residual_scale as f32;
        let own = values[rows.residual] * scale;
        let through_mask = scaled(field.normal_share(self.mask, own, self.mean)) * self.weight;
        let through_residual = match field.local.residual {
            crate::config::Residual::Sum => scaled(scale) * self.weight,
            crate::config::Residual::Gated => scaled(scale) * self.weight * self.mask,
        };
        add_scaled(normal, through_mask, &values[mask_slope.clone()]);
        add_scaled(normal, through_residual, &values[residual_slope.clone()]);
    }
}

/// What regions that were left out may have added.
struct Doubts {
    middle: Vec<[f32; 3]>,
    radius: Vec<[f32; 3]>,
    visible: u16,
    every: u16,
}

impl Doubts {
    fn new(field: &Ready, shown: &Shown) -> Self {
        let visible = field.regions.iter().enumerate().filter(|(_, region)| shown.regions.contains(**region));
        Self {
            middle: field.ranges.iter().map(|range| range.middle).collect(),
            radius: field.ranges.iter().map(|range| range.radius).collect(),
            visible: visible.fold(0, |bits, (index, _)| bits | 1 << index),
            every: ((1u32 << field.regions.len()) - 1) as u16,
        }
    }

    /// A sample's colour from the logits of the regions that were evaluated.
    fn colour(&self, logits: &[f32; 3], masks: &[f32], left_out: u16) -> [f32; 3] {
        let left_out = left_out & self.visible;
        let (mut centre, mut radius) = (*logits, [0f32; 3]);
        if left_out != 0 {
            for (region, mask) in masks.iter().enumerate().filter(|(region, _)| left_out & 1 << region != 0) {
                for channel in 0..3 {
                    centre[channel] += mask * self.middle[region][channel];
                    radius[channel] += mask.abs() * self.radius[region][channel];
                }
            }
        }
        std::array::from_fn(|channel| middle(centre[channel], radius[channel]))
    }
}

/// The colour that stands for all logits within `centre` ± `radius`: see [`UNCERTAIN`].
fn middle(centre: f32, radius: f32) -> f32 {
    if radius <= UNCERTAIN { sigmoid(centre) } else { 0.5 * (sigmoid(centre - radius) + sigmoid(centre + radius)) }
}

/// One region's activations, weighted and summed along those rays that have any: most rays see one region or two.
#[derive(Default)]
struct RaySums {
    rays: Vec<u32>,
    /// `[n, W]`.
    activations: Vec<f32>,
}

impl RaySums {
    /// Adds a sample's; samples come ray by ray.
    fn add(&mut self, ray: u32, scale: f32, activations: &[f32]) {
        if self.rays.last() != Some(&ray) {
            self.rays.push(ray);
            self.activations.resize(self.rays.len() * activations.len(), 0.0);
        }
        let start = (self.rays.len() - 1) * activations.len();
        add_scaled(&mut self.activations[start..], scale, activations);
    }
}
