//! A Python object as a policy.

use std::cell::RefCell;

use densify_policies::plan::EditPlan;
use densify_policies::policy::{
    AuxView, Cadence, DensityPolicy, LossTerms, Needs, NoiseTerm, PolicyError, PolicyResult,
    PolicyState, SceneInfo, Snapshot,
};
use densify_policies::rng::PolicyRng;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyTuple;

use super::edits::Plan;
use super::now::{Now, SceneView, View};
use super::rng::Rng;
use super::{failed, needs};

/// The module with the parts of the bridge that are written in Python.
const MODULE: &str = "densify._policy";
/// Steps that are asked for at once: each call from a loop without the interpreter may wait for other threads.
const AHEAD: u32 = 1000;
/// The same for a policy with state, which is asked again after every event.
const AHEAD_WITH_STATE: u32 = 100;

/// Answers for consecutive steps.
struct Answers<T> {
    first: u32,
    values: Vec<T>,
}

impl<T> Default for Answers<T> {
    fn default() -> Self {
        Self { first: 0, values: Vec::new() }
    }
}

impl<T: Copy> Answers<T> {
    fn at(&self, step: u32) -> Option<T> {
        self.values.get(step.checked_sub(self.first)? as usize).copied()
    }
}

/// The answers of a policy's schedules.
#[derive(Default)]
struct Schedules {
    is_due: RefCell<Answers<bool>>,
    cadence: RefCell<Answers<Cadence>>,
    loss_terms: RefCell<Answers<LossTerms>>,
    noise: RefCell<Answers<Option<NoiseTerm>>>,
    resolution: RefCell<Answers<f64>>,
}

/// The optional methods that a class has.
struct Methods {
    cadence: bool,
    loss_terms: bool,
    noise: bool,
    resolution: bool,
    aux_views: bool,
    observe: bool,
}

/// A policy written in Python.
pub(super) struct PythonPolicy {
    object: Py<PyAny>,
    methods: Methods,
    scene: SceneInfo,
    needs: Needs,
    schedules: Schedules,
    /// The state after the last event; `None` for a class without state.
    state: Option<PolicyState>,
    /// An error of a method that cannot return one; it ends the run at the next plan, which is then due.
    pending: RefCell<Option<PolicyError>>,
}

/// Calls a function of the Python part of the bridge.
fn helper<'py>(
    py: Python<'py>,
    name: &str,
    arguments: impl pyo3::call::PyCallArgs<'py>,
) -> PyResult<Bound<'py, PyAny>> {
    py.import(MODULE)?.getattr(name)?.call1(arguments)
}

fn declared_needs(py: Python<'_>, object: &Py<PyAny>, scene: &SceneInfo) -> PyResult<Needs> {
    let view = Py::new(py, SceneView::new(scene))?;
    needs::parse(&helper(py, "needs_of", (object, view))?.extract::<String>()?)
}

fn state_of(py: Python<'_>, object: &Py<PyAny>) -> PyResult<Option<PolicyState>> {
    let text: Option<String> = helper(py, "state_of", (object,))?.extract()?;
    let parse = |text: String| {
        serde_json::from_str(&text).map_err(|error| {
            PyValueError::new_err(format!("the state cannot be saved: {error} of its JSON"))
        })
    };
    text.map(parse).transpose()
}

/// A number that `densify._policy.numbers_of` has taken from a class of the declarations.
fn numbers<const COUNT: usize>(answer: &Bound<'_, PyAny>, class: &str) -> PyResult<[f64; COUNT]> {
    helper(answer.py(), "numbers_of", (answer, class))?.extract()
}

fn whole(number: f64) -> u32 {
    number as u32
}

impl PythonPolicy {
    pub(super) fn new(py: Python<'_>, object: Py<PyAny>, scene: &SceneInfo) -> PyResult<Self> {
        let has = |method: &str| object.bind(py).hasattr(method);
        let methods = Methods {
            cadence: has("cadence")?,
            loss_terms: has("loss_terms")?,
            noise: has("noise")?,
            resolution: has("resolution")?,
            aux_views: has("aux_views")?,
            observe: has("observe")?,
        };
        let needs = declared_needs(py, &object, scene)?;
        let state = state_of(py, &object)?;
        let (scene, schedules) = (scene.clone(), Schedules::default());
        Ok(Self { object, methods, scene, needs, schedules, state, pending: RefCell::default() })
    }

    fn suspend(&self, error: PolicyError) {
        self.pending.borrow_mut().get_or_insert(error);
    }

