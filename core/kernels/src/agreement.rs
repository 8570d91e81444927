//! Tests: every kernel, and the candle composition, against the plain reference in f64.

use candle_core::{DType, Device, Tensor, Var};

use super::{
    Evaluation, Extent, Gradients, HeadShape, Outputs, RegionKernel, autograd, composed, fused, kernels, plain::Plain,
};
use crate::{FILM_LAYERS, SdfHead, random::Stream};

const ALL: Outputs = Outputs { gradient: true, colour: true, activations: true };

/// An evaluation's numbers and an upstream gradient, in f64 but exactly representable in f32.
struct Case {
    shape: HeadShape,
    outputs: Outputs,
    extent: Extent,
    points: Vec<f64>,
    weights: Vec<f64>,
    film: Vec<f64>,
    upstream: Vec<f64>,
}

/// A result and its gradients.
struct Answer {
    result: Vec<f64>,
    points: Vec<f64>,
    weights: Vec<f64>,
    film: Vec<f64>,
}

/// f32 or f64, to and from f64.
trait Number: Copy {
    fn from_f64(value: f64) -> Self;
    fn to_f64(self) -> f64;
}

impl Number for f64 {
    fn from_f64(value: f64) -> Self {
        value
    }
    fn to_f64(self) -> f64 {
        self
    }
}

impl Number for f32 {
    fn from_f64(value: f64) -> Self {
        value as f32
    }
    fn to_f64(self) -> f64 {
        f64::from(self)
    }
}

impl Case {
    /// Random numbers of the sizes that training meets: angles of a few radians, heads of order one.
    fn new(shape: HeadShape, outputs: Outputs, extent: Extent, seed: u64) -> Self {
        let mut stream = Stream::new(seed, &[]);
        let mut draw = |count: usize, mean: f32, deviation: f32| -> Vec<f64> {
            (0..count).map(|_| f64::from(mean + deviation * stream.normal())).collect()
        };
        let Extent { images, regions, points } = extent;
        let rows = shape.rows(outputs).count;
        Self {
            shape,
            outputs,
            extent,
            points: draw(images * points * shape.point_columns(), 0.0, 0.7),
            weights: draw(regions * shape.parameter_count(), 0.0, 0.7 / (shape.width as f32).sqrt()),
            film: draw(images * regions * FILM_LAYERS * 2 * shape.width, 1.5, 0.7),
            upstream: draw(images * regions * rows * points, 0.0, 1.0),
        }
    }

    fn answer<T: Number>(&self, kernel: &dyn RegionKernel<T>) -> Answer {
        let cast = |values: &[f64]| values.iter().map(|value| T::from_f64(*value)).collect::<Vec<T>>();
        let uncast = |values: &[T]| values.iter().map(|value| value.to_f64()).collect::<Vec<f64>>();
        let (points, weights, film) = (cast(&self.points), cast(&self.weights), cast(&self.film));
        let evaluation = Evaluation::new(self.shape, self.outputs, self.extent, &points, &weights, &film).unwrap();
        // Whatever was there must be overwritten.
        let stale = |len: usize| vec![T::from_f64(7.0); len];
        let mut result = stale(evaluation.result_len());
        kernel.forward(&evaluation, &mut result).unwrap();
        let (mut to_points, mut to_weights, mut to_film) =
            (stale(points.len()), stale(weights.len()), stale(film.len()));
        let gradients = Gradients { points: Some(&mut to_points), weights: &mut to_weights, film: &mut to_film };
        kernel.backward(&evaluation, &cast(&self.upstream), gradients).unwrap();
        Answer {
            result: uncast(&result),
            points: uncast(&to_points),
            weights: uncast(&to_weights),
            film: uncast(&to_film),
        }
    }

