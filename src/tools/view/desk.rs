//! Wishes on their way to the one thread that has the models: of each owner only the newest is kept. That thread
//! renders, another makes the pictures, and only so many are in the making at a time.

use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use super::asked::Wanted;
use super::darkroom::Frame;
use super::negative::Negative;

/// Why there is no picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Unmade {
    /// The same owner has wished for another one meanwhile.
    Superseded,
    /// It could not be made, for this reason.
    Failed(String),
    /// Too many others wait.
    Crowded,
    /// Nothing is made any more.
    Over,
}

/// A wish, and where its picture goes.
#[derive(Debug)]
pub(super) struct Ticket {
    pub(super) wanted: Wanted,
    reply: SyncSender<Result<Frame, Unmade>>,
}

impl Ticket {
    fn reply(self, made: Result<Frame, Unmade>) {
        // Whoever asked may have gone.
        let _ = self.reply.send(made);
    }
}

#[derive(Debug, Default)]
struct Queue {
    /// First come, first served. As many at most as there are connections.
    waiting: Vec<Ticket>,
    /// Those that are rendered, but are no pictures yet.
    exposed: Vec<(Ticket, Negative)>,
    /// Wishes that were taken, and not answered yet.
    begun: usize,
    is_over: bool,
}

/// Where wishes wait.
#[derive(Debug)]
pub(super) struct Desk {
    queue: Mutex<Queue>,
    bell: Condvar,
    /// Most wishes that wait; as many as there are connections without.
    most: Option<usize>,
    /// Most wishes that are taken and not answered yet.
    at_once: usize,
}

impl Desk {
    /// A desk at which no more wishes wait than `most`, and so many are in the making at a time.
    pub(super) fn new(most: Option<usize>, at_once: usize) -> Self {
        Self { queue: Mutex::default(), bell: Condvar::new(), most, at_once }
    }

    fn queue(&self) -> MutexGuard<'_, Queue> {
        // Each change is whole before anything can fail.
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&self, queue: MutexGuard<'a, Queue>) -> MutexGuard<'a, Queue> {
        self.bell.wait(queue).unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for the picture.
    pub(super) fn ask(&self, wanted: Wanted) -> Result<Frame, Unmade> {
        let (reply, made) = sync_channel(1);
        let newest = Ticket { wanted, reply };
        {
            let mut queue = self.queue();
            if queue.is_over {
                return Err(Unmade::Over);
            }
            let owner = &newest.wanted.owner;
            // The newer wish has the place of the older one, so that who moves does not wait for ever.
            match queue.waiting.iter().position(|older| older.wanted.owner == *owner) {
                None if self.most.is_some_and(|most| queue.waiting.len() >= most) => {
                    return Err(Unmade::Crowded);
                }
                None => queue.waiting.push(newest),
                Some(place) => {
                    let older = std::mem::replace(&mut queue.waiting[place], newest);
                    older.reply(Err(Unmade::Superseded));
                }
            }
        }
        self.bell.notify_all();
        made.recv().unwrap_or(Err(Unmade::Over))
    }

    /// The next wish, if there is one and its turn has come.
    fn take(&self, queue: &mut Queue) -> Option<Ticket> {
        if queue.waiting.is_empty() || queue.begun >= self.at_once {
            return None;
        }
        queue.begun += 1;
        Some(queue.waiting.remove(0))
    }

    /// The next wish to render; `None` when no more are taken.
    pub(super) fn next(&self) -> Option<Ticket> {
        let mut queue = self.queue();
        loop {
            if queue.is_over {
                return None;
            }
            if let Some(ticket) = self.take(&mut queue) {
                return Some(ticket);
            }
            queue = self.wait(queue);
        }
    }

    /// The next wish to render, if its turn has come or comes within this time.
    pub(super) fn next_within(&self, patience: Duration) -> Option<Ticket> {
        let mut queue = self.queue();
        if let Some(ticket) = self.take(&mut queue) {
            return Some(ticket);
        }
        if queue.is_over || patience.is_zero() {
            return None;
        }
        let waited = self.bell.wait_timeout(queue, patience);
        self.take(&mut waited.unwrap_or_else(PoisonError::into_inner).0)
    }

    /// Hands over what has come of rendering it, so that a picture is made of it.
    pub(super) fn expose(&self, ticket: Ticket, made: Result<Negative, Unmade>) {
        match made {
            Err(why) => self.answer(ticket, Err(why)),
            Ok(negative) => {
                let mut queue = self.queue();
                // Once it is over nobody makes pictures.
                if !queue.is_over {
                    queue.exposed.push((ticket, negative));
                }
                drop(queue);
                self.bell.notify_all();
            }
        }
    }

    /// The next rendering to make a picture of; `None` when no more are made.
    pub(super) fn next_exposed(&self) -> Option<(Ticket, Negative)> {
        let mut queue = self.queue();
        loop {
            if queue.is_over {
                return None;
            }
            if !queue.exposed.is_empty() {
                return Some(queue.exposed.remove(0));
            }
            queue = self.wait(queue);
        }
    }

    /// Answers a wish that was taken.
    pub(super) fn answer(&self, ticket: Ticket, made: Result<Frame, Unmade>) {
        ticket.reply(made);
        self.queue().begun -= 1;
        self.bell.notify_all();
    }

    /// Whether nothing is made any more.
    pub(super) fn is_over(&self) -> bool {
        self.queue().is_over
    }

    /// Takes no more wishes; those that wait are told.
    pub(super) fn close(&self) {
        let (waiting, exposed) = {
            let mut queue = self.queue();
            queue.is_over = true;
            (std::mem::take(&mut queue.waiting), std::mem::take(&mut queue.exposed))
        };
        for ticket in waiting.into_iter().chain(exposed.into_iter().map(|(ticket, _)| ticket)) {
            ticket.reply(Err(Unmade::Over));
        }
        self.bell.notify_all();
    }
}

/// Closes a desk when dropped: by a thread that fails, too.
pub(super) struct Closing<'a>(pub(super) &'a Desk);

