//! The session of a run: the loop around the trainer with its progress, logs, saved models, measurements and
//! checkpoints. The file is not split because all of this happens between two steps, and the order matters.

mod checkpoint;
mod coordinates;
mod degree_trial;
mod first_model;
mod geometry;
mod prepare;
mod records;
mod requirements;
mod resume;
mod run;
mod summary;

pub use requirements::{LeftOut, Reductions, Requirements};
pub use resume::{Resumed, start};
pub use run::Run;

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use glam::DVec3;

use crate::failure::{Failure, INPUT, OTHER, TrainingProblem};
use crate::observer::{Interrupt, NextAction, Observer, say_notes};
use checkpoint::{Opened, open, write_state};
use densify_core::files::{FileError, write_atomically};
use densify_data::models::{PLY, Shape};
use densify_data::views::ViewSource;
use densify_train::checkpoint::{CheckpointError, checkpoint_path};
use densify_train::evaluate::{Comparison, EvaluateError, Split, evaluate};
use densify_train::exposure::named_transforms;
use densify_train::output::{
    CHECKPOINTS, CONFIG_FILE, Guard, Mean, RunFolder, cameras_json, model_path, saved_iterations,
    write_json, write_scores,
};
use densify_train::trainer::{StepReport, TrainError};
use densify_train::vignette::named_vignettes;
use geometry::measure;
use records::{Logs, Unwritten};

/// The file beside a model with the exposures of the training views.
const EXPOSURES: &str = "exposure.json";
/// The file beside a model with the vignettes of the cameras.
const VIGNETTES: &str = "vignette.json";

/// A run in progress.
struct Session<'a> {
    run: Run,
    /// The configuration in the form in which checkpoints store it.
    config: toml::Table,
    observer: &'a dyn Observer,
    /// The folder that files are written to.
    folder: PathBuf,
    logs: Logs,
    /// Detects that another run has taken over the folder.
    guard: Guard,
    /// True if the user has been told about the coordinates of saved models.
    has_told_coordinates: bool,
}

/// Treatment of a run that already exists in the output folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Occupied {
    /// Keep it, and refuse the new run.
    Refuse,
    /// Replace it with the new run once the new run is complete.
    Replace,
    /// Resume it.
    Resume,
}

/// Trains to the end and writes all files of the run; returns the folder.
fn train(run: Run, if_exists: Occupied, observer: &dyn Observer) -> Result<PathBuf, Failure> {
    // Nothing is removed from a run that is being resumed, even if it consists only of its configuration file.
    let has_begun = run.logs.is_some() || run.output.join(CONFIG_FILE).exists();
    let resumes = if_exists == Occupied::Resume && has_begun;
    let folder = match if_exists {
        Occupied::Resume => RunFolder::resume(&run.output, run.logs.is_none())?,
        Occupied::Refuse | Occupied::Replace => {
            RunFolder::create(&run.output, if_exists == Occupied::Replace)?
        }
    };
    let mut session = match Session::start(run, &folder, observer) {
        Ok(session) => session,
        // What an earlier session has written must not be removed.
        Err(error) if resumes => return Err(error),
        Err(error) => {
            folder.discard();
            return Err(error);
        }
    };
    let trained = session.run_steps();
    let guard = folder.guard();
    let finished = trained
        .and_then(|()| guard.check().map_err(Failure::from))
        .and_then(|()| session.write_summary(true).map_err(Failure::from));
    match finished {
        Ok(()) => {
            let path = folder.finish()?;
            session.report(&path);
            measure(session, &path).map_err(|failure| {
                failure.with(TrainingProblem::OnlyMeasuringFailed { run: path.clone() })
            })?;
            Ok(path)
        }
        // Another run may have taken over the folder.
        Err(failure) if guard.check().is_err() => Err(failure),
        // For example, a photograph cannot be decoded and the run has not yet saved anything worth keeping.
        Err(failure) if failure.code == INPUT && !resumes && has_no_results(&folder.path()) => {
            // Dropping the last guard releases the lock; only then can the folder be removed.
            drop((session, guard));
            folder.discard();
            Err(failure)
        }
        // `failure` is the cause; a further error while writing the summary would add nothing.
        Err(failure) => {
            let _ = session.write_summary(false);
            let scene = session.run.spec.start.scene.clone().unwrap_or_default();
            let kept = session.run.checkpoint;
            drop(session);
            let run = folder.abandon();
            let checkpoint = kept.map(|step| checkpoint_path(&run, step));
            Err(failure.with(TrainingProblem::LeftBehind { run, checkpoint, scene }))
        }
    }
}

