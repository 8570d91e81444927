//! Model files: safetensors with a JSON header that says what the weights are, where they come from, and their hash.
//!
//! Also the reading and writing of safetensors for every other file the suite keeps (checkpoints, portraits):
//! bounded, checked, and written under a temporary name first.

use std::{
    collections::{BTreeMap, HashMap},
    path::Path,
};

use candle_core::{DType, Device, Tensor};
use safetensors::{Dtype as StoredDtype, SafeTensors, tensor::TensorView};
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use crate::{
    config::GeneratorConfig,
    error::{Error, Result},
    files::write_atomically,
};

/// Largest file read into memory; a hostile size is refused before anything is allocated.
const LARGEST_FILE: u64 = 4 << 30;

/// Tensors by name, in name order.
pub type Tensors = BTreeMap<String, Tensor>;

/// What a model file says of itself.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelHeader {
    /// Always 1 today; a reader refuses what it does not know.
    pub version: u32,
    /// What the weights are.
    pub config: GeneratorConfig,
    /// The preset it was trained with, or `imported`.
    pub preset: String,
    /// Where the weights come from: data, steps, command.
    pub provenance: String,
    /// SHA-256 over names, shapes and values; portraits name their model by it.
    pub hash: String,
}

const MODEL_KEY: &str = "cnerf-model";
const MODEL_VERSION: u32 = 1;

/// Writes a model. The hash in `header` is computed here.
pub fn write_model(path: &Path, tensors: &Tensors, header: &ModelHeader) -> Result<ModelHeader> {
    let header = ModelHeader { version: MODEL_VERSION, hash: hash(tensors)?, ..header.clone() };
    write_safetensors(path, tensors, &[(MODEL_KEY, serde_json::to_string(&header).unwrap_or_default())])?;
    Ok(header)
}

/// Reads a model and checks its hash. `name` stands for the file in messages.
pub fn read_model(name: &Path, bytes: &[u8]) -> Result<(ModelHeader, Tensors)> {
    let (tensors, metadata) = parse_safetensors(name, bytes)?;
    let header: ModelHeader = header_of(name, &metadata, MODEL_KEY, "a cnerf model (`cnerf convert` reads .pt files)")?;
    if header.version != MODEL_VERSION {
        return Err(Error::malformed(name, format!("model version {} is not known; update cnerf", header.version)));
    }
    let found = hash(&tensors)?;
    if found != header.hash {
        return Err(Error::malformed(name, "the weights do not match the file's hash; copy or download it again"));
    }
    Ok((header, tensors))
}

/// The JSON value kept under `key`, or an error that says what the file should have been.
pub fn header_of<T: serde::de::DeserializeOwned>(
    name: &Path,
    metadata: &HashMap<String, String>,
    key: &str,
    kind: &str,
) -> Result<T> {
    let text = metadata.get(key).ok_or_else(|| Error::malformed(name, format!("this is not {kind}")))?;
    serde_json::from_str(text).map_err(|error| Error::malformed(name, format!("its header cannot be read: {error}")))
}

