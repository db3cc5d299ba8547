//! Parameters of policies: names, ranges, overrides, and scaling with the length of the run.

use std::ops::{Bound, RangeBounds};

use serde::de::{DeserializeOwned, Deserializer, Error, Visitor, value};
use toml::{Table, Value};

use crate::policy::{PolicyError, PolicyResult};

/// Length of the run that defaults in steps refer to `[steps]`.
pub const REFERENCE_ITERATIONS: u32 = 30_000;

/// Largest magnitude of a parameter, so that products of parameters are finite as `f32`.
const MAX_MAGNITUDE: f64 = 1e30;

/// Checks, for [`ConfiguredPolicy::new`], that a parameter is in its range, also when rounded to `f32`, and at
/// most 1e30 in magnitude. The registry adds the policy's name to the error.
///
/// [`ConfiguredPolicy::new`]: crate::registry::ConfiguredPolicy::new
///
/// # Errors
/// [`PolicyError::BadParameter`] with the value and the range.
pub fn in_range(parameter: &str, value: f64, range: impl RangeBounds<f64>) -> PolicyResult {
    let [is_in_range, is_in_range_rounded] =
        [value, f64::from(value as f32)].map(|value| range.contains(&value));
    // False for NaN.
    let is_moderate = value.abs() <= MAX_MAGNITUDE;
    if is_in_range && is_in_range_rounded && is_moderate {
        return Ok(());
    }
    let mut limits = Vec::new();
    match range.start_bound() {
        Bound::Included(low) => limits.push(format!("at least {low}")),
        Bound::Excluded(low) => limits.push(format!("greater than {low}")),
        Bound::Unbounded => {}
    }
    match range.end_bound() {
        Bound::Included(high) => limits.push(format!("at most {high}")),
        Bound::Excluded(high) => limits.push(format!("less than {high}")),
        Bound::Unbounded => {}
    }
    if !is_moderate {
        limits.push(format!("at most {MAX_MAGNITUDE:e} in magnitude"));
    }
    let limits = limits.join(" and ");
    let reason = if is_in_range {
        let rounded = if is_in_range_rounded { "" } else { " as a 32-bit number" };
        format!("{value:e} is out of range; it must be {limits}{rounded}")
    } else {
        format!("{value} is out of range; it must be {limits}")
    };
    Err(bad_parameter(parameter, reason))
}

/// The range in a manual page: `>= a`, `> a`, or `a to b`, where `, a excluded`, `, b excluded` or `, both excluded`
/// may follow. `None` for other forms.
pub fn parse_range(text: &str) -> Option<(Bound<f64>, Bound<f64>)> {
    let number = |text: &str| text.trim().parse::<f64>().ok().filter(|number| number.is_finite());
    if let Some(low) = text.strip_prefix(">=") {
        return Some((Bound::Included(number(low)?), Bound::Unbounded));
    }
    if let Some(low) = text.strip_prefix('>') {
        return Some((Bound::Excluded(number(low)?), Bound::Unbounded));
    }
    let (ends, excluded) = text.split_once(", ").unwrap_or((text, ""));
    let (low, high) = ends.split_once(" to ")?;
    let [excludes_low, excludes_high] =
        [low, high].map(|end| excluded == "both excluded" || excluded == format!("{end} excluded"));
    if !excluded.is_empty() && !excludes_low && !excludes_high {
        return None;
    }
    let bound = |end, excludes| {
        let end = number(end)?;
        Some(if excludes { Bound::Excluded(end) } else { Bound::Included(end) })
    };
    Some((bound(low, excludes_low)?, bound(high, excludes_high)?))
}

/// A [`PolicyError::BadParameter`], for [`ConfiguredPolicy::new`]. The registry adds the policy's name.
///
/// [`ConfiguredPolicy::new`]: crate::registry::ConfiguredPolicy::new
pub fn bad_parameter(parameter: &str, reason: impl Into<String>) -> PolicyError {
    PolicyError::BadParameter {
        policy: String::new(),
        parameter: parameter.to_owned(),
        reason: reason.into(),
    }
}

/// Parses a value given on the command line: as TOML if it is valid TOML, otherwise as text.
pub fn parse_value(text: &str) -> Value {
    let parsed = format!("value = {text}").parse::<Table>().ok();
    // Text with a line break could set further keys; such text is not a single value.
    let single = parsed.filter(|table| table.len() == 1);
    single.and_then(|mut table| table.remove("value")).unwrap_or_else(|| text.into())
}

