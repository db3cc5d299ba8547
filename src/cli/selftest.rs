//! `densify selftest`: checks the arithmetic of this machine and its drivers.

use std::path::PathBuf;

use clap::Args;

use super::console::Console;
use densify_core::files::write_atomically;
use densify_render::cpu::InstructionSet;
use densify_render::gpu::{GpuDevice, adapters};
use densify_render::{Accumulation, AdapterChoice, Device};
use densify_run::DeviceSpec;
use densify_run::failure::{Failure, OTHER};
use densify_selftest::{Case, Finding, Subject, SubjectReport, cases, markdown, table};

/// Compares this machine with a float64 renderer in numerically hard cases.
///
/// Among the cases are needle-shaped Gaussians, thousands of layers, saturated opacities, images of
/// one pixel and Gaussians with NaN. Images, gradients, losses and optimiser steps are compared with
/// those of a second renderer, which shares no arithmetic with the first. Prints the largest error of each kind, its place and its
/// tolerance. Include this table in a bug report.
///
/// The exit code is 1 if any figure is beyond its tolerance.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct SelftestArgs {
    /// Only these cases, by number
    #[arg(value_name = "CASE")]
    only: Vec<u8>,
    /// Also run the parts of cases that take minutes: half a million Gaussians as large as the image, in
    /// about 800 MiB, and runs of 30,000 steps
    #[arg(long)]
    long: bool,
    /// Write the table as Markdown
    #[arg(long, value_name = "FILE")]
    markdown: Option<PathBuf>,
    /// Test every backend: the processor, and all adapters, software drivers included
    #[arg(long, conflicts_with_all = ["backend", "gpu"])]
    all: bool,
    #[command(flatten)]
    device: DeviceSpec,
}

const EXAMPLES: &str = "\
Examples:
  densify selftest                              on a GPU if there is one, else on the processor
  densify selftest --backend cpu 7 13           only needles and layers
  densify selftest --gpu radeon                 on this adapter
  densify selftest --all --long --markdown selftest.md
                                                on every backend, with the long cases, into a file";

/// The accumulation on GPUs. Some cases compare two runs bit by bit, and only this accumulation is reproducible.
const ACCUMULATION: Option<Accumulation> = Some(Accumulation::Slots);

pub(super) fn run(args: &SelftestArgs, console: &Console) -> Result<(), Failure> {
    let selected = select_cases(&args.only)?;
    let mut tested: Vec<SubjectReport> = Vec::new();
    for subject in open_subjects(args)? {
        console.result(format_args!(
            "densify {} on {}: {}, {}",
            env!("CARGO_PKG_VERSION"),
            subject.name(),
            std::env::consts::OS,
            std::env::consts::ARCH
        ));
        let mut report = SubjectReport { subject: subject.name(), cases: Vec::new() };
        for &case in &selected {
            let findings = case.run(&subject, args.long);
            console.result(table(&case, &findings));
            report.cases.push((case, findings));
        }
        tested.push(report);
    }
    if let Some(path) = &args.markdown {
        let text = markdown(&tested);
        write_atomically(path, |out| out.write_all(text.as_bytes()))?;
    }
    let count = check_tolerances(&tested)?;
    console.result(format_args!("All {count} figures are within their tolerances."));
    Ok(())
}

/// Counts the figures; fails unless all are within their tolerances.
fn check_tolerances(tested: &[SubjectReport]) -> Result<usize, Failure> {
    let findings: Vec<&Finding> = tested.iter().flat_map(SubjectReport::findings).collect();
    let failed = findings.iter().filter(|finding| !finding.passes()).count();
    let count = findings.len();
    if failed == 0 {
        return Ok(count);
    }
    Err(Failure::new(
        OTHER,
        format!(
            "{failed} of {count} figures are beyond their tolerances; please report the table above, and \
             if a GPU fails, train with --backend cpu until the cause is known"
        ),
    ))
}

/// Opens the backends to test.
fn open_subjects(args: &SelftestArgs) -> Result<Vec<Subject>, Failure> {
    let native = Subject::Native {
        instructions: InstructionSet::default(),
        threads: args.device.threads.map(|threads| threads.0 as usize),
    };
    if !args.all {
        let device = Device::open_to_render(args.device.backend, args.device.gpu.as_deref())?;
        return Ok(vec![match device {
            Device::Processor => native,
            Device::Gpu(device) => Subject::Gpu(device),
        }]);
    }
    let mut subjects = vec![native];
    for adapter in adapters().into_iter().filter(|adapter| adapter.missing.is_empty()) {
        let device = GpuDevice::open(&AdapterChoice {
            name: Some(adapter.name),
            accumulation: ACCUMULATION,
        })?;
        subjects.push(Subject::Gpu(device));
    }
    Ok(subjects)
}

/// The cases with these numbers, or all.
fn select_cases(only: &[u8]) -> Result<Vec<Case>, Failure> {
    let numbers: Vec<u8> = cases().iter().map(|case| case.number).collect();
    if let Some(unknown) = only.iter().find(|number| !numbers.contains(number)) {
        let numbers: Vec<String> = numbers.iter().map(u8::to_string).collect();
        return Err(Failure::input(format!(
            "there is no case {unknown}; the cases are {}",
            numbers.join(", ")
        )));
    }
    let is_wanted = |case: &&Case| only.is_empty() || only.contains(&case.number);
    Ok(cases().iter().filter(is_wanted).copied().collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cases_are_selected_by_number() {
        assert_eq!(select_cases(&[]).unwrap().len(), cases().len());
        let two: Vec<u8> = select_cases(&[13, 7]).unwrap().iter().map(|case| case.number).collect();
        assert_eq!(two, [7, 13]);
        let refused = select_cases(&[7, 4]).unwrap_err();
        assert!(refused.to_string().contains("no case 4") && refused.code == 2, "{refused:?}");
    }

    #[test]
    fn figures_beyond_their_tolerance_exit_with_code_1() {
        let finding = |error| Finding {
            case: 7,
            kind: "image".into(),
            place: "here".into(),
            error,
            tolerance: 1e-5,
        };
        let tested = |errors: &[f64]| {
            let findings = errors.iter().map(|&error| finding(error)).collect();
            vec![SubjectReport { subject: "native".into(), cases: vec![(cases()[0], findings)] }]
        };
        assert_eq!(check_tolerances(&tested(&[0.0, 1e-5])).unwrap(), 2);
        for wrong in [1.1e-5, f64::NAN, f64::INFINITY] {
            let failure = check_tolerances(&tested(&[0.0, wrong])).unwrap_err();
            assert_eq!(failure.code, OTHER);
            assert!(failure.to_string().starts_with("1 of 2 figures"), "{failure}");
        }
    }
}
