//! `densify mesh`: a triangle mesh of the surface that a model shows.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use clap::{ArgMatches, Args};
use glam::DVec3;

use super::console::Console;
use super::export::check_output;
use super::render::{ModelArgument, RenderingArgs, given_option};
use densify_core::memory::Bytes;
use densify_core::numbers::{counted, grouped, percent};
use densify_inspect::{Limits, mesh_values};
use densify_mesh::{
    DepthSource, FuseOptions, Fused, MeshError, MeshErrors, MeshFormat, ModelSource, Region, fuse,
    score,
};
use densify_policies::policy::Needs;
use densify_render::{BackendChoice, DepthKind};
use densify_run::coordinate_check::CoordinateCheck;
use densify_run::failure::Failure;
use densify_run::{ByteCount, DeviceSpec, ProcessMemory};
use densify_train::evaluate::Split;

/// Memory that rendering and reading a depth map take, for each pixel `[bytes]`.
const BYTES_PER_PIXEL: u64 = 256;
/// Memory if neither the user nor the system limits it `[bytes]`.
const MEMORY: u64 = 4 << 30;

/// Fuses the surface that a model shows into a triangle mesh.
///
/// Renders depth and colour of the training views. A voxel x gets the weighted mean of its truncated signed distances
/// to the surface of each view v that has it in front of the surface, or less than τ behind:
///
///   D(x) = Σᵥ w · min(1, (d − z)/τ) / Σᵥ w,   w = cosθ / d²,   τ = 4 voxels,
///
/// where z is the depth of x, d the depth of the surface in the pixel that shows x, and θ the angle between its ray and
/// the surface's normal. Pixels with alpha below 0.5 show no surface. The mesh is the zero crossing of D (surface nets);
/// a vertex has the mean colour of the views that see it, weighted by w. Coordinates and unit are those of the dataset.
///
/// Voxels are stored in blocks near the surface. If they do not fit into --memory, the mesh is made in several passes.
/// Neither this nor the number of threads changes it. Depth is rendered on the processor.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct MeshArgs {
    /// Folder that `densify train` wrote, or a file of Gaussian splats (for SOG, also a folder)
    #[arg(value_name = "RUN_OR_MODEL")]
    model: PathBuf,
    /// File to write: .ply, .glb or .obj
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Replace a file that exists
    #[arg(long)]
    overwrite: bool,
    /// Saved iteration of the run `[default: the last]`
    #[arg(long, value_name = "N")]
    iteration: Option<u32>,
    /// Folder or ZIP archive of the dataset: needed for a file, and for a run whose dataset has moved
    #[arg(long, value_name = "DIR")]
    scene: Option<PathBuf>,
    /// Length of a voxel in the dataset's unit; details of half this size are lost `[default: 1/256 of the diagonal of
    /// --box or of the box around the scene, which is printed]`
    #[arg(long, value_name = "LENGTH", value_parser = positive)]
    voxel: Option<f64>,
    /// Limit of the memory of this command: 512MiB, 2GiB `[default: half of what the system has available]`
    #[arg(long, value_name = "SIZE")]
    memory: Option<ByteCount>,
    /// Depth of a pixel: expected (the mean of the Gaussians blended into it, Σ α·T·z / Σ α·T), or median (of the one
    /// that reduces the transmittance to below one half) `[default: expected for a run that was trained on depth, else
    /// median]`
    #[arg(long, value_name = "KIND")]
    depth_kind: Option<DepthKind>,
    /// Ignore pixels whose Gaussians' depths have a standard deviation above this fraction of the depth
    #[arg(long, value_name = "FRACTION", default_value_t = 0.4, value_parser = not_negative)]
    max_spread: f64,
    /// Drop connected parts with less than this fraction of the mesh's area
    #[arg(long, value_name = "FRACTION", default_value_t = 0.001, value_parser = share)]
    min_component: f64,
    /// Fuse only this part of space, in the dataset's coordinates `[default: around the points that the views show]`
    #[arg(long = "box", value_name = "X0,Y0,Z0,X1,Y1,Z1", allow_hyphen_values = true)]
    region: Option<BoxArgument>,
    #[command(flatten)]
    rendering: RenderingArgs,
}

const EXAMPLES: &str = "\
Options under Scene are for a model file; a run brings its own.

