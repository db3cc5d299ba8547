//! `--budget auto` measures along the run, and leaves the model, and all that its future depends on,
//! as they were: after measurements from which nothing follows, a run has the same bits as one that
//! measured nothing.

use std::sync::Arc;

use densify::backend::cpu::{CpuBackend, CpuOptions};
use densify::backend::gpu::{GpuBackend, GpuOptions};
use densify::backend::{Backend, MomentStorage, ParameterStorage, Storage, Tensor};
use densify::camera::Camera;
use densify::dataset::images::{Image8, SharedImage};
use densify::gaussians::Gaussians;
use densify::schedule::{Background, RateOptions};
use densify::trainer::{AutoChoices, OnNan, Savings, TrainOptions, Trainer, growth_signals};
use densify::verify::scenes;
use densify::views::{ViewError, ViewSource};
use densify_policies::plan::EditPlan;
use densify_policies::policy::{
    DensityPolicy, Needs, PolicyError, PolicyState, SceneInfo, Snapshot,
};
use densify_policies::rng::PolicyRng;
use glam::DVec3;

use crate::subject::devices;

const ROWS: usize = 60;
/// The probes are measured at step 100, and at step 200 also without the rows of least weight.
const ITERATIONS: u32 = 250;
const MEASURED_AT: u32 = 200;

/// Edits nothing.
struct Idle;

impl DensityPolicy for Idle {
    fn needs(&self, _: &SceneInfo) -> Needs {
        Needs { signals: growth_signals(), ..Needs::default() }
    }
    fn is_due(&self, _: u32) -> bool {
        false
    }
    fn plan(
        &mut self,
        _: &Snapshot<'_>,
        _: &PolicyRng,
        _: &mut EditPlan,
    ) -> Result<(), PolicyError> {
        Ok(())
    }
    fn save(&self) -> PolicyState {
        PolicyState::Null
    }
    fn restore(&mut self, _: PolicyState) -> Result<(), PolicyError> {
        Ok(())
    }
}

#[derive(Clone)]
struct Views(Vec<(Camera, SharedImage)>);

impl ViewSource for Views {
    fn count(&self) -> usize {
        self.0.len()
    }
    fn name(&self, _: usize) -> &str {
        "a view"
    }
    fn camera(&self, view: usize) -> &Camera {
        &self.0[view].0
    }
    fn image(&self, view: usize) -> Result<SharedImage, ViewError> {
        Ok(self.0[view].1.clone())
    }
    fn prefetch(&self, _: &[usize]) {}
}

/// A model, and photographs of another one whose colours are others.
fn scene() -> (Gaussians, Views) {
    let camera = scenes::camera(40, 32, 11);
    let truth = scenes::cloud(ROWS, 1, &camera, 12);
    let mut native = CpuBackend::new(&truth, &CpuOptions::new(ROWS)).expect("a small model fits");
    let photograph = |view: u32| {
        let aside = DVec3::new(0.02 * f64::from(view), 0.0, 0.0);
        let camera = scenes::rounded(&Camera { translation: camera.translation + aside, ..camera });
        let rendering = native.render(&camera, [0.0; 3], 1).expect("a small image");
        let byte = |x: &f32| (x.clamp(0.0, 1.0) * 255.0).round() as u8;
        let rgb = rendering.rgb.iter().map(byte).collect();
        let (width, height) = (camera.width, camera.height);
        (camera, Arc::new(Image8 { width, height, rgb, alpha: None, mask: None }))
    };
    let views = Views((0..8).map(photograph).collect());
    let mut model = truth;
    model.sh.iter_mut().enumerate().for_each(|(i, x)| *x += 0.2 * (i as f32 * 1.7).sin());
    (model, views)
}

/// The bits of a run from which it goes on, after [`MEASURED_AT`] steps with or without measurements.
fn bits(backend: Box<dyn Backend>, views: &Views, measures: bool) -> (Gaussians, Vec<Tensor>) {
    let scene = SceneInfo {
        extent: 1.0,
        train_views: views.count() as u32,
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
        sh_every: None,
        prefetch: 0,
        on_nan: OnNan::Stop,
        savings: Savings::NONE,
    };
    let trainer = Trainer::new(views.clone(), backend, ("idle", Box::new(Idle)), scene, options);
    let mut trainer = trainer.expect("they agree");
    trainer = trainer.requiring(AutoChoices { rows: measures, ..AutoChoices::default() });
    for _ in 0..MEASURED_AT {
        trainer.step().expect("a small image is rendered");
    }
    if measures {
        let growth = trainer.growth().expect("it measures");
        let removals: Vec<_> = growth.removals.iter().map(|s| (s.before, s.after)).collect();
        assert_eq!((growth.intervals.len(), &*removals), (2, &[(ROWS, ROWS)][..]), "{growth:?}");
    }
    let backend = trainer.backend();
    let names = backend.state();
    let saved = names.iter().map(|array| backend.save(&array.name).expect("an array"));
    (backend.download().expect("a model"), saved.collect())
}

#[test]
fn measuring_changes_no_bit() {
    let (model, views) = scene();
    let needs = Needs { signals: growth_signals(), ..Needs::default() };
    let compare = |name: &str, backend: &dyn Fn() -> Box<dyn Backend>| {
        let [without, with] = [false, true].map(|measures| bits(backend(), &views, measures));
        assert!(with.0 == without.0, "{name}: another model");
        for (with, without) in with.1.iter().zip(&without.1) {
            assert!(with == without, "{name}: {} differs", with.name);
        }
        assert_eq!(with.1.len(), without.1.len());
    };
    for parameters in [ParameterStorage::F32, ParameterStorage::F16] {
        for moments in [MomentStorage::F32, MomentStorage::Both8] {
            let storage = Storage { parameters, moments };
            compare(&format!("{storage:?}"), &|| {
                let needs = needs.clone();
                let options = CpuOptions { storage, needs, ..CpuOptions::new(ROWS) };
                Box::new(CpuBackend::new(&model, &options).expect("a small model fits"))
            });
        }
    }
    if let Some(device) = devices().first() {
        compare(&device.adapter().name, &|| {
            let options = GpuOptions { needs: needs.clone(), ..GpuOptions::new(ROWS) };
            Box::new(GpuBackend::new(&model, &options, device).expect("a small model fits"))
        });
    }
}
