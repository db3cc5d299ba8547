//! Registers classes of policies, and makes policies of them.

use std::ops::Bound as End;

use densify_policies::parameters::{StepParameter, bad_parameter, in_range, parse_range};
use densify_policies::policy::{DensityPolicy, PolicyError, PolicyResult, SceneInfo};
use densify_policies::registry::{self, PolicyEntry, PolicyFactory};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict};
use toml::{Table, Value};

use super::bridge::PythonPolicy;
use super::failed;
use crate::errors::keep;

/// The values that the manual page allows.
enum Range {
    Any,
    Numbers(End<f64>, End<f64>),
    Words(Vec<String>),
}

/// A parameter of a policy, with its default.
struct Parameter {
    name: String,
    default: Value,
    range: Range,
}

/// Makes policies of a class.
struct ClassFactory {
    class: Py<PyAny>,
    /// Versions of Python and numpy, and the checksum of the file.
    provenance: String,
    parameters: Vec<Parameter>,
}

/// A parameter as Python describes it: name, default, `step`, `interval` or nothing, and the range in the manual page.
type Described<'py> = (String, Bound<'py, PyAny>, String, String);

/// Registers a policy's class.
///
/// # Errors
/// `ValueError` when the name is taken, or a range has an unknown form; `TypeError` when a default is no number, text or
/// flag.
#[pyfunction]
#[expect(clippy::needless_pass_by_value, reason = "the interface of functions for Python")]
pub(crate) fn register(
    py: Python<'_>,
    class: Py<PyAny>,
    about: (String, String, String, String),
    place: (String, u32),
    origin: (String, String),
    parameters: Vec<Described<'_>>,
) -> PyResult<()> {
    let mut steps = Vec::new();
    let mut described = Vec::new();
    for (name, default, scales, range) in parameters {
        let default = plain_value(&name, &default)?;
        match &*scales {
            "step" => steps.push(StepParameter::Step(leak(&name))),
            "interval" => steps.push(StepParameter::Interval(leak(&name))),
            _ => {}
        }
        let range = range_of(&name, &default, &range)?;
        described.push(Parameter { name, default, range });
    }
    let (identity, provenance) = origin;
    let (name, summary, source, doc) = about;
    let about = (leak(&name), leak(&summary), leak(&source));
    let factory = Box::leak(Box::new(ClassFactory { class, provenance, parameters: described }));
    let entry = PolicyEntry::with_factory(
        about,
        leak(&doc),
        (leak(&place.0), place.1),
        steps.leak(),
        factory,
    );
    let added = py.detach(|| registry::add(entry, &identity));
    added.map_err(|error| PyValueError::new_err(error.to_string()))
}

/// Text that lives as long as the program, as entries of the registry do.
fn leak(text: &str) -> &'static str {
    Box::leak(text.to_owned().into_boxed_str())
}

fn plain_value(name: &str, value: &Bound<'_, PyAny>) -> PyResult<Value> {
    if value.is_instance_of::<PyBool>() {
        return Ok(Value::Boolean(value.extract()?));
    }
    let integer = || value.extract::<i64>().map(Value::Integer);
    let float = || value.extract::<f64>().map(Value::Float);
    let text = || value.extract::<String>().map(Value::String);
    integer().or_else(|_| float()).or_else(|_| text()).map_err(|_| {
        PyTypeError::new_err(format!(
            "parameter `{name}`: a default must be a bool, int, float or str, not {}",
            value.get_type()
        ))
    })
}

fn range_of(name: &str, default: &Value, text: &str) -> PyResult<Range> {
    let text = text.trim();
    if text.is_empty() {
        return Ok(Range::Any);
    }
    if default.is_str() {
        return Ok(Range::Words(text.split(", ").map(str::to_owned).collect()));
    }
    let (low, high) = parse_range(text).ok_or_else(|| {
        PyValueError::new_err(format!(
            "parameter `{name}`: the range `{text}` in the docstring is not of the form `>= a`, `> a`, `a to b`, or \
             `a to b, both excluded`"
        ))
    })?;
    Ok(Range::Numbers(low, high))
}

impl Parameter {
    /// A value in the type of the default.
    fn typed(&self, value: Value) -> Result<Value, String> {
        match (&self.default, value) {
            (Value::Float(_), Value::Integer(number)) => Ok(Value::Float(number as f64)),
            (default, value) if default.same_type(&value) => Ok(value),
            (default, value) => Err(format!(
                "`{}` is of type {}, not {}",
                self.name,
                default.type_str(),
                value.type_str()
            )),
        }
    }

    fn check(&self, value: &Value) -> PolicyResult {
        let number = value.as_float().or_else(|| value.as_integer().map(|number| number as f64));
        match (&self.range, number, value.as_str()) {
            (Range::Numbers(low, high), Some(number), _) => {
                in_range(&self.name, number, (*low, *high))
            }
            (Range::Words(words), _, Some(text)) if !words.iter().any(|word| word == text) => Err(
                bad_parameter(&self.name, format!("`{text}` is not one of {}", words.join(", "))),
            ),
            _ => Ok(()),
        }
    }
}

impl PolicyFactory for ClassFactory {
    fn parameter_names(&self) -> Vec<String> {
        self.parameters.iter().map(|parameter| parameter.name.clone()).collect()
    }

    fn defaults(&self) -> Result<Table, String> {
        let pair = |parameter: &Parameter| (parameter.name.clone(), parameter.default.clone());
        Ok(self.parameters.iter().map(pair).collect())
    }

    fn typed(&self, mut table: Table) -> Result<Table, String> {
        let mut typed = Table::new();
        for parameter in &self.parameters {
            if let Some(value) = table.remove(&parameter.name) {
                typed.insert(parameter.name.clone(), parameter.typed(value)?);
            }
        }
        match table.keys().next() {
            None => Ok(typed),
            Some(unknown) => Err(format!("unknown parameter `{unknown}`")),
        }
    }

    fn provenance(&self) -> Option<String> {
        Some(self.provenance.clone())
    }

    fn build(&self, table: Table, scene: &SceneInfo) -> PolicyResult<Box<dyn DensityPolicy>> {
        for parameter in &self.parameters {
            if let Some(value) = table.get(&parameter.name) {
                parameter.check(value)?;
            }
        }
        Python::attach(|py| {
            let make = || -> PyResult<Py<PyAny>> {
                let arguments = PyDict::new(py);
                for (name, value) in &table {
                    match value {
                        Value::Boolean(flag) => arguments.set_item(name, flag)?,
                        Value::Integer(number) => arguments.set_item(name, number)?,
                        Value::Float(number) => arguments.set_item(name, number)?,
                        other => arguments.set_item(name, other.as_str().unwrap_or_default())?,
                    }
                }
                self.class.call(py, (), Some(&arguments))
            };
            let object = make().map_err(|error| failed(py, error))?;
            let policy = PythonPolicy::new(py, object, scene).map_err(|error| failed(py, error))?;
            Ok(Box::new(policy) as Box<dyn DensityPolicy>)
        })
    }
}

/// From here on, `policy_file` imports Python files and modules.
pub(crate) fn set_importer() {
    registry::set_importer(|file_or_module| {
        Python::attach(|py| {
            let import = || -> PyResult<()> {
                py.import("densify._policy")?.call_method1("import_policies", (file_or_module,))?;
                Ok(())
            };
            import().map_err(|error| {
                PolicyError::Other(format!("{file_or_module}: {}", keep(py, error)))
            })
        })
    });
}