    fn tensors(&self, dtype: DType) -> [Tensor; 4] {
        let Extent { images, regions, points } = self.extent;
        let tensor = |values: &[f64], dims: &[usize]| {
            Tensor::from_slice(values, dims, &Device::Cpu).unwrap().to_dtype(dtype).unwrap()
        };
        [
            tensor(&self.points, &[images, points, self.shape.point_columns()]),
            tensor(&self.weights, &[regions, self.shape.parameter_count()]),
            tensor(&self.film, &[images, regions, FILM_LAYERS, 2, self.shape.width]),
            tensor(&self.upstream, &[images, regions, self.shape.rows(self.outputs).count, points]),
        ]
    }

    /// The answer of a differentiable candle function.
    fn candle_answer(
        &self,
        dtype: DType,
        evaluate: impl Fn(&Tensor, &Tensor, &Tensor) -> crate::Result<Tensor>,
    ) -> Answer {
        let [points, weights, film, upstream] = self.tensors(dtype);
        let [points, weights, film] = [points, weights, film].map(|tensor| Var::from_tensor(&tensor).unwrap());
        let result = evaluate(&points, &weights, &film).unwrap();
        let gradients = (&result * upstream).unwrap().sum_all().unwrap().backward().unwrap();
        let values =
            |tensor: &Tensor| tensor.flatten_all().unwrap().to_dtype(DType::F64).unwrap().to_vec1::<f64>().unwrap();
        let gradient = |variable: &Var| values(gradients.get(variable).unwrap());
        Answer {
            result: values(&result),
            points: gradient(&points),
            weights: gradient(&weights),
            film: gradient(&film),
        }
    }
}

fn relative_error(found: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|value| value * value).sum::<f64>().sqrt();
    let error = norm(&mut found.iter().zip(expected).map(|(found, expected)| found - expected));
    error / (norm(&mut expected.iter().copied()) + 1e-30)
}

impl Answer {
    fn assert_close(&self, expected: &Self, values: f64, gradients: f64, what: &str) {
        let pairs = [
            ("result", &self.result, &expected.result, values),
            ("points", &self.points, &expected.points, gradients),
            ("weights", &self.weights, &expected.weights, gradients),
            ("film", &self.film, &expected.film, gradients),
        ];
        for (name, found, expected, tolerance) in pairs {
            let error = relative_error(found, expected);
            assert!(error <= tolerance, "{what}: {name} is off by {error:.1e} > {tolerance:.1e}");
        }
        let largest = self.result.iter().zip(&expected.result).map(|(a, b)| (a - b).abs() / b.abs().max(1.0));
        let largest = largest.fold(0.0, f64::max);
        assert!(largest <= 10.0 * values, "{what}: a value is off by {largest:.1e}");
    }
}

fn head_shape(width: usize, variant: usize) -> HeadShape {
    HeadShape {
        width,
        sdf_head: if variant & 1 == 0 { SdfHead::Shape } else { SdfHead::Texture },
        mask_view: variant & 2 != 0,
        colour_view: variant & 4 != 0,
    }
}

/// Both heads, with and without views, odd widths, tails of tiles, and every combination of outputs.
fn cases() -> Vec<Case> {
    let mut cases = Vec::new();
    for (index, (width, points)) in
        [5, 16, 48, 130].into_iter().flat_map(|width| [1, 47, 48, 100].map(|points| (width, points))).enumerate()
    {
        let variant = index * 3 + index / 4;
        let extent = if width == 130 {
            Extent { images: 1 + index % 2, regions: 2, points }
        } else {
            Extent { images: 1 + index % 3, regions: 1 + index * 4 % 9, points }
        };
        cases.push(Case::new(head_shape(width, variant), ALL, extent, index as u64));
    }
    // More pieces of work than a backward pass holds partial gradients for at a time.
    cases.push(Case::new(head_shape(130, 0), ALL, Extent { images: 12, regions: 6, points: 1 }, 99));
    for bits in 0..8 {
        let outputs = Outputs { gradient: bits & 1 != 0, colour: bits & 2 != 0, activations: bits & 4 != 0 };
        for variant in 0..8 {
            let extent = Extent { images: 2, regions: 2, points: 50 };
            cases.push(Case::new(head_shape(16, variant), outputs, extent, 100 + 8 * bits + variant as u64));
        }
    }
    cases
}

