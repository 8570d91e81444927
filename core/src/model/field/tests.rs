use candle_core::{DType, Device, Tensor};

use super::*;
use crate::{
    camera::Camera,
    codes::{Aspect, blend},
    region::Region,
    render::{Frame, RenderSettings, Sampling, TwoPass, render_frame},
    rng::Stream,
};

const ALL: Outputs = Outputs { gradient: true, colour: true, activations: true };

fn config(form: FieldConfig) -> FieldConfig {
    FieldConfig { style_dim: 6, width: 8, ..form }
}

/// Every combination that changes how distances are put together.
fn forms() -> Vec<FieldConfig> {
    let ours = config(FieldConfig::ours());
    let paper = config(FieldConfig::paper());
    vec![
        FieldConfig { fusion: Fusion::Raw, ..ours.clone() },
        FieldConfig { residual: Residual::Sum, background: Background::Field, ..ours.clone() },
        FieldConfig { sdf_head: SdfHead::Texture, ..paper.clone() },
        FieldConfig { initial_distance: InitialDistance::Network, ..paper.clone() },
        FieldConfig { density: DensityKind::Sdf, ..paper.clone() },
        FieldConfig { density: DensityKind::Density, ..ours.clone() },
        FieldConfig { composition: Composition::Single, ..ours.clone() },
        ours,
        paper,
    ]
}

fn codes(batch: usize, seed: u64, dtype: DType) -> Tensor {
    Stream::new(seed, &[]).normal_tensor(&[batch, 9, 2, 6], &Device::Cpu).unwrap().to_dtype(dtype).unwrap()
}

fn points(batch: usize, count: usize, dtype: DType) -> Tensor {
    let points = Stream::new(9, &[]).uniform_tensor(&[batch, count, 3], -0.1, 0.1, &Device::Cpu).unwrap();
    points.to_dtype(dtype).unwrap()
}

fn portraits(config: &FieldConfig, dtype: DType) -> PortraitField {
    let parameters = Parameters::fresh(4, dtype, &Device::Cpu);
    Field::new(config, &parameters).unwrap().portraits(&codes(2, 1, dtype)).unwrap()
}

fn largest(tensor: &Tensor) -> f64 {
    tensor.to_dtype(DType::F64).unwrap().abs().unwrap().max_all().unwrap().to_scalar().unwrap()
}

fn difference(left: &Tensor, right: &Tensor) -> f64 {
    largest(&(left.to_dtype(DType::F64).unwrap() - right.to_dtype(DType::F64).unwrap()).unwrap())
}

#[test]
fn gradients_of_the_whole_distance_match_finite_differences() {
    for form in forms() {
        let field = portraits(&form, DType::F64);
        let points = points(2, 5, DType::F64);
        let gradient = field.evaluate(&points, None, ALL).unwrap().gradient.unwrap();
        let step = 1e-6;
        for axis in 0..3 {
            let mut offset = [0.0; 3];
            offset[axis] = step;
            let offset = Tensor::new(&offset, &Device::Cpu).unwrap();
            let at = |points: Tensor| field.evaluate(&points, None, Outputs::default()).unwrap().distance;
            let (right, left) =
                (at(points.broadcast_add(&offset).unwrap()), at(points.broadcast_sub(&offset).unwrap()));
            let expected = ((right - left).unwrap() / (2.0 * step)).unwrap();
            let error = difference(&gradient.narrow(1, axis, 1).unwrap().squeeze(1).unwrap(), &expected);
            // Central differences of step 1e-6 on frequencies up to 30 x 8.3 per unit.
            assert!(error < 1e-5 * (1.0 + largest(&expected)), "{form:?} axis {axis}: {error}");
        }
    }
}

#[test]
fn single_precision_follows_double() {
    for form in forms() {
        let at = |dtype| {
            let field = portraits(&form, dtype);
            let evaluation = field.evaluate(&points(2, 40, dtype), None, ALL).unwrap();
            let density = field.density(&evaluation.distance).unwrap();
            [evaluation.distance, evaluation.masks, evaluation.gradient.unwrap(), evaluation.colours.unwrap(), density]
        };
        for (single, double) in at(DType::F32).iter().zip(at(DType::F64)) {
            assert!(difference(single, &double) < 5e-5 * (1.0 + largest(&double)), "{form:?}");
        }
    }
}

