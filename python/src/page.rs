//! The page of `densify view`, served by a thread while Python goes on.

use std::net::Ipv4Addr;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use densify_run::failure::{Failure, OTHER};
use densify_run::finished::Machine;
use densify_view::{ListenAddress, Server, ViewOptions};
use pyo3::prelude::*;

use crate::errors::detached;
use crate::follow::Listener;
use crate::options;

/// A page in the browser.
#[pyclass(module = "densify._densify", frozen)]
pub(crate) struct PageCore {
    /// The page's address.
    #[pyo3(get)]
    url: String,
    is_over: Arc<AtomicBool>,
    thread: Mutex<Option<JoinHandle<Result<(), Failure>>>>,
}

/// Serves a page with a model, a run or a dataset.
#[pyfunction]
#[pyo3(signature = (path, other, options, *, iteration, port, listener))]
pub(crate) fn serve(
    py: Python<'_>,
    path: PathBuf,
    other: Option<PathBuf>,
    options: &str,
    iteration: Option<u32>,
    port: Option<u16>,
    listener: &Bound<'_, PyAny>,
) -> PyResult<PageCore> {
    Listener::new(Some(listener), None)?.follow(py, move |follower| {
        let spec = options::for_model(options, densify_view::is_run(&path), &["antialias"])?;
        let host = Ipv4Addr::LOCALHOST.into();
        let server = Server::open(ListenAddress { host, port, needs_token: false })?;
        let machine = Machine::open(&spec.device, follower)?;
        let options = ViewOptions {
            path: &path,
            other: other.as_deref(),
            dataset: spec.start.scene,
            iteration,
            near: spec.start.near,
            antialias: spec.start.antialias,
            data: spec.data,
        };
        let scene = densify_view::open(options, machine, follower)?;
        let (url, is_over) = (server.url(), Arc::new(AtomicBool::new(false)));
        let asked = is_over.clone();
        let thread = std::thread::Builder::new()
            .name("densify page".to_owned())
            .spawn(move || server.serve(scene, &|| asked.load(Ordering::SeqCst)))
            .map_err(|error| {
                Failure::new(OTHER, format!("the system cannot start a thread: {error}"))
            })?;
        Ok(PageCore { url, is_over, thread: Mutex::new(Some(thread)) })
    })
}

#[pymethods]
impl PageCore {
    /// Ends the page.
    fn close(&self, py: Python<'_>) -> PyResult<()> {
        self.is_over.store(true, Ordering::SeqCst);
        let thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner).take();
        let Some(thread) = thread else { return Ok(()) };
        detached(py, || {
            thread
                .join()
                .unwrap_or_else(|_| Err(Failure::new(OTHER, "the page has failed; this is a bug")))
        })
    }
}

impl Drop for PageCore {
    fn drop(&mut self) {
        // The thread ends by itself within a fraction of a second.
        self.is_over.store(true, Ordering::SeqCst);
    }
}
