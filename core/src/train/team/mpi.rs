//! The team that `mpirun` started, over the system's MPI.

use std::cell::RefCell;

use mpi::{
    Threading,
    collective::SystemOperation,
    environment::Universe,
    topology::SimpleCommunicator,
    traits::{Communicator as _, CommunicatorCollectives as _},
};

use super::{Exchange, Share};
use crate::error::{Error, Result};

/// Largest number of values in one message: MPI counts in C's ints.
const MESSAGE: usize = 1 << 24;

/// MPI's world of processes.
pub(super) struct World {
    world: SimpleCommunicator,
    universe: RefCell<Option<Universe>>,
}

impl World {
    /// Joins the world; only the calling thread may talk to it.
    pub(super) fn join() -> Result<Self> {
        let taken = || Error::config("mpi", "is up already, or could not start");
        let (universe, _) = mpi::initialize_with_threading(Threading::Funneled).ok_or_else(taken)?;
        Ok(Self { world: universe.world(), universe: RefCell::new(Some(universe)) })
    }
}

impl Exchange for World {
    fn share(&self) -> Share {
        Share { rank: self.world.rank() as usize, count: self.world.size() as usize }
    }

    fn sum(&self, values: &mut [f32]) -> Result<()> {
        for part in values.chunks_mut(MESSAGE) {
            let own = part.to_vec();
            self.world.all_reduce_into(&own[..], part, SystemOperation::sum());
        }
        Ok(())
    }

    fn finish(&self) {
        drop(self.universe.take());
    }
}

impl Drop for World {
    /// A process that stops early must not finalise: it would wait for the others, and they for it. Without that
    /// `mpirun` sees that it failed and stops them all.
    fn drop(&mut self) {
        std::mem::forget(self.universe.take());
    }
}

#[cfg(test)]
mod tests {
    use std::{process::Command, sync::Arc};

    use super::super::{Team, tests::trained};
    use crate::{
        bench::measure::relative_l2,
        train::{config::Stage, test_data::dataset},
    };

    /// Set in the processes that `mpirun` starts.
    const RANK: &str = "CNERF_TEST_MPI_RANK";

    /// Starts itself twice under `mpirun`; each of the two trains with the other and compares with training alone.
    #[test]
    fn two_ranks_train_as_one_process_with_twice_the_batch() {
        if std::env::var_os(RANK).is_some() {
            return as_rank();
        }
        let name = "train::team::mpi::tests::two_ranks_train_as_one_process_with_twice_the_batch";
        let started = Command::new("mpirun")
            .args(["--allow-run-as-root", "--oversubscribe", "-n", "2"])
            .arg(std::env::current_exe().unwrap())
            .args(["--exact", name, "--nocapture", "--test-threads", "1"])
            .env(RANK, "1")
            .env("RAYON_NUM_THREADS", "1")
            .output();
        let Ok(output) = started else {
            println!("skipped: no mpirun on PATH (apt install openmpi-bin libopenmpi-dev)");
            return;
        };
        let said = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
        assert!(output.status.success(), "{said}");
        println!("{said}");
        assert_eq!(said.matches("as one process").count(), 2, "{said}");
    }

    fn as_rank() {
        let team = Team::from_mpi().unwrap();
        assert_eq!(team.share().count, 2);
        let folder = tempfile::tempdir().unwrap();
        let portraits = dataset(folder.path(), 8);
        for stage in [Stage::Warmup, Stage::Field, Stage::Upsampler] {
            let (values, _) = trained(stage, 4, &portraits, team.clone());
            let (whole, _) = trained(stage, 8, &Arc::clone(&portraits), Team::default());
            let error = relative_l2(&values, &whole);
            // See the same comparison of threads in the module above.
            assert!(error < 1e-3, "{stage:?}: {error}");
        }
        println!("rank {} trains as one process", team.share().rank);
        team.finish();
    }
}