/// True if a run has left neither a model nor a checkpoint.
fn has_no_results(folder: &Path) -> bool {
    saved_iterations(folder).is_err() && !folder.join(CHECKPOINTS).exists()
}

/// Writes the cameras of all views in world coordinates, or relative to an offset.
fn write_cameras(run: &Run, folder: &Path, offset: Option<[f64; 3]>) -> Result<(), FileError> {
    let to_world = &run.dataset.normalisation;
    let test = run.dataset.test.iter().map(|view| (view, view.camera));
    let train = run.dataset.train.iter().enumerate();
    let train = train.map(|(number, view)| (view, run.trainer.camera(number)));
    let cameras = test.chain(train).map(|(view, camera)| {
        let mut camera = to_world.world_from_scene_camera(&camera);
        if let Some(offset) = offset {
            camera.translation += camera.rotation * DVec3::from(offset);
        }
        (&*view.name, camera)
    });
    write_atomically(&folder.join("cameras.json"), |out| {
        out.write_all(cameras_json(cameras)?.as_bytes())
    })
}

impl<'a> Session<'a> {
    fn start(
        mut run: Run,
        folder: &RunFolder,
        observer: &'a dyn Observer,
    ) -> Result<Self, Failure> {
        let (guard, folder) = (folder.guard(), folder.path());
        let folder = folder.as_path();
        let Opened { config, logs, lost } = open(&mut run, folder)?;
        run.unwritten = Unwritten::default();
        for name in lost {
            observer.say(format_args!("note: {name} has lost records; they stay missing"));
        }
        let folder = folder.to_owned();
        let has_told_coordinates = false;
        Ok(Self { run, config, observer, folder, logs, guard, has_told_coordinates })
    }

    /// Does all remaining steps.
    fn run_steps(&mut self) -> Result<(), Failure> {
        let done = self.run.trainer.steps_done();
        let (last, budget) = (self.run.last, self.run.config.budget);
        if done > 0 {
            // A run may have been stopped after its last step, before the model was saved and measured and the
            // checkpoint written.
            self.save_and_measure_if_due(done, true)?;
        }
        self.observer.begin(done, last, budget);
        let stepped = (done + 1..=last).try_for_each(|step| {
            self.consult_observer();
            if let Some(interrupt) = self.observer.interrupt() {
                return Err(self.stopped_by(interrupt));
            }
            let report = self.step()?;
            self.observer.step(step, report.output.loss, report.rows);
            self.save_and_measure_if_due(step, false)
        });
        self.observer.end();
        stepped.and_then(|()| self.check_drawn())
    }

    /// Lets the observer render the model, and writes the checkpoints that it asks for.
    fn consult_observer(&mut self) {
        loop {
            let (model, rows) = self.run.trainer.backend_and_history();
            match self.observer.between_steps(model, rows) {
                NextAction::Checkpoint => self.try_checkpoint(),
                NextAction::Step => return,
            }
        }
    }

