//! `--budget auto` measures during training without affecting it: if no decision follows, the run has the same bits as
//! one without measurements.

use densify::core::gaussians::Gaussians;
use densify::data::dataset::{Dataset, LoadOptions};
use densify::data::views::DatasetViews;
use densify::render::{Backend, Storage, Tensor};
use densify::selftest::{Setup, Subject};
use densify::train::init::initialise;
use densify::train::schedule::{Background, RateOptions};
use densify::train::trainer::{AutoChoices, OnNan, TrainOptions, Trainer, growth_signals};
use densify_policies::plan::EditPlan;
use densify_policies::policy::{DensityPolicy, Needs, PolicyError, SceneInfo, Snapshot};
use densify_policies::rng::PolicyRng;

use crate::photographs::Photographs;
use crate::subject::{devices, make_with, saved, storages};

const ROWS: usize = 60;
/// In a run of this length, the PSNR is measured at steps 100 and 200.
const ITERATIONS: u32 = 250;
/// The step of the last measurement, which is repeated with the rows of lowest weight hidden.
const MEASURED_AT: u32 = 200;

/// A policy that never edits.
struct Idle;

impl DensityPolicy for Idle {
    fn needs(&self, _: &SceneInfo) -> Needs {
        needs()
    }
    fn is_due(&self, _: u32) -> bool {
        false
    }
    fn plan(&mut self, _: &Snapshot, _: &PolicyRng, _: &mut EditPlan) -> Result<(), PolicyError> {
        Ok(())
    }
}

fn needs() -> Needs {
    Needs { signals: growth_signals(), ..Needs::default() }
}

/// The state of a run after [`MEASURED_AT`] steps with or without measurements.
fn state(backend: Box<dyn Backend>, dataset: &Dataset, measures: bool) -> (Gaussians, Vec<Tensor>) {
    let scene = SceneInfo {
        extent: 1.0,
        train_views: dataset.train.len() as u32,
        budget: backend.budget(),
        initial_rows: ROWS,
        iterations: ITERATIONS,
        white_background: false,
    };
    let options = TrainOptions {
        iterations: ITERATIONS,
        seed: 7,
        sh_degree: 1,
        background: Background::Black,
        rates: RateOptions::default(),
        prefetch: 0,
        frozen: 0,
        has_all_bands: false,
        on_nan: OnNan::Stop,
        depth: None,
        distortion: 0.0,
        removes_floaters: false,
    };
    let views = DatasetViews::new(dataset.train.clone(), 1 << 20, 1);
    let trainer = Trainer::new(views, backend, ("idle", Box::new(Idle)), scene, options);
    let mut trainer = trainer.expect("consistent options");
    trainer = trainer.with_auto_choices(AutoChoices { rows: measures, ..AutoChoices::default() });
    for _ in 0..MEASURED_AT {
        trainer.step().expect("a small image is rendered");
    }
    if measures {
        let growth = trainer.progress().auto_budget.as_ref().expect("it measures");
        let removals: Vec<_> = growth.removals.iter().map(|s| (s.before, s.after)).collect();
        assert_eq!((growth.intervals.len(), &*removals), (2, &[(ROWS, ROWS)][..]), "{growth:?}");
    }
    saved(trainer.backend())
}

#[test]
fn measuring_does_not_change_the_run() {
    let photographs = Photographs::colmap_text();
    let dataset = Dataset::load(photographs.path(), &LoadOptions::default()).expect("a dataset");
    let (model, _) = initialise(&dataset.points, ROWS, 1, 7).expect("points to start from");
    let stored = storages().map(|storage| (Subject::NATIVE, storage));
    let device = devices().first().map(|device| (Subject::Gpu(device.clone()), Storage::default()));
    for (subject, storage) in stored.into_iter().chain(device) {
        let [without, with] = [false, true].map(|measures| {
            let setup = Setup { storage, needs: needs(), ..Setup::default() };
            state(make_with(&subject, &model, setup), &dataset, measures)
        });
        assert!(with == without, "{}, {storage:?}", subject.name());
    }
}
