//! Reading scenes: TOML text, overrides, and errors that know file, line and key path.

use super::plane::complete;
use super::{Scene, Time};
use crate::{Error, Result, snapshot};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;
use toml::Value;
use toml::de::{DeTable, DeValue, ValueDeserializer};

/// What errors about overrides name as their file.
const SET: &str = "--set";

/// Where the keys of a scene stand.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Source {
    file: String,
    /// Line by key path; `None`: the value came from `--set`.
    lines: BTreeMap<String, Option<usize>>,
    /// Overrides, in their order.
    overrides: Vec<String>,
}

impl Source {
    fn of(file: &str, text: &str, table: &DeTable<'_>) -> Self {
        let mut source = Self { file: file.to_owned(), ..Self::default() };
        source.note_table(&Lines::of(text), "", table);
        source
    }

    fn note_table(&mut self, lines: &Lines, path: &str, table: &DeTable<'_>) {
        for (key, value) in table {
            let path = if path.is_empty() { key.get_ref().to_string() } else { format!("{path}.{}", key.get_ref()) };
            self.lines.insert(path.clone(), Some(lines.at(key.span().start)));
            self.note_value(lines, &path, value.get_ref());
        }
    }

    fn note_value(&mut self, lines: &Lines, path: &str, value: &DeValue<'_>) {
        match value {
            DeValue::Table(table) => self.note_table(lines, path, table),
            DeValue::Array(items) => {
                for (i, item) in items.iter().enumerate() {
                    let path = format!("{path}[{i}]");
                    self.lines.insert(path.clone(), Some(lines.at(item.span().start)));
                    self.note_value(lines, &path, item.get_ref());
                }
            }
            _ => {}
        }
    }

    /// File and line of a key path, or of the nearest key above it that is written down.
    fn place(&self, path: &str) -> (&str, usize) {
        let mut path = path;
        loop {
            match self.lines.get(path) {
                Some(Some(line)) => return (&self.file, *line),
                Some(None) => return (SET, 0),
                None => match path.rfind(['.', '[']) {
                    Some(cut) => path = &path[..cut],
                    None => return (&self.file, 0),
                },
            }
        }
    }

    /// An override of something below a key path.
    fn overridden_below(&self, path: &str) -> Option<&str> {
        let is_below = |known: &str| known.strip_prefix(path).is_some_and(|rest| rest.starts_with(['.', '[']));
        self.lines.iter().find(|(known, line)| line.is_none() && is_below(known)).map(|(known, _)| known.as_str())
    }

    /// Notes that everything at `path` now comes from an override.
    fn overridden(&mut self, path: &str) {
        self.lines.retain(|known, _| !known.strip_prefix(path).is_some_and(|rest| rest.starts_with(['.', '['])));
        self.lines.insert(path.to_owned(), None);
    }
}

/// Line numbers of a text.
struct Lines(Vec<usize>);

impl Lines {
    fn of(text: &str) -> Self {
        Self(text.bytes().enumerate().filter(|(_, b)| *b == b'\n').map(|(i, _)| i).collect())
    }
    /// Line of a byte, from 1.
    fn at(&self, byte: usize) -> usize {
        self.0.partition_point(|&end| end < byte) + 1
    }
}

/// A file's text; a snapshot in its place is told by what it is.
fn read_text(path: &Path) -> std::io::Result<String> {
    let refuse = |what: &str| std::io::Error::new(std::io::ErrorKind::InvalidData, what);
    let bytes = std::fs::read(path)?;
    if bytes.starts_with(snapshot::MAGIC) {
        return Err(refuse("this is a snapshot of a run: go on from it with --resume=FILE, or name a scene"));
    }
    String::from_utf8(bytes).map_err(|_| refuse("it is no text in UTF-8: name a scene in TOML"))
}

