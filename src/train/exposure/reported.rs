//! Exposures that cameras report in EXIF, held against the colours of tracks.
//!
//! Tracks measure what a photograph shows, white balance included; EXIF knows exposure alone, and not what the
//! camera or a program did to the picture afterwards. So EXIF stands in for tracks where these say nothing of a
//! photograph, and is not believed where the two contradict each other.

use densify_data::track_colours::exposures::STOPS;

/// Fewest photographs of which both must be known to compare them.
const MIN_COMPARED: usize = 3;
/// Largest difference between the two, as a share of the larger spread.
const MOST_APART: f64 = 0.5;
/// A difference that is believed however small the spread `[stops]`.
const NO_CONTRADICTION: f64 = 0.3;

/// What became of the exposures that are reported.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Believed {
    /// None is needed or usable.
    Nothing,
    /// So many views begin with them.
    Views(usize),
    /// None: they contradict tracks by so much (root mean square).
    Contradicted {
        /// `[stops]`.
        by: f64,
    },
}

/// Completes gains, which are `known` of some views by their tracks' colours, with the exposures that others
/// report `[stops]`; the mean over all of which anything is known becomes 1.
///
/// # Panics
/// When the three are not of as many views.
pub fn complete(gains: &mut [[f32; 3]], known: &[bool], stops: &[Option<f64>]) -> Believed {
    assert!(gains.len() == known.len() && known.len() == stops.len(), "views differ");
    let by_tracks = |view: usize| {
        let sum: f64 = gains[view].iter().map(|&gain| f64::from(gain).log2()).sum();
        STOPS * sum / 3.0
    };
    let both = (0..known.len()).filter(|&view| known[view]);
    let both: Vec<(f64, f64)> =
        both.filter_map(|view| Some((by_tracks(view), stops[view]?))).collect();
    let offset = if known.contains(&true) {
        let apart = spread(both.iter().map(|(tracks, exif)| exif - tracks));
        let [tracks, exif] =
            [spread(both.iter().map(|pair| pair.0)), spread(both.iter().map(|pair| pair.1))];
        if both.len() < MIN_COMPARED {
            return Believed::Nothing;
        }
        if apart > NO_CONTRADICTION.max(MOST_APART * tracks.max(exif)) {
            return Believed::Contradicted { by: apart };
        }
        mean(both.iter().map(|(tracks, exif)| exif - tracks))
    } else {
        mean(stops.iter().copied().flatten())
    };
    let reporting = (0..known.len()).filter(|&view| !known[view]);
    let reporting: Vec<(usize, f64)> =
        reporting.filter_map(|view| Some((view, stops[view]?))).collect();
    if reporting.is_empty() {
        return Believed::Nothing;
    }
    for &(view, stops) in &reporting {
        gains[view] = [((stops - offset) / STOPS).exp2() as f32; 3];
    }
    let told: Vec<usize> =
        (0..known.len()).filter(|&view| known[view] || stops[view].is_some()).collect();
    let log = |gains: &[[f32; 3]], channel: usize| {
        mean(told.iter().map(|&view| f64::from(gains[view][channel]).log2()))
    };
    let middle = [0, 1, 2].map(|channel| log(gains, channel));
    for &view in &told {
        for (gain, middle) in gains[view].iter_mut().zip(middle) {
            *gain = (f64::from(*gain) / middle.exp2()) as f32;
        }
    }
    Believed::Views(reporting.len())
}

/// Root mean square difference from the mean; 0 of nothing.
#[must_use]
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
    fn without_tracks_the_reported_differences_are_begun_with() {
        let mut gains = [[1.0; 3]; 4];
        let stops = [Some(-7.0), Some(-5.0), None, Some(-6.0)];
        assert_eq!(complete(&mut gains, &[false; 4], &stops), Believed::Views(3));
        for (found, expected) in gains.into_iter().zip([-1.0, 1.0, 0.0, 0.0].map(gain)) {
            assert!(near(found, expected), "{found:?} {expected:?}");
        }
    }

    #[test]
    fn views_that_tracks_do_not_know_are_placed_among_those_that_they_do() {
        let tracks = [-1.0, 0.0, 1.0, 0.0];
        let mut gains = tracks.map(gain);
        gains[3] = [1.0; 3];
        // A tenth of a stop of error, and another zero.
        let stops = [Some(4.1), Some(5.0), Some(5.9), Some(6.0)];
        let known = [true, true, true, false];
        assert_eq!(complete(&mut gains, &known, &stops), Believed::Views(1));
        // The fourth lies a stop above the second, and the mean of all four is 1.
        for (found, expected) in gains.into_iter().zip([-1.25, -0.25, 0.75, 0.75].map(gain)) {
            assert!(near(found, expected), "{found:?} {expected:?}");
        }
    }

    #[test]
    fn what_contradicts_tracks_or_cannot_be_compared_changes_nothing() {
        let known = [true, true, true, false];
        let tracks = [-1.0, 0.0, 1.0, 0.0].map(gain);
        for (stops, expected) in [
            ([Some(5.0); 4], true),
            ([Some(6.0), Some(5.0), Some(4.0), Some(5.0)], true),
            ([Some(4.0), None, None, Some(9.0)], false),
            ([Some(4.0), Some(5.0), Some(6.0), None], false),
        ] {
            let mut gains = tracks;
            let found = complete(&mut gains, &known, &stops);
            assert_eq!(matches!(found, Believed::Contradicted { .. }), expected, "{found:?}");
            assert!(expected || found == Believed::Nothing, "{found:?}");
            assert_eq!(gains, tracks);
        }
        // Tracks that show no difference are believed too.
        let mut alike = [[1.0; 3]; 4];
        let stops = [Some(1.0), Some(3.0), Some(5.0), Some(9.0)];
        assert!(matches!(complete(&mut alike, &known, &stops), Believed::Contradicted { .. }));
        assert_eq!(alike, [[1.0; 3]; 4]);
        // Spreads of 0.35 and of 0.24 stops.
        for (apart, expected) in [(0.43, true), (0.3, false)] {
            let stops = [Some(5.0 - apart), Some(5.0), Some(5.0 + apart), Some(5.0)];
            let found = complete(&mut alike.clone(), &known, &stops);
            assert_eq!(matches!(found, Believed::Contradicted { .. }), expected, "{found:?}");
        }
    }
}
