//! `densify export`: writes a trained model in other formats.

mod table;

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use clap::{ArgMatches, Args};

use super::console::Console;
use super::render::{RenderingArgs, refuse_scene_options};
use super::threads::open_machine;
use densify_core::files::FileError;
use densify_core::gaussians::Gaussians;
use densify_core::numbers::gaussians;
use densify_data::models::{Coordinates, Format, export_formats, find, find_by_extension};
use densify_inspect::Reference;
use densify_run::RunConfig;
use densify_run::failure::{Failure, INPUT};
use densify_run::finished::{model_file, read_model, read_model_as, write_model};
use table::WrittenFile;

/// Value of `--format` that selects every format.
const ALL: &str = "all";

/// Writes a trained model in another format, or in all formats.
///
/// The model keeps the coordinates of the dataset. A file appears only when it is complete. With
/// --format all, or --scene, prints the size of each file; with --scene, also reads each file back and prints
/// how closely its renderings of the held-out views match those of the original model.
#[derive(Debug, Args)]
#[command(after_help = after_help())]
pub(super) struct ExportArgs {
    /// Folder that `densify train` wrote, or a file of Gaussian splats (for SOG, also a folder)
    #[arg(value_name = "RUN_OR_MODEL")]
    model: PathBuf,
    /// File to write; with --format all, a folder
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Format of the file, or all `[default: the one with FILE's extension]`
    #[arg(long, value_name = "NAME")]
    format: Option<String>,
    /// Saved iteration of the run `[default: the last]`
    #[arg(long, value_name = "N")]
    iteration: Option<u32>,
    /// Coordinates of the file: local ones are relative to an offset, stored in the file or, for SPZ, in
    /// FILE.offset.json. auto: world, or local if f32 is too coarse for world coordinates, as in UTM
    #[arg(long, value_name = "KIND", default_value = "auto")]
    coordinates: Coordinates,
    /// Replace files that exist
    #[arg(long)]
    overwrite: bool,
    /// Folder or ZIP archive of the dataset whose held-out views are compared: every 8th photograph, unless
    /// the dataset or an option selects others
    #[arg(long, value_name = "DIR")]
    scene: Option<PathBuf>,
    #[command(flatten)]
    rendering: RenderingArgs,
}

fn after_help() -> String {
    let mut text = "Formats:\n".to_owned();
    for Format { name, extension, summary, .. } in export_formats() {
        let _ = writeln!(text, "  {name:14}  .{extension:14}  {summary}");
    }
    text + "
Options under Scene are for a model file with --scene; a run brings its own.

Examples:
  densify export output/garden-diet -o garden.ply
  densify export output/garden-diet --iteration 7000 -o early.spz
  densify export output/garden-diet --format all -o garden --scene data/garden
  densify export others.sog --format ply -o again.ply --overwrite"
}

pub(super) fn run(
    args: &ExportArgs,
    matches: &ArgMatches,
    console: &Console,
) -> Result<(), Failure> {
    let source = model_file(&args.model, args.iteration)?;
    let is_run = source != args.model;
    if is_run || args.scene.is_none() {
        refuse_scene_options(matches)?;
    }
    let files = output_files(args)?;
    for (_, path) in &files {
        check_output(path, args.overwrite)?;
    }
    let model = read_model_as(&source, args.rendering.antialias, console)?;
    let mut reference = match &args.scene {
        None => None,
        Some(scene) => Some(open_reference(args, is_run, scene, &model, console)?),
    };
    let mut written = Vec::new();
    let mut unfit = None;
    for (format, path) in &files {
        let shown = path.display().to_string();
        let result = write_model(format, path, &model, args.coordinates, console);
        match result.map_err(|error| if error.code == INPUT { error.within(&shown) } else { error })
        {
            Ok(()) => {}
            // Another format may be able to hold the model.
            Err(failure) if failure.code == INPUT && files.len() > 1 => {
                console.say(format_args!("note: not written: {failure}"));
                unfit = unfit.or(Some(failure));
                continue;
            }
            Err(failure) => return Err(failure),
        }
        let psnr = match &mut reference {
            None => None,
            Some(reference) => Some(reference.psnr_of(read_model(path, console)?)?),
        };
        console.result(format_args!(
            "{} in {} ({})",
            gaussians(model.len()),
            path.display(),
            format.name
        ));
        let bytes = path.metadata().map_err(FileError::io("read", path))?.len();
        written.push(WrittenFile { format: format.name, bytes, psnr });
    }
    if let Some(failure) = unfit.filter(|_| written.is_empty()) {
        return Err(failure);
    }
    if reference.is_some() || written.len() > 1 {
        console.result(table::format(&written, model.len()));
    }
    Ok(())
}

