//! Fits the scale and offset of relative inverse depth to the points that each view sees.

use super::super::normalise::median;
use super::super::{LoadError, Note};
use super::Meaning;
use super::agreement::{SeenPoint, seen_points};
use super::decide::{Scene, refused};
use crate::error::DepthRemedy;

/// A relative map needs this many points; its scale must be within this range of multiples of the median.
const FIT_POINTS: usize = 10;
const FIT_SCALES: [f64; 2] = [0.2, 5.0];
/// Repetitions of the fit, each with the pairs whose errors are at most this multiple of the median error.
const FIT_ROUNDS: usize = 4;
const FIT_WIDTH: f64 = 2.0;

/// Fits scale and offset of each view's relative map to the points that the view sees. Views whose fit is unreliable lose their depth.
pub(super) fn fit_views(scene: &mut Scene<'_>, notes: &mut Vec<Note>) -> Result<(), LoadError> {
    let to_scene = scene.normalisation.scale;
    let mut fits = Vec::new();
    for view in scene.train.iter() {
        let Some(depth) = &view.source.depth else {
            fits.push(None);
            continue;
        };
        let sampled = depth.sampled(&view.source)?;
        let width = view.camera.width as usize;
        let pairs: Vec<[f64; 2]> = seen_points(&scene.points.positions, &view.camera)
            .into_iter()
            .filter_map(|SeenPoint { pixel, depth }| {
                let at = pixel.y as usize * width + pixel.x as usize;
                let is_counted = sampled.inverse[at].is_finite() && sampled.confidence[at] > 0;
                is_counted.then(|| [f64::from(sampled.inverse[at]), 1.0 / depth])
            })
            .collect();
        fits.push(fit(&pairs));
    }
    let middle = typical_scale(fits.iter().flatten().map(|fit| fit[0]))?;
    let mut dropped = 0;
    for (view, fit) in scene.train.iter_mut().zip(fits) {
        let Some(depth) = &mut view.source.depth else { continue };
        match fit {
            Some([s, t]) if (FIT_SCALES[0] * middle..=FIT_SCALES[1] * middle).contains(&s) => {
                depth.meaning = Meaning::Inverse([s * to_scene, t * to_scene]);
            }
            _ => {
                view.source.depth = None;
                dropped += 1;
            }
        }
    }
    if dropped > 0 {
        notes.push(Note::Text(format!(
            "the relative depth of {dropped} views could not be fitted to their points, and is not used"
        )));
    }
    Ok(())
}

/// The median of the positive scales.
fn typical_scale(scales: impl Iterator<Item = f64>) -> Result<f64, LoadError> {
    let (positive, others): (Vec<f64>, Vec<f64>) = scales.partition(|scale| *scale > 0.0);
    if others.len() > positive.len() {
        let problem =
            "the values grow where the points are farther away: they are depth, not inverse depth";
        return Err(refused(problem.to_owned(), DepthRemedy::NotRelative));
    }
    median(positive).ok_or_else(|| {
        let problem = format!(
            "relative depth needs {FIT_POINTS} points in each view to fit its scale and offset, but no view sees them"
        );
        refused(problem, DepthRemedy::MorePoints)
    })
}

/// Scale and offset that map the first numbers to the second; the scale is negative if one falls where the other grows.
///
/// Some pairs are points that the view does not see. The fit therefore starts with the median of the slopes between
/// distant pairs, and is repeated with the pairs that it describes best, by least squares.
fn fit(pairs: &[[f64; 2]]) -> Option<[f64; 2]> {
    if pairs.len() < FIT_POINTS {
        return None;
    }
    let mut sorted = pairs.to_vec();
    sorted.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let (low, high) = sorted.split_at(sorted.len() / 2);
    let slopes = low.iter().zip(high).filter(|(a, b)| b[0] > a[0]);
    let mut scale = median(slopes.map(|(a, b)| (b[1] - a[1]) / (b[0] - a[0])).collect())?;
    let mut offset = median(pairs.iter().map(|[a, b]| b - scale * a).collect())?;
    for _ in 0..FIT_ROUNDS {
        let error = |[a, b]: &[f64; 2]| (b - scale * a - offset).abs();
        let limit = FIT_WIDTH * median(pairs.iter().map(error).collect())?;
        let kept: Vec<[f64; 2]> =
            pairs.iter().filter(|&pair| error(pair) <= limit).copied().collect();
        let count = kept.len() as f64;
        let mean = |number: usize| kept.iter().map(|pair| pair[number]).sum::<f64>() / count;
        let means = [mean(0), mean(1)];
        let moment = |x: usize, y: usize| -> f64 {
            kept.iter().map(|pair| (pair[x] - means[x]) * (pair[y] - means[y])).sum()
        };
        scale = moment(0, 1) / moment(0, 0);
        offset = means[1] - scale * means[0];
    }
    (scale.is_finite() && offset.is_finite()).then_some([scale, offset])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::LoadRemedy;

    #[test]
    fn scales_of_the_wrong_sign_do_not_move_the_typical_one() {
        let typical = |scales: &[f64]| typical_scale(scales.iter().copied());
        assert_eq!(typical(&[-3.0, 2.0, -1.0, 2.5, 2.2, -9.0]), Ok(2.2));
        let remedy = |scales: &[f64]| match typical(scales) {
            Err(LoadError::Remedied { remedy: LoadRemedy::Depth(remedy), .. }) => Some(remedy),
            _ => None,
        };
        assert_eq!(remedy(&[-3.0, 2.0, -1.0]), Some(DepthRemedy::NotRelative));
        assert_eq!(remedy(&[]), Some(DepthRemedy::MorePoints));
    }

    #[test]
    fn relative_depth_is_fitted_with_the_sign_of_the_relation() {
        // A quarter of the points is hidden behind what the map shows.
        let hidden = |i: i32| if i % 4 == 0 { 30.0 } else { 0.0 };
        let pairs = |s: f64| -> Vec<[f64; 2]> {
            (0..21).map(|i| [f64::from(i), s * f64::from(i) + 3.0 + hidden(i)]).collect()
        };
        for s in [0.5, -2.0] {
            let [scale, offset] = fit(&pairs(s)).unwrap();
            assert!((scale - s).abs() < 1e-9 && (offset - 3.0).abs() < 1e-9, "{scale} {offset}");
        }
        assert_eq!(fit(&pairs(1.0)[..9]), None);
        assert_eq!(fit(&[[1.0, 2.0]; 12]), None, "a constant map has no scale");
    }
}
