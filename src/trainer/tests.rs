//! The loop against a backend that only counts and a policy that does as it is told.
//!
//! One piece: every test here drives the same counting backend and scripted policy.

use std::sync::{Arc, Mutex};

use densify_policies::plan::{EditPlan, Offspring, OpacityRule, ParentFate, Placement, ScaleRule};
use densify_policies::policy::{
    AuxColumn, AuxRequest, AuxView, Candidate, PolicyError, PolicyState, Signal, SignalSet, Signals,
};
use glam::{DMat3, DVec3};

use super::*;
use crate::backend::{
    Attribute, AuxInput, AuxOutput, Kept, Rendering, StateArray, StateError, Tensor, Unsound,
};
use crate::camera::Camera;
use crate::dataset::images::{Image8, SharedImage};
use crate::gaussians::ModelArray;
use crate::memory::Ledger;
use crate::schedule::{Background, RateOptions};
use crate::views::ViewError;
use densify_policies::policy::Snapshot;
use densify_policies::rng::PolicyRng;

/// Everything that was asked of the fakes, in order.
type Diary = Arc<Mutex<Vec<String>>>;

fn note(diary: &Diary, what: String) {
    diary.lock().unwrap().push(what);
}

struct CountingBackend {
    rows: usize,
    budget: usize,
    lost_at: u32,
    unsound: u32,
    diary: Diary,
    ledger: Ledger,
}

impl Backend for CountingBackend {
    fn rows(&self) -> usize {
        self.rows
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
        note(&self.diary, "epoch".into());
    }
    fn train_step(&mut self, input: &StepInput<'_>) -> Result<StepOutput, BackendError> {
        note(&self.diary, format!("step {} view {}", input.step, input.target.rgb[0]));
        if input.cadence != Cadence::default() {
            let Cadence { all, sh_rest } = input.cadence;
            note(&self.diary, format!("cadence {all} {sh_rest}"));
        }
        let loss = if input.step == self.lost_at { f32::NAN } else { 0.5 };
        Ok(StepOutput { loss, ..StepOutput::default() })
    }
    fn measure_weights(&mut self, camera: &Camera, sh_degree: u8) -> Result<(), BackendError> {
        note(&self.diary, format!("measure {} at degree {sh_degree}", camera.translation.x));
        Ok(())
    }
    fn observe(&mut self, input: &AuxInput<'_>) -> Result<AuxOutput, BackendError> {
        let (x, degree) = (input.camera.translation.x, input.sh_degree);
        note(&self.diary, format!("observe {x}, pixel {}, degree {degree}", input.target.rgb[0]));
        assert_eq!((input.view as f64, input.seed), (x, 7));
        let columns = input.request.columns.iter().map(|&c| (c, vec![x as f32; self.rows]));
        Ok(AuxOutput { loss: 0.5, columns: columns.collect(), points: Vec::new() })
    }
    fn take_signals(&mut self, wanted: SignalSet) -> Result<Signals, BackendError> {
        Ok(Signals::zeros(self.rows, wanted))
    }

