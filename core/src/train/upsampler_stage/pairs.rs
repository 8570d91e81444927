//! Training portraits paired with their photos: the field's render of each, made once, and the crop of a step.

use candle_core::{DType, Device, Tensor};

use crate::{
    camera::Camera,
    data::loader::{Cached, Draw},
    error::{Error, Result},
    model::generator::Generator,
    region::REGION_COUNT,
    render::{Frame, RenderSettings},
    rng::Stream,
    train::{config::TrainConfig, people::People, portrait_codes::PortraitCodes, preview, team::Team, trainer::Inputs},
};

/// Renders of training portraits are kept up to this many; beyond it they are rendered each time they are needed.
const MOST_KEPT: usize = 2_500;

/// Largest error of a render, as of the command line's pictures.
const BUDGET: f64 = 0.002;

/// Training portraits with codes, and their renders.
pub(super) struct Pairs {
    portraits: Cached,
    people: People,
    pictures: Vec<Draw>,
    codes: PortraitCodes,
    renders: Vec<Option<Render>>,
    kept: usize,
    team: Team,
}

/// A square of the renders of some portraits, and the same square of their photos.
pub(super) struct PairBatch {
    /// The renders' square, `[B, …, crop, crop]`.
    pub frame: Frame,
    /// `[B, 9, 2, D]`.
    pub codes: Tensor,
    /// The photos' square in [-1, 1], `[B, 3, side, side]`.
    pub photo: Tensor,
    /// Its regions, `[B, 9, side, side]`.
    pub masks: Tensor,
}

/// A square of a render, in its pixels.
#[derive(Clone, Copy, Debug)]
pub(super) struct Square {
    pub left: usize,
    pub top: usize,
    pub side: usize,
}

impl Square {
    /// A random square of `side` pixels within `resolution`.
    pub fn random(side: usize, resolution: usize, random: &mut Stream) -> Self {
        let side = side.min(resolution);
        Self { left: random.below(resolution - side + 1), top: random.below(resolution - side + 1), side }
    }

    /// The square of a picture `factor` times as fine.
    pub fn of(&self, picture: &Tensor, factor: usize) -> Result<Tensor> {
        let side = self.side * factor;
        Ok(picture.narrow(2, self.top * factor, side)?.narrow(3, self.left * factor, side)?.contiguous()?)
    }

    /// The square of every part of a render.
    pub fn of_frame(&self, frame: &Frame) -> Result<Frame> {
        frame.try_map(|picture| self.of(picture, 1))
    }
}

impl Pairs {
    /// The photos of `inputs` at `resolution`, and the codes a warm-up on them left.
    pub fn new(
        config: &TrainConfig,
        inputs: &Inputs,
        codes: Option<&PortraitCodes>,
        resolution: usize,
    ) -> Result<Self> {
        let people = People::of(&inputs.dataset, config.mirror);
        let pictures = people.pictures();
        let codes = codes.filter(|codes| codes.count() == people.count()).ok_or_else(|| {
            let reason = "pairs need the codes a warm-up on the same data left beside its model; \
                          run --stage all, or --set upsampler.pixels=0 upsampler.perceptual=0";
            Error::config("upsampler.pixels", reason)
        })?;
        let portraits = Cached::new(&inputs.dataset, &[resolution], &|_| ())?;
        let renders = vec![None; pictures.len()];
        Ok(Self { portraits, people, pictures, codes: codes.clone(), renders, kept: 0, team: inputs.team.clone() })
    }

    /// The codes of all portraits.
    pub fn codes(&self) -> &PortraitCodes {
        &self.codes
    }

    /// Portraits spread over the set: their rows among the codes, and their cameras.
    pub fn spread(&self) -> (Vec<u32>, Vec<Camera>) {
        preview::spread(&self.people, &self.portraits)
    }

