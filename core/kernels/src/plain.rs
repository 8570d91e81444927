//! The reference kernel: one point, one region at a time, loops that can be checked against the formulas by eye.
//! Serial and slow; every other kernel is tested against it in f64.

use std::ops::{Add, AddAssign, Mul, Sub};

use super::{
    Evaluation, Gradients, HeadShape, Layout, Linear, Outputs, PreparedRegion, RegionKernel, Rows, check_length,
    prepared::PlainRegion,
};
use crate::{FILM_LAYERS, Result, SHAPE_LAYERS};

/// A floating-point number: f32 or f64.
pub trait Real:
    Copy + Default + Send + Sync + 'static + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + AddAssign
{
    /// Sine of an angle in radians.
    fn sin(self) -> Self;
    /// Cosine of an angle in radians.
    fn cos(self) -> Self;
}

macro_rules! impl_real {
    ($($float:ty),*) => {$(
        impl Real for $float {
            fn sin(self) -> Self {
                <$float>::sin(self)
            }
            fn cos(self) -> Self {
                <$float>::cos(self)
            }
        }
    )*};
}
impl_real!(f32, f64);

/// The reference kernel.
#[derive(Clone, Copy, Debug)]
pub struct Plain;

impl<T: Real> RegionKernel<T> for Plain {
    fn name(&self) -> &'static str {
        "plain"
    }

    fn available(&self) -> bool {
        true
    }

    fn forward(&self, evaluation: &Evaluation<'_, T>, result: &mut [T]) -> Result<()> {
        check_length("result", &[evaluation.result_len()], result.len())?;
        let rows = evaluation.shape.rows(evaluation.outputs);
        let count = evaluation.extent.points;
        if count == 0 {
            return Ok(());
        }
        for (pair, block) in result.chunks_exact_mut(rows.count * count).enumerate() {
            let generator = LocalGenerator::new(evaluation, pair);
            for (index, point) in evaluation.points_of_pair(pair).enumerate() {
                let values = generator.forward(point, &rows);
                for (row, value) in values.into_iter().enumerate() {
                    block[row * count + index] = value;
                }
            }
        }
        Ok(())
    }

    fn backward(&self, evaluation: &Evaluation<'_, T>, upstream: &[T], mut gradients: Gradients<'_, T>) -> Result<()> {
        check_length("upstream", &[evaluation.result_len()], upstream.len())?;
        gradients.check(evaluation)?;
        gradients.weights.fill(T::default());
        gradients.film.fill(T::default());
        if let Some(points) = &mut gradients.points {
            points.fill(T::default());
        }
        let rows = evaluation.shape.rows(evaluation.outputs);
        let count = evaluation.extent.points;
        if count == 0 {
            return Ok(());
        }
        let columns = evaluation.shape.point_columns();
        let parameters = evaluation.shape.parameter_count();
        for (pair, block) in upstream.chunks_exact(rows.count * count).enumerate() {
            let (image, region) = (pair / evaluation.extent.regions, pair % evaluation.extent.regions);
            let generator = LocalGenerator::new(evaluation, pair);
            let weights = &mut gradients.weights[region * parameters..][..parameters];
            let mut folded = Folded::zeros(evaluation.shape);
            for (index, point) in evaluation.points_of_pair(pair).enumerate() {
                let upstream: Vec<T> = (0..rows.count).map(|row| block[row * count + index]).collect();
                let point_gradient = generator.backward(point, &rows, &upstream, weights, &mut folded);
                if let Some(points) = &mut gradients.points {
                    let start = (image * count + index) * columns;
                    add(&mut points[start..start + columns], &point_gradient);
                }
            }
            let film_len = FILM_LAYERS * 2 * evaluation.shape.width;
            generator.unfold(&folded, weights, &mut gradients.film[pair * film_len..][..film_len]);
        }
        Ok(())
    }

    fn prepare(
        &self,
        shape: HeadShape,
        outputs: Outputs,
        weights: &[T],
        film: &[T],
    ) -> Result<Box<dyn PreparedRegion<T>>> {
        Ok(Box::new(PlainRegion::new(shape, outputs, weights, film)?))
    }
}

