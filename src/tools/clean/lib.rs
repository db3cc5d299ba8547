//! Removes floaters from a trained model: Gaussians in front of the surface, Gaussians that no view shows, and small
//! groups far from all others (`rules.rs`, `isolated.rs`). The rest can be trained further (`refine.rs`).
//!
//! The training views decide. Their surface is the model's own median depth; depth maps of the dataset are not used.

mod isolated;
mod refine;
mod rules;
mod weights;

use std::path::Path;

use densify_core::antialiasing::Antialiasing;
use densify_core::gaussians::Gaussians;
use densify_data::dataset::Dataset;
use densify_data::views::ViewSource;
use densify_run::coordinate_check::CoordinateCheck;
use densify_run::failure::Failure;
use densify_run::finished::{Machine, load, near_plane, read_model_as, views_of};
use densify_run::{DataSpec, DepthSpec, DeviceSpec, Fraction, Observer, check_interrupt};
use densify_train::evaluate::Split;
use densify_train::exposure::{ExposureModel, fitted};
use densify_train::metrics::psnr;

pub use rules::{Removed, Rule, Rules};

/// Options of [`clean`].
#[derive(Debug, Clone)]
pub struct Options<'a> {
    /// File of the model.
    pub model: &'a Path,
    /// Dataset of the model.
    pub scene: &'a Path,
    /// Options with which the dataset is read.
    pub data: DataSpec,
    /// Depth options of the training.
    pub depth: DepthSpec,
    /// Exposure model, if the model was trained with an exposure per photograph.
    pub exposure: Option<ExposureModel>,
    /// Near plane, as a fraction of the scene's extent; `None`: the usual near plane of the dataset.
    pub near: Option<Fraction>,
    /// Antialiasing of the model; `None`: as its file states.
    pub antialias: Option<Antialiasing>,
    /// Device to measure PSNR and to train on. Weights are measured on the processor.
    pub device: DeviceSpec,
    /// The rules.
    pub rules: Rules,
    /// Maximum number of rounds, >= 1. A round that removes nothing is the last.
    pub rounds: u32,
    /// Training iterations after the last round.
    pub refine: u32,
    /// Random seed of the training.
    pub seed: u64,
    /// File that will be written; training keeps a temporary file beside it.
    pub output: &'a Path,
}

/// A cleaned model, and how it came about.
#[derive(Debug, Clone, PartialEq)]
pub struct Cleaned {
    /// The model, in the coordinates of the dataset.
    pub model: Gaussians,
    /// What each round removed.
    pub rounds: Vec<Vec<Removed>>,
    /// The views in which PSNR was measured: test views if there are any.
    pub split: Split,
    /// Number of Gaussians and mean PSNR `[dB]` before, after the rounds, and after the training if there was any.
    pub stages: Vec<(usize, f64)>,
}

/// Cleans a model.
///
/// # Errors
/// When a file cannot be read, the model is not in the coordinates of the dataset, nothing would be left, the device
/// fails, or the observer interrupts.
pub fn clean(options: &Options<'_>, observer: &dyn Observer) -> Result<Cleaned, Failure> {
    let machine = Machine::open(&options.device, observer)?;
    let dataset = load(options.scene, &options.data, observer)?;
    let near = near_plane(options.near, &dataset, observer);
    let mut model = read_model_as(options.model, options.antialias, observer)?;
    if model.is_empty() {
        let file = options.model.display();
        return Err(Failure::input(format!("{file} has no Gaussian; name another model")));
    }
    let split = if dataset.test.is_empty() { Split::Train } else { Split::Test };
    let judge = Judge { dataset: &dataset, machine: &machine, near, split, options, observer };
    let (before, check) = judge.measure(&model)?;
    check.require(None, options.model, observer)?;
    let mut stages = vec![(model.len(), before)];
    let mut rounds = Vec::new();
    for _ in 0..options.rounds {
        let weights = weights::measure(&model, (&dataset, near), options, observer)?;
        let (kept, removed) = rules::apply(&model, &weights, &options.rules);
        if kept.is_empty() {
            return Err(Failure::input(
                "no Gaussian would be left; check that the model belongs to the dataset, and the box",
            ));
        }
        let is_last = kept.len() == model.len();
        rounds.push(removed);
        if is_last {
            break;
        }
        model = model.gather(&kept);
    }
    stages.push((model.len(), judge.psnr(&model)?));
    if options.refine > 0 {
        model = refine::train(model, options, observer)?;
        stages.push((model.len(), judge.psnr(&model)?));
    }
    Ok(Cleaned { model, rounds, split, stages })
}

/// Measures models against the photographs.
struct Judge<'a> {
    dataset: &'a Dataset,
    machine: &'a Machine,
    /// `[scene units]`.
    near: f32,
    split: Split,
    options: &'a Options<'a>,
    observer: &'a dyn Observer,
}

impl Judge<'_> {
    /// Mean PSNR `[dB]`.
    fn psnr(&self, model: &Gaussians) -> Result<f64, Failure> {
        Ok(self.measure(model)?.0)
    }

    /// Mean PSNR `[dB]`, with the best-fitting exposure of each photograph if exposures are learned, and the comparison
    /// of coordinates.
    fn measure(&self, model: &Gaussians) -> Result<(f64, CoordinateCheck), Failure> {
        let background = self.options.data.background.fixed();
        let mut backend = self.machine.backend(self.dataset, model.clone(), self.near)?;
        let views = views_of(self.dataset, self.split)?;
        let mut check = CoordinateCheck::new(views.count());
        let mut sum = 0.0;
        for view in 0..views.count() {
            check_interrupt(self.observer)?;
            views.prefetch_after(view);
            let image = views.image(view).map_err(Failure::input)?;
            let rendering = backend.render(views.camera(view), background, model.sh_degree)?;
            let score = |rgb: &[f32]| psnr(rgb, &image, background).map_err(Failure::input);
            // Also checks that the render and the photograph can be compared.
            let mut value = score(&rendering.rgb)?;
            if self.options.exposure.is_some() {
                value = score(&fitted(&rendering.rgb, &image, background))?;
            }
            sum += value;
            check.add(view, &rendering, &image, background);
        }
        Ok((sum / views.count() as f64, check))
    }
}
