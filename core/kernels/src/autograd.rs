//! The door to the kernels: local generators as one differentiable candle function.

use std::{
    mem,
    sync::{Arc, Mutex, PoisonError},
};

use candle_core::{CpuStorage, CustomOp3, DType, Device, Layout, Shape, Storage, Tensor};

use super::{
    Evaluation, Extent, Gradients, HeadShape, Outputs, Path, RegionKernel, composed,
    parts::{Left, Parts},
};
use crate::Result;

/// Evaluates every region at every point of its image, differentiable to first order in all three tensors; gradient
/// rows are differentiable too, so a loss on them is the exact double backward.
///
/// - `points` [B, N, 3] scaled to network units, or [B, N, 6] with the view direction when a head reads it;
/// - `weights` [k, P], one region a row, packed as [`HeadShape::layout`];
/// - `film` [B, k, 5, 2, W], γ then β of each layer;
/// - the result is [B, k, C, N], rows as [`HeadShape::rows`].
///
/// f32 on the CPU runs on the kernel of the current [`Path`], all else on [`composed`]. A tensor that no variable led to gets no
/// gradient (detach `points` to save the work and memory of theirs).
///
/// # Errors
/// If a tensor has another shape, `CNERF_KERNEL` names no kernel, or candle errs.
pub fn evaluate(
    points: &Tensor,
    weights: &Tensor,
    film: &Tensor,
    shape: HeadShape,
    outputs: Outputs,
) -> Result<Tensor> {
    match Path::current()? {
        Path::Kernel(kernel) if matches!(points.device(), Device::Cpu) && points.dtype() == DType::F32 => {
            evaluate_with(kernel, points, weights, film, shape, outputs)
        }
        _ => composed::evaluate(points, weights, film, shape, outputs),
    }
}

/// [`evaluate`] for reading in parts, at a fraction of the memory traffic on the way back.
///
/// # Errors
/// As [`evaluate`].
pub fn evaluate_in_parts(
    points: &Tensor,
    weights: &Tensor,
    film: &Tensor,
    shape: HeadShape,
    outputs: Outputs,
) -> Result<Parts> {
    let is_tracked = [points, weights, film].iter().any(|tensor| tensor.track_op());
    let kernel = match Path::current()? {
        Path::Kernel(kernel) if matches!(points.device(), Device::Cpu) && points.dtype() == DType::F32 => kernel,
        _ => return Parts::new(composed::evaluate(points, weights, film, shape, outputs)?),
    };
    if !is_tracked {
        return Parts::new(evaluate_with(kernel, points, weights, film, shape, outputs)?);
    }
    let (images, regions, count) = composed::check_shapes(points, weights, film, shape)?;
    let extent = Extent { images, regions, points: count };
    let (left, values) = (Arc::new(Left::default()), Arc::new(Mutex::new(Vec::new())));
    let generators = LocalGenerators { kernel, shape, outputs, extent };
    let operation = InParts { generators, values: values.clone(), left: left.clone() };
    let knot = points.contiguous()?.apply_op3(&weights.contiguous()?, &film.contiguous()?, operation)?;
    let values = mem::take(&mut *values.lock().unwrap_or_else(PoisonError::into_inner));
    let values = Tensor::from_vec(values, (images, regions, shape.rows(outputs).count, count), &Device::Cpu)?;
    Parts::tied(values, knot, left)
}

/// [`evaluate`] with the kernel of one's choice; tensors are f32 on the CPU.
///
/// # Errors
/// As [`evaluate`], or if a tensor is of another type or device.
pub fn evaluate_with(
    kernel: &'static dyn RegionKernel<f32>,
    points: &Tensor,
    weights: &Tensor,
    film: &Tensor,
    shape: HeadShape,
    outputs: Outputs,
) -> Result<Tensor> {
    let (images, regions, count) = composed::check_shapes(points, weights, film, shape)?;
    let extent = Extent { images, regions, points: count };
    let operation = LocalGenerators { kernel, shape, outputs, extent };
    Ok(points.contiguous()?.apply_op3(&weights.contiguous()?, &film.contiguous()?, operation)?)
}

struct LocalGenerators {
    kernel: &'static dyn RegionKernel<f32>,
    shape: HeadShape,
    outputs: Outputs,
    extent: Extent,
}

impl LocalGenerators {
    fn evaluation<'a>(
        &self,
        points: &'a [f32],
        weights: &'a [f32],
        film: &'a [f32],
    ) -> candle_core::Result<Evaluation<'a, f32>> {
        Evaluation::new(self.shape, self.outputs, self.extent, points, weights, film).map_err(into_candle)
    }
}

