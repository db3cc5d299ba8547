//! `densify policies`: lists the registered policies and prints their manual pages.

use clap::Args;
use densify_policies::registry::{find, policies};

use super::console::Console;
use densify_run::failure::Failure;

/// Lists the density-control policies, or explains one.
///
/// A policy decides where Gaussians are added and removed during training. Choose one with
/// `densify train --policy NAME`.
#[derive(Debug, Args)]
pub(super) struct PoliciesArgs {
    /// Policy to explain: its decisions, source and parameters
    name: Option<String>,
    /// A second name; it is refused with a hint
    #[arg(hide = true)]
    more: Option<String>,
}

pub(super) fn run(args: &PoliciesArgs, console: &Console) -> Result<(), Failure> {
    if let Some(name) = &args.name {
        if let Some(more) = &args.more {
            let name = if find(name).is_ok() { name } else { more };
            return Err(Failure::input(format!("give one name: `densify policies {name}`")));
        }
        let entry = find(name)?;
        console.result(entry.manual().trim_end());
        let parameters = entry.parameters();
        if !parameters.is_empty() {
            console.result(format_args!("\nDefaults, for a run of 30,000 steps:\n"));
        }
        for (parameter, value) in parameters {
            let key = format!("{name}.{parameter}");
            let scales = entry.step_parameters().iter().any(|step| step.name() == parameter);
            let note = if scales { "   (scales with --iterations)" } else { "" };
            console.result(format_args!("  --policy-set {key}={value}{note}"));
        }
        return Ok(());
    }
    let entries = policies()?;
    let width = entries.iter().map(|entry| entry.name.len()).max().unwrap_or(0);
    for entry in entries {
        console.result(format_args!("{:width$}  {}", entry.name, entry.summary));
        console.result(format_args!("{:width$}  {} ({})", "", entry.source, entry.location()));
    }
    console.result(format_args!("\n`densify policies NAME` explains a policy and its parameters."));
    Ok(())
}
