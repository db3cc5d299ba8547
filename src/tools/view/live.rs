//! `train --view`: the page of a run in training. It is rendered between two steps, by the thread that trains and with
//! its model, so that training needs no second copy of it, and waits for nothing else; while nobody asks, a step costs
//! a look at an empty desk.

use std::cell::Cell;
use std::fmt;
use std::thread;
use std::time::Duration;

use densify_policies::policy::SignalSet;

use super::asked::MOST_PIXELS;
use super::board::{self, Board, Next};
use super::desk::{Closing, Desk};
use super::http;
use super::negative;
use super::paint::Known;
use super::routes::Routes;
use super::stage::Stage;
use super::{Server, darkroom, describe};
use densify_core::memory::{Ledger, Section};
use densify_render::{Backend, Device};
use densify_run::failure::{Failure, OTHER};
use densify_run::{Between, Companion, CompanionSize, Interrupt, Observer, Run};
use densify_train::evaluate::Mean;
use densify_train::metrics::scratch_bytes;
use densify_train::output::StepRecord;
use densify_train::trainer::{EditEvent, RowHistory};

/// Most pictures that are waited for.
const MOST_WISHES: usize = 8;
/// Pictures in the making at a time: what they take is promised.
const AT_ONCE: usize = 1;
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

/// What is said of the points that are drawn `[bytes]`.
const POINTS: u64 = (POINTS_TO_LOOK_AT * describe::POINT) as u64;
/// Numbers per row while it is painted: what it is painted by, for its scale once more, and its colour; and on the host
/// of a GPU the lengths of its axes, and colours of its own.
const PAINT: u64 = 5;
const PAINT_ON_GPU: usize = 12;

/// What the page takes throughout: connections, answers on their way, what it says of the run and remembers of so many
/// rows, and the making of a picture, which may be at any time: the rendering, the photograph as it is, flattened,
/// half-way to the picture's size and at it, their difference with what measuring it takes, and the picture `[bytes]`.
fn lasting_bytes(
    largest_image: (u32, u32),
    photograph: u64,
    views: usize,
    rows: u64,
    threads: usize,
) -> u64 {
    let pixels = pixels(largest_image);
    // JPEG at the best quality that is used takes under 3 bytes of a pixel, noise included.
    let frame = pixels * 3;
    let (seats, wishes) = (http::SEATS as u64, MOST_WISHES as u64);
    let float = size_of::<f32>() as u64;
    let pixel = 5 * float + size_of::<f64>() as u64 + 4 * 3;
    let whole = u64::from(largest_image.0) * u64::from(largest_image.1);
    // While it is made smaller its colours and alpha are floats.
    let smaller = whole * (3 + 4 * float);
    let making = pixels * pixel + smaller + photograph + scratch_bytes(largest_image.0, threads);
    let said = board::BYTES + POINTS + views as u64 * VIEW;
    let darkroom = darkroom::STACK as u64 + AT_ONCE as u64 * making;
    seats * SEAT + wishes * frame + said + rows * RowHistory::BYTES + darkroom
}

/// What painting so many rows takes, between two steps `[bytes]`.
fn passing_bytes(rows: u64, device: &Device) -> u64 {
    let numbers = PAINT + device.columns_on_host(PAINT_ON_GPU) as u64;
    rows * numbers * size_of::<f32>() as u64
}

/// Most of the dataset's points that the page draws: more hide what they are on.
pub(crate) const POINTS_TO_LOOK_AT: usize = 4000;

/// The page as a run that is to train beside it knows it.
pub const COMPANION: Companion = Companion { reserve, points: POINTS_TO_LOOK_AT };

fn reserve(size: &CompanionSize<'_>, ledger: &mut Ledger) {
    let CompanionSize { budget, device, largest_image, photograph, views, threads } = *size;
    ledger.add_to(Section::Passing, "a picture for the page", passing_bytes(budget, device));
    let bytes = lasting_bytes(largest_image, photograph, views, budget, threads);
    ledger.add_to(Section::Renderer, "the page", bytes);
}

fn pixels((width, height): (u32, u32)) -> u64 {
    (u64::from(width) * u64::from(height)).min(MOST_PIXELS)
}

