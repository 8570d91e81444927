//! Every path against the f64 loops of the definition, and the differentiable operations against finite differences.

use candle_core::{DType, Device, Tensor, Var};

use super::*;
use crate::random::Stream;

/// Kernel size, stride and padding of every kind of convolution in the networks, and a few in none.
const KINDS: [[usize; 3]; 11] = [
    [3, 1, 1],
    [1, 1, 0],
    [3, 2, 1],
    [3, 2, 0],
    [4, 2, 1],
    [1, 2, 0],
    [5, 1, 2],
    [5, 1, 0],
    [2, 3, 1],
    [11, 4, 2],
    [1, 1, 1],
];
const CHANNELS: [usize; 7] = [1, 3, 5, 16, 44, 64, 100];
const SIZES: [usize; 6] = [1, 2, 7, 8, 16, 33];

fn draw<T>(stream: &mut Stream, from: &[T]) -> T
where
    T: Copy,
{
    *stream.pick(from).unwrap()
}

/// Convolutions of every kind, with sizes drawn until `per_kind` of them exist and are small enough for plain loops.
fn geometries(seed: u64, per_kind: usize) -> Vec<Geometry> {
    let mut stream = Stream::new(seed, &[]);
    let mut found = Vec::new();
    for [kernel, stride, padding] in KINDS {
        let mut left = per_kind;
        while left > 0 {
            let input = [
                1 + stream.below(3),
                draw(&mut stream, &CHANNELS),
                draw(&mut stream, &SIZES),
                draw(&mut stream, &SIZES),
            ];
            let weight = [draw(&mut stream, &CHANNELS), input[1], kernel, kernel];
            let Ok(geometry) = Geometry::new(&input, &weight, stride, padding) else { continue };
            if geometry.batch * geometry.output_size() * geometry.input_channels * geometry.taps() < 8_000_000 {
                found.push(geometry);
                left -= 1;
            }
        }
    }
    found
}

fn normal(stream: &mut Stream, shape: &[usize]) -> Vec<f32> {
    (0..shape.iter().product()).map(|_| stream.normal()).collect()
}

fn double(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&value| f64::from(value)).collect()
}

fn relative_error(found: &[f32], expected: &[f64]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let squares = |values: &mut dyn Iterator<Item = f64>| values.map(|value| value * value).sum::<f64>();
    let error = squares(&mut found.iter().zip(expected).map(|(&found, expected)| f64::from(found) - expected));
    (error / squares(&mut expected.iter().copied()).max(f64::MIN_POSITIVE)).sqrt()
}

fn paths() -> impl Iterator<Item = Path> {
    let sets = [InstructionSet::Portable, InstructionSet::Neon, InstructionSet::Avx2, InstructionSet::Avx512];
    let direct = sets.into_iter().filter(|set| set.available()).map(Path::Direct);
    std::iter::once(Path::Plain).chain(direct)
}

#[test]
fn every_path_computes_the_three_maps() {
    for geometry in geometries(1, 12) {
        let mut stream = Stream::new(2, &[geometry.input_size() as u64]);
        let input = normal(&mut stream, &geometry.input_shape());
        let weight = normal(&mut stream, &geometry.weight_shape());
        let bias = normal(&mut stream, &[geometry.output_channels]);
        let grad_output = normal(&mut stream, &geometry.output_shape());

        let mut output = plain::forward(&geometry, &double(&input), &double(&weight));
        let positions = geometry.output_height * geometry.output_width;
        for (index, value) in output.iter_mut().enumerate() {
            *value += f64::from(bias[index / positions % geometry.output_channels]);
        }
        let input_gradient = plain::input_gradient(&geometry, &double(&grad_output), &double(&weight));
        let weight_gradient = plain::weight_gradient(&geometry, &double(&input), &double(&grad_output));
        let mut bias_gradient = vec![0f64; geometry.output_channels];
        for (index, value) in grad_output.iter().enumerate() {
            bias_gradient[index / positions % geometry.output_channels] += f64::from(*value);
        }

        // The sums have at most a few thousand terms; f32 keeps them to well under 1e-5 of their norm.
        for path in paths() {
            let errors = [
                relative_error(&path.forward(&geometry, &input, &weight, Some(&bias)), &output),
                relative_error(&path.input_gradient(&geometry, &grad_output, &weight), &input_gradient),
                relative_error(&path.weight_gradient(&geometry, &input, &grad_output), &weight_gradient),
                relative_error(
                    &activation::channel_sums(&grad_output, geometry.batch, geometry.output_channels),
                    &bias_gradient,
                ),
            ];
            assert!(errors.iter().all(|&error| error <= 1e-5), "{path:?} {geometry:?}: {errors:?}");
        }
    }
}

