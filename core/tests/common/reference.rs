//! Tensors computed with the authors' code, and a table of how far ours are from them.

use std::{
    collections::HashMap,
    path::{Path, PathBuf},
};

use candle_core::{DType, Device, Tensor};
use cnerf_core::{interop::torch::read_checkpoint, model::file};
use serde_json::Value;

/// Relative L2 error asked of values.
pub const VALUES: f64 = 1e-4;
/// Relative L2 error asked of gradients.
pub const GRADIENTS: f64 = 1e-3;

/// One seed of the reference.
pub struct Reference {
    /// `tiny_s0` and so on.
    pub name: String,
    /// The `config` of its JSON file.
    pub config: Value,
    folder: PathBuf,
    tensors: HashMap<String, Tensor>,
}

/// All seeds in `CNERF_REFERENCE`, by default `shared/reference` beside the repository; none, with a word why, if
/// the folder is not there.
pub fn references() -> Vec<Reference> {
    let folder = std::env::var_os("CNERF_REFERENCE")
        .map(PathBuf::from)
        .unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/reference"));
    let Ok(entries) = std::fs::read_dir(&folder) else {
        println!("skipped: no reference at {}; set CNERF_REFERENCE", folder.display());
        return Vec::new();
    };
    let mut names: Vec<String> = entries
        .filter_map(|entry| Some(entry.ok()?.file_name().to_str()?.strip_suffix(".json")?.to_owned()))
        .filter(|name| name.starts_with("tiny_s") && folder.join(format!("{name}.safetensors")).is_file())
        .collect();
    names.sort();
    if names.is_empty() {
        println!("skipped: no tiny_s*.json with its tensors in {}", folder.display());
    }
    names.into_iter().map(|name| Reference::read(&folder, name)).collect()
}

impl Reference {
    fn read(folder: &Path, name: String) -> Self {
        let json = std::fs::read(folder.join(format!("{name}.json"))).unwrap();
        let json: Value = serde_json::from_slice(&json).unwrap();
        let path = folder.join(format!("{name}.safetensors"));
        let (tensors, _) = file::parse_safetensors(&path, &file::read_bytes(&path).unwrap()).unwrap();
        Self { name, config: json["config"].clone(), folder: folder.to_owned(), tensors: tensors.into_iter().collect() }
    }

    /// A whole number of the configuration.
    pub fn number(&self, name: &str) -> usize {
        self.config[name].as_u64().unwrap() as usize
    }

    /// Whether there is such a tensor.
    pub fn has(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    /// An input, in the element type asked for.
    pub fn input(&self, name: &str, dtype: DType) -> Tensor {
        self.tensors.get(name).unwrap_or_else(|| panic!("{}: no {name}", self.name)).to_dtype(dtype).unwrap()
    }

    /// A result in f64: the authors' model in double precision where there is one.
    pub fn expected(&self, name: &str) -> Tensor {
        let double = format!("f64/{name}");
        self.input(if self.has(&double) { &double } else { name }, DType::F64)
    }

    /// Names of tensors that begin with `prefix`, in order.
    pub fn names(&self, prefix: &str) -> Vec<String> {
        let mut names: Vec<String> = self.tensors.keys().filter(|name| name.starts_with(prefix)).cloned().collect();
        names.sort();
        names
    }

    /// The state dict `part` (`g`, `gd`, ...) of `{name}_{file}.pt`.
    pub fn state(&self, file: &str, part: &str) -> HashMap<String, Tensor> {
        let path = self.folder.join(format!("{}_{file}.pt", self.name));
        read_checkpoint(&path).unwrap().get(part).unwrap().flatten().into_iter().collect()
    }
}

/// Errors by group, printed as they come; fails at the end if any was too large.
pub struct Table {
    title: String,
    failures: Vec<String>,
}

impl Table {
    pub fn new(reference: &Reference, title: &str) -> Self {
        Self { title: format!("{} {title}", reference.name), failures: Vec::new() }
    }

    /// Compares one tensor; their shapes must agree.
    pub fn compare(&mut self, group: &str, found: &Tensor, expected: &Tensor, limit: f64) {
        assert_eq!(found.dims(), expected.dims(), "{group}");
        self.compare_all(group, &[(found.clone(), expected.clone())], limit);
    }

    /// Compares a group of tensors as if they were one vector.
    pub fn compare_all(&mut self, group: &str, pairs: &[(Tensor, Tensor)], limit: f64) {
        let (mut off, mut scale, mut worst) = (0.0, 0.0, 0.0f64);
        for (found, expected) in pairs {
            let (found, expected) = (values(found), values(expected));
            assert_eq!(found.len(), expected.len(), "{group}");
            let (mut own_off, mut own_scale) = (0.0, 0.0);
            for (found, expected) in found.iter().zip(&expected) {
                own_off += (found - expected).powi(2);
                own_scale += expected.powi(2);
            }
            if own_scale > 0.0 {
                worst = worst.max((own_off / own_scale).sqrt());
            }
            off += own_off;
            scale += own_scale;
        }
        let error = if scale > 0.0 { (off / scale).sqrt() } else { off.sqrt() };
        let several =
            if pairs.len() > 1 { format!("   ({} tensors, worst {worst:.1e})", pairs.len()) } else { "".into() };
        println!("{:<28} {group:<34} {error:.1e}{several}", self.title);
        // A NaN must fail too.
        if !(error <= limit && worst <= limit) {
            self.failures.push(format!("{group}: {error:.2e} (worst {worst:.2e}) > {limit:.0e}"));
        }
    }

    /// Whether nothing was too far off so far.
    pub fn passes(&self) -> bool {
        self.failures.is_empty()
    }

    pub fn finish(self) {
        assert!(self.failures.is_empty(), "{}: {}", self.title, self.failures.join("; "));
    }
}

fn values(tensor: &Tensor) -> Vec<f64> {
    let tensor = tensor.to_device(&Device::Cpu).unwrap().to_dtype(DType::F64).unwrap();
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}
