//! Stress on whole pictures: a small field in both of its forms, rendered where something is at the end of its range.

use std::f64::consts::{FRAC_PI_2, PI};

use candle_core::{DType, Device, Tensor};

use super::{Case, Inputs, Outputs, fresh, set};
use crate::{
    camera::{self, Camera},
    config::{Background, FieldConfig, InitialDistance},
    error::{Error, Result},
    kernels,
    model::{field::Field, file::Tensors},
    region::{REGION_COUNT, RegionSet},
    render::{RadianceField as _, RayBundle, Sampling, render_rays},
    rng::Stream,
};

/// What is done to a field's weights.
type Adjust = fn(&mut Tensors) -> Result<()>;

/// One picture.
struct Scene {
    field: FieldConfig,
    cameras: Vec<Camera>,
    resolution: usize,
    field_of_view_rad: f64,
    sampling: Sampling,
    /// ln α.
    log_alpha: Option<f32>,
    /// Factor on standard-normal codes.
    codes: f64,
    adjust: Adjust,
}

impl Scene {
    fn of(field: FieldConfig) -> Self {
        let sampling = match field.background {
            Background::Field => Sampling::closed(24),
            Background::FarPlane => Sampling::behind_the_surface(24),
        };
        Self {
            field: FieldConfig { width: 16, style_dim: 8, ..field },
            cameras: vec![Camera::at(0.3, -0.2)],
            resolution: 5,
            field_of_view_rad: camera::FIELD_OF_VIEW_RAD,
            sampling,
            log_alpha: None,
            codes: 1.0,
            adjust: |_| Ok(()),
        }
    }

    fn ours() -> Self {
        Self::of(FieldConfig::ours())
    }

    fn paper() -> Self {
        Self::of(FieldConfig { alpha_initial: 0.02, ..FieldConfig::paper() })
    }

    fn seen_from(self, cameras: Vec<Camera>) -> Self {
        Self { cameras, ..self }
    }

    fn sampled(self, sampling: Sampling) -> Self {
        Self { sampling, ..self }
    }

    fn sphere(mut self, radius: f64) -> Self {
        self.field.initial_distance = InitialDistance::Sphere { radius };
        self
    }

    fn adjusted(self, adjust: Adjust) -> Self {
        Self { adjust, ..self }
    }

    fn weights(&self) -> Result<Tensors> {
        let mut weights = fresh(|parameters| Field::new(&self.field, parameters))?;
        // An untrained field's masks and residuals hardly differ from nothing; these do.
        for suffix in ["mask.weight", "residual.weight", "colour.weight"] {
            if let Some(weight) = weights.get_mut(suffix) {
                *weight = (&*weight * 8.0)?;
            }
        }
        if let Some(log_alpha) = self.log_alpha {
            set(&mut weights, "log_alpha", |_| log_alpha)?;
        }
        (self.adjust)(&mut weights)?;
        Ok(weights)
    }

    fn portraits(&self, inputs: &mut Inputs) -> Result<crate::model::field::PortraitField> {
        let parameters = inputs.parameters(&self.weights()?)?;
        let field = Field::new(&self.field, &parameters)?;
        inputs.differentiate(&parameters);
        let shape = [self.cameras.len(), REGION_COUNT, 2, self.field.style_dim];
        field.portraits(&inputs.normal("codes", &shape, self.codes)?)
    }

    fn render(&self, inputs: &mut Inputs) -> Result<Outputs> {
        let field = self.portraits(inputs)?;
        let cameras = inputs.variable("cameras", &Camera::parameter_tensor(&self.cameras, &Device::Cpu)?)?;
        let pixels = camera::pixel_centres(self.resolution, &Device::Cpu)?.to_dtype(inputs.dtype)?;
        let rays = RayBundle::new(camera::cast(&cameras, &pixels, self.resolution, self.field_of_view_rad)?)?;
        let depths = inputs.constant(&self.sampling.regular(DType::F32, &Device::Cpu)?)?;
        let outputs = kernels::Outputs { gradient: true, colour: true, activations: true };
        let output = render_rays(&field, &rays, &depths, &self.sampling, outputs, RegionSet::ALL)?;
        let missing = |name: &str| Error::config("stability", format!("the render has no {name}"));
        Ok(vec![
            // In [0, 1]: relative errors of mid-grey in [-1, 1] would be endless.
            ("colour", output.colour.affine(0.5, 0.5)?),
            ("masks", output.masks),
            ("depth", output.depth),
            ("features", output.features.ok_or_else(|| missing("features"))?),
            ("normal", output.normal.ok_or_else(|| missing("normals"))?),
            ("remaining light", output.weights.remaining),
        ])
    }

