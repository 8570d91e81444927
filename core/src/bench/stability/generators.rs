//! Stress on the kernels themselves: local generators with angles far out, sizes that fill no tile; convolutions and
//! activations at the ends of f32.

use candle_core::{Device, Tensor};

use super::{Case, Inputs, Outputs};
use crate::{
    error::Result,
    kernels::{self, FILM_LAYERS, HeadShape, SdfHead, activation, autograd, conv},
    rng::Stream,
};

pub(super) fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for layer in 0..FILM_LAYERS {
        let name = format!("local generator: γ = 1e3 in layer {}", layer + 1);
        cases.push(Scene { gamma: vec![(layer, 1e3)], ..Scene::default() }.case(name));
    }
    for (gamma, name) in [(1e-3, "1e-3"), (30.0, "30"), (100.0, "100")] {
        let gamma = (0..FILM_LAYERS).map(|layer| (layer, gamma)).collect();
        cases.push(Scene { gamma, ..Scene::default() }.case(format!("local generator: γ = {name} in every layer")));
    }
    for (layer, angle, name) in [(0, 1e4, "1e4"), (0, 1e5, "1e5"), (2, 1e5, "1e5"), (4, 1e5, "1e5"), (0, 1e6, "1e6")] {
        let name = format!("local generator: sines of {name} radians in layer {}", layer + 1);
        cases.push(Scene { beta: Some((layer, angle)), ..Scene::default() }.case(name));
    }
    for points in [1, 47, 49, 97] {
        cases.push(Scene { points, ..Scene::default() }.case(format!("local generator: {points} points")));
    }
    for width in [1, 3, 17, 129] {
        cases.push(Scene { width, ..Scene::default() }.case(format!("local generator: width {width}")));
    }
    cases.push(Scene { weights: 0.0, ..Scene::default() }.case("local generator: all weights zero"));
    cases.push(Scene { weights: 1e-40, ..Scene::default() }.case("local generator: denormal weights"));
    cases.push(Scene { heads: 1e6, ..Scene::default() }.case("local generator: heads times 1e6"));
    cases.push(Scene { scale: 1e4, ..Scene::default() }.case("local generator: points 1e4 away"));
    cases.push(Scene { views: true, points: 5, ..Scene::default() }.case("local generator: heads that see the view"));

    for (name, shape, kernel, stride, padding, deviation) in [
        ("one pixel, 3×3", [1, 3, 1, 1], [5, 3, 3, 3], 1, 1, 1.0),
        ("5×7 pixels, 17 to 3 channels", [1, 17, 5, 7], [3, 17, 3, 3], 1, 1, 1.0),
        ("odd sizes, stride 2", [2, 5, 9, 7], [7, 5, 3, 3], 2, 1, 1.0),
        ("rows left over by stride 2", [1, 4, 8, 10], [3, 4, 3, 3], 2, 0, 1.0),
        ("values of 1e15", [1, 8, 6, 6], [8, 8, 3, 3], 1, 1, 1e15),
        ("denormal values", [1, 8, 6, 6], [8, 8, 3, 3], 1, 1, 1e-41),
        ("all zero", [1, 8, 6, 6], [8, 8, 1, 1], 1, 0, 0.0),
    ] {
        cases.push(Case::new(format!("convolution: {name}"), move |inputs| {
            let input = inputs.normal("input", &shape, deviation)?;
            let weight = inputs.normal("weight", &kernel, 1.0)?;
            let bias = inputs.normal("bias", &kernel[..1], deviation)?;
            Ok(vec![("output", conv::conv2d(&input, &weight, Some(&bias), stride, padding)?)])
        }));
    }
    cases.push(Case::new("convolution: its gradients differentiated again", |inputs| {
        let input = inputs.normal("input", &[1, 3, 5, 6], 1.0)?;
        let weight = inputs.normal("weight", &[4, 3, 3, 3], 1.0)?;
        let slope = inputs.normal("slope", &[1, 4, 5, 6], 1.0)?;
        let to_input = conv::conv2d_input_gradient(&slope, &weight, (5, 6), 1, 1)?;
        Ok(vec![
            ("input gradient", to_input),
            ("weight gradient", conv::conv2d_weight_gradient(&input, &slope, (3, 3), 1, 1)?),
        ])
    }));
    cases.push(Case::new("activation: SiLU of 0, ±1e-30, ±100, ±1e4 and ±1e30", |inputs| {
        let x = inputs.variable("x", &Tensor::new(FAR_OUT, &Device::Cpu)?)?;
        Ok(vec![("y", activation::silu(&x)?)])
    }));
    cases.push(Case::new("activation: modulated SiLU, gains of 1e4", |inputs| {
        let x = inputs.normal("x", &[2, 3, 5, 5], 1.0)?;
        let modulation = inputs.normal("modulation", &[2, 6, 5, 5], 1e4)?;
        Ok(vec![("y", activation::modulated_silu(&x, &modulation)?)])
    }));
    cases.push(Case::new("activation: leaky ReLU at zero and far out", |inputs| {
        let x = inputs.variable("x", &Tensor::new(FAR_OUT, &Device::Cpu)?.reshape((1, FAR_OUT.len(), 1))?)?;
        let bias = inputs.variable("bias", &Tensor::zeros(FAR_OUT.len(), candle_core::DType::F32, &Device::Cpu)?)?;
        Ok(vec![("y", conv::bias_leaky_relu(&x, Some(&bias), 0.2, std::f64::consts::SQRT_2)?)])
    }));
    cases
}

