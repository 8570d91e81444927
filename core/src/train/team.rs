//! Processes that train one model together: each takes its share of every batch, and gradients are averaged over all.
//!
//! Random draws are those of the whole batch, made alike by everybody; a process then keeps its rows. So N processes with
//! a batch of b give what one gives with N·b, up to the order of sums. Discriminators compare pictures in groups of four
//! (minibatch deviation), and shares keep those groups whole: there b must be a multiple of four.

use std::{fmt, rc::Rc};

use candle_core::{Device, Tensor, backprop::GradStore};

use crate::{
    error::{Error, Result},
    train::optimiser::Group,
};

#[cfg(feature = "mpi")]
mod mpi;

/// Pictures that a discriminator compares with each other (authors).
const DEVIATION_GROUP: usize = 4;

/// Which process this is, of how many.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Share {
    /// From 0; process 0 writes the run's files.
    pub rank: usize,
    /// Processes.
    pub count: usize,
}

impl Default for Share {
    fn default() -> Self {
        Self { rank: 0, count: 1 }
    }
}

impl Share {
    /// Rows of a whole batch from what the configuration calls a batch: every process takes as many.
    pub fn whole(&self, batch: usize) -> usize {
        batch * self.count
    }

    /// The rows of a whole batch of `whole` that are this process's, ascending.
    pub fn rows(&self, whole: usize) -> Vec<usize> {
        let own = whole / self.count;
        if !own.is_multiple_of(DEVIATION_GROUP) {
            return (self.rank * own..(self.rank + 1) * own).collect();
        }
        // Row i is compared with those congruent to it modulo the number of groups.
        let groups = whole / DEVIATION_GROUP;
        let first = self.rank * groups / self.count;
        let last = (self.rank + 1) * groups / self.count;
        (0..whole).filter(|row| (first..last).contains(&(row % groups))).collect()
    }

    /// This process's rows of a tensor of the whole batch, along its first dimension.
    pub fn of(&self, whole: &Tensor) -> Result<Tensor> {
        if self.count == 1 {
            return Ok(whole.clone());
        }
        let rows: Vec<u32> = self.rows(whole.dim(0)?).into_iter().map(|row| row as u32).collect();
        let count = rows.len();
        Ok(whole.index_select(&Tensor::from_vec(rows, count, whole.device())?, 0)?)
    }

    /// This process's items of a list for the whole batch.
    pub fn pick<T: Clone>(&self, whole: &[T]) -> Vec<T> {
        self.rows(whole.len()).into_iter().filter_map(|row| whole.get(row).cloned()).collect()
    }
}

/// How processes add numbers up.
pub trait Exchange {
    /// This process among all.
    fn share(&self) -> Share;
    /// Replaces `values` by their sums over all processes; everybody calls it with as many, in the same order of calls.
    fn sum(&self, values: &mut [f32]) -> Result<()>;
    /// Ends the exchange well; everybody calls it.
    fn finish(&self) {}
}

/// The processes that train together; by default one alone.
#[derive(Clone, Default)]
pub struct Team {
    exchange: Option<Rc<dyn Exchange>>,
}

impl fmt::Debug for Team {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.share().fmt(formatter)
    }
}

impl Team {
    /// A team that talks through `exchange`.
    pub fn new(exchange: Rc<dyn Exchange>) -> Self {
        Self { exchange: Some(exchange) }
    }

    /// The processes that `mpirun` started; one alone without it.
    ///
    /// # Errors
    /// [`Error::Config`] if MPI is up already.
    #[cfg(feature = "mpi")]
    pub fn from_mpi() -> Result<Self> {
        Ok(Self::new(Rc::new(mpi::World::join()?)))
    }

    /// This process among all.
    pub fn share(&self) -> Share {
        self.exchange.as_ref().map(|exchange| exchange.share()).unwrap_or_default()
    }

    /// Whether this process writes the run's files.
    pub fn leads(&self) -> bool {
        self.share().rank == 0
    }

    /// Whether it is so for any process.
    pub fn any(&self, here: bool) -> Result<bool> {
        let mut votes = [f32::from(u8::from(here))];
        self.sum(&mut votes)?;
        Ok(votes[0] > 0.0)
    }

    /// The mean over all processes, of a tensor that has the same shape in each.
    pub fn mean(&self, tensor: &Tensor) -> Result<Tensor> {
        if self.share().count == 1 {
            return Ok(tensor.clone());
        }
        let mut values = to_vec(tensor)?;
        self.sum(&mut values)?;
        let mean = Tensor::from_vec(values, tensor.shape(), &Device::Cpu)?;
        Ok((mean / self.share().count as f64)?.to_device(tensor.device())?.to_dtype(tensor.dtype())?)
    }