    /// Writes a checkpoint. If that fails, training continues: the run is worth more than the checkpoint, and the
    /// previous checkpoint still exists.
    fn try_checkpoint(&mut self) {
        let step = self.run.trainer.steps_done();
        let trouble = self.write_checkpoint().err().map(|error| {
            tracing::error!(
                step,
                "the checkpoint could not be written, training continues: {error}"
            );
            format!("the checkpoint of step {step} could not be written: {error}")
        });
        self.observer.checkpoint_written(step, trouble.as_deref());
    }

    /// Fails if more than half of the last renderings are empty, because such a model is useless.
    fn check_drawn(&self) -> Result<(), Failure> {
        let drawn = &self.run.totals.drawn;
        let (views, empty) = (drawn.len(), drawn.iter().filter(|drawn| !**drawn).count());
        if 2 * empty <= views {
            return Ok(());
        }
        Err(Failure::with_code(OTHER, TrainingProblem::DrawsNothing { empty, views }))
    }

    /// Saves the model, measures it and writes a checkpoint, each if it is due after `step`. If the run `is_resumed`,
    /// results that exist are skipped.
    fn save_and_measure_if_due(&mut self, step: u32, is_resumed: bool) -> Result<(), Failure> {
        let (output, is_last) = (&self.run.spec.output, step == self.run.last);
        let every = output.checkpoint_every;
        let due = every > 0 && (step.is_multiple_of(every) || is_last);
        let [saves, tests] = [&output.save_iterations, &output.test_iterations]
            .map(|steps| is_last || steps.contains(&step));
        if due || saves || tests {
            self.guard.check()?;
        }
        let exists = |path: PathBuf| is_resumed && path.is_file();
        if saves && !exists(model_path(&self.folder, step)) {
            self.save(step)?;
        }
        if tests && !(is_resumed && self.run.totals.tested.contains_key(&step)) {
            self.test(step, is_last)?;
        }
        if due && !exists(checkpoint_path(&self.folder, step)) {
            self.try_checkpoint();
        }
        Ok(())
    }

    /// Writes a checkpoint.
    fn write_checkpoint(&mut self) -> Result<(), CheckpointError> {
        let step = self.run.trainer.steps_done();
        if self.run.checkpoint == Some(step) {
            return Ok(());
        }
        self.guard.check()?;
        let session = self.logs.save(&self.run.totals, self.run.process)?;
        write_state(&mut self.run, &self.folder, self.config.clone(), session)?;
        Ok(())
    }

    /// Ends the run so that it can be resumed later.
    fn stopped_by(&mut self, Interrupt { name, exit_code }: Interrupt) -> Failure {
        let step = self.run.trainer.steps_done();
        let stopped = TrainingProblem::Stopped { by: name, step: Some(step) };
        self.with_checkpoint(Failure::with_code(exit_code, stopped))
    }

    /// Writes a checkpoint of a run that ends with `failure`; the result also names an error in writing it.
    fn with_checkpoint(&mut self, failure: Failure) -> Failure {
        match self.write_checkpoint() {
            Ok(()) => failure,
            Err(error) => {
                failure.with(TrainingProblem::CheckpointFailed { error: error.to_string() })
            }
        }
    }

    /// Does one step and records it. If the policy fails, the model is saved; if values are not finite, or a photograph
    /// can no longer be read, a checkpoint is written.
    fn step(&mut self) -> Result<StepReport, Failure> {
        let train_views = self.run.dataset.train.len();
        match self.run.step() {
            Ok(report) => {
                self.record()?;
                Ok(report)
            }
            Err(error @ TrainError::Policy { .. }) => {
                let step = self.run.trainer.steps_done();
                let saved = self.save(step).map_err(|failure| failure.to_string());
                Err(Failure::from(error).with(TrainingProblem::ModelSaved { saved }))
            }
            Err(error @ TrainError::NonFinite { .. }) => Err(self.with_checkpoint(error.into())),
            // This photograph was readable in an earlier epoch, so the run is worth saving. In the first epoch, little
            // would be lost.
            Err(error @ TrainError::View { step, .. })
                if step > self.run.trainer.steps_done() && step as usize > train_views =>
            {
                Err(self.with_checkpoint(error.into()))
            }
            Err(error) => Err(error.into()),
        }
    }

