//! Results of the cases on a backend: for each case, the worst measurement of each kind.

use super::Case;
use super::compare::Table;

/// The worst measurement of one kind in a case.
#[derive(Debug, Clone, PartialEq)]
pub struct Finding {
    /// Number of the case.
    pub case: u8,
    /// Kind of measurement: image, gradient, or the name of a quantity.
    pub kind: String,
    /// Scene and array in which it was measured.
    pub place: String,
    /// Error; NaN if the case could not be finished.
    pub error: f64,
    /// Largest error allowed.
    pub tolerance: f64,
}

/// All results of one backend.
#[derive(Debug, Clone)]
pub struct SubjectReport {
    /// [Name](super::Subject::name) of the backend.
    pub subject: String,
    /// The cases in the order in which they ran, each with its findings.
    pub cases: Vec<(Case, Vec<Finding>)>,
}

impl SubjectReport {
    /// All findings of all cases.
    pub fn findings(&self) -> impl Iterator<Item = &Finding> {
        self.cases.iter().flat_map(|(_, findings)| findings)
    }
}

impl Finding {
    /// True if the error is within its tolerance.
    pub fn passes(&self) -> bool {
        self.error <= self.tolerance
    }

    /// Error in units of the tolerance; more than 1 if it fails.
    fn relative(&self) -> f64 {
        if self.error > 0.0 && self.tolerance > 0.0 {
            self.error / self.tolerance
        } else if self.passes() {
            0.0
        } else {
            f64::INFINITY
        }
    }
}

/// The kind of a quantity: all arrays of an image are one kind, and so are the gradients of all classes.
fn kind(quantity: &str) -> &str {
    match quantity {
        "rgb" | "alpha" | "depth" => "image",
        "means" | "log_scales" | "quats" | "opacity_logits" | "sh" => "gradient",
        "mean2d"
        | "mean2d_abs"
        | "colour"
        | "max_weight"
        | "sum_weight"
        | "pixel_count"
        | "rows blended but not visible" => "row statistics",
        other if other.starts_with(NOT_FINITE) => NOT_FINITE,
        other => other,
    }
}

/// Prefix of the names of quantities that count NaN and infinite values.
const NOT_FINITE: &str = "NaN or infinity";

/// The worst finding of each kind, in the order in which kinds first appear; then the failures without a figure.
pub(super) fn worst(case: u8, table: &Table) -> Vec<Finding> {
    let mut findings: Vec<Finding> = Vec::new();
    for (place, quantity, error, tolerance) in table.rows() {
        let kind = kind(quantity);
        let place =
            if kind == quantity { place.to_owned() } else { format!("{place}: {quantity}") };
        let finding = Finding { case, kind: kind.into(), place, error, tolerance };
        match findings.iter_mut().find(|other| other.kind == finding.kind) {
            Some(other) if finding.relative() > other.relative() => *other = finding,
            Some(_) => {}
            None => findings.push(finding),
        }
    }
    let failed = |place: &str| {
        let (kind, place) = ("failed".into(), place.into());
        Finding { case, kind, place, error: f64::NAN, tolerance: 0.0 }
    };
    findings.extend(table.messages().map(failed));
    if findings.is_empty() {
        findings.push(failed("nothing was compared"));
    }
    findings
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
        let findings = worst(3, &table);
        let shown: Vec<_> = findings.iter().map(|f| (&*f.kind, &*f.place, f.passes())).collect();
        let expected = [
            ("image", "b: depth", true),
            ("steps", "b", false),
            ("loss", "c", false),
            ("failed", "it broke", false),
        ];
        assert_eq!(shown, expected);
        assert!(!worst(3, &Table::new("t"))[0].passes());
    }
}
