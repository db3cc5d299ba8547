//! Merges the blocks: streams the Gaussians in each block's cell into one file.

use std::fs::File;
use std::io::Write;
use std::path::Path;

use super::status::is_complete;
use super::{Block, BlockPlan, Task, run_folder};
use densify_core::files::WriteError;
use densify_core::gaussians::{Gaussians, sh_coefficients};
use densify_core::pieces::ROWS_AT_A_TIME;
use densify_data::models::{Format, Frame, Shape, offset_text};
use densify_run::failure::{Failure, OTHER};
use densify_run::finished::{iteration, read_model, say_unstated};
use densify_run::{Observer, RunConfig, Silent};
use densify_train::importance::{footprints, largest};
use densify_train::output::model_path;

/// Memory of the program apart from models `[bytes]`.
const PROGRAM_MEMORY: u64 = 32 << 20;

/// A merged model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Merged {
    /// Number of Gaussians.
    pub rows: usize,
    /// Size of the file `[bytes]`.
    pub bytes: u64,
    /// Names of incomplete blocks, which were left out.
    pub missing: Vec<String>,
}

/// Upper bound of the memory of a merge `[bytes]`, if no block has more than `largest` rows, frozen rows included. It
/// covers a block's model while it is read into growing arrays, and the part of this model in the cell.
pub(super) fn memory(largest: usize, sh_degree: u8) -> u64 {
    let row = size_of::<f32>() * (11 + 3 * sh_coefficients(sh_degree));
    PROGRAM_MEMORY + 4 * (largest * row) as u64
}

/// Merges the blocks into a file; with `partial`, only the complete ones.
///
/// # Errors
/// If a required block is incomplete, or a file cannot be read or written; nothing is written then.
pub fn merge(
    folder: &Path,
    plan: &BlockPlan,
    output: &Path,
    format: &Format,
    partial: bool,
    observer: &dyn Observer,
) -> Result<Merged, Failure> {
    let (complete, missing): (Vec<usize>, Vec<usize>) =
        (0..plan.block.len()).partition(|&index| is_complete(folder, plan, Task::Block(index)));
    let missing: Vec<String> =
        missing.into_iter().map(|index| plan.block[index].name.clone()).collect();
    if !missing.is_empty() && !partial {
        return Err(Failure::input(format!(
            "not complete: {}; run them (`densify blocks submit`), or merge the others with --partial",
            missing.join(", ")
        )));
    }
    if complete.is_empty() {
        return Err(Failure::input(
            "no block is complete; run the plan first (`densify blocks submit`)",
        ));
    }
    // The header holds the number of rows, so each block is read twice.
    let mut rows = 0;
    let (mut frame, mut first_antialiasing) = (Frame::WORLD, None);
    for &index in &complete {
        let part = read_part(folder, plan, index, observer)?;
        rows += part.len();
        // Blocks in local coordinates have offsets of their own; the merged model gets that of the first block.
        if frame.offset().is_none() {
            frame = Frame::from_origin(part.origin);
        }
        let antialiasing = *first_antialiasing.get_or_insert(part.antialiasing);
        if part.antialiasing != antialiasing {
            return Err(Failure::input(format!(
                "{} was trained with antialiasing {}, but the blocks before it with {antialiasing}; train this block \
                 again",
                plan.block[index].name, part.antialiasing
            )));
        }
    }
    if rows > plan.rows {
        let message = format!("{rows} Gaussians, but the plan allows {}; this is a bug", plan.rows);
        return Err(Failure::new(OTHER, message));
    }
    let antialiasing = first_antialiasing.unwrap_or_default();
    let shape = Shape { rows, sh_degree: plan.sh_degree, antialiasing, frame };
    let write = |out: &mut dyn Write| {
        let mut writer = format.open_writer(shape, out)?;
        for &index in &complete {
            let part = read_part(folder, plan, index, &Silent).map_err(WriteError::Source)?;
            let part = part.with_origin(frame.origin);
            let rows: Vec<usize> = (0..part.len()).collect();
            for piece in rows.chunks(ROWS_AT_A_TIME) {
                writer.rows(&part.gather(piece), out)?;
            }
        }
        Ok(writer.finish(out)?)
    };
    format.write_checked(output, frame, write, |_| Ok::<_, Failure>(()))?;
    if let Some(offset) = frame.offset() {
        observer.say(format_args!("coords   local, from the offset {}", offset_text(offset)));
    }
    say_unstated(format, output, frame, antialiasing, observer);
    let bytes = File::open(output).and_then(|file| file.metadata());
    let bytes = bytes.map_err(|error| Failure::input(format!("{}: {error}", output.display())))?;
    Ok(Merged { rows, bytes: bytes.len(), missing })
}

/// Reads the Gaussians that a block has trained in its cell. If they exceed its share, the faintest and smallest are
/// left out.
fn read_part(
    folder: &Path,
    plan: &BlockPlan,
    index: usize,
    observer: &dyn Observer,
) -> Result<Gaussians, Failure> {
    let Block { cell, rows: limit, .. } = &plan.block[index];
    let run = run_folder(folder, plan, Task::Block(index));
    let frozen = RunConfig::read(&run)?.resolved.frozen.map_or(0, |model| model.rows);
    let model = read_model(&model_path(&run, iteration(&run, None)?), observer)?;
    // Frozen rows come first in the model of a run.
    let mut rows = plan.rows_in_cell(cell, &model);
    rows.retain(|&row| row >= frozen);
    let part = model.gather(&rows).with_degree(plan.sh_degree);
    Ok(if part.len() > *limit { part.gather(&largest(&footprints(&part), *limit)) } else { part })
}
