//! PyTorch checkpoints (`.pt`), read without executing anything in them.
//!
//! A `.pt` file is a stored zip: `NAME/data.pkl` describes nested dicts whose tensors are views of the storages
//! `NAME/data/KEY`. The description is a pickle, that is, a program; [`pickle`] runs it with an allow-list of
//! constructors. Every size is checked against what the archive holds before memory is taken for it.

mod pickle;

use std::{
    collections::HashMap,
    fs::File,
    io::{BufReader, Read, Seek},
    path::Path,
    sync::Arc,
};

use candle_core::{Device, Tensor};
use zip::{
    CompressionMethod, ZipArchive,
    read::{ArchiveOffset, Config},
};

pub use pickle::Key;
use pickle::{Handle, Object, Pickle, StorageReference, TensorView};

use crate::error::{Error, Result};

const MAX_PICKLE_BYTES: u64 = 64 << 20;
const MAX_DEPTH: usize = 64;
const MAX_VALUES: usize = 1 << 18;
const MAX_NAME_BYTES: usize = 1024;
/// Strided tensors are copied; all copies together may hold this many times the bytes of the file, or this many bytes.
const MAX_COPIES_OF_FILE: u64 = 4;
const MAX_COPIED_BYTES: u64 = 64 << 20;

/// What a checkpoint is made of.
#[derive(Clone, Debug)]
pub enum Value {
    /// Python's None.
    None,
    /// A truth value.
    Bool(bool),
    /// An integer.
    Integer(i64),
    /// A float.
    Float(f64),
    /// Text.
    Text(Arc<str>),
    /// A tensor on the CPU in its own element type (f32, f64, f16, bf16, i64, i32, i16, u8; bool becomes u8).
    /// Views of one storage share memory where they are contiguous.
    Tensor(Tensor),
    /// A list or tuple.
    List(Vec<Value>),
    /// A dict or OrderedDict, in its order.
    Dict(Vec<(Key, Value)>),
}

impl Value {
    /// The entry called `name` of a dict.
    pub fn get(&self, name: &str) -> Option<&Value> {
        let Self::Dict(entries) = self else { return None };
        entries.iter().find(|(key, _)| matches!(key, Key::Text(text) if &**text == name)).map(|(_, value)| value)
    }

    /// The tensor, if it is one.
    pub fn tensor(&self) -> Option<&Tensor> {
        if let Self::Tensor(tensor) = self { Some(tensor) } else { None }
    }

    /// All tensors at or below this value with their dotted names, in the file's order. Items of lists are named by
    /// their index. A single tensor has the empty name.
    pub fn flatten(&self) -> Vec<(String, Tensor)> {
        let mut flat = Vec::new();
        self.flatten_into("", &mut flat);
        flat
    }

    // Depth is bounded by MAX_DEPTH, checked when the value was made.
    fn flatten_into(&self, name: &str, flat: &mut Vec<(String, Tensor)>) {
        let below =
            |key: &dyn std::fmt::Display| if name.is_empty() { key.to_string() } else { format!("{name}.{key}") };
        match self {
            Self::Tensor(tensor) => flat.push((name.to_owned(), tensor.clone())),
            Self::List(items) => {
                items.iter().enumerate().for_each(|(index, item)| item.flatten_into(&below(&index), flat));
            }
            Self::Dict(entries) => entries.iter().for_each(|(key, value)| value.flatten_into(&below(key), flat)),
            Self::None | Self::Bool(_) | Self::Integer(_) | Self::Float(_) | Self::Text(_) => {}
        }
    }
}

/// A checkpoint: nested dicts of tensors and plain values.
#[derive(Clone, Debug)]
pub struct Checkpoint {
    /// The whole; for the authors' files a dict of state dicts `{g, gd, sd, g_ema}` or `{g, d, g_ema}`.
    pub root: Value,
}

impl Checkpoint {
    /// The entry called `name` of the outermost dict, e.g. `g_ema`.
    pub fn get(&self, name: &str) -> Option<&Value> {
        self.root.get(name)
    }

    /// All tensors with their dotted names, e.g. `g_ema.renderer.network.0…`, in the file's order.
    pub fn flatten(&self) -> Vec<(String, Tensor)> {
        self.root.flatten()
    }
}

/// Reads a checkpoint in PyTorch's zip format (1.6 and later). Nothing in the file is executed.
///
/// # Errors
/// [`Error::Io`] if the file cannot be read; [`Error::Malformed`] if it is not such a checkpoint, is damaged, exceeds
/// the bounds, or names anything but dicts, tensors and storages (the error says what).
pub fn read_checkpoint(path: impl AsRef<Path>) -> Result<Checkpoint> {
    let path = path.as_ref();
    let file = File::open(path).map_err(|error| Error::io(path, error))?;
    let length = file.metadata().map_err(|error| Error::io(path, error))?.len();
    read(BufReader::new(file), length).map_err(|reason| Error::malformed(path, reason))
}

