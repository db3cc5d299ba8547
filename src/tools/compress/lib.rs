//! Compresses a trained model: fewer Gaussians and fewer colour coefficients, fine-tuned, in a file of limited size.
//!
//! Gaussians are pruned by importance, at most half of them at once, with training in between (`tune.rs`).
//! View-dependent colour is dropped per Gaussian where this is invisible (`colour.rs`). The best trade-off between
//! Gaussians and colour depends on the scene, so several degrees and accuracies of colour are tried, each with as many
//! Gaussians as fit (`fit.rs`). The attempt whose file, read back, has the highest PSNR of the training views is kept
//! (`evaluator.rs`).

mod colour;
mod evaluator;
mod fit;
mod tune;

use std::path::{Path, PathBuf};

use tempfile::TempPath;

use densify_core::antialiasing::Antialiasing;
use densify_core::files::write_atomically;
use densify_core::gaussians::Gaussians;
use densify_core::numbers::{gaussians, grouped};
use densify_data::models::{Coarseness, Format, Frame, PLY, local_origin, offset_text};
use densify_run::failure::Failure;
use densify_run::finished::{read_model, read_model_as, say_unstated};
use densify_run::refining::{TrainedModel, scratch_beside};
use densify_run::{DeviceSpec, Observer, Silent};
use evaluator::Evaluator;
use fit::Packing;

/// The size to reach.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Target {
    /// Largest size of the file `[bytes]`.
    Bytes(u64),
    /// Number of Gaussians.
    Rows(usize),
}

/// Options of [`compress`].
#[derive(Debug, Clone)]
pub struct Options<'a> {
    /// The model and its training.
    pub model: TrainedModel,
    /// Antialiasing of the model; `None`: as its file states.
    pub antialias: Option<Antialiasing>,
    /// Device to compute on.
    pub device: DeviceSpec,
    /// Size to reach.
    pub to: Target,
    /// Training iterations of each attempt, >= 1.
    pub iterations: u32,
    /// Random seed of the training.
    pub seed: u64,
    /// Allowed formats of the file, at least one. Of formats that hold equally many Gaussians, the first is used.
    pub formats: &'a [&'static Format],
    /// File to write, named by [`file()`].
    pub output: &'a Path,
}

/// Path of the output in a format. If there are several formats to choose from, the extension is appended.
pub fn file(output: &Path, formats: &[&Format], format: &Format) -> PathBuf {
    let mut name = output.as_os_str().to_owned();
    if formats.len() > 1 {
        name.push(format!(".{}", format.extension));
    }
    name.into()
}

/// A compressed model with its measurements.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Attempt {
    /// Number of Gaussians.
    pub rows: usize,
    /// Spherical-harmonic degree.
    pub sh_degree: u8,
    /// Name of the file's format.
    pub format: &'static str,
    /// Size of the file `[bytes]`.
    pub bytes: u64,
    /// Mean PSNR of the training views `[dB]`, with the best-fitting exposure of each if exposures are learned.
    pub train_psnr: f64,
    /// Mean PSNR of the test views `[dB]`, if there are any.
    pub test_psnr: Option<f64>,
}

/// The result of [`compress`].
#[derive(Debug, Clone, PartialEq)]
pub struct Compressed {
    /// Measurements of the original model, with the size that it has as a PLY.
    pub whole: Attempt,
    /// Measurements of the best attempt after each intermediate stage: a pruning and the training that follows.
    pub stages: Vec<Attempt>,
    /// All attempts in order.
    pub attempts: Vec<Attempt>,
    /// Index of the attempt whose model was written to the file.
    pub best: usize,
    /// Path of the file.
    pub file: PathBuf,
}

