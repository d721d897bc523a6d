//! Parameters that plugins declare, and the values that scenes and command lines give them.
//!
//! A material, coupling, task or backend says what it wants to know: name, unit, type, default or none, range. What is given is held to that before the
//! plugin is made, with the line and key where it stands, so a plugin finds values that it need not check again.

use crate::loader::Refusal;
use crate::scene::{nearest, parse_value};
use crate::{Error, Result, Vec3};
use barchan_abi as abi;
use std::collections::BTreeMap;
use std::fmt;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

/// What is given: values as TOML has them, and tables of them by name.
pub use toml::{Table, Value as Given};

/// The values that a number may have.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    /// Least value.
    pub min: f64,
    /// Greatest value.
    pub max: f64,
    /// Is the least value itself left out?
    pub min_open: bool,
    /// Is the greatest value itself left out?
    pub max_open: bool,
}

impl Range {
    /// All finite numbers.
    pub const FINITE: Self = Self::new(f64::MIN, f64::MAX);
    /// Finite numbers from 0.
    pub const NOT_NEGATIVE: Self = Self::new(0.0, f64::MAX);
    /// Finite numbers above 0.
    pub const POSITIVE: Self = Self { min_open: true, ..Self::NOT_NEGATIVE };

    /// Both ends, and what lies between.
    pub const fn new(min: f64, max: f64) -> Self {
        Self { min, max, min_open: false, max_open: false }
    }
    /// Does it hold the value? NaN it never does.
    pub fn contains(&self, value: f64) -> bool {
        let above = if self.min_open { value > self.min } else { value >= self.min };
        let below = if self.max_open { value < self.max } else { value <= self.max };
        above && below
    }
    /// As it is written, such as `(-1, 0.5)` or `[0, inf)`, with numbers as `number` writes them.
    pub fn written(&self, number: impl Fn(f64) -> String) -> String {
        // What is finite ends before infinity.
        let (from, to) = (self.min == f64::MIN, self.max == f64::MAX);
        let min = if from { "-inf".to_owned() } else { number(self.min) };
        let max = if to { "inf".to_owned() } else { number(self.max) };
        let open = if self.min_open || from { '(' } else { '[' };
        let close = if self.max_open || to { ')' } else { ']' };
        format!("{open}{min}, {max}{close}")
    }
}

impl fmt::Display for Range {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.written(|x| x.to_string()))
    }
}

/// Type of a parameter.
#[derive(Clone, Debug, PartialEq)]
pub enum Kind {
    /// A number in a range.
    Number(Range),
    /// True or false.
    Switch,
    /// One of these texts; any text, if there are none.
    Text(Vec<String>),
    /// A file, named relative to the scene's folder; for backends, to the folder that the program runs in. Empty, where that is the default: none.
    Path,
    /// Values of one type.
    Array {
        /// Their type.
        of: Box<Kind>,
        /// How many there may be.
        count: RangeInclusive<usize>,
    },
    /// Parameters of its own; it may be absent if none of them is required.
    Table(Vec<Parameter>),
}

impl Kind {
    /// Its name: "number", "switch", "text", "path", "array" or "table".
    pub fn name(&self) -> &'static str {
        match self {
            Self::Number(_) => "number",
            Self::Switch => "switch",
            Self::Text(_) => "text",
            Self::Path => "path",
            Self::Array { .. } => "array",
            Self::Table(_) => "table",
        }
    }

    /// Has a default the type, and is it in the range?
    fn allows(&self, value: &Value) -> bool {
        match (self, value) {
            (Self::Number(range), Value::Number(x)) => range.contains(*x),
            (Self::Switch, Value::Switch(_)) => true,
            (Self::Text(choices), Value::Text(text)) => choices.is_empty() || choices.contains(text),
            // Which file there is by default, only a scene's folder could say.
            (Self::Path, Value::Path { given, .. }) => given.as_os_str().is_empty(),
            (Self::Array { of, count }, Value::Array(items)) => {
                count.contains(&items.len()) && items.iter().all(|item| of.allows(item))
            }
            _ => false,
        }
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Number(range) => write!(f, "a number in {range}"),
            Self::Switch => f.write_str("true or false"),
            Self::Text(choices) if choices.is_empty() => f.write_str("a text"),
            Self::Text(choices) => write!(f, "one of the texts {}", choices.join(", ")),
            Self::Path => f.write_str("the path of a file"),
            Self::Array { of, count } => match (count.start(), count.end()) {
                (a, b) if a == b => write!(f, "an array of {a}, each {of}"),
                (a, b) if *b == usize::MAX => write!(f, "an array of {a} or more, each {of}"),
                (a, b) => write!(f, "an array of {a} to {b}, each {of}"),
            },
            Self::Table(keys) => {
                let keys: Vec<&str> = keys.iter().map(|key| key.name.as_str()).collect();
                write!(f, "a table of {}", keys.join(", "))
            }
        }
    }
}

