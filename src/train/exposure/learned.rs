//! Exposures of the training views, learned together with the model.
//!
//! A brighter model with darker exposures gives the same images, so the views' mean exposure is held constant and only
//! differences from it are learned. A weak regularisation towards the identity fixes what the photographs do not
//! determine. Each view has its own Adam moments and takes a step when its photograph is trained on. The host computes
//! these steps in a fixed order, so that runs are reproducible.

use serde::{Deserialize, Serialize};

use super::ExposureModel;
use crate::adam::Step;
use densify_core::colour::{ColourGradient, ColourTransform};

/// Parameters of a transform: three rows of a matrix and an offset.
const PARAMETERS: usize = 12;
/// Step size at the start of a run.
const RATE: f64 = 0.01;
/// Step size at the end of a run, relative to that at the start.
const FADE: f64 = 0.1;
/// Step size of offsets relative to that of the matrix, because their range is smaller: exposures within a stop have
/// offsets below 0.02.
const OFFSET_SHARE: f64 = 0.2;
/// Weight of the squared differences from the identity in the loss. The rest of the loss rises by about five times the
/// square of an error in a factor, so that the regularisation shifts a factor by less than 1/500 of its difference
/// from 1.
const REGULARISATION: f32 = 0.005;

/// The exposures of all training views.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Exposures {
    model: ExposureModel,
    /// Mean difference of the views' transforms from the identity, near 0; it is held constant. Shape: `[12]`.
    mean: [f32; PARAMETERS],
    views: Vec<ViewExposure>,
}

/// The learned state of a view.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ViewExposure {
    /// Difference from the identity, before the mean is corrected: the matrix row by row, then the offset.
    /// Shape: `[12]`.
    values: [f32; PARAMETERS],
    /// Adam's first moments. Shape: `[12]`.
    first: [f32; PARAMETERS],
    /// Adam's second moments. Shape: `[12]`.
    second: [f32; PARAMETERS],
    /// Number of steps so far.
    age: u16,
}

impl Exposures {
    /// Exposures that start with a gain per view and channel.
    pub fn new(model: ExposureModel, gains: &[[f32; 3]]) -> Self {
        let view = |gains: &[f32; 3]| {
            let mut values = [0.0; PARAMETERS];
            for (channel, gain) in gains.iter().enumerate() {
                values[4 * channel] = gain - 1.0;
            }
            ViewExposure { values, first: [0.0; PARAMETERS], second: [0.0; PARAMETERS], age: 0 }
        };
        let views: Vec<_> = gains.iter().map(view).collect();
        let mean = mean(&views).map(|mean| mean as f32);
        Self { model, mean, views }
    }

    /// Memory on the host `[bytes]`.
    pub fn bytes(views: usize) -> u64 {
        (views * size_of::<ViewExposure>()) as u64
    }

    /// Number of views.
    pub fn count(&self) -> usize {
        self.views.len()
    }

    /// The exposure of a view.
    pub fn transform(&self, view: usize) -> ColourTransform {
        let values = self.difference(view);
        let mut transform = ColourTransform::IDENTITY;
        let numbers = transform.matrix.as_flattened_mut().iter_mut().chain(&mut transform.offset);
        for (number, value) in numbers.zip(values) {
            *number += value;
        }
        transform
    }

    /// A view's difference from the identity, after the mean is corrected.
    fn difference(&self, view: usize) -> [f32; PARAMETERS] {
        let mean = mean(&self.views);
        let own = &self.views[view].values;
        std::array::from_fn(|i| (f64::from(own[i]) - mean[i] + f64::from(self.mean[i])) as f32)
    }

    /// Takes an Adam step for a view; `progress` is the elapsed fraction of the run. Non-finite gradients are ignored.
    pub fn step(&mut self, view: usize, gradient: &ColourGradient, progress: f64) {
        let difference = self.difference(view);
        let mut numbers = [0.0; PARAMETERS];
        let values = gradient.matrix.as_flattened().iter().chain(&gradient.offset);
        for (number, value) in numbers.iter_mut().zip(values) {
            *number = *value;
        }
        if numbers.iter().any(|number| !number.is_finite()) {
            return;
        }
        let rate = RATE * FADE.powf(progress.clamp(0.0, 1.0));
        let model = self.model;
        let view = &mut self.views[view];
        view.age = view.age.saturating_add(1);
        let adam = Step::new(view.age.into());
        for i in (0..PARAMETERS).filter(|&i| is_learned(model, i)) {
            let share = if i < 9 { 1.0 } else { OFFSET_SHARE };
            let g = numbers[i] + 2.0 * REGULARISATION * difference[i];
            let step = adam.take(&mut view.first[i], &mut view.second[i], g);
            view.values[i] -= (rate * share) as f32 * step;
        }
    }

    /// Checks that these saved exposures are finite, and match `other` in model and number of views.
    ///
    /// # Errors
    /// A description of the mismatch.
    pub fn check_matches(&self, other: &Self) -> Result<(), String> {
        let (found, expected) = (self.views.len(), other.views.len());
        if found != expected || self.model != other.model {
            return Err(format!(
                "its exposures are for {found} views ({:?}); this run has {expected} ({:?})",
                self.model, other.model
            ));
        }
        let numbers = |view: &ViewExposure| [view.values, view.first, view.second].concat();
        if self.views.iter().flat_map(numbers).chain(self.mean).all(f32::is_finite) {
            Ok(())
        } else {
            Err("its exposures contain a number that is not finite".to_owned())
        }
    }
}

