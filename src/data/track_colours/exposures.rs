//! Decides before training whether the photographs of a scene differ in exposure, from the colours of tracks.
//!
//! A gain per view and channel is fitted to the colours in which the views show the same points. Exposures differ if
//! the gains differ and also explain most of the differences between colours. Highlights, wrong points and noise also
//! change gains a little, but the gains do not explain their differences.

use serde::{Deserialize, Serialize};

use super::{MIN_TRACKS, TrackColours, median};

/// Smallest spread at which exposures are learned `[stops]`. Random exposures within ±1 stop over 20 views may have a
/// spread of only 0.42.
pub const MIN_STOPS: f64 = 0.3;
/// Largest share of the colour differences that the gains may leave unexplained. With random exposures 0.34 or less is
/// left. In photographs of one exposure whose colours change with the view, 0.6 or more is left, at a spread of
/// 0.4 stops, and learning exposures made test views worse. Both were measured for docs/studies/exposure-auto.tsv.
const MAX_UNEXPLAINED: f64 = 0.45;
/// Stops per doubling of an sRGB-encoded value, as the sRGB curve is nearly the power 1/2.4.
pub const STOPS: f64 = 2.4;

/// Differences between the exposures of the training views.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExposureSpread {
    /// Number of tracks measured in enough views.
    pub tracks: usize,
    /// Number of views with enough trusted colours.
    pub views: usize,
    /// Root mean square difference of the gains from their mean, over these views and the channels `[stops]`.
    pub stops: f64,
    /// Median difference between an observed colour and its track's colour, assuming equal exposures `[1/255]`.
    pub alike: f64,
    /// The same median difference with the fitted gains `[1/255]`.
    pub with_gains: f64,
}

impl ExposureSpread {
    /// Measures the spread. Also returns the gains of all views, normalised to a geometric mean of 1; views with too
    /// few trusted colours have gain 1.
    pub fn measure(colours: &TrackColours) -> (Self, Vec<[f32; 3]>) {
        let known: Vec<usize> = (0..colours.views()).filter(|&view| colours.knows(view)).collect();
        let mean = |function: &dyn Fn([f32; 3]) -> [f64; 3]| {
            let mut mean = [0.0; 3];
            for &view in &known {
                let gains = function(colours.gains(view));
                mean.iter_mut().zip(gains).for_each(|(sum, gain)| *sum += gain);
            }
            mean.map(|sum| sum / known.len().max(1) as f64)
        };
        let logarithm = |gains: [f32; 3]| gains.map(|gain| STOPS * f64::from(gain).log2());
        let middle = mean(&logarithm);
        let squares = mean(&|gains| {
            let stops = logarithm(gains);
            std::array::from_fn(|channel| (stops[channel] - middle[channel]).powi(2))
        });
        let factor = middle.map(|stops| (stops / STOPS).exp2());
        let gains = (0..colours.views())
            .map(|view| {
                if !colours.knows(view) {
                    return [1.0; 3];
                }
                let gains = colours.gains(view);
                std::array::from_fn(|channel| (f64::from(gains[channel]) / factor[channel]) as f32)
            })
            .collect();
        // Reserved at once, so that they take no more than [`bytes`](super::bytes) counts.
        let differences = 3 * colours.by_track().map(<[_]>::len).sum::<usize>();
        let mut alike = Vec::with_capacity(differences);
        let mut with_gains = Vec::with_capacity(differences);
        let mut values = Vec::new();
        let mut tracks = 0;
        for (index, seen) in colours.by_track().enumerate() {
            tracks += 1;
            let fitted = colours.reference(index);
            for (channel, fitted) in fitted.iter().enumerate() {
                values.clear();
                values.extend(seen.iter().map(|colour| f32::from(colour.centre[channel])));
                let plain = median(&mut values);
                for colour in seen.iter().filter(|colour| colours.knows(colour.view as usize)) {
                    let value = f32::from(colour.centre[channel]);
                    let gain = colours.gains(colour.view as usize)[channel];
                    alike.push((value - plain).abs());
                    with_gains.push((value - fitted * gain).abs());
                }
            }
        }
        let spread = Self {
            tracks,
            views: known.len(),
            stops: (squares.iter().sum::<f64>() / 3.0).sqrt(),
            alike: f64::from(median(&mut alike)),
            with_gains: f64::from(median(&mut with_gains)),
        };
        (spread, gains)
    }

    /// True if exposures should be learned; `None` if too few tracks or views were measured for a decision.
    pub fn decision(&self, views: usize) -> Option<bool> {
        let is_enough = self.tracks >= MIN_TRACKS && 2 * self.views > views;
        let differ = self.stops >= MIN_STOPS && self.with_gains <= MAX_UNEXPLAINED * self.alike;
        is_enough.then_some(differ)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exposures_are_learned_where_gains_differ_and_explain_colours() {
        let (stops, alike, with_gains) = (0.3, 10.0, 4.5);
        let enough = ExposureSpread { tracks: MIN_TRACKS, views: 6, stops, alike, with_gains };
        for (found, expected) in [
            (enough, Some(true)),
            (ExposureSpread { stops: 0.29, ..enough }, Some(false)),
            (ExposureSpread { with_gains: 4.6, ..enough }, Some(false)),
            (ExposureSpread { tracks: MIN_TRACKS - 1, ..enough }, None),
            (ExposureSpread { views: 5, ..enough }, None),
        ] {
            assert_eq!(found.decision(10), expected, "{found:?}");
        }
    }
}