/// The original model, for comparison with the files.
fn open_reference(
    args: &ExportArgs,
    is_run: bool,
    scene: &Path,
    model: &Gaussians,
    console: &Console,
) -> Result<Reference, Failure> {
    let (data, near) = if is_run {
        let spec = RunConfig::read(&args.model)?.spec;
        (spec.data, spec.start.near)
    } else {
        (args.rendering.data.clone(), args.rendering.near)
    };
    let machine = open_machine(&args.rendering.device, console)?;
    Reference::open(&args.model, model, scene, data, (near, machine), console)
}

/// The formats to write, each with its file.
fn output_files(args: &ExportArgs) -> Result<Vec<(&'static Format, PathBuf)>, Failure> {
    match args.format.as_deref() {
        Some(ALL) => {
            if args.output.exists() && !args.output.is_dir() {
                let output = args.output.display();
                return Err(Failure::input(format!(
                    "-o: {output} is not a folder; with --format {ALL} name a folder"
                )));
            }
            let stem = output_stem(&args.model);
            let file =
                |format: &'static Format| args.output.join(format!("{stem}.{}", format.extension));
            Ok(export_formats().into_iter().map(|format| (format, file(format))).collect())
        }
        Some(name) => {
            let format =
                find(name).map_err(|error| Failure::input(format!("--format: {error}, {ALL}")))?;
            Ok(vec![(format, args.output.clone())])
        }
        None => Ok(vec![(format_from_extension(&args.output)?, args.output.clone())]),
    }
}

/// The name of the written files without extension: that of the run, or of the model's file.
fn output_stem(model: &Path) -> String {
    let name = model.file_name().unwrap_or("model".as_ref()).to_string_lossy().into_owned();
    if model.is_dir() {
        return name;
    }
    let known = find_by_extension(model).map_or(0, |format| format.extension.len() + 1);
    let end = match known {
        0 => name.rfind('.').unwrap_or(name.len()),
        _ => name.len() - known,
    };
    if end == 0 { "model".to_owned() } else { name[..end].to_owned() }
}

/// The format that matches the extension of an output file.
pub(super) fn format_from_extension(output: &Path) -> Result<&'static Format, Failure> {
    find_by_extension(output)
        .map_err(|error| Failure::input(format!("-o: {error}, and name it with --format NAME")))
}

/// Fails if the output is a folder, a device or a pipe; without `overwrite`, also if it is a file.
pub(super) fn check_output(path: &Path, overwrite: bool) -> Result<(), Failure> {
    let shown = path.display();
    match path.symlink_metadata() {
        Ok(_) if path.is_dir() => {
            Err(Failure::input(format!("-o: {shown} is a folder; name a file")))
        }
        // Renaming a file over a device or a pipe would remove it for other programs.
        Ok(_) if path.exists() && !path.is_file() => {
            Err(Failure::input(format!("-o: {shown} is a device or a pipe; name a file")))
        }
        Ok(_) if !overwrite => Err(Failure::input(format!(
            "-o: {shown} exists; choose another file, or replace it with --overwrite"
        ))),
        _ => Ok(()),
    }
}
