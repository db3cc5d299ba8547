//! The command line: arguments → validated options → run. No other crate prints.
//!
//! There is one file per subcommand. Exit codes: 0 success; 2 bad input or usage; 3 the device or the memory is
//! insufficient; 4 `eval` measured a value beyond its limit; 130 and 143 SIGINT or SIGTERM ended the run; 1 anything
//! else. An error is one message that names the file, field or flag and the remedy.
//!
//! A program with its own policies takes two lines:
//!
//! ```no_run
//! // use my_policies as _;   // linked, and therefore registered
//! fn main() -> std::process::ExitCode {
//!     densify_cli::run()
//! }
//! ```

mod blocks;
mod clean;
mod compress;
mod console;
#[cfg(feature = "gpu")]
mod devices;
mod eval;
mod export;
mod film;
mod flags;
mod interrupt;
mod knobs;
mod mesh;
mod plan;
mod policies;
mod poses;
mod progress;
mod render;
#[cfg(feature = "study")]
mod report;
mod scenegen;
#[cfg(feature = "selftest")]
mod selftest;
#[cfg(feature = "study")]
mod study;
mod threads;
mod train;
#[cfg(feature = "view")]
mod view;
#[cfg(not(all(feature = "gpu", feature = "selftest", feature = "study", feature = "view")))]
mod without;

use std::ffi::OsString;
use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

use console::Console;
use densify_render::cpu::InstructionSet;
use densify_run::failure::{self, Failure};
#[cfg(not(feature = "gpu"))]
use without::devices;
#[cfg(not(feature = "selftest"))]
use without::selftest;
#[cfg(not(feature = "view"))]
use without::view;
#[cfg(not(feature = "study"))]
use without::{report, study};

/// Trains 3D Gaussian Splatting scenes under a hard memory budget.
///
/// A scene is a folder of photographs whose cameras are known: a COLMAP reconstruction, a
/// NeRF-synthetic scene or a nerfstudio dataset; `densify poses` finds unknown ones. The result is a .ply that any viewer of Gaussian
/// splats opens.
#[derive(Debug, Parser)]
#[command(name = "densify", version, propagate_version = true, after_help = EXAMPLES)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

const EXAMPLES: &str = "\
Examples:
  densify train scene:spheres -i 2000                      train on a built-in scene: no file needed
  densify train data/garden --eval                         train, hold out every 8th photograph
  densify train data/garden --policy vanilla --budget 1M   another policy, at most a million Gaussians
  densify poses photos -o data/garden                      the cameras of photographs or of a video
  densify plan data/garden --memory 512MiB                 the largest model that fits this memory
  densify eval output/garden-diet                          PSNR and SSIM of the photographs held out
  densify render output/garden-diet -o pictures            those views, rendered to PNG files
  densify view output/garden-diet                          the model in the browser
  densify report output/garden-diet -o garden.html         scores, curves and pictures as one file
  densify export output/garden-diet -o garden.ply          the model as a file for other programs
  densify compress output/garden-diet --to 5MiB -o garden.sog
                                                           a smaller file of the model
  densify clean output/garden-diet -o garden-clean.ply --refine 1000
                                                           the model without floaters
  densify mesh output/garden-diet -o garden.glb            a triangle mesh of the surface
  densify blocks plan data/city -o city --rows 2M --memory 8GiB
                                                           a scene too large for one machine
  densify compare data/garden --policies vanilla,diet --budget 200k
                                                           which policy does best here
  densify policies diet                                    what a policy does, and its parameters
  densify knobs                                            what trades speed or memory for accuracy
  densify trade data/garden --knobs alpha_min,sh_degree    what these cost and gain here
  densify scenegen mesh.glb -o data/mesh                   posed images of a mesh, with depth and normals
  densify selftest                                         check the arithmetic of this machine

`densify COMMAND --help` explains every option of a command.";

const PLAN_EXAMPLES: &str = "\
Examples:
  densify plan data/garden --memory 512MiB
  densify plan data/garden --budget 1.5M --policy taming --eval -r 2";

#[derive(Debug, Subcommand)]
enum Command {
    Train(Box<train::TrainArgs>),
    Blocks(Box<blocks::BlocksArgs>),
    /// Prints the memory that a run would take, without training.
    ///
    /// Takes the options of `densify train` and prints the memory that the run would reserve, buffer by
    /// buffer, and then how many Gaussians fit into the same memory at each spherical-harmonic degree and
    /// with images of full, half and quarter size. Writes nothing.
    #[command(after_help = PLAN_EXAMPLES)]
    Plan(Box<train::TrainArgs>),
    Eval(Box<eval::EvalArgs>),
    Clean(Box<clean::CleanArgs>),
    Compress(Box<compress::CompressArgs>),
    Export(Box<export::ExportArgs>),
    Mesh(Box<mesh::MeshArgs>),
    Render(Box<render::RenderArgs>),
    Report(report::ReportArgs),
    Compare(study::Comparison),
    Devices(devices::DevicesArgs),
    Knobs(knobs::KnobsArgs),
    Policies(policies::PoliciesArgs),
    Poses(Box<poses::PosesArgs>),
    Scenegen(Box<scenegen::ScenegenArgs>),
    Selftest(selftest::SelftestArgs),
    #[command(hide = true)]
    StudyRun(study::StudyRun),
    Trade(study::Trade),
    View(Box<view::ViewArgs>),
}