impl CustomOp3 for LocalGenerators {
    fn name(&self) -> &'static str {
        "local-generators"
    }

    fn cpu_fwd(
        &self,
        points: &CpuStorage,
        points_layout: &Layout,
        weights: &CpuStorage,
        weights_layout: &Layout,
        film: &CpuStorage,
        film_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let evaluation = self.evaluation(
            values(points, points_layout)?,
            values(weights, weights_layout)?,
            values(film, film_layout)?,
        )?;
        let mut result = vec![0.0; evaluation.result_len()];
        self.kernel.forward(&evaluation, &mut result).map_err(into_candle)?;
        let Extent { images, regions, points } = self.extent;
        let rows = self.shape.rows(self.outputs).count;
        Ok((CpuStorage::F32(result), (images, regions, rows, points).into()))
    }

    fn bwd(
        &self,
        points: &Tensor,
        weights: &Tensor,
        film: &Tensor,
        _result: &Tensor,
        upstream: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let upstream = upstream.contiguous()?;
        let (storage, layout) = upstream.storage_and_layout();
        match &*storage {
            Storage::Cpu(storage) => self.backward(points, weights, film, values(storage, layout)?),
            _ => candle_core::bail!("the local generators' kernels run on the CPU only"),
        }
    }
}

impl LocalGenerators {
    /// Gradients of points, weights and FiLM, of those that a variable led to.
    fn backward(
        &self,
        points: &Tensor,
        weights: &Tensor,
        film: &Tensor,
        upstream: &[f32],
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let storages = [points, weights, film].map(Tensor::storage_and_layout);
        let [points_values, weights_values, film_values] =
            storages.each_ref().map(|(storage, layout)| match &**storage {
                Storage::Cpu(storage) => values(storage, layout),
                _ => candle_core::bail!("the local generators' kernels run on the CPU only"),
            });
        let evaluation = self.evaluation(points_values?, weights_values?, film_values?)?;
        let zeros = |tensor: &Tensor| vec![0f32; tensor.elem_count()];
        let mut points_gradient = points.track_op().then(|| zeros(points));
        let (mut weights_gradient, mut film_gradient) = (zeros(weights), zeros(film));
        let gradients = Gradients {
            points: points_gradient.as_deref_mut(),
            weights: &mut weights_gradient,
            film: &mut film_gradient,
        };
        self.kernel.backward(&evaluation, upstream, gradients).map_err(into_candle)?;
        let tensor = |values: Vec<f32>, like: &Tensor| Tensor::from_vec(values, like.shape(), &Device::Cpu);
        Ok((
            points_gradient.map(|gradient| tensor(gradient, points)).transpose()?,
            weights.track_op().then(|| tensor(weights_gradient, weights)).transpose()?,
            film.track_op().then(|| tensor(film_gradient, film)).transpose()?,
        ))
    }
}

/// The same as one number, the knot: values go out and gradients come in beside the graph, see [`Parts`].
struct InParts {
    generators: LocalGenerators,
    values: Arc<Mutex<Vec<f32>>>,
    left: Arc<Left>,
}

impl CustomOp3 for InParts {
    fn name(&self) -> &'static str {
        "local-generators-in-parts"
    }

    fn cpu_fwd(
        &self,
        points: &CpuStorage,
        points_layout: &Layout,
        weights: &CpuStorage,
        weights_layout: &Layout,
        film: &CpuStorage,
        film_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (result, _) = self.generators.cpu_fwd(points, points_layout, weights, weights_layout, film, film_layout)?;
        if let CpuStorage::F32(result) = result {
            *self.values.lock().unwrap_or_else(PoisonError::into_inner) = result;
        }
        Ok((CpuStorage::F32(vec![0.0]), 1.into()))
    }

    fn bwd(
        &self,
        points: &Tensor,
        weights: &Tensor,
        film: &Tensor,
        _: &Tensor,
        _: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let generators = &self.generators;
        let Extent { images, regions, points: count } = generators.extent;
        let upstream = self.left.take((images * regions, generators.shape.rows(generators.outputs).count, count))?;
        generators.backward(points, weights, film, &upstream)
    }
}

/// The values of a contiguous f32 tensor.
fn values<'a>(storage: &'a CpuStorage, layout: &Layout) -> candle_core::Result<&'a [f32]> {
    let values = storage.as_slice::<f32>()?;
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&values[start..end]),
        None => candle_core::bail!("the local generators' kernels need contiguous tensors"),
    }
}

fn into_candle(error: crate::Error) -> candle_core::Error {
    match error {
        crate::Error::Tensor(error) => error,
        error => candle_core::Error::wrap(error),
    }
}
