//! `densify knobs`: lists the settings that trade speed or memory for accuracy.

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
    for (class, promise) in [(Class::Exact, "the same bits"), (Class::Bounded, "a numerical error")]
    {
        console.result(format_args!("{class}: {promise}"));
        for knob in KNOBS.iter().filter(|knob| knob.class == class) {
            console.result(format_args!("  {:<18}  {}", knob.name, knob.effect));
            console.result(format_args!("  {:<18}  {}", "", describe_values(knob)));
        }
    }
    console.result("presets: --preset NAME sets several knobs or options together");
    for preset in PRESETS {
        console.result(format_args!("  {preset}"));
        if let Some(Measured { command, .. }) = preset.measured {
            console.result(format_args!("  {:<18}  measured by: {command}", ""));
        }
    }
    Ok(())
}

/// The default, the valid values, and the backend if only one backend has the knob.
fn describe_values(knob: &Knob) -> String {
    let unit = if knob.unit.is_empty() { String::new() } else { format!(" {}", knob.unit) };
    let on =
        knob.only_on.map_or_else(String::new, |only| format!("; {} backend only", only.name()));
    format!("default {}{unit}, allowed {}{on}", knob.default, knob.domain)
}
