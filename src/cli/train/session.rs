//! The loop around the trainer: progress, logs, saves, measurements, and the end, good or bad.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use cpu_time::ProcessTime;

use super::TrainArgs;
use super::setup::Prepared;
use crate::cli::console::Console;
use crate::cli::failure::{Failure, INPUT};
use crate::cli::number::{duration, grouped};
use crate::cli::progress::Progress;
use crate::evaluate::{Split, evaluate};
use crate::memory::{Bytes, peak_resident};
use crate::output::{
    Mean, OutputError, RecordLog, RunFolder, StepRecord, Summary, TensorBoard, cameras_json,
    model_path, saved_iterations, write_atomically, write_json, write_scores,
};
use crate::ply::write_splats;
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
    steps: RecordLog,
    events: RecordLog,
    board: TensorBoard,
    window: Window,
    wall: Duration,
    cpu: Option<Duration>,
    stages: BTreeMap<&'static str, Duration>,
    tested: BTreeMap<u32, Mean>,
}

/// Sums over the steps since the last record.
#[derive(Default)]
struct Window {
    steps: u32,
    loss: f32,
    l1: f32,
    ssim: f32,
}

pub(super) fn train(args: &TrainArgs, run: Prepared, console: &Console) -> Result<(), Failure> {
    let last = args.iterations;
    let folder = RunFolder::create(&run.output, args.overwrite)?;
    let mut session = Session::start(run, folder.path(), console)?;
    let saves: BTreeSet<u32> = args.save_iterations.iter().copied().chain([last]).collect();
    let tests: BTreeSet<u32> = args.test_iterations.iter().copied().chain([last]).collect();
    let budget = session.run.config.train.budget;
    let mut progress = Progress::new(console, last, budget);
    let done = (1..=last).try_for_each(|step| {
        let report = session.step()?;
        progress.step(step, report.output.loss, report.rows);
        if saves.contains(&step) {
            session.save(step)?;
        }
        if tests.contains(&step) {
            session.test(step, step == last)?;
        }
        Ok(())
    });
    progress.finish();
    let finished = done.and_then(|()| session.write_summary(true).map_err(Failure::from));
    match finished {
        Ok(()) => {
            let path = folder.finish()?;
            session.report(&path);
            Ok(())
        }
        // Such as a photograph that cannot be decoded: nothing was learned that is worth keeping.
        Err(failure) if failure.code == INPUT && saved_iterations(folder.path()).is_err() => {
            drop(session);
            folder.discard();
            Err(failure)
        }
        // What led here is told first; what cannot be written besides is no news.
        Err(failure) => {
            let _ = session.write_summary(false);
            drop(session);
            let path = folder.abandon();
            Err(failure.and(&format!("what was written until then is in {}", path.display())))
        }
    }
}

impl<'a> Session<'a> {
    fn start(run: Prepared, folder: &Path, console: &'a Console) -> Result<Self, OutputError> {
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
        Ok(Self {
            steps: RecordLog::create(&folder.join("stats/train.jsonl"))?,
            events: RecordLog::create(&folder.join("stats/events.jsonl"))?,
            board: TensorBoard::create(folder)?,
            folder: folder.to_owned(),
            window: Window::default(),
            wall: Duration::ZERO,
            cpu: Some(Duration::ZERO),
            stages: BTreeMap::new(),
            tested: BTreeMap::new(),
            run,
            console,
        })
    }

    /// One iteration with its records. On a policy's error the model is saved first.
    fn step(&mut self) -> Result<StepReport, Failure> {
        let (wall, cpu) = (Instant::now(), ProcessTime::try_now().ok());
        let stepped = self.run.trainer.step();
        self.wall += wall.elapsed();
        let spent = cpu.and_then(|start| start.try_elapsed().ok());
        self.cpu = self.cpu.zip(spent).map(|(sum, spent)| sum + spent);
        for &(stage, time) in self.run.trainer.backend().stage_times() {
            *self.stages.entry(stage).or_default() += time;
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
            Err(error) => Err(error.into()),
        }
    }