    fn case(self, name: impl Into<String>) -> Case {
        let points = self.cameras.len() * self.resolution * self.resolution * self.sampling.samples;
        Case::new(name, move |inputs| self.render(inputs)).with_terms(points)
    }

    /// Distances, masks, colours and ∇d at points of space instead of a picture.
    fn points_case(self, name: impl Into<String>, points: impl Fn() -> Vec<f32> + 'static) -> Case {
        Case::new(name, move |inputs| {
            let field = self.portraits(inputs)?;
            let points = points();
            let points =
                inputs.variable("points", &Tensor::from_slice(&points, (1, points.len() / 3, 3), &Device::Cpu)?)?;
            let outputs = kernels::Outputs { gradient: true, colour: true, activations: false };
            let evaluation = field.evaluate(&points, None, outputs)?;
            let density = field.density(&evaluation.distance)?;
            let missing = |name: &str| Error::config("stability", format!("the field gives no {name}"));
            Ok(vec![
                ("distance", evaluation.distance),
                ("density", density),
                ("masks", evaluation.masks),
                ("colours", evaluation.colours.ok_or_else(|| missing("colours"))?),
                ("distance gradient", evaluation.gradient.ok_or_else(|| missing("gradient"))?),
            ])
        })
    }
}

/// ± by turns along the regions.
fn alternating(region: usize) -> f32 {
    if region.is_multiple_of(2) { 1.0 } else { -1.0 }
}

fn zero(weights: &mut Tensors) -> Result<()> {
    scale(weights, 0.0)
}

fn denormal(weights: &mut Tensors) -> Result<()> {
    scale(weights, 1e-40)
}

fn scale(weights: &mut Tensors, factor: f64) -> Result<()> {
    for (name, weight) in weights.iter_mut() {
        if !name.ends_with("log_alpha") {
            *weight = (&*weight * factor)?;
        }
    }
    Ok(())
}

fn sampling(near: f64, far: f64, samples: usize) -> Sampling {
    let last_interval = Some((far - near) / samples as f64);
    Sampling { near, far, last_interval, ..Sampling::behind_the_surface(samples) }
}

