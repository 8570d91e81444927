//! Whether a portrait's views agree: colours, regions and fine detail of one view against another's, carried over by
//! the rendered depth. Only what both views see of the head counts (see [`super::warp`]).

use candle_core::{DType, Device, Tensor};
use serde::Serialize;

use super::{
    quality::{Agreement, MAX_PSNR_DB},
    subject::Subject,
    warp::{Raster, Surface, Warp},
};
use crate::{
    camera::Camera,
    data::{
        dataset::{Dataset, Item},
        labels::LabelMap,
        picture,
    },
    error::{Error, Result},
    model::generator::Picture,
};

/// How far the two views of the reprojection are turned from the middle one, radians.
pub const REPROJECTION_RAD: f64 = 0.3;
/// How far the views whose fine detail is compared with the middle one's are turned, radians (recipe).
pub const DETAIL_RAD: [f64; 2] = [0.05, 0.4];
/// Fine detail is what a Gaussian of this share of the picture's width takes away: a pixel of a 64² render.
const BLUR_SHARE: f64 = 1.0 / 64.0;
/// A picture of a data set is turned by an angle if it is so to this much, radians.
const SAME_TURN_RAD: f64 = 1e-3;
/// Smallest number of pixels that say something.
const LEAST_PIXELS: usize = 16;

/// Agreement of a turned view's fine detail with the middle view's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Detail {
    /// How far the view is turned, radians; what follows is the mean of both sides.
    pub turn_rad: f64,
    /// Correlation of the high-passed luma of the finished pictures after the warp.
    pub correlation: Option<f64>,
    /// The same without the warp: detail that sticks to the screen has it high.
    pub unwarped_correlation: Option<f64>,
    /// The same as `correlation` for the render under the picture: what the upsampler could keep.
    pub field_correlation: Option<f64>,
    /// Mean absolute difference of the finished pictures' luma after the warp, in grey levels of 255: flicker.
    pub flicker_grey_levels: Option<f64>,
    /// The same of the render under the picture.
    pub field_flicker_grey_levels: Option<f64>,
}

/// How well the views of one portrait, or the mean of several, agree.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Consistency {
    /// PSNR between the view at −0.3 rad and the one at +0.3 rad, each carried to the other, dB.
    pub reprojection_psnr: Option<f64>,
    /// PSNR between the middle view and those at ±0.3 rad, dB.
    pub reprojection_psnr_from_middle: Option<f64>,
    /// Mean IoU of the regions of the same two views as `reprojection_psnr`.
    pub mask_consistency: Option<f64>,
    /// Share of the head's pixels at ∓0.3 rad that the other view sees, by both views' depth.
    pub visible_share: f64,
    /// Fine detail at ±0.05 and ±0.4 rad.
    pub detail: [Detail; 2],
}

impl Consistency {
    /// Measures a portrait, turned to both sides of its own camera's elevation, roll, shift and zoom; the middle view
    /// is at azimuth 0. Seven pictures are rendered.
    pub fn of(subject: &Subject<'_>) -> Result<Self> {
        let view = |azimuth_rad: f64| {
            let camera = Camera { azimuth_rad, ..subject.camera };
            View::new(camera, &subject.picture(&camera)?)
        };
        Self::between(&view(0.0)?, |turn_rad| view(turn_rad).map(Some))
    }

    /// Measures the pictures of one head in a data set that knows their depth: what the same measures say of the truth.
    /// The first of `views` is the middle; others count if they are turned from it by one of the angles measured
    /// (`cnerf synth --with depth --turns=-0.4,-0.3,-0.05,0.05,0.3,0.4`). None if the middle view has no depth, regions
    /// or camera.
    pub fn of_truth(dataset: &Dataset, views: &[usize]) -> Result<Option<Self>> {
        let Some((&first, others)) = views.split_first() else { return Ok(None) };
        let Some(middle) = View::of_truth(dataset, first)? else { return Ok(None) };
        let turned = |turn_rad: f64| -> Result<Option<View>> {
            let azimuth_rad = middle.surface.camera().azimuth_rad + turn_rad;
            for view in others {
                let Some(camera) = dataset.camera(*view)? else { continue };
                if (camera.azimuth_rad - azimuth_rad).abs() < SAME_TURN_RAD {
                    return View::of_truth(dataset, *view);
                }
            }
            Ok(None)
        };
        Self::between(&middle, turned).map(Some)
    }

