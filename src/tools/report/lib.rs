//! `densify report`: what runs arrived at, as one HTML file that refers to nothing outside itself.
//!
//! [`runs`] reads what the folders say, [`groups`] finds which runs belong together, [`views`] renders, and
//! the rest writes a part of the page each. Equal runs give equal bytes: no clock and no path of this machine is
//! in it. Prints nothing.

mod curves;
mod edits;
mod groups;
mod memory;
mod options;
mod page;
mod runs;
mod scores;
mod views;

use std::path::{Path, PathBuf};

use densify_core::files::write_atomically;
use densify_run::failure::Failure;
use densify_run::finished::Machine;
use densify_run::{DeviceSpec, Observer};
use groups::Groups;
use runs::Told;

/// What a report is wanted of.
pub struct Wanted<'a> {
    /// Folders of runs.
    pub runs: &'a [PathBuf],
    /// Which saved model of each; the last without.
    pub iteration: Option<u32>,
    /// Where the dataset is now.
    pub scene: Option<&'a Path>,
    pub device: &'a DeviceSpec,
}

/// Writes the report.
///
/// # Errors
/// When a folder is no run, has no model or is damaged, two are the same, or the dataset cannot be read.
pub fn write(wanted: &Wanted<'_>, file: &Path, observer: &dyn Observer) -> Result<(), Failure> {
    let runs = Told::read_all(wanted, observer)?;
    let groups = Groups::of(&runs)?;
    if wanted.scene.is_some()
        && let [first, second, ..] = &groups.scenes[..]
    {
        let (first, second) = (&first.label, &second.label);
        return Err(Failure::input(format!(
            "--scene is for runs of one scene, and these are of {first} and {second}; leave it out, or make a \
             report of each scene"
        )));
    }
    let machine = Machine::open(wanted.device, observer)?;
    let mut shown = Vec::new();
    for scene in &groups.scenes {
        shown.push(views::show(scene, &runs, wanted, &machine, observer)?);
    }
    let text = page::page(&runs, &groups, &shown)?;
    Ok(write_atomically(file, |out| out.write_all(text.as_bytes()))?)
}