#[test]
fn the_same_bits_on_one_thread_and_on_more() {
    let pool = |threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let (one, others) = (pool(1), [pool(2), pool(5)]);
    for geometry in geometries(3, 4) {
        let mut stream = Stream::new(4, &[]);
        let input = normal(&mut stream, &geometry.input_shape());
        let weight = normal(&mut stream, &geometry.weight_shape());
        let grad_output = normal(&mut stream, &geometry.output_shape());
        let bits = |values: Vec<f32>| values.into_iter().map(f32::to_bits).collect::<Vec<_>>();
        for path in paths().skip(1) {
            let all = || {
                [
                    bits(path.forward(&geometry, &input, &weight, None)),
                    bits(path.input_gradient(&geometry, &grad_output, &weight)),
                    bits(path.weight_gradient(&geometry, &input, &grad_output)),
                    bits(activation::channel_sums(&grad_output, geometry.batch, geometry.output_channels)),
                ]
            };
            let expected = one.install(all);
            for other in &others {
                assert!(other.install(all) == expected, "{path:?} {geometry:?}");
            }
        }
    }
}

/// Small convolutions for tests in which candle does the same in f64.
fn small() -> impl Iterator<Item = Geometry> {
    KINDS.into_iter().filter_map(|[kernel, stride, padding]| {
        let size = if kernel > 5 { [13, 14] } else { [6, 7] };
        Geometry::new(&[2, 3, size[0], size[1]], &[4, 3, kernel, kernel], stride, padding).ok()
    })
}

fn tensor(stream: &mut Stream, shape: [usize; 4], dtype: DType) -> Tensor {
    stream.normal_tensor(&shape, &Device::Cpu).unwrap().to_dtype(dtype).unwrap()
}

fn number(tensor: &Tensor) -> f64 {
    tensor.to_dtype(DType::F64).unwrap().to_scalar().unwrap()
}

/// The three maps by number, on whatever type the tensors have: (x, w), (dy, w), (x, dy).
fn map(which: usize, geometry: &Geometry, a: &Tensor, b: &Tensor) -> Tensor {
    let (stride, padding) = (geometry.stride, geometry.padding);
    match which {
        0 => conv2d(a, b, None, stride, padding),
        1 => conv2d_input_gradient(a, b, (geometry.input_height, geometry.input_width), stride, padding),
        _ => conv2d_weight_gradient(a, b, (geometry.kernel_height, geometry.kernel_width), stride, padding),
    }
    .unwrap()
}

fn arguments(which: usize, geometry: &Geometry) -> [[usize; 4]; 2] {
    match which {
        0 => [geometry.input_shape(), geometry.weight_shape()],
        1 => [geometry.output_shape(), geometry.weight_shape()],
        _ => [geometry.input_shape(), geometry.output_shape()],
    }
}

/// Some function of the map that is not linear, so that its gradient depends on everything.
fn loss(which: usize, geometry: &Geometry, a: &Tensor, b: &Tensor) -> Tensor {
    let value = map(which, geometry, a, b);
    ((&value * &value).unwrap() * &value).unwrap().sum_all().unwrap()
}

fn gradients(which: usize, geometry: &Geometry, a: &Tensor, b: &Tensor) -> [Tensor; 2] {
    let (a, b) = (Var::from_tensor(a).unwrap(), Var::from_tensor(b).unwrap());
    let gradients = loss(which, geometry, &a, &b).backward().unwrap();
    [a, b].map(|variable| gradients.get(&variable).unwrap().clone())
}

#[test]
fn gradients_of_all_maps_agree_with_finite_differences() {
    for geometry in small() {
        for which in 0..3 {
            let mut stream = Stream::new(5, &[which as u64]);
            let [a, b] = arguments(which, &geometry).map(|shape| tensor(&mut stream, shape, DType::F64));
            let [u, v] = arguments(which, &geometry).map(|shape| tensor(&mut stream, shape, DType::F64));
            let found = gradients(which, &geometry, &a, &b);
            for (direction, (u, v)) in
                [(&u, &v.zeros_like().unwrap()), (&u.zeros_like().unwrap(), &v)].iter().enumerate()
            {
                let at = |step: f64| {
                    let a = (&a + (*u * step).unwrap()).unwrap();
                    let b = (&b + (*v * step).unwrap()).unwrap();
                    number(&loss(which, &geometry, &a, &b))
                };
                // A cubic along the line: the central difference is off by step², rounding by 1e-16 / step.
                let step = 1e-5;
                let expected = (at(step) - at(-step)) / (2.0 * step);
                let along = [u, v][direction];
                let found = number(&(&found[direction] * *along).unwrap().sum_all().unwrap());
                let error = (found - expected).abs() / expected.abs().max(1.0);
                assert!(error < 1e-6, "map {which}, argument {direction}, {geometry:?}: {found} for {expected}");
            }
        }
    }
}

