//! How much the colours of a scene change with the view, measured in its photographs before anything
//! is trained: what degree of spherical harmonics it asks for.
//!
//! Each track of the reconstruction is a point of a surface with the views that it was found in. Its
//! colour is read where it projects to in each of them. Photographs differ in exposure and white
//! balance, so that each view has a gain per channel, fitted first. What else differs without the
//! colour of the surface changing must not count:
//!
//! - Points of a reconstruction lie on edges and corners, where being a pixel off changes a colour
//!   more than any highlight. A view disagrees with a track only by as much as the track's colour (the
//!   median over its views) lies outside of *all* colours within a pixel of the place.
//! - Something else may stand before the point in some views. The quarter of a track's views that
//!   disagree most is left out.
//! - A point may not lie on the surface at all. It does where most views show its colour, as the
//!   reconstruction has it; where less than half of all points do, tracks decide nothing.
//!
//! What is left is a root mean square over the track's views. Highlights may cover a small part of a
//! scene, so that the strongest twentieth of the tracks decides. Nothing is read but photographs,
//! poses and the reconstruction.
//!
//! This departs from the per-Gaussian rule of Reduced-3DGS (Papantonakis et al. 2024, section 4.2),
//! which needs a trained model, and cannot save what its training takes.

use serde::{Deserialize, Serialize};

use crate::dataset::images::Image8;
use crate::dataset::{DatasetError, LEAST_VIEWS, Tracks, View};

/// Fewer measured tracks decide nothing.
pub const LEAST_TRACKS: usize = 500;
/// The difference that a twentieth of the tracks exceeds, from which on degree 1, 2 and 3 are asked
/// for `[1/255]`. `docs/requirements.md` has the scenes that they were chosen on.
pub const THRESHOLDS: [f64; 3] = [1.0, 2.0, 3.0];
/// Difference between a point's own colour and what its views show, up to which it lies on a surface
/// `[1/255]`.
const OWN: f64 = 4.0;
/// The share of a track's views that count: those that disagree least.
const COUNTED: f64 = 0.75;
/// Rounds of the fit: gains by the tracks' colours, then these by the gains.
const ROUNDS: usize = 3;
/// Channels outside of this say nothing about a gain: dark ones are noise, bright ones are clipped.
const TRUSTED: std::ops::RangeInclusive<u8> = 16..=245;
/// A view with fewer trusted colours keeps its gain of 1.
const LEAST_COLOURS: usize = 30;

/// How tracks' colours differ over views, in steps of 8 bits.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spread {
    /// Tracks measured in enough views.
    pub tracks: usize,
    /// The share of them that show their own colour.
    pub on_surface: f64,
    /// What half of the tracks exceed `[1/255]`.
    pub median: f64,
    /// What a tenth of the tracks exceeds `[1/255]`.
    pub tenth: f64,
    /// What a twentieth of the tracks exceeds `[1/255]`.
    pub twentieth: f64,
    /// Root mean square over all tracks `[1/255]`.
    pub rms: f64,
}

impl Spread {
    /// The degree that it asks for; `None` where too few tracks were measured, or too few of them lie
    /// on surfaces.
    #[must_use]
    pub fn degree(&self) -> Option<u8> {
        let above = THRESHOLDS.iter().filter(|&&from| self.twentieth >= from).count();
        (self.tracks >= LEAST_TRACKS && self.on_surface >= 0.5).then_some(above as u8)
    }
}

/// What a view shows of a track.
#[derive(Debug, Clone, Copy)]
struct Colour {
    track: u32,
    view: u32,
    centre: [u8; 3],
    /// Least and greatest within a pixel.
    lowest: [u8; 3],
    highest: [u8; 3],
}

/// Bytes that [`measure`] takes at most beside an image.
#[must_use]
pub fn bytes(tracks: &Tracks) -> u64 {
    let colours: usize = tracks.views.iter().map(Vec::len).sum();
    // The colours, and the numbers of one channel that are sorted for a median.
    (colours * (size_of::<Colour>() + 2 * size_of::<f32>())) as u64
}

