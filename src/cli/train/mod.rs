//! `densify train`.

mod choices;
mod degree;
mod demand;
mod export;
mod interrupt;
pub(super) mod plan;
mod resume;
mod session;
mod setup;
mod size;
mod spelling;
mod tally;

use std::ffi::OsString;
use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::console::Console;
use super::device::DeviceArgs;
use super::failure::Failure;
use super::number;
use super::scene::{NEAR, SceneArgs};
use crate::output::InitChoice;
use crate::schedule::REFERENCE_ITERATIONS;
use crate::trainer::OnNan;
use degree::ShDegree;
use resume::Start;
use size::Budget;

/// Most rows, where `--budget` is not given: trains on a laptop in well under 2 GiB, and carries
/// a room or an object; large outdoor scenes want more.
pub(super) const DEFAULT_BUDGET: usize = 200_000;

/// Trains a scene.
///
/// SCENE is a folder with a COLMAP reconstruction (images/ and sparse/0/), a NeRF-synthetic scene
/// (transforms_train.json and transforms_test.json) or a nerfstudio dataset (transforms.json); or a
/// built-in scene by name, as scene:spheres (`densify scenegen --list` shows them).
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct TrainArgs {
    /// Folder of the dataset, or scene:NAME
    #[arg(help_heading = "Scene")]
    scene: PathBuf,
    /// Folder to write to `[default: output/SCENE-POLICY]`
    #[arg(short, long, value_name = "DIR", help_heading = "Output")]
    output: Option<PathBuf>,

    #[command(flatten)]
    data: SceneArgs,
    #[command(flatten)]
    device: DeviceArgs,
    /// Give the same bytes every time. The processor always does; a GPU adds up gradients in slots for it,
    /// in one order, where it would do it by atomics otherwise (`densify devices`)
    #[arg(long, help_heading = "Device")]
    deterministic: bool,

    /// Most Gaussians the model may ever have, at any instant: 200000, 28k, 1.5M
    /// `[default: 200k, or as many as --memory holds]`
    ///
    /// auto: growth stops where a doubling of Gaussians brings less than 0.10 dB on training
    /// views; what is missed least is removed then. The default stays the limit
    #[arg(short, long, value_name = "ROWS", help_heading = "Memory")]
    budget: Option<Budget>,
    /// Memory that the run may take, all included: 512MiB, 1.5GiB, 800MB. It is the device's on a
    /// GPU, else the process's.
    ///
    /// Options that are given are kept: --budget (the smaller of the two limits holds), --sh-degree,
    /// --tile-cap, --image-cache. The others are chosen: Gaussians as many as fit; the degree is 3
    /// unless fewer fit than the scene starts with, then it is lowered until they do; decoded
    /// photographs take at most an eighth, and those beyond it are decoded again; tile lists hold 4
    /// pairs per Gaussian, up to 16 where --budget leaves room. `densify plan` shows what comes of it
    #[arg(long, value_name = "BYTES", help_heading = "Memory", value_parser = number::bytes)]
    memory: Option<u64>,
    /// Most (Gaussian, tile) pairs held at a time; views with more are processed in bands, which
    /// is exact but slower `[default: 16 per Gaussian of the budget, or chosen for --memory]`
    #[arg(long, value_name = "PAIRS", help_heading = "Memory", value_parser = number::rows)]
    tile_cap: Option<usize>,

    /// What decides where Gaussians are born and die; `densify policies` lists the choices
    #[arg(
        short,
        long,
        value_name = "NAME",
        help_heading = "Density control",
        default_value = "diet"
    )]
    policy: String,
    /// Set a parameter of the policy, such as diet.rho=0.2; may be repeated
    #[arg(long, value_name = "POLICY.NAME=VALUE", help_heading = "Density control")]
    policy_set: Vec<String>,
    /// TOML file with parameters in a table per policy; --policy-set wins over it
    #[arg(long, value_name = "FILE", help_heading = "Density control")]
    policy_config: Option<PathBuf>,

    /// Length of the run; every schedule scales with it
    /// `[default: 30000, but 24000 with --preset balanced and 15000 with fast]`
    #[arg(short, long, value_name = "N", help_heading = "Training", default_value_t = REFERENCE_ITERATIONS, hide_default_value = true, value_parser = clap::value_parser!(u32).range(1..))]
    iterations: u32,
    /// How colours may depend on the direction of view: 0 not at all, 3 most; auto: as much as the
    /// scene requires `[default: 3, or lower where --memory requires it]`
    ///
    /// With auto it is decided before training, by how much the photographs disagree about the
    /// colours of the reconstruction's points. Where it has no tracks, the degree is raised along
    /// the run, for as long as a raise has paid
    #[arg(long, value_name = "DEGREE", help_heading = "Training")]
    sh_degree: Option<ShDegree>,
    /// Leave nothing out on a finding of densify's own: degree 3, whatever the scene or --memory says
    #[arg(long, help_heading = "Training")]
    full: bool,
    /// Where the first Gaussians are placed [default: points where the dataset has any, else
    /// random]
    #[arg(long, value_enum, value_name = "HOW", help_heading = "Training")]
    init: Option<Init>,
    /// Number of random points to start from `[default: half the budget, at most 100k]`
    #[arg(long, value_name = "N", help_heading = "Training", value_parser = number::rows)]
    init_points: Option<usize>,
    /// Nearest distance to a camera at which anything is drawn, as a fraction of the scene's
    /// extent
    #[arg(long, value_name = "FRACTION", help_heading = "Training", default_value_t = NEAR, value_parser = number::fraction)]
    near: f64,
    /// Set a learning rate: mean_start, mean_end, log_scale, quat, opacity, sh_dc,
    /// sh_rest, or boost (factor of them all at the start; 1 for runs of 30,000);
    /// may be repeated
    #[arg(long, value_name = "NAME=RATE", help_heading = "Training")]
    lr: Vec<String>,
    /// Iterations per optimiser step of view-dependent colour; gradients are summed in between
    /// `[default: the policy's choice, mostly 1]`
    #[arg(long, value_name = "N", help_heading = "Training", value_parser = clap::value_parser!(u32).range(1..=1000))]
    sh_every: Option<u32>,
    /// Knobs that go together: exact, balanced, fast or tiny-memory; says what it was measured to cost
    /// and buy `[default: balanced]`
    #[arg(long, value_name = "NAME", help_heading = "Training")]
    preset: Option<String>,
    /// Set a knob of the trade between speed, memory and accuracy, such as alpha_min=1/128;
    /// `densify knobs` lists them. May be repeated
    #[arg(long, value_name = "NAME=VALUE", help_heading = "Training")]
    knob: Vec<String>,
    /// What becomes of Gaussians with a number that is not finite, found every 100 iterations at
    /// least
    #[arg(long, value_name = "WHAT", help_heading = "Training", default_value = "prune")]
    on_nan: NanArg,
    /// Everything random follows from this number; equal numbers give equal results
    #[arg(long, value_name = "N", help_heading = "Training", default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    seed: u64,
    /// Processor threads to use; the result does not depend on it `[default: all]`
    #[arg(long, value_name = "N", help_heading = "Training", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,

    /// Iterations after which to save the model, beside the last
    #[arg(long, value_name = "N", help_heading = "Output", num_args = 1.., value_delimiter = ',')]
    save_iterations: Vec<u32>,
    /// Iterations after which to measure the views held out, beside the last
    #[arg(long, value_name = "N", help_heading = "Output", num_args = 1.., value_delimiter = ',')]
    test_iterations: Vec<u32>,
    /// Steps between two checkpoints; one is written at the end, too, and when SIGINT or SIGTERM
    /// stops the run. The two newest are kept. 0: none but when stopped
    #[arg(long, value_name = "N", help_heading = "Output", default_value_t = CHECKPOINT_EVERY)]
    checkpoint_every: u32,
    /// Go on from the newest checkpoint in the output folder, with its options (but for those that say
    /// when to save, measure and keep the run); --iterations may extend it. Without any checkpoint the
    /// run begins at its start
    #[arg(long, help_heading = "Output", conflicts_with = "overwrite")]
    resume: bool,
    /// Replace the run that is in the output folder, once this one is complete
    #[arg(long, help_heading = "Output")]
    overwrite: bool,
    /// Show nothing but errors
    #[arg(short, long, help_heading = "Output")]
    pub(super) quiet: bool,
}

