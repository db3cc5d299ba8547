//! Findings as a table for a terminal and for Markdown.

use std::fmt::Write as _;

use super::{Case, Finding, Tested};

fn figure(value: f64) -> String {
    if value.is_nan() {
        "-".into()
    } else if value.to_bits() == 0 || (value.fract() == 0.0 && value < 1e6) {
        format!("{value:.0}")
    } else {
        format!("{value:.1e}")
    }
}

fn verdict(finding: &Finding) -> &'static str {
    if finding.holds() { "ok" } else { "FAILED" }
}

/// The lines of one case for a terminal.
#[must_use]
pub fn table(case: &Case, findings: &[Finding]) -> String {
    let mut text = format!("{:>2}  {}", case.number, case.what);
    for finding in findings {
        let Finding { kind, place, error, tolerance, .. } = finding;
        let (error, tolerance) = (figure(*error), figure(*tolerance));
        let verdict = verdict(finding);
        let _ =
            write!(text, "\n    {verdict:<6} {error:>8} of {tolerance:>8}  {kind:<38}  {place}");
    }
    text
}

/// What stands at the head of a Markdown file.
const HEAD: &str = "\
# Figures of the selftest

Written by `densify selftest --markdown FILE`, with `--all` for every backend; of each case and
kind of figure the worst that was measured, beside the tolerance. Images are compared with those of a
renderer in float64 where no decision is close; gradients relative to the largest of their class; what
must never happen is counted. The numbers of the cases are those of `tests/it/extremes.rs`.
";

/// A Markdown file: a section for each backend that was tested, with a table of its findings.
#[must_use]
pub fn markdown(tested: &[Tested]) -> String {
    let mut text = HEAD.to_owned();
    for Tested { subject, cases } in tested {
        let _ = write!(text, "\n## {subject}\n\n{COLUMNS}");
        for (case, findings) in cases {
            for (i, finding) in findings.iter().enumerate() {
                let number = case.number.to_string();
                let (number, what) = if i == 0 { (&*number, case.what) } else { ("", "") };
                let Finding { kind, place, error, tolerance, .. } = finding;
                let (error, tolerance) = (figure(*error), figure(*tolerance));
                let verdict = verdict(finding);
                let place = place.replace('|', "\\|");
                let _ = writeln!(
                    text,
                    "| {number} | {what} | {kind} | {error} | {tolerance} | {verdict} | {place} |"
                );
            }
        }
    }
    text
}

const COLUMNS: &str = "\
| case | what | figure | measured | tolerance | | worst in |
|---|---|---|---|---|---|---|
";

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cases;

    fn finding(error: f64, tolerance: f64) -> Finding {
        Finding { number: 1, kind: "image".into(), place: "a|b".into(), error, tolerance }
    }

    #[test]
    fn what_fails_is_seen() {
        let case = cases()[0];
        let findings = vec![finding(1.5e-5, 2e-5), finding(3.0, 0.0), finding(f64::NAN, 1.0)];
        let text = table(&case, &findings);
        assert!(text.contains("ok       1.5e-5 of   2.0e-5"), "{text}");
        assert!(text.contains("FAILED        3 of        0"), "{text}");
        assert!(text.contains("FAILED        - of"), "{text}");
        let text = markdown(&[Tested { subject: "native".into(), cases: vec![(case, findings)] }]);
        assert!(text.contains("\n## native\n\n| case |"), "{text}");
        assert!(text.contains("| 1.5e-5 | 2.0e-5 | ok | a\\|b |"), "{text}");
        assert_eq!(text.matches("FAILED").count(), 2);
    }
}
