//! `train --view`: the page of a run in training. Pictures are made between two steps, by the thread that trains
//! and with its model, so that training needs no second copy of it; while nobody asks, a step costs a look at an
//! empty desk.

use std::cell::RefCell;
use std::fmt;
use std::thread;
use std::time::Duration;

use super::asked::MOST_PIXELS;
use super::board::{self, Board, Next};
use super::desk::{Closing, Desk};
use super::http;
use super::pictures;
use super::routes::Routes;
use super::stage::Stage;
use super::{Server, describe};
use crate::backend::Backend;
use crate::evaluate::Mean;
use crate::failure::{Failure, OTHER};
use crate::metrics::scratch_bytes;
use crate::output::StepRecord;
use crate::run::{Between, Interrupt, Observer, Run};
use crate::trainer::EditEvent;

/// Most pictures that are waited for.
const MOST_WISHES: usize = 8;
/// What a connection takes: what its thread touches of its stack and keeps of its buffers, and its request
/// `[bytes]`.
const SEAT: u64 = 80 << 10;
/// What a view takes: its name, path and camera thrice, and what is said of it `[bytes]`.
const VIEW: u64 = 4 << 10;
/// Bytes of the stack of the thread that waits for the end.
const STACK: usize = 256 << 10;
/// How often a paused run looks for orders.
const PULSE: Duration = Duration::from_millis(20);
/// How a run ends that the page has stopped: as by a signal.
const STOPPED: Interrupt = Interrupt { name: "the page", exit_code: 130 };

/// What the page takes throughout: connections, answers on their way, and what it says of the run `[bytes]`.
pub(crate) fn lasting_bytes(largest_image: (u32, u32), views: usize) -> u64 {
    // JPEG at the best quality that is used takes under 3 bytes of a pixel, noise included.
    let frame = pixels(largest_image) * 3;
    let (seats, wishes) = (http::SEATS as u64, MOST_WISHES as u64);
    seats * SEAT + wishes * frame + board::BYTES + views as u64 * VIEW
}

/// What making a picture takes `[bytes]`: the rendering, the photograph as it is, flattened, half-way to the
/// picture's size and at it, their difference with what measuring it takes, and the picture.
pub(crate) fn passing_bytes(largest_image: (u32, u32), photograph: u64, threads: usize) -> u64 {
    let float = size_of::<f32>() as u64;
    let pixel = 5 * float + size_of::<f64>() as u64 + 4 * 3;
    let whole = u64::from(largest_image.0) * u64::from(largest_image.1);
    // While it is made smaller its colours and alpha are floats.
    let smaller = whole * (3 + 4 * float);
    pixels(largest_image) * pixel + smaller + photograph + scratch_bytes(largest_image.0, threads)
}

fn pixels((width, height): (u32, u32)) -> u64 {
    (u64::from(width) * u64::from(height)).min(MOST_PIXELS)
}

impl Server {
    /// Trains a run, and serves its page until it ends.
    ///
    /// # Errors
    /// Those of training; a page that fails does not end it.
    pub(crate) fn follow<T>(
        &self,
        mut run: Run,
        observer: &dyn Observer,
        train: impl FnOnce(Run, &dyn Observer) -> Result<T, Failure>,
    ) -> Result<T, Failure> {
        let stage = Stage::of_run(&mut run);
        let rows = run.trainer().rows();
        let (desk, board) = (Desk::bounded(MOST_WISHES), Board::default());
        let routes = Routes {
            door: &self.door,
            desk: &desk,
            extent: stage.extent(),
            description: describe::describe(&stage).to_string(),
            board: Some(&board),
        };
        thread::scope(|scope| {
            let _closing = Closing(&desk);
            let (desk, routes) = (&desk, &routes);
            let serves = thread::Builder::new().stack_size(STACK).spawn_scoped(scope, move || {
                let answer = |request: &http::Request| routes.answer(request);
                let served = http::serve(&routes.door.listener, &answer, &|| desk.is_over());
                if let Err(error) = served {
                    tracing::error!(
                        "the page cannot be served any more, training goes on: {error}"
                    );
                }
            });
            serves.map_err(|error| Failure {
                code: OTHER,
                message: format!("--view: the system gives no thread for the page: {error}"),
            })?;
            let live = Live { observer, desk, board: &board, stage: RefCell::new(stage), rows };
            train(run, &live)
        })
    }
}

/// Follows a run, and shows it.
struct Live<'a> {
    observer: &'a dyn Observer,
    desk: &'a Desk,
    board: &'a Board,
    stage: RefCell<Stage>,
    /// At the beginning.
    rows: usize,
}

impl Live<'_> {
    /// Makes a picture that is waited for, or waits so long for one to be wanted.
    fn draw(&self, model: &mut dyn Backend, patience: Duration) {
        if let Some(ticket) = self.desk.next_within(patience) {
            let made = pictures::make(&mut self.stage.borrow_mut(), &mut [model], &ticket.wanted);
            ticket.reply(made);
        }
    }
}

impl Observer for Live<'_> {
    fn say(&self, line: fmt::Arguments<'_>) {
        self.observer.say(line);
    }

    fn begin(&self, done: u32, last: u32, budget: usize) {
        self.board.begin(done, last, budget, self.rows);
        self.observer.begin(done, last, budget);
    }

    fn step(&self, step: u32, loss: f32, rows: usize) {
        self.board.step(step, rows);
        self.observer.step(step, loss, rows);
    }

    fn recorded(&self, record: &StepRecord) {
        self.board.record(record);
        self.observer.recorded(record);
    }

    fn edited(&self, event: &EditEvent) {
        self.board.edit(event);
        self.observer.edited(event);
    }

    fn tested(&self, step: u32, mean: &Mean) {
        self.board.tested(step, mean);
        self.observer.tested(step, mean);
    }

    fn kept(&self, step: u32, trouble: Option<&str>) {
        self.board.kept(step, trouble);
        self.observer.kept(step, trouble);
    }

    fn end(&self) {
        self.board.end();
        self.observer.end();
    }

    fn between(&self, model: &mut dyn Backend) -> Between {
        self.draw(model, Duration::ZERO);
        loop {
            match self.board.next() {
                Next::Checkpoint => return Between::Checkpoint,
                Next::Step | Next::Stop => return Between::Step,
                Next::Wait if self.observer.interrupt().is_some() => return Between::Step,
                Next::Wait => self.draw(model, PULSE),
            }
        }
    }

    fn interrupt(&self) -> Option<Interrupt> {
        let stopped = || self.board.stops().then_some(STOPPED);
        self.observer.interrupt().or_else(stopped)
    }
}
