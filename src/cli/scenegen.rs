//! `densify scenegen`: posed images of a mesh.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use densify_scenegen::{
    Ambient, Damage, Lens, Options, PRESETS, PointOptions, RigKind, Scene, Source, check_target,
    contact_sheet, write,
};
use image::{DynamicImage, RgbaImage};

use super::console::Console;
use super::threads;
use densify_core::numbers::grouped;
use densify_data::dataset::builtin;
use densify_run::Threads;
use densify_run::failure::Failure;
use densify_train::pictures::write_png;

/// Ray-traces a mesh into posed images of known geometry.
///
/// INPUT is a .gltf, .glb or .obj file; --preset names a built-in scene instead. Writes images with
/// alpha, depth and normals (EXR), cameras for NeRF-synthetic readers (transforms_train.json,
/// transforms_test.json), for nerfstudio (transforms.json, with depth as .npy) and for COLMAP
/// (sparse/0), initial points (points3d.ply), the mesh as traced (mesh.ply), and a description of the
/// scene (scene.json). Built-in scenes can be trained on without any file: densify train scene:NAME.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct ScenegenArgs {
    /// Mesh to render: .gltf, .glb or .obj
    #[arg(conflicts_with_all = ["preset", "list"], required_unless_present_any = ["preset", "list"])]
    input: Option<PathBuf>,
    /// Render a built-in scene; some have sizes: town:4 is larger than town
    #[arg(long, value_name = "NAME", conflicts_with = "list")]
    preset: Option<String>,
    /// List the built-in scenes
    #[arg(long)]
    list: bool,
    /// Folder to write the scene to
    #[arg(short, long, value_name = "DIR", help_heading = "Output")]
    output: Option<PathBuf>,
    /// Write one PNG with eight views
    #[arg(long, value_name = "FILE", help_heading = "Output", conflicts_with = "list")]
    contact_sheet: Option<PathBuf>,
    /// Replace the scene in the output folder once this one is complete
    #[arg(long, help_heading = "Output")]
    overwrite: bool,

    /// Arrangement of the cameras [default: that of the built-in scene; dome for files]
    #[arg(long, value_enum, value_name = "RIG", help_heading = "Cameras")]
    rig: Option<RigArg>,
    /// Views to train on `[default: 60, or as the built-in scene says]`
    #[arg(long, value_name = "N", help_heading = "Cameras")]
    train: Option<u32>,
    /// Views held out, on a path of their own `[default: 20, or as the built-in scene says]`
    #[arg(long, value_name = "N", help_heading = "Cameras")]
    test: Option<u32>,
    /// Image size in pixels, such as 400 or 640x480 `[default: 256, or as the built-in scene says]`
    #[arg(long, value_name = "SIZE", help_heading = "Cameras", value_parser = parse_size)]
    size: Option<(u32, u32)>,
    /// Horizontal field of view in degrees
    #[arg(long, value_name = "DEGREES", help_heading = "Cameras")]
    fov: Option<f64>,
    /// Distance of the cameras, relative to the distance at which the scene fills the image; with --rig inside, the
    /// radius of the cameras' path as a share of the room; with --rig survey, a factor on the height of the path
    #[arg(long, value_name = "FACTOR", help_heading = "Cameras")]
    radius: Option<f64>,
    /// Photograph training views through a lens, fisheye:K1[,K2,K3,K4] or radial:K1[,K2], with the coefficients of
    /// COLMAP's OPENCV_FISHEYE and OPENCV. Test views keep the pinhole camera
    #[arg(long, value_name = "LENS", help_heading = "Cameras")]
    lens: Option<Lens>,
    /// Put people into this share of the training views, at a different place in each, and mask them
    #[arg(long, value_name = "SHARE", help_heading = "Cameras", default_value_t = 0.0)]
    passers_by: f64,
    /// Random displacement of the cameras, as a share of their distance
    #[arg(long, value_name = "SHARE", help_heading = "Cameras")]
    jitter: Option<f64>,

    /// Samples along each side of a pixel: 4 means 16 samples per pixel
    #[arg(long, value_name = "N", help_heading = "Light", default_value_t = 4)]
    samples: u32,
    /// Sample occlusion of the sky, with this many rays per pixel
    #[arg(long, value_name = "RAYS", help_heading = "Light", value_parser = clap::value_parser!(u32).range(1..=65_536))]
    ao: Option<u32>,
    /// Sample light that is reflected once between surfaces, with this many rays per pixel
    #[arg(long, value_name = "RAYS", help_heading = "Light", conflicts_with = "ao", value_parser = clap::value_parser!(u32).range(1..=65_536))]
    bounce: Option<u32>,
    /// Environment light: an equirectangular .hdr or .exr image, +y up and +x in its middle, in
    /// place of the built-in sky and sun. It lights the scene only: the background stays transparent
    #[arg(long, value_name = "FILE", help_heading = "Light")]
    sky: Option<PathBuf>,
    /// Let light pass through surfaces: no shadows
    #[arg(long, help_heading = "Light")]
    no_shadows: bool,
    /// Make all materials diffuse: colours do not depend on the viewing direction
    #[arg(long, help_heading = "Light")]
    lambert: bool,
    /// Factor on all light [default: 1; chosen automatically with --sky and for meshes with lights of their own]
    #[arg(long, value_name = "FACTOR", help_heading = "Light")]
    exposure: Option<f32>,
    /// Vary the exposure of training views by up to this many stops, and their white balance by up to 10 %. Test
    /// views and points are unchanged; scene.json has the factors
    #[arg(long, value_name = "STOPS", help_heading = "Light", default_value_t = 0.0)]
    exposure_jitter: f32,
    /// Darken training views towards the corners of the picture, which lose this share of their light: 0.5 is one stop.
    /// Test views and points are unchanged
    #[arg(long, value_name = "STRENGTH", help_heading = "Light", default_value_t = 0.0)]
    vignette: f32,

    /// Number of initial points, on surfaces with detail that at least three views see
    #[arg(long, value_name = "N", help_heading = "Points", default_value_t = 5000)]
    points: usize,
    /// Standard deviation of the noise on the points' coordinates, as a share of the scene's diagonal
    #[arg(long, value_name = "SHARE", help_heading = "Points", default_value_t = 0.001)]
    point_noise: f64,
    /// Share of the points that are at random places
    #[arg(long, value_name = "SHARE", help_heading = "Points", default_value_t = 0.02)]
    outliers: f64,
    /// Share of space to leave without points, in patches of 2 % of the diagonal
    #[arg(long, value_name = "SHARE", help_heading = "Points", default_value_t = 0.0)]
    dropout: f64,
    /// Put no points on thin structures
    #[arg(long, help_heading = "Points")]
    without_thin: bool,

    /// Add noise to the depth of training views (.npy only; .exr stays true): its standard deviation, as a share of the
    /// depth
    #[arg(long, value_name = "SHARE", help_heading = "Damage", default_value_t = 0.0)]
    depth_noise: f64,
    /// Distance over which this noise is correlated; up to 1: white noise
    #[arg(long, value_name = "PX", help_heading = "Damage", default_value_t = 0.0)]
    depth_noise_width: f64,
    /// Share of the pixels to leave without depth, in patches
    #[arg(long, value_name = "SHARE", help_heading = "Damage", default_value_t = 0.0)]
    depth_holes: f64,
    /// Share of the remaining pixels, chosen at random, that keep their depth, as after a laser scan
    #[arg(long, value_name = "SHARE", help_heading = "Damage", default_value_t = 1.0)]
    depth_sparse: f64,
    /// Multiply all depths, as in a wrong unit or scale
    #[arg(long, value_name = "FACTOR", help_heading = "Damage", default_value_t = 1.0)]
    depth_scale: f64,
    /// Multiply the depth of each view by another factor: the standard deviation of its logarithm
    #[arg(long, value_name = "SHARE", help_heading = "Damage", default_value_t = 0.0)]
    depth_scale_jitter: f64,
    /// Write distances along rays instead of depth along the optical axis
    #[arg(long, help_heading = "Damage")]
    depth_along_rays: bool,
    /// Displace depth to the right and down, such as 2,0
    #[arg(long, value_name = "X,Y", help_heading = "Damage", value_parser = parse_shift, default_value = "0,0", allow_hyphen_values = true)]
    depth_shift: (i32, i32),
    /// Rotate the pose of each training view about the camera's centre: the standard deviation of the angle
    #[arg(long, value_name = "DEGREES", help_heading = "Damage", default_value_t = 0.0)]
    pose_noise: f64,
    /// Displace each training camera along each axis: the standard deviation, as a share of the largest distance of a
    /// training camera from their mean
    #[arg(long, value_name = "SHARE", help_heading = "Damage", default_value_t = 0.0)]
    position_noise: f64,
    /// Multiply the focal lengths of the training views by 1 + SHARE
    #[arg(
        long,
        value_name = "SHARE",
        help_heading = "Damage",
        default_value_t = 0.0,
        allow_hyphen_values = true
    )]
    focal_error: f64,

    /// Seed of all random choices
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    /// Processor threads to use, 1 to 256; the result does not depend on it `[default: all]`
    #[arg(long, value_name = "N")]
    threads: Option<Threads>,
}

