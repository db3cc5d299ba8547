//! Types of options that are more than a number or a word: their spelling on the command line and in files, and their
//! range.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize, Serializer};
use toml::{Table, Value};

use densify_core::gaussians::MAX_SH_DEGREE;
use densify_core::numbers;

/// A number of rows, at least 1: `200000`, `28k`, `1.5M`. Files may also contain a plain number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct Rows(pub usize);

/// A number of bytes: `512MiB`, `800MB`, `1000000`. Files may also contain a plain number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct ByteCount(pub u64);

/// `--image-cache`: memory for decoded photographs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ImageCache {
    /// This number of bytes.
    Bytes(u64),
    /// An eighth of the run's memory, plus the part of `--memory` that is left over.
    Auto,
}

/// A number greater than 0 and less than 1.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize)]
pub struct Fraction(pub f64);

/// A number in the range of f32, at least 0.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, Serialize)]
pub struct Weight(pub f64);

/// A whole number from `LEAST` to `MOST`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct Whole<const LEAST: u32, const MOST: u32>(pub u32);

/// A number of processor threads. More threads than a large machine has cores would only take memory for stacks.
pub type Threads = Whole<1, 256>;

/// `--budget`: the maximum number of Gaussians, or `auto`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Budget {
    /// At most this many.
    Rows(usize),
    /// As many as improve the model, up to this limit (`auto:50k`); `auto` alone: up to the default limit, or as many
    /// as `--memory` holds.
    Auto(Option<usize>),
}

impl Budget {
    /// The limit, if one is given.
    pub fn most(self) -> Option<usize> {
        match self {
            Self::Rows(rows) => Some(rows),
            Self::Auto(rows) => rows,
        }
    }

    /// True for `auto`, with or without a limit.
    pub fn is_auto(self) -> bool {
        matches!(self, Self::Auto(_))
    }

    /// The same kind of budget with this limit.
    #[must_use]
    pub fn limited_to(self, rows: usize) -> Self {
        match self {
            Self::Rows(_) => Self::Rows(rows),
            Self::Auto(_) => Self::Auto(Some(rows)),
        }
    }
}

/// `--sh-degree`: a spherical-harmonic degree, or `auto`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ShDegree {
    /// A number, 0 to 3.
    Fixed(u8),
    /// Chosen for the scene; `auto:2` records the degree once it has been chosen.
    Auto(Option<u8>),
}

/// A file by its absolute path, so that it is found from any folder in which the run is resumed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct AbsolutePath(pub PathBuf);

/// `--policy-file`: a Python file by its absolute path, or the name of a Python module.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct PolicyFile(pub String);

/// `--init`: the source of the first Gaussians.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum InitChoice {
    /// One on each point of the dataset's reconstruction.
    Points,
    /// One at each of some random points that the cameras see.
    Random,
    /// The Gaussians of this file, in the dataset's coordinates.
    Model(AbsolutePath),
}

/// The word before an optional number: `auto`, `auto:50k`.
const AUTO: &str = "auto";

/// The text after `auto:`: `Some(None)` for `auto` alone, `None` for other texts.
fn after_auto(text: &str) -> Option<Option<&str>> {
    match text.strip_prefix(AUTO)? {
        "" => Some(None),
        rest => Some(Some(rest.strip_prefix(':')?)),
    }
}

impl FromStr for Rows {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        numbers::rows(text).map(Self)
    }
}

impl FromStr for ByteCount {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        numbers::bytes(text).map(Self)
    }
}

impl FromStr for ImageCache {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match after_auto(text) {
            Some(None) => Ok(Self::Auto),
            _ => numbers::bytes(text).map(Self::Bytes).map_err(|error| format!("{error}, or auto")),
        }
    }
}

impl FromStr for Fraction {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        numbers::fraction(text).map(Self)
    }
}

impl<const LEAST: u32, const MOST: u32> FromStr for Whole<LEAST, MOST> {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.parse() {
            Ok(number) if (LEAST..=MOST).contains(&number) => Ok(Self(number)),
            _ if MOST == u32::MAX => Err(format!("`{text}` must be a whole number from {LEAST}")),
            _ => Err(format!("`{text}` must be a whole number from {LEAST} to {MOST}")),
        }
    }
}

impl FromStr for Weight {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        // Weights are used in f32.
        let is_weight = |weight: &f64| (*weight as f32).is_finite() && *weight >= 0.0;
        let weight = text.parse().ok().filter(is_weight);
        weight.map(Self).ok_or_else(|| format!("`{text}` must be a number from 0"))
    }
}

impl FromStr for Budget {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let rows = |text| numbers::rows(text).map_err(|error| format!("{error}, or auto"));
        match after_auto(text) {
            Some(None) => Ok(Self::Auto(None)),
            Some(Some(most)) => Ok(Self::Auto(Some(rows(most)?))),
            None => rows(text).map(Self::Rows),
        }
    }
}

impl FromStr for ShDegree {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let degree = |text: &str| text.parse().ok().filter(|degree| *degree <= MAX_SH_DEGREE);
        let wrong = || format!("`{text}` is not a degree; give 0, 1, 2, 3, or auto");
        match after_auto(text) {
            Some(None) => Ok(Self::Auto(None)),
            Some(Some(decided)) => {
                degree(decided).map(|degree| Self::Auto(Some(degree))).ok_or_else(wrong)
            }
            None => degree(text).map(Self::Fixed).ok_or_else(wrong),
        }
    }
}

