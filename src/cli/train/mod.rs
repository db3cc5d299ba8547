//! `densify train`: trains a scene.

#[cfg(feature = "view")]
mod page;
#[cfg(not(feature = "view"))]
#[path = "without_page.rs"]
mod page;

use std::cell::RefCell;
use std::fmt;
use std::path::PathBuf;

use clap::{ArgMatches, Args};

use super::console::Console;
use super::flags;
use super::interrupt::Interrupts;
use super::poses;
use super::progress::Progress;
use super::threads;
use densify_run as run;
use densify_run::failure::Failure;
use densify_run::{Host, Interrupt, Observer, Occupied, Partial, Resumed, Run, RunSpec};
use densify_train::output::RunFolder;

/// Trains a scene.
///
/// SCENE is a folder with a COLMAP reconstruction (images/ and sparse/0/), a NeRF-synthetic scene
/// (transforms_train.json and transforms_test.json) or a nerfstudio dataset (transforms.json); or a
/// built-in scene by name, such as scene:spheres (`densify scenegen --list` shows them). Of a folder of
/// photographs or a video, the cameras are found first, as by `densify poses`, into output/NAME-poses.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct TrainArgs {
    #[command(flatten)]
    run: RunSpec,
    /// TOML file with any of these options, such as the config.toml of a run; flags override it
    #[arg(long, value_name = "FILE", help_heading = "Scene")]
    config: Option<PathBuf>,
    /// Resume from the newest checkpoint in the output folder. Options are restored from the run; those that
    /// do not change the result may be given again, and --iterations may extend it. Without a checkpoint
    /// the run starts from the beginning
    #[arg(long, help_heading = "Output", conflicts_with = "overwrite")]
    pub(super) resume: bool,
    /// Replace the run in the output folder once this one is complete
    #[arg(long, help_heading = "Output")]
    overwrite: bool,
    /// Show the run in the browser while it trains: serves a page on this machine alone, with the model,
    /// curves and edits, and buttons that pause, save and stop the run (default port: the first free one from 8080
    /// on). From another machine: ssh -L 8080:127.0.0.1:8080 NAME, then open the whole printed address. The page's
    /// pictures are no larger than the largest photograph. The page does not change the run, but uses part of --memory
    #[arg(
        long, value_name = "PORT", num_args = 0..=1, require_equals = true, default_missing_value = "0",
        help_heading = "Output"
    )]
    pub(super) view: Option<u16>,
    /// Also show the table of memory, buffer by buffer, as `densify plan` does
    #[arg(short, long, help_heading = "Output", conflicts_with = "quiet")]
    verbose: bool,
    /// Show nothing but errors
    #[arg(short, long, help_heading = "Output")]
    pub(super) quiet: bool,
}

const EXAMPLES: &str = "\
Examples:
  densify train scene:spheres --iterations 2000
  densify train data/garden
  densify train data/garden --eval -r 4 --budget 1.5M -o runs/garden
  densify train data/garden --memory 512MiB
  densify train data/chair --background white --init-points 50k
  densify train data/room --iterations 3000 --policy diet --policy-set diet.rho=0.2
  densify train --config output/garden-diet/config.toml -o runs/again
  densify train data/garden --resume
  densify train data/garden --view            and watch the run in the browser";

impl TrainArgs {
    /// The host of the run: its observer, and the memory of the page if there is one.
    pub(super) fn host<'a>(&self, follower: &'a Follower<'_>) -> Host<'a> {
        Host { companion: self.view.map(|_| page::COMPANION), ..Host::new(follower) }
    }

    /// The run that the flags and the file of `--config` describe, with the checkpoint to resume from.
    pub(super) fn describe(
        &self,
        matches: &ArgMatches,
        follower: &Follower<'_>,
    ) -> Result<(RunSpec, Option<Resumed>), Failure> {
        let flags = flags::given(matches, &self.run)?;
        let file = self.config.as_deref().map(Partial::read).transpose()?.unwrap_or_default();
        let given = flags.clone().over(file);
        let (spec, resumed) =
            if self.resume { run::start(given, follower)? } else { (given.describe()?, None) };
        flags::check_policy(&flags, &spec)?;
        Ok((spec, resumed))
    }
}

