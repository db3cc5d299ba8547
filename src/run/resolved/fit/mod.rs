//! Finds the largest run that fits a memory limit: rows, degree, tile lists and image cache.
//!
//! The functions are pure: the memory that a [`RunSize`] takes comes from a callback. Guarantees: the result fits; one
//! more row does not fit, unless another limit applies; and more memory never gives a lower degree, or fewer rows at
//! the same degree.

use std::ops::RangeInclusive;

/// The size of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct RunSize {
    /// Maximum number of rows, >= 1.
    pub(crate) rows: usize,
    /// Highest spherical-harmonic degree, 0 to 3.
    pub(crate) sh_degree: u8,
    /// Maximum number of (row, tile) pairs in the tile lists at a time, >= rows.
    pub(crate) tile_cap: usize,
    /// Bytes of decoded images kept in memory.
    pub(crate) image_cache: u64,
    /// Maximum bytes of training images kept on a GPU.
    pub(crate) images_on_gpu: u64,
}

/// The memory limit, the wanted size, and the choices left to the solver.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct SizeRequest {
    /// The limit `[bytes]`.
    pub(crate) memory: u64,
    /// Minimum number of rows of a useful model, >= 1.
    pub(crate) min_rows: usize,
    /// Number of rows at the start; the degree is lowered if fewer fit.
    pub(crate) enough_rows: usize,
    /// Maximum number of rows: the number wanted, or the largest number possible if that is smaller; >= 1.
    pub(crate) max_rows: usize,
    /// Degrees to choose from; the highest is the one wanted.
    pub(crate) sh_degree: RangeInclusive<u8>,
    /// Maximum number of (row, tile) pairs; `None`: chosen by the solver.
    pub(crate) tile_cap: Option<usize>,
    /// (Row, tile) pairs per row to choose from, in ascending order; numbers above the first are chosen only if
    /// memory is left.
    pub(crate) pairs: [usize; 3],
    /// Maximum number of (row, tile) pairs that the device supports.
    pub(crate) max_pairs: usize,
    /// Number of (row, tile) pairs that few views exceed: lists with more than the first of `pairs` per row are no longer.
    pub(crate) enough_pairs: usize,
    /// Bytes of decoded images; `None`: chosen by the solver.
    pub(crate) image_cache: Option<u64>,
    /// Maximum bytes of decoded images that are kept at the expense of rows.
    pub(crate) max_image_bytes: u64,
    /// Bytes of all images when decoded.
    pub(crate) all_image_bytes: u64,
}

/// The size that [`fit`] found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Fit {
    /// The size.
    pub(crate) size: RunSize,
    /// True if memory limits the number of rows.
    pub(crate) by_memory: bool,
    /// Number of rows that fit at the wanted degree.
    pub(crate) at_wanted_degree: usize,
}

/// Default (row, tile) pairs per row: the minimum, and larger numbers if memory is left. A view rarely has three pairs
/// per row; views with more pairs than the limit are rendered in bands, with the same result.
pub(super) const PAIRS: [usize; 3] = [4, 8, 16];
/// Decoded images may take the memory limit divided by this number.
pub(super) const IMAGE_SHARE_DIVISOR: u64 = 8;

impl SizeRequest {
    /// A size with this many pairs per row, and at most 1 / [`IMAGE_SHARE_DIVISOR`] of the memory for images.
    pub(super) fn size(&self, rows: usize, sh_degree: u8, pairs: usize) -> RunSize {
        let max_pairs = self.max_pairs.max(rows);
        let enough = self.enough_pairs.max(rows.saturating_mul(self.pairs[0]));
        let chosen = || rows.saturating_mul(pairs).min(enough).min(max_pairs);
        let tile_cap = self.tile_cap.unwrap_or_else(chosen);
        let share = self.memory / IMAGE_SHARE_DIVISOR;
        let images = || self.all_image_bytes.min(share).min(self.max_image_bytes);
        let image_cache = self.image_cache.unwrap_or_else(images);
        let images_on_gpu = image_cache.min(share);
        RunSize { rows, sh_degree, tile_cap: tile_cap.max(rows), image_cache, images_on_gpu }
    }
}

