//! The connections that there are: who has a seat, and who makes room.

use std::collections::BTreeMap;
use std::io;
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use super::conversation::converse;
use super::{Answer, Request};

/// Connections at a time: a browser opens six to a page.
pub(crate) const SEATS: usize = 64;
/// Bytes of the stack of a connection's thread.
const STACK: usize = 256 << 10;
/// How often it is asked whether to end.
const PULSE: Duration = Duration::from_millis(50);

/// Answers requests until `is_over`.
///
/// # Errors
/// When no connection can be accepted any more.
pub(crate) fn serve(
    listener: &TcpListener,
    answer: &(dyn Fn(&Request) -> Answer + Sync),
    is_over: &dyn Fn() -> bool,
) -> io::Result<()> {
    let address = listener.local_addr()?;
    let (room, ends) = (Room::default(), AtomicBool::new(false));
    thread::scope(|scope| {
        let door = scope.spawn(|| accept(listener, &room, &ends, answer));
        while !is_over() && !door.is_finished() {
            thread::sleep(PULSE);
        }
        ends.store(true, Ordering::SeqCst);
        // Whoever waits at the door is woken by a guest.
        let _ = TcpStream::connect_timeout(&reachable(address), Duration::from_secs(1));
        room.close();
        door.join().unwrap_or_else(|_| Err(io::Error::other("the server has failed")))
    })
}

/// Where a listener can be reached from here.
fn reachable(mut address: SocketAddr) -> SocketAddr {
    if address.ip().is_unspecified() {
        address.set_ip(match address {
            SocketAddr::V4(_) => std::net::Ipv4Addr::LOCALHOST.into(),
            SocketAddr::V6(_) => std::net::Ipv6Addr::LOCALHOST.into(),
        });
    }
    address
}

fn accept(
    listener: &TcpListener,
    room: &Room,
    ends: &AtomicBool,
    answer: &(dyn Fn(&Request) -> Answer + Sync),
) -> io::Result<()> {
    thread::scope(|scope| {
        loop {
            let stream = listener.accept();
            if ends.load(Ordering::SeqCst) {
                room.close();
                return Ok(());
            }
            let stream = match stream {
                Ok((stream, _)) => Arc::new(stream),
                // A guest that has gone again, or no file left for one more: the next may do better.
                Err(error) => {
                    tracing::debug!("a connection could not be accepted: {error}");
                    thread::sleep(PULSE);
                    continue;
                }
            };
            let Some(seat) = room.take(&stream) else {
                let full = Answer::refusal(503, "too many requests at a time; try again");
                let _ = stream.set_nonblocking(true);
                let _ = full.write(&*stream, true, true);
                continue;
            };
            let guest = thread::Builder::new().stack_size(STACK);
            // Where no thread can be had, the seat is free again and the connection closed.
            let _ = guest.spawn_scoped(scope, move || {
                let _ = converse(&stream, &seat, answer);
            });
        }
    })
}

/// A connection that has a seat.
#[derive(Debug)]
struct Guest {
    stream: Arc<TcpStream>,
    /// Whether it has ever asked for anything.
    has_asked: bool,
    /// Since when nothing has been asked for; `None` while there is an answer to be given.
    waits_since: Option<Instant>,
}

#[derive(Debug, Default)]
struct Guests {
    /// By the order in which they came.
    seated: BTreeMap<u64, Guest>,
    next: u64,
}

/// All seats.
#[derive(Debug, Default)]
struct Room(Mutex<Guests>);

impl Room {
    fn guests(&self) -> MutexGuard<'_, Guests> {
        // Each change is whole before anything can fail.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A seat for a connection. Where there is none, the one that has waited longest is closed, of
    /// those that never asked for anything first; `None` where all are being answered.
    fn take(&self, stream: &Arc<TcpStream>) -> Option<Seat<'_>> {
        let mut guests = self.guests();
        if guests.seated.len() >= SEATS {
            let waiting = guests.seated.iter().filter_map(|(&number, guest)| {
                guest.waits_since.map(|since| (guest.has_asked, since, number))
            });
            let (.., longest) = waiting.min()?;
            if let Some(guest) = guests.seated.remove(&longest) {
                let _ = guest.stream.shutdown(Shutdown::Both);
            }
        }
        let number = guests.next;
        guests.next += 1;
        let stream = Arc::clone(stream);
        let guest = Guest { stream, has_asked: false, waits_since: Some(Instant::now()) };
        guests.seated.insert(number, guest);
        Some(Seat { room: self, number })
    }

    /// Closes all connections.
    fn close(&self) {
        for guest in self.guests().seated.values() {
            let _ = guest.stream.shutdown(Shutdown::Both);
        }
    }
}

/// The seat of one connection, free again when dropped.
#[derive(Debug)]
pub(super) struct Seat<'a> {
    room: &'a Room,
    number: u64,
}

impl Seat<'_> {
    /// There is nothing to answer.
    pub(super) fn waits(&self) {
        if let Some(guest) = self.room.guests().seated.get_mut(&self.number) {
            guest.waits_since = Some(Instant::now());
        }
    }

    /// A request is being answered.
    pub(super) fn works(&self) {
        if let Some(guest) = self.room.guests().seated.get_mut(&self.number) {
            guest.waits_since = None;
            guest.has_asked = true;
        }
    }
}

impl Drop for Seat<'_> {
    fn drop(&mut self) {
        self.room.guests().seated.remove(&self.number);
    }
}