    /// The answer of a method for a step. An exception counts for the step at which it is raised.
    fn ask<T: Copy>(
        &self,
        answers: &RefCell<Answers<T>>,
        step: u32,
        fallback: T,
        ask: impl Fn(&Bound<'_, PyAny>, u32) -> PyResult<T>,
    ) -> T {
        if let Some(known) = answers.borrow().at(step) {
            return known;
        }
        let mut values = Vec::new();
        Python::attach(|py| {
            let ahead = if self.state.is_some() { AHEAD_WITH_STATE } else { AHEAD };
            for next in step..step.saturating_add(ahead) {
                match ask(self.object.bind(py), next) {
                    Ok(value) => values.push(value),
                    Err(error) if next == step => {
                        self.suspend(failed(py, error));
                        break;
                    }
                    // Asked again, and reported, when this step comes.
                    Err(_) => break,
                }
            }
        });
        let answer = values.first().copied().unwrap_or(fallback);
        *answers.borrow_mut() = Answers { first: step, values };
        answer
    }

    /// Calls the policy's own methods at an event, and keeps its state.
    fn at_event(
        &mut self,
        call: impl FnOnce(Python<'_>, &Py<PyAny>) -> PyResult<()>,
    ) -> PolicyResult {
        let done = Python::attach(|py| {
            let called = call(py, &self.object).and_then(|()| state_of(py, &self.object));
            called.map_err(|error| failed(py, error))
        });
        self.state = done?;
        if self.state.is_some() {
            // Schedules may depend on the state, and on nothing else that changes.
            self.schedules = Schedules::default();
        }
        Ok(())
    }
}

impl DensityPolicy for PythonPolicy {
    fn needs(&self, scene: &SceneInfo) -> Needs {
        if *scene == self.scene {
            return self.needs.clone();
        }
        Python::attach(|py| {
            declared_needs(py, &self.object, scene).unwrap_or_else(|error| {
                self.suspend(failed(py, error));
                self.needs.clone()
            })
        })
    }

    fn is_due(&self, step: u32) -> bool {
        let due = self.ask(&self.schedules.is_due, step, true, |object, step| {
            object.call_method1("is_due", (step,))?.extract()
        });
        due || self.pending.borrow().is_some()
    }

    fn cadence(&self, step: u32) -> Cadence {
        if !self.methods.cadence {
            return Cadence::default();
        }
        self.ask(&self.schedules.cadence, step, Cadence::default(), |object, step| {
            let [all, sh_rest] = numbers(&object.call_method1("cadence", (step,))?, "Cadence")?;
            Ok(Cadence { all: whole(all), sh_rest: whole(sh_rest) })
        })
    }

    fn loss_terms(&self, step: u32, declared: LossTerms) -> LossTerms {
        if !self.methods.loss_terms {
            return declared;
        }
        self.ask(&self.schedules.loss_terms, step, declared, |object, step| {
            let [opacity, scale] =
                numbers(&object.call_method1("loss_terms", (step,))?, "LossTerms")?;
            Ok(LossTerms { opacity: opacity as f32, scale: scale as f32 })
        })
    }

    fn noise(&self, step: u32, declared: Option<NoiseTerm>) -> Option<NoiseTerm> {
        if !self.methods.noise {
            return declared;
        }
        self.ask(&self.schedules.noise, step, declared, |object, step| {
            let answer = object.call_method1("noise", (step,))?;
            if answer.is_none() {
                return Ok(None);
            }
            let [strength, sharpness, opacity] =
                numbers(&answer, "NoiseTerm")?.map(|number: f64| number as f32);
            Ok(Some(NoiseTerm { strength, sharpness, opacity }))
        })
    }

    fn resolution(&self, step: u32) -> f64 {
        if !self.methods.resolution {
            return 1.0;
        }
        self.ask(&self.schedules.resolution, step, 1.0, |object, step| {
            object.call_method1("resolution", (step,))?.extract()
        })
    }

    fn aux_views(&self, step: u32, rows: usize, budget: usize) -> u32 {
        if !self.methods.aux_views {
            return 0;
        }
        Python::attach(|py| {
            let asked = self.object.call_method1(py, "aux_views", (step, rows, budget));
            asked.and_then(|views| views.extract(py)).unwrap_or_else(|error| {
                self.suspend(failed(py, error));
                0
            })
        })
    }

    fn observe(&mut self, view: &AuxView<'_>) -> PolicyResult {
        if !self.methods.observe {
            return Ok(());
        }
        let columns = self.needs.aux.as_ref().map_or_else(Vec::new, |aux| aux.columns.clone());
        self.at_event(|py, object| {
            let view = Py::new(py, View::new(py, view, &columns)?)?;
            helper(py, "call_quietly", (object.getattr(py, "observe")?, view)).map(drop)
        })
    }

    fn plan(&mut self, now: &Snapshot<'_>, rng: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
        if let Some(error) = self.pending.take() {
            return Err(error);
        }
        let signals = self.needs.signals;
        self.at_event(|py, object| {
            // The plan moves into the Python object and back, so the policy cannot use it after the event.
            let now_object = Py::new(py, Now::new(py, now, signals)?)?;
            let rng_object = Py::new(py, Rng::new(*rng, now.rows()))?;
            let empty = EditPlan::new(0, 0);
            let plan_object = Py::new(py, Plan::new(std::mem::replace(plan, empty)))?;
            let arguments = PyTuple::new(
                py,
                [
                    object.getattr(py, "plan")?,
                    now_object.into_any(),
                    rng_object.into_any(),
                    plan_object.clone_ref(py).into_any(),
                ],
            )?;
            let called = helper(py, "call_quietly", arguments);
            *plan = plan_object.get().take()?;
            called.map(drop)
        })
    }

    fn save(&self) -> PolicyState {
        self.state.clone().unwrap_or_default()
    }

    fn restore(&mut self, state: PolicyState) -> PolicyResult {
        if self.state.is_none() {
            if state.is_null() {
                return Ok(());
            }
            return Err(PolicyError::State(format!(
                "this policy keeps no state, but the checkpoint holds {state}"
            )));
        }
        let restored = Python::attach(|py| {
            helper(py, "restore_state", (&self.object, state.to_string()))
                .and_then(|_| state_of(py, &self.object))
                .map_err(|error| PolicyError::State(super::keep(py, error)))
        });
        self.state = restored?;
        self.schedules = Schedules::default();
        Ok(())
    }
}
