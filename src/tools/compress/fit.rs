//! Determines the number of Gaussians that fit in a file of a given size.

use std::io::{self, Write};
use std::path::Path;

use super::{Options, Target};
use densify_core::gaussians::Gaussians;
use densify_core::numbers::grouped;
use densify_data::models::{Format, Frame, is_unfit, remove_sidecar};
use densify_run::Observer;
use densify_run::failure::{Failure, INPUT, OTHER};
use densify_run::finished::write_in_frame;
use densify_train::importance::{footprints, largest};

/// Fraction of the size limit that an estimate aims at, because training changes the compression ratio.
const FILL: f64 = 0.98;
/// Maximum number of estimates of the number of rows.
const MAX_ESTIMATES: usize = 8;
/// Fraction of the rows that is dropped in addition if the file is still too large.
const EXTRA_TRIM: f64 = 0.01;

/// Counts the bytes written to it.
#[derive(Default)]
struct ByteCounter(u64);

impl Write for ByteCounter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0 += bytes.len() as u64;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Size of a model's file in a format `[bytes]`.
pub(super) fn file_size(format: &Format, model: &Gaussians) -> Result<u64, Failure> {
    let mut counter = ByteCounter::default();
    format.write(model, &mut counter).map_err(|error| {
        Failure::new(
            if is_unfit(&error) { INPUT } else { OTHER },
            format!("cannot write the model as {}: {error}", format.name),
        )
    })?;
    Ok(counter.0)
}

/// Checks that the model can reach the target, before anything is trained.
pub(super) fn check(options: &Options<'_>, model: &Gaussians) -> Result<(), Failure> {
    match options.to {
        _ if model.is_empty() => Err(Failure::input(format!(
            "{}: the model has no Gaussian",
            options.model.file.display()
        ))),
        Target::Rows(rows) if rows > model.len() => Err(Failure::input(format!(
            "--to {rows}: {} has only {} Gaussians; give fewer, or a size such as 5MiB",
            options.model.file.display(),
            grouped(model.len())
        ))),
        Target::Bytes(limit) if limit < smallest_size(options, model).0 => {
            Err(too_small(options, model))
        }
        _ => Ok(()),
    }
}

/// Writes the model as it is to a temporary file, without the sidecar that a result would have.
fn write_scratch(
    format: &Format,
    scratch: &Path,
    model: &Gaussians,
    observer: &dyn Observer,
) -> Result<(), Failure> {
    write_in_frame(format, scratch, model, Frame::from_origin(model.origin), observer)?;
    Ok(remove_sidecar(scratch)?)
}

/// Writes the model to the file `scratch` in each format, and returns the formats that can hold it. Tells the observer
/// what they change, and which formats cannot hold the model.
///
/// # Errors
/// When no format can hold the model, or the disk fails.
pub(super) fn usable_formats(
    options: &Options<'_>,
    model: &Gaussians,
    scratch: &Path,
    observer: &dyn Observer,
) -> Result<Vec<&'static Format>, Failure> {
    let (mut usable, mut unfit) = (Vec::new(), None);
    for &format in options.formats {
        match write_scratch(format, scratch, model, observer) {
            Ok(()) => usable.push(format),
            Err(failure) if failure.code == INPUT && options.formats.len() > 1 => {
                observer.say(format_args!("note: not tried: {failure}"));
                unfit = unfit.or(Some(failure));
            }
            Err(failure) => return Err(failure),
        }
    }
    unfit.filter(|_| usable.is_empty()).map_or(Ok(usable), Err)
}

/// A format, and the number of rows of the untrained model with which its file meets the target.
#[derive(Debug, Clone, Copy)]
pub(super) struct Packing {
    pub(super) format: &'static Format,
    pub(super) rows: usize,
    /// True if all rows fit, with at least the format's default accuracy.
    pub(super) is_whole: bool,
}

