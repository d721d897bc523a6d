//! A run's folder: who writes into it, what a run has written there, and what may be removed.
//!
//! A run lists what it writes in `files.txt`, each name before the file is there. Nothing else is ever removed or overwritten: neither what a
//! user has put there, nor what lies under a name that a run would use. The list is locked while a run writes into the folder, by the
//! operating system, which lets go of it however the run ends.

use barchan_core::file::{of_temporary, try_room, write_whole};
use barchan_core::scene::plain;
use barchan_core::{Error, Result};
use std::collections::BTreeSet;
use std::fs::{self, File, TryLockError};
use std::io::{self, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// The list of what a run has written.
const LIST: &str = "files.txt";
/// What a run writes besides numbered files.
const FIXED: [&str; 9] = [
    super::TRACE,
    super::TRACE_ARRAYS,
    super::TRACE_SINCE,
    super::TRACE_PARQUET,
    super::PROBES,
    super::SUMMARY,
    super::SNAPSHOT,
    super::CONTACT_SHEET,
    super::ANIMATION,
];
/// Folders of numbered files, and how those may end.
const NUMBERED: [(&str, &[&str]); 4] = [
    (super::FRAMES, &["png"]),
    (super::PARTICLES, &["ply", "npz", "vtu"]),
    (super::SURFACE, &["ply"]),
    (super::HEIGHT, &["npz", "png"]),
];
/// Folder of what observers write, each into a folder of its own name.
const OBSERVED: &str = "observed";
/// Digits of a number at least.
const DIGITS: usize = 5;

/// What becomes of a run that the output folder holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Existing {
    /// The folder is refused.
    #[default]
    Refuse,
    /// All that it has written is removed.
    Overwrite,
    /// It is gone on with: what it has written up to the simulation's present step is kept.
    Resume,
}

/// A folder that a run writes into, locked for others.
#[derive(Debug)]
pub(super) struct Folder {
    path: PathBuf,
    list: File,
    /// Names of what was written, with slashes.
    written: BTreeSet<String>,
}

/// Says early whether an output folder will be refused since it holds a run.
///
/// # Errors
/// [`Error::Folder`] then.
pub fn check(out: &Path, existing: Existing) -> Result<()> {
    check_list(out)?;
    let listed = match File::open(out.join(LIST)) {
        Ok(mut list) => read_list(out, &mut list)?.names,
        Err(_) => BTreeSet::new(),
    };
    check_content(out, &listed, existing)
}

/// Makes the next numbered folder for output of a scene: `name-001`, `name-002`, … in `parent`.
///
/// # Errors
/// If it cannot be made.
pub fn next(parent: &Path, name: &str) -> Result<PathBuf> {
    make(parent)?;
    let mut number = numbers(parent, name).into_iter().max().unwrap_or(0);
    loop {
        number += 1;
        let path = parent.join(format!("{name}-{number:03}"));
        // Another run may be as fast.
        match fs::create_dir(&path) {
            Ok(()) => return Ok(path),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(source) => return Err(Error::Io { file: path, what: MAKING, source }),
        }
    }
}

/// The last numbered folder of a scene's output that holds a snapshot.
pub fn last(parent: &Path, name: &str) -> Option<PathBuf> {
    let mut numbers = numbers(parent, name);
    numbers.sort_unstable();
    let folders = numbers.into_iter().rev().map(|number| parent.join(format!("{name}-{number:03}")));
    folders.into_iter().find(|folder| folder.join(super::SNAPSHOT).exists())
}

fn numbers(parent: &Path, name: &str) -> Vec<u64> {
    let entries = fs::read_dir(parent).into_iter().flatten().flatten();
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
    names.filter_map(|entry| entry.strip_prefix(name)?.strip_prefix('-')?.parse().ok()).collect()
}

/// The name of the file with which it is tried whether there is room.
const PROBE: &str = "probe";
const UNUSABLE: &str = "this output folder cannot be used (choose another with --out, or make room)";
const MAKING: &str = "this output folder cannot be made (choose another with --out)";

fn make(path: &Path) -> Result<()> {
    fs::create_dir_all(path).map_err(|source| Error::Io { file: path.to_owned(), what: MAKING, source })
}

