//! What the records of a study say, level by level.

use super::effects::{
    FACTORS, Price, RUNS, dominated_by, error_of_effects, is_free, main_effects, stands_out,
};
use super::levels::Factor;
use super::{BASE, ImageError, Outcome, Trade};
use crate::knobs::Class;
use crate::study::difference::{Difference, Pair, mean};
use crate::study::distinct;

/// A study's results.
pub(super) struct Report {
    pub(super) study: Trade,
    /// Labels of the scenes.
    pub(super) scenes: Vec<String>,
    pub(super) outcomes: Vec<Outcome>,
    pub(super) images: Vec<ImageError>,
    pub(super) effects: Vec<Effect>,
    pub(super) together: Vec<Together>,
}

/// What a knob does at a level, against `exact`.
pub(super) struct Effect {
    pub(super) factor: Factor,
    pub(super) level: String,
    pub(super) psnr: Difference,
    pub(super) ssim: Difference,
    pub(super) flip: Difference,
    /// Logarithms of ratios, as the next four.
    pub(super) depth: Option<Difference>,
    pub(super) chamfer: Option<Difference>,
    pub(super) seconds: Difference,
    /// Of processor time, which other programs disturb less.
    pub(super) cpu: Option<Difference>,
    pub(super) peak: Difference,
    /// Runs whose model is that of `exact` to the bit.
    pub(super) same: usize,
    /// Least over scenes, of images against the float64 renderer `[dB]`.
    pub(super) numerical: Option<f64>,
    pub(super) free: bool,
    /// Which other level is nowhere worse, and somewhere better.
    pub(super) dominated: Option<String>,
    /// Whether PSNR or time differ by more than two standard errors.
    pub(super) stands_out: bool,
}

/// A knob among others.
pub(super) struct Together {
    pub(super) knob: String,
    pub(super) level: String,
    /// Effects on PSNR `[dB]` and on the logarithm of time: alone, and among the others.
    pub(super) alone: [f64; 2],
    pub(super) among: [f64; 2],
    /// Standard errors of the latter.
    pub(super) errors: Option<[f64; 2]>,
}

/// A number of a run; none where it was not measured.
type Measure = fn(&Outcome) -> Option<f64>;

pub(super) const PSNR: Measure = |r| Some(r.psnr);
const SSIM: Measure = |r| Some(r.ssim);
const FLIP: Measure = |r| Some(r.flip);
const DEPTH: Measure = |r| positive(r.geometry.as_ref()?.depth.abs_rel).map(f64::ln);
const CHAMFER: Measure = |r| positive(r.geometry.as_ref()?.centres.chamfer).map(f64::ln);
pub(super) const SECONDS: Measure = |r| positive(r.seconds).map(f64::ln);
const CPU: Measure = |r| positive(r.cpu_seconds?).map(f64::ln);
/// Where the system does not say, what was promised.
const PEAK: Measure = |r| positive(r.peak_bytes.unwrap_or(r.ledger_bytes) as f64).map(f64::ln);

fn positive(value: f64) -> Option<f64> {
    (value.is_finite() && value > 0.0).then_some(value)
}

impl Report {
    pub(super) fn new(
        study: &Trade,
        chosen: &[Factor],
        outcomes: Vec<Outcome>,
        images: Vec<ImageError>,
    ) -> Self {
        let scenes = distinct(outcomes.iter().map(|outcome| outcome.scene.clone()));
        let mut report = Self {
            study: study.clone(),
            scenes,
            outcomes,
            images,
            effects: Vec::new(),
            together: Vec::new(),
        };
        for one in chosen {
            for level in &one.levels {
                report.effects.extend(report.effect(one, level));
            }
        }
        report.rank();
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
        let (psnr, ssim, depth) = (of(PSNR)?, of(SSIM)?, of(DEPTH));
        let pairs = self.pairs(name, level);
        let same = pairs.iter().filter(|(run, base)| run.model == base.model).count();
        let numerical = self.numerical(name, level);
        let free = is_free(&psnr, &ssim, depth.as_ref(), numerical);
        let stand_out = [PSNR, SECONDS].map(|of| {
            let all = self.differences(name, level, of).into_iter();
            stands_out(&all.map(|pair| pair.difference).collect::<Vec<_>>())
        });
        Some(Effect {
            factor: factor.clone(),
            level: level.to_owned(),
            free,
            psnr,
            ssim,
            flip: of(FLIP)?,
            depth,
            chamfer: of(CHAMFER),
            seconds: of(SECONDS)?,
            cpu: of(CPU),
            peak: of(PEAK)?,
            same,
            numerical,
            dominated: None,
            stands_out: stand_out.contains(&true),
        })
    }

