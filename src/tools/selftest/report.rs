//! Tables of findings, for a terminal and as Markdown.

use std::fmt::Write as _;

use super::{Case, Finding, SubjectReport};

fn format_figure(value: f64) -> String {
    if value.is_nan() {
        "-".into()
    } else if value.to_bits() == 0 || (value.fract() == 0.0 && value < 1e6) {
        format!("{value:.0}")
    } else {
        format!("{value:.1e}")
    }
}

fn verdict(finding: &Finding) -> &'static str {
    if finding.passes() { "ok" } else { "FAILED" }
}

/// The lines of one case for a terminal.
pub fn table(case: &Case, findings: &[Finding]) -> String {
    let mut text = format!("{:>2}  {}", case.number, case.title);
    for finding in findings {
        let Finding { kind, place, error, tolerance, .. } = finding;
        let (error, tolerance) = (format_figure(*error), format_figure(*tolerance));
        let verdict = verdict(finding);
        let _ =
            write!(text, "\n    {verdict:<6} {error:>8} of {tolerance:>8}  {kind:<38}  {place}");
    }
    text
}

/// Head of the Markdown file.
const HEAD: &str = "\
# Figures of the selftest

Written by `densify selftest --markdown FILE`; `--all` includes every backend. The tables show the worst
figure of each kind in each case, beside its tolerance. Images and gradients are compared with those of a
float64 renderer: images except where a threshold of the renderer is close, gradients relative to the largest
of their class. Other figures count errors that must never occur. `tests/it/extremes.rs` has the same case numbers.
";

/// A Markdown file with a section for each backend and a table of its findings.
pub fn markdown(reports: &[SubjectReport]) -> String {
    let mut text = HEAD.to_owned();
    for SubjectReport { subject, cases } in reports {
        let _ = write!(text, "\n## {subject}\n\n{COLUMNS}");
        for (case, findings) in cases {
            for (i, finding) in findings.iter().enumerate() {
                let number = case.number.to_string();
                let (number, title) = if i == 0 { (&*number, case.title) } else { ("", "") };
                let Finding { kind, place, error, tolerance, .. } = finding;
                let (error, tolerance) = (format_figure(*error), format_figure(*tolerance));
                let verdict = verdict(finding);
                let place = place.replace('|', "\\|");
                let _ = writeln!(
                    text,
                    "| {number} | {title} | {kind} | {error} | {tolerance} | {verdict} | {place} |"
                );
            }
        }
    }
    text
}

const COLUMNS: &str = "\
| case | title | figure | measured | tolerance | | worst in |
|---|---|---|---|---|---|---|
";

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cases;

    fn finding(error: f64, tolerance: f64) -> Finding {
        Finding { case: 1, kind: "image".into(), place: "a|b".into(), error, tolerance }
    }

    #[test]
    fn failures_are_marked() {
        let case = cases()[0];
        let findings = vec![finding(1.5e-5, 2e-5), finding(3.0, 0.0), finding(f64::NAN, 1.0)];
        let text = table(&case, &findings);
        assert!(text.contains("ok       1.5e-5 of   2.0e-5"), "{text}");
        assert!(text.contains("FAILED        3 of        0"), "{text}");
        assert!(text.contains("FAILED        - of"), "{text}");
        let text =
            markdown(&[SubjectReport { subject: "native".into(), cases: vec![(case, findings)] }]);
        assert!(text.contains("\n## native\n\n| case |"), "{text}");
        assert!(text.contains("| 1.5e-5 | 2.0e-5 | ok | a\\|b |"), "{text}");
        assert_eq!(text.matches("FAILED").count(), 2);
    }
}
