//! The portrait file, `.cnerf`: one safetensors file with everything that makes a photo an editable 3D portrait.
//!
//! | tensor | type, shape | what |
//! | --- | --- | --- |
//! | `codes` | f32 `[9, 2, D]` | shape and texture code of every region |
//! | `upsampler_code` | f32 `[L]` | the global code, for upsamplers that have one |
//! | `delta.NAME` | f16, the weight's shape | what tuning added to the model's weight NAME, divided by its scale |
//! | `noise.N` | f32 | noise images of an upsampler that has them |
//! | `tint` | f32 `[9, 3]` | what edits added to the colour of every region, if they did |
//! | `thumbnail` | u8 `[bytes]` | a PNG |
//! | `undo.N.codes`, `undo.N.upsampler_code`, `undo.N.tint` | f32 | what edit N changed, as it was before |
//!
//! All else is the JSON header in `__metadata__`. The model is named by its hash: weights are stored as differences
//! to it, so that a file stays well under 2 MB.

mod delta;

use std::{
    collections::BTreeMap,
    io::Cursor,
    path::{Path, PathBuf},
};

use candle_core::{DType, Device, Tensor};
use cnerf_core::{
    camera::{CAMERA_PARAMETERS, Camera},
    model::file::{self, Tensors},
    region::REGION_COUNT,
};
use image::{ImageFormat, RgbImage};
use serde::{Deserialize, Serialize};

pub use self::delta::Deltas;
use crate::{
    align::CropTransform,
    config::InvertConfig,
    edit::Edit,
    error::{Error, Result},
};

/// The header's key in the file's metadata.
const HEADER_KEY: &str = "cnerf-portrait";
/// The format's version; a reader refuses what it does not know.
const VERSION: u32 = 1;
/// Largest portrait file read, bytes: the largest model's deltas and a long history fit many times over.
const LARGEST_FILE: u64 = 512 << 20;
/// Longest code row.
const LARGEST_STYLE_DIM: usize = 4096;
/// Largest part of a tint, colours in [-1, 1].
pub(crate) const LARGEST_TINT: f32 = 2.0;
/// Width and height of a thumbnail that is read, pixels.
const LARGEST_THUMBNAIL: u32 = 1024;

/// The model a portrait's weights are differences to.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelName {
    /// What the user called it: `portrait`, `cartoon` or a path.
    pub name: String,
    /// Its hash, see [`file::hash`].
    pub hash: String,
}

/// How well the portrait shows its photo. Pictures are compared at the model's output resolution.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Metrics {
    /// Peak signal-to-noise ratio, dB.
    pub psnr: f64,
    /// Multi-scale structural similarity, in [0, 1].
    pub ms_ssim: f64,
    /// LPIPS, if a weight file was given.
    pub lpips: Option<f64>,
    /// Mean intersection over union of the region masks, if the photo's are known.
    pub mask_miou: Option<f64>,
    /// PSNR of the pivot, before tuning, dB.
    pub pivot_psnr: f64,
    /// Mean absolute difference between the tuned portrait's depth and the pivot's at two off-views, world units.
    pub depth_drift: f64,
    /// Optimiser steps on codes and camera.
    pub steps_pivot: usize,
    /// Optimiser steps on weights.
    pub steps_tune: usize,
    /// Wall time, seconds. Not in the file: the same photo and seed give the same bytes.
    #[serde(skip_serializing)]
    pub seconds: f64,
}

/// An edit that led to the portrait as it is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EditRecord {
    /// What was asked for.
    pub edit: Edit,
    /// What it changed.
    pub change: crate::edit::Change,
}

/// Codes as they were before an edit.
#[derive(Clone, Debug)]
pub struct Undo {
    /// `[9, 2, D]`.
    pub codes: Tensor,
    /// `[L]`.
    pub upsampler_code: Option<Tensor>,
    /// `[9, 3]`.
    pub tint: Option<Tensor>,
}

/// A portrait: a photo brought into a model's space.
#[derive(Clone, Debug)]
pub struct Portrait {
    /// The model it belongs to.
    pub model: ModelName,
    /// The photo it was made from, as it was called.
    pub source: String,
    /// Where the photo was cut.
    pub crop: Option<CropTransform>,
    /// Codes `[9, 2, D]`, f32.
    pub codes: Tensor,
    /// The upsampler's global code `[L]`, f32, if it has one.
    pub upsampler_code: Option<Tensor>,
    /// What edits add to the colour of every region's field, `[9, 3]`, f32, colours in [-1, 1].
    pub tint: Option<Tensor>,
    /// The camera that saw the photo.
    pub camera: Camera,
    /// Tuned weights as differences.
    pub deltas: Deltas,
    /// The upsampler's noise images, if it has any of its own.
    pub noise: Vec<Tensor>,
    /// A small picture of the portrait.
    pub thumbnail: RgbImage,
    /// How it was made.
    pub config: InvertConfig,
    /// How well it turned out.
    pub metrics: Metrics,
    /// Edits, oldest first, each with the codes before it.
    pub history: Vec<(EditRecord, Undo)>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    version: u32,
    model: ModelName,
    source: String,
    crop: Option<CropTransform>,
    camera: Camera,
    config: InvertConfig,
    metrics: Metrics,
    delta_scales: BTreeMap<String, f32>,
    history: Vec<EditRecord>,
}

