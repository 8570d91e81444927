//! Writing files whole or not at all.

use std::{io::Write as _, path::Path};

use tempfile::NamedTempFile;

use crate::error::{Error, Result};

/// Writes `bytes` to a temporary file in the folder of `path`, which is made if need be, and renames it: readers see
/// all of it or nothing, after a power cut too.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    std::fs::create_dir_all(folder).map_err(|error| Error::io(folder, error))?;
    let failed = |error| Error::io(path, error);
    let mut file = NamedTempFile::new_in(folder).map_err(failed)?;
    file.write_all(bytes).map_err(failed)?;
    file.as_file().sync_all().map_err(failed)?;
    publish(file, path)
}

/// Renames a temporary file to `path` with the permissions a plain `File::create` would have given it: temporary files
/// are private to their owner, a result is not.
pub(crate) fn publish(file: NamedTempFile, path: &Path) -> Result<()> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt as _;
        let shared = std::fs::Permissions::from_mode(0o644);
        file.as_file().set_permissions(shared).map_err(|error| Error::io(path, error))?;
    }
    file.persist(path).map_err(|error| Error::io(path, error.error))?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_whole_and_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("made/on/the/way.txt");
        write_atomically(&path, b"first").unwrap();
        write_atomically(&path, b"second").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"second");
        assert_eq!(std::fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
        // A folder in the way: an error, and no temporary file is left.
        let blocked = folder.path().join("made");
        assert!(write_atomically(&blocked, b"x").unwrap_err().to_string().contains("made"));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