Examples:
  densify mesh output/garden-diet -o garden.ply
  densify mesh output/garden-diet -o garden.glb --voxel 0.02 --memory 2GiB
  densify mesh others.spz --scene data/garden -o garden.obj --box -2,-1,-2,2,1.5,2
  densify eval garden.ply --scene scene:room";

/// A box as text: six numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct BoxArgument {
    pub(super) low: DVec3,
    pub(super) high: DVec3,
}

impl FromStr for BoxArgument {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let numbers = text.split(',').map(|part| part.trim().parse::<f64>().ok());
        let numbers: Option<Vec<f64>> = numbers.collect();
        if let Some([a, b, c, d, e, f]) = numbers.as_deref() {
            let (low, high) = (DVec3::new(*a, *b, *c), DVec3::new(*d, *e, *f));
            if low.is_finite() && high.is_finite() && low.cmplt(high).all() {
                return Ok(Self { low, high });
            }
        }
        Err("give the smallest x, y and z and then the largest ones, such as -1,-1,0,1,1,2".into())
    }
}

/// Parses a number > 0.
fn positive(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number: &f64| number.is_finite() && *number > 0.0);
    number.ok_or_else(|| "give a number above 0".to_owned())
}

/// Parses a number >= 0.
fn not_negative(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number: &f64| number.is_finite() && *number >= 0.0);
    number.ok_or_else(|| "give a number from 0 on".to_owned())
}

/// Parses a share, from 0 to 1.
pub(super) fn share(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|number| (0.0..=1.0).contains(number));
    number.ok_or_else(|| "give a number from 0 to 1".to_owned())
}

pub(super) fn run(args: &MeshArgs, matches: &ArgMatches, console: &Console) -> Result<(), Failure> {
    let Some(format) = MeshFormat::of_file(&args.output) else {
        let output = args.output.display();
        return Err(Failure::input(format!("-o: {output} must end in .ply, .glb or .obj")));
    };
    check_output(&args.output, args.overwrite)?;
    let rendering =
        RenderingArgs { device: on_processor(&args.rendering.device)?, ..args.rendering.clone() };
    let argument = ModelArgument {
        model: &args.model,
        scene: args.scene.as_deref(),
        iteration: args.iteration,
    };
    let mut opened = argument.open(&rendering, Needs::default(), matches, console)?;
    let views = opened.views(Split::Train)?;
    let normalisation = opened.dataset.normalisation;
    let region = args.region.map(|BoxArgument { low, high }| Region {
        low: normalisation.scene_from_world(low),
        high: normalisation.scene_from_world(high),
    });
    let background = opened.data.background.fixed();
    CoordinateCheck::measure(opened.backend.as_mut(), &views, (background, opened.sh_degree))?
        .require(None, &args.model, console)?;
    // Depth in the loss makes the expected depth exact; without it, Gaussians before the surface pull it forward.
    let usual = if opened.trained_on_depth { DepthKind::Expected } else { DepthKind::Median };
    let depth = args.depth_kind.unwrap_or(usual);
    console.say(format_args!("depth    {depth} depth of each pixel"));
    let mut source = ModelSource {
        backend: opened.backend.as_mut(),
        views: &views,
        sh_degree: opened.sh_degree,
        depth,
        max_spread: args.max_spread as f32,
    };
    // Memory is measured after a view was rendered, since the renderer's lists take some only then.
    source.frame(0)?;
    let (width, height) = opened.dataset.largest_image();
    let memory = memory_left(args.memory, u64::from(width) * u64::from(height))?;
    let options = FuseOptions {
        voxel: args.voxel.map(|voxel| voxel * normalisation.scale),
        region,
        min_component: args.min_component,
        memory,
        unit: normalisation.scale,
    };
    let fused = fuse(&mut source, &options, console);
    let Fused { mesh, passes, dropped: (count, share), .. } = fused.map_err(failure_of)?;
    if passes > 1 {
        console.say(format_args!("fused    in {passes} passes, within the memory"));
    }
    if count > 0 {
        let count = counted(count, "component");
        console.say(format_args!("dropped  {count} with {} of the area", percent(share)));
    }
    let mesh = mesh.in_world(&normalisation);
    format.write(&mesh, &args.output)?;
    console.result(format_args!(
        "{} vertices and {} triangles in {}",
        grouped(mesh.positions.len()),
        grouped(mesh.triangles.len()),
        args.output.display()
    ));
    Ok(())
}

