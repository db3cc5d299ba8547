//! `densify export`: writes a trained model in another format.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use clap::Args;

use super::console::Console;
use crate::export::{Format, find, find_by_extension, formats};
use crate::failure::Failure;
use crate::number::grouped;
use crate::output::{model_path, write_atomically};
use crate::run::finished::{iteration, read_model};

/// Writes a trained model in another format.
///
/// The model keeps the coordinates of the dataset. The file appears only when it is complete.
#[derive(Debug, Args)]
#[command(after_help = after_help())]
pub(super) struct ExportArgs {
    /// Folder that `densify train` wrote, or a .ply of Gaussian splats
    #[arg(value_name = "RUN_OR_PLY")]
    model: PathBuf,
    /// File to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Format of the file `[default: the one with FILE's extension]`
    #[arg(long, value_name = "NAME")]
    format: Option<String>,
    /// Saved iteration of the run `[default: the last]`
    #[arg(long, value_name = "N")]
    iteration: Option<u32>,
    /// Replace FILE if it exists
    #[arg(long)]
    overwrite: bool,
}

fn after_help() -> String {
    let mut text = "Formats:\n".to_owned();
    for Format { name, extension, summary, .. } in formats() {
        let _ = writeln!(text, "  {name:8}  .{extension:8}  {summary}");
    }
    text + "
Examples:
  densify export output/garden-diet -o garden.ply
  densify export output/garden-diet --iteration 7000 -o early.ply
  densify export others.ply --format ply -o again.ply --overwrite"
}

pub(super) fn run(args: &ExportArgs, console: &Console) -> Result<(), Failure> {
    let format = match &args.format {
        Some(name) => find(name).map_err(|error| Failure::input(format!("--format: {error}")))?,
        None => find_by_extension(&args.output).map_err(|error| {
            Failure::input(format!("-o: {error}, and name it with --format NAME"))
        })?,
    };
    check_output(&args.output, args.overwrite)?;
    let path = match args.model.is_file() {
        true if args.iteration.is_some() => {
            return Err(Failure::input(
                "--iteration is for a run's folder; a file has only one model",
            ));
        }
        true => args.model.clone(),
        false => model_path(&args.model, iteration(&args.model, args.iteration)?),
    };
    let model = read_model(&path, console)?;
    write_atomically(&args.output, |out| format.write(&model, out))?;
    console.result(format_args!(
        "{} Gaussians in {} ({})",
        grouped(model.len()),
        args.output.display(),
        format.name
    ));
    Ok(())
}

/// Fails where something is in the way of the output.
fn check_output(path: &Path, overwrite: bool) -> Result<(), Failure> {
    let path_text = path.display();
    match path.symlink_metadata() {
        Ok(_) if path.is_dir() => {
            Err(Failure::input(format!("-o: {path_text} is a folder; name a file")))
        }
        Ok(_) if !overwrite => Err(Failure::input(format!(
            "-o: {path_text} exists; choose another file, or replace it with --overwrite"
        ))),
        _ => Ok(()),
    }
}