impl std::fmt::Display for Case {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:?} {:?} {:?}", self.shape, self.outputs, self.extent)
    }
}

#[test]
fn the_candle_composition_agrees_with_the_reference_in_f64() {
    for case in cases() {
        let found = case.candle_answer(DType::F64, |points, weights, film| {
            composed::evaluate(points, weights, film, case.shape, case.outputs)
        });
        found.assert_close(&case.answer::<f64>(&Plain), 1e-12, 1e-10, &case.to_string());
    }
}

#[test]
fn every_kernel_agrees_with_the_reference_in_f64() {
    for case in cases() {
        let expected = case.answer::<f64>(&Plain);
        for kernel in kernels().filter(|kernel| kernel.available()) {
            let found = case.answer(kernel);
            // f32 rounding of angles of a few radians through five layers.
            found.assert_close(&expected, 1e-5, 1e-4, &format!("{} {case}", kernel.name()));
        }
    }
}

#[test]
fn the_candle_operation_agrees_with_the_composition() {
    let extent = Extent { images: 2, regions: 3, points: 70 };
    let case = Case::new(head_shape(24, 6), ALL, extent, 5);
    let expected = case.candle_answer(DType::F64, |points, weights, film| {
        autograd::evaluate(points, weights, film, case.shape, case.outputs)
    });
    for kernel in kernels().filter(|kernel| kernel.available()) {
        let found = case.candle_answer(DType::F32, |points, weights, film| {
            // Views and transposes must be taken as well as fresh tensors.
            let points = points.transpose(1, 2)?.contiguous()?.transpose(1, 2)?;
            autograd::evaluate_with(kernel, &points, weights, film, case.shape, case.outputs)
        });
        found.assert_close(&expected, 1e-5, 1e-4, kernel.name());
    }
}

#[test]
fn results_are_the_same_bits_at_any_thread_count() {
    // Several chunks for each (image, region), with an odd tail.
    let extent = Extent { images: 2, regions: 3, points: 7001 };
    let case = Case::new(head_shape(8, 0), ALL, extent, 9);
    for kernel in kernels().filter(|kernel| kernel.available()) {
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| case.answer(kernel))
        };
        let one = run(1);
        for threads in [2, 5] {
            let many = run(threads);
            let pairs = [
                (&one.result, &many.result),
                (&one.points, &many.points),
                (&one.weights, &many.weights),
                (&one.film, &many.film),
            ];
            for (one, many) in pairs {
                let same = one.iter().zip(many).all(|(one, many)| one.to_bits() == many.to_bits());
                assert!(same, "{} with {threads} threads", kernel.name());
            }
        }
    }
}

/// Regions prepared for lists give, for points in any order and company, the bits that whole evaluations give.
#[test]
fn prepared_regions_give_the_same_bits() {
    for variant in 0..8 {
        let extent = Extent { images: 1, regions: 3, points: 120 };
        let case = Case::new(head_shape(20, variant), ALL, extent, 40 + variant as u64);
        let single = |values: &[f64]| values.iter().map(|value| *value as f32).collect::<Vec<f32>>();
        let (points, weights, film) = (single(&case.points), single(&case.weights), single(&case.film));
        let (columns, parameters) = (case.shape.point_columns(), case.shape.parameter_count());
        let picked: Vec<usize> = (0..extent.points).rev().filter(|index| index % 3 != 1).collect();
        let list: Vec<f32> = picked.iter().flat_map(|index| points[index * columns..][..columns].to_vec()).collect();
        for outputs in [Outputs::default(), Outputs { gradient: false, ..ALL }, ALL] {
            let evaluation = Evaluation::new(case.shape, outputs, extent, &points, &weights, &film).unwrap();
            for kernel in kernels().filter(|kernel| kernel.available()) {
                let mut whole = vec![0f32; evaluation.result_len()];
                kernel.forward(&evaluation, &mut whole).unwrap();
                for region in 0..extent.regions {
                    let (weights, film) = (&weights[region * parameters..][..parameters], film.chunks(10 * 20));
                    let film = film.into_iter().nth(region).unwrap();
                    let prepared = kernel.prepare(case.shape, outputs, weights, film).unwrap();
                    let rows = prepared.rows().count;
                    let mut found = vec![0f32; rows * picked.len()];
                    prepared.forward(&list, &mut found).unwrap();
                    for row in 0..rows {
                        for (place, index) in picked.iter().enumerate() {
                            let expected = whole[(region * rows + row) * extent.points + index];
                            let found = found[place * rows + row];
                            assert_eq!(found.to_bits(), expected.to_bits(), "{} {case} row {row}", kernel.name());
                        }
                    }
                    assert!(prepared.forward(&list[1..], &mut found).is_err() || columns == 1);
                    assert!(kernel.prepare(case.shape, outputs, &weights[1..], film).is_err());
                }
            }
        }
    }
}

