//! `densify knobs`: the settings that trade accuracy for speed or memory.

use clap::Args;

use super::console::Console;
use densify_run::failure::Failure;
use densify_run::knobs::{Class, KNOBS, Knob, Measured, PRESETS};

/// Lists the knobs: every setting that trades accuracy for speed or memory.
///
/// Set one with `densify train --knob NAME=VALUE`. An exact knob changes no bit of the
/// result; a bounded one adds a numerical error with a known bound.
#[derive(Debug, Args)]
pub(super) struct KnobsArgs {}

pub(super) fn run(_: &KnobsArgs, console: &Console) -> Result<(), Failure> {
    for class in [Class::Exact, Class::Bounded] {
        let promise = match class {
            Class::Exact => "the same bits",
            Class::Bounded => "a numerical error",
        };
        console.result(format_args!("{class}: {promise}"));
        for knob in KNOBS.iter().filter(|knob| knob.class == class) {
            console.result(format_args!("  {:<18}  {}", knob.name, knob.effect));
            console.result(format_args!("  {:<18}  {}", "", facts(knob)));
        }
    }
    console.result("presets: --preset NAME, knobs that go together");
    for preset in PRESETS {
        console.result(format_args!("  {preset}"));
        if let Some(Measured { command, .. }) = preset.measured {
            console.result(format_args!("  {:<18}  measured by: {command}", ""));
        }
    }
    Ok(())
}

/// Default, domain and backends of a knob.
fn facts(knob: &Knob) -> String {
    let unit = if knob.unit.is_empty() { String::new() } else { format!(" {}", knob.unit) };
    let on =
        knob.only_on.map_or_else(String::new, |only| format!("; {} backend only", only.name()));
    format!("{}{unit}, of {}{on}", knob.default, knob.domain)
}