impl FromStr for AbsolutePath {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text.is_empty() {
            return Err("give a file".to_owned());
        }
        let path = std::path::absolute(text);
        path.map(Self).map_err(|error| format!("`{text}` is not a path: {error}"))
    }
}

impl FromStr for PolicyFile {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text.is_empty() {
            return Err("give a Python file or module".to_owned());
        }
        let is_file = Path::new(text).extension().is_some_and(|ending| ending == "py");
        if !is_file {
            return Ok(Self(text.to_owned()));
        }
        let path = std::path::absolute(text).ok().and_then(|path| path.to_str().map(str::to_owned));
        path.map(Self).ok_or_else(|| format!("`{text}` is not a path in UTF-8"))
    }
}

impl FromStr for InitChoice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "points" => Ok(Self::Points),
            "random" => Ok(Self::Random),
            "" => Err("give points, random, or a file of Gaussian splats".to_owned()),
            path => path.parse().map(Self::Model),
        }
    }
}

impl Serialize for InitChoice {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Points => "points".serialize(serializer),
            Self::Random => "random".serialize(serializer),
            Self::Model(file) => file.serialize(serializer),
        }
    }
}

impl Serialize for Budget {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Rows(rows) => rows.serialize(serializer),
            Self::Auto(None) => AUTO.serialize(serializer),
            Self::Auto(Some(rows)) => format!("{AUTO}:{rows}").serialize(serializer),
        }
    }
}

impl Serialize for ImageCache {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Bytes(bytes) => bytes.serialize(serializer),
            Self::Auto => AUTO.serialize(serializer),
        }
    }
}

impl Serialize for ShDegree {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Fixed(degree) => degree.serialize(serializer),
            Self::Auto(None) => AUTO.serialize(serializer),
            Self::Auto(Some(degree)) => format!("{AUTO}:{degree}").serialize(serializer),
        }
    }
}

macro_rules! number_or_text {
    ($([$($parameters:tt)*] $type:ty;)*) => {$(
        impl<'de, $($parameters)*> Deserialize<'de> for $type {
            fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                numbers::number_or_text(deserializer)
            }
        }
    )*};
}

number_or_text! {
    [] Rows;
    [] ByteCount;
    [] ImageCache;
    [] Fraction;
    [] Weight;
    [const LEAST: u32, const MOST: u32] Whole<LEAST, MOST>;
    [] Budget;
    [] ShDegree;
    [] InitChoice;
}

/// One `NAME=VALUE` of an option that may be repeated; NAME may have parts, separated by a dot.
#[derive(Debug, Clone, PartialEq)]
pub struct Assignment {
    /// The parts of the name.
    pub path: Vec<String>,
    /// The value: TOML if it parses as TOML, else text.
    pub value: Value,
}

impl FromStr for Assignment {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (name, value) = text.split_once('=').unwrap_or((text, ""));
        let path: Vec<String> = name.split('.').map(|part| part.trim().to_owned()).collect();
        if value.trim().is_empty() || path.iter().any(String::is_empty) {
            return Err(format!("`{text}` is not of the form NAME=VALUE"));
        }
        Ok(Self { path, value: densify_policies::parameters::parse_value(value.trim()) })
    }
}

/// Converts assignments to a table, the form that they have in files.
///
/// # Errors
/// When a name is assigned two values, or is a value and a table at once.
pub(super) fn table(assignments: &[Assignment]) -> Result<Table, String> {
    let mut all = Table::new();
    for Assignment { path, value } in assignments {
        let name = path.join(".");
        let twice = |other: &Value| {
            format!("{name}={value} and {name}={other} contradict each other; give one of them")
        };
        let Some((last, parents)) = path.split_last() else { continue };
        let mut inner = &mut all;
        for parent in parents {
            let entry = inner.entry(parent).or_insert_with(|| Table::new().into());
            inner = entry.as_table_mut().ok_or_else(|| format!("{name} is not a table"))?;
        }
        match inner.get(last) {
            Some(other) if other != value => return Err(twice(other)),
            _ => _ = inner.insert(last.clone(), value.clone()),
        }
    }
    Ok(all)
}

/// The assignments of a table.
pub(crate) fn assignments(table: &Table) -> Vec<Assignment> {
    let mut all = Vec::new();
    for (name, value) in table {
        match value {
            Value::Table(inner) => all.extend(assignments(inner).into_iter().map(|mut one| {
                one.path.insert(0, name.clone());
                one
            })),
            value => all.push(Assignment { path: vec![name.clone()], value: value.clone() }),
        }
    }
    all
}

/// For `#[serde(with)]`: assignments as a table.
pub(super) mod as_table {
    use super::{Assignment, Deserialize, Deserializer, Serialize, Serializer, Value};
    use serde::de::Error as _;

    pub(crate) fn serialize<S: Serializer>(
        all: &[Assignment],
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        super::table(all).map_err(serde::ser::Error::custom)?.serialize(serializer)
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<Vec<Assignment>, D::Error> {
        match Value::deserialize(deserializer)? {
            Value::Table(table) => Ok(super::assignments(&table)),
            other => Err(D::Error::custom(format!("{other} is not a table of NAME = VALUE"))),
        }
    }
}