fn read<R: Read + Seek>(mut reader: R, length: u64) -> pickle::Result<Checkpoint> {
    let mut start = Vec::new();
    (&mut reader).take(4).read_to_end(&mut start).map_err(|error| error.to_string())?;
    if start != *b"PK\x03\x04" {
        return Err("not a PyTorch zip checkpoint; open it in PyTorch ≥ 1.6 and save it again with torch.save".into());
    }
    let mut archive = Archive::open(reader, length)?;
    let program = archive.bytes("data.pkl", MAX_PICKLE_BYTES)?;
    let pickle = pickle::interpret(&program)?;
    let mut resolver =
        Resolver { pickle: &pickle, archive, storages: HashMap::new(), tensors: HashMap::new(), values: 0, copied: 0 };
    Ok(Checkpoint { root: resolver.value(pickle.root, 0, 0)? })
}

/// The zip file, with the folder that all its entries share.
struct Archive<R> {
    zip: ZipArchive<R>,
    folder: String,
    length: u64,
}

impl<R: Read + Seek> Archive<R> {
    fn open(reader: R, length: u64) -> pickle::Result<Self> {
        // Searched for, the directory's start is missed by 76 bytes (zip 9.4) when PyTorch's redundant zip64 record is
        // as long as the first header, which a checkpoint's name of 21 characters makes it.
        let config = Config { archive_offset: ArchiveOffset::Known(0) };
        let mut zip =
            ZipArchive::with_config(config, reader).map_err(|error| format!("{error}; download the file again"))?;
        let folder = zip
            .file_names()
            .filter_map(|name| name.ok()?.strip_suffix("/data.pkl").map(str::to_owned))
            .find(|folder| !folder.contains('/'))
            .ok_or("a zip without NAME/data.pkl: not a PyTorch checkpoint")?;
        if zip.has_overlapping_files().map_err(|error| format!("{error}; download the file again"))? {
            return Err("entries of the zip overlap; the file was tampered with".into());
        }
        let mut archive = Self { zip, folder, length };
        if archive.zip.index_for_name(&format!("{}/byteorder", archive.folder)).is_some()
            && archive.bytes("byteorder", 16)? != b"little"
        {
            return Err("was written on a big-endian machine; save it again on a little-endian one".into());
        }
        Ok(archive)
    }

    /// The bytes of one entry, which must be stored: then the archive is never larger in memory than on disk.
    fn bytes(&mut self, name: &str, limit: u64) -> pickle::Result<Vec<u8>> {
        let entry = self
            .zip
            .by_name(&format!("{}/{name}", self.folder))
            .map_err(|error| format!("entry `{name}`: {error}; the file is damaged"))?;
        if entry.compression() != CompressionMethod::Stored {
            return Err("its entries are compressed, as torch.save never does; save it again with torch.save".into());
        }
        let size = entry.size();
        if size > limit || size > self.length {
            return Err(format!("entry `{name}` claims {size} bytes, more than it may have"));
        }
        let mut bytes = Vec::with_capacity(size as usize);
        let error = |error: std::io::Error| format!("entry `{name}`: {error}; download the file again");
        entry.take(size + 1).read_to_end(&mut bytes).map_err(error)?;
        if bytes.len() as u64 != size {
            return Err(format!("entry `{name}` has {} bytes of its {size}; download the file again", bytes.len()));
        }
        Ok(bytes)
    }
}

/// Turns the pickle's objects into values. Objects may be shared, even (in a malicious file) contain themselves:
/// depth and the number of values are bounded.
struct Resolver<'a, R> {
    pickle: &'a Pickle,
    archive: Archive<R>,
    storages: HashMap<String, (StorageReference, Tensor)>,
    tensors: HashMap<Handle, Tensor>,
    values: usize,
    copied: u64,
}