#[test]
fn gradients_in_f32_agree_with_those_in_f64() {
    for geometry in small() {
        for which in 0..3 {
            let mut stream = Stream::new(6, &[which as u64]);
            let [a, b] = arguments(which, &geometry).map(|shape| tensor(&mut stream, shape, DType::F64));
            let expected = gradients(which, &geometry, &a, &b);
            let [a, b] = [a, b].map(|tensor| tensor.to_dtype(DType::F32).unwrap());
            for (found, expected) in gradients(which, &geometry, &a, &b).iter().zip(&expected) {
                let found = found.flatten_all().unwrap().to_vec1::<f32>().unwrap();
                let expected = expected.flatten_all().unwrap().to_vec1::<f64>().unwrap();
                let error = relative_error(&found, &expected);
                // The arguments themselves were rounded to f32, and the loss cubes the map.
                assert!(error < 1e-4, "map {which}, {geometry:?}: {error}");
            }
        }
    }
}

#[test]
fn a_bias_is_added_and_learnt() {
    let mut stream = Stream::new(7, &[]);
    let input = tensor(&mut stream, [2, 3, 9, 8], DType::F32);
    let weight = tensor(&mut stream, [5, 3, 3, 3], DType::F32);
    let bias = Var::from_tensor(&stream.normal_tensor(&[5], &Device::Cpu).unwrap()).unwrap();
    let with = conv2d(&input, &weight, Some(&bias), 2, 1).unwrap();
    let without = conv2d(&input, &weight, None, 2, 1).unwrap();
    let expected = without.broadcast_add(&bias.reshape((1, 5, 1, 1)).unwrap()).unwrap();
    let difference = number(&(&with - &expected).unwrap().abs().unwrap().max_all().unwrap());
    assert!(difference < 1e-5, "{difference}");

    let found = with.sqr().unwrap().sum_all().unwrap().backward().unwrap();
    let expected = expected.sqr().unwrap().sum_all().unwrap().backward().unwrap();
    let (found_bias, expected) = (found.get(&bias).unwrap(), expected.get(&bias).unwrap());
    let error = (found_bias - expected).unwrap().abs().unwrap().max_all().unwrap();
    assert!(number(&error) < 1e-5 * number(&expected.abs().unwrap().max_all().unwrap()));
    assert!(found.get(&weight).is_none() && found.get(&input).is_none(), "constants have no gradients");
}

#[test]
fn a_transposed_convolution_is_candles() {
    let mut stream = Stream::new(8, &[]);
    for [kernel, stride, padding, output_padding] in
        [[3, 2, 0, 0], [3, 2, 1, 1], [4, 2, 1, 0], [3, 1, 1, 0], [2, 3, 0, 2]]
    {
        let input = tensor(&mut stream, [2, 6, 5, 4], DType::F64);
        let weight = tensor(&mut stream, [6, 7, kernel, kernel], DType::F64);
        let expected = input.conv_transpose2d(&weight, padding, output_padding, stride, 1).unwrap();
        for dtype in [DType::F32, DType::F64] {
            let (input, weight) = (input.to_dtype(dtype).unwrap(), weight.to_dtype(dtype).unwrap());
            let found = conv_transpose2d(&input, &weight, stride, padding, output_padding).unwrap();
            assert_eq!(found.dims(), expected.dims());
            let difference = (found.to_dtype(DType::F64).unwrap() - &expected).unwrap();
            assert!(number(&difference.abs().unwrap().max_all().unwrap()) < 2e-5);
        }
    }
}

#[test]
fn strided_views_and_repeated_gradients_are_understood() {
    let mut stream = Stream::new(9, &[]);
    let input = tensor(&mut stream, [8, 9, 2, 3], DType::F32);
    let view = input.permute((2, 3, 0, 1)).unwrap();
    let weight = Var::from_tensor(&tensor(&mut stream, [5, 3, 3, 3], DType::F32)).unwrap();
    // The gradient of a plain sum arrives as a broadcast scalar.
    let gradients = conv2d(&view, &weight, None, 1, 1).unwrap().sum_all().unwrap().backward().unwrap();
    let expected = view.conv2d(&weight, 1, 1, 1, 1).unwrap().sum_all().unwrap().backward().unwrap();
    let difference = (gradients.get(&weight).unwrap() - expected.get(&weight).unwrap()).unwrap();
    assert!(number(&difference.abs().unwrap().max_all().unwrap()) < 1e-4);
}

