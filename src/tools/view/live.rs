//! `train --view`: the page of a run in training. The training thread renders its own model between two steps, so no
//! second copy is needed, and training waits only for this rendering. Without requests, a step costs one check of an
//! empty queue.

use std::cell::Cell;
use std::fmt;
use std::thread;
use std::time::Duration;

use densify_policies::policy::SignalSet;

use super::http;
use super::picture_request::MAX_PIXELS;
use super::render;
use super::render_queue::{CloseOnDrop, RenderQueue};
use super::routes::Routes;
use super::row_colours::RowData;
use super::run_status::{self, Action, RunStatus};
use super::scene::Scene;
use super::{Server, description, encoder};
use densify_core::memory::{Ledger, Section};
use densify_render::{Backend, Device};
use densify_run::failure::{Failure, OTHER};
use densify_run::{Companion, CompanionSize, Interrupt, NextAction, Observer, Run};
use densify_train::evaluate::Mean;
use densify_train::metrics::scratch_bytes;
use densify_train::output::StepRecord;
use densify_train::trainer::{EditEvent, RowHistory};

/// Maximum number of waiting requests.
const MAX_WAITING: usize = 8;
/// Maximum number of pictures in progress; their memory is in the ledger.
const MAX_ACTIVE: usize = 1;
/// Memory of a connection: the used part of its thread's stack, its buffers and its request `[bytes]`.
const CONNECTION_BYTES: u64 = 80 << 10;
/// Memory of a view: name, path and camera three times each, and its description `[bytes]`.
const VIEW_BYTES: u64 = 4 << 10;
/// Stack of the HTTP server's thread `[bytes]`.
const STACK: usize = 256 << 10;
/// Interval at which a paused run checks for commands.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// The interrupt of a run that the page stops; the exit code is that of a signal.
const STOPPED: Interrupt = Interrupt { name: "the page", exit_code: 130 };

/// Memory of the points in the description `[bytes]`.
const POINTS_BYTES: u64 = (MAX_POINTS * description::MAX_POINT_BYTES) as u64;
/// Numbers per Gaussian while it is coloured: its value, a copy to find the ends of the scale, and its colour.
const COLOURING_NUMBERS: u64 = 5;
/// Further numbers per Gaussian on the host of a GPU: the lengths of its axes, and colours for the upload.
const COLOURING_NUMBERS_ON_GPU: usize = 12;

/// Memory of the page during the whole run `[bytes]`: connections, responses, run status, history of the Gaussians, and
/// the encoder, which may be active at any time. A picture needs the rendering, the photograph (decoded, flattened,
/// resized in one direction, then in both), their difference with the buffers of the metric, and the encoded picture.
fn page_bytes(
    largest_image: (u32, u32),
    photograph: u64,
    views: usize,
    rows: u64,
    threads: usize,
) -> u64 {
    let pixels = pixels(largest_image);
    // JPEG at the highest quality used here takes under 3 bytes per pixel, even for noise.
    let picture = pixels * 3;
    let float = size_of::<f32>() as u64;
    let bytes_per_pixel = 5 * float + size_of::<f64>() as u64 + 4 * 3;
    let full_size_pixels = u64::from(largest_image.0) * u64::from(largest_image.1);
    // Resizing converts colours and alpha to floats.
    let resizing = full_size_pixels * (3 + 4 * float);
    let encoding =
        pixels * bytes_per_pixel + resizing + photograph + scratch_bytes(largest_image.0, threads);
    let connections = http::MAX_CONNECTIONS as u64 * CONNECTION_BYTES;
    let responses = MAX_WAITING as u64 * picture;
    let status = run_status::BYTES + POINTS_BYTES + views as u64 * VIEW_BYTES;
    let encoder = encoder::STACK as u64 + MAX_ACTIVE as u64 * encoding;
    connections + responses + status + rows * RowHistory::BYTES + encoder
}

/// Memory for colouring this many Gaussians between two steps `[bytes]`.
fn colouring_bytes(rows: u64, device: &Device) -> u64 {
    let numbers = COLOURING_NUMBERS + device.columns_on_host(COLOURING_NUMBERS_ON_GPU) as u64;
    rows * numbers * size_of::<f32>() as u64
}

/// Maximum number of the dataset's points that the page draws; more would hide the scene.
pub(crate) const MAX_POINTS: usize = 4000;

/// The page's memory, for the ledger of a run that trains beside it.
pub const COMPANION: Companion = Companion { reserve, points: MAX_POINTS };

fn reserve(size: &CompanionSize<'_>, ledger: &mut Ledger) {
    let CompanionSize { budget, device, largest_image, photograph, views, threads } = *size;
    ledger.add_to(Section::Passing, "a picture for the page", colouring_bytes(budget, device));
    let bytes = page_bytes(largest_image, photograph, views, budget, threads);
    ledger.add_to(Section::Renderer, "the page", bytes);
}

fn pixels((width, height): (u32, u32)) -> u64 {
    (u64::from(width) * u64::from(height)).min(MAX_PIXELS)
}

