//! Checkpoints: everything a run needs to continue as if it had never stopped, in one file, written atomically. The
//! newest few are kept, and the best.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::{
    error::{Error, Result},
    files,
    model::file::{self, Tensors},
    train::config::Stage,
};

const CHECKPOINT_KEY: &str = "cnerf-checkpoint";
/// The best checkpoint lies beside the newest ones under this name.
const BEST: &str = "best.safetensors";

/// What a checkpoint says of itself. Random draws are functions of seed and step, so no generator's state is kept.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CheckpointHeader {
    /// The stage that was running.
    pub stage: Stage,
    /// Its finished steps.
    pub step: usize,
    /// Mean of what the stage calls its error since the checkpoint before; none where it has no such number.
    #[serde(default)]
    pub error: Option<f64>,
}

/// A checkpoint's path, header and content.
pub type Checkpoint = (PathBuf, CheckpointHeader, Tensors);

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
        let text = serde_json::to_string(header).map_err(|error| Error::malformed(&path, error))?;
        file::write_safetensors(&path, tensors, &[(CHECKPOINT_KEY, text)])?;
        if self.is_best(header)? {
            let best = self.folder.join(BEST);
            files::write_atomically(&best, &file::read_bytes(&path)?)?;
        }
        let known = self.list()?;
        for old in &known[..known.len().saturating_sub(self.keep)] {
            std::fs::remove_file(old).map_err(|error| Error::io(old, error))?;
        }
        Ok(path)
    }

    /// Whether a checkpoint's error is the stage's least so far.
    fn is_best(&self, header: &CheckpointHeader) -> Result<bool> {
        let Some(error) = header.error else { return Ok(false) };
        let best = self.best()?.filter(|best| best.1.stage == header.stage).and_then(|best| best.1.error);
        Ok(best.is_none_or(|best| error < best))
    }

    /// The newest checkpoint that can be read whole, if there is one.
    pub fn newest(&self) -> Result<Option<Checkpoint>> {
        for path in self.list()?.into_iter().rev() {
            if let Some(checkpoint) = read(&path)? {
                return Ok(Some(checkpoint));
            }
        }
        Ok(None)
    }

    /// The checkpoint with the least error of the stage that wrote one last, if there is one.
    pub fn best(&self) -> Result<Option<Checkpoint>> {
        let path = self.folder.join(BEST);
        if path.is_file() { read(&path) } else { Ok(None) }
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
            .filter(|path| path.file_name().is_some_and(|name| name != BEST))
            .collect();
        paths.sort();
        Ok(paths)
    }
}

/// A checkpoint, where it lies, and what it says of itself; none if it was cut off.
fn read(path: &Path) -> Result<Option<Checkpoint>> {
    let bytes = file::read_bytes(path)?;
    let Ok((tensors, metadata)) = file::parse_safetensors(path, &bytes) else { return Ok(None) };
    let header = file::header_of(path, &metadata, CHECKPOINT_KEY, "a cnerf checkpoint")?;
    Ok(Some((path.to_owned(), header, tensors)))
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
            let header = CheckpointHeader { stage: Stage::Warmup, step, error: Some((step as f64 - 20.0).abs()) };
            checkpoints.write(step, &header, &tensors).unwrap();
        }
        assert_eq!(checkpoints.best().unwrap().unwrap().1.step, 20);
        assert_eq!(checkpoints.list().unwrap().len(), 2);
        std::fs::write(run.path().join("checkpoints/0000030.safetensors"), b"cut off").unwrap();
        let (_, header, tensors) = checkpoints.newest().unwrap().unwrap();
        assert_eq!(header.step, 20);
        assert_eq!(tensors["x"].to_vec1::<f32>().unwrap(), [20.0]);
        // The next stage's errors are other numbers.
        let header = CheckpointHeader { stage: Stage::Upsampler, step: 1, error: Some(1e3) };
        checkpoints.write(31, &header, &tensors).unwrap();
        assert_eq!(checkpoints.best().unwrap().unwrap().1, header);
    }
}
