//! Checkpoints: of a session, and of a run that a program steps through itself.

use std::path::{Path, PathBuf};

use super::records::{Logs, SavedSession, Totals};
use super::{Run, write_cameras};
use crate::failure::{Failure, ResumeProblem};
use densify_train::checkpoint::{
    CheckpointError, Header, checkpoint_path, newest_step, remove_older, write,
};
use densify_train::output::RunFolder;

/// The files of a run that records are added to.
pub(super) struct Opened {
    /// The configuration in the form in which checkpoints store it.
    pub(super) config: toml::Table,
    pub(super) logs: Logs,
    pub(super) totals: Totals,
    /// Names of logs that have lost records.
    pub(super) lost: Vec<&'static str>,
}

/// Writes the configuration and the cameras into `folder`, and opens the logs there, in the state that was `saved`.
pub(super) fn open(
    run: &Run,
    folder: &Path,
    saved: Option<SavedSession>,
) -> Result<Opened, Failure> {
    run.config.write(folder)?;
    let config = run.config.table()?;
    write_cameras(run, folder, None)?;
    let (logs, totals, lost) = match saved {
        None => (Logs::create(folder)?, Totals::after(run.spent), Vec::new()),
        Some(saved) => Logs::resume(folder, saved)?,
    };
    Ok(Opened { config, logs, totals, lost })
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
    /// the folder; this run can also go on. Steps that were done one by one have no records in the logs.
    ///
    /// # Errors
    /// When the folder contains another run, or this run was continued there by somebody else; when it cannot be
    /// written, or the policy cannot save its state. A new folder is then removed again.
    pub fn save_checkpoint(&mut self) -> Result<PathBuf, Failure> {
        self.check_continued()?;
        if self.checkpoint == Some(self.trainer.steps_done()) {
            return Ok(self.output.clone());
        }
        let is_new = self.session.is_none();
        let folder = if is_new {
            RunFolder::create(&self.output, false)?
        } else {
            RunFolder::resume(&self.output, false)?
        };
        match self.save_into(&folder.path()) {
            Ok(session) => {
                self.session = Some(session);
                Ok(folder.path())
            }
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
        if self.session.is_some() && newest_step(&self.output) != self.newest_checkpoint {
            return Err(ResumeProblem::Continued { output: self.output.clone() }.into());
        }
        Ok(())
    }

    fn save_into(&mut self, folder: &Path) -> Result<SavedSession, Failure> {
        let Opened { config, logs, totals, .. } = open(self, folder, self.session.clone())?;
        let session = logs.save(&totals, self.process)?;
        write_state(self, folder, config, session.clone())?;
        serde_json::from_value(session).map_err(Failure::input)
    }
}