const EXAMPLES: &str = "\
Examples:
  densify scenegen --list
  densify scenegen --preset thin -o data/thin
  densify scenegen --preset town:4 -o data/town --points 50000
  densify scenegen mesh.glb -o data/mesh --train 100 --size 400
  densify scenegen house.obj -o data/house --rig inside --bounce 64
  densify scenegen mesh.glb -o data/mesh --sky studio.hdr --ao 64
  densify scenegen --preset room -o data/room --depth-noise 0.05 --depth-holes 0.3
  densify scenegen mesh.glb --contact-sheet look.png";

/// The [`RigKind`], as named on the command line.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum RigArg {
    /// Rings around the scene
    Orbit,
    /// Evenly on the upper hemisphere
    Dome,
    /// Inside, looking in all directions, for rooms
    Inside,
    /// On an ellipse as wide and deep as the scene
    Ellipse,
    /// In rows above the scene, looking obliquely down; in town also along the streets
    Survey,
    /// At and around the cameras in the file
    File,
}

impl From<RigArg> for RigKind {
    fn from(rig: RigArg) -> Self {
        match rig {
            RigArg::Orbit => Self::Orbit,
            RigArg::Dome => Self::Dome,
            RigArg::Inside => Self::Inside,
            RigArg::Ellipse => Self::Ellipse,
            RigArg::Survey => Self::Survey,
            RigArg::File => Self::File,
        }
    }
}

fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let wrong = |_| format!("`{text}` is not an image size; write it as 400 or 640x480");
    let (width, height) = text.split_once('x').unwrap_or((text, text));
    Ok((width.parse().map_err(wrong)?, height.parse().map_err(wrong)?))
}

fn parse_shift(text: &str) -> Result<(i32, i32), String> {
    let wrong = || format!("`{text}` is not a displacement; write it as 2,0");
    let (x, y) = text.split_once(',').ok_or_else(wrong)?;
    Ok((x.trim().parse().map_err(|_| wrong())?, y.trim().parse().map_err(|_| wrong())?))
}

impl ScenegenArgs {
    fn options(&self) -> Options {
        let ambient = match (self.ao, self.bounce) {
            (Some(rays), _) => Some(Ambient::Occlusion(rays)),
            (None, Some(rays)) => Some(Ambient::Bounce(rays)),
            (None, None) => None,
        };
        Options {
            rig: self.rig.map(RigKind::from),
            train: self.train,
            test: self.test,
            size: self.size,
            fov: self.fov,
            radius: self.radius,
            jitter: self.jitter,
            grid: self.samples,
            ambient,
            sky: self.sky.clone(),
            shadows: !self.no_shadows,
            lambert: self.lambert,
            exposure: self.exposure,
            exposure_jitter: self.exposure_jitter,
            vignette: self.vignette,
            lens: self.lens,
            passers_by: self.passers_by,
            damage: Damage {
                noise: self.depth_noise,
                noise_width: self.depth_noise_width,
                holes: self.depth_holes,
                sparse: self.depth_sparse,
                scale: self.depth_scale,
                scale_jitter: self.depth_scale_jitter,
                along_rays: self.depth_along_rays,
                shift: self.depth_shift.into(),
                pose_noise: self.pose_noise,
                position_noise: self.position_noise,
                focal_error: self.focal_error,
            },
            points: PointOptions {
                count: self.points,
                noise: self.point_noise,
                outliers: self.outliers,
                dropout: self.dropout,
                without_thin: self.without_thin,
            },
            seed: self.seed,
        }
    }
}

