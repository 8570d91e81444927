//! The codes training portraits have of their own: one z each, and, once a warm-up has unlocked them, what every region
//! adds to the mapped code. Also the optimiser of a table of which each step touches a few rows.

use std::path::Path;

use candle_core::{Device, Tensor, Var};

use crate::{
    codes,
    error::{Error, Result},
    model::{
        file::{self, Tensors},
        generator::Generator,
    },
    train::{optimiser::Betas, whiten::principal_components},
};

/// Names of the tensors in a run's code file and in checkpoints.
const CODES: &str = "codes";
const REGION_CODES: &str = "region_codes";

/// Codes of M portraits, mirrored copies after the plain ones.
#[derive(Clone, Debug)]
pub struct PortraitCodes {
    /// z, `[M, D]`.
    pub noise: Tensor,
    /// What each region and aspect adds to the mapped z, `[M, 9, 2, D]`; none is 0.
    pub offsets: Option<Tensor>,
}

impl PortraitCodes {
    /// M.
    pub fn count(&self) -> usize {
        self.noise.dims().first().copied().unwrap_or(0)
    }

    /// Codes `[B, 9, 2, D]` of the portraits `rows`.
    pub fn codes(&self, generator: &Generator, rows: &[u32]) -> Result<Tensor> {
        let rows = Tensor::new(rows, self.noise.device())?;
        let mapped = codes::broadcast(&generator.map(&self.noise.index_select(&rows, 0)?)?)?;
        match &self.offsets {
            Some(offsets) => Ok((mapped + offsets.index_select(&rows, 0)?)?),
            None => Ok(mapped),
        }
    }

    /// All codes, `[M, 9, 2, D]`.
    pub fn all(&self, generator: &Generator) -> Result<Tensor> {
        let rows: Vec<u32> = (0..self.count() as u32).collect();
        self.codes(generator, &rows)
    }

    /// `generator` with the `size` first principal components of these codes as its population, or as many as there can
    /// be; 0 leaves it without.
    pub fn population(&self, generator: &Generator, size: usize, seed: u64) -> Result<Generator> {
        let size = size.min(self.count().saturating_sub(1));
        if size == 0 {
            return Ok(generator.clone());
        }
        let codes = self.all(generator)?.detach().flatten_from(1)?;
        let components = principal_components(&codes, size, seed)?;
        generator.with_population(Some((&codes.mean(0)?, &components)))
    }

    /// Adds the tensors that [`Self::take`] reads.
    pub fn put(&self, tensors: &mut Tensors) {
        tensors.insert(CODES.to_owned(), self.noise.clone());
        if let Some(offsets) = &self.offsets {
            tensors.insert(REGION_CODES.to_owned(), offsets.clone());
        }
    }

    /// The codes among `tensors`; none if there are none.
    pub fn take(tensors: &Tensors, device: &Device) -> Result<Option<Self>> {
        let Some(noise) = tensors.get(CODES) else { return Ok(None) };
        let (count, style_dim) = noise.dims2()?;
        let offsets = tensors.get(REGION_CODES).map(|offsets| offsets.to_device(device)).transpose()?;
        if let Some(offsets) = &offsets
            && codes::dimensions(offsets)? != (count, style_dim)
        {
            return Err(Error::shape(REGION_CODES, [count, 9, 2, style_dim], offsets.dims()));
        }
        Ok(Some(Self { noise: noise.to_device(device)?, offsets }))
    }

    /// Writes the file [`Self::read`] reads.
    pub fn write(&self, path: &Path) -> Result<()> {
        let mut tensors = Tensors::new();
        self.put(&mut tensors);
        file::write_safetensors(path, &tensors, &[])
    }

    /// The codes in the file at `path`.
    pub fn read(path: &Path, device: &Device) -> Result<Self> {
        let (tensors, _) = file::parse_safetensors(path, &file::read_bytes(path)?)?;
        Self::take(&tensors, device)?.ok_or_else(|| Error::malformed(path, "holds no portrait codes"))
    }
}

