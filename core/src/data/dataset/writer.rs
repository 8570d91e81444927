//! Writing a dataset, whole or not at all.

use std::{
    collections::HashSet,
    fs,
    io::{BufWriter, Write as _},
    path::{Path, PathBuf},
};

use serde_json::{Map, Value};
use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

use super::{
    INDEX_NAME,
    files::check_name,
    index::{Entry, Index},
};
use crate::{
    camera::Camera,
    data::{
        labels::LabelMap,
        picture::{self, RgbImage},
    },
    error::{Error, Result},
    files,
};

/// How photos are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PhotoFormat {
    /// Exact.
    Png,
    /// Small; quality 1 to 100.
    Jpeg(u8),
}

/// An item ready to be written; made on any thread, as encoding takes the time.
#[derive(Clone, Debug)]
pub struct EncodedItem {
    image: (&'static str, Vec<u8>),
    mask: Option<Vec<u8>>,
    camera: Option<Camera>,
    extra: Map<String, Value>,
    attachments: Vec<(String, String, Vec<u8>)>,
}

impl EncodedItem {
    /// Encodes a photo and its label map, which must have one size.
    pub fn new(image: &RgbImage, mask: Option<&LabelMap>, camera: Option<Camera>, format: PhotoFormat) -> Result<Self> {
        if let Some(mask) = mask
            && (mask.width(), mask.height()) != image.dimensions()
        {
            let found = [mask.height() as usize, mask.width() as usize];
            return Err(Error::shape("label map", [image.height(), image.width()], &found));
        }
        let image = match format {
            PhotoFormat::Png => ("png", picture::encode_png(image)?),
            PhotoFormat::Jpeg(quality) => ("jpg", picture::encode_jpeg(image, quality)?),
        };
        let mask = mask.map(LabelMap::encode).transpose()?;
        Ok(Self { image, mask, camera, extra: Map::new(), attachments: Vec::new() })
    }

    /// Adds a field to the item's entry.
    #[must_use]
    pub fn with(mut self, field: &str, value: impl Into<Value>) -> Self {
        self.extra.insert(field.to_owned(), value.into());
        self
    }

    /// Adds all these fields to the item's entry.
    #[must_use]
    pub fn with_all(mut self, fields: Map<String, Value>) -> Self {
        self.extra.extend(fields);
        self
    }

    /// Adds a file `KIND/NNNNN.EXTENSION`, named by the entry's field KIND (e.g. `depth`).
    #[must_use]
    pub fn attach(mut self, kind: &str, extension: &str, bytes: Vec<u8>) -> Self {
        self.attachments.push((kind.to_owned(), extension.to_owned(), bytes));
        self
    }
}

enum Target {
    Folder(tempfile::TempDir),
    Zip(Box<ZipWriter<BufWriter<tempfile::NamedTempFile>>>),
}

/// Writes a dataset folder, or a zip if the path ends in `.zip`. Nothing is at the path until [`Self::finish`]; a
/// writer that is dropped leaves nothing.
pub struct DatasetWriter {
    path: PathBuf,
    target: Target,
    overwrite: bool,
    entries: Vec<Entry>,
    names: HashSet<String>,
    extra: Map<String, Value>,
}

impl DatasetWriter {
    /// Starts a dataset at `path`. An existing one is refused unless `overwrite`; a folder that holds files but no
    /// `dataset.json` is always refused.
    pub fn create(path: &Path, overwrite: bool) -> Result<Self> {
        check_target(path, overwrite)?;
        let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
        fs::create_dir_all(parent).map_err(|error| Error::io(parent, error))?;
        let zipped = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("zip"));
        let target = if zipped {
            let file = tempfile::NamedTempFile::new_in(parent).map_err(|error| Error::io(parent, error))?;
            Target::Zip(Box::new(ZipWriter::new(BufWriter::new(file))))
        } else {
            Target::Folder(tempfile::TempDir::new_in(parent).map_err(|error| Error::io(parent, error))?)
        };
        let (entries, names) = (Vec::new(), HashSet::new());
        Ok(Self { path: path.to_owned(), target, overwrite, entries, names, extra: Map::new() })
    }

    /// Adds a field beside `labels` and `items`.
    pub fn set(&mut self, field: &str, value: impl Into<Value>) {
        self.extra.insert(field.to_owned(), value.into());
    }