    /// Measures the view in the middle against those turned by an angle, as far as they are there.
    fn between(middle: &View, turned: impl Fn(f64) -> Result<Option<View>>) -> Result<Self> {
        let sides = [turned(-REPROJECTION_RAD)?, turned(REPROJECTION_RAD)?];
        let (mut across, mut from_middle) = (Reprojection::default(), Reprojection::default());
        if let [Some(left), Some(right)] = &sides {
            across.add(left, right)?;
            across.add(right, left)?;
        }
        for side in sides.iter().flatten() {
            from_middle.add(side, middle)?;
        }
        let mut detail = [Detail::default(); 2];
        for (detail, turn_rad) in detail.iter_mut().zip(DETAIL_RAD) {
            let sides = [turned(-turn_rad)?, turned(turn_rad)?];
            let sides: Vec<Detail> = sides.iter().flatten().map(|view| view.detail(middle, turn_rad)).collect();
            *detail = Detail { turn_rad, ..Detail::mean(&sides) };
        }
        Ok(Self {
            reprojection_psnr: across.psnr(),
            reprojection_psnr_from_middle: from_middle.psnr(),
            mask_consistency: across.agreement.mean_iou(),
            visible_share: across.visible as f64 / across.foreground.max(1) as f64,
            detail,
        })
    }

    /// The mean of several portraits; what a portrait lacks is left out of the mean.
    pub fn mean(portraits: &[Self]) -> Self {
        let of = |value: fn(&Self) -> Option<f64>| mean(portraits.iter().filter_map(value));
        let detail = std::array::from_fn(|index| {
            Detail::mean(&portraits.iter().map(|portrait| portrait.detail[index]).collect::<Vec<_>>())
        });
        Self {
            reprojection_psnr: of(|portrait| portrait.reprojection_psnr),
            reprojection_psnr_from_middle: of(|portrait| portrait.reprojection_psnr_from_middle),
            mask_consistency: of(|portrait| portrait.mask_consistency),
            visible_share: of(|portrait| Some(portrait.visible_share)).unwrap_or_default(),
            detail,
        }
    }
}

impl Detail {
    fn mean(details: &[Self]) -> Self {
        let of = |value: fn(&Self) -> Option<f64>| mean(details.iter().filter_map(value));
        Self {
            turn_rad: details.first().map_or(0.0, |detail| detail.turn_rad),
            correlation: of(|detail| detail.correlation),
            unwarped_correlation: of(|detail| detail.unwarped_correlation),
            field_correlation: of(|detail| detail.field_correlation),
            flicker_grey_levels: of(|detail| detail.flicker_grey_levels),
            field_flicker_grey_levels: of(|detail| detail.field_flicker_grey_levels),
        }
    }
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, count) = values.fold((0.0, 0usize), |(sum, count), value| (sum + value, count + 1));
    (count > 0).then(|| sum / count as f64)
}

/// One view: colours in [0, 1], luma and its fine detail, at the output's and the render's resolution.
struct View {
    surface: Surface,
    output: Layer,
    field: Layer,
    labels: LabelMap,
}

/// Channels red, green, blue, luma, fine detail.
struct Layer(Raster);

const LUMA: usize = 3;
const DETAIL: usize = 4;

impl Layer {
    fn new(rgb: &Tensor) -> Result<Self> {
        let rgb = Raster::from_tensor(&rgb.clamp(-1.0, 1.0)?.affine(0.5, 0.5)?)?;
        let side = rgb.side();
        let mut channels = rgb.channels().to_vec();
        let weights = [0.299, 0.587, 0.114];
        let luma: Vec<f64> = (0..side * side)
            .map(|index| channels.iter().zip(weights).map(|(channel, weight)| channel[index] * weight).sum())
            .collect();
        let detail = high_pass(&luma, side);
        channels.extend([luma, detail]);
        Ok(Self(Raster::new(side, channels)?))
    }
}

