//! `densify view`: a page in the browser whose pictures are rendered here, by the backend that trains.
//!
//! One thread has the models, of a run in training ([`live`]) the one that trains. Connections bring wishes to its
//! [`desk`], which keeps the newest of each page; that thread renders them ([`negative`]), and another makes pictures
//! of what is rendered ([`darkroom`]). Everything that a browser sends is checked before ([`door`], [`asked`]); no path
//! of the disk is served. Prints nothing.

mod asked;
mod board;
mod darkroom;
mod describe;
mod desk;
mod door;
mod http;
mod kinds;
mod live;
mod measured;
mod negative;
pub mod open;
mod paint;
mod ramp;
mod routes;
mod stage;

use std::thread;

use desk::{Closing, Desk};
use door::Door;
pub use door::{FIRST_PORT, Place};
pub use live::COMPANION;
use negative::Brush;
pub use open::{Looked, is_run, open};
use routes::Routes;
pub(crate) use stage::Exhibition;

use densify_run::failure::{Failure, OTHER};

/// Pictures in the making at a time: while one is encoded, the next is rendered.
const AT_ONCE: usize = 2;

/// A page that can be opened.
pub struct Server {
    door: Door,
}

impl Server {
    /// Takes the port.
    ///
    /// # Errors
    /// When it is another program's, or the address is not this machine's.
    pub fn open(place: Place) -> Result<Self, Failure> {
        Ok(Self { door: Door::open(place)? })
    }

    /// What to type into a browser on this machine.
    pub fn url(&self) -> String {
        self.door.url()
    }

    /// Whether other machines reach the page.
    pub fn is_public(&self) -> bool {
        self.door.is_public()
    }

    /// Serves the page until `is_over`.
    ///
    /// # Errors
    /// When the network fails, or what renders.
    pub fn serve(&self, exhibition: Exhibition, is_over: &dyn Fn() -> bool) -> Result<(), Failure> {
        let Exhibition { mut stage, mut backends } = exhibition;
        let desk = Desk::new(None, AT_ONCE);
        let routes = Routes {
            door: &self.door,
            desk: &desk,
            extent: stage.extent(),
            description: describe::describe(&mut stage),
            board: None,
        };
        let failed = |message: String| Failure::new(OTHER, message);
        thread::scope(|scope| {
            let (desk, stage) = (&desk, &stage);
            let develops = darkroom::open(scope, desk, stage)
                .map_err(|error| failed(format!("the system gives no thread: {error}")))?;
            let renders = scope.spawn(move || {
                let _closing = Closing(desk);
                let mut brushes: Vec<Brush> = backends.iter().map(|_| Brush::default()).collect();
                while let Some(ticket) = desk.next() {
                    let (wanted, model) = (&ticket.wanted, ticket.wanted.model);
                    let made =
                        negative::expose(stage, &mut *backends[model], &mut brushes[model], wanted);
                    desk.expose(ticket, made);
                }
            });
            let answer = |request: &http::Request| routes.answer(request);
            let is_over = || is_over() || renders.is_finished();
            // Wishes that wait are told that it is over, or their connections would not end.
            let ends = || {
                let ends = is_over();
                if ends {
                    desk.close();
                }
                ends
            };
            let served = http::serve(&self.door.listener, &answer, &ends);
            desk.close();
            let rendered = renders.join().and(develops.join());
            served
                .map_err(|error| failed(format!("the page cannot be served any more: {error}")))?;
            rendered.map_err(|_| failed("what makes the pictures has failed; this is a bug".into()))
        })
    }
}
