//! Policies on scenes whose geometry is known exactly: small views of built-in scenes, short runs,
//! fixed seeds.

mod policies;

use std::ops::ControlFlow;
use std::path::Path;

use densify::dataset::{Dataset, LoadOptions, Split, builtin};
use densify::evaluate::{Mean, evaluate};
use densify::gaussians::Gaussians;
use densify::init::{initialise, restart};
use densify::metrics::geometry::{self, Geometry, KnownScene};
use densify::schedule::{Background, RateOptions};
use densify::trainer::{OnNan, Savings, TrainOptions, Trainer, needs};
use densify::verify::{Setup, Subject};
use densify::views::DatasetViews;
use densify_policies::policy::SceneInfo;
use densify_policies::registry::find;
use densify_scenegen::{Generated, GroundTruth, Options, PointOptions, Source, generate};
use toml::Table;

use crate::subject::make_with;

/// A built-in scene, small, with its ground truth.
pub(crate) struct Known {
    name: &'static str,
    dataset: Dataset,
    truth: GroundTruth,
}

/// What is trained.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Run<'a> {
    pub(crate) policy: &'a str,
    /// Parameters as TOML.
    pub(crate) set: &'a str,
    pub(crate) budget: usize,
    pub(crate) iterations: u32,
    pub(crate) seed: u64,
}

/// What came of it.
pub(crate) struct Outcome {
    pub(crate) geometry: Geometry,
    pub(crate) psnr: f64,
    pub(crate) ssim: f64,
    pub(crate) rows: usize,
    pub(crate) peak: usize,
}

impl Known {
    /// 24 views of a scene to train on and 6 held out, and so many points to start from.
    pub(crate) fn new(name: &'static str, side: u32, points: usize) -> Self {
        let options = Options {
            size: Some((side, side)),
            train: Some(24),
            test: Some(6),
            points: PointOptions { count: points, ..PointOptions::default() },
            ..Options::default()
        };
        let generated = generate(&Source::Preset(name.to_owned()), &options).expect("a preset");
        let Generated { scene, frames, points } = generated;
        let options = LoadOptions { split: Split::Eval, ..LoadOptions::default() };
        let path = Path::new("in memory");
        let dataset = builtin::dataset(path, &scene, frames, points, &options).expect("views");
        Self { name, dataset, truth: GroundTruth::of_scene(scene) }
    }

    /// Trains and measures on the native backend.
    pub(crate) fn train(&self, run: Run<'_>) -> Outcome {
        self.train_on(&Subject::NATIVE, run)
    }

    /// Trains and measures on this backend. The budget is held at every step.
    #[expect(
        clippy::print_stderr,
        reason = "the numbers, where a test fails or is asked to show them"
    )]
    pub(crate) fn train_on(&self, subject: &Subject, run: Run<'_>) -> Outcome {
        let Self { dataset, truth, .. } = self;
        let entry = find(run.policy).expect("a policy");
        let (mut model, _) =
            initialise(&dataset.points, run.budget, 0, run.seed).expect("points to start from");
        let scene = SceneInfo {
            extent: dataset.extent() as f32,
            train_views: dataset.train.len() as u32,
            budget: run.budget,
            initial_rows: model.len(),
            iterations: run.iterations,
            white_background: false,
        };
        let set: Table = run.set.parse().expect("TOML");
        let policy = entry.build(&set, &scene).expect("parameters");
        let declared = policy.needs(&scene);
        restart(&mut model, &declared.start);
        let options = TrainOptions {
            iterations: run.iterations,
            seed: run.seed,
            sh_degree: 0,
            background: Background::Black,
            rates: RateOptions::for_run(run.iterations).with(&declared.rates),
            sh_every: None,
            prefetch: 0,
            on_nan: OnNan::Prune,
            savings: Savings::NONE,
        };
        let near = Some((0.04 * dataset.extent()) as f32);
        let make = |model: &Gaussians, budget, needs| {
            make_with(subject, model, Setup { budget, near, needs, ..Setup::default() })
        };
        let needs = needs(policy.as_ref(), &scene, options.sh_every);
        let first = make(&model, run.budget, needs);
        let views =
            |views: &[densify::dataset::View]| DatasetViews::new(views.to_vec(), 1 << 30, 1);
        let (train, test) = (views(&dataset.train), views(&dataset.test));
        let mut trainer =
            Trainer::new(views(&dataset.train), first, (run.policy, policy), scene, options)
                .expect("a run");
        for _ in 0..run.iterations {
            let report = trainer.step().expect("a step");
            assert!(report.rows <= run.budget, "{run:?}: {} rows", report.rows);
        }
        let model = trainer.model().expect("a model");
        let mut last = make(&model, model.len().max(1), geometry::needs());
        let ground = KnownScene {
            truth,
            normalisation: &dataset.normalisation,
            background: [0.0; 3],
            sh_degree: 0,
        };
        let scores = evaluate(last.as_mut(), &test, [0.0; 3], 0, |_| ControlFlow::Continue(()));
        let scores = Mean::of(&scores.expect("scores"));
        let outcome = Outcome {
            geometry: geometry::measure(last.as_mut(), &ground, &train, &test).expect("measured"),
            psnr: scores.psnr,
            ssim: scores.ssim,
            rows: model.len(),
            peak: trainer.peak_rows(),
        };
        eprintln!("{:8} {:8} seed {}: {outcome}", self.name, run.policy, run.seed);
        outcome
    }
}

impl std::fmt::Display for Outcome {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { geometry: g, psnr, ssim, rows, peak } = self;
        write!(
            f,
            "PSNR {psnr:.2}, SSIM {ssim:.4}, rows {rows}, peak {peak}, depth RMSE {:.2} %, AbsRel \
             {:.2} %, coverage {:.1} %, normals {:.1}°, Chamfer {:.2} %, F 1 % {:.1} %, floaters {} \
             ({:.2} % of rows, {:.2} % of weight), {:.1} per pixel, idle {:.1} %, thin",
            100.0 * g.depth.rmse,
            100.0 * g.depth.abs_rel,
            100.0 * g.depth.coverage,
            g.normal_error,
            100.0 * g.centres.chamfer,
            100.0 * g.centres.f_score_one_percent,
            g.floaters.count,
            100.0 * g.floaters.of_rows,
            100.0 * g.floaters.of_weight,
            g.redundancy.blended_per_pixel,
            100.0 * g.redundancy.below_one_percent,
        )?;
        for thin in &g.thin {
            write!(f, " {} px: {:.0} % of {}", thin.width, 100.0 * thin.recall, thin.pixels)?;
        }
        Ok(())
    }
}