/// A large table of which a step touches a few rows: Adam with moments for every row, moved only when the row is used
/// (as `torch.optim.SparseAdam` does), so that a step costs what the batch costs and not what the table would.
pub struct RowTable {
    rows: usize,
    /// Shape of one row.
    shape: Vec<usize>,
    values: Vec<f32>,
    first: Vec<f32>,
    second: Vec<f32>,
    step: u64,
}

impl RowTable {
    /// A table `[rows, shape…]` of zeros.
    pub fn zeros(rows: usize, shape: &[usize]) -> Self {
        let length = rows * shape.iter().product::<usize>();
        Self {
            rows,
            shape: shape.to_vec(),
            values: vec![0.0; length],
            first: vec![0.0; length],
            second: vec![0.0; length],
            step: 0,
        }
    }

    /// Takes over the values of `tensor`, `[rows, shape…]`.
    pub fn set(&mut self, tensor: &Tensor) -> Result<()> {
        if tensor.dims() != self.dimensions() {
            return Err(Error::shape(REGION_CODES, self.dimensions(), tensor.dims()));
        }
        self.values = tensor.flatten_all()?.to_vec1()?;
        Ok(())
    }

    /// Whether any step was taken.
    pub fn is_touched(&self) -> bool {
        self.step > 0
    }

    /// The whole table.
    pub fn tensor(&self) -> Result<Tensor> {
        Ok(Tensor::from_slice(&self.values, self.dimensions(), &Device::Cpu)?)
    }

    /// The rows named, as a variable to differentiate by: `[B, shape…]`.
    pub fn gather(&self, rows: &[u32], device: &Device) -> Result<Var> {
        let mut values = Vec::with_capacity(rows.len() * self.row_length());
        for row in rows {
            values.extend_from_slice(&self.values[self.span(*row)?]);
        }
        let mut dimensions = vec![rows.len()];
        dimensions.extend(&self.shape);
        Ok(Var::from_vec(values, dimensions, device)?)
    }

    /// One step of Adam on those rows; `rows` holds no row twice.
    pub fn step(&mut self, rows: &[u32], gradient: &Tensor, learning_rate: f64, betas: Betas) -> Result<()> {
        let gradient: Vec<f32> = gradient.flatten_all()?.to_vec1()?;
        if gradient.len() != rows.len() * self.row_length() {
            return Err(Error::shape("gradient of rows", [rows.len(), self.row_length()], &[gradient.len()]));
        }
        if !gradient.iter().all(|value| value.is_finite()) {
            return Err(Error::not_finite(format!("the gradient of {REGION_CODES}")));
        }
        self.step += 1;
        let correction = |beta: f64| (1.0 - beta.powf(self.step as f64)) as f32;
        let (correction_first, correction_second) = (correction(betas.first), correction(betas.second));
        let (beta_first, beta_second) = (betas.first as f32, betas.second as f32);
        let rate = learning_rate as f32 / correction_first;
        for (row, gradient) in rows.iter().zip(gradient.chunks_exact(self.row_length())) {
            let span = self.span(*row)?;
            let moments = self.first[span.clone()].iter_mut().zip(&mut self.second[span.clone()]);
            for ((value, (first, second)), gradient) in self.values[span].iter_mut().zip(moments).zip(gradient) {
                *first = beta_first * *first + (1.0 - beta_first) * gradient;
                *second = beta_second * *second + (1.0 - beta_second) * gradient * gradient;
                *value -= rate * *first / ((*second / correction_second).sqrt() + 1e-8);
            }
        }
        Ok(())
    }

    /// Values and moments under `prefix`.
    pub fn save(&self, prefix: &str, tensors: &mut Tensors) -> Result<()> {
        for (name, values) in [("values", &self.values), ("first", &self.first), ("second", &self.second)] {
            tensors.insert(format!("{prefix}.{name}"), Tensor::from_slice(values, self.dimensions(), &Device::Cpu)?);
        }
        tensors.insert(format!("{prefix}.step"), Tensor::new(&[self.step as i64], &Device::Cpu)?);
        Ok(())
    }