/// A parameter of a plugin.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameter {
    /// snake_case name.
    pub name: String,
    /// SI unit of its numbers; empty if it has none. Angles are in rad, and a scene may give them in degrees as `<name>_deg`.
    pub unit: String,
    /// One sentence.
    pub doc: String,
    /// Type and range.
    pub kind: Kind,
    /// What it is where nothing is given; `None`: it is required, or a table, whose keys have their own.
    pub default: Option<Value>,
    /// `BARCHAN_PARAM_*` bits of a material's; else 0.
    pub flags: u64,
}

impl Parameter {
    /// One that is required, unless a default is given by [`or`](Self::or).
    pub fn new(name: &str, unit: &str, kind: Kind, doc: &str) -> Self {
        Self { name: name.to_owned(), unit: unit.to_owned(), doc: doc.to_owned(), kind, default: None, flags: 0 }
    }
    /// A number.
    pub fn number(name: &str, unit: &str, range: Range, doc: &str) -> Self {
        Self::new(name, unit, Kind::Number(range), doc)
    }
    /// True or false.
    pub fn switch(name: &str, doc: &str) -> Self {
        Self::new(name, "", Kind::Switch, doc)
    }
    /// One of some texts, or any if there are none to choose from.
    pub fn text(name: &str, choices: &[&str], doc: &str) -> Self {
        Self::new(name, "", Kind::Text(choices.iter().map(|&choice| choice.to_owned()).collect()), doc)
    }
    /// A file.
    pub fn path(name: &str, doc: &str) -> Self {
        Self::new(name, "", Kind::Path, doc)
    }
    /// Three numbers: a point, a vector, or factors along x, y, z.
    pub fn vector(name: &str, unit: &str, range: Range, doc: &str) -> Self {
        Self::new(name, unit, Kind::Array { of: Box::new(Kind::Number(range)), count: 3..=3 }, doc)
    }
    /// Tables with the same keys, so many of them.
    pub fn tables(name: &str, keys: Vec<Self>, count: RangeInclusive<usize>, doc: &str) -> Self {
        Self::new(name, "", Kind::Array { of: Box::new(Kind::Table(keys)), count }, doc)
    }

    /// With a default. That of a path is the empty text: no file.
    #[must_use]
    pub fn or(self, default: impl Into<Value>) -> Self {
        let default = match (default.into(), &self.kind) {
            (Value::Text(file), Kind::Path) => Value::Path { given: file.into(), file: PathBuf::new() },
            (other, _) => other,
        };
        Self { default: Some(default), ..self }
    }

    /// The default of a number.
    pub fn default_number(&self) -> Option<f64> {
        match self.default {
            Some(Value::Number(x)) => Some(x),
            _ => None,
        }
    }

    /// One of a material.
    pub(crate) fn of_material(name: String, unit: String, doc: String, raw: &abi::BarchanParam) -> Self {
        let range = Range {
            min: raw.min_value,
            max: raw.max_value,
            min_open: raw.flags & abi::BARCHAN_PARAM_MIN_OPEN != 0,
            max_open: raw.flags & abi::BARCHAN_PARAM_MAX_OPEN != 0,
        };
        let default = Some(Value::Number(raw.default_value));
        Self { name, unit, doc, kind: Kind::Number(range), default, flags: raw.flags }
    }

    fn check(&self) -> Result<(), Refusal> {
        if !is_snake_case(&self.name) {
            return Err(Refusal::new(
                format!("it has a parameter named '{}'", self.name),
                "use snake_case: a-z, 0-9 and _",
            ));
        }
        let nested = match &self.kind {
            Kind::Table(keys) => check(keys),
            Kind::Array { of, .. } => match &**of {
                Kind::Table(keys) => check(keys),
                _ => Ok(()),
            },
            _ => Ok(()),
        };
        nested.map_err(|r| Refusal::new(format!("parameter '{}': {}", self.name, r.what), r.mend))?;
        match &self.default {
            Some(default) if !self.kind.allows(default) => Err(Refusal::new(
                match (&self.kind, default) {
                    (Kind::Number(range), Value::Number(x)) => {
                        format!("the default {x} of parameter '{}' is outside its range {range}", self.name)
                    }
                    (kind, default) => {
                        format!("the default {default:?} of parameter '{}' is not {kind}", self.name)
                    }
                },
                "correct the default or the range",
            )),
            _ => Ok(()),
        }
    }