impl Scene {
    /// Reads and checks a scene file.
    ///
    /// # Errors
    /// [`Error::Io`] if it cannot be read, [`Error::Scene`] if it cannot be used.
    pub fn from_file(path: impl AsRef<Path>) -> Result<Self> {
        Self::from_file_with(path, &[] as &[&str])
    }

    /// Reads a scene file, applies overrides such as `world.cell=0.02`, and checks the result; see [`set`](Self::set).
    ///
    /// # Errors
    /// As [`from_file`](Self::from_file).
    pub fn from_file_with(path: impl AsRef<Path>, overrides: &[impl AsRef<str>]) -> Result<Self> {
        let path = path.as_ref();
        let text =
            read_text(path).map_err(|source| Error::Io { file: path.to_owned(), what: "reading the scene", source })?;
        let folder = path.parent().unwrap_or(Path::new(""));
        Self::from_str_with(&text, &path.display().to_string(), folder, overrides)
    }

    /// Reads and checks a scene from TOML text. `file_name` is for messages; relative paths start from `folder`.
    ///
    /// # Errors
    /// [`Error::Scene`] if it cannot be used.
    pub fn from_str(text: &str, file_name: &str, folder: impl AsRef<Path>) -> Result<Self> {
        Self::from_str_with(text, file_name, folder, &[] as &[&str])
    }

    /// As [`from_str`](Self::from_str), with overrides applied before anything is checked.
    ///
    /// # Errors
    /// As there.
    pub fn from_str_with(
        text: &str,
        file_name: &str,
        folder: impl AsRef<Path>,
        overrides: &[impl AsRef<str>],
    ) -> Result<Self> {
        Self::read(text, file_name, folder.as_ref(), &listed(overrides))
    }

    // Not generic, as all below it: what reads a scene would otherwise be compiled again by each crate that calls it, half a minute each.
    fn read(text: &str, file_name: &str, folder: &Path, overrides: &[&str]) -> Result<Self> {
        let syntax = |e: toml::de::Error| Error::Scene {
            file: file_name.to_owned(),
            line: e.span().map_or(0, |span| Lines::of(text).at(span.start)),
            path: "TOML".to_owned(),
            what: e.message().replace('\n', ", "),
            allowed: None,
        };
        let source = Source::of(file_name, text, DeTable::parse(text).map_err(syntax)?.get_ref());
        let value = Value::Table(toml::from_str(text).map_err(syntax)?);
        Self::from_value(value, source, folder, overrides)
    }

    /// Applies overrides of the form `key.path=value` and checks the result; on an error nothing is changed.
    ///
    /// A key path is as in messages, `body[0].shape.box.min`; entries of a list may also be called by their `name`, as
    /// in `tool.cube.motion.free.mass=5`. The value is TOML; quotes around a single word may be left out.
    ///
    /// # Errors
    /// [`Error::Scene`] if a path leads nowhere or the result cannot be used.
    pub fn set(&mut self, overrides: &[impl AsRef<str>]) -> Result<()> {
        *self = self.with_overrides(&listed(overrides))?;
        Ok(())
    }

    fn with_overrides(&self, overrides: &[&str]) -> Result<Self> {
        let value = Value::try_from(self).map_err(|e| self.fault("scene", e.to_string(), "correct it"))?;
        Self::from_value(value, (*self.source).clone(), &self.folder, overrides)
    }

    /// What has been [set](Self::set) since the scene was read from its file, in order.
    pub fn overrides(&self) -> &[String] {
        &self.source.overrides
    }

    /// Takes over the overrides of a resumed run's scene.
    pub(crate) fn note_overrides(&mut self, overrides: Vec<String>) {
        self.source = Arc::new(Source { overrides, ..(*self.source).clone() });
    }

    /// The same scene with the names of another, what that writes and draws, and when it ends: nothing of this changes a state.
    pub(crate) fn in_words_of(&self, own: &Self) -> Self {
        Self {
            name: own.name.clone(),
            doc: own.doc.clone(),
            output: own.output.clone(),
            time: Time { end: own.time.end, ..self.time.clone() },
            ..self.clone()
        }
    }

