//! How large a run may be in a memory that is given: rows, degree, tile lists and image cache.
//!
//! Pure functions over the bytes that a setting takes. What is promised is that the setting found
//! fits, that one row more would not (but where another limit holds), and that more memory never
//! gives a smaller model: a lower degree, or fewer rows at the same degree.

use std::ops::RangeInclusive;

/// What decides how large a run is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Setting {
    /// Most rows there may ever be, >= 1.
    pub rows: usize,
    /// Highest spherical-harmonic degree, 0 to 3.
    pub sh_degree: u8,
    /// Most (row, tile) pairs held at a time, >= rows.
    pub tile_cap: usize,
    /// Bytes of decoded images held at a time.
    pub image_cache: u64,
}

/// What is asked for, and what may be chosen.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Wishes {
    /// The limit `[bytes]`.
    pub memory: u64,
    /// Fewer rows than this are no model, >= 1.
    pub least_rows: usize,
    /// Rows that the scene starts with: a degree at which fewer fit is lowered.
    pub enough_rows: usize,
    /// Most rows wanted or possible, >= 1.
    pub most_rows: usize,
    /// Degrees to choose from; the highest is the one that is wanted.
    pub sh_degree: RangeInclusive<u8>,
    /// Most (row, tile) pairs, where they are not to be chosen.
    pub tile_cap: Option<usize>,
    /// (Row, tile) pairs per row where they are chosen: those for a start, and those where rows leave
    /// room, in rising order.
    pub pairs: [usize; 3],
    /// Most (row, tile) pairs possible.
    pub most_pairs: usize,
    /// Bytes of decoded images, where they are not to be chosen.
    pub image_cache: Option<u64>,
    /// Bytes of all images decoded.
    pub all_images: u64,
}

/// What fits.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fit {
    /// The setting.
    pub setting: Setting,
    /// Whether memory is what keeps the rows from being more.
    pub by_memory: bool,
    /// Rows that fit at the degree that was wanted.
    pub at_wanted_degree: usize,
}

/// (Row, tile) pairs per row unless something else is wished: those for a start, then those where rows
/// leave room. A view seldom has three per row; one that has more is rendered in bands, to the same
/// bits.
pub const PAIRS: [usize; 3] = [4, 8, 16];
/// The share of the memory that decoded images may have: one part in so many.
pub(crate) const IMAGES: u64 = 8;

impl Wishes {
    /// Where the search begins: the fewest pairs, and no more images than their share.
    fn setting(&self, rows: usize, sh_degree: u8, pairs: usize) -> Setting {
        let most = self.most_pairs.max(rows);
        let tile_cap = self.tile_cap.unwrap_or_else(|| rows.saturating_mul(pairs).min(most));
        let images = || self.all_images.min(self.memory / IMAGES);
        let image_cache = self.image_cache.unwrap_or_else(images);
        Setting { rows, sh_degree, tile_cap: tile_cap.max(rows), image_cache }
    }
}

/// Finds the setting for what is wished. `bytes` says what a setting takes; it must not shrink as
/// rows, pairs or images grow, and images must not take more than they are granted beyond a fixed
/// part. `None`: not even the least rows fit.
///
/// The degree is the one wanted, unless fewer rows than enough fit there: then the highest at which
/// enough fit, or else the lowest. Rows are as many as fit; where the most wanted fit, what is left
/// goes to the tile lists and then to the images.
///
/// # Errors
/// Those of `bytes`.
pub fn fit<E>(
    wishes: &Wishes,
    mut bytes: impl FnMut(&Setting) -> Result<u64, E>,
) -> Result<Option<Fit>, E> {
    let most = wishes.most_rows.max(1);
    let least = wishes.least_rows.clamp(1, most);
    let enough = wishes.enough_rows.clamp(least, most);
    let mut at_wanted_degree = None;
    let mut found = None;
    for degree in wishes.sh_degree.clone().rev() {
        let of = |rows| wishes.setting(rows, degree, wishes.pairs[0]);
        let rows = most_within(least, most, |rows| Ok(bytes(&of(rows))? <= wishes.memory))?;
        at_wanted_degree.get_or_insert(rows.unwrap_or(0));
        found = rows.map(|rows| (rows, degree));
        if rows.is_some_and(|rows| rows >= enough) {
            break;
        }
    }
    let Some((rows, degree)) = found else { return Ok(None) };
    let mut setting = wishes.setting(rows, degree, wishes.pairs[0]);
    if rows == most {
        for pairs in wishes.pairs.into_iter().skip(1) {
            let larger = wishes.setting(rows, degree, pairs);
            if bytes(&larger)? <= wishes.memory {
                setting = larger;
            }
        }
        if wishes.image_cache.is_none() {
            let all = Setting { image_cache: wishes.all_images, ..setting };
            let left = wishes.memory.saturating_sub(bytes(&setting)?);
            // What is in use at a time is counted even where the cache holds less.
            setting.image_cache = match bytes(&all)? <= wishes.memory {
                true => wishes.all_images,
                false => setting.image_cache.saturating_add(left).min(wishes.all_images),
            };
        }
    }
    let at_wanted_degree = at_wanted_degree.unwrap_or(rows);
    Ok(Some(Fit { setting, by_memory: rows < most, at_wanted_degree }))
}

/// The least memory in which a model fits, in whole steps of `step` bytes, if there is any.
///
/// # Errors
/// Those of `bytes`.
pub fn least_memory<E>(
    wishes: &Wishes,
    step: u64,
    mut bytes: impl FnMut(&Setting) -> Result<u64, E>,
) -> Result<Option<u64>, E> {
    let fits = |steps: usize, bytes: &mut dyn FnMut(&Setting) -> Result<u64, E>| {
        let wishes = Wishes { memory: steps as u64 * step, ..wishes.clone() };
        fit(&wishes, bytes).map(|fit| fit.is_some())
    };
    // The least model with all of its images.
    let all = Wishes { memory: u64::MAX, ..wishes.clone() };
    let least = wishes.least_rows.clamp(1, wishes.most_rows.max(1));
    let most = bytes(&all.setting(least, *wishes.sh_degree.start(), wishes.pairs[0]))?;
    let Ok(most) = usize::try_from(most.div_ceil(step)) else { return Ok(None) };
    let too_little = most_within(0, most, |steps| Ok(!fits(steps, &mut bytes)?))?;
    Ok(Some(too_little.map_or(0, |steps| steps as u64 + 1) * step))
}

/// The largest number in `least..=most` that `holds`, where all below it do, too.
fn most_within<E>(
    least: usize,
    most: usize,
    mut holds: impl FnMut(usize) -> Result<bool, E>,
) -> Result<Option<usize>, E> {
    if least > most || !holds(least)? {
        return Ok(None);
    }
    if holds(most)? {
        return Ok(Some(most));
    }
    let (mut good, mut bad) = (least, most);
    while bad - good > 1 {
        let middle = good + (bad - good) / 2;
        *(if holds(middle)? { &mut good } else { &mut bad }) = middle;
    }
    Ok(Some(good))
}

#[cfg(test)]
mod tests;