/// Refuses a folder since something in it is not a run's.
fn foreign(out: &Path, what: String) -> Error {
    let mend = "move it elsewhere, or choose another folder with --out".to_owned();
    Error::Folder { folder: out.to_owned(), what, mend }
}

/// What bears the list's name is a file and no link to one.
fn check_list(out: &Path) -> Result<()> {
    match fs::symlink_metadata(out.join(LIST)) {
        Ok(found) if !found.is_file() => Err(foreign(out, format!("holds {LIST}, which is no file of a run"))),
        _ => Ok(()),
    }
}

/// Opens the list of a folder's files and locks it.
fn lock(out: &Path) -> Result<File> {
    check_list(out)?;
    let path = out.join(LIST);
    let list = File::options().read(true).write(true).create(true).truncate(false).open(&path);
    let list = list.map_err(|source| Error::Io { file: out.to_owned(), what: UNUSABLE, source })?;
    match list.try_lock() {
        Ok(()) => Ok(list),
        Err(TryLockError::WouldBlock) => Err(Error::Folder {
            folder: out.to_owned(),
            what: "is being written into by another run".to_owned(),
            mend: "wait until it has ended, or choose another folder with --out".to_owned(),
        }),
        // Some file systems know no locks: better without than not at all.
        Err(TryLockError::Error(error)) if error.kind() == io::ErrorKind::Unsupported => Ok(list),
        Err(TryLockError::Error(source)) => Err(Error::Io { file: path, what: "locking the output folder", source }),
    }
}

/// What a list holds.
struct Listed {
    names: BTreeSet<String>,
    /// Bytes of whole lines.
    whole: u64,
}

/// Reads a list. A line that was cut off names nothing that is there; one that names what no run writes is somebody else's.
fn read_list(out: &Path, list: &mut File) -> Result<Listed> {
    let mut text = Vec::new();
    let read = list.read_to_end(&mut text);
    read.map_err(|source| Error::Io { file: out.join(LIST), what: "reading the list of a run's files", source })?;
    let text = String::from_utf8_lossy(&text);
    let is_own = |line: &str| match line.strip_suffix('\n') {
        Some(name) => FIXED.contains(&name) || number_of(name).is_some() || is_observed(name),
        None => may_begin(line),
    };
    if let Some(line) = text.split_inclusive('\n').find(|line| !is_own(line)) {
        return Err(foreign(out, format!("holds {LIST}, which no run has written (it has a line '{}')", plain(line))));
    }
    let whole = text.rfind('\n').map_or(0, |end| end + 1);
    Ok(Listed { names: text[..whole].lines().map(str::to_owned).collect(), whole: whole as u64 })
}

/// Characters of names that observers and their files may have.
fn is_plain(c: char) -> bool {
    c.is_ascii_alphanumeric() || "._-".contains(c)
}

/// Is it the name of a file or folder, without a way out of it and not hidden?
fn is_plain_name(name: &str) -> bool {
    !name.is_empty() && name.len() <= 128 && !name.starts_with('.') && name.chars().all(is_plain)
}

/// Is it the name of a file that an observer could have written?
fn is_observed(name: &str) -> bool {
    let mut parts = name.split('/');
    parts.next() == Some(OBSERVED) && parts.clone().count() == 2 && parts.all(is_plain_name)
}

/// The number of a numbered file, if a run could have written one of that name.
fn number_of(name: &str) -> Option<u64> {
    let (folder, file) = name.split_once('/')?;
    let (stem, ending) = file.split_once('.')?;
    let (_, endings) = NUMBERED.iter().find(|(known, _)| *known == folder)?;
    (endings.contains(&ending) && stem.len() >= DIGITS && stem.bytes().all(|c| c.is_ascii_digit()))
        .then(|| stem.parse().ok())
        .flatten()
}

/// Might a name that a run writes begin like that?
fn may_begin(text: &str) -> bool {
    let numbered = |(folder, _): &(&str, _)| match text.strip_prefix(folder) {
        Some(rest) => {
            rest.is_empty()
                || rest.starts_with('/') && rest[1..].bytes().all(|c| c.is_ascii_alphanumeric() || c == b'.')
        }
        None => folder.starts_with(text),
    };
    let observed = match text.strip_prefix(OBSERVED) {
        Some(rest) => {
            rest.is_empty()
                || rest.starts_with('/') && !rest.contains("/.") && rest[1..].chars().all(|c| c == '/' || is_plain(c))
        }
        None => OBSERVED.starts_with(text),
    };
    observed || FIXED.iter().any(|name| name.starts_with(text)) || NUMBERED.iter().any(numbered)
}

