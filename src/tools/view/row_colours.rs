//! Colours the Gaussians of a model by one of their properties.

use std::ops::Range;

use densify_policies::adc::mean_over_views;
use densify_policies::policy::{Signal, SignalSet, Signals};

use super::colour_map;
use super::picture_kind::PictureKind;
use super::row_measurements::RowMeasurements;
use densify_render::{Backend, BackendError};
use densify_train::trainer::RowHistory;

/// Background of coloured Gaussians: darker than the dark end of the colour map.
pub(super) const BACKGROUND: [f32; 3] = [0.02, 0.02, 0.03];
/// Fraction of the values at each end that a scale ignores if the values determine its ends.
const OUTLIERS: f64 = 0.01;
/// Signals that measure the gradient, in order of preference.
const GRADIENTS: [Signal; 2] = [Signal::ScreenGradient, Signal::ScreenGradientAbs];

/// A colour for every Gaussian.
#[derive(Debug, Clone)]
pub(super) struct RowColours {
    /// Shape: `[rows]`.
    pub(super) rows: Vec<[f32; 3]>,
    /// The values at both ends of the colour map, if the colours represent numbers.
    pub(super) range: Option<Range<f64>>,
}

/// Data about the Gaussians that is not part of the model.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct RowData<'a> {
    /// Signals that training accumulates.
    pub(super) signals: SignalSet,
    /// When each Gaussian was created and edited, and the current step.
    pub(super) history: Option<(&'a RowHistory, u32)>,
    /// Signals measured in the training views.
    pub(super) measurements: Option<&'a RowMeasurements>,
}

impl RowData<'_> {
    /// The accumulated signal for the gradient, if there is one and its views are counted.
    pub(super) fn gradient(&self) -> Option<Signal> {
        let counts = self.signals.contains(Signal::VisibleCount);
        GRADIENTS.into_iter().find(|&signal| counts && self.signals.contains(signal))
    }
}

/// The ends of a scale.
enum Scale {
    /// 0 and 1.
    Unit,
    /// 0 and the largest value.
    FromZero,
    /// The smallest and the largest value.
    Fitted,
}

/// A number per Gaussian, and its scale.
struct ScaledValues {
    /// Logarithms if the scale is logarithmic. Shape: `[rows]`.
    values: Vec<f32>,
    scale: Scale,
    is_logarithmic: bool,
}

impl ScaledValues {
    fn linear(values: Vec<f32>, scale: Scale) -> Self {
        Self { values, scale, is_logarithmic: false }
    }

    fn logarithmic(values: Vec<f32>, scale: Scale) -> Self {
        Self { values, scale, is_logarithmic: true }
    }

    fn to_colours(&self) -> RowColours {
        let ends = match self.scale {
            Scale::Unit => 0.0..1.0,
            Scale::FromZero => 0.0..ends(&self.values).end,
            Scale::Fitted => ends(&self.values),
        };
        let width = (ends.end - ends.start).max(f32::MIN_POSITIVE);
        let colour = |&value: &f32| colour_map::colour((value - ends.start) / width);
        let number = |end: f32| if self.is_logarithmic { f64::from(end).exp() } else { end.into() };
        // Before the first measurement there are no values, so no scale either.
        let has_values = self.values.iter().any(|value| value.is_finite());
        let range = has_values.then(|| number(ends.start)..number(ends.end));
        RowColours { rows: self.values.iter().map(colour).collect(), range }
    }
}

