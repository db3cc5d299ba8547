//! Limits on scores, as pass or fail conditions of scripts.

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use serde_json::Value;

use densify_train::evaluate::Mean;
use densify_train::metrics::geometry::{Geometry, MeshErrors, ThinRecall};

/// A bound on a measured value. As text: `KEY=NUMBER`.
#[derive(Debug, Clone, PartialEq)]
pub struct Limit {
    /// `psnr`, `ssim`, `flip`, `lpips`, or the path of a number in geometry.json.
    pub key: String,
    /// The bound, finite.
    pub bound: f64,
}

impl FromStr for Limit {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (key, bound) = text.split_once('=').unwrap_or((text, ""));
        match bound.trim().parse() {
            Ok(bound) if f64::is_finite(bound) => Ok(Self { key: key.trim().to_owned(), bound }),
            _ => Err("give KEY=NUMBER, such as psnr=25".to_owned()),
        }
    }
}

/// The side of a limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// No smaller value is allowed.
    Lowest,
    /// No larger value is allowed.
    Highest,
}

/// The limits of an evaluation.
#[derive(Debug, Clone, Copy)]
pub struct Limits<'a> {
    /// Values may not be smaller than these.
    pub lowest: &'a [Limit],
    /// Values may not be larger than these.
    pub highest: &'a [Limit],
}

/// Limits that are exceeded or cannot be checked.
#[derive(Debug, Clone, PartialEq)]
pub enum LimitError {
    /// No value has this key.
    Unknown {
        /// The limit's side.
        side: Side,
        /// Its key.
        key: String,
        /// The keys that exist.
        known: Vec<String>,
        /// True if the geometry of the scene is known.
        has_geometry: bool,
    },
    /// Values beyond their limits, each with its side and limit; a value that was not measured is NaN.
    Exceeded(Vec<(f64, Side, Limit)>),
}

/// The values that limits may name: the scores, and every number of geometry.json by its path.
pub fn measured_values(mean: &Mean, geometry: Option<&Geometry>) -> BTreeMap<String, f64> {
    let mut values = BTreeMap::new();
    if let Some(geometry) = geometry.and_then(|measured| serde_json::to_value(measured).ok()) {
        flatten("", &geometry, &mut values);
    }
    let lpips = mean.lpips.map(|value| ("lpips", value));
    let scores = [("psnr", mean.psnr), ("ssim", mean.ssim), ("flip", mean.flip)];
    for (key, value) in scores.into_iter().chain(lpips) {
        values.insert(key.to_owned(), value);
    }
    values
}

/// The values of a mesh that limits may name.
pub fn mesh_values(errors: &MeshErrors) -> BTreeMap<String, f64> {
    let mut values = BTreeMap::new();
    if let Ok(errors) = serde_json::to_value(errors) {
        flatten("", &errors, &mut values);
    }
    values
}

fn flatten(prefix: &str, value: &Value, values: &mut BTreeMap<String, f64>) {
    let path = |key: &str| match prefix {
        "" => key.to_owned(),
        prefix => format!("{prefix}.{key}"),
    };
    match value {
        Value::Object(map) => {
            map.iter().for_each(|(key, value)| flatten(&path(key), value, values));
        }
        Value::Array(list) => list.iter().enumerate().for_each(|(index, value)| {
            flatten(&path(&index.to_string()), value, values);
        }),
        // A value that was not measured fails every limit.
        Value::Null => _ = values.insert(prefix.to_owned(), f64::NAN),
        value => values.extend(value.as_f64().map(|number| (prefix.to_owned(), number))),
    }
}

impl Limits<'_> {
    fn each(&self) -> impl Iterator<Item = (Side, &Limit)> {
        let lowest = self.lowest.iter().map(|limit| (Side::Lowest, limit));
        lowest.chain(self.highest.iter().map(|limit| (Side::Highest, limit)))
    }

    /// Checks, before anything is measured, that every limit names a value that will be measured.
    ///
    /// # Errors
    /// [`LimitError::Unknown`].
    pub fn check_keys(&self, has_geometry: bool, has_lpips: bool) -> Result<(), LimitError> {
        let example = Geometry { thin: vec![ThinRecall::default()], ..Geometry::default() };
        let lpips = has_lpips.then_some(0.0);
        let mean = Mean { psnr: 0.0, ssim: 0.0, flip: 0.0, lpips, fitted: None };
        let known = measured_values(&mean, has_geometry.then_some(&example));
        for (side, Limit { key, .. }) in self.each() {
            // The number of thin structures is known only after measuring, so any index is accepted.
            let zero_if_index = |part| if str::parse::<u32>(part).is_ok() { "0" } else { part };
            let with_index_0 = key.split('.').map(zero_if_index).collect::<Vec<_>>().join(".");
            if !known.contains_key(&with_index_0) {
                return Err(LimitError::unknown(side, key, &known));
            }
        }
        Ok(())
    }

    /// Checks that every limit names one of the values that will be measured.
    ///
    /// # Errors
    /// [`LimitError::Unknown`].
    pub fn check_known(&self, known: &BTreeMap<String, f64>) -> Result<(), LimitError> {
        match self.each().find(|(_, limit)| !known.contains_key(&limit.key)) {
            Some((side, limit)) => Err(LimitError::unknown(side, &limit.key, known)),
            None => Ok(()),
        }
    }

    /// Checks that every value was measured and is within its limit.
    ///
    /// # Errors
    /// [`LimitError::Exceeded`] with every such value; [`LimitError::Unknown`] for a key that does not exist.
    pub fn check(&self, values: &BTreeMap<String, f64>) -> Result<(), LimitError> {
        let mut exceeded = Vec::new();
        for (side, limit) in self.each() {
            let Some(&value) = values.get(&limit.key) else {
                return Err(LimitError::unknown(side, &limit.key, values));
            };
            let is_kept = match side {
                Side::Lowest => value >= limit.bound,
                Side::Highest => value <= limit.bound,
            };
            if !is_kept {
                exceeded.push((value, side, limit.clone()));
            }
        }
        if exceeded.is_empty() { Ok(()) } else { Err(LimitError::Exceeded(exceeded)) }
    }
}

