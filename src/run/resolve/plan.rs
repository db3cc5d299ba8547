//! What a run would take, without the run.

use std::fmt;

use super::size::{self, RESOLUTIONS, Size};
use super::{Inputs, RunSpec};
use crate::dataset::Resolution;
use crate::failure::Failure;
use crate::memory::{Bytes, Ledger};
use crate::number::grouped;
use crate::run::observer::Observer;

/// How large a run would be, and what it would take.
#[derive(Debug, Clone)]
pub struct Plan {
    /// Bytes per buffer.
    pub ledger: Ledger,
    /// Why the size is what it is, a line each.
    pub lines: Vec<String>,
    /// What else the same memory holds.
    pub alternatives: Alternatives,
}

/// Rows that a memory holds, by degree and by size of the images.
#[derive(Debug, Clone)]
pub struct Alternatives {
    /// The memory `[bytes]`.
    pub memory: u64,
    /// `--resolution`, and width and height of the largest image `[px]`.
    pub images: Vec<(u32, (u32, u32))>,
    /// Rows at each degree and each size of the images; `None` where none fit.
    pub rows: Vec<Vec<Option<usize>>>,
}

/// Finds out what a run would take. Trains nothing and writes nothing.
pub fn plan(spec: &RunSpec, observer: &dyn Observer) -> Result<Plan, Failure> {
    let inputs = Inputs::load(spec, None, observer)?;
    let size = Size::choose(&inputs)?;
    let lines = inputs.degree.line().into_iter().chain(size.lines(&inputs)).collect();
    let needs = inputs.needs(size.setting.rows)?;
    let ledger = inputs.ledger(&size.setting, &needs, inputs.threads());
    size::check(&inputs, &ledger)?;
    let memory = spec.size.memory.map_or_else(|| inputs.device.limited_bytes(&ledger), |it| it.0);
    let alternatives = alternatives(inputs, memory)?;
    Ok(Plan { ledger, lines, alternatives })
}

fn alternatives(inputs: Inputs<'_>, memory: u64) -> Result<Alternatives, Failure> {
    let own = inputs.data.resolution.unwrap_or(Resolution::Divisor(1));
    let mut all: Vec<(Resolution, Inputs<'_>)> = RESOLUTIONS
        .into_iter()
        .filter(|&resolution| resolution != own)
        .filter_map(|resolution| Some((resolution, inputs.at_resolution(resolution)?)))
        .collect();
    all.push((own, inputs));
    all.sort_by_key(|(resolution, _)| match resolution {
        Resolution::Width(_) => 0,
        Resolution::Divisor(divisor) => *divisor,
    });
    let rows_at =
        |degree| all.iter().map(|(_, inputs)| size::rows_at(inputs, memory, degree)).collect();
    Ok(Alternatives {
        memory,
        images: all
            .iter()
            .map(|(resolution, inputs)| (resolution.number(), inputs.dataset.largest_image()))
            .collect(),
        rows: (0..=3).map(rows_at).collect::<Result<_, _>>()?,
    })
}

impl fmt::Display for Alternatives {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Gaussians that --memory {} holds\n  {:<11}", Bytes(self.memory), "")?;
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