/// Measures the tracks in the views that they name; decodes each view once.
///
/// # Errors
/// When an image cannot be read.
pub fn measure(tracks: &Tracks, views: &[View]) -> Result<Spread, DatasetError> {
    let mut shown = vec![Vec::new(); views.len()];
    for (track, seen_by) in tracks.views.iter().enumerate() {
        for &view in seen_by {
            if let Some(shown) = shown.get_mut(view as usize) {
                shown.push(track as u32);
            }
        }
    }
    let mut colours = Vec::new();
    for ((number, view), shown) in (0_u32..).zip(views).zip(shown) {
        if shown.is_empty() {
            continue;
        }
        let image = view.source.load()?;
        colours.extend(shown.into_iter().filter_map(|track| {
            let (pixel, depth) = view.camera.project(tracks.positions[track as usize]);
            let (centre, lowest, highest) = (depth > 0.0).then(|| around(&image, pixel))??;
            Some(Colour { track, view: number, centre, lowest, highest })
        }));
    }
    // By track; within one, views stay in order.
    colours.sort_by_key(|colour| colour.track);
    let of_tracks: Vec<&[Colour]> = colours
        .chunk_by(|a, b| a.track == b.track)
        .filter(|colours| colours.len() >= LEAST_VIEWS)
        .collect();
    // By channel, then track.
    let fits: [_; 3] = std::array::from_fn(|channel| fit(&of_tracks, views.len(), channel));
    let (mut each, mut on_surface, mut some) = (Vec::new(), 0, Vec::new());
    for (place, colours) in of_tracks.iter().enumerate() {
        let Some(first) = colours.first() else { continue };
        let own = tracks.colours[first.track as usize].map(f32::from);
        let reference = [0, 1, 2].map(|channel| fits[channel].1[place]);
        let mut differences = |from: [f32; 3]| -> Vec<f64> {
            some.clear();
            some.extend(colours.iter().map(|colour| {
                let gains = [0, 1, 2].map(|channel| fits[channel].0[colour.view as usize]);
                colour.square_from(from, gains)
            }));
            some.sort_unstable_by(f64::total_cmp);
            some.clone()
        };
        let from_own = differences(own);
        on_surface += usize::from(from_own[(from_own.len() - 1) / 2] < OWN * OWN);
        let from_reference = differences(reference);
        let counted = ((from_reference.len() as f64 * COUNTED).round() as usize).max(1);
        let sum: f64 = from_reference.iter().take(counted).sum();
        each.push((sum / counted as f64).sqrt());
    }
    each.sort_unstable_by(f64::total_cmp);
    let exceeded_by = |share: f64| {
        let place = ((1.0 - share) * each.len().saturating_sub(1) as f64).round() as usize;
        each.get(place).copied().unwrap_or(0.0)
    };
    let tracks = each.len().max(1) as f64;
    Ok(Spread {
        tracks: each.len(),
        on_surface: f64::from(on_surface as u32) / tracks,
        median: exceeded_by(0.5),
        tenth: exceeded_by(0.1),
        twentieth: exceeded_by(0.05),
        rms: (each.iter().map(|difference| difference * difference).sum::<f64>() / tracks).sqrt(),
    })
}

impl Colour {
    /// The mean square over channels of what this view is away from a colour.
    fn square_from(&self, colour: [f32; 3], gains: [f32; 3]) -> f64 {
        let square = |channel: usize| {
            let expected = colour[channel] * gains[channel];
            let below = f32::from(self.lowest[channel]) - expected;
            let above = expected - f32::from(self.highest[channel]);
            f64::from(below.max(above).max(0.0)).powi(2)
        };
        (square(0) + square(1) + square(2)) / 3.0
    }
}

/// The pixel's colour, and the least and greatest of it and its eight neighbours; `None` where not
/// all of them are there, opaque and counted.
fn around(image: &Image8, pixel: glam::DVec2) -> Option<([u8; 3], [u8; 3], [u8; 3])> {
    let (width, height) = (i64::from(image.width), i64::from(image.height));
    let (x, y) = (pixel.x.floor() as i64, pixel.y.floor() as i64);
    if !(1..width - 1).contains(&x) || !(1..height - 1).contains(&y) {
        return None;
    }
    let (mut lowest, mut highest) = ([u8::MAX; 3], [u8::MIN; 3]);
    let at = |x: i64, y: i64| (y * width + x) as usize;
    for place in (y - 1..=y + 1).flat_map(|y| (x - 1..=x + 1).map(move |x| at(x, y))) {
        let whole =
            |channel: &Option<Vec<u8>>| channel.as_ref().is_none_or(|c| c[place] == u8::MAX);
        if !whole(&image.alpha) || !whole(&image.mask) {
            return None;
        }
        for channel in 0..3 {
            let value = image.rgb[3 * place + channel];
            lowest[channel] = lowest[channel].min(value);
            highest[channel] = highest[channel].max(value);
        }
    }
    let centre = std::array::from_fn(|channel| image.rgb[3 * at(x, y) + channel]);
    Some((centre, lowest, highest))
}

/// Gains of the views and colours of the tracks, of one channel: each the median of what the others
/// say about it. An exposure is a factor in encoded values too, as their curve is nearly a power.
fn fit(of_tracks: &[&[Colour]], views: usize, channel: usize) -> (Vec<f32>, Vec<f32>) {
    let mut gains = vec![1.0_f32; views];
    let mut references = vec![0.0_f32; of_tracks.len()];
    let mut some = Vec::new();
    for round in 0..=ROUNDS {
        for (reference, colours) in references.iter_mut().zip(of_tracks) {
            some.clear();
            let said = |c: &Colour| f32::from(c.centre[channel]) / gains[c.view as usize];
            some.extend(colours.iter().map(said));
            *reference = median(&mut some);
        }
        if round == ROUNDS {
            break;
        }
        let mut ratios: Vec<Vec<f32>> = vec![Vec::new(); views];
        for (reference, colours) in references.iter().zip(of_tracks) {
            for colour in colours.iter().filter(|c| TRUSTED.contains(&c.centre[channel])) {
                let ratio = f32::from(colour.centre[channel]) / reference.max(1.0);
                ratios[colour.view as usize].push(ratio);
            }
        }
        for (gain, ratios) in gains.iter_mut().zip(&mut ratios) {
            if ratios.len() >= LEAST_COLOURS {
                *gain = median(ratios);
            }
        }
    }
    (gains, references)
}

/// The lower median; 0 of nothing.
fn median(values: &mut [f32]) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = (values.len() - 1) / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

#[cfg(test)]
mod tests;
