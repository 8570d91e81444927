//! The local generators in candle operations: any device, f32 or f64, differentiable by candle's own autograd.
//!
//! Spatial gradients are written out as a graph of their own (a reverse sweep), so that first-order autograd of it is
//! the exact double backward; candle's second order is not to be trusted (it silently detaches).

use candle_core::{D, Tensor};

use super::{HeadShape, Linear, Outputs};
use crate::{Error, FILM_LAYERS, Result, SHAPE_LAYERS};

/// Evaluates every region at every point of its image.
///
/// `points` [B, N, 3 or 6], `weights` [k, P], `film` [B, k, 5, 2, W] → [B, k, C, N]; see [`super::autograd::evaluate`].
///
/// # Errors
/// If a tensor has another shape, or candle errs.
pub fn evaluate(
    points: &Tensor,
    weights: &Tensor,
    film: &Tensor,
    shape: HeadShape,
    outputs: Outputs,
) -> Result<Tensor> {
    let (images, regions, count) = check_shapes(points, weights, film, shape)?;
    let width = shape.width;
    let layout = shape.layout();
    let depth = shape.depth(outputs);
    let per_image = |tensor: &Tensor| -> Result<Tensor> {
        let mut dims = tensor.dims().to_vec();
        dims.insert(0, images);
        Ok(tensor.broadcast_as(dims)?.contiguous()?)
    };
    let weight = |linear: &Linear| -> Result<Tensor> {
        let packed = weights.narrow(1, linear.weight.start, linear.weight.len())?;
        Ok(packed.reshape((regions, linear.outputs, linear.inputs))?)
    };
    let bias = |linear: &Linear| -> Result<Tensor> {
        let packed = weights.narrow(1, linear.bias.start, linear.bias.len())?;
        Ok(packed.reshape((1, regions, linear.outputs, 1))?)
    };
    // [B, 3, N] → [B, k, 3, N]
    let per_region = |columns: Tensor| -> Result<Tensor> {
        let columns = columns.transpose(1, 2)?.unsqueeze(1)?;
        Ok(columns.broadcast_as((images, regions, 3, count))?.contiguous()?)
    };
    let point = per_region(points.narrow(2, 0, 3)?)?;
    let view = if shape.point_columns() == 6 { Some(per_region(points.narrow(2, 3, 3)?)?) } else { None };

    let mut sines = Vec::with_capacity(FILM_LAYERS);
    let mut cosines = Vec::with_capacity(FILM_LAYERS);
    let mut folded = Vec::with_capacity(FILM_LAYERS);
    let mut hidden = point;
    for (index, linear) in layout.layers.iter().enumerate().take(depth) {
        let layer_film = film.narrow(2, index, 1)?.reshape((images, regions, 2, width))?;
        let gamma = layer_film.narrow(2, 0, 1)?.reshape((images, regions, width, 1))?;
        let beta = layer_film.narrow(2, 1, 1)?.reshape((images, regions, width, 1))?;
        let matrix = weight(linear)?.unsqueeze(0)?.broadcast_mul(&gamma)?;
        let offset = (bias(linear)?.broadcast_mul(&gamma)? + beta)?;
        let angle = matrix.matmul(&hidden)?.broadcast_add(&offset)?;
        hidden = angle.sin()?;
        sines.push(hidden.clone());
        if outputs.gradient && index < SHAPE_LAYERS.max(shape.residual_depth()) {
            cosines.push(angle.cos()?);
        }
        folded.push(matrix);
    }
    let layer_output =
        |depth: usize| sines.get(depth - 1).ok_or_else(|| Error::shape("hidden layers", depth, &[sines.len()]));
    let head = |linear: &Linear, depth: usize| -> Result<Tensor> {
        let matrix = weight(linear)?;
        let mut value = per_image(&matrix.narrow(2, 0, width)?)?.matmul(layer_output(depth)?)?;
        if let (true, Some(view)) = (linear.inputs > width, &view) {
            value = (value + per_image(&matrix.narrow(2, width, 3)?)?.matmul(view)?)?;
        }
        Ok(value.broadcast_add(&bias(linear)?)?)
    };
    // ∇(w·h_L) = W_1'ᵀ (cos z_1 ∘ … W_L'ᵀ (cos z_L ∘ w)), with FiLM inside W'.
    let head_gradient = |linear: &Linear, depth: usize| -> Result<Tensor> {
        let row = weight(linear)?.narrow(2, 0, width)?.reshape((1, regions, width, 1))?;
        let mut sweep = row.broadcast_as((images, regions, width, count))?;
        for (matrix, cosine) in folded.iter().zip(&cosines).take(depth).rev() {
            sweep = matrix.transpose(2, 3)?.contiguous()?.matmul(&(sweep * cosine)?)?;
        }
        Ok(sweep)
    };

    let mut rows = vec![head(&layout.mask, SHAPE_LAYERS)?, head(&layout.residual, shape.residual_depth())?];
    if outputs.gradient {
        rows.push(head_gradient(&layout.mask, SHAPE_LAYERS)?);
        rows.push(head_gradient(&layout.residual, shape.residual_depth())?);
    }
    if outputs.colour {
        rows.push(head(&layout.colour, FILM_LAYERS)?);
    }
    if outputs.activations {
        rows.push(layer_output(FILM_LAYERS)?.clone());
    }
    Ok(Tensor::cat(&rows, D::Minus2)?)
}

