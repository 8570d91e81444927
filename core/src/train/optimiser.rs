//! Adam with named state that can be saved, so that a resumed run continues bit for bit.

use std::collections::BTreeMap;

use candle_core::{Tensor, Var, backprop::GradStore};

use crate::{
    error::{Error, Result},
    model::file::Tensors,
    train::team::Team,
};

/// A set of variables that share a learning rate and a gradient bound.
pub struct Group {
    /// Variables by name.
    pub variables: Vec<(String, Var)>,
    /// Learning rate before the schedule's factor.
    pub learning_rate: f64,
    /// Largest Euclidean norm of the group's gradient; larger ones are scaled down to it.
    pub largest_gradient_norm: Option<f64>,
}

/// Adam's constants.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Betas {
    /// Decay of the gradient's mean.
    pub first: f64,
    /// Decay of the gradient's square.
    pub second: f64,
}

/// Adam (Kingma and Ba, 2015) with bias correction and ε = 1e-8.
pub struct Adam {
    groups: Vec<Group>,
    betas: Betas,
    moments: BTreeMap<String, (Tensor, Tensor)>,
    step: u64,
    team: Team,
}

impl Adam {
    /// An optimiser at step 0.
    pub fn new(groups: Vec<Group>, betas: Betas) -> Self {
        Self { groups, betas, moments: BTreeMap::new(), step: 0, team: Team::default() }
    }

    /// The same, stepping along the mean gradient of a whole team.
    #[must_use]
    pub fn in_team(self, team: &Team) -> Self {
        Self { team: team.clone(), ..self }
    }

    /// One step along `gradients`, learning rates multiplied by `factor`. Returns each group's gradient norm before
    /// bounding. Variables without a gradient stay as they are. A norm that is not finite changes nothing and is an
    /// error.
    pub fn step(&mut self, gradients: &GradStore, factor: f64) -> Result<Vec<f64>> {
        let mut means = self.team.means(&self.groups, gradients)?.map(Vec::into_iter);
        // The gradients of all groups' variables, in order.
        let mut gradient_of = |variable: &Var| match &mut means {
            Some(means) => means.next().flatten(),
            None => gradients.get(variable).map(Tensor::detach),
        };
        let gradients: Vec<Vec<Option<Tensor>>> = self
            .groups
            .iter()
            .map(|group| group.variables.iter().map(|(_, variable)| gradient_of(variable)).collect())
            .collect();
        let mut norms = Vec::with_capacity(self.groups.len());
        for (group, gradients) in self.groups.iter().zip(&gradients) {
            let mut square = 0.0;
            for ((name, _), gradient) in group.variables.iter().zip(gradients) {
                if let Some(gradient) = gradient {
                    let sum =
                        f64::from(gradient.sqr()?.sum_all()?.to_dtype(candle_core::DType::F32)?.to_scalar::<f32>()?);
                    if !sum.is_finite() {
                        return Err(Error::not_finite(format!("the gradient of {name}")));
                    }
                    square += sum;
                }
            }
            norms.push(square.sqrt());
        }
        self.step += 1;
        let correction_first = 1.0 - self.betas.first.powf(self.step as f64);
        let correction_second = 1.0 - self.betas.second.powf(self.step as f64);
        for ((group, gradients), norm) in self.groups.iter().zip(gradients).zip(&norms) {
            let bound = group.largest_gradient_norm.map_or(1.0, |largest| (largest / norm.max(1e-12)).min(1.0));
            for ((name, variable), gradient) in group.variables.iter().zip(gradients) {
                let Some(gradient) = gradient else { continue };
                let gradient = if bound < 1.0 { (gradient * bound)? } else { gradient };
                let (first, second) = match self.moments.remove(name) {
                    Some(moments) => moments,
                    None => (gradient.zeros_like()?, gradient.zeros_like()?),
                };
                let first = ((first * self.betas.first)? + (&gradient * (1.0 - self.betas.first))?)?;
                let second = ((second * self.betas.second)? + (gradient.sqr()? * (1.0 - self.betas.second))?)?;
                let denominator = ((&second / correction_second)?.sqrt()? + 1e-8)?;
                let rate = group.learning_rate * factor / correction_first;
                variable.set(&variable.as_tensor().sub(&((&first * rate)? / denominator)?)?.detach())?;
                self.moments.insert(name.clone(), (first, second));
            }
        }
        Ok(norms)
    }

    /// State under `prefix`: moments by variable name, and the step.
    pub fn save(&self, prefix: &str, tensors: &mut Tensors) -> Result<()> {
        for (name, (first, second)) in &self.moments {
            tensors.insert(format!("{prefix}.first.{name}"), first.clone());
            tensors.insert(format!("{prefix}.second.{name}"), second.clone());
        }
        tensors.insert(format!("{prefix}.step"), Tensor::new(&[self.step as i64], &candle_core::Device::Cpu)?);
        Ok(())
    }