    /// Reads what [`Self::save`] wrote.
    pub fn load(&mut self, prefix: &str, tensors: &Tensors) -> Result<()> {
        let read = |name: &str| -> Result<&Tensor> {
            let name = format!("{prefix}.{name}");
            tensors.get(&name).ok_or_else(|| Error::shape(name, self.dimensions(), &[]))
        };
        let table = |name: &str| -> Result<Vec<f32>> {
            let tensor = read(name)?;
            if tensor.dims() != self.dimensions() {
                return Err(Error::shape(format!("{prefix}.{name}"), self.dimensions(), tensor.dims()));
            }
            Ok(tensor.flatten_all()?.to_vec1()?)
        };
        let (values, first, second) = (table("values")?, table("first")?, table("second")?);
        let step = read("step")?.flatten_all()?.to_vec1::<i64>()?;
        self.step = step.first().copied().unwrap_or(0).max(0) as u64;
        (self.values, self.first, self.second) = (values, first, second);
        Ok(())
    }

    fn dimensions(&self) -> Vec<usize> {
        std::iter::once(self.rows).chain(self.shape.iter().copied()).collect()
    }

    fn row_length(&self) -> usize {
        self.shape.iter().product()
    }

    fn span(&self, row: u32) -> Result<std::ops::Range<usize>> {
        let start = row as usize * self.row_length();
        if row as usize >= self.rows {
            return Err(Error::shape("row", format!("below {}", self.rows), &[row as usize]));
        }
        Ok(start..start + self.row_length())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        model::file::Tensors,
        train::optimiser::{Adam, Group},
    };

    const BETAS: Betas = Betas { first: 0.9, second: 0.99 };

    fn gradient(variable: &Var) -> Tensor {
        let loss = variable.as_tensor().affine(1.0, -3.0).unwrap().sqr().unwrap().sum_all().unwrap();
        loss.backward().unwrap().get(variable).unwrap().clone()
    }

    #[test]
    fn with_every_row_in_every_step_it_is_adam() {
        let mut table = RowTable::zeros(3, &[2]);
        let dense = Var::zeros((3, 2), candle_core::DType::F32, &Device::Cpu).unwrap();
        let group =
            Group { variables: vec![("x".into(), dense.clone())], learning_rate: 0.1, largest_gradient_norm: None };
        let mut adam = Adam::new(vec![group], BETAS);
        for _ in 0..40 {
            let rows = [2, 0, 1];
            let gathered = table.gather(&rows, &Device::Cpu).unwrap();
            table.step(&rows, &gradient(&gathered), 0.1, BETAS).unwrap();
            let loss = dense.as_tensor().affine(1.0, -3.0).unwrap().sqr().unwrap().sum_all().unwrap();
            adam.step(&loss.backward().unwrap(), 1.0).unwrap();
        }
        let difference = (table.tensor().unwrap() - dense.as_tensor()).unwrap().abs().unwrap().max_all().unwrap();
        // The same arithmetic in another order: a few units in the last place of values around 3.
        assert!(difference.to_scalar::<f32>().unwrap() < 1e-5);
    }

    #[test]
    fn rows_left_alone_stay_and_a_resumed_table_goes_on_bit_for_bit() {
        let mut table = RowTable::zeros(4, &[3]);
        let advance = |table: &mut RowTable, rows: &[u32]| {
            let gathered = table.gather(rows, &Device::Cpu).unwrap();
            table.step(rows, &gradient(&gathered), 0.1, BETAS).unwrap();
        };
        advance(&mut table, &[1, 3]);
        let mut saved = Tensors::new();
        table.save("codes", &mut saved).unwrap();
        let mut resumed = RowTable::zeros(4, &[3]);
        resumed.load("codes", &saved).unwrap();
        for table in [&mut table, &mut resumed] {
            advance(table, &[3, 0]);
        }
        let values = |table: &RowTable| table.tensor().unwrap().to_vec2::<f32>().unwrap();
        assert_eq!(values(&table), values(&resumed));
        assert_eq!(values(&table)[2], [0.0; 3]);
        assert!(values(&table)[1].iter().all(|value| *value > 0.0));
        assert!(table.gather(&[4], &Device::Cpu).is_err());
        assert!(RowTable::zeros(4, &[2]).load("codes", &saved).is_err());
    }
}