    /// The least over scenes, of images with a knob at a level.
    fn numerical(&self, knob: &str, level: &str) -> Option<f64> {
        let here = self.images.iter().filter(|i| i.knob == knob && i.level == level);
        here.map(|image| image.standard).reduce(f64::min)
    }

    /// Says which levels are dominated, by others or by `exact`.
    fn rank(&mut self) {
        let price = |effect: &Effect| Price {
            psnr: effect.psnr.mean,
            seconds: effect.seconds.mean.exp(),
            peak: effect.peak.mean.exp(),
        };
        let exact = Price { psnr: 0.0, seconds: 1.0, peak: 1.0 };
        let prices: Vec<Price> =
            std::iter::once(exact).chain(self.effects.iter().map(price)).collect();
        let names: Vec<String> = std::iter::once("exact".to_owned())
            .chain(self.effects.iter().map(|e| format!("{}={}", e.factor.name, e.level)))
            .collect();
        for (i, effect) in self.effects.iter_mut().enumerate() {
            effect.dominated = dominated_by(&prices, i + 1).map(|by| names[by].clone());
        }
    }

    /// The knobs that stand out, each at the fastest of its levels that does; as many as there is room
    /// for. Those that only say how large a run is are left out, and those that are several knobs.
    pub(super) fn knobs_that_stand_out(&self) -> Vec<(String, String)> {
        let mut found: Vec<&Effect> = Vec::new();
        for effect in &self.effects {
            let sized = effect.factor.is_size;
            let several = effect.factor.name == "preset";
            if !effect.stands_out || sized || several || effect.factor.class == Class::Exact {
                continue;
            }
            match found.iter_mut().find(|other| other.factor.name == effect.factor.name) {
                Some(other) if effect.seconds.mean < other.seconds.mean => *other = effect,
                Some(_) => {}
                None => found.push(effect),
            }
        }
        found.sort_by(|a, b| a.seconds.mean.total_cmp(&b.seconds.mean));
        found.truncate(FACTORS);
        found.iter().map(|e| (e.factor.name.clone(), e.level.clone())).collect()
    }

    /// Adds the runs in which several knobs were changed.
    pub(super) fn add_factorial(&mut self, knobs: Vec<(String, String)>, runs: Vec<Outcome>) {
        let of = |measure: Measure| {
            let mut sums = [0.0; FACTORS];
            let mut scenes = 0_u32;
            for scene in &self.scenes {
                let here = |i: usize| {
                    let number = (i + 1).to_string();
                    runs.iter().find(|r| r.scene == *scene && r.level == number).and_then(measure)
                };
                let responses: Option<Vec<f64>> = (0..RUNS).map(here).collect();
                let Some(responses) = responses.and_then(|r| <[f64; RUNS]>::try_from(r).ok())
                else {
                    continue;
                };
                scenes += 1;
                for (sum, effect) in sums.iter_mut().zip(main_effects(&responses)) {
                    *sum += effect;
                }
            }
            (scenes > 0).then(|| sums.map(|sum| sum / f64::from(scenes)))
        };
        let (Some(psnr), Some(seconds)) = (of(PSNR), of(SECONDS)) else { return };
        let idle = |all: &[f64; FACTORS]| error_of_effects(&all[knobs.len()..]);
        let errors = idle(&psnr).zip(idle(&seconds)).map(|(a, b)| [a, b]);
        let alone = |knob: &str, level: &str| {
            let effect = self.effects.iter().find(|e| e.factor.name == knob && e.level == level);
            effect.map_or([f64::NAN; 2], |e| [e.psnr.mean, e.seconds.mean])
        };
        let together = knobs.iter().enumerate().map(|(k, (knob, level))| Together {
            knob: knob.clone(),
            level: level.clone(),
            alone: alone(knob, level),
            among: [psnr[k], seconds[k]],
            errors,
        });
        self.together = together.collect();
        self.outcomes.extend(runs);
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
        stage_seconds: [("rasterize".to_owned(), 0.5 * seconds)].into(),
        ..crate::study::record::sample(knob, level, seed, psnr)
    };
    let outcomes = (0..3).flat_map(|seed| {
        let by = f64::from(seed);
        [
            outcome("", "", seed, 30.0 + by, 100.0),
            outcome("alpha_min", "1/64", seed, 30.0 + by, 90.0),
            outcome("alpha_min", "1/32", seed, 29.0 + 1.1 * by, 95.0),
            outcome("ssim_every", "5", seed, 30.2 + by, 50.0),
        ]
    });
    let image = |knob: &str, level: &str, standard| ImageError {
        densify: "1".into(),
        scene: "room".into(),
        knob: knob.into(),
        level: level.into(),
        spec: toml::Table::new(),
        standard,
        everything: standard - 1.0,
        worst: 0.01,
    };
    let study = Trade {
        scenes: vec!["scene:room".into()],
        knobs: Vec::new(),
        seeds: 3,
        iterations: 100,
        budget: 1000,
        no_factorial: false,
        output: "x".into(),
        train: vec!["--policy=diet".into()],
    };
    let factor = |name: &str, levels: &[&str]| Factor {
        name: name.to_owned(),
        class: crate::knobs::find(name).expect("a knob").class,
        is_size: false,
        levels: levels.iter().map(|level| (*level).to_owned()).collect(),
    };
    let chosen = [factor("alpha_min", &["1/64", "1/32"]), factor("ssim_every", &["5"])];
    let images = vec![
        image("", "", 120.0),
        image("alpha_min", "1/64", 61.0),
        image("alpha_min", "1/32", 42.0),
    ];