    /// Number of items so far.
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Whether there is no item yet.
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// Adds an item under the next number.
    pub fn add(&mut self, item: EncodedItem) -> Result<()> {
        let number = format!("{:05}", self.entries.len());
        let image = format!("images/{number}.{}", item.image.0);
        self.write(&image, &item.image.1)?;
        let mask = match item.mask {
            Some(bytes) => {
                let name = format!("masks/{number}.png");
                self.write(&name, &bytes)?;
                Some(name)
            }
            None => None,
        };
        let mut extra = item.extra;
        for (kind, extension, bytes) in item.attachments {
            let name = format!("{kind}/{number}.{extension}");
            self.write(&name, &bytes)?;
            extra.insert(kind, name.into());
        }
        self.entries.push(Entry { image, mask, camera: item.camera, extra });
        Ok(())
    }

    /// Writes the index and puts the dataset in its place.
    pub fn finish(mut self) -> Result<()> {
        let index = Index::write(&self.entries, &self.extra);
        self.write(INDEX_NAME, &index)?;
        // Somebody may have made one meanwhile.
        check_target(&self.path, self.overwrite)?;
        let path = &self.path;
        match self.target {
            Target::Zip(writer) => {
                let writer = writer.finish().map_err(|error| Error::io(path, error.into()))?;
                let file = writer.into_inner().map_err(|error| Error::io(path, error.into_error()))?;
                files::publish(file, path)
            }
            Target::Folder(folder) => {
                #[cfg(unix)]
                {
                    use std::os::unix::fs::PermissionsExt as _;
                    let shared = fs::Permissions::from_mode(0o755);
                    fs::set_permissions(folder.path(), shared).map_err(|error| Error::io(path, error))?;
                }
                // The old set moves aside first, and is deleted only once the new one is in place.
                let parent = folder.path().parent().unwrap_or(Path::new("."));
                let aside = tempfile::TempDir::new_in(parent).map_err(|error| Error::io(path, error))?;
                if path.exists() {
                    fs::rename(path, aside.path().join("old")).map_err(|error| Error::io(path, error))?;
                }
                fs::rename(folder.path(), path).map_err(|error| Error::io(path, error))?;
                let _moved = folder.keep();
                Ok(())
            }
        }
    }

    fn write(&mut self, name: &str, bytes: &[u8]) -> Result<()> {
        let shown = self.path.join(name);
        check_name(name).map_err(|fault| Error::malformed(&shown, format!("the name {fault}")))?;
        if !self.names.insert(name.to_owned()) {
            return Err(Error::malformed(&shown, "the dataset holds this name already"));
        }
        match &mut self.target {
            Target::Folder(folder) => {
                let path = folder.path().join(name);
                if let Some(parent) = path.parent() {
                    fs::create_dir_all(parent).map_err(|error| Error::io(&shown, error))?;
                }
                fs::write(&path, bytes).map_err(|error| Error::io(&shown, error))
            }
            Target::Zip(writer) => {
                // Pictures are compressed already: stored entries are read at random without inflating. A fixed
                // date makes the same content the same bytes.
                let options = SimpleFileOptions::default()
                    .compression_method(CompressionMethod::Stored)
                    .last_modified_time(zip::DateTime::default())
                    .unix_permissions(0o644);
                writer.start_file(name, options).map_err(|error| Error::io(&shown, error.into()))?;
                writer.write_all(bytes).map_err(|error| Error::io(&shown, error))
            }
        }
    }
}

fn check_target(path: &Path, overwrite: bool) -> Result<()> {
    let Ok(metadata) = fs::metadata(path) else { return Ok(()) };
    let empty_folder = metadata.is_dir() && fs::read_dir(path).is_ok_and(|mut entries| entries.next().is_none());
    if empty_folder {
        return Ok(());
    }
    if !overwrite {
        return Err(Error::malformed(path, "exists already; give another path, or --overwrite to replace it"));
    }
    if metadata.is_dir() && !path.join(INDEX_NAME).is_file() {
        return Err(Error::malformed(
            path,
            format!("holds files but no {INDEX_NAME}; it is not replaced: remove it yourself"),
        ));
    }
    Ok(())
}