/// A luma plane without what a Gaussian blur leaves of it; the blur's weights are shared out again at the edges.
fn high_pass(luma: &[f64], side: usize) -> Vec<f64> {
    let deviation = BLUR_SHARE * side as f64;
    let reach = (3.0 * deviation).ceil() as i64;
    let weights: Vec<f64> = (-reach..=reach).map(|offset| (-0.5 * (offset as f64 / deviation).powi(2)).exp()).collect();
    let blur = |values: &dyn Fn(i64) -> Option<f64>, centre: i64| {
        let (mut sum, mut total) = (0.0, 0.0);
        for (weight, offset) in weights.iter().zip(-reach..) {
            if let Some(value) = values(centre + offset) {
                (sum, total) = (sum + weight * value, total + weight);
            }
        }
        sum / total
    };
    let at = |plane: &[f64], x: i64, y: i64| {
        let inside = (0..side as i64).contains(&x) && (0..side as i64).contains(&y);
        if inside { plane.get(y as usize * side + x as usize).copied() } else { None }
    };
    let places = || (0..(side * side) as i64).map(|index| (index % side as i64, index / side as i64));
    let across: Vec<f64> = places().map(|(x, y)| blur(&|column| at(luma, column, y), x)).collect();
    places().zip(luma).map(|((x, y), value)| value - blur(&|row| at(&across, x, row), y)).collect()
}

impl View {
    fn new(camera: Camera, picture: &Picture) -> Result<Self> {
        Ok(Self {
            surface: Surface::new(camera, &picture.frame)?,
            output: Layer::new(&picture.rgb)?,
            field: Layer::new(&picture.frame.colour)?,
            labels: LabelMap::from_masks(&picture.masks.squeeze(0)?)?,
        })
    }

    /// The picture at `index` of a data set, at its own size, if its depth, regions and camera are known.
    fn of_truth(dataset: &Dataset, index: usize) -> Result<Option<Self>> {
        let (depth, Item { image, mask, camera }) = (dataset.depth(index)?, dataset.item(index)?);
        let (Some(depth), Some(labels), Some(camera)) = (depth, mask, camera) else { return Ok(None) };
        let side = image.width();
        if depth.dims() != [side as usize; 2] {
            return Err(Error::shape("depth", [side as usize; 2], depth.dims()));
        }
        let head = labels.labels().iter().map(|label| if *label == 0 { 0.0 } else { 1.0 }).collect();
        let depths = depth.to_dtype(DType::F64)?.flatten_all()?.to_vec1()?;
        let half = picture::resize_area(&image, side.div_ceil(2), side.div_ceil(2))?;
        Ok(Some(Self {
            surface: Surface::of_head(camera, Raster::new(side as usize, vec![depths, head])?),
            output: Layer::new(&picture::to_tensor(&[image], &Device::Cpu)?)?,
            field: Layer::new(&picture::to_tensor(&[half], &Device::Cpu)?)?,
            labels,
        }))
    }

    /// Compares this view's fine detail with what `source` shows of the same places.
    fn detail(&self, source: &Self, turn_rad: f64) -> Detail {
        let compare = |target: &Layer, found: &Layer| {
            let side = target.0.side();
            let warp = Warp::new(&self.surface, &source.surface, side);
            let channel = |index: usize, channel: usize| target.0.channels()[channel][index];
            let warped = warp.visible().map(|(index, place)| (channel(index, DETAIL), found.0.cubic(DETAIL, place)));
            let unwarped = warp.visible().map(|(index, _)| (channel(index, DETAIL), found.0.channels()[DETAIL][index]));
            let luma = warp.visible().map(|(index, place)| (channel(index, LUMA) - found.0.cubic(LUMA, place)).abs());
            let flicker = mean(luma).map(|difference| 255.0 * difference);
            (correlation(warped), correlation(unwarped), flicker)
        };
        let (correlated, unwarped_correlation, flicker_grey_levels) = compare(&self.output, &source.output);
        let (field_correlation, _, field_flicker_grey_levels) = compare(&self.field, &source.field);
        Detail {
            turn_rad,
            correlation: correlated,
            unwarped_correlation,
            field_correlation,
            flicker_grey_levels,
            field_flicker_grey_levels,
        }
    }
}