impl Drop for Closing<'_> {
    fn drop(&mut self) {
        if thread::panicking() {
            tracing::error!("no pictures are made for the page any more; this is a bug");
        }
        self.0.close();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::asked::Viewpoint;
    use crate::kinds::Kind;
    use densify_train::evaluate::Split;

    fn wish(page: &str, number: usize) -> Wanted {
        Wanted {
            owner: (page.to_owned(), 0),
            kind: Kind::Render,
            model: 0,
            size: (8, 8),
            is_moving: true,
            from: Viewpoint::View(Split::Test, number),
        }
    }

    #[test]
    fn a_bounded_desk_turns_away_who_would_wait_too_long() {
        let desk = Desk::new(Some(1), 1);
        assert!(desk.next_within(Duration::ZERO).is_none());
        thread::scope(|scope| {
            let first = scope.spawn(|| desk.ask(wish("a", 0)));
            while desk.queue().waiting.is_empty() {
                thread::yield_now();
            }
            assert_eq!(desk.ask(wish("b", 0)).unwrap_err(), Unmade::Crowded);
            // A newer wish of who waits has its place.
            let second = scope.spawn(|| desk.ask(wish("a", 1)));
            assert_eq!(first.join().unwrap().unwrap_err(), Unmade::Superseded);
            let ticket = desk.next_within(Duration::ZERO).unwrap();
            desk.expose(ticket, Err(Unmade::Failed("made".into())));
            assert_eq!(second.join().unwrap().unwrap_err(), Unmade::Failed("made".into()));
            assert!(!desk.is_over());
            desk.close();
            assert!(desk.is_over() && desk.next_within(Duration::from_secs(60)).is_none());
        });
    }

    #[test]
    fn no_more_are_begun_than_may_be_until_a_picture_is_made() {
        let desk = Desk::new(None, 1);
        let frame = Frame {
            jpeg: vec![3],
            size: (1, 1),
            range: None,
            mean: None,
            distance: None,
            measured: None,
            milliseconds: 0.0,
        };
        thread::scope(|scope| {
            let asked = ["a", "b"].map(|page| {
                let desk = &desk;
                scope.spawn(move || desk.ask(wish(page, 0)).map(|frame| frame.jpeg))
            });
            while desk.queue().waiting.len() < 2 {
                thread::yield_now();
            }
            let ticket = desk.next_within(Duration::ZERO).unwrap();
            assert!(desk.next_within(Duration::ZERO).is_none(), "two at once");
            let (first, second) = match (&*ticket.wanted.owner.0, asked) {
                ("a", [first, second]) | (_, [second, first]) => (first, second),
            };
            desk.expose(ticket, Ok(Negative::default()));
            // The rendering is no picture yet.
            assert!(desk.next_within(Duration::ZERO).is_none());
            let (ticket, _) = desk.next_exposed().unwrap();
            desk.answer(ticket, Ok(frame));
            assert_eq!(first.join().unwrap().unwrap(), [3]);
            let ticket = desk.next().unwrap();
            desk.expose(ticket, Err(Unmade::Failed("made".into())));
            assert!(second.join().unwrap().is_err());
            // Who waits for a picture of a rendering is told of the end, too.
            let last = scope.spawn(|| desk.ask(wish("c", 0)).unwrap_err());
            let ticket = desk.next().expect("who fails has no turn any more");
            desk.expose(ticket, Ok(Negative::default()));
            desk.close();
            assert_eq!(last.join().unwrap(), Unmade::Over);
            assert!(desk.next_exposed().is_none());
        });
    }

    #[test]
    fn only_the_newest_wish_of_an_owner_is_kept_and_nobody_is_passed_over() {
        let desk = Desk::new(None, 1);
        let waiting = |count: usize| {
            while desk.queue().waiting.len() < count {
                thread::yield_now();
            }
        };
        let newest_is = |number: usize| {
            while desk.queue().waiting[0].wanted != wish("a", number) {
                thread::yield_now();
            }
        };
        thread::scope(|scope| {
            let ask = |page, number| {
                scope.spawn({
                    let desk = &desk;
                    move || desk.ask(wish(page, number))
                })
            };
            let first = ask("a", 0);
            waiting(1);
            let other = ask("b", 9);
            waiting(2);
            let second = ask("a", 1);
            newest_is(1);
            let third = ask("a", 2);
            newest_is(2);
            assert_eq!(first.join().unwrap().unwrap_err(), Unmade::Superseded);
            assert_eq!(second.join().unwrap().unwrap_err(), Unmade::Superseded);
            for (expected, asked) in [(wish("a", 2), third), (wish("b", 9), other)] {
                let ticket = desk.next().unwrap();
                assert_eq!(ticket.wanted, expected);
                desk.expose(ticket, Err(Unmade::Failed("made".into())));
                assert_eq!(asked.join().unwrap().unwrap_err(), Unmade::Failed("made".into()));
            }
            let left = ask("c", 0);
            waiting(1);
            drop(Closing(&desk));
            assert_eq!(left.join().unwrap().unwrap_err(), Unmade::Over);
        });
        assert!(desk.next().is_none());
        assert_eq!(desk.ask(wish("a", 0)).unwrap_err(), Unmade::Over);
    }
}
