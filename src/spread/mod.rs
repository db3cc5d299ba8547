//! Measures how much colours change with the view, in the photographs and before training, to choose
//! the degree of spherical harmonics.
//!
//! Each track of the reconstruction is a surface point with the views that show it. Its colour is
//! read in each of them. Photographs differ in exposure and white balance, so a gain per view and
//! channel is fitted first. Three other causes of differences must not count:
//!
//! - Reconstructed points lie on edges and corners, where one pixel changes the colour more than any
//!   highlight. So the difference is the distance of the track's colour (the median over its views)
//!   from the range of *all* colours within a pixel.
//! - The point may be hidden in some views. The quarter of its views that differ most is ignored.
//! - The point may not lie on a surface. It does if most views show the colour that the
//!   reconstruction gives it; if less than half of all points do, tracks decide nothing.
//!
//! The spread of a track is the root mean square over its remaining views. Highlights may cover a
//! small part of a scene, so the 95th percentile of the tracks decides. Only photographs, poses and
//! the reconstruction are read.
//!
//! This differs from the per-Gaussian rule of Reduced-3DGS (Papantonakis et al. 2024, section 4.2),
//! which needs a trained model and therefore cannot save memory while training.

use serde::{Deserialize, Serialize};

use crate::dataset::images::Image8;
use crate::dataset::{DatasetError, MIN_VIEWS, Tracks, View};

/// With fewer measured tracks, the degree is not decided.
pub const MIN_TRACKS: usize = 500;
/// From these 95th percentiles on, degrees 1, 2 and 3 are chosen `[1/255]`. `docs/tradeoffs.md` lists
/// the scenes that they were fitted to.
pub const THRESHOLDS: [f64; 3] = [1.0, 2.0, 3.0];
/// Largest difference between the reconstruction's colour of a point and its colour in a view for
/// the point to count as on a surface `[1/255]`.
const SAME_COLOUR: f64 = 4.0;
/// Fraction of a track's views that count: those that differ least.
const AGREEING: f64 = 0.75;
/// Rounds of alternately fitting gains and colours of tracks.
const ROUNDS: usize = 3;
/// Values used to fit gains: darker ones are noise, brighter ones are clipped.
const TRUSTED: std::ops::RangeInclusive<u8> = 16..=245;
/// A view with fewer trusted values keeps a gain of 1.
const MIN_COLOURS: usize = 30;

/// How much the colours of tracks change with the view.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spread {
    /// Number of tracks measured in enough views.
    pub tracks: usize,
    /// Fraction of them that lie on a surface.
    pub on_surface: f64,
    /// Median over the tracks `[1/255]`.
    pub median: f64,
    /// 90th percentile of the tracks `[1/255]`.
    pub tenth: f64,
    /// 95th percentile of the tracks `[1/255]`.
    pub twentieth: f64,
    /// Root mean square over all tracks `[1/255]`.
    pub rms: f64,
}

impl Spread {
    /// The degree to train with; `None` if too few tracks were measured, or too few of them lie on
    /// surfaces.
    #[must_use]
    pub fn degree(&self) -> Option<u8> {
        let above = THRESHOLDS.iter().filter(|&&from| self.twentieth >= from).count();
        (self.tracks >= MIN_TRACKS && self.on_surface >= 0.5).then_some(above as u8)
    }
}

/// The colours of a track in one view.
#[derive(Debug, Clone, Copy)]
struct Observation {
    track: u32,
    view: u32,
    centre: [u8; 3],
    /// Smallest and largest value within a pixel.
    lowest: [u8; 3],
    highest: [u8; 3],
}

/// Most bytes that [`measure`] takes in addition to an image.
#[must_use]
pub fn bytes(tracks: &Tracks) -> u64 {
    let colours: usize = tracks.views.iter().map(Vec::len).sum();
    // The observations, and one channel of them that is sorted for a median.
    (colours * (size_of::<Observation>() + 2 * size_of::<f32>())) as u64
}