#[test]
fn texture_codes_leave_the_surface_bit_identical() {
    for form in [config(FieldConfig::ours()), config(FieldConfig::paper())] {
        let field = Field::new(&form, &Parameters::fresh(4, DType::F32, &Device::Cpu)).unwrap();
        let (before, other) = (codes(1, 1, DType::F32), codes(1, 2, DType::F32));
        let after = blend(&before, &other, RegionSet::ALL, Aspect::Texture, 1.0).unwrap();
        let frame = |codes: &Tensor| frame(&field, codes, &settings(&form));
        let (before, after) = (frame(&before), frame(&after));
        for (before, after) in [(&before.depth, &after.depth), (&before.masks, &after.masks)] {
            assert_eq!(bits(before), bits(after));
        }
        assert!(difference(&before.colour, &after.colour) > 1e-3, "the texture does change");
        let normals = (before.normal.unwrap(), after.normal.unwrap());
        assert_eq!(bits(&normals.0), bits(&normals.1));
    }
}

fn bits(tensor: &Tensor) -> Vec<u32> {
    tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap().into_iter().map(f32::to_bits).collect()
}

fn settings(form: &FieldConfig) -> RenderSettings {
    let sampling = match form.background {
        Background::Field => Sampling::closed(6),
        Background::FarPlane => Sampling::behind_the_surface(6),
    };
    RenderSettings { resolution: 8, sampling, features: true, normals: true, ..RenderSettings::default() }
}

fn frame(field: &Field, codes: &Tensor, settings: &RenderSettings) -> Frame {
    let cameras = vec![Camera::at(0.3, 0.1); codes.dim(0).unwrap()];
    let cameras = Camera::parameter_tensor(&cameras, &Device::Cpu).unwrap().to_dtype(codes.dtype()).unwrap();
    render_frame(&field.portraits(codes).unwrap(), &cameras, settings).unwrap()
}

#[test]
fn features_after_the_sum_equal_the_sum_of_features() {
    let form = config(FieldConfig::paper());
    let parameters = Parameters::fresh(4, DType::F64, &Device::Cpu);
    let field = Field::new(&form, &parameters).unwrap().portraits(&codes(1, 1, DType::F64)).unwrap();
    let (points, view) = (points(1, 6, DType::F64), Tensor::new(&[0.6, 0.0, 0.8], &Device::Cpu).unwrap());
    let view = view.broadcast_as((1, 6, 3)).unwrap().contiguous().unwrap();
    let evaluation = field.evaluate(&points, Some(&view), ALL).unwrap();
    let activations = evaluation.activations.unwrap().tensor().unwrap();
    let ones = Tensor::ones((1, 9, 6), DType::F64, &Device::Cpu).unwrap();
    // One ray of weight 1 per point, then the folded colour head must agree with the head on the features.
    for region in 0..9 {
        let mask = (0..9).map(|row| if row == region { 1.0 } else { 0.0 }).collect::<Vec<f64>>();
        let mask = Tensor::from_vec(mask, (1, 9, 1), &Device::Cpu).unwrap().broadcast_mul(&ones).unwrap();
        let alone = activations.broadcast_mul(&mask.unsqueeze(2).unwrap()).unwrap();
        let feature = field.features(&alone, &mask, Some(&view)).unwrap();
        let head = |name: &str, shape: &[usize]| {
            parameters.get(name, shape, Init::Constant(0.0)).unwrap().narrow(0, region, 1).unwrap()
        };
        let (weight, bias) = (head("colour.weight", &[9, 3, 8]), head("colour.bias", &[9, 3]));
        let expected = weight.matmul(&feature).unwrap().broadcast_add(&bias.unsqueeze(2).unwrap()).unwrap();
        let folded = evaluation.colours.as_ref().unwrap().narrow(1, region, 1).unwrap().squeeze(1).unwrap();
        assert!(difference(&folded, &expected) < 1e-13);
    }
}

#[test]
fn regions_that_are_not_shown_give_no_colour_and_move_nothing() {
    for form in [config(FieldConfig::ours()), config(FieldConfig::paper())] {
        let field = Field::new(&form, &Parameters::fresh(4, DType::F32, &Device::Cpu)).unwrap();
        let codes = codes(1, 1, DType::F32);
        let whole = frame(&field, &codes, &settings(&form));
        let shown = RegionSet::from(Region::Hair).with(Region::Background);
        let part = frame(&field, &codes, &RenderSettings { regions: shown, ..settings(&form) });
        assert_eq!(bits(&whole.depth), bits(&part.depth));
        for region in Region::ALL {
            let row = |frame: &Frame| frame.masks.narrow(1, region.index(), 1).unwrap();
            let expected = if shown.contains(region) { row(&whole) } else { row(&whole).zeros_like().unwrap() };
            assert_eq!(bits(&row(&part)), bits(&expected), "{region}");
        }
        assert!(difference(&whole.colour, &part.colour) > 1e-4);
        let nothing = frame(&field, &codes, &RenderSettings { regions: RegionSet::EMPTY, ..settings(&form) });
        assert!(largest(&nothing.colour) < 1e-6, "mid-grey");
        assert_eq!(largest(&nothing.features.unwrap()), 0.0);
    }
}

