//! Decides before training whether a camera loses light towards the edges of its pictures, from the colours of tracks.
//!
//! The logarithm of a colour is that of the point, plus that of the view's exposure, plus that of V(r). By weighted
//! least squares, one number b is fitted for each camera, log₂V = −b·r², after the means of points and views have been
//! subtracted. So only tracks count that a camera has seen at different radii: where each point keeps its radius, a
//! vignette cannot be told from the points' colours.

use serde::{Deserialize, Serialize};

use super::colours::{Observation, TRUSTED};
use super::{MIN_TRACKS, TrackColours};
use crate::dataset::{MIN_VIEWS, Tracks, View};
use densify_core::vignette::{self, COEFFICIENTS, CURVE_OFFSET, PhotographPlace};

/// Smallest loss of light at which a vignette is learned `[stops at the corner of a 4:3 photograph]`; see
/// docs/studies/vignette.tsv.
pub const MIN_STOPS: f64 = 0.25;
/// A loss counts only if it is this many times its standard error.
const MIN_SIGNIFICANCE: f64 = 3.0;
/// Smallest spread of r² within tracks. In views of a room it is 0.09.
const MIN_SPREAD: f64 = 0.02;
/// r² at the corner of a 4:3 photograph.
const CORNER: f64 = vignette::CORNER as f64;
/// Rounds of fitting, each with weights by the residuals of the one before.
const ROUNDS: usize = 6;
/// Sweeps of subtracting the means of tracks and views. Each reduces what is left of the other's mean by a factor of
/// about three.
const SWEEPS: usize = 12;
/// Standard deviation of a colour on an even surface `[stops]`: a step of eight bits in the middle greys, and noise.
const NOISE: f64 = 0.05;
/// Residuals of this many standard deviations have half the weight (Cauchy).
const HALF_WEIGHT: f64 = 2.385;

/// The evidence for the vignette of a camera.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VignetteSpread {
    /// Number of tracks that the camera sees in enough views.
    pub tracks: usize,
    /// Number of these views.
    pub views: usize,
    /// Root mean square spread of r² within tracks.
    pub spread: f64,
    /// Light lost at the corner of a 4:3 photograph `[stops]`.
    pub stops: f64,
    /// Its standard error, with residuals that are correlated within tracks `[stops]`.
    pub error: f64,
}

impl VignetteSpread {
    /// True if a vignette should be learned; `None` if there is too little evidence for a decision.
    pub fn decision(&self) -> Option<bool> {
        let is_enough = self.tracks >= MIN_TRACKS && self.spread >= MIN_SPREAD;
        is_enough.then_some(self.stops >= MIN_STOPS && self.stops >= MIN_SIGNIFICANCE * self.error)
    }

    /// True if a vignette should be learned.
    pub fn is_found(&self) -> bool {
        self.decision() == Some(true)
    }

    /// The coefficients of V that agree best with the loss.
    pub fn coefficients(&self) -> [f32; COEFFICIENTS] {
        polynomial(self.stops / CORNER)
    }
}

/// Peak memory for [`measure`] `[bytes]`.
pub fn bytes(tracks: &Tracks) -> u64 {
    let colours: usize = tracks.views.iter().map(Vec::len).sum();
    let means = tracks.count().max(tracks.views.len()) * size_of::<[f64; 3]>();
    (colours * size_of::<Sample>() + 2 * means) as u64
}

/// A colour of a track.
#[derive(Debug, Clone, Copy)]
struct Sample {
    track: u32,
    view: u32,
    /// r².
    radius: f32,
    /// log₂ of the linear light, mean over the channels.
    light: f32,
    /// Inverse variance by what the colour's neighbourhood shows `[1/stops²]`.
    prior: f32,
    weight: f32,
    /// `light` and `radius` without the means of tracks and views.
    centred: [f32; 2],
}

/// Measures the vignette of each camera. `cameras` has the number of each view's camera, and `places` the place of its
/// pixels, if known. Shape: `[cameras]`.
pub fn measure(
    tracks: &Tracks,
    colours: &TrackColours,
    views: &[View],
    cameras: &[u32],
    places: &[Option<PhotographPlace>],
) -> Vec<VignetteSpread> {
    let count = cameras.iter().max().map_or(0, |last| last + 1);
    let of_camera = |camera: u32| {
        let mut samples = Vec::with_capacity(colours.by_track().map(<[_]>::len).sum());
        for seen in colours.by_track() {
            let start = samples.len();
            samples.extend(seen.iter().filter_map(|colour| {
                let view = colour.view as usize;
                let place = places[view].filter(|_| cameras[view] == camera)?;
                let (pixel, _) =
                    views[view].camera.project(tracks.positions[colour.track as usize]);
                let corner = [pixel.x, pixel.y].map(|x| (x - 0.5) as f32);
                sample(colour, place.squared_radius(corner[0], corner[1]))
            }));
            if samples.len() - start < MIN_VIEWS {
                samples.truncate(start);
            }
        }
        fit(&mut samples, tracks.count(), views.len())
    };
    (0..count).map(of_camera).collect()
}

