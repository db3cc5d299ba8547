//! Whether a backend computes what it should where numbers are hardest: needles, thousands of layers,
//! saturated opacities, images of one pixel, rows that hold anything at all.
//!
//! What it should is said by a renderer in `f64` that shares no arithmetic with the backends. It
//! belongs to the tests and lives there; it is compiled into the program too, so that
//! `densify selftest` can hold a user's own machine and driver to it. The integration tests run the
//! same [`cases`] on every backend that they find. The numbers of the cases are those of the table at
//! the head of `tests/it/extremes.rs`, which says where each of them is tested beside here.

mod bench;
mod cases;
mod report;
#[cfg(test)]
mod sabotage;
mod trial;
pub mod values;

#[path = "../../tests/it/compare.rs"]
#[expect(dead_code, reason = "the tests use the rest")]
mod compare;
#[path = "../../tests/it/reference/mod.rs"]
#[expect(dead_code, reason = "the tests use the rest")]
mod reference;
#[path = "../../tests/it/scenes.rs"]
#[expect(dead_code, reason = "the tests use the rest")]
pub(crate) mod scenes;

use std::panic::{AssertUnwindSafe, catch_unwind};

use crate::backend::BackendError;
use crate::camera::Camera;
use crate::gaussians::Gaussians;
pub use bench::Bench;
pub use cases::cases;
pub use report::{markdown, table};
use trial::Trial;

/// What a reference image blends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Blended {
    /// What every renderer does by default: alpha from 1/255, transmittance down to 1e-4.
    Standard,
    /// Everything.
    Everything,
}

/// Colours of some pixels (x, y) of a view by the float64 renderer, background included, not clamped.
/// Rows at camera z below `near` are not drawn.
pub(crate) fn reference_pixels(
    model: &Gaussians,
    camera: &Camera,
    background: [f32; 3],
    near: f32,
    blended: Blended,
    pixels: &[[u32; 2]],
) -> Vec<[f64; 3]> {
    use reference::{Model, Rules, View, blend, project};
    let rules = match blended {
        Blended::Standard => Rules::STANDARD,
        Blended::Everything => Rules::SMOOTH,
    };
    let rules = Rules { near: f64::from(near), ..rules };
    let view = View { camera, background: background.map(f64::from), sh_degree: model.sh_degree };
    let splats = project::project(&Model::of(model), view, &rules);
    let order = project::by_depth(&splats);
    let colour = |&at: &[u32; 2]| blend::sample(&splats, &order, view, &rules, at).rgb;
    pixels.iter().map(colour).collect()
}

/// Something that must hold on every backend.
#[derive(Debug, Clone, Copy)]
pub struct Case {
    /// Its number.
    pub number: u8,
    /// What is hard about it, in a few words.
    pub what: &'static str,
    run: fn(&mut Trial<'_>) -> Result<(), BackendError>,
}

/// The worst figure of a kind that was measured in a case.
#[derive(Debug, Clone, PartialEq)]
pub struct Finding {
    /// The number of the case.
    pub number: u8,
    /// The kind of figure: image, gradient, or a quantity by name.
    pub kind: String,
    /// Where it is worst: the scene, and which of its arrays.
    pub place: String,
    /// How far off it is there. NaN where there is no figure, because the case could not be finished.
    pub error: f64,
    /// How far off it may be.
    pub tolerance: f64,
}

/// Everything that was found on one backend.
#[derive(Debug, Clone)]
pub struct Tested {
    /// Its [name](Bench::name).
    pub bench: String,
    /// The cases that were tried, in their order, each with its findings.
    pub cases: Vec<(Case, Vec<Finding>)>,
}

impl Tested {
    /// All findings.
    pub fn findings(&self) -> impl Iterator<Item = &Finding> {
        self.cases.iter().flat_map(|(_, findings)| findings)
    }
}

impl Finding {
    /// Whether it is within its tolerance.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.error <= self.tolerance
    }

    /// The error in units of its tolerance; more than 1 for one that does not hold.
    fn share(&self) -> f64 {
        match (self.holds(), self.error > 0.0) {
            (true, true) => self.error / self.tolerance,
            (true, false) => 0.0,
            (false, true) if self.tolerance > 0.0 => self.error / self.tolerance,
            (false, _) => f64::INFINITY,
        }
    }
}