/// What lies in a folder under names that a run uses.
fn found(out: &Path) -> Vec<String> {
    let is_there = |name: &str| fs::symlink_metadata(out.join(name)).is_ok();
    let mut found: Vec<String> = FIXED.into_iter().filter(|name| is_there(name)).map(str::to_owned).collect();
    for (folder, _) in NUMBERED {
        let entries = fs::read_dir(out.join(folder)).into_iter().flatten().flatten();
        let names = entries.filter_map(|entry| Some(format!("{folder}/{}", entry.file_name().to_str()?)));
        found.extend(names.filter(|name| number_of(name).is_some()));
    }
    let inside = |path: &Path| fs::read_dir(path).into_iter().flatten().flatten();
    for observer in inside(&out.join(OBSERVED)) {
        let name = |file: &fs::DirEntry| {
            Some(format!("{OBSERVED}/{}/{}", observer.file_name().to_str()?, file.file_name().to_str()?))
        };
        found.extend(inside(&observer.path()).filter_map(|file| name(&file)).filter(|name| is_observed(name)));
    }
    found
}

/// Holds what a folder holds to what is to become of it.
fn check_content(out: &Path, listed: &BTreeSet<String>, existing: Existing) -> Result<()> {
    let found = found(out);
    if existing == Existing::Refuse && !found.is_empty() {
        let mend = "go on with it by --resume, replace it by --overwrite, or choose another folder with --out";
        return Err(Error::Folder {
            folder: out.to_owned(),
            what: format!("holds a run ({})", found[0]),
            mend: mend.to_owned(),
        });
    }
    // What is not listed is somebody else's.
    match found.iter().find(|name| !listed.contains(*name)) {
        Some(name) => Err(foreign(out, format!("holds {name}, which no run that wrote here has listed in {LIST}"))),
        None => Ok(()),
    }
}

impl Folder {
    /// Takes a folder for a run.
    ///
    /// 1. It is made if it is missing, and its list locked: one run writes at a time.
    /// 2. What it holds is held to what is to become of that.
    /// 3. What killed runs have left half written is cleared.
    /// 4. A file as large as the first snapshot (up to 64 MiB) is tried.
    pub(super) fn open(out: &Path, existing: Existing, snapshot: u64) -> Result<Self> {
        let is_new = !out.exists();
        make(out)?;
        let was_listed = out.join(LIST).exists();
        let list = lock(out)?;
        let mut folder = Self { path: out.to_owned(), list, written: BTreeSet::new() };
        let ready = folder.prepare(existing, snapshot);
        if ready.is_err() && !was_listed {
            // As if it had never been asked for. What fails here is of no concern beside what went wrong.
            let _ = fs::remove_file(out.join(LIST));
            let _ = if is_new { fs::remove_dir(out) } else { Ok(()) };
        }
        ready.map(|()| folder)
    }

    fn prepare(&mut self, existing: Existing, snapshot: u64) -> Result<()> {
        let listed = read_list(&self.path, &mut self.list)?;
        self.written = listed.names;
        check_content(&self.path, &self.written, existing)?;
        // What comes next begins a line.
        let cut = self.list.set_len(listed.whole);
        cut.map_err(|source| Error::Io { file: self.join(LIST), what: "listing a file", source })?;
        self.clear_leftovers()?;
        try_room(&self.join(PROBE), snapshot.clamp(1 << 16, 64 << 20) as usize).map_err(|source| Error::Io {
            file: self.path.clone(),
            what: UNUSABLE,
            source,
        })?;
        if existing == Existing::Overwrite { self.remove(|_| true) } else { Ok(()) }
    }

    /// The path of a file in the folder.
    pub(super) fn join(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }

