//! What the records of a study say, level by level.

use super::levels::Factor;
use super::{BASE, Outcome, Trade};
use crate::difference::{Difference, Pair, mean};
use crate::distinct;

/// A study's results.
pub(super) struct Report {
    pub(super) study: Trade,
    /// Labels of the scenes.
    pub(super) scenes: Vec<String>,
    pub(super) outcomes: Vec<Outcome>,
    pub(super) effects: Vec<Effect>,
}

/// What a knob does at a level, against `exact`.
pub(super) struct Effect {
    pub(super) factor: Factor,
    pub(super) level: String,
    pub(super) psnr: Difference,
    pub(super) ssim: Difference,
    /// Logarithms of ratios, as the next two.
    pub(super) seconds: Difference,
    /// Of processor time, which other programs disturb less.
    pub(super) cpu: Option<Difference>,
    pub(super) peak: Difference,
    /// Runs whose model is that of `exact` to the bit.
    pub(super) same: usize,
}

/// A number of a run; none where it was not measured.
type Measure = fn(&Outcome) -> Option<f64>;

pub(super) const PSNR: Measure = |r| Some(r.psnr);
const SSIM: Measure = |r| Some(r.ssim);
pub(super) const SECONDS: Measure = |r| positive(r.seconds).map(f64::ln);
const CPU: Measure = |r| positive(r.cpu_seconds?).map(f64::ln);
/// Where the system does not say, what was promised.
const PEAK: Measure = |r| positive(r.peak_bytes.unwrap_or(r.ledger_bytes) as f64).map(f64::ln);

fn positive(value: f64) -> Option<f64> {
    (value.is_finite() && value > 0.0).then_some(value)
}

impl Report {
    pub(super) fn new(study: &Trade, chosen: &[Factor], outcomes: Vec<Outcome>) -> Self {
        let scenes = distinct(outcomes.iter().map(|outcome| outcome.scene.clone()));
        let mut report = Self { study: study.clone(), scenes, outcomes, effects: Vec::new() };
        for one in chosen {
            for level in &one.levels {
                report.effects.extend(report.effect(one, level));
            }
        }
        report
    }

    /// The runs with a knob at a level.
    pub(super) fn runs(&self, knob: &str, level: &str) -> impl Iterator<Item = &Outcome> {
        let is_it = move |run: &&Outcome| run.factor == knob && run.level == level;
        self.outcomes.iter().filter(is_it)
    }

    /// Each run with a knob at a level, and the exact one of the same scene and seed.
    fn pairs(&self, knob: &str, level: &str) -> Vec<(&Outcome, &Outcome)> {
        let base = |run: &Outcome| {
            self.runs(BASE, "").find(|base| (&base.scene, base.seed) == (&run.scene, run.seed))
        };
        self.runs(knob, level).filter_map(|run| Some((run, base(run)?))).collect()
    }

    fn differences(&self, knob: &str, level: &str, of: Measure) -> Vec<Pair<'_>> {
        let all = self.pairs(knob, level).into_iter();
        all.filter_map(|(run, base)| {
            let difference = of(run)? - of(base)?;
            Some(Pair { scene: &run.scene, seed: run.seed, difference })
        })
        .collect()
    }

    fn effect(&self, factor: &Factor, level: &str) -> Option<Effect> {
        let name = &*factor.name;
        let of = |measure: Measure| Difference::new(&self.differences(name, level, measure));
        let pairs = self.pairs(name, level);
        let same = pairs.iter().filter(|(run, base)| run.model == base.model).count();
        Some(Effect {
            factor: factor.clone(),
            level: level.to_owned(),
            psnr: of(PSNR)?,
            ssim: of(SSIM)?,
            seconds: of(SECONDS)?,
            cpu: of(CPU),
            peak: of(PEAK)?,
            same,
        })
    }

    /// Mean over the runs with a knob at a level in a scene.
    pub(super) fn mean(&self, scene: &str, knob: &str, level: &str, of: Measure) -> Option<f64> {
        let values: Option<Vec<f64>> =
            self.runs(knob, level).filter(|run| run.scene == scene).map(of).collect();
        mean(values?)
    }

    /// Peak memory of the runs with a knob at a level in a scene `[MiB]`.
    pub(super) fn peak_mib(&self, scene: &str, knob: &str, level: &str) -> Option<f64> {
        self.mean(scene, knob, level, PEAK).map(|peak| peak.exp() / f64::from(1 << 20))
    }
}

/// For tests of what shows a report.
#[cfg(test)]
pub(super) fn sample() -> Report {
    let outcome = |knob: &str, level: &str, seed, psnr: f64, seconds: f64| Outcome {
        peak_bytes: Some(64 << 20),
        seconds,
        ..crate::record::sample(knob, level, seed, psnr)
    };
    let outcomes = (0..3).flat_map(|seed| {
        let by = f64::from(seed);
        [
            outcome("", "", seed, 30.0 + by, 100.0),
            outcome("alpha_min", "1/64", seed, 30.0 + by, 90.0),
            outcome("alpha_min", "1/32", seed, 29.0 + 1.1 * by, 95.0),
            outcome("sh_degree", "0", seed, 30.2 + by, 50.0),
        ]
    });
    let study = Trade {
        scenes: vec!["scene:room".into()],
        knobs: Vec::new(),
        seeds: 3,
        iterations: 100,
        budget: 1000,
        output: "x".into(),
        train: vec!["--policy=diet".into()],
        engine: crate::EngineArgs::default(),
    };
    let factor = |name: &str, levels: &[&str]| Factor {
        name: name.to_owned(),
        is_exact: false,
        levels: levels.iter().map(|level| (*level).to_owned()).collect(),
    };
    let chosen = [factor("alpha_min", &["1/64", "1/32"]), factor("sh_degree", &["0"])];
    Report::new(&study, &chosen, outcomes.collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn effects_are_paired_with_the_exact_one_of_the_same_seed() {
        let report = sample();
        let of = |level: &str| report.effects.iter().find(|e| e.level == level).expect("there");
        let equal = of("1/64");
        assert!(equal.psnr.mean.abs() < 1e-12 && equal.same == 3);
        assert!((equal.seconds.mean.exp() - 0.9).abs() < 1e-12);
        let bad = of("1/32");
        assert!((bad.psnr.mean + 0.9).abs() < 1e-12 && bad.same == 0);
    }
}
