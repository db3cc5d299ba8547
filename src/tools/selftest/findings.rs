//! What was found on a backend: the worst figure of each kind in each case.

use super::Case;
use super::compare::Table;

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
    /// Its [name](super::Subject::name).
    pub subject: String,
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
pub(super) fn worst(number: u8, table: &Table) -> Vec<Finding> {
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
        let mut table = Table::new("t");
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
        assert!(!worst(3, &Table::new("t"))[0].holds());
    }
}