/// Compresses a model and writes its file.
///
/// # Errors
/// If a file cannot be used, nothing fits, the device or the disk fails, or the observer interrupts; nothing is written
/// then.
pub fn compress(options: &Options<'_>, observer: &dyn Observer) -> Result<Compressed, Failure> {
    let evaluator = Evaluator::open(options, observer)?;
    if options.model.exposure.is_some() {
        observer.say(format_args!(
            "exposure learned again, as in the run; PSNR is measured with the best exposure of each photograph"
        ));
    }
    if options.model.vignette {
        observer.say(format_args!(
            "vignette learned again, as in the run; PSNR is measured without it"
        ));
    }
    let original = read_model_as(&options.model.file, options.antialias, observer)?;
    let model = in_fine_coordinates(original);
    fit::check(options, &model)?;
    let bytes = fit::file_size(PLY, &model)?;
    let whole = evaluator.evaluate_original(model.clone(), bytes, observer)?;
    let scratch = scratch_beside(options.output)?;
    let allowed_formats = options.formats;
    let formats = fit::usable_formats(options, &model, &scratch, observer)?;
    let options = &Options { formats: &formats, ..options.clone() };
    let search = Search { options, observer, evaluator, scratch, model };
    let (mut attempts, mut best_stages) = (Vec::<Attempt>::new(), Vec::new());
    let mut best: Option<(usize, &Format, Gaussians)> = None;
    for degree in degrees(search.model.sh_degree, options.to) {
        let packings = fit::packings(options, &search.start_model(degree))?;
        for packing in &packings {
            let mut stages = Vec::new();
            let Some((attempt, small)) = search.attempt(packing, degree, &mut stages)? else {
                continue;
            };
            let is_best =
                best.as_ref().is_none_or(|(at, ..)| attempt.train_psnr > attempts[*at].train_psnr);
            attempts.push(attempt);
            if is_best {
                best = Some((attempts.len() - 1, packing.format, small));
                best_stages = stages;
            }
        }
        if packings.first().is_some_and(|packing| search.keeps_everything(packing, degree)) {
            break;
        }
    }
    let Some((best, format, small)) = best else {
        return Err(fit::too_small(options, &search.model));
    };
    let file = file(options.output, allowed_formats, format);
    format.save(&small, &file)?;
    let (frame, antialiasing) = (Frame::from_origin(small.origin), search.model.antialiasing);
    if let Some(offset) = frame.offset() {
        observer.say(format_args!("coords   local, from the offset {}", offset_text(offset)));
    }
    say_unstated(format, &file, frame, antialiasing, observer);
    Ok(Compressed { whole, stages: best_stages, attempts, best, file })
}

/// The state that all attempts share.
struct Search<'a> {
    options: &'a Options<'a>,
    observer: &'a dyn Observer,
    evaluator: Evaluator,
    scratch: TempPath,
    /// The original model.
    model: Gaussians,
}

impl Search<'_> {
    /// The original model with at most this degree. Each attempt makes its own copy and drops it before it trains.
    fn start_model(&self, degree: u8) -> Gaussians {
        colour::reduce(self.model.clone(), degree)
    }

    /// True if the packing keeps all rows and bands of the model, so that no training is needed.
    fn keeps_everything(&self, packing: &Packing, degree: u8) -> bool {
        packing.is_whole && degree == self.model.sh_degree
    }

    /// Compresses the model with this packing and degree, and evaluates its file; `None` if no row fits. The result of
    /// each stage but the last is added to `stages`.
    fn attempt(
        &self,
        packing: &Packing,
        degree: u8,
        stages: &mut Vec<Attempt>,
    ) -> Result<Option<(Attempt, Gaussians)>, Failure> {
        let Self { options, observer, scratch, .. } = self;
        let Packing { format, rows, .. } = *packing;
        let mut start = self.start_model(degree);
        if !format.states_antialiasing(start.antialiasing) {
            // Readers of the file will assume this kernel.
            start.antialiasing = Antialiasing::Wide;
        }
        let tuned = if self.keeps_everything(packing, degree) {
            start
        } else {
            let after_stage = &mut |model: &Gaussians| {
                stages.push(self.evaluate_file(model, format, fit::file_size(format, model)?)?);
                Ok(())
            };
            tune::tune(start, (format, rows), options, scratch, *observer, after_stage)?
        };
        let Some((small, bytes)) = fit::trim(options.to, format, tuned)? else {
            return Ok(None);
        };
        let attempt = self.evaluate_file(&small, format, bytes)?;
        observer.say(format_args!(
            "tried    {} of degree {degree} as {}: {} bytes, {:.2} dB",
            gaussians(attempt.rows),
            format.name,
            grouped(usize::try_from(bytes).unwrap_or(usize::MAX)),
            attempt.train_psnr
        ));
        Ok(Some((attempt, small)))
    }

    /// Writes a model in a format, reads it back and evaluates it, so that the format's rounding counts.
    fn evaluate_file(
        &self,
        model: &Gaussians,
        format: &Format,
        bytes: u64,
    ) -> Result<Attempt, Failure> {
        write_atomically(&self.scratch, |out| format.write(model, out))?;
        // The temporary file has no sidecar.
        let decoded = Gaussians { origin: model.origin, ..read_model(&self.scratch, &Silent)? };
        self.evaluator.evaluate(decoded, format, bytes)
    }
}

/// The model in local coordinates if world coordinates are too coarse in f32, else in world coordinates.
fn in_fine_coordinates(model: Gaussians) -> Gaussians {
    let is_coarse = Coarseness::measure(&model).is_noted();
    let origin = if is_coarse { local_origin(&model) } else { [0.0; 3] };
    model.with_origin(origin)
}

/// Spherical-harmonic degrees to try, the model's own first.
fn degrees(own: u8, to: Target) -> Vec<u8> {
    match to {
        Target::Rows(_) => vec![own],
        Target::Bytes(_) => (0..=own).rev().collect(),
    }
}

#[cfg(test)]
mod tests;