impl<R: Read + Seek> Resolver<'_, R> {
    fn value(&mut self, handle: Handle, depth: usize, name_bytes: usize) -> pickle::Result<Value> {
        self.values += 1;
        if self.values > MAX_VALUES {
            return Err(format!("holds more than {MAX_VALUES} values; no generator's checkpoint does"));
        }
        if depth > MAX_DEPTH || name_bytes > MAX_NAME_BYTES {
            return Err("its dicts are nested too deeply, or their names are too long".into());
        }
        let pickle = self.pickle;
        Ok(match pickle.objects.get(handle).ok_or("its pickle names an object that is not there")? {
            Object::None => Value::None,
            Object::Bool(value) => Value::Bool(*value),
            Object::Integer(value) => Value::Integer(*value),
            Object::Float(value) => Value::Float(*value),
            Object::Text(text) => Value::Text(Arc::clone(text)),
            Object::Tensor(view) => Value::Tensor(self.tensor(handle, view)?),
            Object::List(items) | Object::Tuple(items) => {
                let values = items.iter().map(|&item| self.value(item, depth + 1, name_bytes + 8));
                Value::List(values.collect::<pickle::Result<_>>()?)
            }
            Object::Dict(dict) => {
                let entries = dict.entries.iter().map(|(key, value)| {
                    let key_bytes = if let Key::Text(text) = key { text.len() } else { 20 };
                    Ok((key.clone(), self.value(*value, depth + 1, name_bytes + key_bytes + 1)?))
                });
                Value::Dict(entries.collect::<pickle::Result<_>>()?)
            }
            Object::Constructor(_) | Object::Storage(_) => {
                return Err("holds a bare storage or constructor where a value should be".into());
            }
        })
    }

    fn tensor(&mut self, handle: Handle, view: &TensorView) -> pickle::Result<Tensor> {
        if let Some(tensor) = self.tensors.get(&handle) {
            return Ok(tensor.clone());
        }
        let elements = view.checked_elements()?;
        let tensor = if elements == 0 {
            Tensor::from_raw_buffer(&[], view.storage.dtype, &view.shape, &Device::Cpu)
        } else if view.is_contiguous() {
            let flat = self.storage(&view.storage)?;
            flat.narrow(0, view.offset, elements).and_then(|flat| flat.reshape(view.shape.as_slice()))
        } else {
            let width = view.storage.dtype.size_in_bytes();
            self.copied = self.copied.saturating_add(elements as u64 * width as u64);
            if self.copied > MAX_COPIES_OF_FILE.saturating_mul(self.archive.length).max(MAX_COPIED_BYTES) {
                return Err("its tensors unfold to far more numbers than it holds; the file is damaged".into());
            }
            let flat = self.storage(&view.storage)?;
            view.indices()
                .and_then(|indices| flat.index_select(&indices, 0))
                .and_then(|flat| flat.reshape(view.shape.as_slice()))
        };
        let tensor = tensor.map_err(|error| error.to_string())?;
        self.tensors.insert(handle, tensor.clone());
        Ok(tensor)
    }

    /// All elements of a storage in one dimension. Read once, then shared.
    fn storage(&mut self, reference: &StorageReference) -> pickle::Result<Tensor> {
        let key = &*reference.key;
        if let Some((known, tensor)) = self.storages.get(key) {
            return if known == reference {
                Ok(tensor.clone())
            } else {
                Err(format!("describes storage {key} in two ways; the file is damaged"))
            };
        }
        if key.is_empty() || key.len() > 20 || !key.bytes().all(|byte| byte.is_ascii_alphanumeric()) {
            return Err("names a storage in a way that PyTorch does not; the file is damaged".into());
        }
        let bytes = self.archive.bytes(&format!("data/{key}"), u64::MAX)?;
        if reference.elements.checked_mul(reference.dtype.size_in_bytes()) != Some(bytes.len()) {
            return Err(format!(
                "storage {key} has {} bytes where {} × {} should be; download the file again",
                bytes.len(),
                reference.elements,
                reference.dtype.as_str()
            ));
        }
        let tensor = Tensor::from_raw_buffer(&bytes, reference.dtype, &[reference.elements], &Device::Cpu)
            .map_err(|error| error.to_string())?;
        self.storages.insert(key.to_owned(), (reference.clone(), tensor.clone()));
        Ok(tensor)
    }
}

impl TensorView {
    /// Number of elements, once it is known that all of them lie within the storage.
    fn checked_elements(&self) -> pickle::Result<usize> {
        let outside = || {
            let Self { storage, offset, shape, strides } = self;
            let elements = storage.elements;
            format!(
                "a tensor of shape {shape:?}, strides {strides:?} and offset {offset} leaves its storage of {elements}"
            )
        };
        let count = self.shape.iter().try_fold(1usize, |count, &size| count.checked_mul(size)).ok_or_else(outside)?;
        if count == 0 {
            return Ok(0);
        }
        let last = self
            .shape
            .iter()
            .zip(&self.strides)
            .try_fold(self.offset, |last, (&size, &stride)| last.checked_add((size - 1).checked_mul(stride)?));
        if last.is_some_and(|last| last < self.storage.elements) { Ok(count) } else { Err(outside()) }
    }

    fn is_contiguous(&self) -> bool {
        let mut expected = 1;
        self.shape.iter().zip(&self.strides).rev().all(|(&size, &stride)| {
            let fits = size == 1 || stride == expected;
            expected *= size;
            fits
        })
    }

    /// Places in the storage of all elements in row order, as an I64 tensor. Only after [`Self::checked_elements`].
    fn indices(&self) -> candle_core::Result<Tensor> {
        let mut places = vec![self.offset as i64];
        for (&size, &stride) in self.shape.iter().zip(&self.strides) {
            places =
                places.iter().flat_map(|place| (0..size).map(move |step| place + (step * stride) as i64)).collect();
        }
        let count = places.len();
        Tensor::from_vec(places, count, &Device::Cpu)
    }
}

#[cfg(test)]
mod tests;
