//! The rows of a model in colours that say something about each.

use std::ops::Range;

use super::kinds::Kind;
use super::ramp;
use crate::backend::{Backend, BackendError};
use crate::gaussians::{Gaussians, ModelArray, rgb_to_dc, sigmoid};
use crate::run::finished::Machine;

/// What lies behind painted rows: darker than the least of any scale.
pub(super) const BACKGROUND: [f32; 3] = [0.02, 0.02, 0.03];
/// Share of the rows at each end of a scale that do not stretch it.
const OUTLIERS: f64 = 0.01;

/// A model of the same rows, whose colours do not depend on the direction.
pub(super) struct Paint {
    pub(super) backend: Box<dyn Backend>,
    /// What the colours say at present, and what the ends of their scale stand for.
    shows: Option<(Kind, Option<Range<f64>>)>,
}

impl Paint {
    /// Copies a model.
    pub(super) fn new(
        machine: &Machine,
        model: &dyn Backend,
        near: f32,
    ) -> Result<Self, BackendError> {
        let rows = model.download()?.with_degree(0);
        Ok(Self { backend: machine.backend_in_scene(&rows, near, (1, 1))?, shows: None })
    }

    /// Colours the rows, unless they are coloured so already; returns the ends of the scale. Lengths are given
    /// in `units` per scene unit.
    pub(super) fn show(
        &mut self,
        kind: Kind,
        units: f64,
    ) -> Result<Option<Range<f64>>, BackendError> {
        if let Some((shown, range)) = &self.shows
            && *shown == kind
        {
            return Ok(range.clone());
        }
        let rows = 0..self.backend.rows();
        let (colours, range) = colours(&self.backend.download()?, kind, units);
        let coefficients: Vec<f32> =
            colours.as_flattened().iter().copied().map(rgb_to_dc).collect();
        self.backend.upload_array(ModelArray::Sh, rows, &coefficients)?;
        self.shows = Some((kind, range.clone()));
        Ok(range)
    }
}

/// A colour per row, and what the ends of the scale stand for if there is one.
fn colours(model: &Gaussians, kind: Kind, units: f64) -> (Vec<[f32; 3]>, Option<Range<f64>>) {
    let ordered = |log_scales: &[f32; 3]| {
        let mut lengths = log_scales.map(f64::from);
        lengths.sort_by(f64::total_cmp);
        lengths
    };
    let by = |values: Vec<f64>, ends: Range<f64>| -> Vec<[f32; 3]> {
        let width = (ends.end - ends.start).max(f64::MIN_POSITIVE);
        values.iter().map(|value| ramp::colour(((value - ends.start) / width) as f32)).collect()
    };
    match kind {
        Kind::RowOpacity => {
            let values = model.opacity_logits.iter().map(|&logit| f64::from(sigmoid(logit)));
            (by(values.collect(), 0.0..1.0), Some(0.0..1.0))
        }
        Kind::RowSize => {
            let values = model.log_scales.iter().map(|lengths| ordered(lengths)[2] + units.ln());
            let values: Vec<f64> = values.collect();
            let ends = ends(&values);
            (by(values, ends.clone()), Some(ends.start.exp()..ends.end.exp()))
        }
        Kind::RowShape => {
            let values =
                model.log_scales.iter().map(ordered).map(|[_, middle, long]| long - middle);
            let values: Vec<f64> = values.collect();
            let ends = 0.0..ends(&values).end;
            (by(values, ends.clone()), Some(1.0..ends.end.exp()))
        }
        _ => ((0..model.len() as u32).map(of_its_own).collect(), None),
    }
}

/// A colour that neighbours do not have: multiplication by an odd constant mixes the bits (Knuth, *The Art
/// of Computer Programming* 3, 6.4).
fn of_its_own(row: u32) -> [f32; 3] {
    let mixed = (row + 1).wrapping_mul(2_654_435_769);
    let mixed = (mixed ^ (mixed >> 15)).wrapping_mul(2_246_822_519);
    [24, 13, 2].map(|shift| 0.15 + 0.8 * (mixed >> shift & 255) as f32 / 255.0)
}

/// The least and the largest of some numbers, but for outliers.
pub(super) fn ends(values: &[f64]) -> Range<f64> {
    let mut values: Vec<f64> = values.iter().copied().filter(|value| value.is_finite()).collect();
    if values.is_empty() {
        return 0.0..0.0;
    }
    let last = values.len() - 1;
    let place = (last as f64 * OUTLIERS).round() as usize;
    let least = *values.select_nth_unstable_by(place, f64::total_cmp).1;
    let most = *values.select_nth_unstable_by(last - place, f64::total_cmp).1;
    least..most
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gaussians::logit;

    fn model() -> Gaussians {
        let mut model = Gaussians::zeros(3, 0);
        for (row, (opacity, lengths)) in
            [(0.001_f32, [0.1_f32, 0.1, 0.1]), (0.5, [0.1, 0.2, 0.4]), (0.999, [3.2, 0.1, 0.1])]
                .into_iter()
                .enumerate()
        {
            model.opacity_logits[row] = logit(opacity);
            model.log_scales[row] = lengths.map(f32::ln);
            model.quats[row] = [1.0, 0.0, 0.0, 0.0];
        }
        model
    }

    #[test]
    fn colours_follow_what_they_stand_for() {
        let brightness = |colour: [f32; 3]| colour.iter().sum::<f32>();
        for (kind, range) in
            [(Kind::RowOpacity, 0.0..1.0), (Kind::RowSize, 0.2..6.4), (Kind::RowShape, 1.0..32.0)]
        {
            let (colours, ends) = colours(&model(), kind, 2.0);
            let ends = ends.unwrap();
            assert!((ends.start - range.start).abs() < 1e-5, "{kind:?}: {ends:?}");
            assert!((ends.end - range.end).abs() < 1e-5, "{kind:?}: {ends:?}");
            let bright: Vec<f32> = colours.into_iter().map(brightness).collect();
            assert!(bright[0] < bright[1] && bright[1] < bright[2], "{kind:?}: {bright:?}");
        }
        let (own, none) = colours(&model(), Kind::Rows, 2.0);
        assert!(none.is_none() && own[0].map(f32::to_bits) != own[1].map(f32::to_bits));
    }

    #[test]
    fn the_ends_of_a_scale_leave_out_the_outliers() {
        let mut values: Vec<f64> = (0..1000).map(f64::from).collect();
        values.extend([1e9, -1e9, f64::NAN, f64::INFINITY]);
        let ends = ends(&values);
        assert!(
            (0.0..20.0).contains(&ends.start) && (980.0..1000.0).contains(&ends.end),
            "{ends:?}"
        );
        assert_eq!(super::ends(&[]), 0.0..0.0);
    }
}
