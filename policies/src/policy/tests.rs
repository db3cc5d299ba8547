//! Tests of the inputs of policies.

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
    assert!(now.positions().is_err() && now.orientations().is_err());
    assert!(now.log_scales().is_err() && now.colours().is_err());
}

#[test]
fn attributes_are_read_per_row() {
    use Signal::{Colour, LogScale, Orientation, Position};
    let mut event = Event::new(1, 2, 2);
    for (signal, first) in [(Position, 0.0), (LogScale, 10.0), (Orientation, 20.0), (Colour, 30.0)]
    {
        let values = (0..2 * signal.width() as u8).map(|i| first + f32::from(i));
        event = event.with(signal, &values.collect::<Vec<_>>());
    }
    let mut signals = Signals::zeros(2, [Position, LogScale, Orientation, Colour].into());
    for (signal, values) in &event.signals {
        signals.get_mut(*signal).unwrap().copy_from_slice(values);
    }
    let now = Snapshot { step: 1, scene: &event.scene, signals: &signals, candidates: &[] };
    assert_eq!(now.positions(), Ok(&[[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]][..]));
    assert_eq!(now.log_scales(), Ok(&[[10.0, 11.0, 12.0], [13.0, 14.0, 15.0]][..]));
    assert_eq!(now.orientations().map(|all| &all[1..]), Ok(&[[24.0, 25.0, 26.0, 27.0]][..]));
    assert_eq!(now.colours().map(|all| &all[1..]), Ok(&[[33.0, 34.0, 35.0]][..]));
}