    fn candidates(&self) -> &[Candidate] {
        &[]
    }
    fn apply(&mut self, ops: &RowOps, _seed: u64, step: u32) -> Result<(), BackendError> {
        note(&self.diary, format!("apply {step}"));
        assert_eq!(ops.rows_before, self.rows);
        self.rows = ops.rows_after;
        self.unsound = 0;
        Ok(())
    }
    fn audit(&mut self) -> Result<Vec<Unsound>, BackendError> {
        let unsound = |row| Unsound { row, attribute: Attribute::Opacity, kept: Kept::Moment };
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

/// Splits as many rows as it can at every multiple of `every`, or prunes half, or fails.
struct ToldPolicy {
    every: u32,
    fresh_views: u32,
    aux_views: u32,
    cadence: Cadence,
    seen: Vec<f32>,
    what: Told,
}

#[derive(Clone, Copy, PartialEq)]
enum Told {
    Split,
    Halve,
    Nothing,
    Fail,
    Panic,
    ReadUndeclared,
    ReadFresh,
}

impl DensityPolicy for ToldPolicy {
    fn needs(&self, _scene: &SceneInfo) -> Needs {
        let (signals, fresh_views) = (SignalSet::from([Signal::Opacity]), self.fresh_views);
        let fresh = if fresh_views > 0 { signals.with(Signal::FreshWeightMax) } else { signals };
        let aux = (self.aux_views > 0)
            .then(|| AuxRequest { columns: vec![AuxColumn::Depth], ..AuxRequest::default() });
        let cadence = Cadence { all: 4, sh_rest: 1 };
        Needs { signals: fresh, fresh_views, aux, cadence, ..Needs::default() }
    }
    fn wants_fresh(&self, step: u32, rows: usize, budget: usize) -> bool {
        assert!(self.is_due(step) && rows <= budget);
        2 * rows > budget
    }
    fn is_due(&self, step: u32) -> bool {
        step.is_multiple_of(self.every)
    }
    fn cadence(&self, step: u32) -> Cadence {
        if step > 5 { self.cadence } else { Cadence::default() }
    }
    fn aux_views(&self, step: u32, rows: usize, budget: usize) -> u32 {
        assert!(self.is_due(step) && rows <= budget);
        if step == 4 { self.aux_views } else { 0 }
    }
    fn observe(&mut self, view: &AuxView<'_>) -> Result<(), PolicyError> {
        assert_eq!((view.step, view.loss, view.points.len()), (4, 0.5, 0));
        assert_eq!(view.column(AuxColumn::Depth)?.len(), view.rows);
        self.seen.push(view.column(AuxColumn::Depth)?[0]);
        if self.what == Told::ReadUndeclared {
            view.column(AuxColumn::Radius)?;
        }
        Ok(())
    }
    fn plan(
        &mut self,
        now: &Snapshot<'_>,
        _rng: &PolicyRng,
        plan: &mut EditPlan,
    ) -> Result<(), PolicyError> {
        if !self.seen.is_empty() {
            plan.cause(&format!("saw {:?}", std::mem::take(&mut self.seen)));
        }
        let rows = now.signal(Signal::Opacity)?.len() as u32;
        plan.cause("told");
        match self.what {
            Told::Split => {
                let split = Offspring {
                    children: 1,
                    parent: ParentFate::BecomesChild,
                    placement: Placement::Sampled,
                    scale: ScaleRule::Uniform(0.5),
                    opacity: OpacityRule::Same,
                };
                for row in 0..rows {
                    // A refusal is counted by the plan.
                    let _ = plan.grow(row, split);
                }
            }
            Told::Halve => {
                for row in 0..rows / 2 {
                    plan.prune(row).map_err(|e| PolicyError::Other(e.to_string()))?;
                }
            }
            Told::Nothing => {}
            Told::Panic => panic!("no row {rows}"),
            Told::Fail => return Err(PolicyError::Other("out of ideas".into())),
            Told::ReadUndeclared => {
                now.signal(Signal::Age)?;
            }
            Told::ReadFresh => {
                now.signal(Signal::FreshWeightMax)?;
            }
        }
        Ok(())
    }
    fn save(&self) -> PolicyState {
        PolicyState::Null
    }
    fn restore(&mut self, _state: PolicyState) -> Result<(), PolicyError> {
        Ok(())
    }
}

struct FakeViews {
    cameras: Vec<Camera>,
    unreadable: Option<usize>,
    announced: Diary,
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
        let rgb = vec![view as u8; 3];
        Ok(Arc::new(Image8 { width: 1, height: 1, rgb, alpha: None, mask: None }))
    }
    fn prefetch(&self, upcoming: &[usize]) {
        note(&self.announced, format!("{upcoming:?}"));
    }
}

struct Case {
    rows: usize,
    budget: usize,
    what: Told,
    every: u32,
    fresh_views: u32,
    aux_views: u32,
    cadence: Cadence,
    lost_at: u32,
    unsound: u32,
    unreadable: Option<usize>,
}

const CASE: Case = Case {
    rows: 3,
    budget: 10,
    what: Told::Split,
    every: 2,
    fresh_views: 0,
    aux_views: 0,
    cadence: Cadence { all: 1, sh_rest: 1 },
    lost_at: 0,
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
    rates: RateOptions {
        boost: 1.0,
        mean_start: 1e-4,
        mean_end: 1e-6,
        log_scale: 1.0,
        quat: 1.0,
        opacity: 1.0,
        sh_dc: 1.0,
        sh_rest: 1.0,
    },
    sh_every: None,
    prefetch: 2,
    on_nan: OnNan::Prune,
    savings: Savings::NONE,
};

fn build(
    case: &Case,
    views: usize,
    scene: SceneInfo,
    options: TrainOptions,
) -> Result<(Trainer<FakeViews>, Diary, Diary), TrainError> {
    let camera = Camera {
        width: 1,
        height: 1,
        fx: 1.0,
        fy: 1.0,
        cx: 0.5,
        cy: 0.5,
        rotation: DMat3::IDENTITY,
        translation: DVec3::ZERO,
    };
    let (diary, announced) = (Diary::default(), Diary::default());
    let backend = CountingBackend {
        rows: case.rows,
        budget: case.budget,
        lost_at: case.lost_at,
        unsound: case.unsound,
        diary: diary.clone(),
        ledger: Ledger::default(),
    };
    let views = FakeViews {
        cameras: (0..views)
            .map(|view| Camera { translation: DVec3::X * view as f64, ..camera })
            .collect(),
        unreadable: case.unreadable,
        announced: announced.clone(),
    };
    let Case { every, fresh_views, aux_views, cadence, what, .. } = *case;
    let policy = ToldPolicy { every, fresh_views, aux_views, cadence, seen: Vec::new(), what };
    let policy = ("told", Box::new(policy) as Box<dyn DensityPolicy>);
    let trainer = Trainer::new(views, Box::new(backend), policy, scene, options)?;
    Ok((trainer, diary, announced))
}

fn trainer(case: &Case) -> (Trainer<FakeViews>, Diary, Diary) {
    build(case, 3, scene(case, 3), OPTIONS).unwrap()
}

fn failure(case: &Case) -> (String, usize, Vec<String>) {
    let (mut trainer, diary, _) = trainer(case);
    let error = (0..9).find_map(|_| trainer.step().err()).expect("an error within 9 steps");
    let done = diary.lock().unwrap().clone();
    (error.to_string(), trainer.model().unwrap().len(), done)
}

#[test]
fn every_epoch_shows_every_view_once_and_is_announced() {
    let (mut trainer, diary, announced) = trainer(&Case { every: 100, ..CASE });
    let shown: Vec<usize> = (0..9).map(|_| trainer.step().unwrap().view).collect();
    for (epoch, views) in shown.chunks(3).enumerate() {
        assert_eq!(views, schedule::view_order(3, 7, epoch as u32));
    }
    let diary = diary.lock().unwrap();
    let epochs: Vec<usize> = (0..diary.len()).filter(|&i| diary[i] == "epoch").collect();
    assert_eq!(epochs, [0, 4, 8]);
    // The right pixels reached the backend.
    let steps: Vec<String> =
        shown.iter().enumerate().map(|(i, view)| format!("step {} view {view}", i + 1)).collect();
    assert_eq!(diary.iter().filter(|d| *d != "epoch").cloned().collect::<Vec<_>>(), steps);
    // Each announcement is what comes next, and nothing beyond the end of the run.
    for (i, said) in announced.lock().unwrap().iter().enumerate() {
        assert_eq!(*said, format!("{:?}", &shown[i + 1..(i + 3).min(9)]));
    }
}

#[test]
fn edits_are_reported_and_the_budget_holds() {
    let (mut trainer, ..) = trainer(&CASE);
    let events: Vec<EditEvent> = (0..9).flat_map(|_| trainer.step().unwrap().events).collect();
    let short: Vec<_> =
        events.iter().map(|e| (e.step, e.before, e.added, e.denied, e.after)).collect();
    assert_eq!(short, [(2, 3, 3, 0, 6), (4, 6, 4, 2, 10), (6, 10, 0, 10, 10), (8, 10, 0, 10, 10)]);
    assert_eq!((events[0].updated, events[0].removed, &*events[0].cause), (3, 0, "told"));
    assert_eq!(trainer.events(), events);
    assert_eq!((trainer.peak_rows(), trainer.rows(), trainer.steps_done()), (10, 10, 9));
}

#[test]
fn fresh_views_are_measured_where_they_are_wanted() {
    let run = |fresh_views: u32, seed: u64| {
        let case = Case { fresh_views, ..CASE };
        let options = TrainOptions { seed, ..OPTIONS };
        let (mut trainer, diary, _) = build(&case, 3, scene(&case, 3), options).unwrap();
        for _ in 0..9 {
            trainer.step().unwrap();
        }
        let diary = diary.lock().unwrap().clone();
        let is_edit = |d: &String| d.starts_with("measure") || d.starts_with("apply");
        (diary.into_iter().filter(is_edit).collect::<Vec<_>>(), trainer.extra_forwards())
    };
    // 3 rows of 10 at step 2, where none is wanted, then 6, 10, 10.
    let expected = |count: usize, seed: u64| -> Vec<String> {
        let event = |step: u32| {
            let count = if step == 2 { 0 } else { count };
            let degree = schedule::sh_degree(step, 9, 3);
            let views = schedule::fresh_views(3, count, seed, step).into_iter();
            let measured = views.map(move |view| format!("measure {view} at degree {degree}"));
            measured.chain([format!("apply {step}")])
        };
        [2, 4, 6, 8].into_iter().flat_map(event).collect()
    };
    assert_eq!(run(2, 7), (expected(2, 7), 6));
    assert_eq!(run(2, 7), run(2, 7));
    assert_eq!(run(2, 8), (expected(2, 8), 6));
    assert_ne!(run(2, 7), run(2, 8));
    // There are no more than three.
    assert_eq!(run(100, 7), (expected(3, 7), 9));
    assert_eq!(run(0, 7), (expected(0, 7), 0));
}

#[test]
fn views_that_are_nearly_the_same_are_scored_once() {
    // Cameras one apart: with an extent of 150, the second is the first, and the third is not.
    let case = Case { fresh_views: 100, ..CASE };
    let info = SceneInfo { extent: 150.0, ..scene(&case, 3) };
    let (trainer, diary, _) = build(&case, 3, info, OPTIONS).unwrap();
    let mut trainer = trainer.requiring(Required { scored_views: true, ..Required::default() });
    for _ in 0..9 {
        trainer.step().unwrap();
    }
    let diary = diary.lock().unwrap().clone();
    let measured: Vec<&str> =
        diary.iter().filter(|d| d.starts_with("measure")).map(|d| &d[..9]).collect();
    assert!(measured.contains(&"measure 0") && measured.contains(&"measure 2"), "{diary:?}");
    assert!(!measured.contains(&"measure 1"), "{diary:?}");
    assert_eq!(trainer.unscored_views(), 1);
    // All are trained on.
    assert!(
        (0..3).all(|view| diary.iter().any(|d| d.contains(&format!("view {view}")))),
        "{diary:?}"
    );
}

#[test]
fn fresh_signals_are_there_only_where_they_are_wanted() {
    let case = Case { what: Told::ReadFresh, fresh_views: 2, ..CASE };
    let (message, ..) = failure(&case);
    assert!(message.contains("FreshWeightMax was read but not declared"), "{message}");
    assert!(message.starts_with("step 2") && message.contains("`wants_fresh`"), "{message}");
    let (mut trainer, ..) = trainer(&Case { rows: 6, ..case });
    assert!((0..9).all(|_| trainer.step().is_ok()));
}

#[test]
fn a_plan_that_does_nothing_is_no_event() {
    let (mut trainer, diary, _) = trainer(&Case { what: Told::Nothing, ..CASE });
    assert!((0..9).all(|_| trainer.step().unwrap().events.is_empty()));
    assert!(trainer.events().is_empty());
    // It may reset statistics and is executed all the same.
    assert!(diary.lock().unwrap().contains(&"apply 2".to_owned()));
}

#[test]
fn the_peak_outlives_a_prune() {
    let (mut trainer, ..) = trainer(&Case { rows: 8, what: Told::Halve, ..CASE });
    for _ in 0..4 {
        trainer.step().unwrap();
    }
    assert_eq!((trainer.rows(), trainer.peak_rows()), (2, 8));
}

#[test]
fn slots_written_before_the_moves_count_for_the_peak() {
    let ops =
        RowOps { rows_before: 4, rows_after: 3, child_slots: vec![1, 5], ..RowOps::default() };
    assert_eq!(edit::rows_within(&ops), 6);
}

#[test]
fn a_policy_error_stops_before_the_edit() {
    let (message, rows, done) = failure(&Case { what: Told::Fail, ..CASE });
    assert_eq!(message, "step 2: policy `told`: out of ideas");
    assert_eq!(rows, 3);
    assert!(!done.iter().any(|d| d.starts_with("apply")), "{done:?}");
    let (message, rows, done) = failure(&Case { what: Told::Panic, ..CASE });
    assert!(message.contains("`told`: it panicked: no row 3;"), "{message}");
    assert_eq!(rows, 3);
    assert!(!done.iter().any(|d| d.starts_with("apply")), "{done:?}");
    let (message, ..) = failure(&Case { what: Told::ReadUndeclared, ..CASE });
    assert!(message.contains("Age") && message.contains("not declared"), "{message}");
}

#[test]
fn a_lost_model_and_an_unreadable_view_are_named() {
    let (message, _, done) = failure(&Case { lost_at: 4, every: 4, ..CASE });
    let view = ["a.png", "b.png", "c.png"][schedule::view_order(3, 7, 1)[0]];
    assert!(message.starts_with(&format!("step 4: the loss of view `{view}` is NaN")), "{message}");
    assert!(!done.contains(&"apply 4".to_owned()), "{done:?}");
    let (message, ..) = failure(&Case { unreadable: Some(1), ..CASE });
    assert!(message.contains("view `b.png`: file is gone"), "{message}");
}

#[test]
fn options_that_disagree_are_refused() {
    let refused = |views, change: fn(&mut SceneInfo, &mut TrainOptions)| {
        let (mut scene, mut options) = (scene(&CASE, 3), OPTIONS);
        change(&mut scene, &mut options);
        build(&CASE, views, scene, options).err().expect("refused").to_string()
    };
    assert!(refused(0, |_, _| ()).contains("no training view"));
    assert!(refused(2, |_, _| ()).contains("2 views"));
    assert!(refused(3, |_, o| o.iterations = 8).contains("--iterations"));
    assert!(refused(3, |s, _| s.extent = f32::NAN).contains("extent"));
    assert!(refused(3, |s, _| s.budget = 11).contains("budget 10 (scene: 11)"));
    assert!(refused(3, |_, o| o.rates.quat = 0.0).contains("`quat`"));
    assert!(build(&CASE, 3, scene(&CASE, 3), OPTIONS).is_ok());
}

#[test]
fn auxiliary_views_are_shown_before_the_plan() {
    let case = Case { aux_views: 2, ..CASE };
    let (mut trainer, diary, _) = trainer(&case);
    let events: Vec<EditEvent> = (0..9).flat_map(|_| trainer.step().unwrap().events).collect();
    let views = schedule::fresh_views(3, 2, 7, 4);
    let degree = schedule::sh_degree(4, 9, 3);
    let shown = |view: &usize| format!("observe {view}, pixel {view}, degree {degree}");
    let diary = diary.lock().unwrap();
    let first = diary.iter().position(|d| d.starts_with("observe")).unwrap();
    let expected: Vec<String> = views.iter().map(shown).chain(["apply 4".to_owned()]).collect();
    assert_eq!(diary[first..first + 3], expected);
    assert_eq!(diary.iter().filter(|d| d.starts_with("observe")).count(), 2);
    assert_eq!(trainer.extra_forwards(), 2);
    let saw: Vec<f32> = views.iter().map(|&view| view as f32).collect();
    assert_eq!(events[1].cause, format!("saw {saw:?}+told"));
    assert_eq!(events[2].cause, "told");
    // All of them, where more are wanted than there are.
    let (mut trainer, ..) = self::trainer(&Case { aux_views: u32::MAX, ..CASE });
    (0..9).for_each(|_| drop(trainer.step().unwrap()));
    assert_eq!(trainer.extra_forwards(), 3);
}

#[test]
fn what_an_auxiliary_view_does_not_have_stops_the_run() {
    let case = Case { aux_views: 1, what: Told::ReadUndeclared, every: 4, ..CASE };
    let (message, rows, done) = failure(&case);
    assert!(message.contains("step 4: policy `told`: column Radius"), "{message}");
    assert!(rows == 3 && done.iter().all(|d| !d.starts_with("apply")));
}

#[test]
fn the_cadence_is_the_policys_unless_the_options_say_otherwise() {
    let noted = |cadence: Cadence, sh_every: Option<u32>| {
        let case = Case { cadence, every: 100, ..CASE };
        let options = TrainOptions { sh_every, ..OPTIONS };
        let (mut trainer, diary, _) = build(&case, 3, scene(&case, 3), options)?;
        for _ in 0..9 {
            trainer.step()?;
        }
        let diary = diary.lock().unwrap().clone();
        Ok::<_, TrainError>(
            diary.into_iter().filter(|d| d.starts_with("cadence")).collect::<Vec<_>>(),
        )
    };
    let (every, fourth) = (Cadence::default(), Cadence { all: 4, sh_rest: 1 });
    assert_eq!(noted(every, None).unwrap(), [""; 0]);
    assert_eq!(noted(fourth, None).unwrap(), ["cadence 4 1"; 4]);
    assert_eq!(noted(every, Some(16)).unwrap(), ["cadence 1 16"; 9]);
    assert_eq!(
        noted(fourth, Some(16)).unwrap()[4..],
        ["cadence 1 16", "cadence 4 16", "cadence 4 16", "cadence 4 16", "cadence 4 16"]
    );
    let undeclared = noted(Cadence { all: 1, sh_rest: 9 }, None).unwrap_err().to_string();
    assert!(undeclared.starts_with("step 6: policy `told`: it wants"), "{undeclared}");
    let senseless = noted(every, Some(0)).unwrap_err().to_string();
    assert!(senseless.contains("cadence.sh_rest is 0"), "{senseless}");
}

#[test]
fn rows_that_are_unsound_go_before_the_policy_is_asked() {
    let case = Case { rows: 2000, budget: 2000, unsound: 2, what: Told::Halve, ..CASE };
    let (mut trainer, diary, _) = trainer(&case);
    assert!(trainer.step().unwrap().events.is_empty());
    let events = trainer.step().unwrap().events;
    let short: Vec<_> = events.iter().map(|e| (&*e.cause, e.before, e.removed)).collect();
    assert_eq!(short, [("not finite", 2000, 2), ("told", 1998, 999)]);
    assert_eq!(diary.lock().unwrap().iter().filter(|d| *d == "apply 2").count(), 2);
    assert_eq!(trainer.events(), events);
}

#[test]
fn rows_that_are_unsound_go_at_the_end_too() {
    let (mut trainer, ..) = trainer(&Case { unsound: 1, every: 100, ..CASE });
    let events: Vec<EditEvent> = (0..9).flat_map(|_| trainer.step().unwrap().events).collect();
    assert_eq!((events.len(), events[0].step, events[0].after), (1, 9, 2));
}

#[test]
fn many_unsound_rows_end_the_run_and_so_does_one_where_none_is_wanted() {
    // One in a thousand may go, and one always.
    for (rows, unsound, ends) in
        [(3, 1, false), (3, 2, true), (3000, 3, false), (3000, 4, true), (1, 1, true)]
    {
        let case = Case { rows, budget: 3000, unsound, every: 100, ..CASE };
        let (mut trainer, ..) = trainer(&case);
        let error = (0..9).find_map(|_| trainer.step().err());
        assert_eq!(error.is_some(), ends, "{unsound} of {rows}");
        if let Some(error) = error {
            let said = error.to_string();
            let count = format!("step 9: {unsound} of {rows} rows");
            assert!(said.starts_with(&count) && said.contains("opacity of row 0"), "{said}");
            assert_eq!((trainer.rows(), trainer.steps_done()), (rows, 9));
        }
    }
    let case = Case { rows: 2000, budget: 2000, unsound: 1, ..CASE };
    let options = TrainOptions { on_nan: OnNan::Stop, ..OPTIONS };
    let (mut trainer, ..) = build(&case, 3, scene(&case, 3), options).unwrap();
    assert!(trainer.step().is_ok() && trainer.step().is_err());
}
