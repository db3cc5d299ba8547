//! Follows a run on behalf of Python: progress and records go to a Python object, and a run stops between two steps when
//! it is asked to.

use std::cell::{Cell, RefCell};
use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use densify_core::spelling::Spelling;
use densify_run::{Interrupt, Observer};
use densify_train::evaluate::Mean;
use densify_train::output::StepRecord;
use densify_train::trainer::EditEvent;
use pyo3::prelude::*;

/// Exit code of a process that SIGINT has ended.
const SIGINT_EXIT: u8 = 130;
/// Interval between two looks at Python's signals, and between two redraws: a call from a loop without the interpreter
/// may have to wait for other Python threads.
const LOOK_INTERVAL: Duration = Duration::from_millis(100);

/// A request to stop a run between two steps.
#[pyclass(module = "densify._densify", frozen)]
#[derive(Default)]
pub(crate) struct Stop {
    asked: Arc<AtomicBool>,
    by_signal: Arc<AtomicBool>,
}

#[pymethods]
impl Stop {
    #[new]
    fn new() -> Self {
        Self::default()
    }

    /// Asks for the stop.
    #[pyo3(signature = (*, by_signal = false))]
    fn ask(&self, by_signal: bool) {
        self.by_signal.fetch_or(by_signal, Ordering::SeqCst);
        self.asked.store(true, Ordering::SeqCst);
    }

    /// Takes the request back.
    fn clear(&self) {
        self.by_signal.store(false, Ordering::SeqCst);
        self.asked.store(false, Ordering::SeqCst);
    }

    /// True if a signal asks for the stop.
    #[getter]
    fn by_signal(&self) -> bool {
        self.by_signal.load(Ordering::SeqCst)
    }

    /// True once the stop was asked for.
    #[getter]
    fn asked(&self) -> bool {
        self.asked.load(Ordering::SeqCst)
    }
}

impl Stop {
    fn share(&self) -> Self {
        Self { asked: self.asked.clone(), by_signal: self.by_signal.clone() }
    }
}

/// What a [`Follower`] is made of; it can move to another thread.
pub(crate) struct Listener {
    object: Option<Py<PyAny>>,
    every_step: bool,
    stop: Stop,
}

impl Listener {
    /// A listener that calls the methods of `object`, a `densify._progress.Listener`.
    pub(crate) fn new(
        object: Option<&Bound<'_, PyAny>>,
        stop: Option<&Bound<'_, Stop>>,
    ) -> PyResult<Self> {
        let every_step = match object {
            Some(object) => object.getattr("every_step")?.extract()?,
            None => false,
        };
        let stop = stop.map_or_else(Stop::default, |stop| stop.get().share());
        Ok(Self { object: object.map(|object| object.clone().unbind()), every_step, stop })
    }

    /// Does work that is followed. An exception of the Python object takes the place of the work's own result.
    pub(crate) fn follow<T: Send>(
        self,
        py: Python<'_>,
        work: impl FnOnce(&Follower) -> Result<T, densify_run::failure::Failure> + Send,
    ) -> PyResult<T> {
        let mut raised = None;
        let done = super::errors::detached(py, || {
            let follower = Follower {
                listener: self,
                error: RefCell::default(),
                looked: Cell::new(None),
                drawn: Cell::new(None),
                hidden: Cell::new(None),
            };
            let done = work(&follower);
            raised = follower.error.into_inner();
            done
        });
        raised.map_or(done, Err)
    }
}

/// Follows a run.
pub(crate) struct Follower {
    listener: Listener,
    /// The first exception of the Python object, which stops the run.
    error: RefCell<Option<PyErr>>,
    /// When Python's signals were last looked at.
    looked: Cell<Option<Instant>>,
    /// When progress was last shown.
    drawn: Cell<Option<Instant>>,
    /// The last step, if it was not shown: step, loss and rows.
    hidden: Cell<Option<(u32, f32, usize)>>,
}

impl Follower {
    fn tell(&self, call: impl FnOnce(&Bound<'_, PyAny>) -> PyResult<()>) {
        let Some(object) = &self.listener.object else { return };
        if self.error.borrow().is_some() {
            return;
        }
        if let Err(error) = Python::attach(|py| call(object.bind(py))) {
            *self.error.borrow_mut() = Some(error);
        }
    }

    fn show(&self, step: u32, loss: f32, rows: usize) {
        self.tell(|object| object.call_method1("step", (step, loss, rows)).map(drop));
    }

    fn tell_json(&self, method: &str, value: &impl serde::Serialize) {
        // A record of plain numbers and text can always be written.
        let text = serde_json::to_string(value).unwrap_or_default();
        self.tell(|object| object.call_method1(method, (text,)).map(drop));
    }
}

/// True if the time of the last event is longer ago than the interval; then it becomes now.
fn is_time(last: &Cell<Option<Instant>>) -> bool {
    let now = Instant::now();
    let due = last.get().is_none_or(|last| now.duration_since(last) >= LOOK_INTERVAL);
    if due {
        last.set(Some(now));
    }
    due
}

/// Lets Python's handlers of signals run.
#[expect(
    clippy::redundant_closure_for_method_calls,
    reason = "the method alone is not general enough in its lifetime"
)]
fn check_signals() -> PyResult<()> {
    Python::attach(|py| py.check_signals())
}

impl Observer for Follower {
    fn spelling(&self) -> Spelling {
        Spelling::Keyword
    }

    fn say(&self, line: fmt::Arguments<'_>) {
        let line = line.to_string();
        self.tell(|object| object.call_method1("say", (line,)).map(drop));
    }

    fn begin(&self, done: u32, last: u32, budget: usize) {
        self.tell(|object| object.call_method1("begin", (done, last, budget)).map(drop));
    }

    fn step(&self, step: u32, loss: f32, rows: usize) {
        if self.listener.every_step || is_time(&self.drawn) {
            self.hidden.set(None);
            self.show(step, loss, rows);
        } else {
            self.hidden.set(Some((step, loss, rows)));
        }
    }

    fn recorded(&self, record: &StepRecord) {
        self.tell_json("recorded", record);
    }

    fn edited(&self, event: &EditEvent) {
        self.tell_json("edited", event);
    }

    fn tested(&self, step: u32, mean: &Mean) {
        self.tell_json("tested", &(step, mean));
    }

    fn end(&self) {
        if let Some((step, loss, rows)) = self.hidden.take() {
            self.show(step, loss, rows);
        }
        self.tell(|object| object.call_method0("end").map(drop));
    }

    fn interrupt(&self) -> Option<Interrupt> {
        if self.error.borrow().is_none()
            && is_time(&self.looked)
            && let Err(error) = check_signals()
        {
            *self.error.borrow_mut() = Some(error);
        }
        let is_asked = self.listener.stop.asked() || self.error.borrow().is_some();
        let name =
            if self.listener.stop.by_signal.load(Ordering::SeqCst) { "SIGINT" } else { "stop()" };
        is_asked.then_some(Interrupt { name, exit_code: SIGINT_EXIT })
    }
}