impl<'a, T> Evaluation<'a, T> {
    /// The points of the image of the `pair`-th (image, region), each with its view direction if there is one.
    fn points_of_pair(&self, pair: usize) -> std::slice::ChunksExact<'a, T> {
        let columns = self.shape.point_columns();
        let block = self.extent.points * columns;
        self.points[pair / self.extent.regions * block..][..block].chunks_exact(columns)
    }
}

/// The layers with FiLM folded in, A = γ ∘ W and a = γ ∘ b + β; or a gradient with respect to them.
struct Folded<T> {
    matrices: [Vec<T>; FILM_LAYERS],
    offsets: [Vec<T>; FILM_LAYERS],
}

impl<T: Real> Folded<T> {
    fn zeros(shape: HeadShape) -> Self {
        let layers = shape.layout().layers;
        Self {
            matrices: std::array::from_fn(|layer| vec![T::default(); layers[layer].weight.len()]),
            offsets: std::array::from_fn(|layer| vec![T::default(); layers[layer].bias.len()]),
        }
    }
}

/// Activations of one point: h_l = sin z_l and cos z_l, of as many layers as the outputs need.
struct Trace<T> {
    sines: Vec<Vec<T>>,
    cosines: Vec<Vec<T>>,
}

/// One region of one image.
struct LocalGenerator<'a, T> {
    shape: HeadShape,
    layout: Layout,
    depth: usize,
    weights: &'a [T],
    film: &'a [T],
    folded: Folded<T>,
}

impl<'a, T: Real> LocalGenerator<'a, T> {
    fn new(evaluation: &Evaluation<'a, T>, pair: usize) -> Self {
        let shape = evaluation.shape;
        let parameters = shape.parameter_count();
        let film_len = FILM_LAYERS * 2 * shape.width;
        let mut generator = Self {
            shape,
            layout: shape.layout(),
            depth: shape.depth(evaluation.outputs),
            weights: &evaluation.weights[pair % evaluation.extent.regions * parameters..][..parameters],
            film: &evaluation.film[pair * film_len..][..film_len],
            folded: Folded::zeros(shape),
        };
        for (layer, linear) in generator.layout.layers.iter().enumerate() {
            let (gamma, beta) = (generator.gamma(layer), generator.beta(layer));
            let weight = generator.weights[linear.weight.clone()].chunks_exact(linear.inputs);
            let folded = generator.folded.matrices[layer].chunks_exact_mut(linear.inputs);
            for ((row, folded_row), &gamma) in weight.zip(folded).zip(gamma) {
                add_scaled(folded_row, gamma, row);
            }
            let bias = &generator.weights[linear.bias.clone()];
            for (unit, offset) in generator.folded.offsets[layer].iter_mut().enumerate() {
                *offset = gamma[unit] * bias[unit] + beta[unit];
            }
        }
        generator
    }