/// Steps between two checkpoints. One takes about as long as one to three steps.
const CHECKPOINT_EVERY: u32 = 1_000;

const EXAMPLES: &str = "\
Examples:
  densify train scene:spheres --iterations 2000
  densify train data/garden
  densify train data/garden --eval -r 4 --budget 1.5M -o runs/garden
  densify train data/garden --memory 512MiB
  densify train data/chair --background white --init-points 50k
  densify train data/room --iterations 3000 --policy diet --policy-set diet.rho=0.2
  densify train data/garden --resume";

/// Spelling of [`OnNan`] on the command line.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum NanArg {
    /// Stop the run, with a checkpoint
    Stop,
    /// Remove them; stop only if they are more than 0.1 % at once
    Prune,
}

impl From<NanArg> for OnNan {
    fn from(choice: NanArg) -> Self {
        match choice {
            NanArg::Stop => Self::Stop,
            NanArg::Prune => Self::Prune,
        }
    }
}

/// Spelling of [`InitChoice`] on the command line.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Init {
    /// On the points of the dataset's reconstruction
    Points,
    /// At random, where the cameras look
    Random,
}

impl From<Init> for InitChoice {
    fn from(init: Init) -> Self {
        match init {
            Init::Points => Self::Points,
            Init::Random => Self::Random,
        }
    }
}

/// Trains. `words` are those after `train` on the command line, which `args` was parsed from.
pub(super) fn run(words: &[OsString], args: &TrainArgs, console: &Console) -> Result<(), Failure> {
    let (args, resumed) = match args.resume {
        true => match resume::start(words, args, console)? {
            Start::Anew => (arguments(words)?, None),
            Start::From(run) => {
                let (args, resumed) = *run;
                (args, Some(resumed))
            }
        },
        false => (arguments(words)?, None),
    };
    let prepared = setup::prepare(&args, resumed, console)?;
    session::train(&args, prepared, console)
}

/// The arguments in the words of a call, its knobs spelled out.
pub(super) fn arguments(words: &[OsString]) -> Result<TrainArgs, Failure> {
    spelling::arguments(&spelling::spelled(words, None)?)
}

#[cfg(test)]
mod tests;