/// Colours the Gaussians by a property. There are `units` dataset units in a scene unit.
pub(super) fn colour_rows(
    kind: PictureKind,
    backend: &mut dyn Backend,
    row_data: RowData<'_>,
    units: f64,
) -> Result<RowColours, BackendError> {
    if kind == PictureKind::Rows {
        let rows = (0..backend.rows() as u32).map(distinct_colour).collect();
        return Ok(RowColours { rows, range: None });
    }
    let mut read = |signals: SignalSet, convert: &dyn Fn(&Signals) -> Vec<f32>| {
        let taken = backend.take_signals(signals)?;
        let values = convert(&taken);
        backend.give_back(taken);
        Ok::<_, BackendError>(values)
    };
    let column = |signals: &Signals, signal| signals.get(signal).unwrap_or_default().to_vec();
    let axes = |convert: fn([f32; 3]) -> f32| {
        move |signals: &Signals| -> Vec<f32> {
            let axes = signals.get(Signal::LogScale).unwrap_or_default().as_chunks::<3>().0;
            axes.iter().map(|&axes| convert(sorted(axes))).collect()
        }
    };
    let values = match kind {
        PictureKind::RowOpacity => {
            let opacity = Signal::Opacity;
            let values = read([opacity].into(), &|signals| column(signals, opacity))?;
            ScaledValues::linear(values, Scale::Unit)
        }
        PictureKind::RowSize => {
            let mut values = read([Signal::LogScale].into(), &axes(|[.., long]| long))?;
            let log_units = units.ln() as f32;
            values.iter_mut().for_each(|value| *value += log_units);
            ScaledValues::logarithmic(values, Scale::Fitted)
        }
        PictureKind::RowShape => {
            let shape = axes(|[_, middle, long]| long - middle);
            ScaledValues::logarithmic(read([Signal::LogScale].into(), &shape)?, Scale::FromZero)
        }
        PictureKind::RowGradient => {
            let values = match (row_data.measurements, row_data.gradient()) {
                (Some(measurements), _) => measurements.gradient.clone(),
                (None, Some(gradient)) => {
                    let views = Signal::VisibleCount;
                    read([gradient, views].into(), &|signals| {
                        let get = |signal| signals.get(signal).unwrap_or_default();
                        mean_over_views(get(gradient), get(views))
                    })?
                }
                (None, None) => vec![0.0; backend.rows()],
            };
            // A Gaussian that no view has seen has a gradient of 0, and is dark.
            ScaledValues::logarithmic(values.into_iter().map(f32::ln).collect(), Scale::Fitted)
        }
        PictureKind::RowWeight => {
            let weight = Signal::WeightMax;
            let values = match row_data.measurements {
                Some(measurements) => measurements.weight.clone(),
                None => read([weight].into(), &|signals| column(signals, weight))?,
            };
            ScaledValues::linear(values, Scale::Unit)
        }
        PictureKind::RowInFront => {
            let values = row_data.measurements.map(RowMeasurements::shares_in_front);
            let values = values.unwrap_or_else(|| vec![0.0; backend.rows()]);
            ScaledValues::linear(values, Scale::Unit)
        }
        PictureKind::RowAge | PictureKind::RowEdit => {
            let steps = row_data.history.map_or(&[][..], |(history, _)| match kind {
                PictureKind::RowAge => history.created(),
                _ => history.edited(),
            });
            let now = row_data.history.map_or(0, |(_, step)| step);
            let since = |&step: &u32| now.saturating_sub(step) as f32;
            ScaledValues::linear(steps.iter().map(since).collect(), Scale::FromZero)
        }
        PictureKind::Render
        | PictureKind::Photograph
        | PictureKind::Difference
        | PictureKind::Depth
        | PictureKind::Opacity
        | PictureKind::Count
        | PictureKind::Rows => unreachable!("{kind:?} does not colour Gaussians by a number"),
    };
    Ok(values.to_colours())
}

/// Sorts the axes, the shortest first.
fn sorted(mut axes: [f32; 3]) -> [f32; 3] {
    axes.sort_by(f32::total_cmp);
    axes
}

/// A colour unlike those of neighbouring rows: multiplication by an odd constant mixes the bits (Knuth, *The Art of
/// Computer Programming* 3, 6.4).
fn distinct_colour(row: u32) -> [f32; 3] {
    let mixed = (row + 1).wrapping_mul(2_654_435_769);
    let mixed = (mixed ^ (mixed >> 15)).wrapping_mul(2_246_822_519);
    [24, 13, 2].map(|shift| 0.15 + 0.8 * (mixed >> shift & 255) as f32 / 255.0)
}

