//! Tests that the registered policies conform, and that a policy with any of the faults below is caught.
//!
//! One file, because one policy can have each of the faults.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

use super::*;
use crate::adc::clone_at;
use crate::parameters::StepParameter::{self, Interval, Step};
use crate::parameters::in_range;
use crate::plan::{EditPlan, Refused, Update};
use crate::policy::{
    AuxColumn, AuxRequest, AuxView, Cadence, DensityPolicy, LossTerms, Needs, PolicyResult,
    PolicyState, Signal, SignalSet, Snapshot,
};
use crate::registry::{ConfiguredPolicy, policies};
use crate::rng::{PolicyRng, Purpose};
use crate::sample::{smallest, top_k};

#[test]
fn every_registered_policy_conforms() {
    for entry in policies().unwrap() {
        let conforms = check_policy(entry).and_then(|()| check_manual(entry));
        conforms.unwrap_or_else(|report| panic!("{report}"));
    }
}

/// The fault of a [`Faulty`] policy.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
enum Fault {
    #[default]
    None,
    ReadsUndeclared,
    ReadsUndeclaredIfPresent,
    ReadsUndeclaredCandidates,
    UsesItsOwnRandomness,
    RestoresNothing,
    AcceptsAnyState,
    PanicsOnNan,
    FailsWhenRefused,
    PrunesAll,
    ReplacesThePlan,
    HasRandomNeeds,
    WantsViewsAtRandom,
    WantsViewsUndeclared,
    ReadsUndeclaredColumn,
    ReadsUndeclaredPoints,
    SavesOnlyPart,
    DeclaresNan,
    HasInvalidCadence,
    HasNanTermsLate,
    ShrinksImagesTooFar,
    /// Shrinks images, depending on state that it does not save.
    ShrinksImagesUnsaved,
    NeverEdits,
    /// Prunes one row in a thousand, chosen by the system's clock.
    ReadsTheClock,
    PanicsOnManyRows,
    /// Counts events of models above 1,000 rows, and does not save the count.
    ForgetsManyRows,
    /// Panics if its update with the row's own position is refused.
    TrustsPositions,
    UpdatesUndeclared,
}

/// The faults, each with the check that finds it.
const FAULTS: [(Fault, Option<Check>); 28] = [
    (Fault::None, None),
    (Fault::ReadsUndeclared, Some(Check::ReadsOnlyDeclared)),
    (Fault::ReadsUndeclaredIfPresent, Some(Check::ReadsOnlyDeclared)),
    (Fault::ReadsUndeclaredCandidates, Some(Check::ReadsOnlyDeclared)),
    (Fault::UsesItsOwnRandomness, Some(Check::IsDeterministic)),
    (Fault::RestoresNothing, Some(Check::RestoresState)),
    (Fault::AcceptsAnyState, Some(Check::RejectsForeignState)),
    (Fault::PanicsOnNan, Some(Check::NeverFails)),
    (Fault::FailsWhenRefused, Some(Check::NeverFails)),
    (Fault::PrunesAll, Some(Check::LeavesARow)),
    (Fault::ReplacesThePlan, Some(Check::KeepsPlan)),
    (Fault::HasRandomNeeds, Some(Check::IsDeterministic)),
    (Fault::WantsViewsAtRandom, Some(Check::IsDeterministic)),
    (Fault::WantsViewsUndeclared, Some(Check::RequestsConsistently)),
    (Fault::ReadsUndeclaredColumn, Some(Check::ReadsOnlyDeclared)),
    (Fault::ReadsUndeclaredPoints, Some(Check::ReadsOnlyDeclared)),
    (Fault::SavesOnlyPart, Some(Check::RestoresState)),
    (Fault::DeclaresNan, Some(Check::DeclaresValidNumbers)),
    (Fault::HasInvalidCadence, Some(Check::DeclaresValidNumbers)),
    (Fault::HasNanTermsLate, Some(Check::DeclaresValidNumbers)),
    (Fault::ShrinksImagesTooFar, Some(Check::DeclaresValidNumbers)),
    (Fault::ShrinksImagesUnsaved, Some(Check::RestoresState)),
    (Fault::NeverEdits, Some(Check::Edits)),
    (Fault::ReadsTheClock, Some(Check::IsDeterministic)),
    (Fault::PanicsOnManyRows, Some(Check::NeverFails)),
    (Fault::ForgetsManyRows, Some(Check::RestoresState)),
    (Fault::TrustsPositions, Some(Check::NeverFails)),
    (Fault::UpdatesUndeclared, Some(Check::DeclaresEdits)),
];