/// The sample of a colour; `None` if it may be clipped or is mostly noise.
fn sample(colour: &Observation, radius: f32) -> Option<Sample> {
    if !colour.centre.iter().all(|value| TRUSTED.contains(value)) {
        return None;
    }
    let stops = |values: [u8; 3]| {
        let log = |value: u8| 2.4 * (f32::from(value) / 255.0 + CURVE_OFFSET).log2();
        values.map(log).iter().sum::<f32>() / 3.0
    };
    let contrast = f64::from(stops(colour.highest) - stops(colour.lowest));
    Some(Sample {
        track: colour.track,
        view: colour.view,
        radius,
        light: stops(colour.centre),
        prior: (1.0 / (NOISE * NOISE + contrast * contrast)) as f32,
        weight: 0.0,
        centred: [0.0; 2],
    })
}

fn fit(samples: &mut [Sample], tracks: usize, views: usize) -> VignetteSpread {
    let mut slope = 0.0;
    for sample in &mut *samples {
        sample.weight = sample.prior;
    }
    for round in 0..ROUNDS {
        centre(samples, tracks, views);
        let [mut by_light, mut by_radius] = [0.0, 0.0];
        for Sample { weight, centred: [light, radius], .. } in &*samples {
            let (weight, radius) = (f64::from(*weight), f64::from(*radius));
            by_light += weight * radius * f64::from(*light);
            by_radius += weight * radius * radius;
        }
        slope = if by_radius > 0.0 { by_light / by_radius } else { 0.0 };
        if round + 1 < ROUNDS {
            reweight(samples, slope);
        }
    }
    let (mut weights, mut squares, mut scores, mut count) = (0.0, 0.0, 0.0, 0);
    let mut is_seen = vec![false; views];
    for seen in samples.chunk_by(|a, b| a.track == b.track) {
        let mut score = 0.0;
        for sample in seen {
            let (weight, radius) = (f64::from(sample.weight), f64::from(sample.centred[1]));
            weights += weight;
            squares += weight * radius * radius;
            score += weight * radius * residual(sample, slope);
            is_seen[sample.view as usize] = true;
        }
        scores += score * score;
        count += 1;
    }
    let share = |sum: f64, of: f64| if of > 0.0 { sum / of } else { 0.0 };
    VignetteSpread {
        tracks: count,
        views: is_seen.iter().filter(|&&seen| seen).count(),
        spread: share(squares, weights).sqrt(),
        stops: -slope * CORNER,
        error: share(scores.sqrt(), squares) * CORNER,
    }
}

fn residual(sample: &Sample, slope: f64) -> f64 {
    f64::from(sample.centred[0]) - slope * f64::from(sample.centred[1])
}

/// Weights samples by their residuals in units of their prior standard deviation.
fn reweight(samples: &mut [Sample], slope: f64) {
    let scaled = |sample: &Sample| residual(sample, slope) * f64::from(sample.prior).sqrt();
    let mut sizes: Vec<f32> = samples.iter().map(|s| scaled(s).abs() as f32).collect();
    let deviation = 1.4826 * f64::from(super::median(&mut sizes));
    // Without noise, all residuals are equal up to rounding.
    let half = HALF_WEIGHT * deviation.max(1e-3);
    for sample in samples {
        let relative = scaled(sample) / half;
        sample.weight = (f64::from(sample.prior) / (1.0 + relative * relative)) as f32;
    }
}

/// Subtracts the weighted means of tracks and of views.
fn centre(samples: &mut [Sample], tracks: usize, views: usize) {
    for sample in &mut *samples {
        sample.centred = [sample.light, sample.radius];
    }
    let mut means = vec![[0.0_f64; 3]; tracks.max(views)];
    for sweep in 0..2 * SWEEPS {
        let group = |sample: &Sample| {
            if sweep % 2 == 0 { sample.view as usize } else { sample.track as usize }
        };
        means.fill([0.0; 3]);
        for sample in &*samples {
            let weight = f64::from(sample.weight);
            let mean = &mut means[group(sample)];
            mean[0] += weight * f64::from(sample.centred[0]);
            mean[1] += weight * f64::from(sample.centred[1]);
            mean[2] += weight;
        }
        for sample in &mut *samples {
            let [light, radius, weight] = means[group(sample)];
            sample.centred[0] -= (light / weight) as f32;
            sample.centred[1] -= (radius / weight) as f32;
        }
    }
}

