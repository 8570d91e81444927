//! Which texture branches a frame runs: all but those whose largest possible effects, summed over what is left out of a
//! pixel, stay within the budget.
//!
//! Why the sum is a bound. With weights w_s and masks m_i a pixel is Σ_s w_s sigmoid(Σ_i m_i c_i). A logit c_i is within
//! its range's middle ± radius R_i ([`LogitRange`]); what is left out counts as the middle. So
//! the sum of logits of a sample is off by at most r = Σ |m_i| R_i over what was left out, and its colour, as sigmoid has
//! slope ≤ 1/4, by at most r / 4; or, taken at the middle of sigmoid's range over ± r, by at most 1/2. Both are at most
//! Σ min(|m_i| R_i / 4, 1/2), a sum over pairs. The features' activations are sines: what is left out counts as 0 and is
//! off by at most |m_i| w_s of their range's half, so they are charged the same way, in units of their range. Normals
//! are charged too, but have no bound: how steep a region is, is not known before it is evaluated.

use crate::render::plan::{
    ROUNDING, ROUNDING_PER_LOGIT, Shown,
    local::{LogitRange, Ready},
    march::Marched,
    rays::Rays,
};

/// Normals are of unit length however little light there is to have one, so what is left out of them counts relative to
/// the ray's opacity. They may lose this many times more than colours: an upsampler takes them as a hint.
const NORMAL_LENIENCE: f32 = 8.0;
/// Opacity below which normals fade, as [`crate::render::integrate::aggregate`] has them.
const FAINT: f32 = 1e-3;

/// A chunk's pairs to evaluate.
pub struct Selection {
    /// Per region the samples to evaluate, ascending.
    pub samples: Vec<Vec<u32>>,
    /// Per sample the regions left out, as bits.
    pub left_out: Vec<u16>,
    /// Rays whose background is evaluated, ascending.
    pub background: Vec<u32>,
    /// Per ray, what leaving out can change at most, in [0, 1] colour units.
    pub bounds: Vec<f32>,
}

/// Charges of one ray's candidates within the budget, cheapest first: charge (as its bits) above, place below.
type Candidates = Vec<u64>;

/// Selects under `budget` per pixel, which what marching spent has a first claim on.
pub fn select(field: &Ready, rays: &Rays, marched: &Marched, shown: &Shown, budget: f32) -> Selection {
    let (count, samples, regions) = (rays.count(), rays.samples, field.regions.len());
    let pairs = samples * regions + 1;
    let charges = Charges::new(field, shown);
    let every = ((1u32 << regions) - 1) as u16;
    let mut selection = Selection {
        samples: vec![Vec::new(); regions],
        left_out: vec![0; count * samples],
        background: Vec::new(),
        bounds: vec![0.0; count],
    };
    let mut candidates = Candidates::new();
    for ray in 0..count {
        let rounding = charges.rounding(marched, ray * samples..ray * samples + marched.marched[ray] as usize);
        // A little slack for the rounding of the charges' own sum.
        let budget = ((budget - rounding - marched.spent(ray)) * (1.0 - 1e-5)).max(0.0);
        let lit = 1.0 / (NORMAL_LENIENCE * (1.0 - marched.remaining[ray] + FAINT));
        // All charges up to here together take at most half of the budget: no need to sort them.
        let negligible = budget / (2 * pairs) as f32;
        let mut spent = 0f32;
        candidates.clear();
        let mut consider = |spent: &mut f32, charge: f32, place: usize, leave_out: &mut dyn FnMut()| {
            if charge <= negligible {
                *spent += charge;
                leave_out();
            } else if charge <= budget {
                candidates.push(u64::from(charge.to_bits()) << 32 | place as u64);
            }
        };
        for step in 0..marched.marched[ray] as usize {
            let sample = ray * samples + step;
            let weight = marched.weights[sample];
            // Most samples are empty space: with shares for masks a look at the weight is enough.
            if weight * charges.largest(lit) <= negligible {
                spent += weight * charges.largest(lit);
                selection.left_out[sample] = every;
                continue;
            }
            for (region, mask) in marched.masks[sample * regions..][..regions].iter().enumerate() {
                let charge = weight * charges.visible(region, *mask).max(lit * charges.normal(*mask));
                consider(&mut spent, charge, step * regions + region, &mut || {
                    selection.left_out[sample] |= 1 << region
                });
            }
        }
        let mut background = field.background.is_some();
        let behind = marched.remaining[ray] * charges.background;
        if background {
            consider(&mut spent, behind, samples * regions, &mut || background = false);
        }
        candidates.sort_unstable();
        for candidate in &candidates {
            let charge = f32::from_bits((candidate >> 32) as u32);
            if spent + charge > budget {
                break;
            }
            spent += charge;
            let place = (candidate & u64::from(u32::MAX)) as usize;
            if place == samples * regions {
                background = false;
            } else {
                selection.left_out[ray * samples + place / regions] |= 1 << (place % regions);
            }
        }
        let mut bound = if background { 0.0 } else { behind };
        for step in 0..marched.marched[ray] as usize {
            let sample = ray * samples + step;
            if marched.weights[sample] * charges.largest(lit) <= negligible {
                // At worst, what is left out as a whole is the middle of [0, 1].
                bound += 0.5 * marched.weights[sample];
                continue;
            }
            for (region, list) in selection.samples.iter_mut().enumerate() {
                if selection.left_out[sample] & 1 << region == 0 {
                    list.push(sample as u32);
                } else {
                    bound +=
                        marched.weights[sample] * charges.visible(region, marched.masks[sample * regions + region]);
                }
            }
        }
        if background {
            selection.background.push(ray as u32);
        }
        selection.bounds[ray] = bound * (1.0 + 1e-6) + marched.spent(ray) + rounding;
    }
    selection
}