impl Portrait {
    /// Writes the portrait under a temporary name and renames it to `path`.
    pub fn save(&self, path: &Path) -> Result<()> {
        let (mut tensors, delta_scales) = self.deltas.stored()?;
        tensors.insert("codes".into(), self.codes.to_dtype(DType::F32)?.contiguous()?);
        if let Some(code) = &self.upsampler_code {
            tensors.insert("upsampler_code".into(), code.to_dtype(DType::F32)?.contiguous()?);
        }
        if let Some(tint) = &self.tint {
            tensors.insert("tint".into(), tint.to_dtype(DType::F32)?.contiguous()?);
        }
        for (index, noise) in self.noise.iter().enumerate() {
            tensors.insert(format!("noise.{index}"), noise.to_dtype(DType::F32)?.contiguous()?);
        }
        for (index, (_, undo)) in self.history.iter().enumerate() {
            tensors.insert(format!("undo.{index}.codes"), undo.codes.to_dtype(DType::F32)?.contiguous()?);
            if let Some(code) = &undo.upsampler_code {
                tensors.insert(format!("undo.{index}.upsampler_code"), code.to_dtype(DType::F32)?.contiguous()?);
            }
            if let Some(tint) = &undo.tint {
                tensors.insert(format!("undo.{index}.tint"), tint.to_dtype(DType::F32)?.contiguous()?);
            }
        }
        let mut png = Cursor::new(Vec::new());
        self.thumbnail.write_to(&mut png, ImageFormat::Png).map_err(|error| Error::malformed(path, error))?;
        tensors.insert("thumbnail".into(), Tensor::new(png.into_inner(), &Device::Cpu)?);
        let header = Header {
            version: VERSION,
            model: self.model.clone(),
            source: self.source.clone(),
            crop: self.crop,
            camera: self.camera,
            config: self.config.clone(),
            metrics: self.metrics.clone(),
            delta_scales,
            history: self.history.iter().map(|(record, _)| record.clone()).collect(),
        };
        let text = serde_json::to_string(&header).map_err(|error| Error::malformed(path, error))?;
        Ok(file::write_safetensors(path, &tensors, &[(HEADER_KEY, text)])?)
    }

    /// Reads a portrait. Everything is checked: no name, shape, type or number that this version does not write is
    /// accepted. Errors name the file.
    pub fn load(path: &Path) -> Result<Self> {
        let size = std::fs::metadata(path).map_err(|error| Error::io(path, error))?.len();
        if size > LARGEST_FILE {
            return Err(Error::malformed(path, format!("{size} bytes is more than a portrait holds")));
        }
        Self::parse(path, &file::read_bytes(path)?)
    }

    /// A portrait from a file's bytes; `path` stands for the file in messages.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self> {
        let (mut tensors, metadata) = file::parse_safetensors(path, bytes)?;
        let kind = "a portrait; `cnerf invert` makes one from a photo";
        let header: Header = file::header_of(path, &metadata, HEADER_KEY, kind)?;
        if header.version != VERSION {
            let reason = format!("portrait version {} is not known; update cnerf", header.version);
            return Err(Error::malformed(path, reason));
        }
        check_camera(path, &header.camera)?;
        let mut reader = Reader { path, tensors: &mut tensors };
        let codes = reader.codes("codes", None)?;
        let upsampler_code = reader.optional_row("upsampler_code")?;
        let tint = reader.tint("tint")?;
        let thumbnail = reader.thumbnail()?;
        let mut history = Vec::with_capacity(header.history.len().min(1 << 16));
        for (index, record) in header.history.into_iter().enumerate() {
            let codes = reader.codes(&format!("undo.{index}.codes"), Some(codes.dims()))?;
            let upsampler_code = reader.optional_row(&format!("undo.{index}.upsampler_code"))?;
            let tint = reader.tint(&format!("undo.{index}.tint"))?;
            history.push((record, Undo { codes, upsampler_code, tint }));
        }
        let noise = reader.noise()?;
        let deltas = Deltas::from_stored(path, reader.tensors, &header.delta_scales)?;
        if let Some(name) = tensors.keys().next() {
            return Err(Error::malformed(path, format!("holds a tensor `{name}` that no portrait has")));
        }
        Ok(Self {
            model: header.model,
            source: header.source,
            crop: header.crop,
            codes,
            upsampler_code,
            tint,
            camera: header.camera,
            deltas,
            noise,
            thumbnail,
            config: header.config,
            metrics: header.metrics,
            history,
        })
    }

    /// Refuses a model that is not the one this portrait (read from `path`) was made with.
    pub fn check_model(&self, path: &Path, hash: &str) -> Result<()> {
        if self.model.hash == hash {
            return Ok(());
        }
        Err(Error::WrongModel {
            path: path.to_owned(),
            name: self.model.name.clone(),
            wanted: short(&self.model.hash),
            found: short(hash),
        })
    }

    /// Takes back the last edit; `path` stands for the portrait in messages.
    pub fn undo(&mut self, path: &Path) -> Result<EditRecord> {
        let (record, before) = self.history.pop().ok_or_else(|| Error::NothingToUndo { path: PathBuf::from(path) })?;
        self.codes = before.codes;
        self.upsampler_code = before.upsampler_code;
        self.tint = before.tint;
        Ok(record)
    }
}

