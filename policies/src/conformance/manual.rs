//! Checks that a manual page lists all parameters with the defaults and ranges of the code.

use toml::{Table, Value};

use super::scenarios::scene;
use super::{Check, Report};
use crate::parameters::parse_value;
use crate::policy::PolicyError;
use crate::registry::PolicyEntry;

/// Runs [`Check::IsDocumented`].
///
/// # Errors
/// A report of all rows of the manual's table that are missing or wrong, or that describe no parameter.
pub fn check_manual(entry: &PolicyEntry) -> Result<(), Report> {
    let manual = entry.manual();
    let table = manual.lines().skip_while(|line| !line.starts_with("| name | default |")).skip(2);
    let rows: Vec<Vec<&str>> = table
        .take_while(|line| line.starts_with('|'))
        .map(|line| line.trim_matches('|').split('|').map(str::trim).collect())
        .collect();
    let mut errors: Vec<String> = Vec::new();
    for (name, default) in &entry.parameters() {
        match rows.iter().find(|row| row[0] == name) {
            None => errors.push(format!("`{name}` is missing")),
            Some(row) if row.len() != 5 => {
                errors.push(format!("the row of `{name}` has {} cells instead of 5", row.len()));
            }
            Some(row) => {
                if !equals(&parse_value(row[1]), default) {
                    errors.push(format!("`{name}` has the default {default}, not {}", row[1]));
                }
                errors.extend(check_range(entry, name, default, row[2]));
            }
        }
    }
    let known = entry.parameter_names();
    let unknown = rows.iter().map(|row| row[0]).filter(|name| known.iter().all(|k| k != name));
    errors.extend(unknown.map(|name| format!("`{name}` is not a parameter")));
    let mut report = Report::new(entry);
    if !errors.is_empty() {
        report.add(Check::IsDocumented, errors.join(", "));
    }
    report.result()
}

fn equals(documented: &Value, default: &Value) -> bool {
    let number = |value: &Value| value.as_float().or_else(|| value.as_integer().map(|v| v as f64));
    match (number(documented), number(default)) {
        (Some(documented), Some(default)) => documented.total_cmp(&default).is_eq(),
        _ => documented == default,
    }
}

/// Builds the policy with values at the ends of the documented range and beyond them. Reports the first value that is
/// refused although the range includes it, or accepted although it does not.
fn check_range(entry: &PolicyEntry, name: &str, default: &Value, range: &str) -> Option<String> {
    let Some((inside, outside)) = boundary_values(range, default) else {
        return Some(format!("`{name}` has the range `{range}`, which is not in a known form"));
    };
    let build = |value: &Value| {
        let set = Table::from_iter([(name.to_owned(), value.clone())]);
        entry.build(&set, &scene(10, 100)).map(drop)
    };
    let wrongly_refused = inside.iter().find_map(|value| {
        let error = build(value).err()?;
        Some(format!("`{name}` = {value} is in its range, but: {error}"))
    });
    wrongly_refused.or_else(|| {
        outside.iter().find_map(|value| match build(value) {
            Ok(()) => Some(format!("`{name}` = {value} is accepted, but its range is `{range}`")),
            Err(PolicyError::BadParameter { parameter, .. }) if parameter == name => None,
            Err(error) => {
                Some(format!("`{name}` = {value} is refused for another reason: {error}"))
            }
        })
    })
}

/// Values inside and outside a range of the form `>= a`, `> a`, `a to b` (optionally followed by `, a excluded`,
/// `, b excluded` or `, both excluded`) or a list of words. `None` for other forms.
fn boundary_values(range: &str, default: &Value) -> Option<(Vec<Value>, Vec<Value>)> {
    if range.is_empty() {
        return Some((Vec::new(), Vec::new()));
    }
    if default.is_str() {
        let words = range.split(", ").map(Value::from).collect();
        return Some((words, vec!["no such choice".into()]));
    }
    let (ends, excluded) = range.split_once(", ").unwrap_or((range, ""));
    let (low, high) = ends.split_once(" to ").unwrap_or((ends, ""));
    let excludes = |end: &str| excluded == "both excluded" || excluded == format!("{end} excluded");
    let (low, excludes_low) = match (low.strip_prefix(">= "), low.strip_prefix("> ")) {
        (Some(low), _) => (low, false),
        (_, Some(low)) => (low, true),
        _ => (low, excludes(low)),
    };
    let number = |x: f64| match default {
        Value::Integer(_) => Value::Integer(x as i64),
        _ => Value::Float(x),
    };
    let (mut inside, mut outside) = (Vec::new(), Vec::new());
    let mut add_end = |text: &str, is_excluded: bool, beyond: f64| {
        let end: f64 = text.parse().ok()?;
        if !is_excluded {
            inside.push(number(end));
        }
        outside.push(number(if is_excluded { end } else { end + beyond }));
        Some(())
    };
    add_end(low, excludes_low, -1.0)?;
    if !high.is_empty() {
        add_end(high, excludes(high), 1.0)?;
    }
    if default.is_float() {
        outside.extend([f64::NAN, f64::INFINITY].map(Value::Float));
    }
    Some((inside, outside))
}
