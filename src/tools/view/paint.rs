//! The rows of a model in colours that say something about each.

use std::ops::Range;

use densify_policies::adc::mean_over_views;
use densify_policies::policy::{Signal, SignalSet, Signals};

use super::kinds::Kind;
use super::measured::Measured;
use super::ramp;
use densify_render::{Backend, BackendError};
use densify_train::trainer::RowHistory;

/// What lies behind painted rows: darker than the least of any scale.
pub(super) const BACKGROUND: [f32; 3] = [0.02, 0.02, 0.03];
/// Share of the rows at each end of a scale that do not stretch it.
const OUTLIERS: f64 = 0.01;
/// Signals of which any says how strongly photographs pull at a row, the best first.
const GRADIENTS: [Signal; 2] = [Signal::ScreenGradient, Signal::ScreenGradientAbs];

/// The colours of all rows.
#[derive(Debug, Clone)]
pub(super) struct Colours {
    /// Shape: `[rows]`.
    pub(super) rows: Vec<[f32; 3]>,
    /// What the ends of their scale stand for, if they have one.
    pub(super) range: Option<Range<f64>>,
}

/// What is known of the rows beside the model itself.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Known<'a> {
    /// The signals that training accumulates.
    pub(super) signals: SignalSet,
    /// When rows were made and edited, and the step that is now.
    pub(super) history: Option<(&'a RowHistory, u32)>,
    /// What was measured in the training views.
    pub(super) measured: Option<&'a Measured>,
}

impl Known<'_> {
    /// The signal that says how strongly photographs pull at a row, where the views are counted over which it is the
    /// mean.
    pub(super) fn gradient(&self) -> Option<Signal> {
        let counts = self.signals.contains(Signal::VisibleCount);
        GRADIENTS.into_iter().find(|&signal| counts && self.signals.contains(signal))
    }
}

/// Where a scale begins and ends.
enum Scale {
    /// At 0 and 1.
    Unit,
    /// At 0 and the largest value.
    FromZero,
    /// At the least and the largest value.
    Fitted,
}

/// A number per row, and its scale.
struct Numbers {
    /// Logarithms, where the scale is logarithmic. Shape: `[rows]`.
    values: Vec<f32>,
    scale: Scale,
    is_logarithmic: bool,
}

impl Numbers {
    fn linear(values: Vec<f32>, scale: Scale) -> Self {
        Self { values, scale, is_logarithmic: false }
    }

    fn logarithmic(values: Vec<f32>, scale: Scale) -> Self {
        Self { values, scale, is_logarithmic: true }
    }

    fn colours(&self) -> Colours {
        let ends = match self.scale {
            Scale::Unit => 0.0..1.0,
            Scale::FromZero => 0.0..ends(&self.values).end,
            Scale::Fitted => ends(&self.values),
        };
        let width = (ends.end - ends.start).max(f32::MIN_POSITIVE);
        let colour = |&value: &f32| ramp::colour((value - ends.start) / width);
        let said = |end: f32| if self.is_logarithmic { f64::from(end).exp() } else { end.into() };
        // Where nothing has been measured yet, a scale would say something of it.
        let is_known = self.values.iter().any(|value| value.is_finite());
        let range = is_known.then(|| said(ends.start)..said(ends.end));
        Colours { rows: self.values.iter().map(colour).collect(), range }
    }
}

