//! What a run would take, without the run.

use std::fmt;

use super::size::{self, MIB, RESOLUTIONS, Size};
use super::{Begun, Inputs, Known, ModelSize, RunConfig, RunSpec};
use crate::companion::Companion;
use crate::config::Resolved;
use crate::failure::Failure;
use crate::observer::Observer;
use crate::values::ByteCount;
use densify_core::memory::Ledger;
use densify_core::numbers::grouped;
use densify_data::dataset::Resolution;
use densify_train::exposure::ExposureChoice;

/// How large a run would be, and what it would take.
#[derive(Debug, Clone)]
pub struct Plan {
    /// Bytes per buffer.
    pub ledger: Ledger,
    /// Why the size is what it is, a line each, and the ledger.
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
pub fn plan(
    spec: &RunSpec,
    companion: Option<Companion>,
    observer: &dyn Observer,
) -> Result<Plan, Failure> {
    let inputs = Inputs::load(spec, None, companion, observer)?;
    let size = Size::choose(&inputs)?;
    let rows = size.setting.rows;
    let ledger = inputs.ledger(&size.setting, &inputs.needs(rows)?);
    let lines = inputs.choices().chain(size.lines(&inputs));
    let lines = lines.chain([inputs.promise(&ledger)]).collect();
    let limited = inputs.device.limited_bytes(&ledger);
    let memory = spec.size.memory.map_or(limited.next_multiple_of(MIB), |it| it.0);
    let alternatives = alternatives(&inputs, memory, rows)?;
    Ok(Plan { ledger, lines, alternatives })
}

/// The rows that fit, and what a run takes whose models of `--init` and `--freeze` are not there yet. Exposures count
/// where they may be learned.
///
/// # Errors
/// As [`plan`].
pub fn promised(
    spec: &RunSpec,
    [init_model, frozen]: [Option<ModelSize>; 2],
    observer: &dyn Observer,
) -> Result<(usize, Ledger), Failure> {
    let has_exposures = spec.schedule.exposure != ExposureChoice::Off;
    let resolved = Resolved { init_model, frozen, has_exposures, ..Resolved::default() };
    let config = RunConfig { densify: String::new(), spec: spec.clone(), resolved };
    let known = Known { config: &config, exposures: Begun::Reckoned };
    let inputs = Inputs::load(spec, Some(known), None, observer)?;
    let setting = Size::choose(&inputs)?.setting;
    let ledger = inputs.ledger(&setting, &inputs.needs(setting.rows)?);
    Ok((setting.rows, ledger))
}

/// What a run takes of the host's memory at most `[bytes]`.
///
/// # Errors
/// As [`plan`].
pub fn promised_bytes(spec: &RunSpec, observer: &dyn Observer) -> Result<u64, Failure> {
    let inputs = Inputs::load(spec, None, None, observer)?;
    let setting = Size::choose(&inputs)?.setting;
    Ok(inputs.ledger(&setting, &inputs.needs(setting.rows)?).on_host())
}

/// What `memory` holds, as the solver finds it for such a run without `--budget`; `planned` rows are a model.
fn alternatives(inputs: &Inputs<'_>, memory: u64, planned: usize) -> Result<Alternatives, Failure> {
    let own = inputs.spec.data.resolution.unwrap_or(Resolution::Divisor(1));
    let mut resolutions = vec![own];
    resolutions.extend(RESOLUTIONS.into_iter().filter(|&other| other != own));
    resolutions.sort_by_key(|resolution| match resolution {
        Resolution::Width(_) => 0,
        Resolution::Divisor(divisor) => *divisor,
    });
    let specs = resolutions.into_iter().map(|resolution| {
        let mut spec = inputs.spec.clone();
        spec.size.memory = Some(ByteCount(memory));
        spec.data.resolution =
            Some(resolution).filter(|_| resolution != own).or(spec.data.resolution);
        (resolution, spec)
    });
    let specs: Vec<(Resolution, RunSpec)> = specs.collect();
    // Where there are no images of a size, it is left out.
    let at = |(resolution, spec)| Some((resolution, inputs.with(spec).ok()?));
    let all: Vec<(&Resolution, Inputs<'_>)> =
        specs.iter().filter_map(|(resolution, spec)| at((resolution, spec))).collect();
    let rows_at = |degree| {
        let at = |(_, inputs): &(_, Inputs<'_>)| size::rows_at(inputs, memory, degree, planned);
        all.iter().map(at).collect()
    };
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
        // As it can be typed, and nothing rounded.
        let memory = match self.memory % MIB {
            0 => format!("{}MiB", self.memory / MIB),
            _ => self.memory.to_string(),
        };
        write!(f, "Gaussians that --memory {memory} holds\n  {:<11}", "")?;
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
