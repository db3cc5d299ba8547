//! `--fail-below` and `--fail-above`: measured values as conditions of a script.

use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::str::FromStr;

use serde_json::Value;

use densify_run::failure::{Failure, LIMIT};
use densify_train::evaluate::Mean;
use densify_train::metrics::geometry::{Geometry, ThinRecall};

/// A bound on a measured value.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Limit {
    key: String,
    bound: f64,
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

/// The values that limits may name: the scores, and every number of geometry.json by its path.
pub(super) fn values(mean: &Mean, geometry: Option<&Geometry>) -> BTreeMap<String, f64> {
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

fn flatten(prefix: &str, value: &Value, values: &mut BTreeMap<String, f64>) {
    let path = |key: &str| match prefix {
        "" => key.to_owned(),
        prefix => format!("{prefix}.{key}"),
    };
    match value {
        Value::Object(map) => map.iter().for_each(|(key, it)| flatten(&path(key), it, values)),
        Value::Array(list) => {
            (0..).zip(list).for_each(|(at, it): (u32, _)| {
                flatten(&path(&at.to_string()), it, values);
            });
        }
        // What was not measured keeps no limit.
        Value::Null => _ = values.insert(prefix.to_owned(), f64::NAN),
        value => values.extend(value.as_f64().map(|number| (prefix.to_owned(), number))),
    }
}

/// Fails, before anything is measured, where a limit names what will not be.
///
/// # Errors
/// Code 2 with the keys that there are.
pub(super) fn check_keys(
    knows_geometry: bool,
    knows_lpips: bool,
    below: &[Limit],
    above: &[Limit],
) -> Result<(), Failure> {
    let example = Geometry { thin: vec![ThinRecall::default()], ..Geometry::default() };
    let lpips = knows_lpips.then_some(0.0);
    let mean = Mean { psnr: 0.0, ssim: 0.0, flip: 0.0, lpips, fitted: None };
    let known = values(&mean, knows_geometry.then_some(&example));
    for (limits, flag) in [(below, "--fail-below"), (above, "--fail-above")] {
        for Limit { key, .. } in limits {
            // How many widths of thin structures there are is found by measuring.
            let first = |part| if str::parse::<u32>(part).is_ok() { "0" } else { part };
            let like = key.split('.').map(first).collect::<Vec<_>>().join(".");
            if !known.contains_key(&like) {
                return Err(unknown(flag, key, &known));
            }
        }
    }
    Ok(())
}

fn unknown(flag: &str, key: &str, known: &BTreeMap<String, f64>) -> Failure {
    let names: Vec<&str> = known.keys().map(String::as_str).collect();
    let geometry = match known.contains_key("depth.rmse") {
        true => "",
        false => {
            "; geometry is known of built-in scenes, and of those that `densify scenegen` wrote"
        }
    };
    let names = names.join(", ");
    let lpips = if key == "lpips" { "; LPIPS is measured with --lpips FILE" } else { "" };
    Failure::input(format!(
        "{flag}: nothing called `{key}` is measured; there are {names}{geometry}{lpips}"
    ))
}

/// Fails where a value is beyond its limit, or was not measured.
///
/// # Errors
/// Code 4 with every value beyond its limit; code 2 for a key that there is not.
pub(super) fn check(
    values: &BTreeMap<String, f64>,
    below: &[Limit],
    above: &[Limit],
) -> Result<(), Failure> {
    let mut beyond = Vec::new();
    let sides =
        [(below, "--fail-below", Ordering::Less), (above, "--fail-above", Ordering::Greater)];
    for (limits, flag, forbidden) in sides {
        for Limit { key, bound } in limits {
            let Some(&value) = values.get(key) else {
                return Err(unknown(flag, key, values));
            };
            // What is not a number compares with nothing, and is beyond every limit.
            if value.partial_cmp(bound).is_none_or(|order| order == forbidden) {
                beyond.push(format!("{key} is {value}, beyond {flag} {key}={bound}"));
            }
        }
    }
    match beyond.is_empty() {
        true => Ok(()),
        false => Err(Failure::new(LIMIT, beyond.join("\n"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_beyond_their_limits_are_named() {
        let mean = Mean { psnr: 24.5, ssim: 0.9, flip: 0.1, lpips: None, fitted: None };
        let mut values = values(&mean, None);
        flatten("", &serde_json::json!({ "depth": { "rmse": 0.02 }, "thin": [null] }), &mut values);
        let limit = |text: &str| vec![text.parse::<Limit>().unwrap()];
        let check = |below: &str, above: &str| check(&values, &limit(below), &limit(above));
        assert_eq!(check("psnr=24.5", "flip=0.1"), Ok(()));
        let failure = check("psnr=25", "depth.rmse=0.01").unwrap_err();
        assert_eq!(failure.code, LIMIT);
        for words in ["psnr is 24.5", "--fail-below psnr=25", "depth.rmse is 0.02"] {
            assert!(failure.to_string().contains(words), "{failure}");
        }
        assert_eq!(check("thin.0=0", "flip=1").unwrap_err().code, LIMIT);
        let unknown = check("PSNR=1", "flip=1").unwrap_err();
        assert!(unknown.code == 2 && unknown.to_string().contains("psnr, ssim"), "{unknown}");
        let early = |knows, key: &str| check_keys(knows, false, &limit(&format!("{key}=1")), &[]);
        for key in ["flip", "centres.f_score_one_percent", "thin.3.recall", "normal_error"] {
            assert_eq!(early(true, key), Ok(()), "{key}");
            let failure = early(false, key).err().map(|failure| failure.to_string());
            let told = failure.is_some_and(|it| it.contains("flip") && it.contains("scenegen"));
            assert_eq!(told, key != "flip", "{key}");
        }
        assert_eq!(check_keys(false, true, &limit("lpips=1"), &[]), Ok(()));
        assert!(early(true, "lpips").unwrap_err().to_string().contains("--lpips"));
        let typo = early(true, "depth.rsme").unwrap_err();
        assert!(typo.code == 2 && typo.to_string().contains("depth.rmse"), "{typo}");
        for bad in ["psnr", "psnr=", "psnr=nan", "=x"] {
            assert!(bad.parse::<Limit>().is_err(), "{bad}");
        }
    }
}