impl LimitError {
    fn unknown(side: Side, key: &str, known: &BTreeMap<String, f64>) -> Self {
        let has_geometry = known.contains_key("depth.rmse") || !known.contains_key("psnr");
        let known = known.keys().cloned().collect();
        Self::Unknown { side, key: key.to_owned(), known, has_geometry }
    }

    /// The message, in which `spell` names the option of each side.
    pub fn message(&self, spell: impl Fn(Side) -> &'static str) -> String {
        match self {
            Self::Unknown { side, key, known, has_geometry } => {
                let geometry = if *has_geometry {
                    ""
                } else {
                    "; geometry is known only for built-in scenes and those that `densify scenegen` wrote"
                };
                let lpips =
                    if key == "lpips" { "; LPIPS is measured with --lpips FILE" } else { "" };
                format!(
                    "{}: no value called `{key}` is measured; those measured are {}{geometry}{lpips}",
                    spell(*side),
                    known.join(", ")
                )
            }
            Self::Exceeded(values) => {
                let line = |(value, side, Limit { key, bound }): &(f64, Side, Limit)| {
                    format!("{key} is {value}, beyond {} {key}={bound}", spell(*side))
                };
                values.iter().map(line).collect::<Vec<_>>().join("\n")
            }
        }
    }
}

impl fmt::Display for LimitError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = |side| match side {
            Side::Lowest => "lowest",
            Side::Highest => "highest",
        };
        f.write_str(&self.message(name))
    }
}

impl std::error::Error for LimitError {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_beyond_their_limits_are_named() {
        let mean = Mean { psnr: 24.5, ssim: 0.9, flip: 0.1, lpips: None, fitted: None };
        let mut values = measured_values(&mean, None);
        flatten("", &serde_json::json!({ "depth": { "rmse": 0.02 }, "thin": [null] }), &mut values);
        let limit = |text: &str| vec![text.parse::<Limit>().unwrap()];
        let check = |lowest: &str, highest: &str| {
            Limits { lowest: &limit(lowest), highest: &limit(highest) }.check(&values)
        };
        assert_eq!(check("psnr=24.5", "flip=0.1"), Ok(()));
        let exceeded = check("psnr=25", "depth.rmse=0.01").unwrap_err();
        assert!(matches!(&exceeded, LimitError::Exceeded(values) if values.len() == 2));
        for words in ["psnr is 24.5", "lowest psnr=25", "depth.rmse is 0.02"] {
            assert!(exceeded.to_string().contains(words), "{exceeded}");
        }
        assert!(matches!(check("thin.0=0", "flip=1"), Err(LimitError::Exceeded(_))));
        let unknown = check("PSNR=1", "flip=1").unwrap_err();
        let is_unknown = matches!(unknown, LimitError::Unknown { .. });
        assert!(is_unknown && unknown.to_string().contains("psnr, ssim"), "{unknown}");
        let check_key = |has_geometry, has_lpips, key: &str| {
            Limits { lowest: &limit(&format!("{key}=1")), highest: &[] }
                .check_keys(has_geometry, has_lpips)
        };
        for key in ["flip", "centres.f_score_one_percent", "thin.3.recall", "normal_error"] {
            assert_eq!(check_key(true, false, key), Ok(()), "{key}");
            let message = check_key(false, false, key).err().map(|error| error.to_string());
            let is_explained =
                message.is_some_and(|text| text.contains("flip") && text.contains("scenegen"));
            assert_eq!(is_explained, key != "flip", "{key}");
        }
        assert_eq!(check_key(false, true, "lpips"), Ok(()));
        assert!(check_key(true, false, "lpips").unwrap_err().to_string().contains("--lpips"));
        let typo = check_key(true, false, "depth.rsme").unwrap_err();
        assert!(typo.to_string().contains("depth.rmse"), "{typo}");
        for bad in ["psnr", "psnr=", "psnr=nan", "=x"] {
            assert!(bad.parse::<Limit>().is_err(), "{bad}");
        }
    }
}