    /// Is it a number of radians, or numbers of them?
    fn is_angle(&self) -> bool {
        self.unit == "rad"
    }
}

pub(crate) fn is_snake_case(name: &str) -> bool {
    name.starts_with(|c: char| c.is_ascii_lowercase())
        && name.bytes().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == b'_')
}

/// Holds what a plugin declares to the rules: names in snake_case, each once, and defaults of the type and in the range.
///
/// # Errors
/// What is wrong, and what would mend it.
pub(crate) fn check(parameters: &[Parameter]) -> Result<(), Refusal> {
    parameters.iter().try_for_each(Parameter::check)?;
    let mut names: Vec<_> = parameters.iter().map(|p| &p.name).collect();
    names.sort();
    match names.windows(2).find(|pair| pair[0] == pair[1]) {
        Some(pair) => Err(Refusal::new(format!("it declares parameter '{}' twice", pair[0]), "rename one of them")),
        None => Ok(()),
    }
}

/// A value of a parameter.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// In the parameter's unit.
    Number(f64),
    /// True or false.
    Switch(bool),
    /// A text.
    Text(String),
    /// A file.
    Path {
        /// As it was given.
        given: PathBuf,
        /// Where it is.
        file: PathBuf,
    },
    /// Values of one type.
    Array(Vec<Value>),
    /// Values by name.
    Table(Parameters),
}

impl Value {
    /// Adds the files that it names, as they were given.
    fn add_files<'a>(&'a self, files: &mut Vec<&'a Path>) {
        match self {
            Self::Path { given, .. } if !given.as_os_str().is_empty() => files.push(given),
            Self::Array(items) => items.iter().for_each(|item| item.add_files(files)),
            Self::Table(table) => files.extend(table.files()),
            _ => {}
        }
    }
}

impl From<f64> for Value {
    fn from(number: f64) -> Self {
        Self::Number(number)
    }
}
impl From<bool> for Value {
    fn from(switch: bool) -> Self {
        Self::Switch(switch)
    }
}
impl From<&str> for Value {
    fn from(text: &str) -> Self {
        Self::Text(text.to_owned())
    }
}
impl From<Vec3> for Value {
    fn from(vector: Vec3) -> Self {
        Self::Array(vector.map(Self::Number).to_vec())
    }
}
impl From<Vec<Value>> for Value {
    fn from(items: Vec<Value>) -> Self {
        Self::Array(items)
    }
}

/// The values of all parameters that a plugin has declared: given ones, and defaults.
///
/// Each type has a question of its own. One that was not declared under that name and type is a mistake of the plugin's and panics, whatever the
/// scene says.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Parameters(BTreeMap<String, Value>);

