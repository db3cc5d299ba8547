//! The loop around the trainer: progress, logs, saves, measurements, and the end, good or bad.

use std::collections::BTreeSet;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;

use cpu_time::ProcessTime;

use super::TrainArgs;
use super::export::export;
use super::interrupt::{Interrupt, Interrupts};
use super::setup::Prepared;
use super::tally::{Logs, Tally};
use crate::checkpoint::{CheckpointError, Header, checkpoint_path, tidy, write};
use crate::cli::console::Console;
use crate::cli::failure::{Failure, INPUT};
use crate::cli::number::{duration, grouped};
use crate::cli::progress::Progress;
use crate::evaluate::{EvaluateError, Split, evaluate};
use crate::memory::Bytes;
use crate::output::{
    CHECKPOINTS, Mean, OutputError, Requirements, RunFolder, Summary, cameras_json, model_path,
    saved_iterations, write_atomically, write_json, write_scores,
};
use crate::trainer::{StepReport, TrainError};
use crate::views::ViewSource;

/// Steps between two records of the log.
const RECORD_EVERY: u32 = 10;

/// A run in progress.
struct Session<'a> {
    run: Prepared,
    console: &'a Console,
    /// Where files go now.
    folder: PathBuf,
    logs: Logs,
    tally: Tally,
    interrupts: Interrupts,
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