    fn record(&mut self, report: &StepReport) -> Result<(), OutputError> {
        if let Some(event) = &report.event {
            self.events.append(event)?;
        }
        let window = &mut self.window;
        window.steps += 1;
        window.loss += report.output.loss;
        window.l1 += report.output.l1;
        window.ssim += report.output.ssim;
        let step = report.step;
        if step.is_multiple_of(RECORD_EVERY) || step == self.run.config.train.iterations {
            let Window { steps, loss, l1, ssim } = std::mem::take(window);
            let mean = |sum: f32| sum / steps as f32;
            let record = StepRecord {
                step,
                loss: mean(loss),
                l1: mean(l1),
                ssim: mean(ssim),
                rows: report.rows,
                seconds: self.wall.as_secs_f64(),
            };
            self.steps.append(&record)?;
            self.board.scalars(step, &[("loss", record.loss), ("rows", report.rows as f32)])?;
        }
        Ok(())
    }

    /// Writes the model in the dataset's own coordinates; returns where.
    fn save(&mut self, step: u32) -> Result<PathBuf, Failure> {
        let model = self.run.trainer.model()?;
        let model = self.run.dataset.normalisation.model_to_world(&model);
        let path = model_path(&self.folder, step);
        write_atomically(&path, |mut out| write_splats(&model, &mut out))?;
        Ok(path)
    }

    /// Measures the views held out, if there are any.
    fn test(&mut self, step: u32, is_last: bool) -> Result<(), Failure> {
        let Prepared { trainer, test, config, .. } = &mut self.run;
        if test.count() == 0 {
            return Ok(());
        }
        let background = config.scene.background.fixed();
        let degree = config.train.sh_degree;
        let scores = evaluate(trainer.backend(), test, background, degree, |_| ())?;
        let mean = scores.mean();
        write_scores(&self.folder, Split::Test, step, &scores)?;
        self.board
            .scalars(step, &[("test/psnr", mean.psnr as f32), ("test/ssim", mean.ssim as f32)])?;
        self.tested.insert(step, mean);
        if !is_last {
            let Mean { psnr, ssim } = mean;
            self.console.say(format_args!("step {step}: test PSNR {psnr:.2} dB, SSIM {ssim:.4}"));
        }
        Ok(())
    }

    fn write_summary(&self, finished: bool) -> Result<(), OutputError> {
        let Prepared { config, trainer, test, ledger, .. } = &self.run;
        let (events, views) = trainer.policy_times();
        let policy = [("policy events", events), ("policy views", views)];
        let stages = self.stages.iter().map(|(&stage, &time)| (stage, time)).chain(policy);
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
            peak_bytes: peak_resident(),
            ledger_bytes: ledger.total(),
            ledger: ledger.clone(),
            seconds: self.wall.as_secs_f64(),
            stage_seconds,
            cpu_seconds: self.cpu.map(|cpu| cpu.as_secs_f64()),
            train_views: trainer.views().count(),
            test_views: test.count(),
            test: self.tested.clone(),
        };
        write_json(&self.folder.join("stats/summary.json"), &summary)
    }

    /// What came of it, in a few lines.
    fn report(&self, path: &Path) {
        let Prepared { config, trainer, test, ledger, .. } = &self.run;
        let steps = trainer.steps_done();
        if let Some(Mean { psnr, ssim }) = self.tested.get(&steps) {
            let views = test.count();
            self.console.say(format_args!(
                "test     PSNR {psnr:.2} dB, SSIM {ssim:.4} (mean of {views} views)"
            ));
        }
        self.console.say(format_args!(
            "rows     {}, at most {} of {}",
            grouped(trainer.rows()),
            grouped(trainer.peak_rows()),
            grouped(config.train.budget)
        ));
        let promised = Bytes(ledger.total());
        if let Some(peak) = peak_resident() {
            let peak = Bytes(peak);
            self.console.say(format_args!("memory   {peak} at its peak, {promised} promised"));
        }
        let cpu = self.cpu.map_or_else(String::new, |cpu| {
            format!(", {:.4} CPU-seconds per iteration", cpu.as_secs_f64() / f64::from(steps))
        });
        self.console.say(format_args!("time     {}{cpu}", duration(self.wall)));
        self.console.say(format_args!("model    {}", model_path(path, steps).display()));
        self.console.say(format_args!("numbers  {}", path.join("stats").display()));
    }
}