    /// The first key in which two scenes differ, and its value in each: empty, if the key is absent.
    pub fn difference(&self, other: &Self) -> Option<(String, [String; 2])> {
        fn find(path: String, a: Option<&Value>, b: Option<&Value>) -> Option<(String, [String; 2])> {
            match (a, b) {
                _ if a == b => None,
                (Some(Value::Table(a)), Some(Value::Table(b))) => {
                    let keys: BTreeSet<&String> = a.keys().chain(b.keys()).collect();
                    let below = |key: &String| if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
                    keys.into_iter().find_map(|key| find(below(key), a.get(key), b.get(key)))
                }
                (Some(Value::Array(a)), Some(Value::Array(b))) => {
                    (0..a.len().max(b.len())).find_map(|i| find(format!("{path}[{i}]"), a.get(i), b.get(i)))
                }
                _ => Some((path, [a, b].map(|value| value.map_or_else(|| "nothing".to_owned(), Value::to_string)))),
            }
        }
        let [a, b] = [self, other].map(|scene| Value::try_from(scene).ok());
        find(String::new(), a.as_ref(), b.as_ref())
    }

    fn from_value(mut value: Value, mut source: Source, folder: &Path, overrides: &[&str]) -> Result<Self> {
        for &text in overrides {
            let path = apply(&mut value, text)?;
            source.overridden(&path);
            source.overrides.push(text.to_owned());
        }
        complete(&mut value);
        let mut scene: Self = serde_path_to_error::deserialize(value).map_err(|e| explain(&e, &source))?;
        scene.folder = folder.to_owned();
        scene.source = Arc::new(source);
        scene.check()?;
        Ok(scene)
    }

    /// The scene as TOML text: reading it gives the same scene.
    ///
    /// # Errors
    /// [`Error::Scene`] if a number or path has no form in TOML (a seed above 2⁶³ − 1, a path that is not UTF-8).
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string(self).map_err(|e| self.fault("scene", e.to_string(), "use values that TOML can hold"))
    }

    /// JSON Schema of scene files, with descriptions.
    pub fn schema() -> serde_json::Value {
        schemars::schema_for!(Self).to_value()
    }

    /// An error about a key of this scene, with the file and line where it stands.
    pub fn fault(&self, path: &str, what: impl Into<String>, mend: impl Into<String>) -> Error {
        fault(&self.source, path, what.into(), mend.into())
    }
}

fn listed(overrides: &[impl AsRef<str>]) -> Vec<&str> {
    overrides.iter().map(AsRef::as_ref).collect()
}

fn fault(source: &Source, path: &str, what: String, mend: String) -> Error {
    let (file, line) = source.place(path);
    let with = source.overridden_below(path).filter(|_| file != SET);
    Error::Scene {
        file: if file.is_empty() { "scene".to_owned() } else { file.to_owned() },
        line,
        path: path.to_owned(),
        what: what + &with.map_or_else(String::new, |key| format!(" (with {SET} {key})")),
        allowed: (!mend.is_empty()).then_some(mend),
    }
}

