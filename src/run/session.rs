//! The loop around the trainer: progress, logs, saves, measurements, and the end, good or bad. One piece, as all of it
//! happens between two steps, in an order that matters.

use std::collections::BTreeSet;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;

use cpu_time::ProcessTime;

use super::Run;
use super::measuring::measure;
use super::observer::{Between, Interrupt, Observer};
use super::records::{Logs, Totals};
use crate::failure::{Failure, INPUT, OTHER};
use densify_core::files::{OutputError, write_atomically};
use densify_data::export::{PLY, Shape};
use densify_data::views::ViewSource;
use densify_train::checkpoint::{CheckpointError, Header, checkpoint_path, remove_older, write};
use densify_train::evaluate::{Comparison, EvaluateError, Split, evaluate};
use densify_train::exposure::named_transforms;
use densify_train::output::{
    CHECKPOINTS, CONFIG_FILE, Guard, Mean, RunFolder, cameras_json, model_path, saved_iterations,
    write_json, write_scores,
};
use densify_train::trainer::{StepReport, TrainError};

/// Name of the file beside a model that says how its training views were exposed.
const EXPOSURES: &str = "exposure.json";
/// Steps between two records of the log.
const RECORD_EVERY: u32 = 10;

/// A run in progress.
pub(super) struct Session<'a> {
    pub(super) run: Run,
    /// What checkpoints say of its configuration.
    config: toml::Table,
    pub(super) observer: &'a dyn Observer,
    /// Where files go now.
    pub(super) folder: PathBuf,
    logs: Logs,
    pub(super) totals: Totals,
    /// Whether the folder is still the run's own.
    guard: Guard,
    /// Step of the last checkpoint that this process has written, or gone on from.
    checkpoint: Option<u32>,
}

/// What is done after which step, beside training.
struct Duties {
    saves: BTreeSet<u32>,
    tests: BTreeSet<u32>,
    checkpoint_every: u32,
    last: u32,
}

/// What happens to a run that is in the output folder already.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Occupied {
    /// It stays, and the new run is refused.
    Refuse,
    /// The new run replaces it, once that is complete.
    Replace,
    /// It goes on.
    Resume,
}

/// Trains to the end, and writes everything that a run leaves; returns the folder.
pub(super) fn train(
    run: Run,
    occupied: Occupied,
    observer: &dyn Observer,
) -> Result<PathBuf, Failure> {
    let last = run.last;
    // Of a run that goes on nothing is removed, were it only its description.
    let has_begun = run.session.is_some() || run.output.join(CONFIG_FILE).exists();
    let resumes = occupied == Occupied::Resume && has_begun;
    let folder = match occupied {
        Occupied::Resume => RunFolder::resume(&run.output, run.session.is_none())?,
        Occupied::Refuse => RunFolder::create(&run.output, false)?,
        Occupied::Replace => RunFolder::create(&run.output, true)?,
    };
    let output = run.config.spec.output.clone();
    let duties = Duties {
        saves: output.save_iterations.iter().copied().chain([last]).collect(),
        tests: output.test_iterations.iter().copied().chain([last]).collect(),
        checkpoint_every: output.checkpoint_every,
        last,
    };
    let mut session = match Session::start(run, &folder, observer) {
        Ok(session) => session,
        // Where nothing can be written nothing has been learned.
        Err(error) if resumes => return Err(error),
        Err(error) => {
            folder.discard();
            return Err(error);
        }
    };
    let done = session.go(&duties);
    let guard = folder.guard();
    let finished = done
        .and_then(|()| guard.check().map_err(Failure::from))
        .and_then(|()| session.write_summary(true).map_err(Failure::from));
    match finished {
        Ok(()) => {
            let path = folder.finish()?;
            session.report(&path);
            measure(session, &path).map_err(|failure| {
                failure.and(&format!("the run is complete in {} all the same", path.display()))
            })?;
            Ok(path)
        }
        // Another run may be there now.
        Err(failure) if guard.check().is_err() => Err(failure),
        // Such as a photograph that cannot be decoded: nothing was learned that is worth keeping.
        Err(failure) if failure.code == INPUT && !resumes && has_nothing(&folder.path()) => {
            // The lock goes with its last holder, and then the folder can be removed.
            drop((session, guard));
            folder.discard();
            Err(failure)
        }
        // The cause is reported first; a further error of writing adds nothing.
        Err(failure) => {
            let _ = session.write_summary(false);
            let scene = session.run.config.spec.start.scene.clone().unwrap_or_default();
            let kept = session.checkpoint;
            drop(session);
            let path = folder.abandon();
            let kept = kept.map_or_else(String::new, |step| {
                format!(
                    ", with the checkpoint {}; go on with: densify train {} -o {} --resume",
                    checkpoint_path(&path, step).display(),
                    scene.display(),
                    path.display(),
                )
            });
            let path = path.display();
            Err(failure.and(&format!("what was written until then is in {path}{kept}")))
        }
    }
}

/// Whether a run has left neither a model nor a checkpoint.
fn has_nothing(folder: &Path) -> bool {
    saved_iterations(folder).is_err() && !folder.join(CHECKPOINTS).exists()
}