/// Colours the rows. Lengths are given in `units` per scene unit.
pub(super) fn colours(
    kind: Kind,
    backend: &mut dyn Backend,
    known: Known<'_>,
    units: f64,
) -> Result<Colours, BackendError> {
    if kind == Kind::Rows {
        let rows = (0..backend.rows() as u32).map(of_its_own).collect();
        return Ok(Colours { rows, range: None });
    }
    let mut reads = |signals: SignalSet, of: &dyn Fn(&Signals) -> Vec<f32>| {
        let taken = backend.take_signals(signals)?;
        let values = of(&taken);
        backend.give_back(taken);
        Ok::<_, BackendError>(values)
    };
    let column = |signals: &Signals, signal| signals.get(signal).unwrap_or_default().to_vec();
    let lengths = |of: fn([f32; 3]) -> f32| {
        move |signals: &Signals| -> Vec<f32> {
            let axes = signals.get(Signal::LogScale).unwrap_or_default().as_chunks::<3>().0;
            axes.iter().map(|&axes| of(ordered(axes))).collect()
        }
    };
    let numbers = match kind {
        Kind::RowOpacity => {
            let opacity = Signal::Opacity;
            let values = reads([opacity].into(), &|signals| column(signals, opacity))?;
            Numbers::linear(values, Scale::Unit)
        }
        Kind::RowSize => {
            let mut values = reads([Signal::LogScale].into(), &lengths(|[.., long]| long))?;
            let by = units.ln() as f32;
            values.iter_mut().for_each(|value| *value += by);
            Numbers::logarithmic(values, Scale::Fitted)
        }
        Kind::RowShape => {
            let shape = lengths(|[_, middle, long]| long - middle);
            Numbers::logarithmic(reads([Signal::LogScale].into(), &shape)?, Scale::FromZero)
        }
        Kind::RowGradient => {
            let values = match (known.measured, known.gradient()) {
                (Some(measured), _) => measured.gradient.clone(),
                (None, Some(gradient)) => {
                    let views = Signal::VisibleCount;
                    reads([gradient, views].into(), &|signals| {
                        let of = |signal| signals.get(signal).unwrap_or_default();
                        mean_over_views(of(gradient), of(views))
                    })?
                }
                (None, None) => vec![0.0; backend.rows()],
            };
            // What no view has seen has none, and is dark.
            Numbers::logarithmic(values.into_iter().map(f32::ln).collect(), Scale::Fitted)
        }
        Kind::RowWeight => {
            let weight = Signal::WeightMax;
            let values = match known.measured {
                Some(measured) => measured.weight.clone(),
                None => reads([weight].into(), &|signals| column(signals, weight))?,
            };
            Numbers::linear(values, Scale::Unit)
        }
        Kind::RowAge | Kind::RowEdit => {
            let steps = known.history.map_or(&[][..], |(history, _)| match kind {
                Kind::RowAge => history.created(),
                _ => history.edited(),
            });
            let now = known.history.map_or(0, |(_, step)| step);
            let since = |&step: &u32| now.saturating_sub(step) as f32;
            Numbers::linear(steps.iter().map(since).collect(), Scale::FromZero)
        }
        Kind::Render
        | Kind::Photograph
        | Kind::Difference
        | Kind::Depth
        | Kind::Opacity
        | Kind::Count
        | Kind::Rows => unreachable!("{kind:?} does not paint rows by numbers"),
    };
    Ok(numbers.colours())
}

/// The shortest first.
fn ordered(mut axes: [f32; 3]) -> [f32; 3] {
    axes.sort_by(f32::total_cmp);
    axes
}

/// A colour that neighbours do not have: multiplication by an odd constant mixes the bits (Knuth, *The Art
/// of Computer Programming* 3, 6.4).
fn of_its_own(row: u32) -> [f32; 3] {
    let mixed = (row + 1).wrapping_mul(2_654_435_769);
    let mixed = (mixed ^ (mixed >> 15)).wrapping_mul(2_246_822_519);
    [24, 13, 2].map(|shift| 0.15 + 0.8 * (mixed >> shift & 255) as f32 / 255.0)
}

/// The least and the largest of some numbers, but for outliers.
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

    /// Steps 0, 6 and 9.
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
    fn colours_follow_what_they_stand_for() {
        let brightness = |colour: &[f32; 3]| colour.iter().sum::<f32>();
        let mut backend = Device::default().backend(&model(), &Setup::new(3)).unwrap();
        let measured = Measured::of(vec![0.0, 1e-5, 1e-3], vec![0.0, 0.25, 1.0]);
        let history = history();
        let known = Known {
            measured: Some(&measured),
            history: Some((&history, 10)),
            signals: SignalSet::default(),
        };
        for (kind, range) in [
            (Kind::RowOpacity, 0.0..1.0),
            (Kind::RowSize, 0.2..6.4),
            (Kind::RowShape, 1.0..32.0),
            (Kind::RowGradient, 1e-5..1e-3),
            (Kind::RowWeight, 0.0..1.0),
            (Kind::RowEdit, 0.0..10.0),
        ] {
            let colours = colours(kind, backend.as_mut(), known, UNITS).unwrap();
            let ends = colours.range.unwrap();
            assert!((ends.start - range.start).abs() < 1e-5, "{kind:?}: {ends:?}");
            assert!((ends.end - range.end).abs() < 1e-5, "{kind:?}: {ends:?}");
            let bright: Vec<f32> = colours.rows.iter().map(brightness).collect();
            // Of the gradient, row 0 has none and row 1 the least.
            let rises = bright[0] < bright[1] || kind == Kind::RowGradient;
            assert!(rises && bright[1] < bright[2], "{kind:?}: {bright:?}");
        }
        let age = colours(Kind::RowAge, backend.as_mut(), known, UNITS).unwrap();
        assert_eq!(age.range, Some(0.0..10.0), "an update makes no row");
        let own = colours(Kind::Rows, backend.as_mut(), known, UNITS).unwrap();
        assert!(own.range.is_none());
        assert_ne!(own.rows[0].map(f32::to_bits), own.rows[1].map(f32::to_bits));
    }

    #[test]
    fn the_ends_of_a_scale_leave_out_the_outliers() {
        let mut values: Vec<f32> = (0_u16..1000).map(f32::from).collect();
        values.extend([1e9, -1e9, f32::NAN, f32::INFINITY]);
        let ends = ends(&values);
        assert!(
            (0.0..20.0).contains(&ends.start) && (980.0..1000.0).contains(&ends.end),
            "{ends:?}"
        );
        assert_eq!(super::ends(&[]), 0.0..0.0);
    }
}
