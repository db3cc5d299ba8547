//! Tests of how much quantised formats change models, including models beyond the formats' ranges.

use super::round_trips::plausible;
use super::saved;
use crate::models::{Changes, find, fitting_format};
use densify_core::files::write_atomically;
use densify_core::gaussians::Gaussians;

const LOSSY: [&str; 4] = ["spz", "spz-v4", "sog", "compressed-ply"];

/// A model like a trained one: 1,000 Gaussians whose colours depend little on direction.
fn trained() -> Gaussians {
    let mut model = plausible(1_000, 1);
    model.sh.chunks_exact_mut(12).for_each(|row| row[3..].iter_mut().for_each(|v| *v *= 0.1));
    model
}

/// Multiplies the standard deviations by e^`by`.
fn grow(model: &mut Gaussians, by: f32) {
    model.log_scales.as_flattened_mut().iter_mut().for_each(|log| *log += by);
}

/// Gives a coefficient of every Gaussian this value.
fn colour(model: &mut Gaussians, coefficient: usize, value: f32) {
    model.sh.chunks_exact_mut(12).for_each(|row| row[coefficient] = value);
}

fn changes(format: &str, model: &Gaussians) -> Changes {
    let (_folder, path) = saved("model", "");
    let format = find(format).unwrap();
    write_atomically(&path, |out| format.write(model, out)).unwrap();
    format.changes(model, &path).unwrap()
}

#[test]
fn rounding_does_not_count_as_a_change() {
    for format in LOSSY.into_iter().chain(["ply", "glb"]) {
        let changes = changes(format, &trained());
        assert!(!changes.is_noted(), "{format}: {changes}");
    }
}

/// In each case, a quantity of all Gaussians is beyond what a format can hold, or one Gaussian spoils the others.
#[test]
fn values_that_a_format_cannot_hold_count_as_changes() {
    type Change = fn(&mut Gaussians);
    let cases: [(&str, Change, &[&str], &str); 9] = [
        ("tiny", |m| grow(m, -8.0), &LOSSY[..2], "scales"),
        ("huge", |m| grow(m, 11.0), &LOSSY[..2], "scales"),
        ("faint", |m| m.opacity_logits.fill(-5.0), &LOSSY, "opacities"),
        ("bright", |m| colour(m, 0, 6.0), &LOSSY[..2], "colours"),
        ("view-dependent", |m| colour(m, 4, 2.0), &LOSSY[..2], "colours"),
        ("strongly view-dependent", |m| colour(m, 4, 6.0), &["spz", "compressed-ply"], "colours"),
        ("one far Gaussian", |m| m.means[7][1] = 1e6, &LOSSY[..2], "positions"),
        ("UTM", |m| m.means.iter_mut().for_each(|mean| mean[1] += 5e5), &["sog"], "positions"),
        ("one glaring Gaussian", |m| m.sh[0] = 1e7, &["sog"], "colours"),
    ];
    for (case, change, unfit, quantity) in cases {
        let mut model = trained();
        change(&mut model);
        for format in unfit {
            let changes = changes(format, &model);
            assert!(changes.is_unfit(), "{case}, {format}: {changes}");
            assert!(changes.to_string().contains(quantity), "{case}, {format}: {changes}");
        }
        let (_folder, path) = saved("scratch", "");
        let fits = fitting_format(&model, &path);
        assert!(!unfit.contains(&fits.name) && !fits.changes(&model, &path).unwrap().is_unfit());
    }
}

/// Changes that are hardly visible are not noted: of small or faint Gaussians, or of the thin axis of flat ones.
#[test]
fn changes_are_weighted_by_their_visibility() {
    let mut model = trained();
    // All Gaussians are as thin as a plane, and one in fifty is so small that no format with limits holds it.
    model.log_scales.iter_mut().for_each(|logs| logs[2] = -15.0);
    model.log_scales.iter_mut().step_by(50).for_each(|logs| *logs = [-13.0; 3]);
    assert!(!changes("spz", &model).is_noted(), "{}", changes("spz", &model));
    // One in fifty fills the view.
    model.log_scales.iter_mut().step_by(50).for_each(|logs| *logs = [6.4; 3]);
    let found = changes("spz", &model);
    assert!(found.is_unfit() && found.to_string().contains("20 Gaussians"), "{found}");
}
