//! `densify knobs`: what trades speed or memory for accuracy.

use clap::Args;

use super::console::Console;
use super::failure::Failure;
use crate::knobs::{Class, How, KNOBS, Knob, Measured, On, PRESETS};

/// Lists the knobs: every setting that trades speed or memory for accuracy.
///
/// Set one with `densify train --knob NAME=VALUE`. Some are options of `train` or parameters of the
/// policy by another name; either way of setting them does. An exact knob changes no bit of the
/// result, a bounded one makes a numerical error only, a heuristic one changes what training arrives
/// at.
#[derive(Debug, Args)]
pub(super) struct KnobsArgs {}

pub(super) fn run(_: &KnobsArgs, console: &Console) -> Result<(), Failure> {
    for class in [Class::Exact, Class::Bounded, Class::Heuristic] {
        let promise = match class {
            Class::Exact => "the same bits",
            Class::Bounded => "a numerical error only",
            Class::Heuristic => "another outcome of training",
        };
        console.result(format_args!("{class}: {promise}"));
        for knob in KNOBS.iter().filter(|knob| knob.class == class) {
            console.result(format_args!("  {:<18}  {}", knob.name, knob.what));
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

/// Default, domain, and how it is set.
fn facts(knob: &Knob) -> String {
    let unit = if knob.unit.is_empty() { String::new() } else { format!(" {}", knob.unit) };
    let how = match knob.how {
        How::Knob => String::new(),
        How::Flag(flag) => format!("; the same as {flag}"),
        How::Parameter(names) => {
            format!("; the same as --policy-set POLICY.{}", names.join(" or "))
        }
    };
    let on = match knob.on {
        On::Both => "",
        On::Native => "; native backend only",
        On::Gpu => "; GPU backend only",
    };
    format!("{}{unit}, of {}{how}{on}", knob.default, knob.domain)
}
