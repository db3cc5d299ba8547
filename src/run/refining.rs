//! A finished model, measured against its photographs and trained further with a fixed number of Gaussians.

use std::path::{Path, PathBuf};

use tempfile::TempPath;

use densify_core::files::{FileError, folder_of, write_atomically};
use densify_core::gaussians::Gaussians;
use densify_core::image::Image8;
use densify_data::dataset::Dataset;
use densify_data::models::{Coordinates, PLY};
use densify_data::views::ViewSource;
use densify_render::{Backend, Rendering};
use densify_train::evaluate::Split;
use densify_train::exposure::{ExposureChoice, ExposureModel, fitted};
use densify_train::metrics::psnr;
use densify_train::poses::PoseChoice;
use densify_train::vignette::VignetteChoice;

use crate::failure::Failure;
use crate::finished::views_of;
use crate::models::is_model;
use crate::observer::Observer;
use crate::resolved::RunConfig;
use crate::session::Run;
use crate::spec::{
    AbsolutePath, Assignment, Budget, DataSpec, DepthSpec, DeviceSpec, Fraction, InitChoice,
    RunSpec, ShDegree, Whole,
};

/// With the settings below, this policy neither adds nor prunes rows.
const POLICY: &str = "vanilla";
const POLICY_SETTINGS: [&str; 3] =
    ["vanilla.grow_every=0", "vanilla.reset_every=0", "vanilla.white_reset_at=0"];

/// A finished model with its dataset and the options of its training.
#[derive(Debug, Clone)]
pub struct TrainedModel {
    /// File of the model.
    pub file: PathBuf,
    /// Its dataset.
    pub scene: PathBuf,
    /// Options with which the dataset is read.
    pub data: DataSpec,
    /// Depth options of the training.
    pub depth: DepthSpec,
    /// Exposure model, if the model was trained with an exposure per photograph.
    pub exposure: Option<ExposureModel>,
    /// Whether the poses of the model's run were refined, and focal lengths with them.
    pub poses: (PoseChoice, bool),
    /// True if the model was trained with a vignette per camera.
    pub vignette: bool,
    /// Near plane, as a fraction of the scene's extent; `None`: the usual near plane of the dataset.
    pub near: Option<Fraction>,
}

/// An empty temporary file beside `output`, for the training of a model; it is deleted when the value is dropped.
///
/// # Errors
/// When the folder cannot be created or written to.
pub fn scratch_beside(output: &Path) -> Result<TempPath, Failure> {
    let folder = folder_of(output);
    let made = std::fs::create_dir_all(folder)
        .and_then(|()| tempfile::NamedTempFile::with_prefix_in(".densify-", folder));
    Ok(made.map_err(FileError::io("write to the folder", folder))?.into_temp_path())
}

/// How a model is trained further.
#[derive(Debug, Clone, Copy)]
pub struct Refinement<'a> {
    /// Device to train on.
    pub device: &'a DeviceSpec,
    /// Number of Gaussians that are kept.
    pub rows: usize,
    /// Iterations, >= 1.
    pub iterations: u32,
    /// Random seed.
    pub seed: u64,
    /// True if the colours of bands 1–3 stay as they are.
    pub freezes_bands: bool,
}

impl TrainedModel {
    /// The model in `file`, which belongs to `model`: a run's folder, whose configuration is read, or the file itself,
    /// which takes the `given` options and needs a `scene`. `naming_scene` tells how the user names the scene.
    ///
    /// # Errors
    /// When the run's configuration cannot be read, or a file comes without a scene.
    pub fn find(
        model: &Path,
        file: PathBuf,
        scene: Option<PathBuf>,
        given: (DataSpec, DepthSpec, Option<Fraction>),
        naming_scene: &str,
    ) -> Result<Self, Failure> {
        if is_model(model) {
            let scene = scene.ok_or_else(|| {
                Failure::input(format!(
                    "{} is a file, which has no photographs; name its dataset with {naming_scene}",
                    model.display()
                ))
            })?;
            let (data, depth, near) = given;
            let (exposure, vignette) = (None, false);
            let poses = (PoseChoice::Fixed, false);
            return Ok(Self { file, scene, data, depth, exposure, vignette, poses, near });
        }
        let config = RunConfig::read(model)?;
        let scene = scene.unwrap_or_else(|| config.scene_path());
        let exposure = config.resolved.has_exposures;
        let exposure = exposure.then_some(config.spec.schedule.exposure_model);
        let choice =
            if config.resolved.refines_poses { PoseChoice::Refine } else { PoseChoice::Fixed };
        let poses = (choice, config.spec.schedule.refine_focal);
        let vignette = config.resolved.has_vignettes;
        let RunSpec { data, depth, start, .. } = config.spec;
        Ok(Self { file, scene, data, depth, exposure, vignette, poses, near: start.near })
    }

