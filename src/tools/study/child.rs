//! Runs of `densify` in processes of their own, whose memory is then the run's alone; each is given a file
//! that describes it.

use std::fmt::Display;
use std::path::Path;
use std::process::{Command, Stdio};

use densify_core::files::write_atomically;
use densify_data::dataset::{GroundTruth, builtin};
use densify_launch::program;
use densify_run::failure::{Failure, OTHER};
use densify_run::{Partial, RunSpec};
use densify_train::output::{Summary, summary_of};

/// A run of a study, by its description, and the folder that it writes.
pub(super) struct Child<'a> {
    pub(super) spec: &'a Partial,
    pub(super) folder: &'a Path,
}

impl Child<'_> {
    /// Trains.
    pub(super) fn train(&self) -> Result<(), Failure> {
        // Appended, as a name may hold a dot.
        let mut file = self.folder.as_os_str().to_owned();
        file.push(".toml");
        let text = toml::to_string(&self.spec.clone().into_table()).map_err(Failure::input)?;
        write_atomically(Path::new(&file), |out| out.write_all(text.as_bytes()))?;
        let mut command = Command::new(program()?);
        command.arg("train").arg("--config").arg(file).args(["--overwrite", "--quiet", "--output"]);
        wait_for(command.arg(self.folder))
    }

    /// Measures what was trained, with `densify eval`, on the device that trained it.
    pub(super) fn measure(&self) -> Result<(), Failure> {
        let RunSpec { start, device, .. } = self.spec.clone().describe()?;
        let mut command = Command::new(program()?);
        command.arg("eval").arg(self.folder);
        command.arg("--scene").arg(start.scene.unwrap_or_default());
        command.args(["--backend", device.backend.word()]);
        if let Some(name) = device.gpu {
            command.args(["--gpu", &name]);
        }
        if let Some(threads) = device.threads {
            command.args(["--threads", &threads.0.to_string()]);
        }
        wait_for(&mut command)
    }
}

/// The description that all runs of a study share: the options that the user gave, but views are held
/// out, and no checkpoints are written, as a run that is interrupted runs again so that its times are
/// whole.
pub(super) fn shared_options(given: Partial, own: &[&str]) -> Result<Partial, Failure> {
    if let Some((name, _)) = given.iter().find(|(name, _)| own.contains(name)) {
        return Err(Failure::input(format!(
            "--{} is set by the study itself; leave it out after `--`",
            name.replace('_', "-")
        )));
    }
    let mut least = Partial::option("checkpoint_every", 0);
    if given.get("test_every").is_none() {
        least = Partial::option("eval", true).over(least);
    }
    Ok(given.over(least))
}

/// A failure within a run of a study.
pub(super) fn in_run(run: &impl Display, failure: Failure) -> Failure {
    failure.and(&format!("this was the run {run}; the same command goes on from here"))
}

fn wait_for(command: &mut Command) -> Result<(), Failure> {
    let child = command
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .output()
        .map_err(|e| Failure::new(OTHER, format!("cannot start a run: {e}")))?;
    if child.status.success() {
        return Ok(());
    }
    let said = String::from_utf8_lossy(&child.stderr);
    let message = said.trim().trim_start_matches("error: ").to_owned();
    let code = child.status.code().and_then(|code| u8::try_from(code).ok());
    Err(Failure::new(code.unwrap_or(OTHER), message))
}

/// `stats/summary.json` of a run.
pub(super) fn summary(run: &Path) -> Result<Summary, Failure> {
    summary_of(run)?.ok_or_else(|| {
        Failure::new(OTHER, format!("{}: there is no stats/summary.json", run.display()))
    })
}

/// Whether the surface of a scene is known.
pub(super) fn has_geometry(scene: &Path) -> bool {
    builtin::name(scene).is_some() || GroundTruth::is_in(scene)
}