/// Shared state that makes policies nondeterministic.
static CALLS: AtomicU64 = AtomicU64::new(0);

fn next_call() -> u64 {
    CALLS.fetch_add(1, Ordering::Relaxed)
}

#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Params {
    every: u32,
    fault: Fault,
}

/// A policy with state: every third event prunes the faintest row; the others clone two rows, one by
/// gradient and one at random, and rewrite the first row. It conforms except for its fault.
struct Faulty {
    fault: Fault,
    events: u64,
    /// Hash of the numbers seen in auxiliary views.
    seen: u64,
    /// State that the policy does not save.
    unsaved: u32,
}

impl ConfiguredPolicy for Faulty {
    type Params = Params;
    const STEP_PARAMETERS: &'static [StepParameter] = &[Interval("every")];
    fn new(params: Params, _scene: &SceneInfo) -> PolicyResult<Self> {
        Ok(Self { fault: params.fault, events: 0, seen: 0, unsaved: 0 })
    }
}

impl Faulty {
    fn has(&self, fault: Fault) -> bool {
        self.fault == fault
    }
}

impl DensityPolicy for Faulty {
    fn needs(&self, _scene: &SceneInfo) -> Needs {
        let mut signals =
            SignalSet::from([Signal::Opacity, Signal::ScreenGradient, Signal::Position]);
        if self.has(Fault::HasRandomNeeds) && next_call().is_multiple_of(2) {
            signals = signals.with(Signal::Age);
        }
        let detailed_edits = !self.has(Fault::UpdatesUndeclared);
        let mut needs = Needs { signals, detailed_edits, ..Needs::default() };
        if !self.has(Fault::WantsViewsUndeclared) {
            let columns = vec![AuxColumn::Depth];
            let points = if self.has(Fault::ReadsUndeclaredPoints) { 0 } else { 2 };
            needs.aux = Some(AuxRequest { columns, points, ..AuxRequest::default() });
        }
        if self.has(Fault::DeclaresNan) {
            needs.loss_terms.opacity = f32::NAN;
        }
        needs.cadence.all = 3;
        needs.least_resolution = Some(0.5);
        needs
    }

    fn is_due(&self, step: u32) -> bool {
        step.is_multiple_of(5)
    }

    fn cadence(&self, step: u32) -> Cadence {
        let all = if step > 100 { 3 } else { 1 };
        let sh_rest = if self.has(Fault::HasInvalidCadence) && step > 90 { 2 } else { 1 };
        // An interval of 0 steps is invalid, whatever the needs declare.
        Cadence { all: if sh_rest > 1 { 0 } else { all }, sh_rest }
    }

    fn loss_terms(&self, step: u32, declared: LossTerms) -> LossTerms {
        let is_wrong = self.has(Fault::HasNanTermsLate) && step > 90;
        LossTerms { scale: if is_wrong { f32::NAN } else { 0.0 }, ..declared }
    }

    fn resolution(&self, step: u32) -> f64 {
        let is_too_far = self.has(Fault::ShrinksImagesTooFar) && step > 90;
        let shrinks_unsaved = self.has(Fault::ShrinksImagesUnsaved) && self.unsaved > 2;
        if is_too_far {
            0.4
        } else if shrinks_unsaved {
            0.5
        } else {
            1.0
        }
    }

    fn aux_views(&self, step: u32, _rows: usize, _budget: usize) -> u32 {
        let at_random = self.has(Fault::WantsViewsAtRandom) && next_call().is_multiple_of(2);
        if at_random || step.is_multiple_of(10) { 2 } else { 0 }
    }

    fn observe(&mut self, view: &AuxView<'_>) -> PolicyResult {
        if self.has(Fault::ReadsUndeclaredColumn) {
            view.column(AuxColumn::Radius)?;
        }
        let bits = |x: f32| u64::from(x.to_bits());
        let depths = view.column(AuxColumn::Depth)?;
        let sum = depths.iter().fold(bits(view.loss), |sum, &x| sum.rotate_left(5) ^ bits(x));
        self.seen = self.seen.rotate_left(9) ^ sum;
        for point in view.points {
            self.seen = self.seen.rotate_left(9) ^ bits(point.error);
        }
        Ok(())
    }