/// Turns serde's message into ours.
fn explain(error: &serde_path_to_error::Error<toml::de::Error>, source: &Source) -> Error {
    let path = error.path().to_string();
    let path = if path == "." { String::new() } else { path };
    let message = error.inner().message();
    let mut names = message.split('`').skip(1).step_by(2).map(str::to_owned);
    let (path, what, mend) = if message.starts_with("unknown field") || message.starts_with("unknown variant") {
        let name = names.next().unwrap_or_default();
        let allowed: Vec<_> = names.collect();
        let meant = nearest(&name, &allowed).map(|n| format!("; did you mean `{n}`?")).unwrap_or_default();
        let kind = if message.starts_with("unknown field") { "key" } else { "choice" };
        (path, format!("unknown {kind} `{name}`"), format!("allowed here: {}{meant}", allowed.join(", ")))
    } else if message.starts_with("missing field") {
        let name = names.next().unwrap_or_default();
        let path = if path.is_empty() { name } else { format!("{path}.{name}") };
        (path, "this key is required".to_owned(), "add it".to_owned())
    } else if message.starts_with("invalid type: unit variant") {
        let mend = "a choice that has keys of its own is written `{ NAME = { KEY = … } }`, one that has none `\"NAME\"`; `barchan schema` has them all";
        (path, "its choice is written otherwise".to_owned(), mend.to_owned())
    } else if message.starts_with("invalid type: map, expected a sequence") {
        let mend = format!("write [[{path}]] in place of [{path}], or [{{ … }}] in place of {{ … }}");
        (path, "there may be several, so it is a list".to_owned(), mend)
    } else if message.starts_with("wanted exactly 1 element") {
        let what = if message.contains("0 elements") {
            "none of its choices is given"
        } else {
            "several of its choices are given"
        };
        (path, what.to_owned(), "give exactly one of its choices".to_owned())
    } else {
        (path, message.replace("floating point ", "").replace("f64", "a number").replace('\n', ", "), String::new())
    };
    fault(source, if path.is_empty() { "scene" } else { &path }, what, mend)
}

/// The name that a misspelt one most likely stands for.
pub(crate) fn nearest<'a>(name: &str, known: &'a [String]) -> Option<&'a str> {
    known
        .iter()
        .map(|k| (edits(name, k), k.as_str()))
        .filter(|(distance, k)| *distance <= 1 + k.len() / 4)
        .min()
        .map(|(_, k)| k)
}

/// Levenshtein distance.
fn edits(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.chars().enumerate() {
        let mut diagonal = std::mem::replace(&mut row[0], i + 1);
        for (j, y) in b.iter().enumerate() {
            let change = diagonal + usize::from(x != *y);
            diagonal = row[j + 1];
            row[j + 1] = change.min(diagonal + 1).min(row[j] + 1);
        }
    }
    row[b.len()]
}

/// Applies one override to the value tree and returns the key path it changed.
fn apply(root: &mut Value, text: &str) -> Result<String> {
    let refuse = |path: &str, what: String, mend: &str| Error::Scene {
        file: SET.to_owned(),
        line: 0,
        path: path.to_owned(),
        what,
        allowed: Some(mend.to_owned()),
    };
    let Some((keys, raw)) = text.split_once('=') else {
        return Err(refuse(text, "has no `=`".to_owned(), "write key.path=value, such as world.cell=0.02"));
    };
    let (keys, raw) = (keys.trim(), raw.trim());
    let value = parse_value(raw).ok_or_else(|| {
        refuse(
            keys,
            format!("`{raw}` is no TOML value"),
            "write a number, true, false, \"text\", [list] or { key = value }",
        )
    })?;
    let form = right_form(root, keys);
    let mut node = root;
    let mut path = String::new();
    for segment in keys.replace('[', ".[").split('.') {
        let index = segment.strip_prefix('[').map(|rest| rest.strip_suffix(']').and_then(|i| i.parse::<usize>().ok()));
        if segment.is_empty() || index == Some(None) {
            let form = form.as_deref().unwrap_or("body[0].spacing");
            return Err(refuse(keys, format!("`{segment}` is no key"), &format!("write {form}={raw}")));
        }
        node = match node {
            Value::Array(items) => {
                let names: Vec<String> = items.iter().filter_map(name_of).map(str::to_owned).collect();
                let found = index.flatten().or_else(|| items.iter().position(|item| name_of(item) == Some(segment)));
                let count = items.len();
                let Some((i, item)) = found.and_then(|i| items.get_mut(i).map(|item| (i, item))) else {
                    let what = format!("`{path}` is a list of {count}, and none is `{segment}`");
                    let mut mend = format!("write {}={raw}", form.as_deref().unwrap_or("body[0].spacing"));
                    if !names.is_empty() {
                        mend += &format!(", or name one of {}", names.join(", "));
                    }
                    return Err(refuse(keys, what, &mend));
                };
                path = format!("{path}[{i}]");
                item
            }
            // A choice written as a word, such as motion = "fixed", may be replaced by one with keys.
            scalar_or_table => {
                if index.is_some() {
                    // What was not there before has just been made.
                    let is_new = scalar_or_table.as_table().is_some_and(toml::Table::is_empty);
                    let what = if is_new { "is not set by the scene" } else { "is no list" };
                    let mend = match &form {
                        Some(form) => format!("write {form}={raw}"),
                        None if is_new => format!("write all of it, {path}=[…]"),
                        None => "leave out the index".to_owned(),
                    };
                    return Err(refuse(keys, format!("`{path}` {what}"), &mend));
                }
                if !scalar_or_table.is_table() {
                    *scalar_or_table = Value::Table(toml::Table::new());
                }
                path = if path.is_empty() { segment.to_owned() } else { format!("{path}.{segment}") };
                let Value::Table(table) = scalar_or_table else {
                    unreachable!("what was no table has just been made one")
                };
                // An angle is given in radians or in degrees: what is set replaces the other.
                let twin = segment.strip_suffix("_deg").map_or_else(|| format!("{segment}_deg"), str::to_owned);
                table.remove(&twin);
                table.entry(segment).or_insert_with(|| Value::Table(toml::Table::new()))
            }
        };
    }
    *node = value;
    Ok(path)
}