/// Pearson's correlation of pairs; none for too few of them, or where one side is constant.
pub fn correlation(pairs: impl Iterator<Item = (f64, f64)>) -> Option<f64> {
    let pairs: Vec<(f64, f64)> = pairs.collect();
    let count = pairs.len() as f64;
    if pairs.len() < LEAST_PIXELS {
        return None;
    }
    let (x, y) = pairs.iter().fold((0.0, 0.0), |(x, y), pair| (x + pair.0 / count, y + pair.1 / count));
    let (mut xx, mut yy, mut xy) = (0.0, 0.0, 0.0);
    for (a, b) in pairs {
        xx += (a - x).powi(2);
        yy += (b - y).powi(2);
        xy += (a - x) * (b - y);
    }
    // Deviations below 1e-10 are rounding.
    let varies = xx.min(yy) > 1e-20 * count;
    varies.then(|| xy / (xx * yy).sqrt())
}

/// Differences of colours and regions over the pixels that two views share.
#[derive(Default)]
struct Reprojection {
    squares: f64,
    visible: usize,
    foreground: usize,
    agreement: Agreement,
}

impl Reprojection {
    /// Adds `target`'s pixels, compared with what `source` shows there.
    fn add(&mut self, target: &View, source: &View) -> Result<()> {
        let side = target.output.0.side();
        let warp = Warp::new(&target.surface, &source.surface, side);
        let (mut expected, mut found) = (Vec::new(), Vec::new());
        for (index, place) in warp.visible() {
            for channel in 0..LUMA {
                let difference =
                    target.output.0.channels()[channel][index] - source.output.0.cubic(channel, place).clamp(0.0, 1.0);
                self.squares += difference * difference / LUMA as f64;
            }
            let labels = [(&target.labels, index), (&source.labels, source.output.0.nearest(place))];
            let [a, b] = labels.map(|(map, index)| map.labels().get(index).copied().unwrap_or_default());
            expected.push(a);
            found.push(b);
        }
        self.visible += expected.len();
        self.foreground += warp.foreground;
        let width = expected.len() as u32;
        if width > 0 {
            self.agreement.add(&LabelMap::new(width, 1, expected)?, &LabelMap::new(width, 1, found)?)?;
        }
        Ok(())
    }

    fn psnr(&self) -> Option<f64> {
        let mean = self.squares / self.visible.max(1) as f64;
        (self.visible >= LEAST_PIXELS).then(|| (-10.0 * mean.log10()).min(MAX_PSNR_DB))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::{FAR, NEAR},
        region::{REGION_COUNT, Region},
        render::Frame,
    };

    const SIDE: usize = 64;
    /// A head of this radius at the origin.
    const RADIUS: f64 = 0.08;

    /// A textured sphere; `stuck` paints the texture on the screen instead of the sphere.
    fn sphere(camera: &Camera, stuck: bool) -> Picture {
        let pixels = SIDE * SIDE;
        let (mut colour, mut depth) = (vec![0f64; 3 * pixels], vec![FAR; pixels]);
        let (mut opacity, mut masks) = (vec![0f64; pixels], vec![0f64; REGION_COUNT * pixels]);
        for index in 0..pixels {
            let at = |place: usize| (2 * place + 1) as f64 / SIDE as f64 - 1.0;
            let [x, y] = [at(index % SIDE), -at(index / SIDE)];
            let (origin, direction) = camera.ray(x, y);
            let dot = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            let (a, b, c) = (dot(direction, direction), dot(origin, direction), dot(origin, origin) - RADIUS * RADIUS);
            let root = b * b - a * c;
            let mut region = Region::Background;
            if root > 0.0 {
                let distance = (-b - root.sqrt()) / a;
                let point: [f64; 3] = std::array::from_fn(|axis| origin[axis] + distance * direction[axis]);
                let place = if stuck { [0.08 * x, 0.08 * y, 0.0] } else { point };
                let wave = (250.0 * place[0]).sin() * (200.0 * place[1]).cos() + (150.0 * place[2]).sin();
                for channel in 0..3 {
                    colour[channel * pixels + index] = 0.4 * wave / (1.0 + channel as f64);
                }
                (depth[index], opacity[index]) = (distance, 1.0);
                region = if point[0] > 0.0 { Region::Face } else { Region::Hair };
            }
            masks[region.index() * pixels + index] = 1.0;
        }
        assert!(depth.iter().all(|depth| (NEAR..=FAR).contains(depth)));
        let tensor = |values: Vec<f64>| {
            let channels = values.len() / pixels;
            Tensor::from_vec(values, (1, channels, SIDE, SIDE), &Device::Cpu).unwrap()
        };
        let (colour, masks) = (tensor(colour), tensor(masks));
        let frame = Frame {
            colour: colour.clone(),
            features: None,
            masks: masks.clone(),
            depth: tensor(depth),
            normal: None,
            point: tensor(vec![0.0; 3 * pixels]),
            opacity: tensor(opacity),
        };
        Picture { rgb: colour, masks, frame }
    }

