//! Measures before training how much colours in the photographs change with the view, to choose the degree of spherical
//! harmonics.
//!
//! Each track of the reconstruction is a point with the views that show it, and its colour is read in each of them.
//! Photographs differ in exposure and white balance, so a gain per view and channel is fitted first. Three other causes
//! of differences are excluded:
//!
//! - Reconstructed points lie on edges and corners, where the colour changes more within a pixel than by any highlight.
//!   The difference in a view is therefore the distance of the track's colour (the median over its views) from the
//!   range of *all* colours within a pixel.
//! - The point may be occluded in some views. The quarter of its views that differ most is ignored.
//! - The point may not lie on a surface. A point counts as on a surface if most views show the colour that the
//!   reconstruction gives it; if fewer than half of all points do, no decision is made.
//!
//! The spread of a track is the root mean square over its remaining views. Highlights may cover a small part of a
//! scene, so the 95th percentile of the tracks decides. Only photographs, poses and the reconstruction are used.
//!
//! This differs from the per-Gaussian rule of Reduced-3DGS (Papantonakis et al. 2024, section 4.2),
//! which needs a trained model and therefore cannot save memory while training.

mod colours;
pub mod exposures;
pub mod vignettes;

use serde::{Deserialize, Serialize};

use crate::dataset::Tracks;
use colours::median;
pub use colours::{TrackColours, bytes};

/// Smallest number of measured tracks for a decision.
pub const MIN_TRACKS: usize = 500;
/// The smallest 95th percentiles for which degrees 1, 2 and 3 are chosen `[1/255]`, fitted to the scenes of
/// `docs/studies/sh-degree-auto.tsv`.
const THRESHOLDS: [f64; 3] = [1.0, 2.0, 3.0];
/// Largest difference between a point's colour in the reconstruction and in a view, if the point lies on a surface
/// `[1/255]`.
const SAME_COLOUR: f64 = 4.0;
/// Fraction of a track's views that count, namely those that differ least.
const AGREEING: f64 = 0.75;

/// Statistics of the spreads of all tracks.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Spread {
    /// Number of tracks measured in enough views.
    pub tracks: usize,
    /// Fraction of these tracks that lie on a surface.
    pub on_surface: f64,
    /// Median of the tracks' spreads `[1/255]`.
    pub median: f64,
    /// 90th percentile of the spreads: a tenth of the tracks exceeds it `[1/255]`.
    pub tenth: f64,
    /// 95th percentile of the spreads: a twentieth of the tracks exceeds it `[1/255]`.
    pub twentieth: f64,
    /// Root mean square of the spreads `[1/255]`.
    pub rms: f64,
}

impl Spread {
    /// The degree of spherical harmonics to train with; `None` if too few tracks were measured or lie on surfaces.
    pub fn degree(&self) -> Option<u8> {
        let above = THRESHOLDS.iter().filter(|&&from| self.twentieth >= from).count();
        (self.tracks >= MIN_TRACKS && self.on_surface >= 0.5).then_some(above as u8)
    }
}

/// Measures how much the colours of tracks change with the view, after correcting exposures.
pub fn measure(tracks: &Tracks, colours: &TrackColours) -> Spread {
    let (mut each, mut on_surface, mut buffer) = (Vec::new(), 0, Vec::new());
    for (index, seen) in colours.by_track().enumerate() {
        let Some(first) = seen.first() else { continue };
        let own = tracks.colours[first.track as usize].map(f32::from);
        let mut differences = |from: [f32; 3]| -> Vec<f64> {
            buffer.clear();
            buffer.extend(seen.iter().map(|colour| {
                colour.squared_difference(from, colours.gains(colour.view as usize))
            }));
            buffer.sort_unstable_by(f64::total_cmp);
            buffer.clone()
        };
        let to_own = differences(own);
        on_surface += usize::from(to_own[(to_own.len() - 1) / 2] < SAME_COLOUR * SAME_COLOUR);
        let to_reference = differences(colours.reference(index));
        let counted = ((to_reference.len() as f64 * AGREEING).round() as usize).max(1);
        let sum: f64 = to_reference.iter().take(counted).sum();
        each.push((sum / counted as f64).sqrt());
    }
    each.sort_unstable_by(f64::total_cmp);
    let percentile = |fraction: f64| {
        let index = (fraction * each.len().saturating_sub(1) as f64).round() as usize;
        each.get(index).copied().unwrap_or(0.0)
    };
    let tracks = each.len().max(1) as f64;
    Spread {
        tracks: each.len(),
        on_surface: f64::from(on_surface as u32) / tracks,
        median: percentile(0.5),
        tenth: percentile(0.9),
        twentieth: percentile(0.95),
        rms: (each.iter().map(|difference| difference * difference).sum::<f64>() / tracks).sqrt(),
    }
}

#[cfg(test)]
mod tests;