/// Shortest interval after scaling `[steps]`. Between two events, rows must be seen in many views, and
/// new rows must converge, which takes as many steps in a short run as in a long one.
const MIN_INTERVAL: i64 = 100;

/// The name of a parameter that counts steps. Its default refers to a run of 30,000 steps and scales with the
/// length of the run; a value set by the user does not.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StepParameter {
    /// A step of the run, or a number of steps: scales in proportion.
    Step(&'static str),
    /// The number of steps between events: scales, but does not shrink below 100.
    Interval(&'static str),
}

/// Concatenates `first`, the step parameters of another policy, and `more`; N is the total number.
///
/// # Panics
/// When the total is not N. In a constant this is a compile error.
pub const fn extended<const N: usize>(
    first: &[StepParameter],
    more: &[StepParameter],
) -> [StepParameter; N] {
    assert!(first.len() + more.len() == N, "wrong number of step parameters");
    let mut all = [StepParameter::Step(""); N];
    let mut i = 0;
    while i < N {
        all[i] = if i < first.len() { first[i] } else { more[i - first.len()] };
        i += 1;
    }
    all
}

impl StepParameter {
    /// The parameter's name.
    pub fn name(self) -> &'static str {
        let (Self::Step(name) | Self::Interval(name)) = self;
        name
    }
}

/// Multiplies step counts by `iterations` / 30,000 and rounds them to at least 1; 0 stays 0, as it switches
/// something off. Intervals do not shrink below [`MIN_INTERVAL`].
pub(crate) fn scale_steps(table: &mut Table, parameters: &[StepParameter], iterations: u32) {
    for parameter in parameters {
        if let Some(Value::Integer(steps)) = table.get_mut(parameter.name())
            && *steps > 0
        {
            let factor = f64::from(iterations) / f64::from(REFERENCE_ITERATIONS);
            let minimum = match parameter {
                StepParameter::Interval(_) => (*steps).min(MIN_INTERVAL),
                StepParameter::Step(_) => 1,
            };
            *steps = ((*steps as f64 * factor).round() as i64).max(minimum);
        }
    }
}

/// The name in `known` most similar to `name`, if any is similar enough.
pub fn nearest<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> Option<String> {
    // 0.7 accepts a missing or wrong letter in a short name, but not a different word.
    let scored = known.into_iter().map(|k| (strsim::jaro_winkler(name, k), k));
    let best = scored.filter(|(score, _)| *score >= 0.7).max_by(|a, b| a.0.total_cmp(&b.0));
    best.map(|(_, k)| k.to_owned())
}

/// The field names of `T`, a struct that derives `Deserialize`, in declaration order. Unlike a table of
/// defaults, they include fields that are `None` by default. `None` if `T` is not a plain struct.
pub(crate) fn field_names<T: DeserializeOwned>() -> Option<&'static [&'static str]> {
    let mut names = None;
    // This deserialiser only records the names and always returns an error.
    let _ = T::deserialize(FieldNames(&mut names));
    names
}

struct FieldNames<'a>(&'a mut Option<&'static [&'static str]>);

