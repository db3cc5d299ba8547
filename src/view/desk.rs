//! Wishes on their way to the one thread that has the models: of each owner only the newest is kept.

use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::asked::Wanted;
use super::pictures::Frame;

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
pub(super) struct Ticket {
    pub(super) wanted: Wanted,
    reply: SyncSender<Result<Frame, Unmade>>,
}

impl Ticket {
    /// Hands over what has come of it.
    pub(super) fn reply(self, made: Result<Frame, Unmade>) {
        // Whoever asked may have gone.
        let _ = self.reply.send(made);
    }
}

#[derive(Default)]
struct Queue {
    /// First come, first served. As many at most as there are connections.
    waiting: Vec<Ticket>,
    is_over: bool,
}

/// Where wishes wait.
#[derive(Default)]
pub(super) struct Desk {
    queue: Mutex<Queue>,
    bell: Condvar,
    /// Most wishes that wait; as many as there are connections without.
    most: Option<usize>,
}

impl Desk {
    /// A desk at which no more wishes wait than this.
    pub(super) fn bounded(most: usize) -> Self {
        Self { most: Some(most), ..Self::default() }
    }

    fn queue(&self) -> MutexGuard<'_, Queue> {
        // Each change is whole before anything can fail.
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits for the picture.
    pub(super) fn ask(&self, wanted: Wanted) -> Result<Frame, Unmade> {
        let (reply, made) = sync_channel(1);
        let ticket = Ticket { wanted, reply };
        {
            let mut queue = self.queue();
            if queue.is_over {
                return Err(Unmade::Over);
            }
            let owner = &ticket.wanted.owner;
            // The newer wish has the place of the older one, so that who moves does not wait for ever.
            match queue.waiting.iter().position(|older| older.wanted.owner == *owner) {
                None if self.most.is_some_and(|most| queue.waiting.len() >= most) => {
                    return Err(Unmade::Crowded);
                }
                None => queue.waiting.push(ticket),
                Some(place) => {
                    let older = std::mem::replace(&mut queue.waiting[place], ticket);
                    older.reply(Err(Unmade::Superseded));
                }
            }
        }
        self.bell.notify_one();
        made.recv().unwrap_or(Err(Unmade::Over))
    }

    /// The next wish; `None` when no more are taken.
    pub(super) fn next(&self) -> Option<Ticket> {
        let mut queue = self.queue();
        loop {
            if queue.is_over {
                return None;
            }
            if !queue.waiting.is_empty() {
                return Some(queue.waiting.remove(0));
            }
            queue = self.bell.wait(queue).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// The next wish, if one is there or comes within this time.
    pub(super) fn next_within(&self, patience: Duration) -> Option<Ticket> {
        let mut queue = self.queue();
        if queue.waiting.is_empty() && !queue.is_over && !patience.is_zero() {
            let waited = self.bell.wait_timeout(queue, patience);
            queue = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
        if queue.waiting.is_empty() { None } else { Some(queue.waiting.remove(0)) }
    }

    /// Whether nothing is made any more.
    pub(super) fn is_over(&self) -> bool {
        self.queue().is_over
    }

    /// Takes no more wishes; those that wait are told.
    pub(super) fn close(&self) {
        let waiting = {
            let mut queue = self.queue();
            queue.is_over = true;
            std::mem::take(&mut queue.waiting)
        };
        waiting.into_iter().for_each(|ticket| ticket.reply(Err(Unmade::Over)));
        self.bell.notify_all();
    }
}

/// Closes a desk when dropped: by a thread that fails, too.
pub(super) struct Closing<'a>(pub(super) &'a Desk);

impl Drop for Closing<'_> {
    fn drop(&mut self) {
        self.0.close();
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use super::*;
    use crate::evaluate::Split;
    use crate::view::asked::Viewpoint;
    use crate::view::kinds::Kind;

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
        let desk = Desk::bounded(1);
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
            ticket.reply(Err(Unmade::Failed("made".into())));
            assert_eq!(second.join().unwrap().unwrap_err(), Unmade::Failed("made".into()));
            assert!(!desk.is_over());
            desk.close();
            assert!(desk.is_over() && desk.next_within(Duration::from_secs(60)).is_none());
        });
    }

    #[test]
    fn only_the_newest_wish_of_an_owner_is_kept_and_nobody_is_passed_over() {
        let desk = Desk::default();
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
                ticket.reply(Err(Unmade::Failed("made".into())));
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