    /// Describes the run that trains `model`, which is or will be saved in `scratch`.
    ///
    /// # Errors
    /// When the working directory cannot be read.
    pub fn describe_training(
        &self,
        model: &Gaussians,
        refinement: &Refinement<'_>,
        scratch: &Path,
    ) -> Result<RunSpec, Failure> {
        let assignment = |text: &str| text.parse::<Assignment>().map_err(Failure::input);
        let mut spec = RunSpec {
            data: self.data.clone(),
            depth: self.depth.clone(),
            device: refinement.device.clone(),
            ..RunSpec::default()
        };
        spec.start.scene = Some(self.scene.clone());
        let file = std::path::absolute(scratch).map_err(Failure::input)?;
        spec.start.init = Some(InitChoice::Model(AbsolutePath(file)));
        spec.start.near = self.near;
        spec.size.budget = Some(Budget::Rows(refinement.rows));
        spec.size.sh_degree = Some(ShDegree::Fixed(model.sh_degree));
        POLICY.clone_into(&mut spec.density.policy);
        spec.density.policy_set =
            POLICY_SETTINGS.into_iter().map(assignment).collect::<Result<_, _>>()?;
        spec.schedule.iterations = Whole(refinement.iterations);
        spec.schedule.seed = refinement.seed;
        if refinement.freezes_bands {
            spec.schedule.lr = vec![assignment("sh_rest=0")?];
        }
        if let Some(exposure_model) = self.exposure {
            spec.schedule.exposure = ExposureChoice::On;
            spec.schedule.exposure_model = exposure_model;
        }
        (spec.schedule.poses, spec.schedule.refine_focal) = self.poses;
        if self.vignette {
            spec.schedule.vignette = VignetteChoice::On;
        }
        spec.output.coordinates =
            if model.is_local() { Coordinates::Local } else { Coordinates::World };
        Ok(spec)
    }

    /// Trains `model` further, which is saved in `scratch` meanwhile. If it has more rows than are kept, the least
    /// important ones are left out.
    ///
    /// # Errors
    /// Errors of a run, and when the observer interrupts.
    pub fn train(
        &self,
        model: Gaussians,
        refinement: &Refinement<'_>,
        scratch: &Path,
        observer: &dyn Observer,
    ) -> Result<Gaussians, Failure> {
        write_atomically(scratch, |out| PLY.write(&model, out))?;
        let spec = self.describe_training(&model, refinement, scratch)?;
        let origin = model.origin;
        drop(model);
        let trained = Run::prepare(&spec)?.model_after_training(observer)?;
        Ok(trained.with_origin(origin))
    }

    /// Mean PSNR `[dB]` of a backend's model in the views of a split; if exposures are learned, with the best-fitting
    /// exposure of each photograph. `after_view` receives each view's number, rendering and photograph.
    ///
    /// # Errors
    /// When a view cannot be loaded, rendered or compared, and those of `after_view`.
    pub fn mean_psnr(
        &self,
        backend: &mut dyn Backend,
        (dataset, split): (&Dataset, Split),
        mut after_view: impl FnMut(usize, &Rendering, &Image8) -> Result<(), Failure>,
    ) -> Result<f64, Failure> {
        let background = self.data.background.fixed();
        let sh_degree = backend.sh_degree();
        let views = views_of(dataset, split)?;
        let mut sum = 0.0;
        for view in 0..views.count() {
            views.prefetch_after(view);
            let image = views.image(view).map_err(Failure::input)?;
            let rendering = backend.render(views.camera(view), background, sh_degree)?;
            let score = |rgb: &[f32]| psnr(rgb, &image, background).map_err(Failure::input);
            // This also checks that the render and the photograph can be compared, so it runs in either case.
            let mut value = score(&rendering.rgb)?;
            if self.exposure.is_some() {
                value = score(&fitted(&rendering.rgb, &image, background))?;
            }
            sum += value;
            after_view(view, &rendering, &image)?;
        }
        Ok(sum / views.count() as f64)
    }
}