    fn plan(&mut self, now: &Snapshot<'_>, rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        self.events += 1;
        if self.has(Fault::ShrinksImagesUnsaved) {
            self.unsaved += 1;
        }
        let opacity = now.signal(Signal::Opacity)?;
        let gradient = now.signal(Signal::ScreenGradient)?;
        let rows: Vec<u32> = (0..now.rows() as u32).collect();
        if self.has(Fault::ReplacesThePlan) {
            let needs = self.needs(now.scene);
            *plan = EditPlan::new(now.rows(), plan.budget() + 1).allowing(&needs);
        }
        match self.fault {
            Fault::NeverEdits => return Ok(()),
            Fault::ReadsTheClock => {
                let now_ns = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
                let chosen = now_ns.subsec_nanos() % (now.rows() as u32).max(1);
                for row in (0..now.rows() as u32 / 1000).map(|i| (chosen + i) % now.rows() as u32) {
                    let _ = plan.prune(row);
                }
                return Ok(());
            }
            Fault::PanicsOnManyRows => assert!(now.rows() <= 1000, "too many rows"),
            Fault::ForgetsManyRows if now.rows() > 1000 => {
                let _ = plan.prune(self.unsaved % 1000);
                self.unsaved += 1;
                return Ok(());
            }
            _ => {}
        }
        if self.events.is_multiple_of(3) {
            let keep = if self.has(Fault::PrunesAll) { 0 } else { 1 };
            for row in smallest(rows, opacity, now.rows().saturating_sub(keep).min(1)) {
                let _ = plan.prune(row);
            }
            return Ok(());
        }
        if self.has(Fault::PanicsOnNan) {
            assert!(gradient.iter().all(|g| !g.is_nan()), "a gradient is not a number");
        }
        let mut by_chance: Vec<f32> =
            rows.iter().map(|&row| rng.uniform(row ^ self.seen as u32, Purpose::Select)).collect();
        let mut by_gradient = gradient.to_vec();
        if self.has(Fault::ReadsUndeclared) {
            by_gradient = now.signal(Signal::ScreenGradientAbs)?.to_vec();
        }
        if self.has(Fault::ReadsUndeclaredIfPresent) {
            let undeclared = now.signals.get(Signal::ScreenGradientAbs);
            by_gradient = undeclared.unwrap_or(gradient).to_vec();
        }
        if self.has(Fault::ReadsUndeclaredCandidates) {
            by_gradient.truncate(now.candidates.len());
        }
        if self.has(Fault::UsesItsOwnRandomness) {
            for chance in &mut by_chance {
                *chance = (next_call() % 7) as f32;
            }
        }
        for row in top_k(&by_gradient, 1).into_iter().chain(top_k(&by_chance, 1)) {
            let grown = plan.grow(row, clone_at([0.0; 3]));
            if self.has(Fault::FailsWhenRefused) {
                grown.map_err(|refused| PolicyError::Other(refused.to_string()))?;
            }
        }
        let position = now.positions()?.first().copied();
        if let Err(Refused::BadValue(field)) = plan.update(0, Update { position, ..Update::NONE }) {
            assert!(field == "position" && !self.has(Fault::TrustsPositions), "a bad {field}");
        }
        Ok(())
    }

    fn save(&self) -> PolicyState {
        if self.has(Fault::SavesOnlyPart) {
            return serde_json::json!({ "events": self.events, "seen": 0 });
        }
        serde_json::json!({ "events": self.events, "seen": self.seen })
    }

    fn restore(&mut self, state: PolicyState) -> PolicyResult {
        if self.has(Fault::RestoresNothing) && state["events"].is_u64() {
            return Ok(());
        }
        match state["events"].as_u64() {
            Some(events) => self.events = events,
            None if self.has(Fault::AcceptsAnyState) => {}
            None => return Err(PolicyError::State("no `events`".to_owned())),
        }
        self.seen = state["seen"].as_u64().unwrap_or_default();
        Ok(())
    }
}

/// The report on a policy with this fault.
fn report(fault: Fault) -> Result<(), Report> {
    let entry = PolicyEntry::new::<Faulty>("faulty", "for tests", "nowhere", "", ("tests.rs", 1));
    check_policy_with(&entry, &Table::try_from(Params { every: 0, fault }).unwrap())
}