impl Server {
    /// Trains a run and serves its page until training ends.
    ///
    /// # Errors
    /// Errors of training; a failing page does not stop training.
    pub fn follow<T>(
        &self,
        mut run: Run,
        observer: &dyn Observer,
        train: impl FnOnce(Run, &dyn Observer) -> Result<T, Failure>,
    ) -> Result<T, Failure> {
        let mut scene = Scene::of_run(&mut run);
        let (rows, signals) = (run.trainer.rows(), run.trainer.signals());
        let queue = RenderQueue::new(Some(MAX_WAITING), MAX_ACTIVE);
        let run_status = RunStatus::default();
        let description = description::describe(&mut scene);
        let routes = Routes {
            listener: self,
            queue: &queue,
            scene: &scene,
            description,
            run_status: Some(&run_status),
        };
        thread::scope(|scope| {
            let _close = CloseOnDrop(&queue);
            let (queue, routes) = (&queue, &routes);
            let thread_error = |error| {
                let problem = "--view: the system cannot start a thread for the page";
                Failure::new(OTHER, format!("{problem}: {error}"))
            };
            let encoder = encoder::start(scope, queue, &scene).map_err(thread_error)?;
            let server = thread::Builder::new().stack_size(STACK).spawn_scoped(scope, move || {
                let _close = CloseOnDrop(queue);
                let respond = |request: &http::Request| routes.respond(request);
                let served = http::serve(&routes.listener.socket, &respond, &|| queue.is_closed());
                if let Err(error) = served {
                    tracing::error!(
                        "the page can no longer be served, training continues: {error}"
                    );
                }
            });
            server.map_err(thread_error)?;
            let (run_status, scene, step) = (&run_status, &scene, Cell::new(0));
            let live = LiveObserver { observer, queue, run_status, scene, rows, signals, step };
            let trained = train(run, &live);
            queue.close();
            // A failed encoder has logged its error, and must not make training fail.
            let _ = encoder.join();
            trained
        })
    }
}

/// The observer of a run that shows it on the page.
struct LiveObserver<'a> {
    observer: &'a dyn Observer,
    queue: &'a RenderQueue,
    run_status: &'a RunStatus,
    scene: &'a Scene,
    /// Number of Gaussians at the beginning.
    rows: usize,
    /// Signals that training accumulates.
    signals: SignalSet,
    /// The last completed step.
    step: Cell<u32>,
}

impl LiveObserver<'_> {
    /// Renders the next requested picture; waits for a request, but no longer than `timeout`.
    fn render_next(&self, model: &mut dyn Backend, rows: Option<&RowHistory>, timeout: Duration) {
        if let Some(job) = self.queue.next_within(timeout) {
            let history = rows.map(|rows| (rows, self.step.get()));
            let row_data = RowData { signals: self.signals, history, measurements: None };
            let rendered = render::render_live(self.scene, model, row_data, &job.request);
            self.queue.finish_rendering(job, rendered);
        }
    }
}

impl Observer for LiveObserver<'_> {
    fn say(&self, line: fmt::Arguments<'_>) {
        self.observer.say(line);
    }

    fn begin(&self, done: u32, last: u32, budget: usize) {
        self.step.set(done);
        self.run_status.begin(done, last, budget, self.rows);
        self.observer.begin(done, last, budget);
    }

    fn step(&self, step: u32, loss: f32, rows: usize) {
        self.step.set(step);
        self.run_status.step(step, rows);
        self.observer.step(step, loss, rows);
    }

    fn recorded(&self, record: &StepRecord) {
        self.run_status.record(record);
        self.observer.recorded(record);
    }

    fn edited(&self, event: &EditEvent) {
        self.run_status.record_edit(event);
        self.observer.edited(event);
    }

    fn tested(&self, step: u32, mean: &Mean) {
        self.run_status.record_test(step, mean);
        self.observer.tested(step, mean);
    }

    fn checkpoint_written(&self, step: u32, trouble: Option<&str>) {
        self.run_status.record_checkpoint(step, trouble);
        self.observer.checkpoint_written(step, trouble);
    }

    fn end(&self) {
        self.run_status.end();
        self.observer.end();
    }

    fn between_steps(&self, model: &mut dyn Backend, rows: Option<&RowHistory>) -> NextAction {
        self.render_next(model, rows, Duration::ZERO);
        loop {
            match self.run_status.next_action() {
                Action::Checkpoint => return NextAction::Checkpoint,
                Action::Step | Action::Stop => return NextAction::Step,
                // A closed page cannot send the command to continue.
                Action::Wait if self.observer.interrupt().is_some() || self.queue.is_closed() => {
                    return NextAction::Step;
                }
                Action::Wait => self.render_next(model, rows, POLL_INTERVAL),
            }
        }
    }

    fn interrupt(&self) -> Option<Interrupt> {
        let stopped = || self.run_status.is_stopped().then_some(STOPPED);
        self.observer.interrupt().or_else(stopped)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::open::scene_of_one_view;
    use crate::run_status::Command;
    use densify_core::gaussians::Gaussians;
    use densify_render::{Device, Setup};
    use densify_run::Silent;

    #[test]
    fn a_paused_run_continues_when_its_page_closes() {
        let (_folder, scene) = scene_of_one_view();
        let (queue, run_status) = (RenderQueue::new(Some(1), 1), RunStatus::default());
        run_status.begin(0, 10, 1, 1);
        run_status.command(Command::Pause);
        let (signals, step) = (SignalSet::default(), Cell::new(0));
        let live = LiveObserver {
            observer: &Silent,
            queue: &queue,
            run_status: &run_status,
            scene: &scene,
            rows: 1,
            signals,
            step,
        };
        let model = Gaussians::zeros(1, 0);
        let mut backend = Device::default().backend(&model, &Setup::new(1)).expect("a backend");
        thread::scope(|scope| {
            let waits = scope.spawn(|| {
                thread::sleep(5 * POLL_INTERVAL);
                let is_paused = matches!(run_status.next_action(), Action::Wait);
                queue.close();
                is_paused
            });
            assert_eq!(live.between_steps(&mut *backend, None), NextAction::Step);
            assert!(queue.is_closed() && waits.join().expect("it ends"), "the run was not paused");
        });
    }
}