pub(super) fn train(args: &TrainArgs, run: Prepared, console: &Console) -> Result<(), Failure> {
    let interrupts = Interrupts::listen();
    let last = run.last;
    let folder = match args.resume {
        true => RunFolder::resume(&run.output, run.kept.is_none())?,
        false => RunFolder::create(&run.output, args.overwrite)?,
    };
    let goes_on = run.kept.is_some();
    let mut session = match Session::start(run, folder.path(), interrupts, console) {
        Ok(session) => session,
        // Where nothing can be written nothing has been learned.
        Err(error) if goes_on => return Err(error.into()),
        Err(error) => {
            folder.discard();
            return Err(error.into());
        }
    };
    let duties = Duties {
        saves: args.save_iterations.iter().copied().chain([last]).collect(),
        tests: args.test_iterations.iter().copied().chain([last]).collect(),
        checkpoint_every: args.checkpoint_every,
        last,
    };
    let done = session.go(&duties);
    let finished = done.and_then(|()| session.write_summary(true).map_err(Failure::from));
    match finished {
        Ok(()) => {
            let path = folder.finish()?;
            session.report(&path);
            Ok(())
        }
        // Such as a photograph that cannot be decoded: nothing was learned that is worth keeping.
        Err(failure) if failure.code == INPUT && has_nothing(folder.path()) => {
            drop(session);
            folder.discard();
            Err(failure)
        }
        // What led here is told first; what cannot be written besides is no news.
        Err(failure) => {
            let _ = session.write_summary(false);
            let (scene, kept) = (session.run.config.scene.path.clone(), session.checkpoint);
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
        mut run: Prepared,
        folder: &Path,
        interrupts: Interrupts,
        console: &'a Console,
    ) -> Result<Self, OutputError> {
        run.config.write(folder)?;
        let to_world = &run.dataset.normalisation;
        if let Some(warning) = to_world.f32_warning() {
            console.say(format_args!("note: {warning}"));
        }
        let views = run.dataset.test.iter().chain(&run.dataset.train);
        let cameras = views.map(|view| (&*view.name, to_world.denormalise_camera(&view.camera)));
        write_atomically(&folder.join("cameras.json"), |out| {
            out.write_all(cameras_json(cameras)?.as_bytes())
        })?;
        let mut checkpoint = None;
        let (logs, tally) = match run.kept.take() {
            None => (Logs::create(folder)?, Tally::new()),
            Some(kept) => {
                checkpoint = Some(run.trainer.steps_done());
                let (logs, tally, lost) = Logs::resume(folder, kept)?;
                for name in lost {
                    console.say(format_args!("note: {name} has lost records; they stay missing"));
                }
                (logs, tally)
            }
        };
        let folder = folder.to_owned();
        Ok(Self { run, console, folder, logs, tally, interrupts, checkpoint })
    }

    /// All steps that are left.
    fn go(&mut self, duties: &Duties) -> Result<(), Failure> {
        let done = self.run.trainer.steps_done();
        let (last, budget) = (duties.last, self.run.config.train.budget);
        if done > 0 {
            // A run that was stopped may not have come to what follows its last step.
            self.after(done, duties, true)?;
        }
        let mut progress = Progress::new(self.console, done, last, budget);
        let stepped = (done + 1..=last).try_for_each(|step| {
            if let Some(interrupt) = self.interrupts.received() {
                return Err(self.interrupted(interrupt));
            }
            let report = self.step()?;
            progress.step(step, report.output.loss, report.rows);
            self.after(step, duties, false)
        });
        progress.finish();
        stepped
    }

    /// What follows a step: the model is saved, measured, and the run kept. Where the run is
    /// resumed, only what is not there yet.
    fn after(&mut self, step: u32, duties: &Duties, resumed: bool) -> Result<(), Failure> {
        let there = |path: PathBuf| resumed && path.is_file();
        if duties.saves.contains(&step) && !there(model_path(&self.folder, step)) {
            self.save(step)?;
        }
        if duties.tests.contains(&step) && !(resumed && self.tally.tested.contains_key(&step)) {
            self.test(step, step == duties.last)?;
        }
        let every = duties.checkpoint_every;
        let due = every > 0 && (step.is_multiple_of(every) || step == duties.last);
        if due && !there(checkpoint_path(&self.folder, step)) {
            // The run is worth more than its checkpoint; the one before is still there.
            if let Err(error) = self.keep() {
                tracing::error!(
                    step,
                    "the checkpoint could not be written, training goes on: {error}"
                );
            }
        }
        Ok(())
    }

    /// Writes a checkpoint of the run as it is now.
    fn keep(&mut self) -> Result<(), CheckpointError> {
        let step = self.run.trainer.steps_done();
        if self.checkpoint == Some(step) {
            return Ok(());
        }
        let trainer = self.run.trainer.state();
        let header = Header {
            densify: self.run.config.densify.clone(),
            config: self.run.config.clone(),
            dataset: self.run.fingerprint.clone(),
            trainer: trainer.map_err(|source| CheckpointError::Policy { source })?,
            session: self.logs.keep(&self.tally)?,
        };
        write(&checkpoint_path(&self.folder, step), &header, self.run.trainer.backend())?;
        tidy(&self.folder, step);
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
    /// where rows are unsound the run is kept.
    fn step(&mut self) -> Result<StepReport, Failure> {
        let (wall, cpu) = (Instant::now(), ProcessTime::try_now().ok());
        let stepped = self.run.trainer.step();
        self.tally.time(wall, cpu);
        for &(stage, time) in self.run.trainer.backend().stage_times() {
            self.tally.stage(stage, time);
        }
        match stepped {
            Ok(report) => {
                self.record(&report)?;
                Ok(report)
            }
            Err(error @ (TrainError::Policy { .. } | TrainError::BrokenPlan { .. })) => {
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
            Err(error) => Err(error.into()),
        }
    }

    fn record(&mut self, report: &StepReport) -> Result<(), OutputError> {
        let Self { logs, tally, run, .. } = self;
        for event in &report.events {
            logs.events.append(event)?;
        }
        tally.step(&report.output);
        let step = report.step;
        // The end of a run is a record even where it is extended, so that records do not depend on it.
        let ends = [run.config.train.iterations, run.last].contains(&step);
        if step.is_multiple_of(RECORD_EVERY) || ends {
            let record = tally.record(step, report.rows);
            logs.steps.append(&record)?;
            logs.board.scalars(step, &[("loss", record.loss), ("rows", report.rows as f32)])?;
        }
        Ok(())
    }

    /// Writes the model; returns where.
    fn save(&mut self, step: u32) -> Result<PathBuf, Failure> {
        let path = model_path(&self.folder, step);
        export(&mut self.run.trainer, &self.run.dataset.normalisation, &path)?;
        Ok(path)
    }

    /// Measures the views held out, if there are any.
    fn test(&mut self, step: u32, is_last: bool) -> Result<(), Failure> {
        let Prepared { trainer, test, config, .. } = &mut self.run;
        if test.count() == 0 {
            return Ok(());
        }
        let (background, degree) = (config.scene.background.fixed(), config.train.sh_degree);
        let interrupts = self.interrupts;
        let scores = evaluate(trainer.backend(), test, background, degree, |_| {
            interrupts.received().map_or(ControlFlow::Continue(()), |_| ControlFlow::Break(()))
        });
        let scores = match (scores, self.interrupts.received()) {
            (Err(EvaluateError::Stopped), Some(interrupt)) => {
                return Err(self.interrupted(interrupt));
            }
            (scores, _) => scores?,
        };
        let mean = scores.mean();
        write_scores(&self.folder, Split::Test, step, &scores)?;
        let Mean { psnr, ssim, flip } = mean;
        let scalars = [("test/psnr", psnr), ("test/ssim", ssim), ("test/flip", flip)];
        self.logs.board.scalars(step, &scalars.map(|(name, value)| (name, value as f32)))?;
        self.tally.tested.insert(step, mean);
        if !is_last {
            self.console.say(format_args!(
                "step {step}: test PSNR {psnr:.2} dB, SSIM {ssim:.4}, FLIP {flip:.4}"
            ));
        }
        Ok(())
    }

    fn write_summary(&self, finished: bool) -> Result<(), OutputError> {
        let Prepared { config, trainer, test, ledger, .. } = &self.run;
        let (events, views) = trainer.policy_times();
        let images = trainer.images_time();
        let more = [("policy events", events), ("policy views", views), ("images", images)];
        let more = more.map(|(stage, time)| (stage.to_owned(), time));
        let stages = self.tally.stages.clone().into_iter().chain(more);
        let stage_seconds = stages.map(|(stage, time)| (stage, time.as_secs_f64())).collect();
        let summary = Summary {
            densify: config.densify.clone(),
            policy: config.policy.name.clone(),
            finished,
            iterations: trainer.steps_done(),
            rows: trainer.rows(),
            peak_rows: trainer.peak_rows(),
            budget: config.train.budget,
            extra_forwards: trainer.extra_forwards(),
            peak_bytes: self.tally.peak_bytes(),
            memory: config.train.memory,
            ledger_bytes: ledger.total(),
            ledger: ledger.clone(),
            seconds: self.tally.wall.as_secs_f64(),
            stage_seconds,
            cpu_seconds: self.tally.cpu.map(|cpu| cpu.as_secs_f64()),
            train_views: trainer.views().count(),
            test_views: test.count(),
            test: self.tally.tested.clone(),
        };
        write_json(&self.folder.join("stats/requirements.json"), &self.requirements())?;
        write_json(&self.folder.join("stats/summary.json"), &summary)
    }

    /// What was left out.
    fn requirements(&self) -> Requirements {
        let Prepared { config, trainer, .. } = &self.run;
        let (growth, unscored) = (trainer.growth(), trainer.unscored_views());
        Requirements::of(&config.train, trainer.rows(), growth, unscored)
    }

    /// What came of it, in a few lines.
    fn report(&self, path: &Path) {
        let Prepared { config, trainer, test, ledger, .. } = &self.run;
        let steps = trainer.steps_done();
        if let Some(Mean { psnr, ssim, flip }) = self.tally.tested.get(&steps) {
            let views = test.count();
            self.console.say(format_args!(
                "test     PSNR {psnr:.2} dB, SSIM {ssim:.4}, FLIP {flip:.4} (mean of {views} views)"
            ));
        }
        self.console.say(format_args!(
            "rows     {}, at most {} of {}",
            grouped(trainer.rows()),
            grouped(trainer.peak_rows()),
            grouped(config.train.budget)
        ));
        let promised = Bytes(ledger.total());
        if let Some(peak) = self.tally.peak_bytes() {
            let peak = Bytes(peak);
            self.console.say(format_args!("memory   {peak} at its peak, {promised} promised"));
        }
        let cpu = self.tally.cpu.map_or_else(String::new, |cpu| {
            format!(", {:.4} CPU-seconds per iteration", cpu.as_secs_f64() / f64::from(steps))
        });
        self.console.say(format_args!("time     {}{cpu}", duration(self.tally.wall)));
        for line in self.requirements().lines() {
            self.console.say(line);
        }
        self.console.say(format_args!("model    {}", model_path(path, steps).display()));
        self.console.say(format_args!("numbers  {}", path.join("stats").display()));
    }
}