impl Case {
    /// Tries the case: one finding for each kind of figure, the worst of its kind. With `long`, in
    /// full where that takes minutes.
    #[must_use]
    pub fn run(&self, bench: &Bench, long: bool) -> Vec<Finding> {
        let mut trial = Trial::new(bench, long);
        // A panic is a bug, and the other cases' figures are wanted all the same.
        let done = catch_unwind(AssertUnwindSafe(|| (self.run)(&mut trial)));
        match done {
            Ok(Ok(())) => {}
            Ok(Err(error)) => trial.table.fail(error.to_string()),
            Err(_) => trial.table.fail("a panic, which is a bug".into()),
        }
        worst(self.number, &trial.table)
    }
}

/// The kind of a quantity: arrays of images, and gradients by class, are one kind each.
fn kind(quantity: &str) -> &str {
    match quantity {
        "rgb" | "alpha" | "depth" => "image",
        "means" | "log_scales" | "quats" | "opacity_logits" | "sh" => "gradient",
        "mean2d" | "mean2d_abs" | "colour" | "max_weight" | "sum_weight" | "pixel_count" => {
            "row statistics"
        }
        "rows blended but not visible" => "row statistics",
        other if other.starts_with(BROKEN) => BROKEN,
        other => other,
    }
}

/// What the kind of everything that must be a number begins with.
const BROKEN: &str = "NaN or infinity";

/// The worst of each kind, in the order in which kinds first appear; what could not be measured last.
fn worst(number: u8, table: &compare::Table) -> Vec<Finding> {
    let mut found: Vec<Finding> = Vec::new();
    for (place, quantity, error, tolerance) in table.rows() {
        let kind = kind(quantity);
        let place =
            if kind == quantity { place.to_owned() } else { format!("{place}: {quantity}") };
        let finding = Finding { number, kind: kind.into(), place, error, tolerance };
        match found.iter_mut().find(|other| other.kind == finding.kind) {
            Some(other) if finding.share() > other.share() => *other = finding,
            Some(_) => {}
            None => found.push(finding),
        }
    }
    let failed = table.messages().map(|message| Finding {
        number,
        kind: "failed".into(),
        place: message.into(),
        error: f64::NAN,
        tolerance: 0.0,
    });
    found.extend(failed);
    if found.is_empty() {
        let (kind, place) = ("failed".into(), "nothing was compared".into());
        found.push(Finding { number, kind, place, error: f64::NAN, tolerance: 0.0 });
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worst_of_each_kind_is_shown() {
        let mut table = compare::Table::new("t");
        table.check("a", "rgb", 1.0, 2.0);
        table.check("b", "depth", 1.5, 2.0);
        table.check("b", "alpha", 0.1, 2.0);
        table.check("a", "steps", 0.0, 0.0);
        table.check("b", "steps", 1.0, 0.0);
        table.check("c", "loss", f64::NAN, 1.0);
        table.check("d", "loss", 0.5, 1.0);
        table.fail("it broke".into());
        let found = worst(3, &table);
        let shown: Vec<_> = found.iter().map(|f| (&*f.kind, &*f.place, f.holds())).collect();
        let expected = [
            ("image", "b: depth", true),
            ("steps", "b", false),
            ("loss", "c", false),
            ("failed", "it broke", false),
        ];
        assert_eq!(shown, expected);
        assert!(!worst(3, &compare::Table::new("t"))[0].holds());
    }

    fn panics(_: &mut Trial<'_>) -> Result<(), BackendError> {
        panic!("on purpose")
    }

    fn fails(trial: &mut Trial<'_>) -> Result<(), BackendError> {
        trial.figure("a", "steps", 0.0, 0.0);
        Err(BackendError::NoAdapter("gone".into()))
    }

    #[test]
    fn panics_and_errors_are_failures() {
        let bench = Bench::Native { threads: Some(1) };
        for (run, findings) in [(panics as fn(&mut Trial<'_>) -> _, 1), (fails, 2)] {
            let found = Case { number: 1, what: "x", run }.run(&bench, false);
            assert_eq!(found.len(), findings);
            assert!(!found.last().unwrap().holds(), "{found:?}");
        }
    }

    #[test]
    fn numbers_ascend_and_are_unique() {
        let numbers: Vec<u8> = cases().iter().map(|case| case.number).collect();
        assert!(numbers.is_sorted_by(|a, b| a < b), "{numbers:?}");
    }
}