impl<'a> Session<'a> {
    fn start(
        mut run: Run,
        folder: &RunFolder,
        observer: &'a dyn Observer,
    ) -> Result<Self, Failure> {
        let (guard, folder) = (folder.guard(), folder.path());
        let folder = folder.as_path();
        run.config.write(folder)?;
        let config = run.config.table()?;
        let to_world = &run.dataset.normalisation;
        if let Some(warning) = to_world.f32_warning() {
            observer.say(format_args!("note: {warning}"));
        }
        let views = run.dataset.test.iter().chain(&run.dataset.train);
        let cameras =
            views.map(|view| (&*view.name, to_world.world_from_scene_camera(&view.camera)));
        write_atomically(&folder.join("cameras.json"), |out| {
            out.write_all(cameras_json(cameras)?.as_bytes())
        })?;
        let mut checkpoint = None;
        let (logs, totals) = match run.session.take() {
            None => (Logs::create(folder)?, Totals::new()),
            Some(saved) => {
                checkpoint = Some(run.trainer.steps_done());
                let (logs, totals, lost) = Logs::resume(folder, saved)?;
                for name in lost {
                    observer.say(format_args!("note: {name} has lost records; they stay missing"));
                }
                (logs, totals)
            }
        };
        let folder = folder.to_owned();
        Ok(Self { run, config, observer, folder, logs, totals, guard, checkpoint })
    }

    /// All steps that are left.
    fn go(&mut self, duties: &Duties) -> Result<(), Failure> {
        let done = self.run.trainer.steps_done();
        let (last, budget) = (duties.last, self.run.config.budget());
        if done > 0 {
            // A run that was stopped may not have come to what follows its last step.
            self.after(done, duties, true)?;
        }
        self.observer.begin(done, last, budget);
        let stepped = (done + 1..=last).try_for_each(|step| {
            self.rest();
            if let Some(interrupt) = self.observer.interrupt() {
                return Err(self.interrupted(interrupt));
            }
            let report = self.step()?;
            self.observer.step(step, report.output.loss, report.rows);
            self.after(step, duties, false)
        });
        self.observer.end();
        stepped.and_then(|()| self.check_drawn())
    }

    /// Lets the observer look at the model, and writes the checkpoints that it asks for.
    fn rest(&mut self) {
        loop {
            let (model, rows) = self.run.trainer.backend_and_history();
            match self.observer.between(model, rows) {
                Between::Checkpoint => self.keep_or_say(),
                Between::Step => return,
            }
        }
    }

    /// Writes a checkpoint; where it cannot be written training goes on, as the run is worth more, and the one
    /// before is still there.
    fn keep_or_say(&mut self) {
        let step = self.run.trainer.steps_done();
        let trouble = self.keep().err().map(|error| {
            tracing::error!(step, "the checkpoint could not be written, training goes on: {error}");
            format!("the checkpoint of step {step} could not be written: {error}")
        });
        self.observer.kept(step, trouble.as_deref());
    }

    /// Fails where the model draws nothing in most of the last views: that is no result.
    fn check_drawn(&self) -> Result<(), Failure> {
        let drawn = &self.totals.drawn;
        let (all, empty) = (drawn.len(), drawn.iter().filter(|drawn| !**drawn).count());
        if 2 * empty <= all {
            return Ok(());
        }
        Err(Failure {
            code: OTHER,
            message: format!(
                "the model draws nothing in {empty} of the last {all} views; check the poses of the \
                 cameras, and that they and the points use the same coordinate system, or lower --near"
            ),
        })
    }

    /// What follows a step: the model is saved, measured, and the run kept. Where the run is
    /// resumed, only what is not there yet.
    fn after(&mut self, step: u32, duties: &Duties, resumed: bool) -> Result<(), Failure> {
        let every = duties.checkpoint_every;
        let due = every > 0 && (step.is_multiple_of(every) || step == duties.last);
        if due || duties.saves.contains(&step) || duties.tests.contains(&step) {
            self.guard.check()?;
        }
        let there = |path: PathBuf| resumed && path.is_file();
        if duties.saves.contains(&step) && !there(model_path(&self.folder, step)) {
            self.save(step)?;
        }
        if duties.tests.contains(&step) && !(resumed && self.totals.tested.contains_key(&step)) {
            self.test(step, step == duties.last)?;
        }
        if due && !there(checkpoint_path(&self.folder, step)) {
            self.keep_or_say();
        }
        Ok(())
    }

    /// Writes a checkpoint of the run as it is now.
    fn keep(&mut self) -> Result<(), CheckpointError> {
        let step = self.run.trainer.steps_done();
        if self.checkpoint == Some(step) {
            return Ok(());
        }
        self.guard.check()?;
        let trainer = self.run.trainer.state();
        let header = Header {
            densify: self.run.config.densify.clone(),
            budget: self.run.config.budget(),
            sh_degree: self.run.config.sh_degree(),
            config: self.config.clone(),
            dataset: self.run.fingerprint.clone(),
            trainer: trainer.map_err(|source| CheckpointError::Policy { source })?,
            session: self.logs.keep(&self.totals)?,
        };
        write(&checkpoint_path(&self.folder, step), &header, self.run.trainer.backend())?;
        remove_older(&self.folder, step);
        self.checkpoint = Some(step);
        Ok(())
    }

