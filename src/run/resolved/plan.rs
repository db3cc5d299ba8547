//! `densify plan`: the size and memory of a run, and alternatives to them.

use std::fmt;

use super::ResolvedRun;
use super::case::Case;
use super::size::{self, MIB, RESOLUTIONS};
use crate::failure::{Failure, notes};
use crate::host::Host;
use crate::spec::{ByteCount, RunSpec};
use densify_core::memory::Ledger;
use densify_core::numbers::grouped;
use densify_core::spelling::Spelling;
use densify_data::dataset::Resolution;

/// The size and memory of a run.
#[derive(Debug, Clone)]
pub struct Plan {
    /// The bytes of every buffer.
    pub ledger: Ledger,
    /// Lines for the user: the size with the reasons for it, and the ledger.
    pub lines: Vec<String>,
    /// Other sizes that fit the same memory.
    pub alternatives: Alternatives,
}

/// Number of rows that fit a memory limit, by degree and image size.
#[derive(Debug, Clone)]
pub struct Alternatives {
    /// The memory limit `[bytes]`.
    pub memory: u64,
    /// `--resolution`, and width and height of the largest image `[px]`.
    pub images: Vec<(u32, (u32, u32))>,
    /// Rows at each degree and each size of the images; `None` if none fit.
    pub rows: Vec<Vec<Option<usize>>>,
}

/// Resolves a run without training or writing anything.
///
/// # Errors
/// The errors of preparing the run.
pub fn plan(spec: &RunSpec, host: Host<'_>) -> Result<Plan, Failure> {
    let ResolvedRun { case, size, mut reasons, .. } = ResolvedRun::for_new_run(spec, host)?;
    let ledger = case.ledger_of(&size)?;
    reasons.extend(case.trial_line(&size)?);
    reasons.push(case.memory_table(&ledger, host.observer.spelling()));
    let limited = case.inputs.device.limited_bytes(&ledger);
    if case.memory().is_none() {
        let needed = size::needed_bytes(&case, &size)?;
        if needed + MIB < limited {
            reasons.push(notes::for_speed(host.observer.spelling(), needed, limited - needed));
        }
    }
    let memory = case.memory().unwrap_or(limited.next_multiple_of(MIB));
    let alternatives = alternatives(&case, memory, size.rows)?;
    Ok(Plan { ledger, lines: reasons, alternatives })
}

/// Sizes of this run that fit `memory` if `--budget` is ignored. A model of `planned` rows counts as useful, however
/// small.
fn alternatives(case: &Case<'_>, memory: u64, planned: usize) -> Result<Alternatives, Failure> {
    let own = case.spec.data.resolution.unwrap_or(Resolution::Divisor(1));
    let mut resolutions = vec![own];
    resolutions.extend(RESOLUTIONS.into_iter().filter(|&other| other != own));
    resolutions.sort_by_key(|resolution| match resolution {
        Resolution::Width(_) => 0,
        Resolution::Divisor(divisor) => *divisor,
    });
    let spec = |resolution: Resolution| {
        let mut spec = case.spec.clone();
        spec.size.memory = Some(ByteCount(memory));
        let other = Some(resolution).filter(|_| resolution != own);
        spec.data.resolution = other.or(spec.data.resolution);
        (resolution, spec)
    };
    let specs: Vec<_> = resolutions.into_iter().map(spec).collect();
    // A resolution is left out if its images cannot be loaded.
    let cases = specs.iter().map(|(resolution, spec)| Some((*resolution, case.with(spec).ok()?)));
    let all: Vec<(Resolution, Case<'_>)> = cases.flatten().collect();
    let rows_at = |degree| {
        let at = |(_, case): &(_, Case<'_>)| size::rows_at(case, memory, degree, planned);
        all.iter().map(at).collect()
    };
    Ok(Alternatives {
        memory,
        images: all
            .iter()
            .map(|(resolution, case)| (resolution.number(), case.inputs.dataset.largest_image()))
            .collect(),
        rows: (0..=3).map(rows_at).collect::<Result<_, _>>()?,
    })
}

impl fmt::Display for Alternatives {
    /// A table for a terminal.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // In a form that users can type, without rounding.
        let memory = match self.memory % MIB {
            0 => format!("{}MiB", self.memory / MIB),
            _ => self.memory.to_string(),
        };
        let memory = Spelling::Terminal.text("memory", memory);
        write!(f, "Gaussians that {memory} holds\n  {:<11}", "")?;
        for (resolution, (width, height)) in &self.images {
            write!(f, "{:>22}", format!("-r {resolution} ({width}x{height})"))?;
        }
        for (degree, rows) in self.rows.iter().enumerate() {
            write!(f, "\n  degree {degree:<4}")?;
            for rows in rows {
                write!(f, "{:>22}", rows.map_or_else(|| "none".to_owned(), grouped))?;
            }
        }
        Ok(())
    }
}