impl<'de> Deserializer<'de> for FieldNames<'_> {
    type Error = value::Error;

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _name: &'static str,
        fields: &'static [&'static str],
        _visitor: V,
    ) -> Result<V::Value, Self::Error> {
        *self.0 = Some(fields);
        Err(Error::custom("names only"))
    }

    fn deserialize_any<V: Visitor<'de>>(self, _visitor: V) -> Result<V::Value, Self::Error> {
        Err(Error::custom("names only"))
    }

    serde::forward_to_deserialize_any! {
        bool i8 i16 i32 i64 i128 u8 u16 u32 u64 u128 f32 f64 char str string bytes byte_buf option
        unit unit_struct newtype_struct seq tuple tuple_struct map enum identifier ignored_any
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_of_manual_pages_are_parsed() {
        use Bound::{Excluded, Included, Unbounded};
        assert_eq!(parse_range(">= 1"), Some((Included(1.0), Unbounded)));
        assert_eq!(parse_range("> 0.5"), Some((Excluded(0.5), Unbounded)));
        assert_eq!(parse_range("0 to 1"), Some((Included(0.0), Included(1.0))));
        assert_eq!(parse_range("0 to 1, both excluded"), Some((Excluded(0.0), Excluded(1.0))));
        assert_eq!(parse_range("0 to 1, 0 excluded"), Some((Excluded(0.0), Included(1.0))));
        assert_eq!(parse_range("-1 to 2, 2 excluded"), Some((Included(-1.0), Excluded(2.0))));
        for other in ["", "1", "a to b", ">= x", "0 to inf", "0 to 1, 3 excluded", "low, high"] {
            assert_eq!(parse_range(other), None, "{other}");
        }
    }

    fn reason(result: PolicyResult) -> String {
        match result {
            Err(PolicyError::BadParameter { parameter, reason, .. }) if parameter == "rho" => {
                reason
            }
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn values_out_of_range_are_refused_with_the_range() {
        assert_eq!(in_range("rho", 1.0, 0.0..=1.0), Ok(()));
        assert_eq!(in_range("rho", -5.0, ..), Ok(()));
        let message = reason(in_range("rho", 1.5, 0.0..=1.0));
        assert_eq!(message, "1.5 is out of range; it must be at least 0 and at most 1");
        let open = (Bound::Excluded(0.0), Bound::Excluded(1.0));
        let message = reason(in_range("rho", 0.0, open));
        assert_eq!(message, "0 is out of range; it must be greater than 0 and less than 1");
        let message = reason(in_range("rho", f64::NAN, ..));
        assert_eq!(message, "NaN is out of range; it must be at most 1e30 in magnitude");
        let message = reason(in_range("rho", 1e39, 0.0..));
        assert_eq!(
            message,
            "1e39 is out of range; it must be at least 0 and at most 1e30 in magnitude"
        );
        let message = reason(in_range("rho", 1e-50, (Bound::Excluded(0.0), Bound::Unbounded)));
        assert_eq!(message, "1e-50 is out of range; it must be greater than 0 as a 32-bit number");
        reason(in_range("rho", f64::INFINITY, 0.0..));
        let message = reason(in_range("rho", 0.999_999_999, open));
        assert!(message.ends_with("less than 1 as a 32-bit number"), "{message}");
    }

    #[test]
    fn values_are_toml_or_plain_text() {
        for (text, value) in [
            ("0.3", Value::Float(0.3)),
            ("1e-4", Value::Float(1e-4)),
            ("true", Value::Boolean(true)),
            ("none", Value::String("none".into())),
            ("\"x=y\"", Value::String("x=y".into())),
            ("x=y", Value::String("x=y".into())),
            ("1\nc=2", Value::String("1\nc=2".into())),
        ] {
            assert_eq!(parse_value(text), value, "{text}");
        }
    }

    #[test]
    fn schedules_scale_with_the_run() {
        // Names do not matter: `until_every` is a step, not an interval.
        let scaled = |steps: i64, iterations| {
            let mut table = Table::new();
            for name in ["until_every", "every", "rows"] {
                table.insert(name.into(), steps.into());
            }
            let kinds = ["until_every", "absent"].map(StepParameter::Step);
            scale_steps(&mut table, &kinds, iterations);
            scale_steps(&mut table, &[StepParameter::Interval("every")], iterations);
            assert_eq!(table["rows"].as_integer(), Some(steps));
            ["until_every", "every"].map(|name| table[name].as_integer().unwrap())
        };
        assert_eq!(scaled(100, 30_000), [100, 100]);
        assert_eq!(scaled(100, 2_000), [7, 100]);
        assert_eq!(scaled(50, 2_000), [3, 50]);
        assert_eq!(scaled(3_000, 2_000), [200, 200]);
        assert_eq!(scaled(100, 60_000), [200, 200]);
        assert_eq!(scaled(100, 0), [1, 100]);
        assert_eq!(scaled(0, 60_000), [0, 0]);
    }

    #[test]
    fn a_misspelt_name_finds_the_right_one() {
        let known = ["diet", "taming", "vanilla"];
        assert_eq!(nearest("dite", known).as_deref(), Some("diet"));
        assert_eq!(nearest("vanila", known).as_deref(), Some("vanilla"));
        assert_eq!(nearest("mcmc", known), None);
    }
}
