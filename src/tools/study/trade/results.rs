//! The effect of each factor at each level.

use super::levels::Factor;
use super::{BASE, Outcome, Trade};
use crate::difference::{Difference, Pair, mean};
use crate::distinct;

/// A study's results.
pub(super) struct Results {
    pub(super) study: Trade,
    /// Labels of the scenes.
    pub(super) scenes: Vec<String>,
    pub(super) outcomes: Vec<Outcome>,
    pub(super) effects: Vec<Effect>,
}

/// Effect of a factor at a level, compared with `exact`.
pub(super) struct Effect {
    pub(super) factor: Factor,
    pub(super) level: String,
    pub(super) psnr: Difference,
    pub(super) ssim: Difference,
    /// Logarithm of the ratio of wall times.
    pub(super) seconds: Difference,
    /// Logarithm of the ratio of processor times, which depend less on other programs.
    pub(super) cpu: Option<Difference>,
    /// Logarithm of the ratio of peak memory.
    pub(super) peak: Difference,
    /// Number of runs whose model is identical to that of `exact`.
    pub(super) identical: usize,
}

/// A quantity of a run; `None` if it was not measured.
type Measure = fn(&Outcome) -> Option<f64>;

pub(super) const PSNR: Measure = |r| Some(r.psnr);
const SSIM: Measure = |r| Some(r.ssim);
pub(super) const LOG_SECONDS: Measure = |r| positive(r.seconds).map(f64::ln);
const LOG_CPU: Measure = |r| positive(r.cpu_seconds?).map(f64::ln);
/// Logarithm of the peak memory, or of the promised memory if the system does not report the peak.
const LOG_PEAK: Measure = |r| positive(r.peak_bytes.unwrap_or(r.ledger_bytes) as f64).map(f64::ln);

fn positive(value: f64) -> Option<f64> {
    (value.is_finite() && value > 0.0).then_some(value)
}

impl Results {
    pub(super) fn new(study: &Trade, chosen: &[Factor], outcomes: Vec<Outcome>) -> Self {
        let scenes = distinct(outcomes.iter().map(|outcome| outcome.scene.clone()));
        let mut results = Self { study: study.clone(), scenes, outcomes, effects: Vec::new() };
        for factor in chosen {
            for level in &factor.levels {
                results.effects.extend(results.effect(factor, level));
            }
        }
        results
    }

    /// The runs with a factor at a level.
    pub(super) fn runs(&self, factor: &str, level: &str) -> impl Iterator<Item = &Outcome> {
        self.outcomes.iter().filter(move |run| run.factor == factor && run.level == level)
    }

    /// The runs with a factor at a level, each with the `exact` run of the same scene and seed.
    fn pairs(&self, factor: &str, level: &str) -> Vec<(&Outcome, &Outcome)> {
        let base = |run: &Outcome| {
            self.runs(BASE, "").find(|base| (&base.scene, base.seed) == (&run.scene, run.seed))
        };
        self.runs(factor, level).filter_map(|run| Some((run, base(run)?))).collect()
    }

    fn effect(&self, factor: &Factor, level: &str) -> Option<Effect> {
        let name = &*factor.name;
        let pairs = self.pairs(name, level);
        let difference = |measure: Measure| {
            let pairs = pairs.iter().filter_map(|(run, base)| {
                let difference = measure(run)? - measure(base)?;
                Some(Pair { scene: &run.scene, seed: run.seed, difference })
            });
            Difference::new(&pairs.collect::<Vec<_>>())
        };
        let identical = pairs.iter().filter(|(run, base)| run.model == base.model).count();
        Some(Effect {
            factor: factor.clone(),
            level: level.to_owned(),
            psnr: difference(PSNR)?,
            ssim: difference(SSIM)?,
            seconds: difference(LOG_SECONDS)?,
            cpu: difference(LOG_CPU),
            peak: difference(LOG_PEAK)?,
            identical,
        })
    }

    /// Mean of a quantity over the runs with a factor at a level in a scene; `None` if any run did not measure it.
    pub(super) fn mean(
        &self,
        scene: &str,
        factor: &str,
        level: &str,
        measure: Measure,
    ) -> Option<f64> {
        let runs = self.runs(factor, level).filter(|run| run.scene == scene);
        mean(runs.map(measure).collect::<Option<Vec<f64>>>()?)
    }

    /// Geometric mean of the peak memory of the runs with a factor at a level in a scene `[MiB]`.
    pub(super) fn peak_mib(&self, scene: &str, factor: &str, level: &str) -> Option<f64> {
        self.mean(scene, factor, level, LOG_PEAK).map(|peak| peak.exp() / f64::from(1 << 20))
    }
}

/// Results for tests.
#[cfg(test)]
pub(super) fn sample() -> Results {
    let outcome = |factor: &str, level: &str, seed, psnr: f64, seconds: f64| Outcome {
        peak_bytes: Some(64 << 20),
        seconds,
        ..crate::outcome::sample(factor, level, seed, psnr)
    };
    let outcomes = (0..3).flat_map(|seed| {
        let offset = f64::from(seed);
        [
            outcome("", "", seed, 30.0 + offset, 100.0),
            outcome("alpha_min", "1/64", seed, 30.0 + offset, 90.0),
            outcome("alpha_min", "1/32", seed, 29.0 + 1.1 * offset, 95.0),
            outcome("sh_degree", "0", seed, 30.2 + offset, 50.0),
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
    Results::new(&study, &chosen, outcomes.collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn effects_are_paired_with_the_exact_run_of_the_same_seed() {
        let results = sample();
        let effect =
            |level: &str| results.effects.iter().find(|e| e.level == level).expect("a level");
        let equal = effect("1/64");
        assert!(equal.psnr.mean.abs() < 1e-12 && equal.identical == 3);
        assert!((equal.seconds.mean.exp() - 0.9).abs() < 1e-12);
        let bad = effect("1/32");
        assert!((bad.psnr.mean + 0.9).abs() < 1e-12 && bad.identical == 0);
    }
}
