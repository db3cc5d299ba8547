//! The description of a run: every option is declared here once, with its type, default, range, help text and whether a
//! resumed run may change it. A description stays as the user gave it: choices are not written back into it.
//!
//! An option has one name everywhere: `--tile-cap` on the command line is `tile_cap` in a file and in
//! [`RunSpec`]. The flags of `densify train` and their help, `config.toml`, `--config`, `--resume`, what
//! `plan`, `compare` and `trade` pass on, and docs/options.md follow from this list.

mod added;
mod derived;
pub mod knobs;
mod overlay;
mod values;

pub(crate) use added::add_missing_parameters;
pub(crate) use overlay::NOT_OPTIONS;
pub use overlay::Partial;
pub(crate) use values::assignments;
pub use values::{
    AbsolutePath, Assignment, Budget, ByteCount, Fraction, ImageCache, InitChoice, PolicyFile,
    Rows, ShDegree, Threads, Weight, Whole,
};

use std::num::NonZeroU32;
use std::path::PathBuf;

use clap::{ArgAction, Args};
use serde::{Deserialize, Serialize};

use densify_core::antialiasing::Antialiasing;
use densify_core::spelling::Spelling;
use densify_data::dataset::{DepthAlong, DepthChoice, DepthUnit, FarCameras, MaskMode, Resolution};
use densify_data::models::Coordinates;
use densify_render::{BackendChoice, DepthTerm};
use densify_train::exposure::{ExposureChoice, ExposureModel};
use densify_train::poses::PoseChoice;
use densify_train::schedule::{Background, InitRates, REFERENCE_ITERATIONS};
use densify_train::trainer::{Annealed, OnNan};
use densify_train::vignette::VignetteChoice;
use values::as_table;

/// Rule for changing an option of a resumed run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OnResume {
    /// Another value is refused.
    Fixed,
    /// Any value is allowed; the result does not depend on it.
    Free,
    /// A larger value is allowed.
    Longer,
}

/// An option of a run, as the list below declares it.
#[derive(Debug, Clone, Copy)]
pub struct RunOption {
    /// Name in files, such as `tile_cap`.
    pub name: &'static str,
    /// Rule for changing it in a resumed run.
    pub on_resume: OnResume,
}

impl RunOption {
    /// The option of this name.
    pub fn find(name: &str) -> Option<&'static Self> {
        OPTIONS.iter().find(|option| option.name == name)
    }

    /// The flag, such as `--tile-cap`, or `SCENE`, which is positional.
    pub fn flag(&self) -> String {
        Spelling::Terminal.option(self.name)
    }
}