/// The key path that was most likely meant: entries of lists in brackets, misspelt keys by those that the scene sets. `None` if it asks for the entry of
/// what is no list.
fn right_form(root: &Value, keys: &str) -> Option<String> {
    let (mut node, mut form) = (Some(root), String::new());
    let mut words = keys.split(['.', '[', ']']).filter(|word| !word.is_empty()).peekable();
    while let Some(word) = words.next() {
        if let Some(Value::Array(items)) = node {
            let number = word.parse::<usize>().ok();
            let entry = number.or_else(|| items.iter().position(|item| name_of(item) == Some(word)));
            let place = entry.filter(|entry| *entry < items.len()).unwrap_or(0);
            form += &format!("[{place}]");
            node = items.get(place);
            // Before a key stands an entry, if a wrong one.
            let is_key = words.peek().is_none() || node.is_some_and(|item| item.get(word).is_some());
            if entry.is_some() || !is_key {
                continue;
            }
        }
        if word.parse::<usize>().is_ok() {
            return None;
        }
        let known: Vec<String> =
            node.and_then(Value::as_table).into_iter().flat_map(toml::Table::keys).cloned().collect();
        let key = if known.iter().any(|k| k == word) { word } else { nearest(word, &known).unwrap_or(word) };
        form = if form.is_empty() { key.to_owned() } else { format!("{form}.{key}") };
        node = node.and_then(|node| node.get(key));
    }
    Some(form).filter(|form| !form.is_empty())
}

fn name_of(item: &Value) -> Option<&str> {
    item.get("name").and_then(Value::as_str)
}

/// A value as TOML writes it; quotes around a single word may be left out.
pub(crate) fn parse_value(raw: &str) -> Option<Value> {
    use serde::Deserialize;
    let word = |raw: &str| {
        let plain = |c: char| c.is_alphanumeric() || matches!(c, '_' | '-' | '/' | '.' | ' ');
        (raw.starts_with(|c: char| c.is_alphabetic() || c == '/') && raw.chars().all(plain))
            .then(|| Value::String(raw.to_owned()))
    };
    ValueDeserializer::parse(raw).ok().and_then(|de| Value::deserialize(de).ok()).or_else(|| word(raw))
}
