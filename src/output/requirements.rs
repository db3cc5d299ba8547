//! `stats/requirements.json`: what a run has left out, on what evidence, and what that costs as far as
//! it was measured.

use serde::Serialize;

use super::{DegreeChoice, RunConfig};
use crate::backend::RowDegrees;
use crate::gaussians::MAX_SH_DEGREE;
use crate::memory::Bytes;
use crate::trainer::{Dropped, Earned, Growth, PAYS};

/// The report of a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Requirements {
    /// Whether nothing was to be left out (`--full`).
    pub full: bool,
    /// Highest degree of colour of the model.
    pub sh_degree: u8,
    /// What decided it.
    pub sh_degree_from: DegreeChoice,
    /// Trials of degrees along the run, where these decided.
    pub degrees: Option<Earned>,
    /// Ends of rungs and attempts to do with fewer rows, where rows had to pay.
    pub rows: Option<Growth>,
    /// Bands of colour that rows have lost along the run, where they may.
    pub row_degrees: Option<Dropped>,
    /// Training views that were not rendered for scores, as others are nearly the same.
    pub unscored_views: usize,
    /// What was left out; nothing that the options themselves leave out.
    pub left_out: Vec<LeftOut>,
}

/// What a run has found.
#[derive(Debug, Clone, Copy, Default)]
pub struct Found<'a> {
    /// Trials of degrees, where these decided.
    pub degrees: Option<&'a Earned>,
    /// The limit of rows, where they had to pay.
    pub growth: Option<&'a Growth>,
    /// Bands that rows have lost, where they may.
    pub dropped: Option<&'a Dropped>,
    /// Views that were not scored.
    pub unscored_views: usize,
}

/// Something that was left out.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LeftOut {
    /// What.
    pub what: String,
    /// Why it was thought to be of no use.
    pub evidence: String,
    /// What it would have brought as far as that was measured, and how.
    pub loss: String,
}

impl Requirements {
    /// The report of a run of this configuration that has come to `rows` rows at a degree.
    #[must_use]
    pub fn of(config: &RunConfig, sh_degree: u8, rows: usize, found: Found<'_>) -> Self {
        let train = &config.train;
        let Found { degrees, growth, dropped, unscored_views } = found;
        let left_out = [
            degree_left_out(config, sh_degree, degrees),
            growth.and_then(|growth| rows_left_out(growth, rows, train.budget)),
            growth.and_then(shrunk),
            dropped.and_then(|dropped| bands_left_out(dropped, sh_degree)),
            (unscored_views > 0).then(|| unscored(unscored_views)),
        ];
        Self {
            full: train.full,
            sh_degree,
            sh_degree_from: train.sh_degree_from,
            degrees: degrees.cloned(),
            rows: growth.cloned(),
            row_degrees: dropped.copied(),
            unscored_views,
            left_out: left_out.into_iter().flatten().collect(),
        }
    }

    /// The report in a few lines.
    #[must_use]
    pub fn lines(&self) -> Vec<String> {
        if self.left_out.is_empty() {
            let why = if self.full { " (--full)" } else { "" };
            return vec![format!("left out nothing{why}")];
        }
        let line =
            |left: &LeftOut| format!("left out {}: {}; {}", left.what, left.evidence, left.loss);
        self.left_out.iter().map(line).collect()
    }
}

fn degree_left_out(config: &RunConfig, degree: u8, earned: Option<&Earned>) -> Option<LeftOut> {
    let train = &config.train;
    let what = match (MAX_SH_DEGREE.checked_sub(degree)?, train.sh_degree_from) {
        (0, _) => return None,
        // The options say so.
        (_, DegreeChoice::Given) if train.memory.is_none() || !train.sh_degree_lowered => {
            return None;
        }
        (1, _) => format!("degree {MAX_SH_DEGREE} of colour"),
        _ => format!("degrees {} to {MAX_SH_DEGREE} of colour", degree + 1),
    };
    if train.sh_degree_lowered {
        return Some(LeftOut {
            what,
            evidence: "--memory holds fewer rows at it than the scene starts with".to_owned(),
            loss: "its loss was not measured".to_owned(),
        });
    }
    let (evidence, loss) = match train.sh_degree_from {
        DegreeChoice::Spread(found) => (
            format!(
                "between their views, a twentieth of {} points differ by {:.2}/255 or more",
                found.tracks, found.twentieth
            ),
            format!(
                "the colours of all differ by {:.2}/255 (rms); at equal rows degree 3 was worth 0.5 to \
                 1.4 dB on matt scenes all the same (docs/requirements.md)",
                found.rms
            ),
        ),
        DegreeChoice::Training | DegreeChoice::Given => {
            let last = earned.and_then(|earned| earned.trials.last());
            match last.and_then(|trial| Some((trial.degree, trial.gain?))) {
                Some((tried, gain)) if tried > degree => (
                    format!("degree {tried} was tried and taken back"),
                    format!("it had brought {gain:.3} dB on views that it was not trained on"),
                ),
                _ => (
                    "the run has ended before it was tried".to_owned(),
                    "its loss was not measured".to_owned(),
                ),
            }
        }
    };
    Some(LeftOut { what, evidence, loss })
}