    /// From this process's rows of a mean loss's gradient, those of the whole batch.
    pub fn gather(&self, own: &Tensor) -> Result<Tensor> {
        let share = self.share();
        if share.count == 1 {
            return Ok(own.clone());
        }
        let rows = own.dim(0)?;
        let whole = share.whole(rows);
        let length = own.elem_count() / rows.max(1);
        let mut values = vec![0f32; whole * length];
        for (row, own) in share.rows(whole).into_iter().zip(to_vec(own)?.chunks_exact(length.max(1))) {
            // The loss of a process is a mean over its rows; of all, over all rows.
            let scaled = own.iter().map(|value| value / share.count as f32);
            values[row * length..(row + 1) * length].iter_mut().zip(scaled).for_each(|(to, from)| *to = from);
        }
        self.sum(&mut values)?;
        let mut shape = own.dims().to_vec();
        shape[0] = whole;
        Ok(Tensor::from_vec(values, shape, own.device())?)
    }

    /// The gradients of the groups' variables, in order, as means over all processes; none for one alone.
    pub(super) fn means(&self, groups: &[Group], gradients: &GradStore) -> Result<Option<Vec<Option<Tensor>>>> {
        if self.share().count == 1 {
            return Ok(None);
        }
        let variables = || groups.iter().flat_map(|group| &group.variables).map(|(_, variable)| variable);
        let mut known: Vec<f32> = variables().map(|v| f32::from(u8::from(gradients.get(v).is_some()))).collect();
        self.sum(&mut known)?;
        // One sum for all: a message a tensor would wait for the network each time.
        let mut values = Vec::new();
        for (variable, known) in variables().zip(&known) {
            match gradients.get(variable) {
                Some(gradient) => values.extend(to_vec(gradient)?),
                None if *known > 0.0 => values.resize(values.len() + variable.elem_count(), 0.0),
                None => {}
            }
        }
        self.sum(&mut values)?;
        let (mut means, mut first) = (Vec::new(), 0);
        for (variable, known) in variables().zip(&known) {
            if *known == 0.0 {
                means.push(None);
                continue;
            }
            let own = &values[first..first + variable.elem_count()];
            first += own.len();
            let mean = Tensor::from_slice(own, variable.shape(), &Device::Cpu)?;
            let mean = (mean / self.share().count as f64)?.to_device(variable.device())?;
            means.push(Some(mean.to_dtype(variable.dtype())?));
        }
        Ok(Some(means))
    }

    /// Ends the team's work well. A process that ends without, fails, and the others are stopped.
    pub fn finish(&self) {
        if let Some(exchange) = &self.exchange {
            exchange.finish();
        }
    }

    fn sum(&self, values: &mut [f32]) -> Result<()> {
        match &self.exchange {
            Some(exchange) if exchange.share().count > 1 => exchange.sum(values),
            _ => Ok(()),
        }
    }

    /// The portraits a step of the whole team takes of a set of `available`, none twice.
    pub fn portraits(&self, batch: usize, available: usize) -> Result<usize> {
        let share = self.share();
        let whole = share.whole(batch);
        if share.count == 1 || whole <= available {
            return Ok(whole.min(available));
        }
        let reason = format!("{} processes would take {whole} portraits a step and there are {available}", share.count);
        Err(Error::config("batch", reason))
    }
}

fn to_vec(tensor: &Tensor) -> Result<Vec<f32>> {
    Ok(tensor.detach().to_dtype(candle_core::DType::F32)?.flatten_all()?.to_vec1()?)
}

#[cfg(test)]
pub(crate) mod tests {
    use std::sync::{Arc, Barrier, Mutex};

    use candle_core::DType;

    use super::*;
    use crate::{
        bench::measure::relative_l2,
        data::dataset::Dataset,
        model::{file::Tensors, generator::Generator},
        parameters::Parameters,
        rng::Stream,
        train::{
            config::{Preset, Stage, TrainConfig},
            events::Metrics,
            portrait_codes::PortraitCodes,
            test_data::dataset,
            trainer::{Inputs, Start, begin},
        },
    };

    /// Threads that meet: what processes are, without MPI.
    struct Meeting {
        share: Share,
        sums: Arc<Mutex<Vec<f64>>>,
        barrier: Arc<Barrier>,
    }

    impl Exchange for Meeting {
        fn share(&self) -> Share {
            self.share
        }

        fn sum(&self, values: &mut [f32]) -> Result<()> {
            {
                let mut sums = self.sums.lock().unwrap();
                sums.resize(values.len(), 0.0);
                sums.iter_mut().zip(values.iter()).for_each(|(sum, value)| *sum += f64::from(*value));
            }
            self.barrier.wait();
            values.iter_mut().zip(self.sums.lock().unwrap().iter()).for_each(|(value, sum)| *value = *sum as f32);
            if self.barrier.wait().is_leader() {
                self.sums.lock().unwrap().clear();
            }
            self.barrier.wait();
            Ok(())
        }
    }

    /// What `work` gives in each of `count` processes.
    pub(crate) fn together<T: Send>(count: usize, work: impl Fn(Team) -> T + Sync) -> Vec<T> {
        let (sums, barrier) = (Arc::new(Mutex::new(Vec::new())), Arc::new(Barrier::new(count)));
        std::thread::scope(|scope| {
            let threads: Vec<_> = (0..count)
                .map(|rank| {
                    let (sums, barrier, work) = (Arc::clone(&sums), Arc::clone(&barrier), &work);
                    let share = Share { rank, count };
                    scope.spawn(move || work(Team::new(Rc::new(Meeting { share, sums, barrier }))))
                })
                .collect();
            threads.into_iter().map(|thread| thread.join().unwrap()).collect()
        })
    }

