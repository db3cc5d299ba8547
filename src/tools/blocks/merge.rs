//! Puts the blocks together: of each the rows in its cell, streamed into one file.

use std::fs::File;
use std::path::Path;

use super::crop::inside;
use super::{Block, Blocks, Task, run_folder};
use densify_core::files::{WriteError, write_atomically_from};
use densify_core::gaussians::{Gaussians, sh_coefficients};
use densify_core::pieces::ROWS_AT_A_TIME;
use densify_data::models::{Format, Shape};
use densify_run::failure::{Failure, OTHER};
use densify_run::finished::{iteration, read_model};
use densify_run::{Observer, RunConfig, Silent};
use densify_train::importance::{footprints, largest};
use densify_train::output::model_path;

/// What the program takes beside models `[bytes]`.
const PROGRAM: u64 = 32 << 20;

/// What was merged.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Merged {
    /// Gaussians.
    pub rows: usize,
    /// Size of the file `[bytes]`.
    pub bytes: u64,
    /// Names of the blocks that are not complete, and so are not in it.
    pub missing: Vec<String>,
}

/// What merging takes at most, where a block and what it has frozen have so many rows `[bytes]`: its model as it is
/// read, into arrays that grow, and the part that is kept.
pub(super) fn memory(largest: usize, sh_degree: u8) -> u64 {
    let row = size_of::<f32>() * (11 + 3 * sh_coefficients(sh_degree));
    PROGRAM + 4 * (largest * row) as u64
}

/// Merges the blocks into a file; where `partial`, those that are complete.
///
/// # Errors
/// When a block is not complete, or a file cannot be read or written; then nothing is written.
pub fn merge(
    folder: &Path,
    blocks: &Blocks,
    output: &Path,
    format: &Format,
    partial: bool,
    observer: &dyn Observer,
) -> Result<Merged, Failure> {
    let is_there = |place: &usize| super::status::is_complete(folder, blocks, Task::Block(*place));
    let (there, missing): (Vec<usize>, Vec<usize>) =
        (0..blocks.block.len()).partition(|place| is_there(place));
    let missing: Vec<String> =
        missing.into_iter().map(|place| blocks.block[place].name.clone()).collect();
    if !missing.is_empty() && !partial {
        return Err(Failure::input(format!(
            "not complete: {}; run them (`densify blocks submit`), or merge the others with --partial",
            missing.join(", ")
        )));
    }
    if there.is_empty() {
        return Err(Failure::input(
            "no block is complete; run the plan first (`densify blocks submit`)",
        ));
    }
    // The number of rows comes first in a file, so each block is read twice.
    let mut rows = 0;
    for &place in &there {
        rows += part(folder, blocks, place, observer)?.len();
    }
    if rows > blocks.rows {
        let message = format!("{rows} rows of the promised {}; this is a bug", blocks.rows);
        return Err(Failure::new(OTHER, message));
    }
    let shape = Shape { rows, sh_degree: blocks.sh_degree };
    write_atomically_from::<Failure>(output, |out| {
        let mut writer = format.open_writer()?;
        writer.begin(shape, out)?;
        for &place in &there {
            let part = part(folder, blocks, place, &Silent).map_err(WriteError::Source)?;
            let all: Vec<usize> = (0..part.len()).collect();
            for piece in all.chunks(ROWS_AT_A_TIME) {
                writer.rows(&part.gather(piece), out)?;
            }
        }
        Ok(writer.finish(out)?)
    })?;
    let bytes = File::open(output).and_then(|file| file.metadata());
    let bytes = bytes.map_err(|error| Failure::input(format!("{}: {error}", output.display())))?;
    Ok(Merged { rows, bytes: bytes.len(), missing })
}

/// What a block has trained in its cell; of more than its share the faintest and smallest are left out.
fn part(
    folder: &Path,
    blocks: &Blocks,
    place: usize,
    observer: &dyn Observer,
) -> Result<Gaussians, Failure> {
    let Block { cell, rows: most, .. } = &blocks.block[place];
    let run = run_folder(folder, blocks, Task::Block(place));
    let frozen = RunConfig::read(&run)?.resolved.frozen.map_or(0, |model| model.rows);
    let model = read_model(&model_path(&run, iteration(&run, None)?), observer)?;
    let part = model.gather(&inside(blocks, cell, &model, frozen)).with_degree(blocks.sh_degree);
    Ok(if part.len() > *most { part.gather(&largest(&footprints(&part), *most)) } else { part })
}