    /// Lists a file that is about to be written, and makes its folder. What lies there and is not the run's own is left alone.
    pub(super) fn claim(&mut self, name: &str) -> Result<PathBuf> {
        let path = self.join(name);
        if self.written.contains(name) {
            return Ok(path);
        }
        if fs::symlink_metadata(&path).is_ok() {
            let source = io::Error::new(io::ErrorKind::AlreadyExists, "it is not this run's, and is left as it is");
            return Err(Error::Io { file: path, what: "writing into the output folder", source });
        }
        if let Some(parent) = path.parent() {
            make(parent)?;
        }
        let written =
            self.list.seek(SeekFrom::End(0)).and_then(|_| self.list.write_all(format!("{name}\n").as_bytes()));
        written.map_err(|source| Error::Io { file: self.join(LIST), what: "listing a file", source })?;
        self.written.insert(name.to_owned());
        Ok(path)
    }

    /// Can it be the name of an observer's folder?
    pub(super) fn is_name(name: &str) -> bool {
        is_plain_name(name) && !name.contains('.')
    }

    /// Lists a file that an observer is about to write.
    pub(super) fn claim_observed(&mut self, observer: &str, file: &str) -> Result<PathBuf> {
        if !is_plain_name(file) {
            return Err(Error::Body {
                path: format!("observer '{observer}'"),
                what: format!("'{}' is no name of a file of its own", plain(file)),
                mend: "use letters, digits, '.', '-' and '_', and no '.' at the beginning".to_owned(),
            });
        }
        self.claim(&format!("{OBSERVED}/{observer}/{file}"))
    }

    /// Writes a file: whole, or not at all.
    pub(super) fn write(
        &mut self,
        name: &str,
        what: &'static str,
        write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
    ) -> Result<()> {
        write_whole(&self.claim(name)?, what, write)
    }

    /// The numbered files of one of its folders that a run has written, in order; those from `end` on are removed.
    pub(super) fn numbered(&mut self, folder: &str, end: u64) -> Result<Vec<PathBuf>> {
        let of = |name: &str| number_of(name).filter(|_| name.split_once('/').is_some_and(|(f, _)| f == folder));
        self.remove(|name| of(name).is_some_and(|number| number >= end))?;
        let mut kept: Vec<_> = self.written.iter().filter_map(|name| Some((of(name)?, self.join(name)))).collect();
        kept.retain(|(_, path)| path.exists());
        kept.sort();
        Ok(kept.into_iter().map(|(_, path)| path).collect())
    }

    /// Removes what a run has written, as far as it is wanted.
    fn remove(&mut self, wanted: impl Fn(&str) -> bool) -> Result<()> {
        let (gone, kept): (BTreeSet<_>, BTreeSet<_>) =
            std::mem::take(&mut self.written).into_iter().partition(|name| wanted(name));
        for name in &gone {
            match fs::remove_file(self.join(name)) {
                Err(source) if source.kind() != io::ErrorKind::NotFound => {
                    return Err(Error::Io { file: self.join(name), what: "removing a file of an older run", source });
                }
                _ => {}
            }
        }
        self.written = kept;
        if gone.is_empty() {
            return Ok(());
        }
        let lines = self.written.iter().fold(String::new(), |lines, name| lines + name + "\n");
        let rewrite = |list: &mut File| -> io::Result<()> {
            list.set_len(0)?;
            list.seek(SeekFrom::Start(0))?;
            list.write_all(lines.as_bytes())
        };
        rewrite(&mut self.list).map_err(|source| Error::Io { file: self.join(LIST), what: "listing a file", source })
    }

    /// Removes what killed runs have left half written: temporary names of files that a run writes.
    fn clear_leftovers(&self) -> Result<()> {
        let folders = NUMBERED.iter().map(|(folder, _)| format!("{folder}/"));
        for folder in folders.chain([String::new()]) {
            for entry in fs::read_dir(self.join(&folder)).into_iter().flatten().flatten() {
                let name = entry.file_name();
                let stands_for = name.to_str().and_then(of_temporary).map(|file| format!("{folder}{file}"));
                let is_ours = |name: &String| self.written.contains(name) || *name == PROBE;
                if stands_for.is_some_and(|name| is_ours(&name)) {
                    let path = entry.path();
                    fs::remove_file(&path).map_err(|source| Error::Io {
                        file: path,
                        what: "clearing what a killed run has left",
                        source,
                    })?;
                }
            }
        }
        Ok(())
    }
}