/// The failure, with its remedy. A view that cannot be rendered keeps its exit code.
fn failure_of(error: MeshError) -> Failure {
    match error {
        MeshError::Source(failure) => failure,
        error => Failure::input(format!("{error}{}", error.remedy())),
    }
}

/// The same options for the processor, on which depth is measured.
pub(super) fn on_processor(device: &DeviceSpec) -> Result<DeviceSpec, Failure> {
    if device.backend == BackendChoice::Gpu || device.gpu.is_some() {
        return Err(Failure::input(
            "--backend: this depth is rendered on the processor only; leave out --backend and --gpu",
        ));
    }
    Ok(DeviceSpec { backend: BackendChoice::Cpu, ..device.clone() })
}

/// Memory beside the process as it is now, and beside what rendering an image of `pixels` takes.
fn memory_left(given: Option<ByteCount>, pixels: u64) -> Result<u64, Failure> {
    let system = ProcessMemory::SYSTEM;
    let held = (system.resident)().unwrap_or(0) + pixels * BYTES_PER_PIXEL;
    let Some(ByteCount(limit)) = given else {
        let granted = (system.grant)(rayon::current_num_threads());
        return Ok(granted.map_or(MEMORY, |granted| granted.left / 2));
    };
    limit.checked_sub(held).filter(|left| *left > 0).ok_or_else(|| {
        let (limit, held) = (Bytes(limit), Bytes(held));
        Failure::input(format!(
            "--memory: {limit} is too little: the model and its renderer take {held}, and voxels come on top"
        ))
    })
}

/// Options of `densify eval` that apply only to models.
const MODEL_OPTIONS: [&str; 8] =
    ["iteration", "split", "lpips", "fit_exposure", "near", "antialias", "backend", "gpu"];

/// Measures a mesh against the known surface of a scene, for `densify eval`.
pub(super) fn evaluate(
    (file, scene): (&Path, Option<&Path>),
    (rendering, limits): (&RenderingArgs, Limits<'_>),
    matches: &ArgMatches,
    console: &Console,
) -> Result<(), Failure> {
    if let Some(option) = given_option(MODEL_OPTIONS, matches) {
        let file = file.display();
        return Err(Failure::input(format!(
            "{option} is for models, and {file} is a mesh; leave the option out"
        )));
    }
    let Some(scene) = scene else {
        let file = file.display();
        return Err(Failure::input(format!(
            "{file} is a mesh, which is measured against a known surface; name its dataset with --scene DIR"
        )));
    };
    limits
        .check_known(&mesh_values(&MeshErrors::default()))
        .map_err(super::eval::with_option_names)?;
    super::threads::limit(rendering.device.threads);
    let errors = score(file, scene, &rendering.data, console)?;
    console.result(format_table(&errors));
    limits.check(&mesh_values(&errors)).map_err(super::eval::with_option_names)
}

/// The measurements, one per line, with lengths as percentages of the scene's diagonal.
fn format_table(errors: &MeshErrors) -> String {
    let lines = [
        ("mesh to surface, mean (of the diagonal)", errors.accuracy),
        ("surface to mesh, mean", errors.completeness),
        ("Chamfer distance", errors.chamfer),
        ("precision at 0.5 %", errors.precision_half_percent),
        ("recall at 0.5 %", errors.recall_half_percent),
        ("F-score at 0.5 %", errors.f_score_half_percent),
        ("precision at 1 %", errors.precision_one_percent),
        ("recall at 1 %", errors.recall_one_percent),
        ("F-score at 1 %", errors.f_score_one_percent),
    ];
    let lines = lines.map(|(name, value)| format!("{name:39}  {:>10}", percent(value)));
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn failures_keep_their_exit_codes() {
        let device = failure_of(MeshError::Source(Failure::new(3, "the device fails")));
        assert_eq!((device.code, device.to_string().as_str()), (3, "the device fails"));
        assert_eq!(failure_of(MeshError::Empty).code, 2);
    }

    #[test]
    fn boxes_are_six_numbers_in_order() {
        let parsed: BoxArgument = "-1, -2,0,1,2.5,3".parse().expect("a box");
        assert_eq!((parsed.low.y, parsed.high.y), (-2.0, 2.5));
        for wrong in ["", "1,2,3", "0,0,0,1,1,0", "0,0,0,1,1,nan", "0,0,0,1,1,1,1", "a,0,0,1,1,1"] {
            assert!(wrong.parse::<BoxArgument>().is_err(), "{wrong}");
        }
    }
}