impl Selection {
    /// Every pair of every one of `samples`, which are all, and the background if it is shown.
    pub fn of_everything(field: &Ready, rays: &Rays, shown: &Shown, samples: Vec<u32>) -> Self {
        let seen = field.background.is_some() && shown.regions.contains(crate::region::Region::Background);
        let background = if seen { 0..rays.count() as u32 } else { 0..0 };
        Self {
            left_out: vec![0; samples.len()],
            samples: vec![samples; field.regions.len()],
            background: background.collect(),
            bounds: vec![0.0; rays.count()],
        }
    }
}

/// What leaving a region out charges per unit of weight.
struct Charges {
    /// Per region: R_i / 4, or 0 where the region is not shown.
    colour: Vec<f32>,
    /// Per region: 1/2 if it has features to show.
    features: Vec<f32>,
    /// 1/2 if there are normals; they are those of all regions, shown or not.
    normals: f32,
    /// Whether residuals are summed: then every region bends the normal, whatever its mask.
    summed: bool,
    background: f32,
    /// Per region, the largest |c_i|.
    logits: Vec<f32>,
    /// Whether masks are shares of 1.
    shares: bool,
}

impl Charges {
    fn new(field: &Ready, shown: &Shown) -> Self {
        let visible = |region: &crate::region::Region| f32::from(u8::from(shown.regions.contains(*region)));
        let background = field.background_range.map_or(0.0, |range| {
            let colour = (range.largest_radius() / 4.0).min(0.5);
            let features = if shown.features { 0.5f32 } else { 0.0 };
            colour.max(features) * visible(&crate::region::Region::Background)
        });
        Self {
            colour: field
                .regions
                .iter()
                .zip(&field.ranges)
                .map(|(region, range)| range.largest_radius() / 4.0 * visible(region))
                .collect(),
            features: field
                .regions
                .iter()
                .map(|region| if shown.features { 0.5 * visible(region) } else { 0.0 })
                .collect(),
            normals: if shown.normals { 0.5 } else { 0.0 },
            summed: field.local.residual == crate::config::Residual::Sum,
            background,
            logits: field.ranges.iter().map(LogitRange::largest).collect(),
            shares: matches!(field.local.fusion, crate::config::Fusion::Softmax { .. }),
        }
    }

    /// What rounding may take of a ray's budget.
    fn rounding(&self, marched: &Marched, samples: std::ops::Range<usize>) -> f32 {
        let regions = self.logits.len();
        let lit = samples.filter(|sample| marched.weights[*sample] != 0.0);
        let logits = lit.map(|sample| {
            let masks = marched.masks[sample * regions..][..regions].iter();
            masks.zip(&self.logits).map(|(mask, logit)| mask.abs() * logit).sum::<f32>()
        });
        let largest = logits.fold(0.0, f32::max);
        ROUNDING as f32 + ROUNDING_PER_LOGIT as f32 * largest
    }

    /// The most that all regions of a sample together can be charged, where masks are shares.
    fn largest(&self, lit: f32) -> f32 {
        if self.shares { self.logits.len() as f32 * (lit * self.normals).max(0.5) } else { f32::INFINITY }
    }

    /// What leaving a region out can change of colours and features.
    fn visible(&self, region: usize, mask: f32) -> f32 {
        let mask = mask.abs();
        (mask * self.colour[region]).min(0.5).max(mask * self.features[region])
    }

    /// How much of the normal leaving a region out may take away.
    fn normal(&self, mask: f32) -> f32 {
        if self.summed { self.normals } else { self.normals * mask.abs() }
    }
}