    /// One random square of `count` random portraits.
    pub fn batch(
        &mut self,
        generator: &Generator,
        count: usize,
        crop: usize,
        step: usize,
        random: &mut Stream,
    ) -> Result<PairBatch> {
        let (device, resolution) = (generator.device(), generator.output_resolution());
        let factor = resolution / generator.render_resolution();
        let places = random.permutation(self.pictures.len());
        let whole = self.team.portraits(count, places.len())?;
        let places = self.team.share().pick(&places[..whole]);
        let square = Square::random(crop, generator.render_resolution(), random);
        let renders = places.iter().map(|place| self.render(generator, *place)).collect::<Result<Vec<_>>>()?;
        let draws: Vec<Draw> = places.iter().map(|place| self.pictures[*place]).collect();
        let photos = self.portraits.batch(step as u64, &draws)?;
        let photos = photos.at(resolution)?;
        let rows: Vec<u32> = draws.iter().map(|draw| self.people.row(*draw) as u32).collect();
        Ok(PairBatch {
            frame: square.of_frame(&Render::batch(&renders, &device)?)?,
            codes: self.codes.codes(generator, &rows)?.detach(),
            photo: square.of(&photos.images.to_device(&device)?, factor)?,
            masks: square.of(&photos.masks.to_device(&device)?, factor)?,
        })
    }

    /// The render of a training portrait from its own camera.
    fn render(&mut self, generator: &Generator, place: usize) -> Result<Render> {
        if let Some(Some(render)) = self.renders.get(place) {
            return Ok(render.clone());
        }
        let picture = self.pictures[place];
        let codes = self.codes.codes(generator, &[self.people.row(picture) as u32])?;
        let camera = self.portraits.camera(picture).unwrap_or_default();
        let cameras = Camera::parameter_tensor(&[camera], &generator.device())?;
        let render = Render::of(&generator.render(&codes, &cameras, &settings(generator))?)?;
        if self.kept < MOST_KEPT {
            self.kept += 1;
            self.renders[place] = Some(render.clone());
        }
        Ok(render)
    }
}

/// How renders are made for training: as those of finished portraits are. The field gets no gradient, so what a plan leaves
/// out is bounded by the budget and is nothing else.
pub(super) fn settings(generator: &Generator) -> RenderSettings {
    RenderSettings { budget: BUDGET, ..generator.render_settings() }
}

/// A render as the upsampler reads it, f16: half the memory, and an error far below the renders' own.
#[derive(Clone)]
struct Render {
    values: Tensor,
    has_normal: bool,
}

impl Render {
    fn of(frame: &Frame) -> Result<Self> {
        let features = frame.features.as_ref().ok_or_else(|| Error::config("features", "were not rendered"))?;
        let mut parts = vec![&frame.colour, &frame.masks, &frame.depth, &frame.point, &frame.opacity, features];
        parts.extend(frame.normal.as_ref());
        let values = Tensor::cat(&parts, 1)?.to_dtype(DType::F16)?.detach();
        Ok(Self { values, has_normal: frame.normal.is_some() })
    }

    /// The frame of several renders.
    fn batch(renders: &[Self], device: &Device) -> Result<Frame> {
        let has_normal = renders.iter().all(|render| render.has_normal);
        let values: Vec<&Tensor> = renders.iter().map(|render| &render.values).collect();
        let values = Tensor::cat(&values, 0)?.to_device(device)?.to_dtype(DType::F32)?;
        let normals = if has_normal { 3 } else { 0 };
        let mut first = 0;
        let mut part = |count: usize| {
            first += count;
            values.narrow(1, first - count, count)
        };
        let (colour, masks, depth) = (part(3)?, part(REGION_COUNT)?, part(1)?);
        let (point, opacity) = (part(3)?, part(1)?);
        let features = values.dim(1)? - (3 + REGION_COUNT + 1 + 3 + 1) - normals;
        let features = Some(part(features)?);
        let normal = if has_normal { Some(part(normals)?) } else { None };
        Ok(Frame { colour, features, masks, depth, normal, point, opacity })
    }
}
