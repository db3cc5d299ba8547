//! Rendering Gaussians in substitute colours, without affecting training.

use densify::core::gaussians::rgb_to_dc;
use densify::selftest::{Setup, scenes};

use crate::subject::{BLUE, bits, make_with, on_each, repeatable, saved, step_input};

const ROWS: usize = 37;
const DEGREE: u8 = 2;

#[test]
fn painted_rendering_uses_the_given_colours_and_keeps_the_model() {
    on_each(repeatable(), |subject| {
        let view = scenes::camera(33, 25, 71);
        let model = scenes::cloud(ROWS, DEGREE, &view, 72);
        let mut backend =
            make_with(subject, &model, Setup { budget: (ROWS + 3).into(), ..Setup::default() });
        let target = scenes::target(&view);
        backend.train_step(&step_input(1, &view, &target, DEGREE)).expect("a step");
        let (before, unpainted) = (saved(&*backend), backend.render(&view, BLUE, DEGREE));
        let unpainted = bits(&unpainted.expect("a rendering"));
        let share = |row: usize| row as f32 / ROWS as f32;
        let colours: Vec<[f32; 3]> =
            (0..ROWS).map(|row| [share(row), 0.5, 1.0 - share(row)]).collect();
        let painted =
            backend.inspect().and_then(|inspector| inspector.render_painted(&view, BLUE, &colours));
        let painted = painted.expect("a rendering");

        let mut flat = before.0.clone().with_degree(0);
        flat.sh = colours.as_flattened().iter().copied().map(rgb_to_dc).collect();
        let mut other =
            make_with(subject, &flat, Setup { budget: ROWS.into(), ..Setup::default() });
        let expected = other.render(&view, BLUE, 0).expect("a rendering");
        for (found, expected) in painted.rgb.iter().zip(&expected.rgb) {
            assert!((found - expected).abs() < 2e-6, "{found}, expected {expected}");
        }
        assert_ne!(bits(&painted), unpainted, "the given colours have no effect");
        assert_eq!((painted.alpha, painted.depth), (expected.alpha, expected.depth));
        assert_eq!(saved(&*backend), before, "the model has changed");
        assert_eq!(bits(&backend.render(&view, BLUE, DEGREE).expect("a rendering")), unpainted);
    });
}