    /// Ends the run in order, so that it can go on later.
    fn interrupted(&mut self, Interrupt { name, exit_code }: Interrupt) -> Failure {
        let step = self.run.trainer.steps_done();
        let message = format!("stopped by {name} after step {step}");
        self.kept(Failure { code: exit_code, message })
    }

    /// Writes a checkpoint of a run that ends here.
    fn kept(&mut self, failure: Failure) -> Failure {
        match self.keep() {
            Ok(()) => failure,
            Err(error) => failure.and(&format!("no checkpoint could be written: {error}")),
        }
    }

    /// One iteration with its records. On a policy's error the model is saved first, and
    /// where rows are unsound or a photograph can no longer be read the run is kept.
    fn step(&mut self) -> Result<StepReport, Failure> {
        let (wall, cpu) = (Instant::now(), ProcessTime::try_now().ok());
        let train_views = self.run.dataset.train.len();
        let stepped = self.run.trainer.step();
        self.totals.time(wall, cpu);
        for &(stage, time) in self.run.trainer.backend().stage_times() {
            self.totals.stage(stage, time);
        }
        match stepped {
            Ok(report) => {
                self.record(&report)?;
                Ok(report)
            }
            Err(error @ TrainError::Policy { .. }) => {
                let step = self.run.trainer.steps_done();
                let saved = match self.save(step) {
                    Ok(path) => {
                        format!("the model as it was before is saved in {}", path.display())
                    }
                    Err(e) => format!("the model could not be saved: {}", e.message),
                };
                Err(Failure::from(error).and(&saved))
            }
            Err(error @ TrainError::Unsound { .. }) => Err(self.kept(error.into())),
            // A photograph that could be read before. In the first epoch little is lost.
            Err(error @ TrainError::View { step, .. })
                if step > self.run.trainer.steps_done() && step as usize > train_views =>
            {
                Err(self.kept(error.into()))
            }
            Err(error) => Err(error.into()),
        }
    }

    fn record(&mut self, report: &StepReport) -> Result<(), OutputError> {
        let Self { logs, totals, run, observer, .. } = self;
        for event in &report.events {
            observer.edited(event);
            logs.events.append(event)?;
        }
        totals.step(&report.output, run.dataset.train.len());
        let step = report.step;
        // The end of a run is a record even where it is extended, so that records do not depend on it.
        let ends = [run.config.spec.schedule.iterations.0, run.last].contains(&step);
        if step.is_multiple_of(RECORD_EVERY) || ends {
            let record = totals.record(step, report.rows);
            observer.recorded(&record);
            logs.steps.append(&record)?;
            logs.board.scalars(step, &[("loss", record.loss), ("rows", report.rows as f32)])?;
        }
        Ok(())
    }

    /// Writes the model; returns where.
    fn save(&mut self, step: u32) -> Result<PathBuf, Failure> {
        self.guard.check()?;
        let path = model_path(&self.folder, step);
        let (backend, to_world) = (self.run.trainer.backend(), &self.run.dataset.normalisation);
        let shape = Shape { rows: backend.rows(), sh_degree: backend.sh_degree() };
        PLY.write_file(&path, shape, |piece| {
            Ok::<_, Failure>(to_world.world_from_model(backend.download_rows(piece)?))
        })?;
        if let Some(exposures) = self.run.trainer.exposures() {
            let names = self.run.dataset.train.iter().map(|view| &*view.name);
            let named = named_transforms(exposures, names);
            write_json(&path.with_file_name(EXPOSURES), &named)?;
        }
        Ok(path)
    }

    /// Measures the views held out, if there are any.
    fn test(&mut self, step: u32, is_last: bool) -> Result<(), Failure> {
        let Run { trainer, test, config, .. } = &mut self.run;
        if test.count() == 0 {
            return Ok(());
        }
        let (background, degree) = (config.spec.data.background.fixed(), config.sh_degree());
        let observer = self.observer;
        let fits_exposure = config.resolved.has_exposures;
        let comparison = Comparison { lpips: None, fits_exposure };
        let scores = evaluate(trainer.backend(), test, background, degree, comparison, |_| {
            observer.interrupt().map_or(ControlFlow::Continue(()), |_| ControlFlow::Break(()))
        });
        let scores = match (scores, self.observer.interrupt()) {
            (Err(EvaluateError::Stopped), Some(interrupt)) => {
                return Err(self.interrupted(interrupt));
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
        self.totals.tested.insert(step, mean);
        self.observer.tested(step, &mean);
        if !is_last {
            self.observer.say(format_args!(
                "step {step}: test PSNR {psnr:.2} dB, SSIM {ssim:.4}, FLIP {flip:.4}"
            ));
        }
        Ok(())
    }
}