    fn gamma(&self, layer: usize) -> &'a [T] {
        &self.film[2 * layer * self.shape.width..][..self.shape.width]
    }

    fn beta(&self, layer: usize) -> &'a [T] {
        &self.film[(2 * layer + 1) * self.shape.width..][..self.shape.width]
    }

    fn trace(&self, point: &[T]) -> Trace<T> {
        let mut trace = Trace { sines: Vec::new(), cosines: Vec::new() };
        for layer in 0..self.depth {
            let input = if layer == 0 { &point[..3] } else { &trace.sines[layer - 1] };
            let mut angle = multiply(&self.folded.matrices[layer], input);
            add(&mut angle, &self.folded.offsets[layer]);
            trace.sines.push(angle.iter().map(|angle| angle.sin()).collect());
            trace.cosines.push(angle.iter().map(|angle| angle.cos()).collect());
        }
        trace
    }

    /// The heads in order of their rows: which linear map, the layer it reads, its first row.
    fn heads<'b>(&'b self, rows: &Rows) -> Vec<(&'b Linear, usize, usize)> {
        let mut heads = vec![
            (&self.layout.mask, SHAPE_LAYERS, rows.mask),
            (&self.layout.residual, self.shape.residual_depth(), rows.residual),
        ];
        heads.extend(rows.colour.as_ref().map(|colour| (&self.layout.colour, FILM_LAYERS, colour.start)));
        heads
    }

    /// The heads whose spatial gradients are wanted: the weight's row, the layer it reads, the gradient's first row.
    fn swept_heads<'b>(&'b self, rows: &Rows) -> Vec<(&'b Linear, usize, usize)> {
        let mask = rows.mask_gradient.as_ref().map(|rows| (&self.layout.mask, SHAPE_LAYERS, rows.start));
        let residual = rows.residual_gradient.as_ref();
        let residual = residual.map(|rows| (&self.layout.residual, self.shape.residual_depth(), rows.start));
        mask.into_iter().chain(residual).collect()
    }

    fn forward(&self, point: &[T], rows: &Rows) -> Vec<T> {
        let trace = self.trace(point);
        let mut values = vec![T::default(); rows.count];
        for (linear, depth, first_row) in self.heads(rows) {
            // View columns follow the activations, as the head's weight has them.
            let input: Vec<T> = [&trace.sines[depth - 1], &point[3..]].concat();
            let weight = self.weights[linear.weight.clone()].chunks_exact(linear.inputs);
            for (output, (row, &bias)) in weight.zip(&self.weights[linear.bias.clone()]).enumerate() {
                values[first_row + output] = dot(row, &input[..linear.inputs]) + bias;
            }
        }
        for (linear, depth, first_row) in self.swept_heads(rows) {
            let (_, swept) = self.sweep(linear, depth, &trace);
            values[first_row..first_row + 3].copy_from_slice(&swept[0]);
        }
        if let Some(activations) = &rows.activations {
            values[activations.clone()].copy_from_slice(&trace.sines[FILM_LAYERS - 1]);
        }
        values
    }

    /// The reverse sweep of a head w·h_L: v_L = w, u_l = v_l ∘ cos z_l, v_{l-1} = A_lᵀ u_l. Returns u_1 … u_L and
    /// v_0 … v_L; v_0 is the spatial gradient.
    fn sweep(&self, linear: &Linear, depth: usize, trace: &Trace<T>) -> (Vec<Vec<T>>, Vec<Vec<T>>) {
        let mut before_cosine = vec![self.weights[linear.weight.clone()][..self.shape.width].to_vec()];
        let mut after_cosine = Vec::new();
        for layer in (0..depth).rev() {
            let scaled = product(&before_cosine[before_cosine.len() - 1], &trace.cosines[layer]);
            before_cosine.push(multiply_transposed(&self.folded.matrices[layer], &scaled));
            after_cosine.push(scaled);
        }
        before_cosine.reverse();
        after_cosine.reverse();
        (after_cosine, before_cosine)
    }

    /// Adds one point's share of the gradients; returns the gradient of the point and view direction.
    fn backward(&self, point: &[T], rows: &Rows, upstream: &[T], weights: &mut [T], folded: &mut Folded<T>) -> Vec<T> {
        let width = self.shape.width;
        let trace = self.trace(point);
        let mut point_gradient = vec![T::default(); point.len()];
        let mut sine_adjoint = vec![vec![T::default(); width]; self.depth];
        let mut cosine_adjoint = vec![vec![T::default(); width]; self.depth];

        // The adjoint of the reverse sweep runs upwards, from the spatial gradient to the head.
        for (linear, depth, first_row) in self.swept_heads(rows) {
            let (after_cosine, before_cosine) = self.sweep(linear, depth, &trace);
            let mut adjoint = upstream[first_row..first_row + 3].to_vec();
            for layer in 0..depth {
                add_outer(&mut folded.matrices[layer], &after_cosine[layer], &adjoint);
                let scaled_adjoint = multiply(&self.folded.matrices[layer], &adjoint);
                add(&mut cosine_adjoint[layer], &product(&scaled_adjoint, &before_cosine[layer + 1]));
                adjoint = product(&scaled_adjoint, &trace.cosines[layer]);
            }
            add(&mut weights[linear.weight.clone()][..width], &adjoint);
        }

        for (linear, depth, first_row) in self.heads(rows) {
            let input: Vec<T> = [&trace.sines[depth - 1], &point[3..]].concat();
            for output in 0..linear.outputs {
                let upstream = upstream[first_row + output];
                let row =
                    linear.weight.start + output * linear.inputs..linear.weight.start + (output + 1) * linear.inputs;
                add_scaled(&mut weights[row.clone()], upstream, &input[..linear.inputs]);
                weights[linear.bias.start + output] += upstream;
                let (hidden, view) = self.weights[row].split_at(width);
                add_scaled(&mut sine_adjoint[depth - 1], upstream, hidden);
                add_scaled(&mut point_gradient[3..][..view.len()], upstream, view);
            }
        }
        if let Some(activations) = &rows.activations {
            add(&mut sine_adjoint[FILM_LAYERS - 1], &upstream[activations.clone()]);
        }

        for layer in (0..self.depth).rev() {
            let angle_adjoint: Vec<T> = (0..width)
                .map(|unit| {
                    sine_adjoint[layer][unit] * trace.cosines[layer][unit]
                        - cosine_adjoint[layer][unit] * trace.sines[layer][unit]
                })
                .collect();
            let (input, input_adjoint) = match layer {
                0 => (&point[..3], &mut point_gradient[..3]),
                _ => (&trace.sines[layer - 1][..], &mut sine_adjoint[layer - 1][..]),
            };
            add_outer(&mut folded.matrices[layer], &angle_adjoint, input);
            add(&mut folded.offsets[layer], &angle_adjoint);
            add(input_adjoint, &multiply_transposed(&self.folded.matrices[layer], &angle_adjoint));
        }
        point_gradient
    }

    /// From the gradients of A and a to those of W, b (added) and γ, β (written).
    fn unfold(&self, folded: &Folded<T>, weights: &mut [T], film: &mut [T]) {
        let width = self.shape.width;
        for (layer, linear) in self.layout.layers.iter().enumerate() {
            for (unit, &gamma) in self.gamma(layer).iter().enumerate() {
                let matrix = &folded.matrices[layer][unit * linear.inputs..(unit + 1) * linear.inputs];
                let row = linear.weight.start + unit * linear.inputs..linear.weight.start + (unit + 1) * linear.inputs;
                let bias = linear.bias.start + unit;
                let offset = folded.offsets[layer][unit];
                film[2 * layer * width + unit] = dot(matrix, &self.weights[row.clone()]) + offset * self.weights[bias];
                film[(2 * layer + 1) * width + unit] = offset;
                add_scaled(&mut weights[row], gamma, matrix);
                weights[bias] += gamma * offset;
            }
        }
    }
}