pub(super) fn run(args: &ScenegenArgs, console: &Console) -> Result<(), Failure> {
    if args.list {
        let width = PRESETS.iter().map(|preset| preset.name.len()).max().unwrap_or(0);
        for preset in PRESETS {
            console.result(format_args!("{:width$}  {}", preset.name, preset.summary));
        }
        console.result(format_args!(
            "\n`densify train scene:NAME` trains on one; `densify scenegen --preset NAME -o DIR` writes it."
        ));
        return Ok(());
    }
    let source = match (&args.preset, &args.input) {
        (Some(name), _) => Source::Preset(name.clone()),
        (None, Some(path)) => match builtin::meant(path) {
            Some(name) => {
                return Err(Failure::input(format!(
                    "{} does not exist; --preset {name} renders the built-in scene, and \
                     `densify train scene:{name}` needs no files",
                    path.display()
                )));
            }
            None => Source::File(path.clone()),
        },
        (None, None) => {
            return Err(Failure::input("name a mesh, or a built-in scene with --preset"));
        }
    };
    match &args.output {
        Some(output) => check_target(output, args.overwrite)?,
        None if args.contact_sheet.is_some() => {}
        None => return Err(Failure::input("give the folder to write the scene to, with --output")),
    }
    threads::limit(args.threads);
    let scene = Scene::prepare(&source, &args.options())?;
    print_scene(&scene, console);
    if let Some(path) = &args.contact_sheet {
        let (width, height, rgba) = contact_sheet(&scene);
        let sheet = RgbaImage::from_raw(width, height, rgba).unwrap_or_default();
        write_png(path, &DynamicImage::ImageRgba8(sheet))?;
        console.result(format_args!("eight views in {}", path.display()));
    }
    let Some(output) = &args.output else {
        return Ok(());
    };
    let count = scene.views.len();
    let tenth = count.div_ceil(10).max(1);
    let written = write(&scene, output, args.overwrite, |view| {
        if (view + 1) % tenth == 0 || view + 1 == count {
            console.progress(format_args!("rendered {} of {count} views", view + 1));
        }
    })?;
    console.result(format_args!(
        "{} views and {} points in {}",
        written.views,
        grouped(written.points),
        output.display()
    ));
    let wanted = args.points as f64 * (1.0 - args.dropout);
    if (written.points as f64) < 0.5 * wanted {
        console.say(format_args!(
            "note: only {:.0} % of {} points could be placed, because each must be seen by three views; add views \
             (--train), widen --fov, or choose another --rig (inside for rooms); or train with --init random",
            100.0 * written.points as f64 / args.points as f64,
            grouped(args.points)
        ));
    }
    Ok(())
}

fn print_scene(scene: &Scene, console: &Console) {
    for note in &scene.model.notes {
        console.say(format_args!("note: {note}"));
    }
    let rig = &scene.rig;
    console.say(format_args!(
        "scene    {}: {} triangles",
        scene.name,
        grouped(scene.model.triangles.len())
    ));
    console.say(format_args!(
        "views    {} to train on, {} held out, {}x{} px",
        rig.train, rig.test, rig.width, rig.height
    ));
}

#[cfg(test)]
mod tests {
    use std::ffi::OsStr;

    use clap::FromArgMatches;

    use super::*;
    use densify_core::files::disk::{Fault, Operation, with_fault};
    use densify_run::failure::OTHER;

    #[test]
    fn contact_sheets_are_written_atomically() {
        let root = tempfile::tempdir().unwrap();
        let sheet = root.path().join("sheet.png");
        let words = ["scenegen", "--preset", "spheres", "--size", "8", "--samples", "1"];
        let words = words.map(OsStr::new).into_iter();
        let words = words.chain(["--contact-sheet".as_ref(), sheet.as_os_str()]);
        let matches = ScenegenArgs::augment_args(clap::Command::new("")).get_matches_from(words);
        let args = ScenegenArgs::from_arg_matches(&matches).unwrap();
        for operation in [Operation::Create, Operation::Write, Operation::Sync] {
            let (file, kind) = ("sheet.png", std::io::ErrorKind::StorageFull);
            let fault = Fault { operation, file, spared: 0, kind };
            let (done, met) = with_fault(Some(fault), || run(&args, &Console::new(true)));
            let failure = done.unwrap_err();
            assert!(
                met > 0 && failure.code == OTHER && failure.to_string().contains(file),
                "{failure}"
            );
            assert_eq!(std::fs::read_dir(root.path()).unwrap().count(), 0, "{operation:?}");
        }
        run(&args, &Console::new(true)).unwrap();
        assert_eq!(image::open(sheet).unwrap().width(), 32);
    }

    #[test]
    fn sizes_are_parsed() {
        assert_eq!(parse_size("400"), Ok((400, 400)));
        assert_eq!(parse_size("640x480"), Ok((640, 480)));
        for bad in ["", "x", "640x", "-1", "640x480x3", "1.5"] {
            assert!(parse_size(bad).unwrap_err().contains("640x480"), "{bad}");
        }
    }
}