    Report::new(&study, &chosen, outcomes.collect(), images)
}

#[cfg(test)]
mod tests {
    use super::super::effects::plackett_burman;
    use super::*;

    #[test]
    fn effects_are_paired_with_the_exact_one_of_the_same_seed() {
        let report = sample();
        let of = |level: &str| report.effects.iter().find(|e| e.level == level).expect("there");
        let free = of("1/64");
        assert!(free.psnr.mean.abs() < 1e-12 && free.same == 3 && free.free);
        assert!((free.seconds.mean.exp() - 0.9).abs() < 1e-12 && free.numerical == Some(61.0));
        let bad = of("1/32");
        assert!((bad.psnr.mean + 0.9).abs() < 1e-12 && bad.same == 0 && !bad.free);
        assert_eq!(bad.dominated.as_deref(), Some("alpha_min=1/64"));
        assert!(bad.stands_out);
        // Faster and better than all others, and without an image to look at.
        let best = of("5");
        assert!(best.free && best.dominated.is_none() && best.numerical.is_none());
        assert_eq!(free.dominated.as_deref(), Some("ssim_every=5"));
        let together = report.knobs_that_stand_out();
        assert_eq!(together[0], ("ssim_every".to_owned(), "5".to_owned()));
        assert_eq!(together[1], ("alpha_min".to_owned(), "1/64".to_owned()));
    }

    #[test]
    fn effects_among_others_come_from_the_factorial() {
        let mut report = sample();
        let knobs = report.knobs_that_stand_out();
        let runs = plackett_burman().into_iter().enumerate().map(|(i, run)| Outcome {
            factor: "factorial".into(),
            level: (i + 1).to_string(),
            psnr: 30.0 + if run[0] { 0.5 } else { 0.0 } - if run[1] { 0.25 } else { 0.0 },
            seconds: 100.0 * if run[0] { 0.5 } else { 1.0 },
            ..report.outcomes[0].clone()
        });
        let runs: Vec<Outcome> = runs.collect();
        report.add_factorial(knobs, runs);
        let [first, second] = &report.together[..] else { panic!("two knobs") };
        assert!((first.among[0] - 0.5).abs() < 1e-9 && (first.among[1].exp() - 0.5).abs() < 1e-9);
        assert!((second.among[0] + 0.25).abs() < 1e-9 && second.among[1].abs() < 1e-9);
        assert!((first.alone[0] - 0.2).abs() < 1e-9);
        assert!(first.errors.is_some_and(|e| e[0] < 1e-9));
    }
}