const FAR_OUT: &[f32] = &[0.0, 1e-30, -1e-30, 1.0, -1.0, 100.0, -100.0, 1e4, -1e4, 1e30, -1e30];

/// Local generators with some of their numbers far out.
struct Scene {
    width: usize,
    points: usize,
    views: bool,
    /// Standard deviation of the points.
    scale: f64,
    /// Factor on all weights.
    weights: f64,
    /// Factor on the heads' weights.
    heads: f64,
    /// Layers whose γ is this.
    gamma: Vec<(usize, f32)>,
    /// The layer whose β reaches up to this, either way.
    beta: Option<(usize, f32)>,
}

impl Default for Scene {
    fn default() -> Self {
        Self {
            width: 24,
            points: 50,
            views: false,
            scale: 0.7,
            weights: 1.0,
            heads: 1.0,
            gamma: Vec::new(),
            beta: None,
        }
    }
}

const REGIONS: usize = 2;

impl Scene {
    fn case(self, name: impl Into<String>) -> Case {
        Case::new(name, move |inputs| self.compute(inputs))
    }

    fn compute(&self, inputs: &mut Inputs) -> Result<Outputs> {
        let shape = HeadShape {
            width: self.width,
            sdf_head: if self.views { SdfHead::Texture } else { SdfHead::Shape },
            mask_view: self.views,
            colour_view: self.views,
        };
        let mut random = Stream::new(3, &[]);
        let mut draw = |count: usize, mean: f64, deviation: f64| -> Vec<f32> {
            (0..count).map(|_| (mean + deviation * f64::from(random.normal())) as f32).collect()
        };
        let layout = shape.layout();
        // About as large as a trained model's, so that an angle is a few radians where nothing stresses it.
        let mut weights = draw(REGIONS * shape.parameter_count(), 0.0, self.weights * 0.7 / (self.width as f64).sqrt());
        for row in weights.chunks_exact_mut(shape.parameter_count()) {
            row[layout.mask.weight.start..].iter_mut().for_each(|weight| *weight *= self.heads as f32);
        }
        let mut film = draw(REGIONS * FILM_LAYERS * 2 * self.width, 1.5, 0.7);
        for layer in film.chunks_exact_mut(2 * self.width).enumerate() {
            let (index, (gamma, beta)) = (layer.0 % FILM_LAYERS, layer.1.split_at_mut(self.width));
            for (_, value) in self.gamma.iter().filter(|(layer, _)| *layer == index) {
                gamma.fill(*value);
            }
            if let Some((_, largest)) = self.beta.filter(|(layer, _)| *layer == index) {
                for (unit, beta) in beta.iter_mut().enumerate() {
                    *beta = largest * (2.0 * (unit as f32 + 0.5) / self.width as f32 - 1.0);
                }
            }
        }
        let points = draw(self.points * shape.point_columns(), 0.0, self.scale);
        let tensor = |values: Vec<f32>, dims: &[usize]| Tensor::from_vec(values, dims, &Device::Cpu);
        let points = inputs.variable("points", &tensor(points, &[1, self.points, shape.point_columns()])?)?;
        let weights = inputs.variable("weights", &tensor(weights, &[REGIONS, shape.parameter_count()])?)?;
        let film = inputs.variable("film", &tensor(film, &[1, REGIONS, FILM_LAYERS, 2, self.width])?)?;
        let outputs = kernels::Outputs { gradient: true, colour: true, activations: true };
        let rows = shape.rows(outputs);
        let raw = autograd::evaluate(&points, &weights, &film, shape, outputs)?;
        let block = |first: usize, count: usize| raw.narrow(2, first, count);
        let mut results = vec![("mask", block(rows.mask, 1)?), ("residual", block(rows.residual, 1)?)];
        let ranges = [
            ("mask gradient", rows.mask_gradient),
            ("residual gradient", rows.residual_gradient),
            ("colour", rows.colour),
            ("activations", rows.activations),
        ];
        for (name, range) in ranges {
            if let Some(range) = range {
                results.push((name, block(range.start, range.len())?));
            }
        }
        Ok(results)
    }
}
