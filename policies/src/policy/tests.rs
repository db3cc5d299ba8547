//! Sets of signals, and what a policy may not read.

use super::*;

#[test]
fn all_lists_every_signal_in_order() {
    for (index, signal) in Signal::ALL.into_iter().enumerate() {
        assert_eq!(signal as usize, index);
    }
    assert_eq!(SignalSet::of(&Signal::ALL).iter().collect::<Vec<_>>(), Signal::ALL);
}

#[test]
fn a_set_holds_what_was_put_in() {
    let set = SignalSet::of(&[Signal::Age, Signal::VisibleCount]).with(Signal::Opacity);
    let listed: Vec<Signal> = set.iter().collect();
    assert_eq!(listed, [Signal::VisibleCount, Signal::Opacity, Signal::Age]);
    assert_eq!(set.with(Signal::Age), set);
    assert_eq!(set.without(Signal::Age), SignalSet::of(&[Signal::VisibleCount, Signal::Opacity]));
    assert_eq!(set.without(Signal::WeightMax), set);
    assert!(!set.contains(Signal::WeightMax) && !SignalSet::default().contains(Signal::Age));
}

#[test]
fn only_declared_signals_can_be_read() {
    let scene = SceneInfo {
        extent: 1.0,
        train_views: 1,
        budget: 3,
        initial_rows: 3,
        iterations: 30_000,
        white_background: false,
    };
    let mut signals = Signals::zeros(3, SignalSet::of(&[Signal::Opacity]));
    signals.get_mut(Signal::Opacity).unwrap()[1] = 0.5;
    assert!(signals.get_mut(Signal::Age).is_none());
    let now = Snapshot { step: 1, scene: &scene, signals: &signals, candidates: &[] };
    assert_eq!(now.rows(), 3);
    assert_eq!(now.signal(Signal::Opacity), Ok(&[0.0, 0.5, 0.0][..]));
    let refused = now.signal(Signal::Age).unwrap_err();
    assert_eq!(refused, PolicyError::Undeclared { signal: Signal::Age });
    assert!(refused.to_string().contains("Age"));
}