/// Enough of a hash to tell models apart by eye.
fn short(hash: &str) -> String {
    hash.chars().take(12).collect()
}

fn check_camera(path: &Path, camera: &Camera) -> Result<()> {
    let parameters: [f64; CAMERA_PARAMETERS] = camera.parameters();
    let sane = parameters.iter().all(|value| value.is_finite() && value.abs() < 100.0)
        && (1e-3..3.0).contains(&camera.field_of_view_rad);
    if sane { Ok(()) } else { Err(Error::malformed(path, "its camera has values no camera has")) }
}

/// Takes checked tensors out of a file, so that what is left is what does not belong.
struct Reader<'a> {
    path: &'a Path,
    tensors: &'a mut Tensors,
}

impl Reader<'_> {
    fn refuse<T>(&self, reason: impl std::fmt::Display) -> Result<T> {
        Err(Error::malformed(self.path, reason))
    }

    fn take(&mut self, name: &str, dtype: DType) -> Result<Option<Tensor>> {
        let Some(tensor) = self.tensors.remove(name) else { return Ok(None) };
        if tensor.dtype() != dtype {
            return self.refuse(format!("tensor `{name}` has type {:?}, not {dtype:?}", tensor.dtype()));
        }
        if dtype == DType::F32 && !all_finite(&tensor)? {
            return self.refuse(format!("tensor `{name}` has values that are not finite"));
        }
        Ok(Some(tensor))
    }

    fn codes(&mut self, name: &str, expected: Option<&[usize]>) -> Result<Tensor> {
        let Some(codes) = self.take(name, DType::F32)? else {
            return self.refuse(format!("tensor `{name}` is missing"));
        };
        let sound = match (codes.dims(), expected) {
            (found, Some(expected)) => found == expected,
            ([REGION_COUNT, 2, style_dim], None) => (1..=LARGEST_STYLE_DIM).contains(style_dim),
            _ => false,
        };
        if sound { Ok(codes) } else { self.refuse(format!("tensor `{name}` has shape {:?}", codes.dims())) }
    }

    fn optional_row(&mut self, name: &str) -> Result<Option<Tensor>> {
        match self.take(name, DType::F32)? {
            Some(row) if row.rank() != 1 || row.elem_count() > LARGEST_STYLE_DIM => {
                self.refuse(format!("tensor `{name}` has shape {:?}", row.dims()))
            }
            row => Ok(row),
        }
    }

    fn tint(&mut self, name: &str) -> Result<Option<Tensor>> {
        let Some(tint) = self.take(name, DType::F32)? else { return Ok(None) };
        let bounded = tint.flatten_all()?.to_vec1::<f32>()?.iter().all(|value| value.abs() <= LARGEST_TINT);
        if tint.dims() != [REGION_COUNT, 3] || !bounded {
            return self.refuse(format!("tensor `{name}` has shape {:?} or values no colour has", tint.dims()));
        }
        Ok(Some(tint))
    }

    fn noise(&mut self) -> Result<Vec<Tensor>> {
        let mut images = Vec::new();
        while let Some(image) = self.take(&format!("noise.{}", images.len()), DType::F32)? {
            if image.rank() != 4 {
                return self.refuse(format!("tensor `noise.{}` has shape {:?}", images.len(), image.dims()));
            }
            images.push(image);
        }
        Ok(images)
    }

    fn thumbnail(&mut self) -> Result<RgbImage> {
        let Some(bytes) = self.take("thumbnail", DType::U8)? else {
            return self.refuse("tensor `thumbnail` is missing");
        };
        let bytes = bytes.flatten_all()?.to_vec1::<u8>()?;
        let mut reader = image::ImageReader::with_format(Cursor::new(bytes), ImageFormat::Png);
        let mut limits = image::Limits::default();
        (limits.max_image_width, limits.max_image_height) = (Some(LARGEST_THUMBNAIL), Some(LARGEST_THUMBNAIL));
        reader.limits(limits);
        match reader.decode() {
            Ok(picture) => Ok(picture.into_rgb8()),
            Err(error) => self.refuse(format!("its thumbnail is no picture ({error})")),
        }
    }
}

/// Whether every value of an f32 tensor is a number.
fn all_finite(tensor: &Tensor) -> Result<bool> {
    Ok(tensor.flatten_all()?.to_vec1::<f32>()?.iter().all(|value| value.is_finite()))
}

#[cfg(test)]
mod tests;
