//! `densify report`: the results of one or several runs as a self-contained HTML file.
//!
//! `runs` reads the folders, `groups` finds runs of the same scene and settings, `pictures` renders, and each of
//! the other modules writes a part of the page. The same runs give the same bytes: the page contains neither the time
//! nor a path of this machine. Prints nothing.

mod curves;
mod edits;
mod groups;
mod memory;
mod options;
mod page;
mod pictures;
mod runs;
mod scores;

use std::path::{Path, PathBuf};

use densify_core::files::write_atomically;
use densify_run::failure::Failure;
use densify_run::finished::Machine;
use densify_run::{DeviceSpec, Observer};
use runs::RunRecord;

/// The runs to report on, and how to render them.
pub struct ReportOptions<'a> {
    /// Folders of runs.
    pub runs: &'a [PathBuf],
    /// Iteration of the saved models; by default the last of each run.
    pub iteration: Option<u32>,
    /// The dataset, if it has moved since the runs.
    pub dataset: Option<&'a Path>,
    /// Device to render on.
    pub device: &'a DeviceSpec,
}

/// Writes the report.
///
/// # Errors
/// If a folder is not a run, has no model, is damaged or is given twice, or the dataset cannot be read.
pub fn write(
    options: &ReportOptions<'_>,
    file: &Path,
    observer: &dyn Observer,
) -> Result<(), Failure> {
    let runs = RunRecord::read_all(options, observer)?;
    let scenes = groups::group(&runs)?;
    if options.dataset.is_some()
        && let [first, second, ..] = &scenes[..]
    {
        let (first, second) = (&first.label, &second.label);
        return Err(Failure::input(format!(
            "--scene is for runs of one scene, and these are of {first} and {second}; leave it out, or report on \
             each scene separately"
        )));
    }
    let machine = Machine::open(options.device, observer)?;
    let mut pictures = Vec::new();
    for scene in &scenes {
        pictures.push(pictures::render(scene, &runs, options, &machine, observer)?);
    }
    let text = page::page(&runs, &scenes, &pictures)?;
    Ok(write_atomically(file, |out| out.write_all(text.as_bytes()))?)
}
