//! Initial exposures from EXIF, verified against the colours of tracks.
//!
//! Track colours measure the actual photograph, including white balance; EXIF knows only the exposure, not later
//! processing by the camera or a program. So EXIF is used only for photographs without track colours, and not at all
//! if it contradicts the track colours of the others.

use densify_data::track_colours::exposures::STOPS;

/// Smallest number of photographs with both EXIF and track colours for a comparison.
const MIN_COMPARED: usize = 3;
/// Largest accepted difference between EXIF and track colours, as a fraction of the larger of their spreads.
const MAX_DIFFERENCE: f64 = 0.5;
/// A difference that is accepted even if the spreads are small `[stops]`.
const NEGLIGIBLE_DIFFERENCE: f64 = 0.3;

/// How exposures from EXIF were used.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ExifUse {
    /// No exposure from EXIF was needed or usable.
    Unused,
    /// Number of views that start with the exposure from EXIF.
    Views(usize),
    /// Not used, because EXIF contradicts the track colours.
    Contradicted {
        /// Root mean square difference `[stops]`.
        by: f64,
    },
}

/// Sets the gains of views without `known` track colours from exposures in EXIF `[stops]`. Afterwards the geometric
/// mean of all gains from track colours or EXIF is 1.
///
/// # Panics
/// When the slices have different lengths.
pub fn complete_gains(gains: &mut [[f32; 3]], known: &[bool], stops: &[Option<f64>]) -> ExifUse {
    assert!(gains.len() == known.len() && known.len() == stops.len(), "views differ");
    let by_tracks = |view: usize| {
        let sum: f64 = gains[view].iter().map(|&gain| f64::from(gain).log2()).sum();
        STOPS * sum / 3.0
    };
    let views = (0..known.len()).filter(|&view| known[view]);
    let pairs: Vec<(f64, f64)> =
        views.filter_map(|view| Some((by_tracks(view), stops[view]?))).collect();
    let offset = if known.contains(&true) {
        let difference = spread(pairs.iter().map(|(tracks, exif)| exif - tracks));
        let [tracks, exif] =
            [spread(pairs.iter().map(|pair| pair.0)), spread(pairs.iter().map(|pair| pair.1))];
        if pairs.len() < MIN_COMPARED {
            return ExifUse::Unused;
        }
        if difference > NEGLIGIBLE_DIFFERENCE.max(MAX_DIFFERENCE * tracks.max(exif)) {
            return ExifUse::Contradicted { by: difference };
        }
        mean(pairs.iter().map(|(tracks, exif)| exif - tracks))
    } else {
        mean(stops.iter().copied().flatten())
    };
    let reporting = (0..known.len()).filter(|&view| !known[view]);
    let reporting: Vec<(usize, f64)> =
        reporting.filter_map(|view| Some((view, stops[view]?))).collect();
    if reporting.is_empty() {
        return ExifUse::Unused;
    }
    for &(view, stops) in &reporting {
        gains[view] = [((stops - offset) / STOPS).exp2() as f32; 3];
    }
    let with_gains: Vec<usize> =
        (0..known.len()).filter(|&view| known[view] || stops[view].is_some()).collect();
    let log = |gains: &[[f32; 3]], channel: usize| {
        mean(with_gains.iter().map(|&view| f64::from(gains[view][channel]).log2()))
    };
    let middle = [0, 1, 2].map(|channel| log(gains, channel));
    for &view in &with_gains {
        for (gain, middle) in gains[view].iter_mut().zip(middle) {
            *gain = (f64::from(*gain) / middle.exp2()) as f32;
        }
    }
    ExifUse::Views(reporting.len())
}

/// Root mean square difference from the mean; 0 without values.
pub fn spread(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let middle = mean(values.clone());
    mean(values.map(|value| (value - middle).powi(2))).sqrt()
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
    if count > 0.0 { sum / count } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gain(stops: f64) -> [f32; 3] {
        [(stops / STOPS).exp2() as f32; 3]
    }

    fn near(found: [f32; 3], expected: [f32; 3]) -> bool {
        found.iter().zip(expected).all(|(found, expected)| (found / expected - 1.0).abs() < 1e-5)
    }

    #[test]
    fn without_tracks_gains_follow_exif() {
        let mut gains = [[1.0; 3]; 4];
        let stops = [Some(-7.0), Some(-5.0), None, Some(-6.0)];
        assert_eq!(complete_gains(&mut gains, &[false; 4], &stops), ExifUse::Views(3));
        for (found, expected) in gains.into_iter().zip([-1.0, 1.0, 0.0, 0.0].map(gain)) {
            assert!(near(found, expected), "{found:?} {expected:?}");
        }
    }

    #[test]
    fn exif_fills_in_views_without_track_colours() {
        let tracks = [-1.0, 0.0, 1.0, 0.0];
        let mut gains = tracks.map(gain);
        gains[3] = [1.0; 3];
        // EXIF is off by up to a tenth of a stop, and has another zero point.
        let stops = [Some(4.1), Some(5.0), Some(5.9), Some(6.0)];
        let known = [true, true, true, false];
        assert_eq!(complete_gains(&mut gains, &known, &stops), ExifUse::Views(1));
        // By EXIF the fourth gain is a stop above the second, and the mean of all four gains is 1.
        for (found, expected) in gains.into_iter().zip([-1.25, -0.25, 0.75, 0.75].map(gain)) {
            assert!(near(found, expected), "{found:?} {expected:?}");
        }
    }

    #[test]
    fn contradicting_or_incomparable_exif_changes_nothing() {
        let known = [true, true, true, false];
        let tracks = [-1.0, 0.0, 1.0, 0.0].map(gain);
        for (stops, expected) in [
            ([Some(5.0); 4], true),
            ([Some(6.0), Some(5.0), Some(4.0), Some(5.0)], true),
            ([Some(4.0), None, None, Some(9.0)], false),
            ([Some(4.0), Some(5.0), Some(6.0), None], false),
        ] {
            let mut gains = tracks;
            let found = complete_gains(&mut gains, &known, &stops);
            assert_eq!(matches!(found, ExifUse::Contradicted { .. }), expected, "{found:?}");
            assert!(expected || found == ExifUse::Unused, "{found:?}");
            assert_eq!(gains, tracks);
        }
        // Track colours without differences also contradict EXIF.
        let mut alike = [[1.0; 3]; 4];
        let stops = [Some(1.0), Some(3.0), Some(5.0), Some(9.0)];
        assert!(matches!(complete_gains(&mut alike, &known, &stops), ExifUse::Contradicted { .. }));
        assert_eq!(alike, [[1.0; 3]; 4]);
        // EXIF spreads of 0.35 and 0.24 stops.
        for (apart, expected) in [(0.43, true), (0.3, false)] {
            let stops = [Some(5.0 - apart), Some(5.0), Some(5.0 + apart), Some(5.0)];
            let found = complete_gains(&mut alike.clone(), &known, &stops);
            assert_eq!(matches!(found, ExifUse::Contradicted { .. }), expected, "{found:?}");
        }
    }
}
