//! Checkpoints: of a session, and of a run that a program steps through itself.

use std::path::{Path, PathBuf};

use super::records::{Logs, SavedSession, Unwritten};
use super::{Run, write_cameras};
use crate::failure::{Failure, ResumeProblem};
use crate::observer::Silent;
use densify_train::checkpoint::{
    CheckpointError, Header, checkpoint_path, newest_step, remove_older, write,
};
use densify_train::output::RunFolder;

/// The files of a run that records are added to.
pub(super) struct Opened {
    /// The configuration in the form in which checkpoints store it.
    pub(super) config: toml::Table,
    pub(super) logs: Logs,
    /// Names of logs that have lost records.
    pub(super) lost: Vec<&'static str>,
}

/// Writes the configuration, the cameras, and what the logs lack, into `folder`.
pub(super) fn open(run: &mut Run, folder: &Path) -> Result<Opened, Failure> {
    run.config.write(folder)?;
    let config = run.config.table()?;
    write_cameras(run, folder, None)?;
    let (mut logs, lost) = match &run.logs {
        None => (Logs::create(folder)?, Vec::new()),
        Some(lengths) => Logs::resume(folder, lengths)?,
    };
    logs.write(&run.unwritten, &Silent)?;
    Ok(Opened { config, logs, lost })
}

/// Writes a checkpoint of the run's present state into `folder`, and removes older ones. `config` is the run's
/// configuration in the form in which checkpoints store it, `session` the state of the logs.
pub(super) fn write_state(
    run: &mut Run,
    folder: &Path,
    config: toml::Table,
    session: serde_json::Value,
) -> Result<(), CheckpointError> {
    let step = run.trainer.steps_done();
    let trainer = run.trainer.state();
    let header = Header {
        densify: run.config.densify.clone(),
        budget: run.config.budget,
        sh_degree: run.config.sh_degree,
        config,
        dataset: run.fingerprint.clone(),
        trainer: trainer.map_err(|source| CheckpointError::Policy { source })?,
        session,
    };
    write(&checkpoint_path(folder, step), &header, run.trainer.backend())?;
    remove_older(folder, step);
    run.checkpoint = Some(step);
    run.newest_checkpoint = newest_step(folder);
    Ok(())
}

impl Run {
    /// Writes the configuration and a checkpoint into the run's folder, from which the run can be resumed, and returns
    /// the folder; this run can also go on.
    ///
    /// # Errors
    /// When the folder contains another run, or this run was continued there by somebody else; when it cannot be
    /// written, or the policy cannot save its state. A new folder is then removed again.
    pub fn save_checkpoint(&mut self) -> Result<PathBuf, Failure> {
        self.check_continued()?;
        if self.checkpoint == Some(self.trainer.steps_done()) {
            return Ok(self.output.clone());
        }
        let is_new = self.logs.is_none();
        let folder = if is_new {
            RunFolder::create(&self.output, false)?
        } else {
            RunFolder::resume(&self.output, false)?
        };
        match self.save_into(&folder.path()) {
            Ok(()) => Ok(folder.path()),
            Err(failure) if is_new => {
                folder.discard();
                Err(failure)
            }
            Err(failure) => Err(failure),
        }
    }

    /// Fails if the run's folder has a checkpoint that this run has neither written nor resumed from.
    ///
    /// # Errors
    /// [`ResumeProblem::Continued`].
    pub fn check_continued(&self) -> Result<(), Failure> {
        if self.logs.is_some() && newest_step(&self.output) != self.newest_checkpoint {
            return Err(ResumeProblem::Continued { output: self.output.clone() }.into());
        }
        Ok(())
    }

    fn save_into(&mut self, folder: &Path) -> Result<(), Failure> {
        let Opened { config, logs, .. } = open(self, folder)?;
        let session = logs.save(&self.totals, self.process)?;
        write_state(self, folder, config, session.clone())?;
        let SavedSession { logs, .. } = serde_json::from_value(session).map_err(Failure::input)?;
        self.logs = Some(logs);
        self.unwritten = Unwritten::default();
        Ok(())
    }
}