#[test]
fn chunked_points_agree_with_the_reference() {
    let extent = Extent { images: 1, regions: 2, points: 5003 };
    let case = Case::new(head_shape(12, 3), ALL, extent, 10);
    let expected = case.answer::<f64>(&Plain);
    for kernel in kernels().filter(|kernel| kernel.available()) {
        case.answer(kernel).assert_close(&expected, 1e-5, 1e-4, kernel.name());
    }
}

/// Angles up to a million, far beyond the fast polynomial: layer 1 is β alone, an exact f32, and deeper layers tame.
#[test]
fn huge_angles_stay_right() {
    for largest in [9_000.0, 20_000.0, 1e6] {
        let extent = Extent { images: 1, regions: 1, points: 3 };
        let mut case = Case::new(head_shape(48, 0), ALL, extent, 12);
        let layout = case.shape.layout();
        case.weights[layout.layers[0].weight.start..layout.layers[0].bias.end].fill(0.0);
        for unit in 0..48 {
            case.film[48 + unit] = f64::from((largest * (unit as f32 - 24.0)) / 24.0);
        }
        let expected = case.answer::<f64>(&Plain);
        for kernel in kernels().filter(|kernel| kernel.available()) {
            case.answer(kernel).assert_close(&expected, 1e-5, 1e-4, &format!("{} {largest}", kernel.name()));
        }
    }
}

#[test]
fn huge_angles_in_deep_layers_and_nan_are_not_hidden() {
    let extent = Extent { images: 1, regions: 1, points: 3 };
    for kernel in kernels().filter(|kernel| kernel.available()) {
        let mut case = Case::new(head_shape(16, 0), ALL, extent, 13);
        // β of layer 2, so far out that a polynomial would explode: sines must stay within [-1, 1].
        case.film[3 * 16] = 1e30;
        let activations = case.shape.rows(ALL).activations.unwrap();
        let answer = case.answer(kernel);
        assert!(answer.result.iter().all(|value| value.is_finite()), "{}", kernel.name());
        assert!(answer.result[activations.start * 3..].iter().all(|value| value.abs() <= 1.000_001));
        for poison in [f64::NAN, f64::INFINITY] {
            case.film[3 * 16] = poison;
            assert!(case.answer(kernel).result[0].is_nan(), "{} hides {poison}", kernel.name());
        }
    }
}

#[test]
fn slices_of_another_length_are_refused() {
    let case = Case::new(head_shape(4, 0), ALL, Extent { images: 1, regions: 1, points: 2 }, 1);
    let single = |values: &[f64]| values.iter().map(|value| *value as f32).collect::<Vec<f32>>();
    let (points, weights, film) = (single(&case.points), single(&case.weights), single(&case.film));
    assert!(Evaluation::new(case.shape, ALL, case.extent, &points[1..], &weights, &film).is_err());
    let evaluation = Evaluation::new(case.shape, ALL, case.extent, &points, &weights, &film).unwrap();
    assert!(fused::PORTABLE.forward(&evaluation, &mut [0.0; 3]).is_err());
}