#[test]
fn chunks_do_not_show_and_two_passes_come_close() {
    let form = config(FieldConfig::ours());
    let field = Field::new(&form, &Parameters::fresh(4, DType::F64, &Device::Cpu)).unwrap();
    let codes = codes(2, 1, DType::F64);
    // 64 samples x 2 portraits x 256 rays make several chunks; a differentiable frame is one.
    let settings = RenderSettings { resolution: 16, sampling: Sampling::behind_the_surface(64), ..settings(&form) };
    let chunked = frame(&field, &codes, &settings);
    let whole = frame(&field, &codes, &RenderSettings { differentiable: true, ..settings.clone() });
    assert!(difference(&chunked.colour, &whole.colour) < 1e-13);
    assert!(difference(chunked.features.as_ref().unwrap(), whole.features.as_ref().unwrap()) < 1e-13);
    let two_pass = RenderSettings {
        sampling: Sampling::behind_the_surface(16),
        two_pass: Some(TwoPass { bins: 96, refinements: 4, colour_samples: 24 }),
        ..settings
    };
    let fast = frame(&field, &codes, &two_pass);
    assert!(difference(&fast.depth, &whole.depth) < 2e-3, "{}", difference(&fast.depth, &whole.depth));
    assert!(difference(&fast.colour, &whole.colour) < 2e-2, "{}", difference(&fast.colour, &whole.colour));
    assert!(difference(&fast.masks, &whole.masks) < 2e-2, "{}", difference(&fast.masks, &whole.masks));
}

#[test]
fn the_origin_and_far_away_stay_finite() {
    for form in forms() {
        let field = portraits(&form, DType::F32);
        let points = Tensor::new(&[[[0f32; 3], [1e3, -1e3, 1e3]]], &Device::Cpu).unwrap();
        let points = points.broadcast_as((2, 2, 3)).unwrap().contiguous().unwrap();
        let points = candle_core::Var::from_tensor(&points).unwrap();
        let evaluation = field.evaluate(&points, None, ALL).unwrap();
        let density = field.density(&evaluation.distance).unwrap();
        let sum = [&density, &evaluation.distance, evaluation.gradient.as_ref().unwrap()]
            .iter()
            .map(|tensor| tensor.sum_all().unwrap())
            .reduce(|left, right| (left + right).unwrap())
            .unwrap();
        assert!(sum.to_scalar::<f32>().unwrap().is_finite(), "{form:?}");
        let gradients = sum.backward().unwrap();
        assert!(largest(gradients.get(&points).unwrap()).is_finite(), "{form:?}");
    }
}

#[test]
fn masks_are_shares_with_softmax() {
    let field = portraits(&config(FieldConfig::ours()), DType::F64);
    let masks = field.evaluate(&points(2, 50, DType::F64), None, Outputs::default()).unwrap().masks;
    assert_eq!(masks.dims(), [2, 8, 50]);
    let sums = masks.sum(1).unwrap();
    assert!(difference(&sums, &sums.ones_like().unwrap()) < 1e-14);
}