pub(super) fn cases() -> Vec<Case> {
    let mut cases = vec![Scene::ours().case("field: our form"), Scene::paper().case("field: the paper's form")];

    for (alpha, name) in
        [(1e-5, "1e-5"), (1e-4, "1e-4"), (1e-3, "1e-3"), (1e-2, "1e-2"), (0.1, "0.1"), (1.0, "1"), (10.0, "10")]
    {
        // A little within the limits: f32's nearest to ln 10 lies beyond it.
        let log_alpha = Some((f64::ln(alpha) * (1.0 - 4e-7)) as f32);
        cases.push(Scene { log_alpha, ..Scene::ours() }.case(format!("field: α = {name}")));
    }
    cases.push(Scene { log_alpha: Some(-30.0), ..Scene::ours() }.case("field: α asked for below its limit"));
    cases.push(Scene { log_alpha: Some(9.0), ..Scene::ours() }.case("field: α asked for above its limit"));

    let alternate_masks: Adjust = |weights| set(weights, "mask.bias", |region| 1e6 * alternating(region));
    let all_masks: Adjust = |weights| set(weights, "mask.bias", |_| 1e6);
    let no_masks: Adjust = |weights| set(weights, "mask.bias", |_| -1e6);
    cases.push(Scene::ours().adjusted(alternate_masks).case("field: masks ±1e6, softmax"));
    cases.push(Scene::ours().adjusted(all_masks).case("field: masks all 1e6, softmax"));
    cases.push(Scene::ours().adjusted(no_masks).case("field: masks all −1e6, softmax"));
    cases.push(Scene::paper().adjusted(alternate_masks).case("field: masks ±1e6, raw"));

    // Residual heads are scaled by 0.12 in our form; these biases make distances of 1e3 world units.
    let far: Adjust = |weights| set(weights, "residual.bias", |_| 1e3 / 0.12);
    let deep: Adjust = |weights| set(weights, "residual.bias", |_| -1e3 / 0.12);
    let torn: Adjust = |weights| set(weights, "residual.bias", |region| 1e3 / 0.12 * alternating(region));
    cases.push(Scene::ours().adjusted(far).case("field: distances of 1e3"));
    cases.push(Scene::ours().adjusted(deep).case("field: distances of −1e3"));
    cases.push(Scene::ours().adjusted(torn).case("field: regions' distances ±1e3, gated"));
    cases.push(Scene::paper().adjusted(torn).case("field: regions' distances ±1e3, summed"));

    cases.push(Scene::ours().sphere(10.0).case("field: rays entirely inside the sphere"));
    cases.push(Scene::ours().sphere(0.0).case("field: a sphere of no size"));
    cases.push(Scene::ours().sphere(1.0).case("field: cameras on the sphere"));
    cases.push(Scene::paper().sphere(10.0).case("field: rays entirely inside, closed"));
    cases.push(Scene::paper().sphere(-10.0).case("field: rays entirely outside, closed"));

    for (azimuth, elevation, name) in [
        (0.0, FRAC_PI_2, "elevation 90°"),
        (0.0, -FRAC_PI_2, "elevation −90°"),
        (PI, 0.0, "azimuth 180°"),
        (-FRAC_PI_2, FRAC_PI_2, "azimuth −90°, elevation 90°"),
        (40.0 * PI, 0.0, "azimuth twenty turns"),
    ] {
        cases.push(Scene::ours().seen_from(vec![Camera::at(azimuth, elevation)]).case(format!("camera: {name}")));
    }
    let upside_down = Camera { roll_rad: PI, ..Camera::default() };
    cases.push(Scene::ours().seen_from(vec![upside_down]).case("camera: upside down"));
    cases.push(Scene::ours().sampled(sampling(0.98, 1.1, 24)).case("camera: rays that start inside the head"));
    cases.push(Scene::ours().sampled(sampling(1.0, 1.1, 24)).case("camera: rays that start at the head's centre"));
    cases.push(Scene::ours().sampled(sampling(-1.0, 3.0, 50)).case("camera: rays that start behind the camera"));
    for degrees in [1.0, 60.0, 120.0] {
        let field_of_view_rad = f64::to_radians(degrees);
        cases.push(Scene { field_of_view_rad, ..Scene::ours() }.case(format!("camera: field of view {degrees}°")));
    }
    let close = Camera { zoom: 100.0, ..Camera::default() };
    cases.push(Scene::ours().seen_from(vec![close]).case("camera: zoom 100"));
    let aside = Camera { shift_x: 40.0, ..Camera::default() };
    cases.push(Scene::ours().seen_from(vec![aside]).case("rays: that hit nothing"));
    cases.push(Scene::paper().seen_from(vec![aside]).case("rays: that hit nothing, closed"));

    for samples in [1, 2, 4096] {
        let scene = Scene { resolution: 3, ..Scene::ours() };
        let scene = scene.sampled(Sampling::behind_the_surface(samples));
        cases.push(scene.case(format!("rays: {samples} samples")));
    }
    cases.push(Scene::paper().sampled(Sampling::closed(1)).case("rays: 1 sample, closed"));
    cases.push(Scene::paper().sampled(Sampling::authors(24)).case("rays: the authors' endless last interval"));
    cases.push(Scene { resolution: 1, ..Scene::ours() }.case("rays: a single one"));
    let three = vec![Camera::at(-0.4, 0.1), Camera::default(), Camera::at(0.5, -0.3)];
    cases.push(Scene { resolution: 3, ..Scene::ours() }.seen_from(three).case("rays: three portraits at once"));

    cases.push(Scene::ours().adjusted(zero).case("field: all weights zero"));
    cases.push(Scene::paper().adjusted(zero).case("field: all weights zero, the paper's form"));
    cases.push(Scene::ours().adjusted(denormal).case("field: denormal weights"));
    cases.push(Scene { codes: 0.0, ..Scene::ours() }.case("field: codes all zero"));
    cases.push(Scene { codes: 30.0, ..Scene::ours() }.case("field: codes thirty deviations out"));

    cases.push(Scene::ours().points_case("points: the origin", || vec![0.0; 3]));
    cases.push(Scene::paper().points_case("points: the origin, the paper's form", || vec![0.0; 3]));
    cases.push(Scene::ours().points_case("points: 1e-20 from the origin", || vec![1e-20, -1e-20, 0.0]));
    cases.push(Scene::ours().points_case("points: 1e3 away, sines of 1e5 radians", || {
        let mut random = Stream::new(5, &[]);
        (0..30).map(|_| 1e3 * random.normal()).collect()
    }));
    cases
}