/// Declares a struct per group, its defaults, [`RunSpec`] and the table of options from one list. An option with
/// `value` takes a value; one with `switch` stands alone, or has `=true` or `=false`.
macro_rules! run_spec {
    ($($(#[$doc:meta])* $group:ident: $struct:ident, $heading:literal {
        $($(#[$meta:meta])* $name:ident: $type:ty = $default:expr, $on_resume:ident
            $(, value $value:literal)? $(, switch $action:ident)?;)*
    })*) => {
        $(
            $(#[$doc])*
            #[derive(Debug, Clone, PartialEq, Serialize, Deserialize, Args)]
            #[serde(default)]
            pub struct $struct {
                $(
                    #[arg(help_heading = $heading)]
                    $(#[arg(long, value_name = $value)])?
                    $(#[arg(
                        long, value_name = "true|false", action = ArgAction::$action, num_args = 0..=1,
                        require_equals = true, default_missing_value = "true", hide_possible_values = true
                    )])?
                    $(#[$meta])*
                    pub $name: $type,
                )*
            }

            impl $struct {
                /// Names of the group's options.
                pub const NAMES: &[&str] = &[$(stringify!($name)),*];
            }

            impl Default for $struct {
                fn default() -> Self {
                    Self { $($name: $default,)* }
                }
            }
        )*

        /// A run, completely described: plain data with a default for everything. Fields that are `None` are
        /// decided when the run is prepared.
        ///
        /// In a file all options are at the top level; the groups only structure the help.
        #[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, Args)]
        pub struct RunSpec {
            $($(#[$doc])* #[command(flatten)] #[serde(flatten)] pub $group: $struct,)*
        }

        /// Every option of a run, in the order of the help.
        pub const OPTIONS: &[RunOption] = &[$($(
            RunOption { name: stringify!($name), on_resume: OnResume::$on_resume },
        )*)*];
    };
}

run_spec! {
    /// Reading of the dataset.
    data: DataSpec, "Scene" {
        /// Hold out the dataset's own test views, or every 8th photograph by sorted name, for
        /// measuring
        #[arg(conflicts_with = "test_every")]
        eval: bool = false, Fixed, switch Set;

        /// Hold out every K-th photograph by sorted name, the first included
        test_every: Option<NonZeroU32> = None, Fixed, value "K";

        /// Folder of the photographs, if it is not the dataset's own (relative to the dataset)
        images: Option<PathBuf> = None, Free, value "DIR";

        /// Folder of the COLMAP model, such as sparse/1 (relative to the dataset; default: the one with the most
        /// images)
        sparse: Option<PathBuf> = None, Fixed, value "DIR";

        /// Use only the views that this file names, one per line. A tab and four numbers from 0 to 1 after a name
        /// (left, top, right, bottom) select a part of the view. Views are split into training and test views before
        /// the others are left out
        views: Option<AbsolutePath> = None, Fixed, value "FILE";

        /// Treatment of views whose camera is more than 10 times farther out than the median camera, if at most one
        /// camera in 20 is that far: structure from motion misplaces some cameras
        far_cameras: FarCameras = FarCameras::LeaveOut, Fixed, value "ACTION";

        /// Keep the full field of view of a distorted lens, and mask pixels that the lens did not see; by default
        /// photographs are cropped to the largest rectangle without such pixels. Where the distortion folds over, the
        /// part that can be undistorted is kept
        keep_fov: bool = false, Fixed, switch Set;

        /// Masks are white where photographs are to be ignored; by default black is ignored
        invert_masks: bool = false, Fixed, switch Set;

        /// Meaning of masked pixels. To carve out an object with the mode background, set --background to a colour that
        /// the object does not have, or to random
        mask_mode: MaskMode = MaskMode::Ignore, Fixed, value "MODE";

        /// Render a built-in scene again, and do not keep it in the user's cache folder
        no_cache: bool = false, Free, switch Set;

        /// Size of the photographs: 1, 2, 4 or 8 divides it (images_2, images_4, images_8 are read if they exist); any
        /// larger number is the width in pixels
        #[arg(short)]
        resolution: Option<Resolution> = None, Fixed, value "N";

        /// Background of the scene, and of transparent images: black, white, random (another colour at every step) or
        /// #rrggbb
        background: Background = Background::Black, Fixed, value "COLOUR";
    }

    /// The dataset, and the first Gaussians.
    start: StartSpec, "Scene" {
        /// Folder or ZIP archive of the dataset, or scene:NAME for a built-in scene
        #[arg(value_name = "SCENE")]
        scene: Option<PathBuf> = None, Free;

        /// Source of the first Gaussians: the dataset's points, random points, or a model (a file by any program, or a
        /// run's folder) in the dataset's coordinates (default: points if the dataset has any, else random)
        ///
        /// If the model has more Gaussians than the budget, those that contribute most to the training views are kept.
        /// Its colours are cut or extended to --sh-degree
        init: Option<InitChoice> = None, Fixed, value "points|random|MODEL";

        /// Learning rates of a run that starts from a model; --lr changes single rates
        init_rates: InitRates = InitRates::Fine, Fixed, value "RATES";

        /// A model in the dataset's coordinates (a file by any program, or a run's folder) whose Gaussians are rendered
        /// but never change: they are neither trained, moved nor removed. The Gaussians of --init are trained beside
        /// them; the budget counts frozen and trained Gaussians
        freeze: Option<AbsolutePath> = None, Fixed, value "MODEL";

        /// Lower the opacity of Gaussians smaller than a pixel, to make up for the kernel (0.3 or 0.1 px²) that widens
        /// them, so that the model also suits other resolutions; none: no antialiasing (default: that of the model of
        /// --init or --freeze, else none; without KERNEL: 0.3)
        #[arg(num_args = 0..=1, require_equals = true, default_missing_value = "0.3")]
        antialias: Option<Antialiasing> = None, Fixed, value "KERNEL";

        /// Number of random points to start from (default: half the budget, at most 100k)
        init_points: Option<Rows> = None, Fixed, value "N";

        /// Smallest distance from a camera at which anything is rendered, as a fraction of the scene's
        /// extent (default: 0.04, or less where the views show points that are nearer)
        near: Option<Fraction> = None, Fixed, value "FRACTION";
    }

    /// Depth given beside the photographs, and terms of the loss that need none.
    depth: DepthSpec, "Depth" {
        /// Use of depth maps that the dataset has: files named by depth_file_path in transforms.json; depth/ or depths/
        /// with the names of the photographs (16-bit PNG, .npy, .exr), and confidence/ beside them; COLMAP's
        /// stereo/depth_maps, and depths/ with sparse/0/depth_params.json (default: auto)
        ///
        /// Depth is checked against the points that the views see: errors in scale of 2 to 20 % are corrected; larger
        /// ones, distances along rays, inverse depth, shifted maps and those of other views are refused. 0, negative and
        /// non-finite values are unknown, not sky
        depth: Option<DepthChoice> = None, Fixed, value "WHEN";

        /// Length of one step of the values in the dataset's units, such as 0.001, 1/5000 (TUM) or 1/6553.5 (Replica);
        /// relative: inverse depth up to scale and offset, as monocular networks estimate it, which are fitted to the
        /// points that each view sees (default: 0.001 for PNG and .npy, 1 for .exr and COLMAP)
        depth_unit: Option<DepthUnit> = None, Fixed, value "UNIT";

        /// What the values measure (default: axis)
        depth_along: Option<DepthAlong> = None, Fixed, value "WHICH";

        /// Point cloud in the dataset's coordinates (PLY, LAS or LAZ), such as a laser scan, to be projected into the
        /// views instead of reading depth maps, as with --depth on. If the dataset has no points, training starts from
        /// these
        depth_points: Option<AbsolutePath> = None, Fixed, value "FILE";

        /// Weight of the depth term, at the first and at the last iteration; one number: the same throughout (default:
        /// 0.05:0.001)
        depth_weight: Option<Annealed> = None, Fixed, value "FIRST:LAST";

        /// Term that compares depth: expected compares the mean inverse depth along a ray, samples that of each Gaussian
        /// (default: expected)
        depth_term: Option<DepthTerm> = None, Fixed, value "TERM";

        /// Weight of a term that gathers the Gaussians along each ray, after a third of the run; needs no given depth
        /// (default: 0)
        distortion_weight: Option<Weight> = None, Fixed, value "WEIGHT";

        /// Prune Gaussians with most of their weight in front of the given depth, or else of the model's own median depth,
        /// after each of the first three tenths of the run
        remove_floaters: bool = false, Fixed, switch Set;
    }

    /// Limits of memory and quality.
    size: SizeSpec, "Size" {
        /// Maximum number of Gaussians in the model: 200000, 28k, 1.5M (default: 200k, or as many as --memory holds)
        ///
        /// auto: growth stops when doubling the number of Gaussians gains less than 0.10 dB on
        /// training views; Gaussians with the least effect are then pruned. The limit is still the
        /// default; auto:50k sets another limit
        #[arg(short)]
        budget: Option<Budget> = None, Fixed, value "ROWS";

        /// Limit of all memory of the run: 512MiB, 1.5GiB, 800MB. On a GPU it limits the device's memory, else that of
        /// the process
        ///
        /// Options that are given are kept: --budget (the smaller of the two limits applies), --sh-degree, --tile-cap,
        /// --image-cache. The others are chosen: as many Gaussians as fit; degree 3, or a lower one if at degree 3
        /// fewer fit than the scene starts with; decoded photographs take at most an eighth of the memory, and those
        /// that do not fit into it are decoded again; tile lists hold 4 pairs per Gaussian, up to 16 where --budget
        /// leaves room. `densify plan` shows the result
        memory: Option<ByteCount> = None, Fixed, value "BYTES";

        /// Maximum number of (Gaussian, tile) pairs in memory; views with more are processed in bands, which is exact
        /// but slower (default: 16 per Gaussian of the budget, on a GPU fewer for large models, or chosen for
        /// --memory)
        tile_cap: Option<Rows> = None, Free, value "PAIRS";

        /// Memory for decoded photographs, and the same amount on a GPU; the other photographs are decoded and uploaded
        /// again when they are needed. auto: an eighth of the memory of the run, plus what is left of --memory; 1GiB if
        /// --memory limits a GPU (default: 1GiB, or auto with --memory)
        image_cache: Option<ImageCache> = None, Free, value "BYTES";

        /// Dependence of colours on the viewing direction: 0 none, 3 most; auto: as much as the scene requires
        /// (default: 3, or lower if --memory requires it)
        ///
        /// Within --memory, auto makes two short trial runs if the run has 5,000 iterations or more, and takes 0 if the
        /// Gaussians that then fit are worth more than view-dependent colours, else 3. Without it, or with --init,
        /// --freeze or --budget auto, it is decided by how much the photographs disagree about the colours
        /// of the reconstruction's points; with too few points, it is 3
        sh_degree: Option<ShDegree> = None, Fixed, value "DEGREE";

        /// Disable automatic reductions: degree 3 unless --sh-degree says otherwise, and all views
        /// scored
        full: bool = false, Fixed, switch Set;
    }

    /// The policy of density control.
    density: PolicySpec, "Policy" {
        /// Policy that decides where Gaussians are added and removed; `densify policies` lists the choices
        #[arg(short)]
        policy: String = "diet".to_owned(), Fixed, value "NAME";

        /// Set a parameter of the policy, such as diet.rho=0.2; may be repeated
        #[serde(with = "as_table")]
        policy_set: Vec<Assignment> = Vec::new(), Fixed, value "POLICY.NAME=VALUE";

        /// Python file (.py) or module with policies, which are then known by name; may be repeated. Only the densify
        /// that pip installs can run them
        #[serde(skip_serializing_if = "Vec::is_empty")]
        policy_file: Vec<PolicyFile> = Vec::new(), Free, value "FILE|MODULE";
    }

    /// Training.
    schedule: ScheduleSpec, "Schedule" {
        /// Length of the run; every schedule scales with it
        #[arg(short)]
        iterations: Whole<1, { u32::MAX }> = Whole(REFERENCE_ITERATIONS), Longer, value "N";

        /// Seed of all random numbers
        #[arg(value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
        seed: u64 = 0, Fixed, value "N";

        /// Set a learning rate: mean_start, mean_end, log_scale, quat, opacity, sh_dc, sh_rest; for all but the means
        /// also NAME_end; noise_end: noise on the means at the end; fade: final factor of opacity, sh_dc and sh_rest,
        /// which sets in after the share fade_from of the run; boost: initial factor of all rates (1 in runs of 30,000
        /// iterations). A rate of 0 freezes its values. May be repeated
        #[serde(with = "as_table")]
        lr: Vec<Assignment> = Vec::new(), Fixed, value "NAME=RATE";

        /// Set several options and knobs at once: exact, balanced, fast or tiny-memory. Options that are given override
        /// the preset (default: balanced)
        preset: Option<String> = None, Free, value "NAME";

        /// Set a knob, which trades accuracy for speed or memory, such as alpha_min=1/128; `densify knobs` lists them.
        /// May be repeated
        #[serde(with = "as_table")]
        knob: Vec<Assignment> = Vec::new(), Fixed, value "NAME=VALUE";

        /// Learn an exposure for each training photograph: a factor and an offset per colour channel. Test views are
        /// then measured both as rendered and with the exposure that fits best. auto needs the tracks of a
        /// reconstruction
        exposure: ExposureChoice = ExposureChoice::Off, Fixed, value "WHEN";

        /// Form of the learned exposures
        exposure_model: ExposureModel = ExposureModel::Channels, Fixed, value "MODEL";

        /// Refine the poses of training views: by the points of the reconstruction, then together with the model. Test
        /// views are then measured as given and from the pose that fits best. auto decides by the points
        poses: PoseChoice = PoseChoice::Fixed, Fixed, value "WHEN";

        /// With refined poses, adjust focal lengths by the points, too
        refine_focal: bool = false, Fixed, switch Set;

        /// Learn a vignette for each camera: the light that its photographs lose towards their edges. Test views are
        /// measured without it. auto needs the tracks of a reconstruction
        vignette: VignetteChoice = VignetteChoice::Off, Fixed, value "WHEN";

        /// Treatment of Gaussians with a non-finite value; the model is checked at least every 100 iterations
        on_nan: OnNan = OnNan::Prune, Free, value "ACTION";

        /// Make runs reproducible byte for byte. On the processor they always are; a GPU then adds up gradients in a
        /// fixed order, which is slower than its atomics (`densify devices`)
        #[arg(help_heading = "Backend")]
        deterministic: bool = false, Free, switch Set;
    }

    /// The device.
    device: DeviceSpec, "Backend" {
        /// Backend to compute on
        backend: BackendChoice = BackendChoice::Auto, Free, value "BACKEND";

        /// GPU adapter to compute on, by part of its name; `densify devices` lists them
        /// (default: the best)
        gpu: Option<String> = None, Free, value "NAME";

        /// Processor threads to use, 1 to 256; the result does not depend on it (default: all)
        threads: Option<Threads> = None, Free, value "N";
    }

    /// Output files.
    output: OutputSpec, "Output" {
        /// Folder to write to (default: output/SCENE-POLICY)
        #[arg(short)]
        output: Option<PathBuf> = None, Free, value "DIR";

        /// Coordinates of the saved model: local ones are relative to an offset in the file's header. auto: world, or
        /// local if f32 is too coarse for world coordinates, as in UTM
        coordinates: Coordinates = Coordinates::Auto, Free, value "KIND";

        /// Iterations after which to save the model, besides the last
        #[arg(num_args = 1.., value_delimiter = ',')]
        save_iterations: Vec<u32> = Vec::new(), Free, value "N";

        /// Iterations after which to measure the test views, besides the last
        #[arg(num_args = 1.., value_delimiter = ',')]
        test_iterations: Vec<u32> = Vec::new(), Free, value "N";

        /// Steps between two checkpoints; one is also written at the end, and when SIGINT or SIGTERM
        /// stops the run. The two newest are kept. 0: only when stopped
        checkpoint_every: u32 = 1_000, Free, value "N";
    }
}
