//! Coordinates in the files of models. In f32, coordinates of 5,000 km (northings of UTM) have steps of half a metre,
//! which is larger than most Gaussians. Files may therefore hold coordinates relative to an offset, which is stored in
//! a comment (PLY), in a node (glTF), in `meta.json` (SOG) or in a [sidecar](super::sidecar), or coordinates in f64
//! (PLY).

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::spatial_order::{middle_and_spread, middles_and_spreads};
use densify_core::gaussians::{Gaussians, sigmoid};
use densify_core::numbers::gaussians;

/// `--coordinates`: what coordinates in the file of a model are measured from.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Coordinates {
    /// As world; as local where world coordinates are too coarse in f32
    #[default]
    Auto,
    /// From the dataset's origin, in f32
    World,
    /// From an offset near the model, which is stored with it
    Local,
    /// From the dataset's origin, in f64; only PLY
    Double,
}

/// The point from which the coordinates of a file are measured, and their type.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Frame {
    /// The offset: a position is a coordinate plus this `[world units]`. For coordinates in f64, the point from which
    /// rows are measured in memory.
    pub origin: [f64; 3],
    /// True for world coordinates in f64.
    pub is_double: bool,
}

impl Frame {
    /// World coordinates in f32.
    pub const WORLD: Self = Self { origin: [0.0; 3], is_double: false };

    /// Coordinates in f32 from this origin.
    pub fn from_origin(origin: [f64; 3]) -> Self {
        Self { origin, is_double: false }
    }

    /// The offset that must be stored with the file, if there is one.
    pub fn offset(&self) -> Option<[f64; 3]> {
        let is_local = self.origin.iter().any(|&axis| axis != 0.0);
        (is_local && !self.is_double).then_some(self.origin)
    }
}

/// An offset as text: three numbers that are read back exactly.
pub fn offset_text(offset: [f64; 3]) -> String {
    offset.map(|value| value.to_string()).join(" ")
}

/// Error of a rounded position above which the position counts as coarse (root mean square) `[Gaussian's size]`. An
/// error of a tenth changes a pixel by less than a twentieth of the Gaussian's contrast.
const COARSE: f64 = 0.1;
/// Error above which a position counts as lost `[Gaussian's size]`: a half, as for [`super::Changes`].
const LOST: f64 = 0.5;
/// Smallest coarse share of the visible area, estimated as in [`Coarseness::add`], at which world coordinates in f32
/// are avoided or the user is told.
const NOTED: f64 = 0.01;
/// Smallest share of the visible area with lost positions that makes a file unfit.
const UNFIT: f64 = 0.25;

/// A model is remote, so that f32 may be too coarse, if its middle is farther from the origin than this many times its
/// spread (the median distance of its Gaussians from the middle, along the longest axis).
const REMOTE: f64 = 50.0;

/// A comparison of the step of f32 at the world coordinates of Gaussians with the sizes of these Gaussians.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Coarseness {
    /// Number of Gaussians whose positions are coarse.
    rows: usize,
    /// Estimates of the visible area: of all Gaussians, of those whose positions are coarse, and of those whose
    /// positions are lost.
    total: f64,
    coarse: f64,
    lost: f64,
    /// The largest step `[world units]`.
    step: f64,
}

impl Coarseness {
    /// Measures a whole model.
    pub fn measure(model: &Gaussians) -> Self {
        let (middle, spread) = middle_and_largest_spread(model);
        let mut coarseness = Self::default();
        coarseness.add(model, middle.to_array(), spread);
        coarseness
    }

    /// Adds rows of a scene with this middle and extent `[world units]`, from which a Gaussian's distance from the
    /// cameras is estimated.
    pub fn add(&mut self, rows: &Gaussians, middle: [f64; 3], extent: f64) {
        for row in 0..rows.len() {
            let position = rows.position(row);
            let mut sizes = rows.log_scales[row].map(|log| f64::from(log).exp());
            sizes.sort_by(f64::total_cmp);
            let [_, size, largest] = sizes;
            let away = (0..3).map(|i| (position[i] - middle[i]).powi(2)).sum::<f64>();
            let covered = (size * largest / (away + extent.powi(2))).min(1.0);
            let weight = covered * f64::from(sigmoid(rows.opacity_logits[row]));
            if !weight.is_finite() {
                continue;
            }
            let steps = position.map(step_of_f32);
            // An error that is equally likely from −½ to ½ step has a variance of 1/12 of the step's square.
            let error = (steps.iter().map(|step| step * step).sum::<f64>() / 12.0).sqrt() / size;
            self.total += weight;
            self.step = steps.into_iter().fold(self.step, f64::max);
            if error > COARSE {
                self.rows += 1;
                self.coarse += weight;
            }
            if error > LOST {
                self.lost += weight;
            }
        }
    }

    /// True if so much of the visible area is coarse that the user must be told.
    pub fn is_noted(&self) -> bool {
        self.coarse >= NOTED * self.total.max(f64::MIN_POSITIVE)
    }

    /// True if so many positions are lost that other coordinates must be chosen.
    pub fn is_unfit(&self) -> bool {
        self.lost >= UNFIT * self.total.max(f64::MIN_POSITIVE)
    }
}

impl std::fmt::Display for Coarseness {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "so far from the origin, f32 has steps of up to {}, and shifts {} ({:.1} % of the visible area) by more than \
             {:.0} % of their size",
            two_digits(self.step),
            gaussians(self.rows),
            100.0 * self.coarse / self.total.max(f64::MIN_POSITIVE),
            100.0 * COARSE
        )
    }
}