/// The mean of the views' values, added in their order.
fn mean(views: &[ViewExposure]) -> [f64; PARAMETERS] {
    let mut sums = [0.0; PARAMETERS];
    for view in views {
        for (sum, value) in sums.iter_mut().zip(view.values) {
            *sum += f64::from(value);
        }
    }
    sums.map(|sum| sum / views.len().max(1) as f64)
}

/// True if a parameter is learned. [`ExposureModel::Channels`] learns only the diagonal and the offsets.
fn is_learned(model: ExposureModel, number: usize) -> bool {
    model == ExposureModel::Matrix || number >= 9 || number.is_multiple_of(4)
}

/// The exposures by view name, as JSON: 3x4 matrices that turn (r, g, b, 1) of the model into the colour of the
/// photograph.
pub fn named_transforms<'a>(
    exposures: &Exposures,
    names: impl Iterator<Item = &'a str>,
) -> serde_json::Map<String, serde_json::Value> {
    let named = names.enumerate().take(exposures.count());
    named
        .map(|(view, name)| (name.to_owned(), serde_json::json!(exposures.transform(view).rows())))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The mean factor and offset of the green channel.
    fn mean_green(exposures: &Exposures) -> [f32; 2] {
        let n = exposures.count() as f32;
        let all: Vec<_> = (0..exposures.count()).map(|view| exposures.transform(view)).collect();
        [
            all.iter().map(|t| t.matrix[1][1]).sum::<f32>() / n,
            all.iter().map(|t| t.offset[1]).sum::<f32>() / n,
        ]
    }

    /// The gradient of half the squared distance to `to`.
    fn towards(to: &ColourTransform, at: &ColourTransform) -> ColourGradient {
        let matrix =
            std::array::from_fn(|i| std::array::from_fn(|j| at.matrix[i][j] - to.matrix[i][j]));
        let offset = std::array::from_fn(|i| at.offset[i] - to.offset[i]);
        ColourGradient { matrix, offset }
    }

    #[test]
    fn exposures_are_learned_and_their_mean_stays_constant() {
        let mut exposures = Exposures::new(ExposureModel::Channels, &[[1.2, 1.0, 0.9]; 2]);
        assert!((exposures.transform(0).matrix[0][0] - 1.2).abs() < 1e-6, "{exposures:?}");
        let mut to = [ColourTransform::IDENTITY; 2];
        for (to, sign) in to.iter_mut().zip([1.0, -1.0]) {
            to.matrix[1][1] += 0.3 * sign;
            to.offset[1] += 0.015 * sign;
            to.matrix[0][0] += 0.2;
            to.matrix[0][1] += 0.5;
        }
        for step in 0..400 {
            let view = step % 2;
            let gradient = towards(&to[view], &exposures.transform(view));
            exposures.step(view, &gradient, f64::from(step as u32) / 400.0);
            let [gain, offset] = mean_green(&exposures);
            assert!((gain - 1.0).abs() < 1e-6 && offset.abs() < 1e-6, "{gain}, {offset}");
        }
        for (view, to) in to.iter().enumerate() {
            let found = exposures.transform(view);
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
    fn a_full_matrix_mixes_channels() {
        let mut exposures = Exposures::new(ExposureModel::Matrix, &[[1.0; 3]; 2]);
        let gradient = ColourGradient { matrix: [[1.0; 3]; 3], offset: [1.0; 3] };
        exposures.step(1, &gradient, 0.0);
        let moved = exposures.transform(1);
        assert!(moved.matrix[0][1] < 0.0 && moved.matrix[2][0] < 0.0, "{moved:?}");
    }

    #[test]
    fn exposures_of_another_run_are_refused() {
        let exposures = Exposures::new(ExposureModel::Channels, &[[1.0; 3]; 2]);
        assert_eq!(exposures.check_matches(&exposures), Ok(()));
        let more = Exposures::new(ExposureModel::Channels, &[[1.0; 3]; 3]);
        let message = more.check_matches(&exposures).unwrap_err();
        assert!(message.contains("3 views") && message.contains("has 2"), "{message}");
        let matrix = Exposures::new(ExposureModel::Matrix, &[[1.0; 3]; 2]);
        assert!(matrix.check_matches(&exposures).is_err());
        let broken = Exposures::new(ExposureModel::Channels, &[[1.0; 3], [f32::NAN; 3]]);
        assert!(broken.check_matches(&exposures).unwrap_err().contains("not finite"));
    }

    #[test]
    fn exposures_are_read_back_bit_for_bit() {
        let mut exposures = Exposures::new(ExposureModel::Channels, &[[1.1, 0.9, 1.0 / 3.0]; 3]);
        let gradient = ColourGradient { matrix: [[0.123_456_7; 3]; 3], offset: [-0.7; 3] };
        exposures.step(1, &gradient, 0.25);
        let text = serde_json::to_string(&exposures).unwrap();
        assert_eq!(serde_json::from_str::<Exposures>(&text).unwrap(), exposures);
    }
}