fn rows_left_out(growth: &Growth, rows: usize, budget: usize) -> Option<LeftOut> {
    let last = growth.rungs.iter().find(|rung| Some(rung.step) == growth.stopped)?;
    let gain = last.gain.filter(|_| rows < budget && growth.idle >= 2)?;
    growth.stopped.map(|step| LeftOut {
        what: format!("rows beyond {}", last.rows),
        evidence: format!(
            "growth ended at step {step}, as rows had brought less than {PAYS:.2} dB per doubling, \
             twice in a row"
        ),
        loss: format!(
            "they had brought {gain:.2} dB per doubling on training views, training included"
        ),
    })
}

fn shrunk(growth: &Growth) -> Option<LeftOut> {
    let kept: Vec<_> =
        growth.shrinks.iter().filter(|shrink| shrink.after < shrink.before).collect();
    let change: f64 = kept.iter().map(|shrink| shrink.change).sum();
    let gone: usize = kept.iter().map(|shrink| shrink.before - shrink.after).sum();
    (gone > 0).then(|| LeftOut {
        what: format!("{gone} rows"),
        evidence: format!(
            "{} times, those of least weight were hidden, and missed by less than {PAYS:.2} dB per \
             doubling",
            kept.len()
        ),
        loss: format!("{change:.3} dB on training views, at once, in all"),
    })
}

fn bands_left_out(dropped: &Dropped, sh_degree: u8) -> Option<LeftOut> {
    let RowDegrees { tolerance, rows, bytes: [before, after] } = dropped.left;
    let lower: Vec<String> = (0..usize::from(sh_degree))
        .filter(|&degree| rows[degree] > 0)
        .map(|degree| format!("{} rows at degree {degree}", rows[degree]))
        .collect();
    (!lower.is_empty()).then(|| LeftOut {
        what: format!("higher bands of colour of {}", lower.join(", ")),
        evidence: format!(
            "after step {}, colours changed by no more than {tolerance}/255 without them (rms over \
             directions of view); parameters and moments fell from {} to {}",
            dropped.step,
            Bytes(before),
            Bytes(after)
        ),
        loss: "what that changes in images was not measured".into(),
    })
}

fn unscored(views: usize) -> LeftOut {
    LeftOut {
        what: format!("{views} training views where rows are scored"),
        evidence: "for each there is another within 1 % of the scene's extent and one degree"
            .into(),
        loss: "its loss was not measured".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::config::tests::sample;
    use crate::spread::Spread;
    use crate::trainer::{Rung, Shrink, Trial};

    fn spread() -> Spread {
        let (median, tenth, twentieth, rms) = (0.0, 0.25, 0.5, 0.125);
        Spread { tracks: 4000, on_surface: 0.9, median, tenth, twentieth, rms }
    }

    #[test]
    fn what_the_options_say_is_not_left_out() {
        let mut config = sample();
        config.train.sh_degree_from = DegreeChoice::Given;
        let report = Requirements::of(&config, 0, 500, Found::default());
        assert_eq!(report.lines(), ["left out nothing"]);
        config.train.full = true;
        let report = Requirements::of(&config, 3, 500, Found::default());
        assert_eq!(report.lines(), ["left out nothing (--full)"]);
        config.train.full = false;
        let report =
            Requirements::of(&config, 3, 500, Found { unscored_views: 4, ..Found::default() });
        assert!(report.lines()[0].starts_with("left out 4 training views"), "{report:?}");
    }

    #[test]
    fn each_decision_has_its_evidence_and_its_loss() {
        let mut config = sample();
        let line =
            |config: &RunConfig, degree, earned: Option<&Earned>, growth: Option<&Growth>| {
                let found = Found { degrees: earned, growth, ..Found::default() };
                Requirements::of(config, degree, 900, found).lines().join("\n")
            };
        config.train.sh_degree_from = DegreeChoice::Spread(spread());
        let text = line(&config, 0, None, None);
        for words in ["degrees 1 to 3", "4000 points", "0.50/255", "0.12/255"] {
            assert!(text.contains(words), "{words}: {text}");
        }
        config.train.sh_degree_from = DegreeChoice::Training;
        let trials = vec![
            Trial { step: 100, degree: 1, gain: Some(0.2), kept: true },
            Trial { step: 200, degree: 2, gain: Some(-0.011), kept: false },
        ];
        let earned = Earned { degree: 1, settled: true, trials, ..Earned::default() };
        let text = line(&config, 1, Some(&earned), None);
        assert!(text.contains("degree 2 was tried") && text.contains("-0.011 dB"), "{text}");
        config.train.sh_degree_lowered = true;
        let text = line(&config, 2, None, None);
        assert!(text.contains("degree 3 of") && text.contains("not measured"), "{text}");
        config.train.sh_degree = 3;
        let rung = |step, rows, gain| Rung { step, rows, psnr: 30.0, settled: true, gain };
        let growth = Growth {
            limit: 900,
            stopped: Some(300),
            idle: 2,
            rungs: vec![
                rung(200, 700, Some(0.06)),
                rung(300, 1000, Some(0.04)),
                rung(400, 1000, None),
            ],
            shrinks: vec![
                Shrink { step: 400, before: 1000, after: 900, change: -0.015 },
                Shrink { step: 500, before: 900, after: 900, change: -0.125 },
            ],
        };
        let text = line(&config, 3, None, Some(&growth));
        for words in ["rows beyond 1000", "step 300", "0.04 dB", "100 rows", "1 times", "-0.015 dB"]
        {
            assert!(text.contains(words), "{words}: {text}");
        }
    }
}
