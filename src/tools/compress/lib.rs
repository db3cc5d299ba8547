//! A smaller model of a scene: fewer Gaussians and less colour, trained on, in a file no larger than asked.
//!
//! Gaussians are pruned by how much they show in the training views, at most half of them at once, and the rest
//! trained on in between (`tune.rs`). Colour that depends on the view is dropped from each Gaussian by itself where
//! nobody would see it (`colour.rs`). How much of a file colour is worth depends on the scene, so several degrees of it
//! are tried, and a format's coarser ways to keep it, each with as many Gaussians as then fit, in the format that holds
//! most of them (`fit.rs`); and the one is kept whose file, read back, shows the training views best (`judge.rs`).

mod colour;
mod fit;
mod judge;
mod tune;

use std::path::{Path, PathBuf};

use tempfile::TempPath;

use densify_core::files::{FileError, write_atomically};
use densify_core::gaussians::Gaussians;
use densify_core::numbers::grouped;
use densify_data::models::{Format, PLY};
use densify_run::failure::Failure;
use densify_run::finished::read_model;
use densify_run::{DataSpec, DeviceSpec, Fraction, Observer};
use densify_train::exposure::ExposureModel;
use fit::Packing;
use judge::Judge;

/// What a model is to shrink to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Target {
    /// A file of at most so many bytes.
    Bytes(u64),
    /// So many Gaussians.
    Rows(usize),
}

/// What is compressed, and how.
#[derive(Debug, Clone)]
pub struct Options<'a> {
    /// The file of the model.
    pub model: &'a Path,
    /// The dataset that it shows.
    pub scene: &'a Path,
    /// How the dataset is read.
    pub data: DataSpec,
    /// What an exposure of each photograph may do, where the model was trained with them.
    pub exposure: Option<ExposureModel>,
    /// Nearest distance to a camera at which anything is drawn, as a fraction of the scene's extent.
    pub near: Fraction,
    /// Where to compute.
    pub device: DeviceSpec,
    /// What the result is to be.
    pub to: Target,
    /// Training steps of each attempt, >= 1.
    pub iterations: u32,
    /// Seed of these.
    pub seed: u64,
    /// Formats that the file may have, at least one; of those that hold equally many Gaussians the first is taken.
    pub formats: &'a [&'static Format],
    /// The file, as [`file()`] names it.
    pub output: &'a Path,
}

/// The file in one of several formats: then with its extension added, else as it is named.
#[must_use]
pub fn file(output: &Path, formats: &[&Format], format: &Format) -> PathBuf {
    let mut name = output.as_os_str().to_owned();
    if formats.len() > 1 {
        name.push(format!(".{}", format.extension));
    }
    name.into()
}

/// A model that was made.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Attempt {
    /// Gaussians in it.
    pub rows: usize,
    /// Highest degree of colour in it.
    pub sh_degree: u8,
    /// The format of its file.
    pub format: &'static str,
    /// The size of its file.
    pub bytes: u64,
    /// Mean PSNR of the training views `[dB]`, with the best exposure of each where exposures are learned.
    pub train: f64,
    /// The same of the views held out, if there are any.
    pub test: Option<f64>,
}

/// What came of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Compressed {
    /// The model as it was, and the PLY that training writes of it.
    pub whole: Attempt,
    /// What is in the file, after each stage of its training but the last.
    pub way: Vec<Attempt>,
    /// What was tried, in that order.
    pub attempts: Vec<Attempt>,
    /// Which of them is in the file.
    pub best: usize,
    /// The file.
    pub file: PathBuf,
}

