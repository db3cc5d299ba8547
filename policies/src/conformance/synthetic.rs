//! Synthetic statistics, plausible or broken. Of the model, only the number of rows and the candidates are tracked.

use crate::plan::RowOps;
use crate::policy::{
    AuxColumn, AuxRequest, Candidate, Needs, SceneInfo, Signal, SignalKind, SignalSet, Signals,
};
use crate::rng::{PolicyRng, Purpose};

/// The kind of values in the statistics.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Pattern {
    Plausible,
    Zero,
    Equal,
    Negative,
    Huge,
    Denormal,
    Infinite,
    MinusInfinite,
    Nan,
    /// Each value follows one of the patterns above.
    Mixture,
    /// Each event follows one of the patterns above, chosen by the scenario (`pattern_at`).
    Changing,
}

pub(super) const PATTERNS: [Pattern; 11] = [
    Pattern::Plausible,
    Pattern::Zero,
    Pattern::Equal,
    Pattern::Negative,
    Pattern::Huge,
    Pattern::Denormal,
    Pattern::Infinite,
    Pattern::MinusInfinite,
    Pattern::Nan,
    Pattern::Mixture,
    Pattern::Changing,
];

/// A value that follows `pattern`, from four random words; `plausible` maps u in [0, 1) to a plausible value.
fn value(pattern: Pattern, bits: [u32; 4], plausible: impl Fn(f32) -> f32) -> f32 {
    let u = (bits[0] >> 9) as f32 / 8_388_608.0;
    match pattern {
        Pattern::Plausible | Pattern::Changing => plausible(u),
        Pattern::Zero => 0.0,
        Pattern::Equal => 0.5,
        Pattern::Negative => -plausible(u),
        Pattern::Huge => f32::MAX,
        Pattern::Denormal => f32::from_bits(1),
        Pattern::Infinite => f32::INFINITY,
        Pattern::MinusInfinite => f32::NEG_INFINITY,
        Pattern::Nan => f32::NAN,
        // Half of the values are plausible, so that policies act at all; the others follow any earlier pattern.
        Pattern::Mixture => {
            let pattern =
                if bits[1].is_multiple_of(2) { 0 } else { bits[2] as usize % (PATTERNS.len() - 2) };
            value(PATTERNS[pattern], bits, plausible)
        }
    }
}

/// A value that training may produce, for u in [0, 1).
fn plausible(signal: Signal, u: f32, scene: &SceneInfo) -> f32 {
    match signal {
        Signal::VisibleCount => (20.0 * u).floor(),
        Signal::ScreenGradient | Signal::ScreenGradientAbs => 0.02 * u.powi(3),
        Signal::MeanGradientX | Signal::MeanGradientY | Signal::MeanGradientZ => 1e-3 * (u - 0.5),
        Signal::Opacity => 0.99 * u.powi(3) + 1e-3,
        Signal::ScaleProduct => (0.15 * scene.extent * u.powi(3)).powi(3),
        Signal::ScaleMax => 0.15 * scene.extent * u.powi(3) + 1e-6,
        Signal::Age => (300.0 * u).floor(),
        Signal::Position => 2.0 * scene.extent * (u - 0.5),
        Signal::LogScale => (0.15 * scene.extent * u.powi(3) + 1e-6).ln(),
        Signal::Orientation => u - 0.5,
        // Colours of rows may lie outside 0 to 1.
        Signal::Colour => 1.4 * u - 0.2,
        other => match other.kind() {
            SignalKind::Count => (1000.0 * u).floor(),
            SignalKind::Sum => 1e-3 * u.powi(3),
            _ => u,
        },
    }
}

/// The model of a run.
pub(super) struct Model {
    pub(super) rows: usize,
    pub(super) candidates: Vec<Candidate>,
}

/// Everything that can be read at an event, declared or not.
pub(super) struct Event {
    pub(super) step: u32,
    pub(super) declared: Signals,
    pub(super) all: Signals,
    pub(super) candidates: Vec<Candidate>,
}

/// Everything that can be read in an auxiliary view, declared or not.
pub(super) struct View {
    pub(super) loss: f32,
    pub(super) columns: Vec<(AuxColumn, Vec<f32>)>,
    pub(super) points: Vec<Candidate>,
}

impl Model {
    /// Makes the statistics of an event and collects new candidates.
    pub(super) fn event(
        &mut self,
        pattern: Pattern,
        scene: &SceneInfo,
        step: u32,
        needs: &Needs,
    ) -> Event {
        let rng = PolicyRng::new(7, step);
        let fill = |set: SignalSet| {
            let mut signals = Signals::zeros(self.rows, set);
            for signal in set.iter() {
                for (row, number) in (0..).zip(signals.get_mut(signal).into_iter().flatten()) {
                    let bits = rng.bits(row, Purpose::Noise, signal as u32);
                    *number = value(pattern, bits, |u| plausible(signal, u, scene));
                }
            }
            signals
        };
        let declared = fill(needs.signals);
        let all = fill(Signal::ALL.into());
        let capacity = needs.candidates.map_or(5, |request| request.capacity);
        for index in 0..capacity.saturating_sub(self.candidates.len()).min(5) as u32 {
            let number = |component: u32, scale: f32| {
                let bits = rng.bits(index, Purpose::Noise, 100 + component);
                value(pattern, bits, |u| u) * scale
            };
            self.candidates.push(candidate(number));
        }
        Event { step, declared, all, candidates: self.candidates.clone() }
    }

    /// Makes the statistics of one auxiliary view.
    pub(super) fn view(
        &self,
        pattern: Pattern,
        step: u32,
        view: u32,
        request: &AuxRequest,
    ) -> View {
        let rng = PolicyRng::new(11 + u64::from(view), step);
        let number = |row: u32, counter: u32, scale: f32| {
            value(pattern, rng.bits(row, Purpose::Noise, 200 + counter), |u| u) * scale
        };
        let columns = (0..).zip(AuxColumn::ALL).map(|(counter, column)| {
            let numbers = (0..self.rows as u32).map(|row| {
                let bits = rng.bits(row, Purpose::Noise, 200 + counter);
                value(pattern, bits, |u| (40.0 * u).floor())
            });
            (column, numbers.collect())
        });
        let points = 0..request.points.clamp(1, 4);
        View {
            loss: number(0, 30, 1.0),
            columns: columns.collect(),
            points: points
                .map(|index| candidate(|component, scale| number(index, 20 + component, scale)))
                .collect(),
        }
    }

    pub(super) fn apply(&mut self, ops: &RowOps) {
        self.rows = ops.rows_after;
        if ops.reset_candidates {
            self.candidates.clear();
        }
    }
}

/// A candidate whose components are `number(index of the component, scale)`.
fn candidate(number: impl Fn(u32, f32) -> f32) -> Candidate {
    Candidate {
        position: [0, 1, 2].map(|index| number(index, 1.0)),
        colour: [3, 4, 5].map(|index| number(index, 1.0)),
        pixel_size: number(6, 0.01),
        error: number(7, 1.0),
    }
}