impl Parameters {
    /// A value, if there is such a parameter.
    pub fn get(&self, name: &str) -> Option<&Value> {
        self.0.get(name)
    }
    /// A number, in its unit.
    ///
    /// # Panics
    /// If no number of that name was declared.
    pub fn number(&self, name: &str) -> f64 {
        match self.get(name) {
            Some(Value::Number(x)) => *x,
            other => undeclared("number", name, other),
        }
    }
    /// A switch.
    ///
    /// # Panics
    /// If no switch of that name was declared.
    pub fn switch(&self, name: &str) -> bool {
        match self.get(name) {
            Some(Value::Switch(on)) => *on,
            other => undeclared("switch", name, other),
        }
    }
    /// A text.
    ///
    /// # Panics
    /// If no text of that name was declared.
    pub fn text(&self, name: &str) -> &str {
        match self.get(name) {
            Some(Value::Text(text)) => text,
            other => undeclared("text", name, other),
        }
    }
    /// Where a file is; it was there when the parameters were read. `None` where none is given and there need not be one.
    ///
    /// # Panics
    /// If no path of that name was declared.
    pub fn path(&self, name: &str) -> Option<&Path> {
        match self.get(name) {
            Some(Value::Path { file, .. }) => Some(file.as_path()).filter(|file| !file.as_os_str().is_empty()),
            other => undeclared("path", name, other),
        }
    }
    /// The entries of an array.
    ///
    /// # Panics
    /// If no array of that name was declared.
    pub fn array(&self, name: &str) -> &[Value] {
        match self.get(name) {
            Some(Value::Array(items)) => items,
            other => undeclared("array", name, other),
        }
    }
    /// The entries of an array of numbers, in their unit.
    ///
    /// # Panics
    /// If no array of numbers of that name was declared.
    pub fn numbers(&self, name: &str) -> Vec<f64> {
        let number = |item: &Value| match item {
            Value::Number(x) => *x,
            other => undeclared("array of numbers", name, Some(other)),
        };
        self.array(name).iter().map(number).collect()
    }
    /// Three numbers, in their unit.
    ///
    /// # Panics
    /// If no array of three numbers of that name was declared.
    pub fn vector(&self, name: &str) -> Vec3 {
        let numbers = self.numbers(name);
        numbers.try_into().unwrap_or_else(|_| undeclared("array of three numbers", name, self.get(name)))
    }
    /// The values of a table.
    ///
    /// # Panics
    /// If no table of that name was declared.
    pub fn table(&self, name: &str) -> &Self {
        match self.get(name) {
            Some(Value::Table(table)) => table,
            other => undeclared("table", name, other),
        }
    }
    /// The tables of an array of them.
    ///
    /// # Panics
    /// If no array of tables of that name was declared.
    pub fn tables(&self, name: &str) -> Vec<&Self> {
        let tables = self.array(name).iter().map(|item| match item {
            Value::Table(table) => table,
            other => undeclared("array of tables", name, Some(other)),
        });
        tables.collect()
    }
    /// The files that are named, as they were given.
    pub fn files(&self) -> Vec<&Path> {
        let mut files = Vec::new();
        self.0.values().for_each(|value| value.add_files(&mut files));
        files
    }
}

fn undeclared(kind: &str, name: &str, found: Option<&Value>) -> ! {
    panic!("the plugin asks for the {kind} `{name}`, which it has not declared as such: {found:?}")
}

/// Where parameters are given, for their errors and files.
pub(crate) struct Giver<'a> {
    /// Who declares them, such as "coupling 'current'".
    pub(crate) whose: String,
    /// Folder that paths start from.
    pub(crate) folder: &'a Path,
    /// The error about a key path: what is wrong, and what would mend it.
    pub(crate) fault: &'a dyn Fn(&str, String, String) -> Error,
}

