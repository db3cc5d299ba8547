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
use densify_run::refining::TrainedModel;
use densify_run::{DeviceSpec, Observer, check_interrupt};
use densify_train::evaluate::Split;

pub use rules::{Removed, Rule, Rules};

/// Options of [`clean`].
#[derive(Debug, Clone)]
pub struct Options<'a> {
    /// The model and its training.
    pub model: TrainedModel,
    /// Antialiasing of the model; `None`: as its file states.
    pub antialias: Option<Antialiasing>,
    /// Device to measure and to train on.
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
    let TrainedModel { file, scene, data, near, .. } = &options.model;
    let dataset = load(scene, data, observer)?;
    let near = near_plane(*near, &dataset, observer);
    let mut model = read_model_as(file, options.antialias, observer)?;
    if model.is_empty() {
        let file = file.display();
        return Err(Failure::input(format!("{file} has no Gaussian; name another model")));
    }
    let split = if dataset.test.is_empty() { Split::Train } else { Split::Test };
    let judge = Judge { dataset: &dataset, machine: &machine, near, split, options, observer };
    let (before, check) = judge.measure(&model)?;
    check.require(None, file, observer)?;
    let mut stages = vec![(model.len(), before)];
    let mut rounds = Vec::new();
    for _ in 0..options.rounds {
        let weights = {
            let margin = options.rules.margin;
            weights::measure(&model, (&dataset, near), margin, &machine, observer)?
        };
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

    /// Mean PSNR `[dB]`, and the comparison of coordinates.
    fn measure(&self, model: &Gaussians) -> Result<(f64, CoordinateCheck), Failure> {
        let Self { dataset, split, options, .. } = *self;
        let background = options.model.data.background.fixed();
        let mut backend = self.machine.backend(dataset, model.clone(), self.near)?;
        let mut check = CoordinateCheck::new(views_of(dataset, split)?.count());
        let psnr = options.model.mean_psnr(
            backend.as_mut(),
            (dataset, split),
            |view, rendering, image| {
                check.add(view, rendering, image, background);
                check_interrupt(self.observer)
            },
        )?;
        Ok((psnr, check))
    }
}
