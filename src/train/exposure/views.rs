//! The exposures of the training views, learned beside the model.
//!
//! A brighter model and darker exposures show the same, so the mean over the views stays what it was at the
//! start: what is learned of a view is its difference from the mean. A weak pull to the identity decides what
//! its photographs do not. A view steps when its photograph is trained on, with moments of its own; the host
//! does it, in a fixed order, so that runs repeat.

use serde::{Deserialize, Serialize};

use super::ExposureModel;
use densify_core::colour::{ColourGradient, ColourTransform};

/// Numbers of a transform: three rows of a matrix and an offset.
const NUMBERS: usize = 12;
/// Step sizes at the start of a run, of which a tenth is left at its end.
const RATE: f64 = 0.01;
const FADE: f64 = 0.1;
/// Share of the matrix's step sizes for offsets, whose range is that much smaller: those of exposures within
/// a stop are below 0.02.
const OFFSET_SHARE: f64 = 0.2;
/// Adam's decay rates. A view has a few hundred steps, not the thousands of a Gaussian, and its gradients
/// fall by orders of magnitude: its second moment must forget the first of them.
const BETA1: f32 = 0.9;
const BETA2: f32 = 0.99;
/// Below every gradient that matters: a hundredth of a photograph's pixels off by one step of eight bits.
const EPSILON: f32 = 1e-8;
/// Weight of the squared differences from the identity in the loss. The loss itself rises by about five times
/// the square of an error in a factor, so that this moves no factor by more than a five-hundredth of its
/// difference from 1.
const PULL: f32 = 0.005;

/// The exposures of all training views.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Exposures {
    model: ExposureModel,
    /// Mean difference of the views from the identity, which stays: near 0. Shape: `[12]`.
    mean: [f32; NUMBERS],
    views: Vec<ViewExposure>,
}

/// What is learned of a view.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ViewExposure {
    /// Difference from the identity, before the mean over the views is brought to that of the start: the matrix
    /// row by row, then the offset. Shape: `[12]`.
    values: [f32; NUMBERS],
    /// Adam's moments. Shape: `[12]` each.
    first: [f32; NUMBERS],
    second: [f32; NUMBERS],
    /// Steps so far.
    age: u16,
}

impl Exposures {
    /// Exposures that begin with a factor per view and channel.
    #[must_use]
    pub fn new(model: ExposureModel, gains: &[[f32; 3]]) -> Self {
        let view = |gains: &[f32; 3]| {
            let mut values = [0.0; NUMBERS];
            for (channel, gain) in gains.iter().enumerate() {
                values[4 * channel] = gain - 1.0;
            }
            ViewExposure { values, first: [0.0; NUMBERS], second: [0.0; NUMBERS], age: 0 }
        };
        let views: Vec<_> = gains.iter().map(view).collect();
        let mean = mean(&views).map(|mean| mean as f32);
        Self { model, mean, views }
    }

    /// What they take on the host `[bytes]`.
    #[must_use]
    pub fn bytes(views: usize) -> u64 {
        (views * size_of::<ViewExposure>()) as u64
    }

    /// Number of views.
    #[must_use]
    pub fn count(&self) -> usize {
        self.views.len()
    }

    /// How a view is exposed.
    #[must_use]
    pub fn of(&self, view: usize) -> ColourTransform {
        let values = self.difference(view);
        let mut transform = ColourTransform::IDENTITY;
        let numbers = transform.matrix.as_flattened_mut().iter_mut().chain(&mut transform.offset);
        for (number, value) in numbers.zip(values) {
            *number += value;
        }
        transform
    }

    /// A view's difference from the identity.
    fn difference(&self, view: usize) -> [f32; NUMBERS] {
        let moved = mean(&self.views);
        let own = &self.views[view].values;
        std::array::from_fn(|i| (f64::from(own[i]) - moved[i] + f64::from(self.mean[i])) as f32)
    }

    /// One step of a view, at this share of the run. A gradient that is not finite changes nothing.
    pub fn step(&mut self, view: usize, gradient: &ColourGradient, progress: f64) {
        let difference = self.difference(view);
        let mut numbers = [0.0; NUMBERS];
        let given = gradient.matrix.as_flattened().iter().chain(&gradient.offset);
        for (number, given) in numbers.iter_mut().zip(given) {
            *number = *given;
        }
        if numbers.iter().any(|number| !number.is_finite()) {
            return;
        }
        let rate = RATE * FADE.powf(progress.clamp(0.0, 1.0));
        let model = self.model;
        let view = &mut self.views[view];
        view.age = view.age.saturating_add(1);
        let age = i32::from(view.age);
        let [of_first, of_second] = [BETA1, BETA2].map(|beta| 1.0 / (1.0 - beta.powi(age)));
        for i in (0..NUMBERS).filter(|&i| is_learned(model, i)) {
            let share = if i < 9 { 1.0 } else { OFFSET_SHARE };
            let g = numbers[i] + 2.0 * PULL * difference[i];
            view.first[i] = view.first[i] * BETA1 + g * (1.0 - BETA1);
            view.second[i] = view.second[i] * BETA2 + g * g * (1.0 - BETA2);
            let step = view.first[i] * of_first / ((view.second[i] * of_second).sqrt() + EPSILON);
            view.values[i] -= (rate * share) as f32 * step;
        }
    }

    /// Whether these are exposures of as many views, of finite numbers, by the same model.
    ///
    /// # Errors
    /// What is wrong.
    pub fn check_like(&self, other: &Self) -> Result<(), String> {
        let (found, expected) = (self.views.len(), other.views.len());
        if found != expected || self.model != other.model {
            return Err(format!(
                "its exposures are of {found} views ({:?}); this run has {expected} ({:?})",
                self.model, other.model
            ));
        }
        let numbers = |view: &ViewExposure| [view.values, view.first, view.second].concat();
        match self.views.iter().flat_map(numbers).chain(self.mean).all(f32::is_finite) {
            true => Ok(()),
            false => Err("its exposures hold a number that is not finite".to_owned()),
        }
    }
}

