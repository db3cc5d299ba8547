//! Whether the photographs of a scene were exposed differently, from the colours of the reconstruction's
//! points in them, before training.
//!
//! A gain per view and channel is fitted to the colours that each view shows of the same points. Gains are
//! evidence where they differ, and where they explain how the colours differ: highlights, wrong points and
//! noise make gains differ a little too, but leave the colours apart.

use serde::{Deserialize, Serialize};

use super::{MIN_TRACKS, TrackColours, median};

/// From this spread on, exposures are learned `[stops]`. Jitter of ±1 stop over 20 views may differ by as little as 0.42.
pub const MIN_STOPS: f64 = 0.3;
/// Gains must leave at most this share of the difference between the colours. Jitter leaves 0.34 or less; photographs
/// of one exposure whose colours change with the view leave 0.6 or more, at 0.4 stops: learned there, exposures lost
/// what test views are as photographed. docs/tradeoffs.md has the scenes that both numbers were chosen on.
pub const MOST_LEFT: f64 = 0.45;
/// Stops per doubling of an encoded value: the sRGB curve is nearly the power 1/2.4.
pub const STOPS: f64 = 2.4;

/// How the exposures of the training views differ.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExposureSpread {
    /// Number of tracks measured in enough views.
    pub tracks: usize,
    /// Views of which enough colours are known.
    pub views: usize,
    /// Root mean square difference of the gains from their mean, over these views and the channels `[stops]`.
    pub stops: f64,
    /// Median difference of a colour from that of its track, with one exposure for all views `[1/255]`.
    pub alike: f64,
    /// The same with the gains `[1/255]`.
    pub with_gains: f64,
}

impl ExposureSpread {
    /// Measures it; also returns the gains of all views, whose product is 1, and 1 where too few colours are
    /// known.
    #[must_use]
    pub fn measure(colours: &TrackColours) -> (Self, Vec<[f32; 3]>) {
        let known: Vec<usize> = (0..colours.views()).filter(|&view| colours.knows(view)).collect();
        let mean = |of: &dyn Fn([f32; 3]) -> [f64; 3]| {
            let mut mean = [0.0; 3];
            for &view in &known {
                let gains = of(colours.gains(view));
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
            .map(|view| match colours.knows(view) {
                true => std::array::from_fn(|channel| {
                    (f64::from(colours.gains(view)[channel]) / factor[channel]) as f32
                }),
                false => [1.0; 3],
            })
            .collect();
        let (mut alike, mut with_gains, mut own) = (Vec::new(), Vec::new(), Vec::new());
        let mut tracks = 0;
        for (place, seen) in colours.by_track().enumerate() {
            tracks += 1;
            let fitted = colours.reference(place);
            for (channel, fitted) in fitted.iter().enumerate() {
                own.clear();
                own.extend(seen.iter().map(|colour| f32::from(colour.centre[channel])));
                let plain = median(&mut own);
                for colour in seen.iter().filter(|colour| colours.knows(colour.view as usize)) {
                    let value = f32::from(colour.centre[channel]);
                    let gain = colours.gains(colour.view as usize)[channel];
                    alike.push((value - plain).abs());
                    with_gains.push((value - fitted * gain).abs());
                }
            }
        }
        let found = Self {
            tracks,
            views: known.len(),
            stops: (squares.iter().sum::<f64>() / 3.0).sqrt(),
            alike: f64::from(median(&mut alike)),
            with_gains: f64::from(median(&mut with_gains)),
        };
        (found, gains)
    }

    /// Whether exposures are to be learned; `None` if too few tracks or views are known to say.
    #[must_use]
    pub fn decides(&self, views: usize) -> Option<bool> {
        let is_enough = self.tracks >= MIN_TRACKS && 2 * self.views > views;
        let differ = self.stops >= MIN_STOPS && self.with_gains <= MOST_LEFT * self.alike;
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
            assert_eq!(found.decides(10), expected, "{found:?}");
        }
    }
}