/// SHA-256 over names, shapes and little-endian f32 values, in name order.
pub fn hash(tensors: &Tensors) -> Result<String> {
    let mut digest = Sha256::new();
    for (name, tensor) in tensors {
        digest.update((name.len() as u64).to_le_bytes());
        digest.update(name.as_bytes());
        for size in tensor.dims() {
            digest.update((*size as u64).to_le_bytes());
        }
        for value in tensor.flatten_all()?.to_dtype(DType::F32)?.to_vec1::<f32>()? {
            digest.update(value.to_le_bytes());
        }
    }
    Ok(digest.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
}

/// The whole file, if it is of a sane size.
pub fn read_bytes(path: &Path) -> Result<Vec<u8>> {
    let metadata = std::fs::metadata(path).map_err(|error| Error::io(path, error))?;
    if metadata.is_dir() {
        return Err(Error::malformed(path, "this is a folder, not a file"));
    }
    if metadata.len() > LARGEST_FILE {
        return Err(Error::malformed(path, format!("{} bytes is more than cnerf reads (4 GiB)", metadata.len())));
    }
    std::fs::read(path).map_err(|error| Error::io(path, error))
}

/// Tensors and metadata of safetensors bytes. Element types f32, f16, bf16, f64, u8, u32 and i64 are kept.
pub fn parse_safetensors(name: &Path, bytes: &[u8]) -> Result<(Tensors, HashMap<String, String>)> {
    let refuse = |error: &dyn std::fmt::Display| {
        Error::malformed(name, format!("not a whole safetensors file ({error}); copy or download it again"))
    };
    let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(|error| refuse(&error))?;
    let views = SafeTensors::deserialize(bytes).map_err(|error| refuse(&error))?;
    let mut tensors = Tensors::new();
    for (tensor_name, view) in views.tensors() {
        let dtype = match view.dtype() {
            StoredDtype::F32 => DType::F32,
            StoredDtype::F16 => DType::F16,
            StoredDtype::BF16 => DType::BF16,
            StoredDtype::F64 => DType::F64,
            StoredDtype::U8 => DType::U8,
            StoredDtype::U32 => DType::U32,
            StoredDtype::I64 => DType::I64,
            other => return Err(Error::malformed(name, format!("tensor {tensor_name} has type {other:?}"))),
        };
        let tensor = Tensor::from_raw_buffer(view.data(), dtype, view.shape(), &Device::Cpu)?;
        tensors.insert(tensor_name, tensor);
    }
    Ok((tensors, metadata.metadata().clone().unwrap_or_default()))
}

/// Writes tensors and string metadata to a temporary file beside `path` and renames it.
pub fn write_safetensors(path: &Path, tensors: &Tensors, metadata: &[(&str, String)]) -> Result<()> {
    write_atomically(path, &safetensors_bytes(path, tensors, metadata)?)
}

/// Tensors and string metadata as the bytes of a safetensors file; `name` stands for it in messages.
pub fn safetensors_bytes(name: &Path, tensors: &Tensors, metadata: &[(&str, String)]) -> Result<Vec<u8>> {
    let buffers = tensors.iter().map(|(key, tensor)| Ok((key, raw(tensor)?))).collect::<Result<Vec<_>>>()?;
    let views = buffers
        .iter()
        .map(|(key, (dtype, shape, bytes))| {
            let view = TensorView::new(*dtype, shape.clone(), bytes);
            Ok((key.as_str(), view.map_err(|error| Error::malformed(name, error))?))
        })
        .collect::<Result<Vec<_>>>()?;
    let metadata = metadata.iter().map(|(key, value)| ((*key).to_owned(), value.clone())).collect();
    safetensors::serialize(views, Some(metadata)).map_err(|error| Error::malformed(name, error))
}

fn raw(tensor: &Tensor) -> Result<(StoredDtype, Vec<usize>, Vec<u8>)> {
    fn bytes<T: bytemuck::NoUninit>(values: &[T]) -> Vec<u8> {
        bytemuck::cast_slice(values).to_vec()
    }
    let flat = tensor.flatten_all()?;
    let (dtype, data) = match tensor.dtype() {
        DType::F32 => (StoredDtype::F32, bytes(&flat.to_vec1::<f32>()?)),
        DType::F64 => (StoredDtype::F64, bytes(&flat.to_vec1::<f64>()?)),
        DType::U8 => (StoredDtype::U8, flat.to_vec1::<u8>()?),
        DType::U32 => (StoredDtype::U32, bytes(&flat.to_vec1::<u32>()?)),
        DType::I64 => (StoredDtype::I64, bytes(&flat.to_vec1::<i64>()?)),
        DType::F16 => {
            let halves: Vec<u16> = flat.to_vec1::<half::f16>()?.iter().map(|value| value.to_bits()).collect();
            (StoredDtype::F16, bytes(&halves))
        }
        other => return Err(Error::config("dtype", format!("{other:?} tensors are not stored"))),
    };
    Ok((dtype, tensor.dims().to_vec(), data))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> (Tensors, ModelHeader) {
        let tensor = Tensor::new(&[[1f32, -2.5], [0.25, 3.0]], &Device::Cpu).unwrap();
        let half = tensor.to_dtype(DType::F16).unwrap();
        let config = GeneratorConfig {
            field: crate::config::FieldConfig::ours(),
            upsampler: None,
            camera_deviation_rad: [0.3, 0.15],
            samples: 24,
            population: 0,
        };
        let header =
            ModelHeader { version: 1, config, preset: "tiny".into(), provenance: "test".into(), hash: String::new() };
        (Tensors::from([("a.weight".into(), tensor), ("b".into(), half)]), header)
    }

    #[test]
    fn models_round_trip_and_damage_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.safetensors");
        let (tensors, header) = sample();
        let written = write_model(&path, &tensors, &header).unwrap();
        let mut bytes = read_bytes(&path).unwrap();
        let (found, read) = read_model(&path, &bytes).unwrap();
        assert_eq!(found, written);
        assert_eq!(read["b"].dtype(), DType::F16);

        let last = bytes.len() - 1;
        bytes[last] ^= 1;
        assert!(read_model(&path, &bytes).unwrap_err().to_string().contains("hash"));
        let error = read_model(&path, &bytes[..last]).unwrap_err().to_string();
        assert!(error.contains("model.safetensors") && error.contains("not a whole safetensors file"), "{error}");
    }

    #[test]
    fn mutated_files_never_panic() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.safetensors");
        let (tensors, header) = sample();
        write_model(&path, &tensors, &header).unwrap();
        let bytes = read_bytes(&path).unwrap();
        let mut random = crate::rng::Stream::new(1, &[]);
        for _ in 0..2_000 {
            let mut mutated = bytes.clone();
            for _ in 0..=random.below(4) {
                let at = random.below(mutated.len());
                mutated[at] = random.bits() as u8;
            }
            mutated.truncate(mutated.len() - random.below(3) * random.below(mutated.len()) / 2);
            let _ = read_model(&path, &mutated);
        }
    }
}