    #[test]
    fn shares_are_a_partition_and_keep_groups_of_four() {
        for (whole, count) in [(16, 2), (24, 3), (6, 2), (3, 3), (8, 1)] {
            let shares: Vec<Vec<usize>> = (0..count).map(|rank| Share { rank, count }.rows(whole)).collect();
            let mut all: Vec<usize> = shares.iter().flatten().copied().collect();
            all.sort_unstable();
            assert_eq!(all, (0..whole).collect::<Vec<_>>());
            for rows in shares.iter().filter(|rows| rows.len().is_multiple_of(4)) {
                let (own, groups) = (rows.len() / 4, whole / 4);
                for (place, row) in rows.iter().enumerate() {
                    // Same group within the share as within the whole batch, in the same order.
                    assert_eq!(rows[place % own] % groups, row % groups);
                }
            }
        }
    }

    #[test]
    fn sums_means_votes_and_rows_come_together() {
        let found = together(2, |team| {
            let own = Tensor::new(&[[1f32 + team.share().rank as f32], [5.0]], &Device::Cpu).unwrap();
            let mean = team.mean(&own).unwrap().to_vec2::<f32>().unwrap();
            let gathered = team.gather(&own).unwrap().to_vec2::<f32>().unwrap();
            (mean, gathered, team.any(team.share().rank == 1).unwrap(), team.any(false).unwrap())
        });
        let expected = (vec![vec![1.5], vec![5.0]], vec![vec![0.5], vec![2.5], vec![1.0], vec![2.5]], true, false);
        assert_eq!(found, [expected.clone(), expected]);
    }

    /// Everything a stage knows after three steps, and the metrics of the last.
    pub(crate) fn trained(stage: Stage, batch: usize, portraits: &Arc<Dataset>, team: Team) -> (Vec<f64>, Metrics) {
        let mut config = TrainConfig::preset(Preset::Tiny);
        config.upsampler.channel_multiplier = 1.0 / 128.0;
        let batch = format!("={batch}");
        let settings = ["warmup.batch", "field.batch", "upsampler.batch"].map(|name| format!("{name}{batch}"));
        let more = ["adversarial=0.1", "discriminator_ahead_steps=0", "random_portraits=0", "perceptual=0"];
        let more = more.map(|setting| format!("upsampler.{setting}"));
        let config = config.with(&[&settings[..], &more[..]].concat()).unwrap();
        let generator = Generator::new(&config.model, &Parameters::fresh(1, DType::F32, &Device::Cpu)).unwrap();
        let noise = Stream::new(4, &[]).normal_tensor(&[16, config.model.field.style_dim], &Device::Cpu).unwrap();
        let start = Start { generator, portrait_codes: Some(PortraitCodes { noise, offsets: None }) };
        let inputs =
            Inputs { dataset: Arc::clone(portraits), perceptual: None, start: None, device: Device::Cpu, team };
        let mut run = begin(stage, &config, &inputs, Some(&start)).unwrap();
        let metrics = (0..3).map(|step| run.step(step).unwrap()).next_back().unwrap();
        let mut tensors = Tensors::new();
        run.save(&mut tensors).unwrap();
        let values = tensors.iter().filter(|(name, _)| !name.contains("adam"));
        let numbers = |tensor: &Tensor| tensor.to_dtype(DType::F64)?.flatten_all()?.to_vec1::<f64>();
        (values.flat_map(|(_, tensor)| numbers(tensor).unwrap()).collect(), metrics)
    }

    #[test]
    fn two_processes_train_as_one_with_twice_the_batch() {
        let folder = tempfile::tempdir().unwrap();
        let portraits = dataset(folder.path(), 8);
        for stage in [Stage::Warmup, Stage::Field, Stage::Upsampler] {
            let (whole, metrics) = trained(stage, 8, &portraits, Team::default());
            let two = together(2, |team| trained(stage, 4, &portraits, team));
            assert!(two[0].0 == two[1].0, "{stage:?}: the processes drifted apart");
            // Adam divides gradients by their size: rounding of a gradient near 0 moves a weight by as much as the
            // gradient of another. A share that saw other rows would be off by a tenth and more.
            let error = relative_l2(&two[0].0, &whole);
            assert!(error < 1e-3, "{stage:?}: {error}");
            for (name, expected) in metrics.0.iter().filter(|(name, _)| !name.ends_with("norm")) {
                let mean = two.iter().filter_map(|(_, metrics)| metrics.get(name)).sum::<f64>() / 2.0;
                assert!((mean - expected).abs() < 1e-3 * expected.abs() + 1e-6, "{stage:?} {name}: {mean} {expected}");
            }
            let (alone, _) = trained(stage, 4, &portraits, Team::default());
            assert!(relative_l2(&alone, &whole) > 10.0 * error, "{stage:?}: the other half of the batch had no effect");
        }
    }
}
