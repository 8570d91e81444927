//! The files of a dataset by name, whether in a folder or in a zip; readable from several threads at once.

use std::{
    collections::HashSet,
    fs::File,
    io::{self, Read, Seek, SeekFrom},
    path::{Path, PathBuf},
    sync::Arc,
};

use zip::{ZipArchive, result::ZipError};

use crate::{
    data::picture,
    error::{Error, Result},
};

/// Where a dataset's files lie.
#[derive(Debug)]
pub(super) enum Files {
    /// Below a folder.
    Folder(PathBuf),
    /// In an archive whose directory is held in memory.
    Zip {
        /// The archive's own path.
        path: PathBuf,
        /// Cloned for every read: a clone shares the directory and the open file.
        archive: Box<ZipArchive<SharedFile>>,
    },
}

impl Files {
    /// Opens a folder or a zip. Refused: archives with names that leave it, or with one name twice.
    pub(super) fn open(path: &Path) -> Result<Self> {
        let metadata = std::fs::metadata(path).map_err(|error| Error::io(path, error))?;
        if metadata.is_dir() {
            return Ok(Self::Folder(path.to_owned()));
        }
        let file = File::open(path).map_err(|error| Error::io(path, error))?;
        let file = SharedFile { file: Arc::new(file), position: 0, length: metadata.len() };
        let archive = ZipArchive::new(file).map_err(|error| match error {
            ZipError::Io(error) => Error::malformed(path, format!("not a whole zip archive ({error}); copy it again")),
            error => Error::malformed(path, format!("not a dataset folder or a zip archive ({error})")),
        })?;
        if archive.has_duplicate_names() {
            return Err(Error::malformed(path, "the archive holds one name twice; pack it again"));
        }
        let mut seen = HashSet::new();
        for name in archive.file_names() {
            let name = name.map_err(|error| Error::malformed(path, error))?;
            // Escaped: a name may hold a line break, a message may not.
            let refuse = |fault: &str| {
                Error::malformed(path, format!("entry `{}` {fault}; pack the archive again", name.escape_debug()))
            };
            check_name(name.strip_suffix('/').unwrap_or(&name)).map_err(refuse)?;
            if !seen.insert(name.to_lowercase()) {
                return Err(refuse("is there twice"));
            }
        }
        Ok(Self::Zip { path: path.to_owned(), archive: Box::new(archive) })
    }

    /// The path that stands for a file in errors; within a zip as if that were a folder.
    pub(super) fn path_of(&self, name: &str) -> PathBuf {
        match self {
            Self::Folder(path) | Self::Zip { path, .. } => path.join(name),
        }
    }

    /// Whether the file is there.
    pub(super) fn contains(&self, name: &str) -> bool {
        match self {
            Self::Folder(path) => check_name(name).is_ok() && path.join(name).is_file(),
            Self::Zip { archive, .. } => archive.index_for_name(name).is_some(),
        }
    }

    /// Reads a whole file of at most `limit` bytes.
    pub(super) fn read(&self, name: &str, limit: u64) -> Result<Vec<u8>> {
        let shown = self.path_of(&name.escape_debug().to_string());
        check_name(name).map_err(|fault| Error::malformed(&shown, format!("the name {fault}")))?;
        let shown = self.path_of(name);
        let archive = match self {
            Self::Folder(_) => return picture::read_file(&shown, limit),
            Self::Zip { archive, .. } => archive,
        };
        let index = archive.index_for_name(name).ok_or_else(|| {
            Error::io(&shown, io::Error::new(io::ErrorKind::NotFound, "no such entry in the archive"))
        })?;
        let mut reader = ZipArchive::clone(archive);
        let entry = reader.by_index(index).map_err(|error| {
            let remedy = "entries must be stored or deflated, and not encrypted";
            Error::malformed(&shown, format!("{error}; {remedy}"))
        })?;
        // The declared size is only a claim: the read is bounded too.
        let declared = entry.size();
        let mut bytes = Vec::with_capacity(declared.min(limit).min(16 << 20) as usize);
        let damaged = |error| Error::malformed(&shown, format!("{error}; the archive is truncated or damaged"));
        entry.take(limit + 1).read_to_end(&mut bytes).map_err(damaged)?;
        if bytes.len() as u64 > limit || declared > limit {
            let reason = format!("unpacks to more than the {} MiB that are read of such a file", limit >> 20);
            return Err(Error::malformed(&shown, reason));
        }
        Ok(bytes)
    }
}

/// Refuses names that could leave the dataset or mean different files on different systems.
pub(super) fn check_name(name: &str) -> Result<(), &'static str> {
    let drive = name.as_bytes().get(1) == Some(&b':');
    if name.starts_with('/') || drive {
        Err("is absolute")
    } else if name.contains(|character: char| character == '\\' || character.is_control()) {
        Err("has a backslash or a control character")
    } else if name.split('/').any(|part| matches!(part, "" | "." | "..")) {
        Err("has an empty, `.` or `..` part")
    } else {
        Ok(())
    }
}

/// A file that any number of readers share, each with its own position.
#[derive(Clone, Debug)]
pub(super) struct SharedFile {
    file: Arc<File>,
    position: u64,
    length: u64,
}

impl Read for SharedFile {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        #[cfg(unix)]
        let count = std::os::unix::fs::FileExt::read_at(&*self.file, buffer, self.position)?;
        // Moves the file's own cursor too, which nobody uses.
        #[cfg(windows)]
        let count = std::os::windows::fs::FileExt::seek_read(&*self.file, buffer, self.position)?;
        self.position += count as u64;
        Ok(count)
    }
}

impl Seek for SharedFile {
    fn seek(&mut self, target: SeekFrom) -> io::Result<u64> {
        let moved = match target {
            SeekFrom::Start(position) => Some(position),
            SeekFrom::End(offset) => self.length.checked_add_signed(offset),
            SeekFrom::Current(offset) => self.position.checked_add_signed(offset),
        };
        self.position = moved.ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "seek before the start"))?;
        Ok(self.position)
    }
}