impl Giver<'_> {
    /// Holds what is given to what is declared, and adds the defaults; `path` is the key path of the table.
    ///
    /// # Errors
    /// Unknown names, with the known ones; other types; numbers out of range; files that are not there; required ones that are missing.
    pub(crate) fn resolve(&self, declared: &[Parameter], given: &Table, path: &str) -> Result<Parameters> {
        let below = |key: &str| if path.is_empty() { key.to_owned() } else { format!("{path}.{key}") };
        let mut values = BTreeMap::new();
        for (key, value) in given {
            let at = below(key);
            let exact = declared.iter().find(|p| p.name == *key);
            let in_degrees = || {
                let name = key.strip_suffix("_deg")?;
                declared.iter().find(|p| p.name == name && p.is_angle())
            };
            let Some((parameter, degrees)) = exact.map(|p| (p, false)).or_else(|| in_degrees().map(|p| (p, true)))
            else {
                let what = format!("{} has no parameter `{key}`", self.whose);
                return Err((self.fault)(&at, what, it_has(key, &keys(declared))));
            };
            let value = self.value(parameter, &parameter.kind, value, degrees, &at)?;
            if values.insert(parameter.name.clone(), value).is_some() {
                let what = format!("gives {} a second time", parameter.name);
                return Err((self.fault)(&at, what, "keep one of the two".to_owned()));
            }
        }
        for parameter in declared {
            if values.contains_key(&parameter.name) {
                continue;
            }
            let at = below(&parameter.name);
            let value = match (&parameter.default, &parameter.kind) {
                (Some(default), _) => default.clone(),
                (None, Kind::Table(keys)) => Value::Table(self.resolve(keys, &Table::new(), &at)?),
                (None, kind) => {
                    let unit = after_number(&parameter.unit);
                    let mend = format!("{} needs it: give {kind}{unit} ({})", self.whose, parameter.doc);
                    return Err((self.fault)(&at, "this key is required".to_owned(), mend));
                }
            };
            values.insert(parameter.name.clone(), value);
        }
        Ok(Parameters(values))
    }

    fn value(&self, of: &Parameter, kind: &Kind, given: &Given, degrees: bool, at: &str) -> Result<Value> {
        let fault = |what: String, mend: String| Err((self.fault)(at, what, mend));
        let number = match given {
            Given::Float(x) => Some(*x),
            Given::Integer(i) => Some(*i as f64),
            _ => None,
        };
        match (kind, given) {
            (Kind::Number(range), _) if let Some(x) = number => {
                let si = if degrees { x.to_radians() } else { x };
                if !range.contains(si) {
                    let deg = if degrees { format!(" deg, that is {si} rad") } else { String::new() };
                    return fault(format!("is {x}{deg}"), format!("must be in {range}{}", after_number(&of.unit)));
                }
                Ok(Value::Number(si))
            }
            (Kind::Switch, Given::Boolean(on)) => Ok(Value::Switch(*on)),
            (Kind::Text(choices), Given::String(text)) => {
                if !choices.is_empty() && !choices.contains(text) {
                    let meant = meant(text, choices);
                    return fault(format!("is {text:?}"), format!("must be one of {}{meant}", choices.join(", ")));
                }
                Ok(Value::Text(text.clone()))
            }
            (Kind::Path, Given::String(name)) => {
                let file = self.folder.join(name);
                if !file.is_file() {
                    let mend = format!("give a file; paths start from {}", shown(self.folder));
                    return fault(format!("there is no file {name:?}"), mend);
                }
                Ok(Value::Path { given: name.into(), file })
            }
            (Kind::Array { of: entry, count }, Given::Array(items)) => {
                if !count.contains(&items.len()) {
                    return fault(
                        format!("has {} entries", items.len()),
                        format!("give {kind}{}", after_number(&of.unit)),
                    );
                }
                let item = |(i, item)| self.value(of, entry, item, degrees, &format!("{at}[{i}]"));
                items.iter().enumerate().map(item).collect::<Result<_>>().map(Value::Array)
            }
            (Kind::Table(keys), Given::Table(table)) => self.resolve(keys, table, at).map(Value::Table),
            _ => fault(format!("is {}", described(given)), format!("give {kind}{}", after_number(&of.unit))),
        }
    }
}

/// A unit as it stands after a number or a range: nothing, if there is none or it is that of shares, "1".
pub fn after_number(unit: &str) -> String {
    if matches!(unit, "" | "1") { String::new() } else { format!(" {unit}") }
}

/// What was given, where another type is wanted.
fn described(given: &Given) -> String {
    match given {
        Given::String(text) => format!("the text {text:?}"),
        Given::Array(items) => format!("an array of {}", items.len()),
        Given::Table(_) => "a table".to_owned(),
        Given::Integer(_) | Given::Float(_) | Given::Boolean(_) | Given::Datetime(_) => given.to_string(),
    }
}

fn shown(folder: &Path) -> String {
    if folder.as_os_str().is_empty() { "the folder at hand".to_owned() } else { folder.display().to_string() }
}

/// The keys that may be given.
fn keys(declared: &[Parameter]) -> Vec<String> {
    let forms = |p: &Parameter| std::iter::once(p.name.clone()).chain(p.is_angle().then(|| format!("{}_deg", p.name)));
    declared.iter().flat_map(forms).collect()
}

/// What there is in the place of a name that is not known, and which was most likely meant.
fn it_has(name: &str, known: &[String]) -> String {
    let known_ones = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
    format!("it has {known_ones}{}", meant(name, known))
}

fn meant(name: &str, known: &[String]) -> String {
    nearest(name, known).map(|n| format!("; did you mean `{n}`?")).unwrap_or_default()
}

/// Reads `KEY=VALUE`, as command lines give parameters. The value is TOML; quotes around a single word may be left out.
///
/// # Errors
/// A text that says what is wrong.
pub fn parse(text: &str) -> Result<(String, Given), String> {
    let (key, value) = text.split_once('=').ok_or("has no `=`: write KEY=VALUE, such as drag=0.5")?;
    let (key, value) = (key.trim(), value.trim());
    let parsed = parse_value(value).ok_or_else(|| {
        format!("`{value}` is no TOML value: write a number, true, false, \"text\", [array] or {{ key = value }}")
    })?;
    Ok((key.to_owned(), parsed))
}