/// Mean of the views' values, in their order.
fn mean(views: &[ViewExposure]) -> [f64; NUMBERS] {
    let mut sums = [0.0; NUMBERS];
    for view in views {
        for (sum, value) in sums.iter_mut().zip(view.values) {
            *sum += f64::from(value);
        }
    }
    sums.map(|sum| sum / views.len().max(1) as f64)
}

/// Whether a number is learned: with one factor per channel only the diagonal is, beside the offsets.
fn is_learned(model: ExposureModel, number: usize) -> bool {
    model == ExposureModel::Matrix || number >= 9 || number.is_multiple_of(4)
}

/// The exposures by the names of their views, as JSON: three rows of four numbers each, which take a colour of
/// the model, with a 1 after it, to the photograph's.
pub fn named_transforms<'a>(
    exposures: &Exposures,
    names: impl Iterator<Item = &'a str>,
) -> serde_json::Map<String, serde_json::Value> {
    let named = names.enumerate().take(exposures.count());
    named
        .map(|(view, name)| (name.to_owned(), serde_json::json!(exposures.of(view).rows())))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mean(exposures: &Exposures) -> [f32; 2] {
        let n = exposures.count() as f32;
        let all: Vec<_> = (0..exposures.count()).map(|view| exposures.of(view)).collect();
        [
            all.iter().map(|t| t.matrix[1][1]).sum::<f32>() / n,
            all.iter().map(|t| t.offset[1]).sum::<f32>() / n,
        ]
    }

    /// The derivative of half the squared distance to `to`, whose step is therefore back to it.
    fn towards(to: &ColourTransform, at: &ColourTransform) -> ColourGradient {
        let matrix =
            std::array::from_fn(|i| std::array::from_fn(|j| at.matrix[i][j] - to.matrix[i][j]));
        let offset = std::array::from_fn(|i| at.offset[i] - to.offset[i]);
        ColourGradient { matrix, offset }
    }

    #[test]
    fn exposures_are_learned_and_their_mean_stays() {
        let mut exposures = Exposures::new(ExposureModel::Channels, &[[1.2, 1.0, 0.9]; 2]);
        assert!((exposures.of(0).matrix[0][0] - 1.2).abs() < 1e-6, "{exposures:?}");
        let mut to = [ColourTransform::IDENTITY; 2];
        for (to, sign) in to.iter_mut().zip([1.0, -1.0]) {
            to.matrix[1][1] += 0.3 * sign;
            to.offset[1] += 0.015 * sign;
            to.matrix[0][0] += 0.2;
            to.matrix[0][1] += 0.5;
        }
        for step in 0..400 {
            let view = step % 2;
            let gradient = towards(&to[view], &exposures.of(view));
            exposures.step(view, &gradient, f64::from(step as u32) / 400.0);
            let [gain, offset] = mean(&exposures);
            assert!((gain - 1.0).abs() < 1e-6 && offset.abs() < 1e-6, "{gain}, {offset}");
        }
        for (view, to) in to.iter().enumerate() {
            let found = exposures.of(view);
            assert!((found.matrix[1][1] - to.matrix[1][1]).abs() < 0.01, "{found:?}");
            assert!((found.offset[1] - to.offset[1]).abs() < 0.002, "{found:?}");
            assert_eq!(found.matrix[0][1].to_bits(), 0, "channels do not mix");
        }
        let before = exposures.clone();
        let nan = ColourGradient { matrix: [[f32::NAN; 3]; 3], offset: [0.0; 3] };
        exposures.step(0, &nan, 0.5);
        assert_eq!(exposures, before);
    }

    #[test]
    fn a_matrix_mixes_channels_where_it_may() {
        let mut exposures = Exposures::new(ExposureModel::Matrix, &[[1.0; 3]; 2]);
        let gradient = ColourGradient { matrix: [[1.0; 3]; 3], offset: [1.0; 3] };
        exposures.step(1, &gradient, 0.0);
        let moved = exposures.of(1);
        assert!(moved.matrix[0][1] < 0.0 && moved.matrix[2][0] < 0.0, "{moved:?}");
    }

    #[test]
    fn exposures_of_another_run_are_refused() {
        let exposures = Exposures::new(ExposureModel::Channels, &[[1.0; 3]; 2]);
        assert_eq!(exposures.check_like(&exposures), Ok(()));
        let more = Exposures::new(ExposureModel::Channels, &[[1.0; 3]; 3]);
        let message = more.check_like(&exposures).unwrap_err();
        assert!(message.contains("3 views") && message.contains("has 2"), "{message}");
        let matrix = Exposures::new(ExposureModel::Matrix, &[[1.0; 3]; 2]);
        assert!(matrix.check_like(&exposures).is_err());
        let broken = Exposures::new(ExposureModel::Channels, &[[1.0; 3], [f32::NAN; 3]]);
        assert!(broken.check_like(&exposures).unwrap_err().contains("not finite"));
    }

    #[test]
    fn what_is_written_is_read_back_to_the_bit() {
        let mut exposures = Exposures::new(ExposureModel::Channels, &[[1.1, 0.9, 1.0 / 3.0]; 3]);
        let gradient = ColourGradient { matrix: [[0.123_456_7; 3]; 3], offset: [-0.7; 3] };
        exposures.step(1, &gradient, 0.25);
        let text = serde_json::to_string(&exposures).unwrap();
        assert_eq!(serde_json::from_str::<Exposures>(&text).unwrap(), exposures);
    }
}