/// Chooses the packings to try, all in the format that holds the most rows; of formats that hold equally many, the
/// first. If the format has several variants and all rows fit with the default accuracy, the only packing is the most
/// accurate variant that still holds all rows. Otherwise there is a packing for every variant that holds at least four
/// fifths of the maximum number of rows. Empty if not even one row fits.
///
/// # Errors
/// If writing fails.
pub(super) fn packings(options: &Options<'_>, model: &Gaussians) -> Result<Vec<Packing>, Failure> {
    let mut best = None;
    for &format in options.formats {
        let most = best.map_or(0, |(_, rows)| rows);
        if let Some(rows) = rows_that_fit(options.to, format, model)?.filter(|&rows| rows > most) {
            best = Some((format, rows));
        }
    }
    let Some((format, rows)) = best else { return Ok(Vec::new()) };
    let packing = Packing { format, rows, is_whole: rows == model.len() };
    let variants = format.variants();
    // Variants differ only in the accuracy of SH bands above 0.
    let (Target::Bytes(limit), [most_accurate, ..], 1..) = (options.to, variants, model.sh_degree)
    else {
        return Ok(vec![packing]);
    };
    if packing.is_whole {
        let format = if file_size(most_accurate, model)? <= limit { most_accurate } else { format };
        return Ok(vec![Packing { format, ..packing }]);
    }
    let mut packings: Vec<Packing> = Vec::new();
    for format in variants {
        let Some(rows) = rows_that_fit(options.to, format, model)? else { continue };
        packings.push(Packing { format, rows, is_whole: false });
        if rows == model.len() {
            break;
        }
    }
    // Losing many rows costs more quality than losing accuracy of their colour.
    let most = packings.iter().map(|packing| packing.rows).max().unwrap_or(0);
    packings.retain(|packing| 5 * packing.rows >= 4 * most);
    Ok(packings)
}

/// Estimates the number of rows of this model whose file meets the target; [`trim`] drops any excess. `None`
/// if not even one row fits.
pub(super) fn rows_that_fit(
    to: Target,
    format: &Format,
    model: &Gaussians,
) -> Result<Option<usize>, Failure> {
    let limit = match to {
        Target::Rows(rows) => return Ok(Some(rows.min(model.len()))),
        Target::Bytes(limit) => limit,
    };
    let mut rows = model.len();
    let mut size = file_size(format, model)?;
    if size <= limit {
        return Ok(Some(rows));
    }
    // The size need not be proportional to the rows, so each estimate stays between the known bounds.
    let (mut fits, mut over) = (0, rows);
    for _ in 0..MAX_ESTIMATES {
        let next = (rows as f64 * (FILL * limit as f64 / size as f64)) as usize;
        rows = if fits < next && next < over { next } else { fits.midpoint(over) }.max(1);
        size = file_size(format, &subsample(model, rows))?;
        if size <= limit {
            fits = rows;
        } else {
            over = rows;
        }
        let filled = size as f64 / limit as f64;
        if (FILL - 0.01..=1.0).contains(&filled) || over - fits <= 1 + model.len() / 500 {
            break;
        }
    }
    Ok((fits > 0 || rows > 1).then_some(if fits > 0 { fits } else { rows }))
}

/// Evenly sampled rows of a model; trained models are ordered spatially.
fn subsample(model: &Gaussians, rows: usize) -> Gaussians {
    let row = |index: usize| (index as u64 * model.len() as u64 / rows as u64) as usize;
    model.gather(&(0..rows).map(row).collect::<Vec<_>>())
}

/// Drops rows, the faintest and smallest first, until the model's file is small enough. Returns the model and the size
/// of its file; `None` if no row is left.
pub(super) fn trim(
    to: Target,
    format: &Format,
    mut model: Gaussians,
) -> Result<Option<(Gaussians, u64)>, Failure> {
    loop {
        let size = file_size(format, &model)?;
        let limit = match to {
            Target::Bytes(limit) if size > limit => limit,
            _ => return Ok(Some((model, size))),
        };
        let excess = 1.0 - limit as f64 / size as f64 + EXTRA_TRIM;
        let left = ((model.len() as f64 * (1.0 - excess)) as usize).min(model.len() - 1);
        if left == 0 {
            return Ok(None);
        }
        model = model.gather(&largest(&footprints(&model), left));
    }
}

/// Size of the smallest file with one Gaussian `[bytes]`, and the name of its format.
fn smallest_size(options: &Options<'_>, model: &Gaussians) -> (u64, &'static str) {
    let one = model.gather(&[0]).with_degree(0);
    let sizes = options.formats.iter();
    let sizes = sizes.filter_map(|format| Some((file_size(format, &one).ok()?, format.name)));
    sizes.min().unwrap_or_default()
}

/// The failure if not even one Gaussian fits.
pub(super) fn too_small(options: &Options<'_>, model: &Gaussians) -> Failure {
    let (bytes, format) = smallest_size(options, model);
    Failure::input(format!(
        "--to: no model fits; one Gaussian takes {bytes} bytes as {format}; give a larger size"
    ))
}