    fn view(azimuth_rad: f64, stuck: bool) -> View {
        let camera = Camera::at(azimuth_rad, 0.0);
        View::new(camera, &sphere(&camera, stuck)).unwrap()
    }

    #[test]
    fn a_solid_head_is_consistent_and_a_painted_screen_is_not() {
        let compare = |stuck: bool| {
            let mut reprojection = Reprojection::default();
            reprojection.add(&view(-0.2, stuck), &view(0.2, stuck)).unwrap();
            (reprojection.psnr().unwrap(), reprojection, view(0.1, stuck).detail(&view(0.0, stuck), 0.1))
        };
        let (psnr, reprojection, detail) = compare(false);
        // What is lost is the sampling of a wave of about 12 pixels, and of the curved depth.
        assert!(psnr > 32.0, "{psnr}");
        assert!(reprojection.agreement.mean_iou().unwrap() > 0.95);
        assert!(reprojection.visible as f64 > 0.6 * reprojection.foreground as f64);
        assert!(detail.correlation.unwrap() > 0.95, "{detail:?}");
        assert!(detail.unwrapped() < 0.7, "{detail:?}");
        let (stuck_psnr, _, stuck) = compare(true);
        assert!(stuck_psnr < psnr - 10.0, "{stuck_psnr} {psnr}");
        assert!(stuck.unwrapped() > 0.97 && stuck.correlation.unwrap() < 0.7, "{stuck:?}");
        assert!(stuck.flicker_grey_levels.unwrap() > 4.0 * detail.flicker_grey_levels.unwrap());
    }

    impl Detail {
        fn unwrapped(&self) -> f64 {
            self.unwarped_correlation.unwrap()
        }
    }

    #[test]
    fn the_high_pass_takes_slopes_away_and_keeps_edges() {
        let flat: Vec<f64> = (0..SIDE * SIDE).map(|index| 0.2 + 0.01 * (index % SIDE) as f64).collect();
        let passed = high_pass(&flat, SIDE);
        let inner = |index: usize| (8..SIDE - 8).contains(&(index % SIDE));
        assert!(passed.iter().enumerate().all(|(index, value)| !inner(index) || value.abs() < 1e-12));
        let board: Vec<f64> = (0..SIDE * SIDE).map(|index| ((index % SIDE + index / SIDE) % 2) as f64).collect();
        let passed = high_pass(&board, SIDE);
        assert!((passed[SIDE * 20 + 20].abs() - 0.5).abs() < 0.01, "{}", passed[SIDE * 20 + 20]);
    }

    #[test]
    fn correlation_is_pearsons() {
        let line = |slope: f64| correlation((0..20).map(|x| (f64::from(x), slope * f64::from(x) + 3.0)));
        assert!((line(2.0).unwrap() - 1.0).abs() < 1e-12 && (line(-0.1).unwrap() + 1.0).abs() < 1e-12);
        assert_eq!(line(0.0), None);
        assert_eq!(correlation((0..3).map(|x| (f64::from(x), f64::from(x)))), None);
    }
}