    /// Reads what [`Self::save`] wrote.
    pub fn load(&mut self, prefix: &str, tensors: &Tensors) -> Result<()> {
        let step_name = format!("{prefix}.step");
        let step = tensors.get(&step_name).ok_or_else(|| Error::shape(step_name, [1], &[]))?;
        self.step = step.flatten_all()?.to_vec1::<i64>()?.first().copied().unwrap_or(0).max(0) as u64;
        self.moments.clear();
        for (name, variable) in self.groups.iter().flat_map(|group| &group.variables) {
            let read = |kind: &str| -> Result<Option<Tensor>> {
                let Some(tensor) = tensors.get(&format!("{prefix}.{kind}.{name}")) else { return Ok(None) };
                if tensor.dims() != variable.dims() {
                    return Err(Error::shape(format!("{prefix}.{kind}.{name}"), variable.dims(), tensor.dims()));
                }
                Ok(Some(tensor.to_device(variable.device())?))
            };
            if let (Some(first), Some(second)) = (read("first")?, read("second")?) {
                self.moments.insert(name.clone(), (first, second));
            }
        }
        Ok(())
    }
}

/// A learning rate's factor over a run: linear rise over `warmup_steps`, constant until `hold` of the run, then a
/// cosine down to `floor`.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Schedule {
    /// Steps of linear rise.
    pub warmup_steps: usize,
    /// Fraction of the run before the cosine begins.
    pub hold: f64,
    /// Factor at the end.
    pub floor: f64,
}

impl Schedule {
    /// The factor at `step` of `total`.
    pub fn factor(&self, step: usize, total: usize) -> f64 {
        let rise = ((step + 1) as f64 / self.warmup_steps.max(1) as f64).min(1.0);
        let progress = step as f64 / total.max(1) as f64;
        if progress < self.hold {
            return rise;
        }
        let fall = ((progress - self.hold) / (1.0 - self.hold).max(1e-9)).min(1.0);
        rise * (self.floor + (1.0 - self.floor) * 0.5 * (1.0 + (std::f64::consts::PI * fall).cos()))
    }
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;

    fn optimiser(variable: &Var) -> Adam {
        let group = Group {
            variables: vec![("x".into(), variable.clone())],
            learning_rate: 0.1,
            largest_gradient_norm: Some(1.0),
        };
        Adam::new(vec![group], Betas { first: 0.9, second: 0.99 })
    }

    fn descend(variable: &Var, adam: &mut Adam, steps: usize) {
        for _ in 0..steps {
            let loss = variable.as_tensor().affine(1.0, -3.0).unwrap().sqr().unwrap().sum_all().unwrap();
            adam.step(&loss.backward().unwrap(), 1.0).unwrap();
        }
    }

    #[test]
    fn it_finds_the_minimum_and_resumes_bit_for_bit() {
        let start = Var::new(&[0f32, 10.0], &Device::Cpu).unwrap();
        let mut adam = optimiser(&start);
        descend(&start, &mut adam, 50);
        let mut saved = Tensors::new();
        adam.save("adam", &mut saved).unwrap();
        let copy = Var::from_tensor(&start.as_tensor().copy().unwrap()).unwrap();
        let mut resumed = optimiser(&copy);
        resumed.load("adam", &saved).unwrap();
        descend(&start, &mut adam, 300);
        descend(&copy, &mut resumed, 300);
        let values = |v: &Var| v.as_tensor().to_vec1::<f32>().unwrap();
        assert_eq!(values(&start), values(&copy));
        assert!(values(&start).iter().all(|x| (x - 3.0).abs() < 0.05), "{:?}", values(&start));
    }

    #[test]
    fn a_gradient_that_is_not_finite_changes_nothing() {
        let variable = Var::new(&[1f32], &Device::Cpu).unwrap();
        let mut adam = optimiser(&variable);
        let loss = (variable.as_tensor() * f64::NAN).unwrap().sum_all().unwrap();
        assert!(adam.step(&loss.backward().unwrap(), 1.0).is_err());
        assert_eq!(variable.as_tensor().to_vec1::<f32>().unwrap(), [1.0]);
    }

    #[test]
    fn the_schedule_rises_holds_and_falls() {
        let schedule = Schedule { warmup_steps: 10, hold: 0.3, floor: 0.03 };
        assert!((schedule.factor(0, 1000) - 0.1).abs() < 1e-12);
        assert_eq!(schedule.factor(200, 1000), 1.0);
        assert!((schedule.factor(1000, 1000) - 0.03).abs() < 1e-9);
    }
}
