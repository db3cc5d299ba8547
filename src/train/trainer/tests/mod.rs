//! Tests of the training loop with a backend that only counts rows, and a scripted policy.

use std::sync::{Arc, Mutex};

use densify_policies::adc::split_by;
use densify_policies::plan::{EditPlan, RowOps};
use densify_policies::policy::{
    AuxColumn, AuxRequest, AuxView, Candidate, PolicyError, Signal, SignalSet, Signals, Snapshot,
};
use densify_policies::rng::PolicyRng;
use glam::{DMat3, DVec3};

use super::*;
use crate::schedule::{Background, RateOptions};
use densify_core::antialiasing::Antialiasing;
use densify_core::camera::Camera;
use densify_core::colour::ColourGradient;
use densify_core::gaussians::ModelArray;
use densify_core::image::{Image8, SharedImage};
use densify_core::memory::Ledger;
use densify_core::pose::PoseGradient;
use densify_data::views::ViewError;
use densify_render::{
    AuxInput, AuxOutput, BackendError, NonFinite, NumberKind, Rendering, StateArray, StateError,
    StepOutput, Tensor,
};

mod edits;
mod floaters;
mod nonfinite;
mod policy_views;
mod steps;

/// All calls to the backend, or to the source of views, of a test, in order.
type CallLog = Arc<Mutex<Vec<String>>>;

fn note(log: &CallLog, call: String) {
    log.lock().unwrap().push(call);
}

struct CountingBackend {
    rows: usize,
    budget: usize,
    nan_loss_at: u32,
    /// Number of rows with non-finite values, until an edit removes them.
    unsound: u32,
    log: CallLog,
    ledger: Ledger,
}

impl Backend for CountingBackend {
    fn rows(&self) -> usize {
        self.rows
    }
    fn antialiasing(&self) -> Antialiasing {
        Antialiasing::None
    }