pub(super) fn run(
    args: &mut TrainArgs,
    matches: &ArgMatches,
    console: &Console,
) -> Result<(), Failure> {
    let follower = Follower { verbose: args.verbose, ..Follower::new(console) };
    if let Some(scene) = &args.run.start.scene {
        let found = poses::dataset_of(scene, args.run.device.threads, &follower, console)?;
        args.run.start.scene = found.or(args.run.start.scene.take());
    }
    let args = &*args;
    let (spec, resumed) = args.describe(matches, &follower)?;
    let occupied = match (args.resume, args.overwrite) {
        (true, _) => Occupied::Resume,
        (false, true) => Occupied::Replace,
        (false, false) => Occupied::Refuse,
    };
    if occupied != Occupied::Resume {
        RunFolder::check(&spec.output_folder()?, args.overwrite)?;
    }
    // Bind the port first: a failure then shows at once, although a scene may take long to read.
    let page = args.view.map(page::open).transpose()?;
    threads::limit(spec.device.threads);
    let run = Run::prepare_on(&spec, resumed, args.host(&follower))?;
    if occupied != Occupied::Resume {
        print_preset(&spec, console)?;
    }
    follower.listen();
    match page {
        None => run.train(occupied, &follower).map(drop),
        Some(page) => page::train(&page, run, occupied, &follower, console),
    }
}

/// Prints the measured cost and gain of the preset; they hold only for the preset's number of iterations.
fn print_preset(spec: &RunSpec, console: &Console) -> Result<(), Failure> {
    let name = spec.schedule.preset.as_deref().unwrap_or(densify_run::knobs::DEFAULT_PRESET);
    let preset = densify_run::knobs::preset(name).map_err(Failure::input)?;
    let iterations = spec.schedule.iterations.0.to_string();
    match preset.levels.iter().find(|(name, _)| *name == "iterations") {
        Some((_, of_preset)) if *of_preset != iterations => console.say(format_args!(
            "preset   none: --iterations {iterations} overrides {name}, which has {of_preset}"
        )),
        _ => console.say(format_args!("preset   {preset}")),
    }
    Ok(())
}

/// Shows a run on the console, and stops it on a signal.
pub(super) struct Follower<'a> {
    console: &'a Console,
    /// True if lines of detail are shown, too.
    verbose: bool,
    progress: RefCell<Option<Progress<'a>>>,
    interrupts: RefCell<Option<Interrupts>>,
}

impl<'a> Follower<'a> {
    pub(super) fn new(console: &'a Console) -> Self {
        Self {
            console,
            verbose: false,
            progress: RefCell::default(),
            interrupts: RefCell::default(),
        }
    }

    /// From here on, a signal stops the run cleanly.
    pub(crate) fn listen(&self) {
        *self.interrupts.borrow_mut() = Some(Interrupts::listen());
    }
}

impl Observer for Follower<'_> {
    fn say(&self, line: fmt::Arguments<'_>) {
        self.console.say(line);
    }

    fn detail(&self, lines: fmt::Arguments<'_>) {
        if self.verbose {
            self.console.say(lines);
        }
    }

    fn begin(&self, done: u32, last: u32, budget: usize) {
        *self.progress.borrow_mut() = Some(Progress::new(self.console, done, last, budget));
    }

    fn step(&self, step: u32, loss: f32, rows: usize) {
        if let Some(progress) = self.progress.borrow_mut().as_mut() {
            progress.step(step, loss, rows);
        }
    }

    fn trial_step(&self, [step, last]: [u32; 2], loss: f32, [rows, budget]: [usize; 2]) {
        if step == 1 {
            self.listen();
            self.begin(0, last, budget);
        }
        self.step(step, loss, rows);
        if step == last {
            self.end();
        }
    }

    fn end(&self) {
        if let Some(progress) = self.progress.borrow_mut().take() {
            progress.finish();
        }
    }

    fn interrupt(&self) -> Option<Interrupt> {
        self.interrupts.borrow().and_then(Interrupts::received)
    }
}

#[cfg(test)]
mod tests;
