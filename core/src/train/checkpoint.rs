//! Checkpoints: everything a run needs to continue as if it had never stopped, in one file, written atomically.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::{
    error::{Error, Result},
    model::file::{self, Tensors},
    train::config::Stage,
};

const CHECKPOINT_KEY: &str = "cnerf-checkpoint";

/// What a checkpoint says of itself. Random draws are functions of seed and step, so no generator's state is kept.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CheckpointHeader {
    /// The stage that was running.
    pub stage: Stage,
    /// Its finished steps.
    pub step: usize,
}

/// Checkpoints of a run, newest last.
pub struct Checkpoints {
    folder: PathBuf,
    keep: usize,
}

impl Checkpoints {
    /// The checkpoints in `run`/checkpoints, of which the newest `keep` are kept.
    pub fn of(run: &Path, keep: usize) -> Self {
        Self { folder: run.join("checkpoints"), keep: keep.max(1) }
    }

    /// Writes a checkpoint and removes those that are older than the newest `keep`.
    pub fn write(&self, sequence: usize, header: &CheckpointHeader, tensors: &Tensors) -> Result<PathBuf> {
        let path = self.folder.join(format!("{sequence:07}.safetensors"));
        let header = serde_json::to_string(header).map_err(|error| Error::malformed(&path, error))?;
        file::write_safetensors(&path, tensors, &[(CHECKPOINT_KEY, header)])?;
        let known = self.list()?;
        for old in &known[..known.len().saturating_sub(self.keep)] {
            std::fs::remove_file(old).map_err(|error| Error::io(old, error))?;
        }
        Ok(path)
    }

    /// The newest checkpoint that can be read whole, if there is one.
    pub fn newest(&self) -> Result<Option<(PathBuf, CheckpointHeader, Tensors)>> {
        for path in self.list()?.into_iter().rev() {
            let bytes = file::read_bytes(&path)?;
            if let Ok((tensors, metadata)) = file::parse_safetensors(&path, &bytes) {
                let header = file::header_of(&path, &metadata, CHECKPOINT_KEY, "a cnerf checkpoint")?;
                return Ok(Some((path, header, tensors)));
            }
        }
        Ok(None)
    }

    fn list(&self) -> Result<Vec<PathBuf>> {
        let entries = match std::fs::read_dir(&self.folder) {
            Ok(entries) => entries,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(error) => return Err(Error::io(&self.folder, error)),
        };
        let mut paths: Vec<PathBuf> = entries
            .filter_map(|entry| entry.ok().map(|entry| entry.path()))
            .filter(|path| path.extension().is_some_and(|extension| extension == "safetensors"))
            .collect();
        paths.sort();
        Ok(paths)
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Tensor};

    use super::*;

    #[test]
    fn the_newest_are_kept_and_a_damaged_one_is_passed_over() {
        let run = tempfile::tempdir().unwrap();
        let checkpoints = Checkpoints::of(run.path(), 2);
        for step in [10, 20, 30] {
            let tensors = Tensors::from([("x".into(), Tensor::new(&[step as f32], &Device::Cpu).unwrap())]);
            checkpoints.write(step, &CheckpointHeader { stage: Stage::Warmup, step }, &tensors).unwrap();
        }
        assert_eq!(checkpoints.list().unwrap().len(), 2);
        std::fs::write(run.path().join("checkpoints/0000030.safetensors"), b"cut off").unwrap();
        let (_, header, tensors) = checkpoints.newest().unwrap().unwrap();
        assert_eq!(header.step, 20);
        assert_eq!(tensors["x"].to_vec1::<f32>().unwrap(), [20.0]);
    }
}
