//! Files: written completely or not at all, and compared with what they held before.

use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, BufWriter, Read, Write};
use std::path::{Path, PathBuf};

/// How temporary names end. They begin with a dot, and hold the file's own name and the process' number.
const PART: &str = ".part";

/// Writes a file under a temporary name beside `path`, forces it to disk, then renames it. So a half-written file never
/// has the final name. Whatever has the temporary name before is removed, never written through.
///
/// # Errors
/// [`Error::Io`], which names `what` was being done. An older file of that name is then intact.
pub fn write_whole(
    path: &Path,
    what: &'static str,
    write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<()> {
    let part = temporary(path);
    let attempt = || {
        let mut out = BufWriter::new(create_new(&part)?);
        write(&mut out)?;
        out.into_inner().map_err(io::IntoInnerError::into_error)?.sync_all()?;
        fs::rename(&part, path)
    };
    attempt().map_err(|source| {
        // The first error counts; a part that cannot be removed either is left.
        let _ = fs::remove_file(&part);
        Error::Io { file: path.to_owned(), what, source }
    })
}

/// Checks that `bytes` bytes fit on the disk of `path`: they are written under its temporary name, forced to disk, and
/// removed.
///
/// # Errors
/// The file system's error if they do not fit.
pub fn try_room(path: &Path, bytes: usize) -> io::Result<()> {
    let part = temporary(path);
    let attempt = || {
        let mut file = create_new(&part)?;
        file.write_all(&vec![0; bytes])?;
        file.sync_all()
    };
    let tried = attempt();
    let removed = if part.exists() { fs::remove_file(&part) } else { Ok(()) };
    tried.and(removed)
}

/// The name of this process for what is to become `path`.
fn temporary(path: &Path) -> PathBuf {
    let mut name = OsString::from(".");
    name.push(path.file_name().unwrap_or_default());
    name.push(format!(".{}{PART}", std::process::id()));
    path.with_file_name(name)
}

/// Makes a file that was not there, in the place of anything that a process of the same number has left; a link that lies there is
/// removed, not followed.
fn create_new(part: &Path) -> io::Result<File> {
    match fs::remove_file(part) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    File::options().write(true).create_new(true).open(part)
}

/// The file that a temporary name stands for, if it is one of [`write_whole`].
pub fn of_temporary(name: &str) -> Option<&str> {
    let (file, process) = name.strip_prefix('.')?.strip_suffix(PART)?.rsplit_once('.')?;
    (!file.is_empty() && process.parse::<u32>().is_ok()).then_some(file)
}

/// A file's length and checksum when it was read, to tell whether it has changed since.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stamp {
    /// As the scene names it.
    pub file: PathBuf,
    /// Bytes.
    pub length: u64,
    /// CRC-32 of them.
    pub checksum: u32,
}

impl Stamp {
    /// Reads a file that is named relative to a folder.
    ///
    /// # Errors
    /// [`Error::Io`] if it cannot be read.
    pub fn of(folder: &Path, file: &Path) -> Result<Self> {
        let path = folder.join(file);
        let read = || -> io::Result<Self> {
            let (mut reader, mut hasher) = (File::open(&path)?, crc32fast::Hasher::new());
            let (mut length, mut buffer) = (0, vec![0; 1 << 16]);
            loop {
                match reader.read(&mut buffer)? {
                    0 => break,
                    count => {
                        hasher.update(&buffer[..count]);
                        length += count as u64;
                    }
                }
            }
            Ok(Self { file: file.to_owned(), length, checksum: hasher.finalize() })
        };
        read().map_err(|source| Error::Io { file: path.clone(), what: "reading a file of the scene", source })
    }
}

/// The first of some files that holds something else than it did.
///
/// # Errors
/// [`Error::Io`] if one cannot be read.
pub(crate) fn changed(folder: &Path, then: &[Stamp]) -> Result<Option<PathBuf>> {
    for stamp in then {
        if Stamp::of(folder, &stamp.file)? != *stamp {
            return Ok(Some(folder.join(&stamp.file)));
        }
    }
    Ok(None)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_temporary_name_tells_its_file() {
        assert_eq!(of_temporary(".snapshot.barchan.1234.part"), Some("snapshot.barchan"));
        for other in ["snapshot.barchan", ".snapshot.barchan.part", ".x.y.part", "a.1.part", ".1.part", ".part"] {
            assert_eq!(of_temporary(other), None, "{other}");
        }
    }

    /// Symptom: whoever may write into a folder lays a link under the temporary name, and the run overwrites what it leads to.
    #[cfg(unix)]
    #[test]
    fn a_link_under_the_temporary_name_is_not_followed() {
        let folder = tempfile::tempdir().unwrap();
        let (victim, path) = (folder.path().join("victim"), folder.path().join("file"));
        fs::write(&victim, "mine").unwrap();
        std::os::unix::fs::symlink(&victim, folder.path().join(format!(".file.{}.part", std::process::id()))).unwrap();
        write_whole(&path, "writing", |out| out.write_all(b"new")).unwrap();
        assert_eq!([&victim, &path].map(|file| fs::read_to_string(file).unwrap()), ["mine", "new"]);
        assert!(!fs::symlink_metadata(&path).unwrap().is_symlink());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2, "something was left behind");
    }
}