/// Compresses a model, and writes its file.
///
/// # Errors
/// When a file cannot be used, nothing fits, the device or the disk fails, or the observer asks to stop; then nothing is
/// written.
pub fn compress(options: &Options<'_>, observer: &dyn Observer) -> Result<Compressed, Failure> {
    let judge = Judge::open(options, observer)?;
    if options.exposure.is_some() {
        observer.say(format_args!(
            "exposure learned again, as the run has learned it; PSNR is with the best exposure of each photograph"
        ));
    }
    let model = read_model(options.model, observer)?;
    fit::check(options, &model)?;
    judge.require(&model, options.model, observer)?;
    let whole = judge.attempt(model.clone(), PLY, fit::bytes(PLY, &model)?)?;
    let scratch = scratch(options.output)?;
    let search = Search { options, observer, judge, scratch, model };
    let (mut attempts, mut way) = (Vec::<Attempt>::new(), Vec::new());
    let mut best: Option<(usize, &Format, Gaussians)> = None;
    for degree in degrees(search.model.sh_degree, options.to) {
        let packings = fit::packings(options, &search.start(degree))?;
        for packing in &packings {
            let mut stages = Vec::new();
            let Some((attempt, small)) = search.attempt(packing, degree, &mut stages)? else {
                continue;
            };
            let is_best = best.as_ref().is_none_or(|(at, ..)| attempt.train > attempts[*at].train);
            attempts.push(attempt);
            if is_best {
                best = Some((attempts.len() - 1, packing.format, small));
                way = stages;
            }
        }
        if packings.first().is_some_and(|packing| search.loses_nothing(packing, degree)) {
            break;
        }
    }
    let Some((best, format, small)) = best else {
        return Err(fit::too_small(options, &search.model));
    };
    let file = file(options.output, options.formats, format);
    write_atomically(&file, |out| format.write(&small, out))?;
    Ok(Compressed { whole, way, attempts, best, file })
}

/// What all attempts share.
struct Search<'a> {
    options: &'a Options<'a>,
    observer: &'a dyn Observer,
    judge: Judge,
    scratch: TempPath,
    /// The model as it was.
    model: Gaussians,
}

impl Search<'_> {
    /// The model with at most this degree: made anew for each attempt, so that it is not held while one is trained.
    fn start(&self, degree: u8) -> Gaussians {
        colour::reduced(self.model.clone(), degree)
    }

    /// Whether it is the model with this degree as the format has it, which training has nothing to mend in.
    fn loses_nothing(&self, packing: &Packing, degree: u8) -> bool {
        packing.is_whole && degree == self.model.sh_degree
    }

    /// About so many rows of the model with this degree, trained on, and what its file shows; `None` where no row
    /// fits. What it was after each stage but the last is added to `way`.
    fn attempt(
        &self,
        packing: &Packing,
        degree: u8,
        way: &mut Vec<Attempt>,
    ) -> Result<Option<(Attempt, Gaussians)>, Failure> {
        let Self { options, observer, scratch, .. } = self;
        let start = self.start(degree);
        let Packing { format, rows, .. } = *packing;
        let tuned = if self.loses_nothing(packing, degree) {
            start
        } else {
            let after_stage = &mut |model: &Gaussians| {
                way.push(self.measured(model, format, fit::bytes(format, model)?)?);
                Ok(())
            };
            tune::tune(start, (format, rows), options, scratch, *observer, after_stage)?
        };
        let Some((small, bytes)) = fit::trimmed(options.to, format, tuned)? else {
            return Ok(None);
        };
        let attempt = self.measured(&small, format, bytes)?;
        observer.say(format_args!(
            "tried    {} Gaussians of degree {degree} as {}: {} bytes, {:.2} dB",
            grouped(attempt.rows),
            format.name,
            grouped(usize::try_from(bytes).unwrap_or(usize::MAX)),
            attempt.train
        ));
        Ok(Some((attempt, small)))
    }

    /// What the file of a model shows: what is read back, not what was written.
    fn measured(&self, model: &Gaussians, format: &Format, bytes: u64) -> Result<Attempt, Failure> {
        write_atomically(&self.scratch, |out| format.write(model, out))?;
        self.judge.attempt(read_model(&self.scratch, self.observer)?, format, bytes)
    }
}

/// A file for what is between two steps, in the folder that has room for the result; gone with this value.
fn scratch(output: &Path) -> Result<TempPath, Failure> {
    let folder = match output.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let made = std::fs::create_dir_all(folder)
        .and_then(|()| tempfile::NamedTempFile::with_prefix_in(".densify-", folder));
    Ok(made.map_err(FileError::io("write to the folder", folder))?.into_temp_path())
}

/// Degrees of colour that are tried, the model's own first.
fn degrees(own: u8, to: Target) -> Vec<u8> {
    match to {
        Target::Rows(_) => vec![own],
        Target::Bytes(_) => (0..=own).rev().collect(),
    }
}

#[cfg(test)]
mod tests;