/// The sizes (B, k, N), or which tensor does not fit.
pub(super) fn check_shapes(
    points: &Tensor,
    weights: &Tensor,
    film: &Tensor,
    shape: HeadShape,
) -> Result<(usize, usize, usize)> {
    let &[images, count, columns] = points.dims() else {
        return Err(Error::shape("points", "[B, N, 3 or 6]", points.dims()));
    };
    if columns != shape.point_columns() {
        return Err(Error::shape("points", [images, count, shape.point_columns()], points.dims()));
    }
    let &[regions, parameters] = weights.dims() else {
        return Err(Error::shape("weights", "[k, P]", weights.dims()));
    };
    if parameters != shape.parameter_count() {
        return Err(Error::shape("weights", [regions, shape.parameter_count()], weights.dims()));
    }
    let expected = [images, regions, FILM_LAYERS, 2, shape.width];
    if film.dims() != expected {
        return Err(Error::shape("film", expected, film.dims()));
    }
    Ok((images, regions, count))
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Device, Var};

    use super::*;
    use crate::{SdfHead, random::Stream};

    /// Central differences of a fixed random functional of the result, along one random direction of each input.
    #[test]
    fn first_order_autograd_agrees_with_finite_differences() {
        for (sdf_head, view) in [(SdfHead::Shape, false), (SdfHead::Texture, true)] {
            let shape = HeadShape { width: 6, sdf_head, mask_view: view, colour_view: view };
            let outputs = Outputs { gradient: true, colour: true, activations: true };
            let (images, regions, count) = (2, 3, 5);
            let dims = [
                vec![images, count, shape.point_columns()],
                vec![regions, shape.parameter_count()],
                vec![images, regions, FILM_LAYERS, 2, shape.width],
                vec![images, regions, shape.rows(outputs).count, count],
            ];
            let mut stream = Stream::new(11, &[]);
            let mut draw = |dims: &[usize], scale: f64| {
                let tensor = stream.normal_tensor(dims, &Device::Cpu).unwrap().to_dtype(DType::F64).unwrap();
                (tensor * scale).unwrap()
            };
            let inputs = [draw(&dims[0], 1.0), draw(&dims[1], 0.4), (draw(&dims[2], 0.5) + 1.0).unwrap()];
            let upstream = draw(&dims[3], 1.0);
            let loss = |inputs: &[Tensor]| {
                let result = evaluate(&inputs[0], &inputs[1], &inputs[2], shape, outputs).unwrap();
                assert_eq!(result.dims(), upstream.dims());
                (result * &upstream).unwrap().sum_all().unwrap()
            };
            let variables: Vec<_> = inputs.iter().map(|input| Var::from_tensor(input).unwrap()).collect();
            let tracked: Vec<_> = variables.iter().map(|variable| variable.as_tensor().clone()).collect();
            let gradients = loss(&tracked).backward().unwrap();
            for (which, variable) in variables.iter().enumerate() {
                let direction = draw(&dims[which], 1.0);
                let moved = |step: f64| {
                    let mut inputs = inputs.to_vec();
                    inputs[which] = (&inputs[which] + (&direction * step).unwrap()).unwrap();
                    loss(&inputs).to_scalar::<f64>().unwrap()
                };
                let step = 1e-5;
                let numeric = (moved(step) - moved(-step)) / (2.0 * step);
                let product = (gradients.get(variable).unwrap() * &direction).unwrap();
                let exact = product.sum_all().unwrap().to_scalar::<f64>().unwrap();
                // Central differences in f64: step² truncation and 1e-16 / step rounding, both near 1e-10 x derivatives.
                assert!((numeric - exact).abs() < 1e-7 * (1.0 + exact.abs()), "input {which}: {numeric} {exact}");
            }
        }
    }

    #[test]
    fn wrong_shapes_are_named() {
        let shape = HeadShape { width: 4, sdf_head: SdfHead::Shape, mask_view: false, colour_view: false };
        let zeros = |dims: &[usize]| Tensor::zeros(dims, DType::F32, &Device::Cpu).unwrap();
        let (points, weights, film) =
            (zeros(&[1, 2, 3]), zeros(&[9, shape.parameter_count()]), zeros(&[1, 9, 5, 2, 4]));
        let message = |points: &Tensor, weights: &Tensor, film: &Tensor| {
            evaluate(points, weights, film, shape, Outputs::default()).unwrap_err().to_string()
        };
        assert!(message(&zeros(&[1, 2, 6]), &weights, &film).starts_with("points: "));
        assert!(message(&points, &zeros(&[9, 7]), &film).starts_with("weights: "));
        assert!(message(&points, &weights, &zeros(&[2, 9, 5, 2, 4])).starts_with("film: "));
    }
}