/// The coefficients of V(r) that agree best with 2^(−b·r²) up to the corner of a square.
fn polynomial(b: f64) -> [f32; COEFFICIENTS] {
    /// r² at the corner of a square, and the number of places compared.
    const LARGEST: f64 = 0.5;
    const PLACES: u32 = 50;
    let (mut matrix, mut vector) = (glam::DMat3::ZERO, glam::DVec3::ZERO);
    for i in 1..=PLACES {
        let s = LARGEST * f64::from(i) / f64::from(PLACES);
        let powers = glam::DVec3::new(s, s * s, s * s * s);
        matrix += glam::DMat3::from_cols(powers * powers.x, powers * powers.y, powers * powers.z);
        vector += powers * ((-b * s).exp2() - 1.0);
    }
    (matrix.inverse() * vector).as_vec3().to_array()
}

#[cfg(test)]
mod tests {
    use super::*;
    use densify_core::vignette::light;

    /// Tracks at random radii, with colours, exposures and a vignette of `b` stops per r²; every ninth sample is an
    /// outlier. `still` tracks keep their radius.
    fn made(b: f64, still: bool) -> Vec<Sample> {
        let random = |a: u32, b: u32| {
            let mixed = (a.wrapping_mul(0x9e37_79b9) ^ b.wrapping_mul(0x85eb_ca6b))
                .wrapping_mul(0xc2b2_ae35);
            f64::from((mixed ^ mixed >> 15) % 1000) / 1000.0
        };
        let mut samples = Vec::new();
        for track in 0..600 {
            for view in 0..8 {
                let radius = 0.45 * random(track, if still { 99 } else { view });
                let light = 2.0 * random(track, 50) - 0.3 * f64::from(view % 3) - b * radius
                    + 0.02 * (random(track + 7000, view) - 0.5)
                    - if (track + view) % 9 == 0 { 1.5 } else { 0.0 };
                samples.push(Sample {
                    track,
                    view,
                    radius: radius as f32,
                    light: light as f32,
                    prior: 400.0,
                    weight: 0.0,
                    centred: [0.0; 2],
                });
            }
        }
        samples
    }

    #[test]
    fn a_vignette_is_found_despite_exposures_and_outliers() {
        for b in [0.0, 0.8, 2.5] {
            let found = fit(&mut made(b, false), 600, 8);
            assert!((found.stops - b * CORNER).abs() < 0.02, "{b}: {found:?}");
            assert!(found.error < 0.01 && found.spread > 0.1, "{found:?}");
            assert_eq!((found.tracks, found.views), (600, 8));
            assert_eq!(found.decision(), Some(b > 0.0), "{found:?}");
        }
    }

    #[test]
    fn points_that_keep_their_radius_decide_nothing() {
        let found = fit(&mut made(2.5, true), 600, 8);
        assert!(found.spread < MIN_SPREAD && found.decision().is_none(), "{found:?}");
        assert_eq!(fit(&mut [], 0, 0).decision(), None);
    }

    #[test]
    fn decisions_need_tracks_light_and_significance() {
        let enough = VignetteSpread {
            tracks: MIN_TRACKS,
            views: 6,
            spread: MIN_SPREAD,
            stops: MIN_STOPS,
            error: MIN_STOPS / 3.01,
        };
        for (found, expected) in [
            (enough, Some(true)),
            (VignetteSpread { stops: 0.99 * MIN_STOPS, error: 0.0, ..enough }, Some(false)),
            (VignetteSpread { error: MIN_STOPS / 2.99, ..enough }, Some(false)),
            (VignetteSpread { tracks: MIN_TRACKS - 1, ..enough }, None),
            (VignetteSpread { spread: 0.99 * MIN_SPREAD, ..enough }, None),
        ] {
            assert_eq!(found.decision(), expected, "{found:?}");
        }
    }

    #[test]
    fn the_polynomial_follows_the_fitted_loss() {
        for b in [0.5, 2.0, 4.0] {
            let found = polynomial(b);
            for i in 0..=20 {
                let s = 0.025 * f64::from(i);
                let error = f64::from(light(found, s as f32)) - (-b * s).exp2();
                assert!(error.abs() < 0.005, "{b}, {s}: {error}");
            }
        }
    }
}