/// Runs the command line of this process, for the `main` function of any program.
#[must_use]
pub fn run() -> ExitCode {
    ExitCode::from(run_with(std::env::args_os()))
}

/// Runs a command line that begins with the program's name, and returns the exit code. Unlike [`run`], it is for
/// programs that hold this one, such as Python.
pub fn run_with(arguments: impl IntoIterator<Item = impl Into<OsString> + Clone>) -> u8 {
    let parsed = command().try_get_matches_from(arguments).and_then(|matches| {
        let arguments = Arguments::from_arg_matches(&matches)?;
        Ok((matches, arguments))
    });
    let (matches, arguments) = match parsed {
        Ok(parsed) => parsed,
        Err(help_or_error) => {
            // A closed pipe is not a failure.
            let _ = help_or_error.print();
            return u8::try_from(help_or_error.exit_code()).unwrap_or(failure::INPUT);
        }
    };
    let quiet = match &arguments.command {
        Command::Train(train) | Command::Plan(train) => train.quiet,
        // The user did not ask for the runs that the selftest makes, and the selftest prints the device itself.
        Command::Selftest(_) => true,
        _ => false,
    };
    let console = Console::new(quiet);
    let (_, given) = matches.subcommand().unwrap_or(("", &matches));
    let instructions = InstructionSet::from_environment().map_err(Failure::input);
    let done = instructions.and_then(|_| match arguments.command {
        Command::Train(mut train) => train::run(&mut train, given, &console),
        Command::Blocks(args) => blocks::run(&args, &console),
        Command::Plan(train) => plan::run(&train, given, &console),
        Command::Eval(eval) => eval::run(&eval, given, &console),
        Command::Clean(args) => clean::run(&args, given, &console),
        Command::Compress(compress) => compress::run(&compress, given, &console),
        Command::Mesh(args) => mesh::run(&args, given, &console),
        Command::Export(export) => export::run(&export, given, &console),
        Command::Render(render) => render::run(&render, given, &console),
        Command::Report(report) => report::run(&report, &console),
        Command::Compare(comparison) => study::compare(&comparison, &console),
        Command::Devices(devices) => devices::run(&devices, &console),
        Command::Knobs(knobs) => knobs::run(&knobs, &console),
        Command::Policies(policies) => policies::run(&policies, &console),
        Command::Poses(args) => poses::run(&args, &console),
        Command::Scenegen(scenegen) => scenegen::run(&scenegen, &console),
        Command::StudyRun(run) => study::run(&run, &console),
        Command::Trade(trade) => study::trade(&trade, &console),
        Command::Selftest(selftest) => selftest::run(&selftest, &console),
        Command::View(view) => view::run(&view, given, &console),
    });
    match done.and_then(|()| console.finish()) {
        Ok(()) => 0,
        Err(failure) => {
            console.error(&failure);
            failure.code
        }
    }
}

/// The parser, with the defaults of a run's options filled in for every command that takes such options.
#[must_use]
pub fn command() -> clap::Command {
    const WITH_RUN_OPTIONS: [&str; 11] = [
        "train", "plan", "clean", "compress", "eval", "export", "mesh", "render", "report",
        "selftest", "view",
    ];
    WITH_RUN_OPTIONS.iter().fold(Arguments::command(), |command, name| {
        command.mut_subcommand(name, flags::with_defaults)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_are_consistent() {
        command().debug_assert();
    }

    #[test]
    fn every_option_has_help() {
        for command in command().get_subcommands() {
            for argument in command.get_arguments() {
                let (id, name) = (argument.get_id(), command.get_name());
                assert!(argument.get_help().is_some(), "{name}: {id} has no help");
            }
        }
    }

    #[test]
    fn usage_errors_exit_with_code_2_and_help_with_code_0() {
        assert_eq!(run_with(["densify", "--help"]), 0);
        assert_eq!(run_with(["densify", "--version"]), 0);
        assert_eq!(run_with(["densify", "train"]), failure::INPUT);
        assert_eq!(run_with(["densify", "train", "x", "--budget", "0"]), failure::INPUT);
        assert_eq!(run_with(["densify", "nonsense"]), failure::INPUT);
        assert_eq!(run_with(["densify", "eval", "/no/such/run"]), failure::INPUT);
    }
}