#[test]
fn every_fault_is_found() {
    let mut missed = Vec::new();
    for (fault, expected) in FAULTS {
        let report = report(fault);
        let failures = report.as_ref().err().map_or(&[][..], |report| &report.failures);
        let is_found = |check| failures.iter().any(|(failed, _)| *failed == check);
        if !expected.map_or(failures.is_empty(), is_found) {
            missed.push(format!("{fault:?}: {report:?}"));
        }
    }
    assert!(missed.is_empty(), "{}", missed.join("\n"));
}

#[test]
fn a_report_names_the_policy_and_the_step() {
    let report = report(Fault::ReadsUndeclared).unwrap_err().to_string();
    assert!(report.starts_with(
        "policy `faulty` (tests.rs:1) does not conform:\n- fails the check \"reads only"
    ));
    assert!(report.contains("an empty model") && report.contains("step 5"), "{report}");
    assert!(report.contains("ScreenGradientAbs"), "{report}");
}

/// Parameters that accept unknown names.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(default)]
struct Lax {
    threshold: f64,
}

/// A policy that cannot be built for a run of 7 steps.
struct Unbuildable;

impl ConfiguredPolicy for Unbuildable {
    type Params = Lax;
    const STEP_PARAMETERS: &'static [StepParameter] = &[Step("threshold")];
    fn new(params: Lax, scene: &SceneInfo) -> PolicyResult<Self> {
        in_range("threshold", params.threshold, 0.0..=1.0)?;
        if scene.iterations == 7 {
            Err(PolicyError::Other("not seven".to_owned()))
        } else {
            Ok(Self)
        }
    }
}

impl DensityPolicy for Unbuildable {
    fn needs(&self, _scene: &SceneInfo) -> Needs {
        Needs::default()
    }
    fn is_due(&self, _step: u32) -> bool {
        false
    }
    fn plan(
        &mut self,
        _now: &Snapshot<'_>,
        _rng: &PolicyRng,
        _plan: &mut EditPlan,
    ) -> PolicyResult {
        Ok(())
    }
}

#[test]
fn building_is_checked() {
    let entry = PolicyEntry::new::<Unbuildable>("x", "", "", "", ("tests.rs", 2));
    let failures = check_policy(&entry).unwrap_err().failures;
    assert_eq!(failures, [(Check::Builds, "in a run of 7 steps: not seven".to_owned())]);
}

#[test]
fn manuals_are_checked() {
    let manual = |doc| {
        let entry = PolicyEntry::new::<Unbuildable>("x", "", "", doc, ("tests.rs", 2));
        check_manual(&entry).map_err(|report| report.failures[0].1.clone())
    };
    let head = "//! | name | default | range | unit | meaning |\n//! |---|---|---|---|---|\n";
    let with = |rows: &str| -> &'static str { format!("{head}{rows}").leak() };
    assert_eq!(manual(with("//! | threshold | 0 | | | meaning |\n//!\n")), Ok(()));
    assert_eq!(manual(""), Err("`threshold` is missing".to_owned()));
    let mistaken =
        manual(with("//! | threshold | 0.1 | | | meaning |\n//! | ghost | 1 | | | meaning |\n"));
    let message = "`threshold` has the default 0.0, not 0.1, `ghost` is not a parameter";
    assert_eq!(mistaken, Err(message.to_owned()));
    let short = manual(with("//! | threshold | 0 | meaning |\n"));
    assert_eq!(short, Err("the row of `threshold` has 3 cells instead of 5".to_owned()));
    let range = |range| manual(with(&format!("//! | threshold | 0 | {range} | | meaning |\n")));
    assert_eq!([range("0 to 1"), range(">= 0"), range("")], [Ok(()), Ok(()), Ok(())]);
    for (wrong, expected) in [
        ("0 to 2", "2.0 is in its range"),
        (">= -1", "-1.0 is in its range"),
        ("> 0", "0.0 is accepted"),
        ("0 to 1, 1 excluded", "1.0 is accepted"),
        ("0 to 1, both excluded", "0.0 is accepted"),
        ("about 1", "not in a known form"),
    ] {
        let message = range(wrong).unwrap_err();
        assert!(message.contains(expected), "{wrong}: {message}");
    }
}