impl Server {
    /// Trains a run, and serves its page until it ends.
    ///
    /// # Errors
    /// Those of training; a page that fails does not end it.
    pub fn follow<T>(
        &self,
        mut run: Run,
        observer: &dyn Observer,
        train: impl FnOnce(Run, &dyn Observer) -> Result<T, Failure>,
    ) -> Result<T, Failure> {
        let mut stage = Stage::of_run(&mut run);
        let (rows, signals) = (run.trainer().rows(), run.trainer().signals());
        let (desk, board) = (Desk::new(Some(MOST_WISHES), AT_ONCE), Board::default());
        let routes = Routes {
            door: &self.door,
            desk: &desk,
            extent: stage.extent(),
            description: describe::describe(&mut stage),
            board: Some(&board),
        };
        thread::scope(|scope| {
            let _closing = Closing(&desk);
            let (desk, routes) = (&desk, &routes);
            let no_thread = |error| {
                Failure::new(
                    OTHER,
                    format!("--view: the system gives no thread for the page: {error}"),
                )
            };
            let develops = darkroom::open(scope, desk, &stage).map_err(no_thread)?;
            let serves = thread::Builder::new().stack_size(STACK).spawn_scoped(scope, move || {
                let _closing = Closing(desk);
                let answer = |request: &http::Request| routes.answer(request);
                let served = http::serve(&routes.door.listener, &answer, &|| desk.is_over());
                if let Err(error) = served {
                    tracing::error!(
                        "the page cannot be served any more, training goes on: {error}"
                    );
                }
            });
            serves.map_err(no_thread)?;
            let (board, stage, step) = (&board, &stage, Cell::new(0));
            let live = Live { observer, desk, board, stage, rows, signals, step };
            let trained = train(run, &live);
            desk.close();
            // If it has failed it has said so, and training needs none of it.
            let _ = develops.join();
            trained
        })
    }
}

/// Follows a run, and shows it.
struct Live<'a> {
    observer: &'a dyn Observer,
    desk: &'a Desk,
    board: &'a Board,
    stage: &'a Stage,
    /// At the beginning.
    rows: usize,
    /// Those that training accumulates.
    signals: SignalSet,
    /// The last that was taken.
    step: Cell<u32>,
}

impl Live<'_> {
    /// Renders a picture that is waited for, or waits so long for one to be wanted.
    fn draw(&self, model: &mut dyn Backend, rows: Option<&RowHistory>, patience: Duration) {
        if let Some(ticket) = self.desk.next_within(patience) {
            let history = rows.map(|rows| (rows, self.step.get()));
            let known = Known { signals: self.signals, history, measured: None };
            let made = negative::expose_live(self.stage, model, known, &ticket.wanted);
            self.desk.expose(ticket, made);
        }
    }
}

impl Observer for Live<'_> {
    fn say(&self, line: fmt::Arguments<'_>) {
        self.observer.say(line);
    }

    fn begin(&self, done: u32, last: u32, budget: usize) {
        self.step.set(done);
        self.board.begin(done, last, budget, self.rows);
        self.observer.begin(done, last, budget);
    }

    fn step(&self, step: u32, loss: f32, rows: usize) {
        self.step.set(step);
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

    fn between(&self, model: &mut dyn Backend, rows: Option<&RowHistory>) -> Between {
        self.draw(model, rows, Duration::ZERO);
        loop {
            match self.board.next() {
                Next::Checkpoint => return Between::Checkpoint,
                Next::Step | Next::Stop => return Between::Step,
                // Without a page nobody can let it go on.
                Next::Wait if self.observer.interrupt().is_some() || self.desk.is_over() => {
                    return Between::Step;
                }
                Next::Wait => self.draw(model, rows, PULSE),
            }
        }
    }

    fn interrupt(&self) -> Option<Interrupt> {
        let stopped = || self.board.stops().then_some(STOPPED);
        self.observer.interrupt().or_else(stopped)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::board::Order;
    use crate::open::stage_of_one_view;
    use densify_core::gaussians::Gaussians;
    use densify_render::{Device, Setup};
    use densify_run::Silent;

    #[test]
    fn a_run_that_is_paused_goes_on_when_its_page_is_gone() {
        let (_folder, stage) = stage_of_one_view();
        let (desk, board) = (Desk::new(Some(1), 1), Board::default());
        board.begin(0, 10, 1, 1);
        board.order(Order::Pause);
        let (signals, step) = (SignalSet::default(), Cell::new(0));
        let live = Live {
            observer: &Silent,
            desk: &desk,
            board: &board,
            stage: &stage,
            rows: 1,
            signals,
            step,
        };
        let model = Gaussians::zeros(1, 0);
        let mut backend = Device::default().backend(&model, &Setup::new(1)).expect("a backend");
        thread::scope(|scope| {
            let waits = scope.spawn(|| {
                thread::sleep(5 * PULSE);
                let is_paused = matches!(board.next(), Next::Wait);
                desk.close();
                is_paused
            });
            assert_eq!(live.between(&mut *backend, None), Between::Step);
            assert!(desk.is_over() && waits.join().expect("it ends"), "it has not waited");
        });
    }
}