#[test]
fn what_does_not_fit_is_refused() {
    let zeros = |shape: &[usize]| Tensor::zeros(shape, DType::F32, &Device::Cpu).unwrap();
    let (input, weight) = (zeros(&[1, 3, 4, 4]), zeros(&[2, 3, 3, 3]));
    assert!(conv2d(&input, &zeros(&[2, 4, 3, 3]), None, 1, 1).is_err());
    assert!(conv2d(&input, &zeros(&[2, 3, 5, 5]), None, 1, 0).is_err());
    assert!(conv2d(&input, &weight, None, 0, 1).is_err());
    assert!(conv2d(&input, &weight, Some(&zeros(&[3])), 1, 1).is_err());
    assert!(conv2d(&zeros(&[3, 4, 4]), &weight, None, 1, 1).is_err());
    assert!(conv2d_input_gradient(&zeros(&[1, 2, 4, 4]), &weight, (4, 5), 1, 1).is_err());
    assert!(conv2d_weight_gradient(&input, &zeros(&[1, 2, 4, 4]), (2, 2), 1, 1).is_err());
    assert!(conv_transpose2d(&zeros(&[1, 2, 4, 4]), &weight, 2, 0, 2).is_err());
    assert!(conv_transpose2d(&zeros(&[1, 2, 1, 1]), &weight, 2, 2, 0).is_err());
}

#[test]
fn leaky_relu_has_its_bias_and_gradients() {
    let mut stream = Stream::new(10, &[]);
    for (shape, biased) in [(&[3usize, 5, 7, 6][..], true), (&[2, 4, 3, 3], false), (&[6, 5], true)] {
        let run = |input: &Tensor, bias: &Tensor, cotangent: &Tensor| {
            let (input, bias) = (Var::from_tensor(input).unwrap(), Var::from_tensor(bias).unwrap());
            let output = bias_leaky_relu(&input, biased.then_some(bias.as_tensor()), 0.2, 2f64.sqrt()).unwrap();
            let gradients = (&output * cotangent).unwrap().sum_all().unwrap().backward().unwrap();
            let mut all = vec![output.clone(), gradients.get(&input).unwrap().clone()];
            all.extend(gradients.get(&bias).cloned());

            let gradient = Var::from_tensor(cotangent).unwrap();
            let slopes = leaky_relu_gradient(&output, &gradient, 0.2, 2f64.sqrt()).unwrap();
            all.push(slopes.sqr().unwrap().sum_all().unwrap().backward().unwrap().get(&gradient).unwrap().clone());
            all.push(slopes);
            all
        };
        let normal = |stream: &mut Stream, shape: &[usize]| stream.normal_tensor(shape, &Device::Cpu).unwrap();
        let arguments = [normal(&mut stream, shape), normal(&mut stream, &shape[1..2]), normal(&mut stream, shape)];
        let [input, bias, cotangent] = &arguments;
        let [wide_input, wide_bias, wide_cotangent] = arguments.each_ref().map(|a| a.to_dtype(DType::F64).unwrap());
        let found = run(input, bias, cotangent);
        let expected = run(&wide_input, &wide_bias, &wide_cotangent);
        assert_eq!(found.len(), if biased { 5 } else { 4 });
        for (found, expected) in found.iter().zip(&expected) {
            let difference = (found.to_dtype(DType::F64).unwrap() - expected).unwrap();
            assert!(number(&difference.abs().unwrap().max_all().unwrap()) < 1e-5);
        }
        // In f64 it is candle's composition; its input gradient against the definition.
        let sum = if biased {
            let mut wide = vec![1; shape.len()];
            wide[1] = shape[1];
            wide_input.broadcast_add(&wide_bias.reshape(wide).unwrap()).unwrap()
        } else {
            wide_input.clone()
        };
        let values = |tensor: &Tensor| tensor.flatten_all().unwrap().to_vec1::<f64>().unwrap();
        for ((sum, output), (gradient, cotangent)) in values(&sum)
            .into_iter()
            .zip(values(&expected[0]))
            .zip(values(&expected[1]).into_iter().zip(values(&wide_cotangent)))
        {
            let slope = if sum > 0.0 { 1.0 } else { 0.2 } * 2f64.sqrt();
            assert!((output - slope * sum).abs() < 1e-12 && (gradient - slope * cotangent).abs() < 1e-12);
        }
    }
}