/// Measures the tracks in their views; decodes each view once.
pub fn measure(tracks: &Tracks, views: &[View]) -> Result<Spread, DatasetError> {
    let mut tracks_in = vec![Vec::new(); views.len()];
    for (track, seen_by) in tracks.views.iter().enumerate() {
        for &view in seen_by {
            if let Some(tracks) = tracks_in.get_mut(view as usize) {
                tracks.push(track as u32);
            }
        }
    }
    let mut colours = Vec::new();
    for ((number, view), numbers) in (0_u32..).zip(views).zip(tracks_in) {
        if numbers.is_empty() {
            continue;
        }
        let image = view.source.load()?;
        colours.extend(numbers.into_iter().filter_map(|track| {
            let (pixel, depth) = view.camera.project(tracks.positions[track as usize]);
            let (centre, lowest, highest) =
                (depth > 0.0).then(|| neighbourhood(&image, pixel))??;
            Some(Observation { track, view: number, centre, lowest, highest })
        }));
    }
    // A stable sort: views stay in order within a track.
    colours.sort_by_key(|colour| colour.track);
    let by_track: Vec<&[Observation]> = colours
        .chunk_by(|a, b| a.track == b.track)
        .filter(|colours| colours.len() >= MIN_VIEWS)
        .collect();
    // By channel, then track.
    let fits: [_; 3] = std::array::from_fn(|channel| fit(&by_track, views.len(), channel));
    let (mut each, mut on_surface, mut buffer) = (Vec::new(), 0, Vec::new());
    for (place, colours) in by_track.iter().enumerate() {
        let Some(first) = colours.first() else { continue };
        let own = tracks.colours[first.track as usize].map(f32::from);
        let reference = [0, 1, 2].map(|channel| fits[channel].1[place]);
        let mut differences = |from: [f32; 3]| -> Vec<f64> {
            buffer.clear();
            buffer.extend(colours.iter().map(|colour| {
                let gains = [0, 1, 2].map(|channel| fits[channel].0[colour.view as usize]);
                colour.squared_difference(from, gains)
            }));
            buffer.sort_unstable_by(f64::total_cmp);
            buffer.clone()
        };
        let to_own = differences(own);
        on_surface += usize::from(to_own[(to_own.len() - 1) / 2] < SAME_COLOUR * SAME_COLOUR);
        let to_reference = differences(reference);
        let counted = ((to_reference.len() as f64 * AGREEING).round() as usize).max(1);
        let sum: f64 = to_reference.iter().take(counted).sum();
        each.push((sum / counted as f64).sqrt());
    }
    each.sort_unstable_by(f64::total_cmp);
    let percentile = |fraction: f64| {
        let place = (fraction * each.len().saturating_sub(1) as f64).round() as usize;
        each.get(place).copied().unwrap_or(0.0)
    };
    let tracks = each.len().max(1) as f64;
    Ok(Spread {
        tracks: each.len(),
        on_surface: f64::from(on_surface as u32) / tracks,
        median: percentile(0.5),
        tenth: percentile(0.9),
        twentieth: percentile(0.95),
        rms: (each.iter().map(|difference| difference * difference).sum::<f64>() / tracks).sqrt(),
    })
}

impl Observation {
    /// Squared difference from a colour, mean over the channels.
    fn squared_difference(&self, colour: [f32; 3], gains: [f32; 3]) -> f64 {
        let square = |channel: usize| {
            let expected = colour[channel] * gains[channel];
            let below = f32::from(self.lowest[channel]) - expected;
            let above = expected - f32::from(self.highest[channel]);
            f64::from(below.max(above).max(0.0)).powi(2)
        };
        (square(0) + square(1) + square(2)) / 3.0
    }
}

/// The colour of a pixel, and the smallest and largest values of it and its eight neighbours; `None`
/// unless all of them are inside the image, opaque and not masked.
fn neighbourhood(image: &Image8, pixel: glam::DVec2) -> Option<([u8; 3], [u8; 3], [u8; 3])> {
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

/// Fits the gains of the views and the colours of the tracks, in one channel. An exposure is a factor
/// in encoded values too, because the sRGB curve is nearly a power.
fn fit(by_track: &[&[Observation]], views: usize, channel: usize) -> (Vec<f32>, Vec<f32>) {
    let mut gains = vec![1.0_f32; views];
    let mut references = vec![0.0_f32; by_track.len()];
    let mut buffer = Vec::new();
    for round in 0..=ROUNDS {
        for (reference, colours) in references.iter_mut().zip(by_track) {
            buffer.clear();
            let estimate = |c: &Observation| f32::from(c.centre[channel]) / gains[c.view as usize];
            buffer.extend(colours.iter().map(estimate));
            *reference = median(&mut buffer);
        }
        if round == ROUNDS {
            break;
        }
        let mut ratios: Vec<Vec<f32>> = vec![Vec::new(); views];
        for (reference, colours) in references.iter().zip(by_track) {
            for colour in colours.iter().filter(|c| TRUSTED.contains(&c.centre[channel])) {
                let ratio = f32::from(colour.centre[channel]) / reference.max(1.0);
                ratios[colour.view as usize].push(ratio);
            }
        }
        for (gain, ratios) in gains.iter_mut().zip(&mut ratios) {
            if ratios.len() >= MIN_COLOURS {
                *gain = median(ratios);
            }
        }
    }
    (gains, references)
}

/// The lower median; 0 if there are no values.
fn median(values: &mut [f32]) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = (values.len() - 1) / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

#[cfg(test)]
mod tests;
