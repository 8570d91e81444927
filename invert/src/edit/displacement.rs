//! Moving some rows of a portrait's codes by descent: what painting and recolouring share.

use candle_core::{DType, Tensor, Var};
use cnerf_core::{
    codes::Aspect,
    region::{REGION_COUNT, RegionSet},
    train::optimiser::{Adam, Betas, Group, Schedule},
};

use crate::{error::Result, objective, space::CodeSpace};

const BETAS: Betas = Betas { first: 0.9, second: 0.99 };
const SCHEDULE: Schedule = Schedule { warmup_steps: 5, hold: 0.5, floor: 0.1 };

/// A search for codes: base codes plus a displacement of some rows, in whitened coordinates.
pub(super) struct Displacement {
    /// `[1, 9, 2, D]`.
    base: Tensor,
    /// Which rows move: `[18, N]`, one 1 a column.
    places: Tensor,
    /// `[N, D]`, whitened.
    rows: Var,
    space: CodeSpace,
    optimiser: Adam,
    step: usize,
    steps: usize,
}

impl Displacement {
    /// Starts at `base` `[1, 9, 2, D]`; the rows of `regions` and `aspect` will move for so many `steps` at Adam's
    /// rate `rate` (whitened units).
    pub(super) fn new(
        base: &Tensor,
        space: CodeSpace,
        regions: RegionSet,
        aspect: Aspect,
        steps: usize,
        rate: f64,
    ) -> Result<Self> {
        let moving: Vec<usize> = regions
            .iter()
            .flat_map(|region| (0..2).filter(move |row| aspect.covers(*row)).map(move |row| 2 * region.index() + row))
            .collect();
        let count = moving.len();
        let mut places = vec![0f32; 2 * REGION_COUNT * count];
        for (column, row) in moving.iter().enumerate() {
            if let Some(place) = places.get_mut(row * count + column) {
                *place = 1.0;
            }
        }
        let places = Tensor::from_vec(places, (2 * REGION_COUNT, count), base.device())?;
        let rows = Var::zeros((count, space.style_dim()), DType::F32, base.device())?;
        let variables = vec![("displacement".to_owned(), rows.clone())];
        let optimiser = Adam::new(vec![Group { variables, learning_rate: rate, largest_gradient_norm: None }], BETAS);
        Ok(Self { base: base.detach(), places, rows, space, optimiser, step: 0, steps })
    }

    /// The codes as they are now, `[1, 9, 2, D]`, with their graph. Rows that do not move are the base's, bit by bit.
    pub(super) fn live(&self) -> Result<Tensor> {
        let moved = self.space.displaced(&self.places.matmul(self.rows.as_tensor())?)?;
        Ok((&self.base + moved.reshape(self.base.shape())?)?)
    }

    /// The codes as they are now, without a graph.
    pub(super) fn codes(&self) -> Result<Tensor> {
        Ok(self.live()?.detach())
    }

    /// The mean square of the displacement, a scalar: what holds the codes to where they were.
    pub(super) fn distance(&self) -> Result<Tensor> {
        Ok(self.rows.as_tensor().sqr()?.mean_all()?)
    }

    /// The moving rows as they are now, `[N, D]`, whitened.
    pub(super) fn rows(&self) -> Result<Tensor> {
        Ok(self.rows.as_tensor().copy()?.detach())
    }

    /// Moves the rows to `rows`, as [`Self::rows`] gave them.
    pub(super) fn set(&mut self, rows: &Tensor) -> Result<()> {
        Ok(self.rows.set(rows)?)
    }

    /// Moves the rows by `step` `[N, D]`, whitened.
    pub(super) fn shift(&mut self, step: &Tensor) -> Result<()> {
        let moved = (self.rows.as_tensor() + step)?.detach();
        self.set(&moved)
    }

    /// The gradient of `value`, computed from [`Self::live`], to the moving rows: `[N, D]`.
    pub(super) fn gradient(&self, value: &Tensor) -> Result<Tensor> {
        let gradients = value.backward()?;
        match gradients.get(self.rows.as_tensor()) {
            Some(gradient) => Ok(gradient.detach()),
            None => Ok(self.rows.as_tensor().zeros_like()?),
        }
    }

    /// One step down `loss`, which was computed from [`Self::live`].
    pub(super) fn descend(&mut self, loss: &Tensor, name: &str) -> Result<()> {
        if !objective::scalar(loss)?.is_finite() {
            return Err(cnerf_core::Error::not_finite(name).into());
        }
        self.optimiser.step(&loss.backward()?, SCHEDULE.factor(self.step, self.steps))?;
        self.step += 1;
        Ok(())
    }
}