/// A loss of everything a picture has, differentiated to cameras, codes, points' weights and α.
#[test]
fn gradients_of_pictures_match_finite_differences() {
    for form in [config(FieldConfig::ours()), config(FieldConfig::paper())] {
        let parameters = Parameters::fresh(4, DType::F64, &Device::Cpu);
        let field = Field::new(&form, &parameters).unwrap();
        let settings = RenderSettings { resolution: 3, differentiable: true, ..settings(&form) };
        let camera = [[0.2, -0.1, 0.05, 0.02, -0.03, 0.1]];
        let loss = |camera: &Tensor, codes: &Tensor| {
            let frame = render_frame(&field.portraits(codes).unwrap(), camera, &settings).unwrap();
            let parts = [frame.colour, frame.features.unwrap(), frame.masks, frame.depth, frame.normal.unwrap()];
            let terms = parts.iter().map(|part| part.flatten_all()?.sin()?.sum_all());
            terms.reduce(|sum, term| sum? + term?).unwrap().unwrap()
        };
        let camera = candle_core::Var::new(&camera, &Device::Cpu).unwrap();
        let codes = candle_core::Var::from_tensor(&codes(1, 1, DType::F64)).unwrap();
        let gradients = loss(&camera, &codes).backward().unwrap();
        let mut inputs = parameters.variables();
        inputs.extend([("camera".to_owned(), camera.clone()), ("codes".to_owned(), codes.clone())]);
        for (name, variable) in inputs {
            let gradient = gradients.get(&variable).unwrap_or_else(|| panic!("nothing reaches {name}"));
            let gradient: Vec<f64> = gradient.flatten_all().unwrap().to_vec1().unwrap();
            let values: Vec<f64> = variable.flatten_all().unwrap().to_vec1().unwrap();
            // Two values of each tensor: the largest gradient and one drawn at random.
            let largest = (0..values.len()).max_by(|a, b| gradient[*a].abs().total_cmp(&gradient[*b].abs())).unwrap();
            for index in [largest, Stream::new(5, &[]).below(values.len())] {
                let step = 1e-6;
                let moved = |step: f64| {
                    let mut values = values.clone();
                    values[index] += step;
                    variable.set(&Tensor::from_vec(values, variable.shape(), &Device::Cpu).unwrap()).unwrap();
                    loss(&camera, &codes).to_scalar::<f64>().unwrap()
                };
                let expected = (moved(step) - moved(-step)) / (2.0 * step);
                moved(0.0);
                let error = (gradient[index] - expected).abs();
                assert!(error < 1e-6 + 1e-5 * expected.abs(), "{name}[{index}]: {} {expected}", gradient[index]);
            }
        }
    }
}

#[test]
fn a_single_network_has_one_distance_one_colour_and_the_faces_codes() {
    let ours = config(FieldConfig { composition: Composition::Single, ..FieldConfig::ours() });
    let parameters = Parameters::fresh(4, DType::F64, &Device::Cpu);
    let field = Field::new(&ours, &parameters).unwrap();
    let (first, points) = (codes(1, 1, DType::F64), points(1, 7, DType::F64));
    let evaluate = |codes: &Tensor| field.portraits(codes).unwrap().evaluate(&points, None, ALL).unwrap();
    let whole = evaluate(&first);
    // Between regions only masks differ, so fusing changes nothing.
    let region = |tensor: &Tensor, region: usize| tensor.narrow(1, region, 1).unwrap().contiguous().unwrap();
    let colours = whole.colours.as_ref().unwrap();
    assert_eq!(difference(&region(&whole.residuals, 0), &region(&whole.residuals, 6)), 0.0);
    assert_eq!(difference(&region(colours, 0), &region(colours, 6)), 0.0);
    assert!(difference(&region(&whole.masks, 0), &region(&whole.masks, 6)) > 1e-6);
    let sphere = (norm(&points).unwrap() - 0.06).unwrap();
    let distance = (region(&whole.residuals, 0).squeeze(1).unwrap() + sphere).unwrap();
    assert!(difference(&whole.distance, &distance) < 1e-12);
    let swapped = |region: Region| {
        let other = codes(1, 2, DType::F64);
        difference(
            &evaluate(&blend(&first, &other, region.into(), Aspect::Shape, 1.0).unwrap()).distance,
            &whole.distance,
        )
    };
    assert_eq!(swapped(Region::Hair), 0.0);
    assert!(swapped(Region::Face) > 0.0);
    // One set of weights learns from all regions.
    let loss = (whole.distance.sqr().unwrap().sum_all().unwrap() + colours.sqr().unwrap().sum_all().unwrap()).unwrap();
    let gradients = loss.backward().unwrap();
    let variable = |name: &str| parameters.variables().into_iter().find(|(known, _)| known == name).unwrap().1;
    for name in ["weight1", "film.weight", "residual.weight", "feature.weight", "colour.weight"] {
        assert_eq!(variable(name).dim(0).unwrap(), 1, "{name}");
        assert!(gradients.get(&variable(name)).is_some_and(|gradient| largest(gradient) > 0.0), "{name}");
    }
    let sum = FieldConfig { residual: Residual::Sum, ..ours };
    assert!(Field::new(&sum, &Parameters::fresh(4, DType::F64, &Device::Cpu)).is_err());
}