/// Finds the largest size; `None` if not even the fewest rows fit.
///
/// `bytes` returns the memory of a size. Requirements: if a size exceeds the limit, so does every size with more rows,
/// pairs or images; and images take at most `image_cache` plus a constant.
///
/// The degree is the highest at which enough rows fit, or else the lowest. As many rows as possible are chosen; if all
/// wanted rows fit, the remaining memory goes to the tile lists and then to the images.
pub(super) fn fit<E>(
    request: &SizeRequest,
    mut bytes: impl FnMut(&RunSize) -> Result<u64, E>,
) -> Result<Option<Fit>, E> {
    let max_rows = request.max_rows.max(1);
    let min_rows = request.min_rows.clamp(1, max_rows);
    let enough_rows = request.enough_rows.clamp(min_rows, max_rows);
    let mut at_wanted_degree = None;
    let mut largest = None;
    for degree in request.sh_degree.clone().rev() {
        let size = |rows| request.size(rows, degree, request.pairs[0]);
        let rows = largest_where(min_rows, max_rows, |n| Ok(bytes(&size(n))? <= request.memory))?;
        at_wanted_degree.get_or_insert(rows.unwrap_or(0));
        largest = rows.map(|rows| (rows, degree));
        if rows.is_some_and(|rows| rows >= enough_rows) {
            break;
        }
    }
    let Some((rows, degree)) = largest else { return Ok(None) };
    let mut size = request.size(rows, degree, request.pairs[0]);
    if rows == max_rows {
        for pairs in request.pairs.into_iter().skip(1) {
            let larger = request.size(rows, degree, pairs);
            if bytes(&larger)? <= request.memory {
                size = larger;
            }
        }
        if request.image_cache.is_none() {
            let all = RunSize { image_cache: request.all_image_bytes, ..size };
            let left = request.memory.saturating_sub(bytes(&size)?);
            // Images in use are counted even if the cache is smaller, so a cache of all images may fit although `left`
            // is too small: try that cache first.
            size.image_cache = if bytes(&all)? <= request.memory {
                request.all_image_bytes
            } else {
                size.image_cache.saturating_add(left).min(request.all_image_bytes)
            };
        }
    }
    let at_wanted_degree = at_wanted_degree.unwrap_or(rows);
    Ok(Some(Fit { size, by_memory: rows < max_rows, at_wanted_degree }))
}

/// The smallest memory in which a model fits, in multiples of `step` bytes; `None` if none suffices.
pub(super) fn min_memory<E>(
    request: &SizeRequest,
    step: u64,
    mut bytes: impl FnMut(&RunSize) -> Result<u64, E>,
) -> Result<Option<u64>, E> {
    let fits = |steps: usize, bytes: &mut dyn FnMut(&RunSize) -> Result<u64, E>| {
        let request = SizeRequest { memory: steps as u64 * step, ..request.clone() };
        fit(&request, bytes).map(|fit| fit.is_some())
    };
    // The smallest model with all of its images.
    let all = SizeRequest { memory: u64::MAX, ..request.clone() };
    let rows = request.min_rows.clamp(1, request.max_rows.max(1));
    let enough = bytes(&all.size(rows, *request.sh_degree.start(), request.pairs[0]))?;
    let Ok(max_steps) = usize::try_from(enough.div_ceil(step)) else { return Ok(None) };
    let insufficient = largest_where(0, max_steps, |steps| Ok(!fits(steps, &mut bytes)?))?;
    Ok(Some(insufficient.map_or(0, |steps| steps as u64 + 1) * step))
}

/// The largest number in `min..=max` for which `holds` returns true, which it must do up to some number and not
/// above it.
pub(super) fn largest_where<E>(
    min: usize,
    max: usize,
    mut holds: impl FnMut(usize) -> Result<bool, E>,
) -> Result<Option<usize>, E> {
    if min > max || !holds(min)? {
        return Ok(None);
    }
    if holds(max)? {
        return Ok(Some(max));
    }
    let (mut good, mut bad) = (min, max);
    while bad - good > 1 {
        let middle = good + (bad - good) / 2;
        *(if holds(middle)? { &mut good } else { &mut bad }) = middle;
    }
    Ok(Some(good))
}

#[cfg(test)]
mod tests;
