//! Tests of what a policy may read.

use super::*;
use crate::event::Event;

#[test]
fn only_declared_signals_can_be_read() {
    let scene = Event::new(1, 3, 3).scene;
    let mut signals = Signals::zeros(3, SignalSet::from([Signal::Opacity]));
    signals.get_mut(Signal::Opacity).unwrap()[1] = 0.5;
    assert!(signals.get_mut(Signal::Age).is_none());
    let now = Snapshot { step: 1, scene: &scene, signals: &signals, candidates: &[] };
    assert_eq!(now.rows(), 3);
    assert_eq!(now.signal(Signal::Opacity), Ok(&[0.0, 0.5, 0.0][..]));
    let refused = now.signal(Signal::Age).unwrap_err();
    assert_eq!(refused, PolicyError::Undeclared { signal: Signal::Age });
    assert!(refused.to_string().contains("Age"));
}
