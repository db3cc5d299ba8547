//! Wishes on their way to the one thread that has the models: of each owner only the newest is kept. That thread
//! renders; pictures are made of its renderings by who asked, and only so many at a time.

use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::asked::Wanted;
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

/// A rendering, with the turn of who makes a picture of it.
pub(super) type Handed = (Negative, Turn);

/// A wish, and where its rendering goes.
pub(super) struct Ticket {
    pub(super) wanted: Wanted,
    reply: SyncSender<Result<Handed, Unmade>>,
    turn: Turn,
}

impl Ticket {
    /// Hands over what has come of it.
    pub(super) fn reply(self, made: Result<Negative, Unmade>) {
        let Self { reply, turn, .. } = self;
        // Whoever asked may have gone.
        let _ = reply.send(made.map(|negative| (negative, turn)));
    }
}

/// A wish that is not waited for at the desk any more: while there are as many as may be, no other is begun.
#[derive(Debug)]
pub(super) struct Turn(Arc<Hall>);

impl Drop for Turn {
    fn drop(&mut self) {
        self.0.queue().begun -= 1;
        self.0.bell.notify_all();
    }
}

struct Waiting {
    wanted: Wanted,
    reply: SyncSender<Result<Handed, Unmade>>,
}

#[derive(Default)]
struct Queue {
    /// First come, first served. As many at most as there are connections.
    waiting: Vec<Waiting>,
    /// Wishes that are rendered, or made a picture of.
    begun: usize,
    is_over: bool,
}

#[derive(Default)]
struct Hall {
    queue: Mutex<Queue>,
    bell: Condvar,
}

impl std::fmt::Debug for Hall {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Hall")
    }
}

/// Where wishes wait.
pub(super) struct Desk {
    hall: Arc<Hall>,
    /// Most wishes that wait; as many as there are connections without.
    most: Option<usize>,
    /// Most wishes that are rendered, or made a picture of, at a time.
    at_once: usize,
}

impl Hall {
    fn queue(&self) -> MutexGuard<'_, Queue> {
        // Each change is whole before anything can fail.
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Desk {
    /// A desk at which no more wishes wait than `most`, and so many are begun at a time.
    pub(super) fn new(most: Option<usize>, at_once: usize) -> Self {
        Self { hall: Arc::default(), most, at_once }
    }

    /// Waits for the rendering.
    pub(super) fn ask(&self, wanted: Wanted) -> Result<Handed, Unmade> {
        let (reply, made) = sync_channel(1);
        let newest = Waiting { wanted, reply };
        {
            let mut queue = self.hall.queue();
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
                    // Whoever asked may have gone.
                    let _ = older.reply.send(Err(Unmade::Superseded));
                }
            }
        }
        self.hall.bell.notify_all();
        made.recv().unwrap_or(Err(Unmade::Over))
    }

    /// The next wish, if there is one and its turn has come.
    fn take(&self, queue: &mut Queue) -> Option<Ticket> {
        if queue.waiting.is_empty() || queue.begun >= self.at_once {
            return None;
        }
        let Waiting { wanted, reply } = queue.waiting.remove(0);
        queue.begun += 1;
        Some(Ticket { wanted, reply, turn: Turn(Arc::clone(&self.hall)) })
    }

    /// The next wish; `None` when no more are taken.
    pub(super) fn next(&self) -> Option<Ticket> {
        let mut queue = self.hall.queue();
        loop {
            if queue.is_over {
                return None;
            }
            if let Some(ticket) = self.take(&mut queue) {
                return Some(ticket);
            }
            queue = self.hall.bell.wait(queue).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// The next wish, if its turn has come or comes within this time.
    pub(super) fn next_within(&self, patience: Duration) -> Option<Ticket> {
        let mut queue = self.hall.queue();
        if let Some(ticket) = self.take(&mut queue) {
            return Some(ticket);
        }
        if queue.is_over || patience.is_zero() {
            return None;
        }
        let waited = self.hall.bell.wait_timeout(queue, patience);
        self.take(&mut waited.unwrap_or_else(PoisonError::into_inner).0)
    }

    /// Whether nothing is made any more.
    pub(super) fn is_over(&self) -> bool {
        self.hall.queue().is_over
    }

    /// Takes no more wishes; those that wait are told.
    pub(super) fn close(&self) {
        let waiting = {
            let mut queue = self.hall.queue();
            queue.is_over = true;
            std::mem::take(&mut queue.waiting)
        };
        for Waiting { reply, .. } in waiting {
            let _ = reply.send(Err(Unmade::Over));
        }
        self.hall.bell.notify_all();
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
        let desk = Desk::new(Some(1), 1);
        assert!(desk.next_within(Duration::ZERO).is_none());
        thread::scope(|scope| {
            let first = scope.spawn(|| desk.ask(wish("a", 0)));
            while desk.hall.queue().waiting.is_empty() {
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
    fn no_more_are_begun_than_may_be_until_a_picture_is_made() {
        let desk = Desk::new(None, 1);
        thread::scope(|scope| {
            let [one, two] = ["a", "b"].map(|page| scope.spawn({
                let desk = &desk;
                move || desk.ask(wish(page, 0)).map(|(negative, turn)| (negative.milliseconds, turn))
            }));
            while desk.hall.queue().waiting.len() < 2 {
                thread::yield_now();
            }
            let ticket = desk.next_within(Duration::ZERO).unwrap();
            assert!(desk.next_within(Duration::ZERO).is_none(), "two at once");
            let is_first = ticket.wanted == wish("a", 0);
            ticket.reply(Ok(Negative { milliseconds: 3.0, ..Negative::default() }));
            let (first, second) = if is_first { (one, two) } else { (two, one) };
            let (milliseconds, turn) = first.join().unwrap().unwrap();
            assert!((milliseconds - 3.0).abs() < 1e-9);
            // The rendering is not a picture yet.
            assert!(desk.next_within(Duration::ZERO).is_none());
            drop(turn);
            desk.next().unwrap().reply(Err(Unmade::Failed("made".into())));
            assert!(second.join().unwrap().is_err());
            assert_eq!(desk.hall.queue().begun, 0, "who fails has no turn");
        });
    }

    #[test]
    fn only_the_newest_wish_of_an_owner_is_kept_and_nobody_is_passed_over() {
        let desk = Desk::new(None, 1);
        let waiting = |count: usize| {
            while desk.hall.queue().waiting.len() < count {
                thread::yield_now();
            }
        };
        let newest_is = |number: usize| {
            while desk.hall.queue().waiting[0].wanted != wish("a", number) {
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
