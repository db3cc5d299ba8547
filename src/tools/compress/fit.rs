//! How many Gaussians a file of a given size holds.

use std::io::{self, Write};

use super::{Options, Target};
use densify_core::gaussians::Gaussians;
use densify_core::numbers::grouped;
use densify_data::models::{Format, is_unfit};
use densify_run::failure::{Failure, INPUT, OTHER};
use densify_train::importance::{footprints, largest};

/// Share of the size that the first estimate fills: training changes how well the rows pack.
const FILLED: f64 = 0.98;
/// Estimates until the number of rows is taken as it is.
const ESTIMATES: usize = 8;
/// Share of the rows that is left out at a time where the file is still too large.
const TRIMMED: f64 = 0.01;

/// Counts what is written to it.
#[derive(Default)]
struct Counted(u64);

impl Write for Counted {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0 += bytes.len() as u64;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// The size of a model's file in a format.
pub(super) fn bytes(format: &Format, model: &Gaussians) -> Result<u64, Failure> {
    let mut counted = Counted::default();
    format.write(model, &mut counted).map_err(|error| {
        Failure::new(
            if is_unfit(&error) { INPUT } else { OTHER },
            format!("cannot write the model as {}: {error}", format.name),
        )
    })?;
    Ok(counted.0)
}

/// Fails where the model cannot become what is asked for.
pub(super) fn check(options: &Options<'_>, model: &Gaussians) -> Result<(), Failure> {
    match options.to {
        _ if model.is_empty() => {
            Err(Failure::input(format!("{}: the model has no Gaussian", options.model.display())))
        }
        Target::Rows(rows) if rows > model.len() => Err(Failure::input(format!(
            "--to {rows}: {} has only {} Gaussians; give fewer, or a size such as 5MiB",
            options.model.display(),
            grouped(model.len())
        ))),
        // Said before anything is trained.
        Target::Bytes(most) if most < least(options, model).0 => Err(too_small(options, model)),
        _ => Ok(()),
    }
}

/// How many rows of a model, as it is, make a file of the target.
#[derive(Debug, Clone, Copy)]
pub(super) struct Packing {
    pub(super) format: &'static Format,
    pub(super) rows: usize,
    /// Whether they are all, at least as accurate as the format usually has them.
    pub(super) is_whole: bool,
}

/// In which formats to try this model, and how many of its rows, as it is, then make a file of the target: the format
/// that holds most, the first of equals; where it has several variants, all that hold at least four fifths as many as the one
/// that holds most, or, where it holds all as it is, the most accurate if that does too. None where not even one row fits.
///
/// # Errors
/// When no format has room for the model, or one cannot be written for another reason.
pub(super) fn packings(options: &Options<'_>, model: &Gaussians) -> Result<Vec<Packing>, Failure> {
    let (mut best, mut unfit) = (None, None);
    for &format in options.formats {
        let most = best.map_or(0, |(_, rows)| rows);
        match rows(options.to, format, model) {
            Ok(Some(rows)) if rows > most => best = Some((format, rows)),
            Ok(_) => {}
            Err(failure) if failure.code == INPUT => unfit = unfit.or(Some(failure)),
            Err(failure) => return Err(failure),
        }
    }
    let Some((format, rows)) = best else { return unfit.map_or(Ok(Vec::new()), Err) };
    let as_it_is = Packing { format, rows, is_whole: rows == model.len() };
    let variants = format.variants();
    // Without bands above 0 all variants are the same.
    let has_one = variants.is_empty() || model.sh_degree == 0;
    let Target::Bytes(most) = options.to else { return Ok(vec![as_it_is]) };
    if has_one {
        return Ok(vec![as_it_is]);
    }
    if as_it_is.is_whole {
        // Beside all rows there may be room for the most accurate colour.
        let format = if bytes(&variants[0], model)? <= most { &variants[0] } else { format };
        return Ok(vec![Packing { format, ..as_it_is }]);
    }
    let mut found: Vec<Packing> = Vec::new();
    for format in variants {
        let Some(rows) = self::rows(options.to, format, model)? else { continue };
        found.push(Packing { format, rows, is_whole: false });
        if rows == model.len() {
            break;
        }
    }
    // Rows show more than the accuracy of their colour.
    let most = found.iter().map(|packing| packing.rows).max().unwrap_or(0);
    found.retain(|packing| 5 * packing.rows >= 4 * most);
    Ok(found)
}

/// How many rows of this model, as it is, make a file of the target; `None` where not even one does.
pub(super) fn rows(
    to: Target,
    format: &Format,
    model: &Gaussians,
) -> Result<Option<usize>, Failure> {
    let most = match to {
        Target::Rows(rows) => return Ok(Some(rows.min(model.len()))),
        Target::Bytes(most) => most,
    };
    let mut rows = model.len();
    let mut size = bytes(format, model)?;
    if size <= most {
        return Ok(Some(rows));
    }
    // Files need not grow evenly with their rows, so each estimate stays between what fits and what does not.
    let (mut fits, mut over) = (0, rows);
    for _ in 0..ESTIMATES {
        let next = (rows as f64 * (FILLED * most as f64 / size as f64)) as usize;
        rows = if fits < next && next < over { next } else { fits.midpoint(over) }.max(1);
        size = bytes(format, &spread(model, rows))?;
        if size <= most {
            fits = rows;
        } else {
            over = rows;
        }
        let filled = size as f64 / most as f64;
        if (FILLED - 0.01..=1.0).contains(&filled) || over - fits <= 1 + model.len() / 500 {
            break;
        }
    }
    let found = if fits > 0 { fits } else { rows };
    Ok((fits > 0 || rows > 1).then_some(found))
}

/// So many rows, evenly from first to last, which is through space.
fn spread(model: &Gaussians, rows: usize) -> Gaussians {
    let at = |place: usize| (place as u64 * model.len() as u64 / rows as u64) as usize;
    model.gather(&(0..rows).map(at).collect::<Vec<_>>())
}

/// The model with as few rows left out, the faintest and smallest first, as make its file small enough, and the file's
/// size; `None` where no row is left.
pub(super) fn trimmed(
    to: Target,
    format: &Format,
    mut model: Gaussians,
) -> Result<Option<(Gaussians, u64)>, Failure> {
    loop {
        let size = bytes(format, &model)?;
        let most = match to {
            Target::Bytes(most) if size > most => most,
            _ => return Ok(Some((model, size))),
        };
        // As far over as the file is, so many rows too many; and a little more.
        let over = 1.0 - most as f64 / size as f64 + TRIMMED;
        let left = ((model.len() as f64 * (1.0 - over)) as usize).min(model.len() - 1);
        if left == 0 {
            return Ok(None);
        }
        model = model.gather(&largest(&footprints(&model), left));
    }
}

/// The least bytes that a Gaussian takes, and in which format.
fn least(options: &Options<'_>, model: &Gaussians) -> (u64, &'static str) {
    let one = model.gather(&[0]).with_degree(0);
    let sizes = options.formats.iter().filter_map(|it| Some((bytes(it, &one).ok()?, it.name)));
    sizes.min().unwrap_or_default()
}

/// What to say where not even one Gaussian fits.
pub(super) fn too_small(options: &Options<'_>, model: &Gaussians) -> Failure {
    let (least, format) = least(options, model);
    Failure::input(format!(
        "--to: no model fits; one Gaussian takes {least} bytes as {format}; give more"
    ))
}
