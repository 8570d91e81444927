//! Single regions made ready to be evaluated at lists of points: what a renderer that skips regions needs.
//!
//! [`RegionKernel::forward`] evaluates every region at every point and folds FiLM into the weights on the way. A plan
//! that leaves most (point, region) pairs out asks each region for a short list of its own, many times over: there the
//! folding is done once, and a call costs its points and nothing else. Values are bit-identical to `forward`'s: the
//! same arithmetic in the same order, whatever the neighbours in the list.

use crate::{
    Evaluation, Extent, FILM_LAYERS, HeadShape, Outputs, RegionKernel, Result, Rows, check_length,
    plain::{Plain, Real},
};

/// One region of one image, FiLM folded in. Work is done on the calling thread: cut lists to share it out.
pub trait PreparedRegion<T>: Send + Sync {
    /// The network's sizes.
    fn shape(&self) -> HeadShape;

    /// What [`Self::forward`] gives.
    fn outputs(&self) -> Outputs;

    /// Where each output lies in a result.
    fn rows(&self) -> Rows {
        self.shape().rows(self.outputs())
    }

    /// Writes the result at `points` [n, 3 or 6] (as in [`Evaluation::new`]), one point's C values after another's:
    /// [n, C], numbered as [`HeadShape::rows`].
    ///
    /// # Errors
    /// If a slice has another length.
    fn forward(&self, points: &[T], result: &mut [T]) -> Result<()>;
}

/// Errs unless the slices are one region's and the lists' lengths agree.
pub(crate) fn check_region<T>(shape: HeadShape, weights: &[T], film: &[T]) -> Result<()> {
    Evaluation::new(shape, Outputs::default(), Extent { images: 1, regions: 1, points: 0 }, &[], weights, film)?;
    Ok(())
}

/// n, or an error unless `points` is [n, columns] and `result_len` is n · C.
pub(crate) fn check_list<T>(shape: HeadShape, rows: usize, points: &[T], result_len: usize) -> Result<usize> {
    let count = points.len() / shape.point_columns();
    check_length("points", &[count, shape.point_columns()], points.len())?;
    check_length("result", &[count, rows], result_len)?;
    Ok(count)
}

/// The reference: keeps the weights and evaluates them as they are.
pub(crate) struct PlainRegion<T> {
    shape: HeadShape,
    outputs: Outputs,
    weights: Vec<T>,
    film: Vec<T>,
}

impl<T: Real> PlainRegion<T> {
    pub(crate) fn new(shape: HeadShape, outputs: Outputs, weights: &[T], film: &[T]) -> Result<Self> {
        check_region(shape, weights, film)?;
        debug_assert_eq!(film.len(), FILM_LAYERS * 2 * shape.width);
        Ok(Self { shape, outputs, weights: weights.to_vec(), film: film.to_vec() })
    }
}

impl<T: Real> PreparedRegion<T> for PlainRegion<T> {
    fn shape(&self) -> HeadShape {
        self.shape
    }

    fn outputs(&self) -> Outputs {
        self.outputs
    }

    fn forward(&self, points: &[T], result: &mut [T]) -> Result<()> {
        let count = check_list(self.shape, self.rows().count, points, result.len())?;
        let extent = Extent { images: 1, regions: 1, points: count };
        let evaluation = Evaluation::new(self.shape, self.outputs, extent, points, &self.weights, &self.film)?;
        let mut rows = vec![T::default(); result.len()];
        Plain.forward(&evaluation, &mut rows)?;
        for (point, values) in result.chunks_exact_mut(self.rows().count).enumerate() {
            for (value, row) in values.iter_mut().zip(rows.chunks_exact(count)) {
                *value = row[point];
            }
        }
        Ok(())
    }
}