/// A step with two significant digits: 0.5, 0.031, 9.5e-7.
fn two_digits(step: f64) -> String {
    let rounded: f64 = format!("{step:.1e}").parse().unwrap_or(step);
    if rounded >= 1e-3 || rounded == 0.0 { format!("{rounded}") } else { format!("{rounded:e}") }
}

/// The distance from the f32 at this value to the next larger one.
fn step_of_f32(value: f64) -> f64 {
    let near = value.abs() as f32;
    f64::from(near.next_up()) - f64::from(near)
}

/// The middle of a model and its spread along the longest axis `[world units]`.
pub(super) fn middle_and_largest_spread(model: &Gaussians) -> (DVec3, f64) {
    let axes = middles_and_spreads(model);
    let middle = DVec3::from(axes.map(|(middle, _)| middle)) + DVec3::from(model.origin);
    (middle, largest_spread(&axes))
}

fn largest_spread(axes: &[(f64, f64); 3]) -> f64 {
    axes.iter().map(|(_, spread)| *spread).fold(0.0, f64::max)
}

/// True if a model with this middle and spread is [remote](REMOTE).
pub(super) fn is_remote(middle: [f64; 3], spread: f64) -> bool {
    DVec3::from(middle).length() > REMOTE * spread
}

/// True if a model has an origin of its own near its middle, so that its positions are finer than world coordinates in
/// f32.
pub fn is_finer_than_f32(model: &Gaussians) -> bool {
    let (middle, spread) = middle_and_largest_spread(model);
    model.is_local() && !is_remote((middle - DVec3::from(model.origin)).to_array(), spread)
}

/// A point near the middle of a model, for its local coordinates; the model's own origin if that is near.
pub fn local_origin(model: &Gaussians) -> [f64; 3] {
    if is_finer_than_f32(model) {
        return model.origin;
    }
    let (middle, spread) = middle_and_largest_spread(model);
    round_origin(middle.to_array(), spread)
}

/// A point near the middle of coordinates, given by axis, if they are so far from 0 that f32 may be too coarse; 0
/// otherwise, or if all of them are exact in f32.
pub(super) fn remote_origin(axes: [Vec<f64>; 3]) -> [f64; 3] {
    let is_exact = |value: &f64| f64::from(*value as f32).to_bits() == value.to_bits();
    if axes.iter().flatten().all(is_exact) {
        return [0.0; 3];
    }
    let axes = axes.map(middle_and_spread);
    let (middle, spread) = (axes.map(|(middle, _)| middle), largest_spread(&axes));
    if is_remote(middle, spread) { round_origin(middle, spread) } else { [0.0; 3] }
}

/// A point rounded to multiples of the power of ten below `unit` (1e-15 to 1e15); a non-finite number becomes 0.
pub fn round_origin(point: [f64; 3], unit: f64) -> [f64; 3] {
    let exponent = unit.log10().floor().clamp(-15.0, 15.0) as i32;
    let step = 10f64.powi(exponent.abs());
    point.map(|value| {
        let rounded = if exponent < 0 {
            (value * step).round() / step
        } else {
            (value / step).round() * step
        };
        // Adding 0 turns −0 into 0.
        if rounded.is_finite() { rounded + 0.0 } else { 0.0 }
    })
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "results are exact")]
mod tests {
    use super::*;

    #[test]
    fn steps_are_those_of_f32() {
        for (value, step) in [(5e6, 0.5), (-5e5, 0.031_25), (1.0, f64::from(f32::EPSILON))] {
            assert_eq!(step_of_f32(value), step);
        }
        assert_eq!([0.5, 0.031_25, 9.53e-7].map(two_digits), ["0.5", "0.031", "9.5e-7"]);
    }

    #[test]
    fn origins_are_round_and_near_the_middle() {
        assert_eq!(round_origin([123.456, -0.001, f64::NAN], 0.2), [123.5, 0.0, 0.0]);
        assert_eq!(
            round_origin([512_345.6, 5_400_123.4, 80.0], 37.0),
            [512_350.0, 5_400_120.0, 80.0]
        );
        for unit in [0.0, f64::MIN_POSITIVE, f64::INFINITY, f64::NAN] {
            assert!(round_origin([1e300, 5.0, -5.0], unit).iter().all(|value| value.is_finite()));
        }
    }

    /// The size of the visible Gaussians counts, not the extent of the model.
    #[test]
    fn only_visible_gaussians_make_coordinates_coarse() {
        let mut model = Gaussians::zeros(100, 0);
        model.origin = [0.0, 5e6, 0.0];
        model.log_scales.fill([2f32.ln(); 3]);
        model.opacity_logits.fill(3.0);
        for (row, mean) in model.means.iter_mut().enumerate() {
            *mean = [row as f32, (row % 7) as f32, 0.0];
        }
        assert!(!Coarseness::measure(&model).is_noted());
        // A few small Gaussians are hardly visible.
        model.log_scales[..10].fill([0.01f32.ln(); 3]);
        assert!(!Coarseness::measure(&model).is_noted());
        model.log_scales[..10].fill([1.2f32.ln(); 3]);
        let some = Coarseness::measure(&model);
        assert!(some.is_noted() && !some.is_unfit(), "{some:?}");
        assert!(
            some.to_string().contains("10 Gaussians") && some.to_string().contains("0.5"),
            "{some}"
        );
        model.log_scales.fill([0.1f32.ln(); 3]);
        assert!(Coarseness::measure(&model).is_unfit());
        assert!(!Coarseness::measure(&Gaussians { origin: [0.0; 3], ..model }).is_noted());
        assert!(!Coarseness::measure(&Gaussians::default()).is_noted());
    }
}