fn dot<T: Real>(left: &[T], right: &[T]) -> T {
    left.iter().zip(right).fold(T::default(), |sum, (&left, &right)| sum + left * right)
}

fn product<T: Real>(left: &[T], right: &[T]) -> Vec<T> {
    left.iter().zip(right).map(|(&left, &right)| left * right).collect()
}

fn add<T: Real>(sum: &mut [T], term: &[T]) {
    for (sum, &term) in sum.iter_mut().zip(term) {
        *sum += term;
    }
}

fn add_scaled<T: Real>(sum: &mut [T], scale: T, term: &[T]) {
    for (sum, &term) in sum.iter_mut().zip(term) {
        *sum += scale * term;
    }
}

/// matrix · vector, row-major.
fn multiply<T: Real>(matrix: &[T], vector: &[T]) -> Vec<T> {
    matrix.chunks_exact(vector.len()).map(|row| dot(row, vector)).collect()
}

/// matrixᵀ · vector, row-major.
fn multiply_transposed<T: Real>(matrix: &[T], vector: &[T]) -> Vec<T> {
    let columns = matrix.len() / vector.len();
    let mut sum = vec![T::default(); columns];
    for (row, &scale) in matrix.chunks_exact(columns).zip(vector) {
        add_scaled(&mut sum, scale, row);
    }
    sum
}

/// matrix += column · rowᵀ, row-major.
fn add_outer<T: Real>(matrix: &mut [T], column: &[T], row: &[T]) {
    for (matrix_row, &scale) in matrix.chunks_exact_mut(row.len()).zip(column) {
        add_scaled(matrix_row, scale, row);
    }
}