    fn sh_degree(&self) -> u8 {
        0
    }
    fn budget(&self) -> usize {
        self.budget
    }
    fn ledger(&self) -> &Ledger {
        &self.ledger
    }
    fn begin_epoch(&mut self) {
        note(&self.log, "epoch".into());
    }
    fn train_step(&mut self, input: &StepInput<'_>) -> Result<StepOutput, BackendError> {
        note(&self.log, format!("step {} view {}", input.step, input.target.rgb[0]));
        let Camera { width, height, cx, fy, .. } = *input.camera;
        assert_eq!((input.target.width, input.target.height), (width, height));
        if (width, height) != (SIDE, SIDE) {
            note(&self.log, format!("size {width}x{height}, cx {cx}, fy {fy}"));
        }
        if input.cadence != Cadence::default() {
            let Cadence { all, sh_rest } = input.cadence;
            note(&self.log, format!("cadence {all} {sh_rest}"));
        }
        let terms = (input.loss_terms.opacity, input.noise.map(|noise| noise.strength));
        if terms != (0.0, None) {
            note(&self.log, format!("terms {terms:?}"));
        }
        if let Some(exposure) = input.exposure {
            note(&self.log, format!("exposure {}", exposure.matrix[1][1]));
        }
        let gradient = ColourGradient { matrix: [[1.0; 3]; 3], offset: [0.0; 3] };
        let exposure = input.exposure.map(|_| gradient);
        if input.pose {
            note(&self.log, format!("camera at {:.6}", input.camera.translation.y));
        }
        let pose = input.pose.then(|| PoseGradient { translation: DVec3::Y, ..Default::default() });
        let loss = if input.step == self.nan_loss_at { f32::NAN } else { 0.5 };
        Ok(StepOutput { loss, exposure, pose, ..StepOutput::default() })
    }
    fn observe(&mut self, input: &AuxInput<'_>) -> Result<AuxOutput, BackendError> {
        let (x, degree) = (input.camera.translation.x, input.sh_degree);
        note(&self.log, format!("observe {x}, pixel {}, degree {degree}", input.target.rgb[0]));
        assert_eq!((input.view as f64, input.seed), (x, 7));
        let columns = input.request.columns.iter().map(|&column| {
            let mut values = vec![x as f32; self.rows];
            if column == AuxColumn::WeightInFront {
                // Most of the weight of the second row, and half of that of the others.
                let share = |row: usize| if row == 1 { 0.6 } else { 0.5 };
                values.iter_mut().enumerate().for_each(|(row, value)| *value *= share(row));
            }
            (column, values)
        });
        Ok(AuxOutput { loss: 0.5, columns: columns.collect(), points: Vec::new() })
    }
    fn take_signals(&mut self, wanted: SignalSet) -> Result<Signals, BackendError> {
        Ok(Signals::zeros(self.rows, wanted))
    }
    fn candidates(&self) -> &[Candidate] {
        &[]
    }
    fn apply(&mut self, ops: &RowOps, _seed: u64, step: u32) -> Result<(), BackendError> {
        note(&self.log, format!("apply {step}"));
        assert_eq!(ops.rows_before, self.rows);
        self.rows = ops.rows_after;
        self.unsound = 0;
        Ok(())
    }
    fn audit(&mut self) -> Result<Vec<NonFinite>, BackendError> {
        let unsound =
            |row| NonFinite { row, array: ModelArray::OpacityLogits, kind: NumberKind::Moment };
        Ok((0..self.unsound).map(unsound).collect())
    }
    fn render(
        &mut self,
        camera: &Camera,
        _background: [f32; 3],
        _sh_degree: u8,
    ) -> Result<Rendering, BackendError> {
        Err(BackendError::ImageTooLarge { width: camera.width, height: camera.height, max: 0 })
    }
    fn download_array(
        &self,
        array: ModelArray,
        rows: std::ops::Range<usize>,
    ) -> Result<Vec<f32>, BackendError> {
        Ok(vec![0.0; array.parameters(0).len() * rows.len()])
    }
    fn upload_array(
        &mut self,
        _: ModelArray,
        _: std::ops::Range<usize>,
        _: &[f32],
    ) -> Result<(), BackendError> {
        Ok(())
    }
    fn state(&self) -> Vec<StateArray> {
        Vec::new()
    }
    fn save_rows(&self, name: &str, _: std::ops::Range<usize>) -> Result<Tensor, BackendError> {
        panic!("{name} is not kept")
    }
    fn restore_rows(
        &mut self,
        tensor: Tensor,
        _: std::ops::Range<usize>,
    ) -> Result<(), StateError> {
        Err(tensor.error("nothing is kept"))
    }
    fn stage_times(&self) -> &[(&'static str, std::time::Duration)] {
        &[]
    }
}

/// A policy that is due at multiples of `every`, with a fixed behaviour.
struct ScriptedPolicy {
    every: u32,
    aux_views: u32,
    cadence: Cadence,
    /// Loss terms and noise from step 7 on.
    terms: (LossTerms, Option<NoiseTerm>),
    /// Scale of the images up to step 2.
    resolution: f64,
    seen: Vec<f32>,
    behaviour: Behaviour,
}

#[derive(Clone, Copy, PartialEq)]
enum Behaviour {
    Split,
    Halve,
    Nothing,
    Fail,
    Panic,
    ReadUndeclared,
}

impl DensityPolicy for ScriptedPolicy {
    fn needs(&self, _scene: &SceneInfo) -> Needs {
        let signals = SignalSet::from([Signal::Opacity]);
        let aux = (self.aux_views > 0)
            .then(|| AuxRequest { columns: vec![AuxColumn::Depth], ..AuxRequest::default() });
        let cadence = Cadence { all: 4, sh_rest: 1 };
        let least_resolution = Some(0.25);
        Needs { signals, aux, cadence, least_resolution, ..Needs::default() }
    }
    fn is_due(&self, step: u32) -> bool {
        step.is_multiple_of(self.every)
    }
    fn cadence(&self, step: u32) -> Cadence {
        if step > 5 { self.cadence } else { Cadence::default() }
    }
    fn loss_terms(&self, step: u32, declared: LossTerms) -> LossTerms {
        if step > 6 { self.terms.0 } else { declared }
    }
    fn noise(&self, step: u32, declared: Option<NoiseTerm>) -> Option<NoiseTerm> {
        if step > 6 { self.terms.1 } else { declared }
    }
    fn resolution(&self, step: u32) -> f64 {
        if step <= 2 { self.resolution } else { 1.0 }
    }
    fn aux_views(&self, step: u32, rows: usize, budget: usize) -> u32 {
        assert!(self.is_due(step) && rows <= budget);
        if step == 4 { self.aux_views } else { 0 }
    }
    fn observe(&mut self, view: &AuxView<'_>) -> Result<(), PolicyError> {
        assert_eq!((view.step, view.loss, view.points.len()), (4, 0.5, 0));
        assert_eq!(view.column(AuxColumn::Depth)?.len(), view.rows);
        self.seen.push(view.column(AuxColumn::Depth)?[0]);
        if self.behaviour == Behaviour::ReadUndeclared {
            view.column(AuxColumn::Radius)?;
        }
        Ok(())
    }
    fn plan(
        &mut self,
        snapshot: &Snapshot<'_>,
        _rng: &PolicyRng,
        plan: &mut EditPlan,
    ) -> Result<(), PolicyError> {
        if !self.seen.is_empty() {
            plan.cause(&format!("saw {:?}", std::mem::take(&mut self.seen)));
        }
        let rows = snapshot.signal(Signal::Opacity)?.len() as u32;
        plan.cause("scripted");
        match self.behaviour {
            Behaviour::Split => {
                for row in 0..rows {
                    // A refusal is counted by the plan.
                    let _ = plan.grow(row, split_by(2.0));
                }
            }
            Behaviour::Halve => {
                for row in 0..rows / 2 {
                    plan.prune(row).map_err(|e| PolicyError::Other(e.to_string()))?;
                }
            }
            Behaviour::Nothing => {}
            Behaviour::Panic => panic!("no row {rows}"),
            Behaviour::Fail => return Err(PolicyError::Other("out of ideas".into())),
            Behaviour::ReadUndeclared => {
                snapshot.signal(Signal::Age)?;
            }
        }
        Ok(())
    }
}

/// Width and height of the views `[px]`.
const SIDE: u32 = 64;

struct FakeViews {
    cameras: Vec<Camera>,
    unreadable: Option<usize>,
    prefetched: CallLog,
}

impl ViewSource for FakeViews {
    fn count(&self) -> usize {
        self.cameras.len()
    }
    fn name(&self, view: usize) -> &str {
        ["a.png", "b.png", "c.png"][view]
    }
    fn camera(&self, view: usize) -> &Camera {
        &self.cameras[view]
    }
    fn image(&self, view: usize) -> Result<SharedImage, ViewError> {
        if self.unreadable == Some(view) {
            return Err("file is gone".into());
        }
        let rgb = vec![view as u8; 3 * (SIDE * SIDE) as usize];
        Ok(Arc::new(Image8 { width: SIDE, height: SIDE, rgb, alpha: None, mask: None }))
    }
    fn prefetch(&self, upcoming: &[usize]) {
        note(&self.prefetched, format!("{upcoming:?}"));
    }
}

struct Case {
    rows: usize,
    budget: usize,
    behaviour: Behaviour,
    every: u32,
    aux_views: u32,
    cadence: Cadence,
    terms: (LossTerms, Option<NoiseTerm>),
    resolution: f64,
    nan_loss_at: u32,
    unsound: u32,
    unreadable: Option<usize>,
}

const CASE: Case = Case {
    rows: 3,
    budget: 10,
    behaviour: Behaviour::Split,
    every: 2,
    aux_views: 0,
    cadence: Cadence { all: 1, sh_rest: 1 },
    terms: (LossTerms { opacity: 0.0, scale: 0.0 }, None),
    resolution: 1.0,
    nan_loss_at: 0,
    unsound: 0,
    unreadable: None,
};

fn scene(case: &Case, views: usize) -> SceneInfo {
    SceneInfo {
        extent: 1.0,
        train_views: views as u32,
        budget: case.budget,
        initial_rows: case.rows,
        iterations: 9,
        white_background: false,
    }
}

const OPTIONS: TrainOptions = TrainOptions {
    iterations: 9,
    seed: 7,
    sh_degree: 3,
    background: Background::Black,
    rates: RateOptions::PUBLISHED,
    prefetch: 2,
    frozen: 0,
    has_all_bands: false,
    on_nan: OnNan::Prune,
    depth: None,
    distortion: 0.0,
    removes_floaters: false,
};

fn build(
    case: &Case,
    views: usize,
    scene: SceneInfo,
    options: TrainOptions,
) -> Result<(Trainer<FakeViews>, CallLog, CallLog), TrainError> {
    let camera = Camera::centred((SIDE, SIDE), (1.0, 1.0), DMat3::IDENTITY, DVec3::ZERO);
    let (log, prefetched) = (CallLog::default(), CallLog::default());
    let backend = CountingBackend {
        rows: case.rows,
        budget: case.budget,
        nan_loss_at: case.nan_loss_at,
        unsound: case.unsound,
        log: log.clone(),
        ledger: Ledger::default(),
    };
    let views = FakeViews {
        cameras: (0..views)
            .map(|view| Camera { translation: DVec3::X * view as f64, ..camera })
            .collect(),
        unreadable: case.unreadable,
        prefetched: prefetched.clone(),
    };
    let Case { every, aux_views, cadence, terms, resolution, behaviour, .. } = *case;
    let seen = Vec::new();
    let policy = ScriptedPolicy { every, aux_views, cadence, terms, resolution, seen, behaviour };
    let policy = ("scripted", Box::new(policy) as Box<dyn DensityPolicy>);
    let trainer = Trainer::new(views, Box::new(backend), policy, scene, options)?;
    Ok((trainer, log, prefetched))
}

fn trainer(case: &Case) -> (Trainer<FakeViews>, CallLog, CallLog) {
    build(case, 3, scene(case, 3), OPTIONS).unwrap()
}

fn failure(case: &Case) -> (String, usize, Vec<String>) {
    let (mut trainer, log, _) = trainer(case);
    let error = (0..9).find_map(|_| trainer.step().err()).expect("an error within 9 steps");
    let calls = log.lock().unwrap().clone();
    (error.to_string(), trainer.model().unwrap().len(), calls)
}