    fn record(&mut self) -> Result<(), FileError> {
        let unwritten = std::mem::take(&mut self.run.unwritten);
        if !unwritten.records.is_empty() {
            say_notes(self.observer, &self.run.dataset.take_depth_faults());
        }
        self.logs.write(&unwritten, self.observer)
    }

    /// Writes the model and returns its file.
    fn save(&mut self, step: u32) -> Result<PathBuf, Failure> {
        self.guard.check()?;
        let path = model_path(&self.folder, step);
        let frame = self.choose_frame()?.0;
        let (backend, to_world) = (self.run.trainer.backend(), &self.run.dataset.normalisation);
        let shape = Shape {
            rows: backend.rows(),
            sh_degree: backend.sh_degree(),
            antialiasing: backend.antialiasing(),
            frame,
        };
        PLY.write_file(&path, shape, |piece| {
            Ok::<_, Failure>(to_world.world_from_model(backend.download_rows(piece)?, frame.origin))
        })?;
        let has_moved = self.run.trainer.progress().poses.is_some();
        if has_moved || frame.offset().is_some() {
            // Viewers show the model with these cameras.
            write_cameras(&self.run, &self.folder, frame.offset())?;
        }
        if let Some(exposures) = &self.run.trainer.progress().exposures {
            let names = self.run.dataset.train.iter().map(|view| &*view.name);
            let named = named_transforms(exposures, names);
            write_json(&path.with_file_name(EXPOSURES), &named)?;
        }
        if let Some(vignettes) = &self.run.trainer.progress().vignettes {
            let names = self.run.dataset.train.iter().map(|view| &*view.name);
            let named = named_vignettes(vignettes, names);
            write_json(&path.with_file_name(VIGNETTES), &named)?;
        }
        Ok(path)
    }

    /// Measures the test views, if there are any.
    fn test(&mut self, step: u32, is_last: bool) -> Result<(), Failure> {
        if self.run.test.count() == 0 {
            return Ok(());
        }
        let exact = self.round_means_as_saved()?;
        let Run { spec, trainer, test, config, .. } = &mut self.run;
        let (background, degree) = (spec.data.background.fixed(), config.sh_degree);
        let observer = self.observer;
        let fits_exposure = config.resolved.has_exposures;
        let fits_pose = trainer.progress().poses.is_some();
        let comparison = Comparison { lpips: None, fits_exposure, fits_pose };
        let scores = evaluate(trainer.backend(), test, background, degree, comparison, |_| {
            observer.interrupt().map_or(ControlFlow::Continue(()), |_| ControlFlow::Break(()))
        });
        self.restore_means(exact)?;
        let scores = match (scores, self.observer.interrupt()) {
            (Err(EvaluateError::Stopped), Some(interrupt)) => {
                return Err(self.stopped_by(interrupt));
            }
            (scores, _) => scores?,
        };
        let mean = Mean::over(&scores);
        write_scores(&self.folder, Split::Test, step, &scores)?;
        let Mean { psnr, ssim, flip, .. } = mean;
        let scalars = [("test/psnr", psnr), ("test/ssim", ssim), ("test/flip", flip)];
        self.logs.board.scalars(step, &scalars.map(|(name, value)| (name, value as f32)))?;
        if let Some(fitted) = mean.fitted {
            self.logs.board.scalars(step, &[("test/psnr fitted", fitted.psnr as f32)])?;
        }
        self.run.totals.tested.insert(step, mean);
        self.observer.tested(step, &mean);
        if !is_last {
            self.observer.say(format_args!(
                "step {step}: test PSNR {psnr:.2} dB, SSIM {ssim:.4}, FLIP {flip:.4}"
            ));
        }
        Ok(())
    }
}