/// The smallest and the largest of the finite values, without outliers.
pub(super) fn ends(values: &[f32]) -> Range<f32> {
    let mut values: Vec<f32> = values.iter().copied().filter(|value| value.is_finite()).collect();
    if values.is_empty() {
        return 0.0..0.0;
    }
    let last = values.len() - 1;
    let place = (last as f64 * OUTLIERS).round() as usize;
    let least = *values.select_nth_unstable_by(place, f32::total_cmp).1;
    let most = *values.select_nth_unstable_by(last - place, f32::total_cmp).1;
    least..most
}

#[cfg(test)]
mod tests {
    use densify_policies::plan::{EditPlan, RowOps, Update};
    use densify_policies::policy::Needs;

    use super::*;
    use densify_core::gaussians::{Gaussians, logit};
    use densify_render::{Device, Setup};

    const UNITS: f64 = 2.0;

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

    /// The last edits of the rows were at steps 9, 6 and 0.
    fn history() -> RowHistory {
        let mut history = RowHistory::from_edits(&[0; 3], 3);
        let ops = |rows: std::ops::RangeInclusive<u32>| -> RowOps {
            let needs = Needs { detailed_edits: true, ..Needs::default() };
            let mut plan = EditPlan::new(3, 3).allowing(&needs);
            rows.for_each(|row| plan.update(row, Update::NONE).unwrap());
            plan.compile()
        };
        history.record(&ops(0..=1), 6);
        history.record(&ops(0..=0), 9);
        history
    }

    #[test]
    fn colours_represent_the_property() {
        let brightness = |colour: &[f32; 3]| colour.iter().sum::<f32>();
        let mut backend = Device::default().backend(&model(), &Setup::new(3)).unwrap();
        let measured = RowMeasurements::from_values(vec![0.0, 1e-5, 1e-3], vec![0.0, 0.25, 1.0]);
        let history = history();
        let row_data = RowData {
            measurements: Some(&measured),
            history: Some((&history, 10)),
            signals: SignalSet::default(),
        };
        for (kind, range) in [
            (PictureKind::RowOpacity, 0.0..1.0),
            (PictureKind::RowSize, 0.2..6.4),
            (PictureKind::RowShape, 1.0..32.0),
            (PictureKind::RowGradient, 1e-5..1e-3),
            (PictureKind::RowWeight, 0.0..1.0),
            (PictureKind::RowInFront, 0.0..1.0),
            (PictureKind::RowEdit, 0.0..10.0),
        ] {
            let colours = colour_rows(kind, backend.as_mut(), row_data, UNITS).unwrap();
            let ends = colours.range.unwrap();
            assert!((ends.start - range.start).abs() < 1e-5, "{kind:?}: {ends:?}");
            assert!((ends.end - range.end).abs() < 1e-5, "{kind:?}: {ends:?}");
            let bright: Vec<f32> = colours.rows.iter().map(brightness).collect();
            // Row 0 has no gradient and row 1 the smallest.
            let rises = bright[0] < bright[1] || kind == PictureKind::RowGradient;
            assert!(rises && bright[1] < bright[2], "{kind:?}: {bright:?}");
        }
        let age = colour_rows(PictureKind::RowAge, backend.as_mut(), row_data, UNITS).unwrap();
        assert_eq!(age.range, Some(0.0..10.0), "an update creates no Gaussian");
        let distinct = colour_rows(PictureKind::Rows, backend.as_mut(), row_data, UNITS).unwrap();
        assert!(distinct.range.is_none());
        assert_ne!(distinct.rows[0].map(f32::to_bits), distinct.rows[1].map(f32::to_bits));
    }

    #[test]
    fn the_ends_of_a_scale_ignore_outliers() {
        let mut values: Vec<f32> = (0_u16..1000).map(f32::from).collect();
        values.extend([1e9, -1e9, f32::NAN, f32::INFINITY]);
        let Range { start, end } = ends(&values);
        assert!((0.0..20.0).contains(&start) && (980.0..1000.0).contains(&end), "{start} {end}");
        assert_eq!(ends(&[]), 0.0..0.0);
    }
}
