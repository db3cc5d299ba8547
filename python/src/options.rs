//! Checks of keyword arguments: options of a run, which arrive as JSON and are checked as a TOML table, words and files.

use std::path::Path;

use densify_run::failure::Failure;
use densify_run::{DataSpec, DeviceSpec, Partial, RunSpec};
use pyo3::PyResult;
use pyo3::exceptions::PyValueError;
use serde::de::DeserializeOwned;
use toml::{Table, Value};

/// The origin of options in messages.
const ORIGIN: &str = "options";

/// A JSON value as a TOML value; `None` for null, which TOML does not have.
fn to_toml(value: serde_json::Value) -> Result<Option<Value>, Failure> {
    Ok(Some(match value {
        serde_json::Value::Null => return Ok(None),
        serde_json::Value::Bool(flag) => Value::Boolean(flag),
        serde_json::Value::String(text) => Value::String(text),
        serde_json::Value::Number(number) => match (number.as_i64(), number.as_f64()) {
            (Some(integer), _) => Value::Integer(integer),
            (None, Some(float)) if number.is_f64() => Value::Float(float),
            _ => return Err(Failure::input(format!("{number} is too large for an option"))),
        },
        serde_json::Value::Array(items) => {
            let items = items.into_iter().map(to_toml).collect::<Result<Vec<_>, _>>()?;
            Value::Array(items.into_iter().flatten().collect())
        }
        serde_json::Value::Object(members) => {
            let mut table = Table::new();
            for (name, member) in members {
                if let Some(member) = to_toml(member)? {
                    table.insert(name, member);
                }
            }
            Value::Table(table)
        }
    }))
}

/// A JSON object as a TOML table.
pub(crate) fn table(json: &str) -> Result<Table, Failure> {
    let value: serde_json::Value = serde_json::from_str(json).map_err(Failure::input)?;
    match to_toml(value)? {
        Some(Value::Table(table)) => Ok(table),
        _ => Err(Failure::input("the options are not a table")),
    }
}

/// The options of a JSON object, checked one by one.
pub(crate) fn partial(json: &str) -> Result<Partial, Failure> {
    Partial::new(table(json)?, ORIGIN)
}

/// The options for a model: those of the device, the scene, those in `more`, and of a file those that read the dataset.
/// A run has the others in its folder.
///
/// # Errors
/// Names the first option that has no effect.
pub(crate) fn for_model(json: &str, is_run: bool, more: &[&str]) -> Result<RunSpec, Failure> {
    let given = partial(json)?;
    let has_effect = |name: &str| {
        let of_file = || name == "near" || DataSpec::NAMES.contains(&name);
        ["scene"].iter().chain(more).any(|known| *known == name)
            || DeviceSpec::NAMES.contains(&name)
            || (!is_run && of_file())
    };
    if let Some((name, _)) = given.iter().find(|(name, _)| !has_effect(name)) {
        let remedy = if is_run { "; a run has its own in its config.toml" } else { "" };
        return Err(Failure::input(format!("`{name}` has no effect here{remedy}: leave it out")));
    }
    given.describe()
}

/// The run that a JSON object describes, over its preset and the defaults.
pub(crate) fn spec(json: &str) -> Result<RunSpec, Failure> {
    partial(json)?.describe()
}

/// A word of an enumeration, as files spell it.
pub(crate) fn word<T: DeserializeOwned>(name: &str, text: &str) -> PyResult<T> {
    serde_json::from_value(serde_json::Value::from(text))
        .map_err(|error| PyValueError::new_err(format!("{name}: {error}")))
}

/// Fails if a file would replace something that it must not.
pub(crate) fn check_output(path: &Path, overwrite: bool) -> Result<(), Failure> {
    let shown = path.display();
    match path.symlink_metadata() {
        Ok(_) if path.is_dir() => Err(Failure::input(format!("{shown} is a folder; name a file"))),
        Ok(_) if path.exists() && !path.is_file() => {
            Err(Failure::input(format!("{shown} is a device or a pipe; name a file")))
        }
        Ok(_) if !overwrite => Err(Failure::input(format!(
            "{shown} exists; choose another file, or replace it with overwrite=True"
        ))),
        _ => Ok(()),
    }
}
