//! Accepts connections, gives each a permit, and closes idle ones when there are too many.

use std::collections::BTreeMap;
use std::io;
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use super::connection::serve_connection;
use super::{Request, Response};

/// Maximum number of connections at a time; a browser opens six per page.
pub(crate) const MAX_CONNECTIONS: usize = 64;
/// Stack of a connection's thread `[bytes]`.
const STACK: usize = 256 << 10;
/// Interval between checks of the stop condition, and pause after a failed accept.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// Answers requests until `is_over` returns true.
///
/// # Errors
/// If the listening socket fails.
pub(crate) fn serve(
    listener: &TcpListener,
    respond: &(dyn Fn(&Request) -> Response + Sync),
    is_over: &dyn Fn() -> bool,
) -> io::Result<()> {
    let address = listener.local_addr()?;
    let (pool, stops) = (ConnectionPool::default(), AtomicBool::new(false));
    thread::scope(|scope| {
        let acceptor = scope.spawn(|| accept(listener, &pool, &stops, respond));
        while !is_over() && !acceptor.is_finished() {
            thread::sleep(POLL_INTERVAL);
        }
        stops.store(true, Ordering::SeqCst);
        // `accept` blocks until a connection arrives, so make one.
        let _ = TcpStream::connect_timeout(&reachable(address), Duration::from_secs(1));
        pool.close();
        acceptor.join().unwrap_or_else(|_| Err(io::Error::other("the server has failed")))
    })
}

/// An address at which this machine can reach its own listener.
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
    pool: &ConnectionPool,
    stops: &AtomicBool,
    respond: &(dyn Fn(&Request) -> Response + Sync),
) -> io::Result<()> {
    thread::scope(|scope| {
        loop {
            let stream = listener.accept();
            if stops.load(Ordering::SeqCst) {
                pool.close();
                return Ok(());
            }
            let stream = match stream {
                Ok((stream, _)) => Arc::new(stream),
                // The client has left already, or the process is out of file descriptors, which may be temporary.
                Err(error) => {
                    tracing::debug!("a connection could not be accepted: {error}");
                    thread::sleep(POLL_INTERVAL);
                    continue;
                }
            };
            let Some(permit) = pool.admit(&stream) else {
                let full = Response::error(503, "too many requests at a time; try again");
                let _ = stream.set_nonblocking(true);
                let _ = full.write(&*stream, true, true);
                continue;
            };
            let thread = thread::Builder::new().stack_size(STACK);
            // If no thread can be started, the closure is dropped, which closes the connection and frees its permit.
            let _ = thread.spawn_scoped(scope, move || {
                let _ = serve_connection(&stream, &permit, respond);
            });
        }
    })
}

/// An open connection.
#[derive(Debug)]
struct Connection {
    stream: Arc<TcpStream>,
    /// True once a request has arrived.
    has_requested: bool,
    /// Start of the wait for a request; `None` while a request is answered.
    idle_since: Option<Instant>,
}

#[derive(Debug, Default)]
struct Connections {
    /// The open connections by their numbers, which are given in order of arrival.
    open: BTreeMap<u64, Connection>,
    next: u64,
}

/// The open connections, at most [`MAX_CONNECTIONS`].
#[derive(Debug, Default)]
struct ConnectionPool(Mutex<Connections>);

impl ConnectionPool {
    fn connections(&self) -> MutexGuard<'_, Connections> {
        // A panicking holder cannot leave a change half done, so a poisoned lock is still valid.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Admits a connection. If all permits are taken, the longest idle connection is closed, preferably one that never
    /// sent a request; `None` if every connection is being answered.
    fn admit(&self, stream: &Arc<TcpStream>) -> Option<Permit<'_>> {
        let mut connections = self.connections();
        if connections.open.len() >= MAX_CONNECTIONS {
            let waiting = connections.open.iter().filter_map(|(&number, connection)| {
                connection.idle_since.map(|since| (connection.has_requested, since, number))
            });
            let (.., longest) = waiting.min()?;
            if let Some(connection) = connections.open.remove(&longest) {
                let _ = connection.stream.shutdown(Shutdown::Both);
            }
        }
        let number = connections.next;
        connections.next += 1;
        let stream = Arc::clone(stream);
        let connection =
            Connection { stream, has_requested: false, idle_since: Some(Instant::now()) };
        connections.open.insert(number, connection);
        Some(Permit { pool: self, number })
    }

    /// Closes all connections.
    fn close(&self) {
        for connection in self.connections().open.values() {
            let _ = connection.stream.shutdown(Shutdown::Both);
        }
    }
}

/// The permit of one connection, released when dropped.
#[derive(Debug)]
pub(super) struct Permit<'a> {
    pool: &'a ConnectionPool,
    number: u64,
}

impl Permit<'_> {
    /// The connection waits for a request.
    pub(super) fn mark_idle(&self) {
        if let Some(connection) = self.pool.connections().open.get_mut(&self.number) {
            connection.idle_since = Some(Instant::now());
        }
    }

    /// The connection has a request to answer.
    pub(super) fn mark_busy(&self) {
        if let Some(connection) = self.pool.connections().open.get_mut(&self.number) {
            connection.idle_since = None;
            connection.has_requested = true;
        }
    }
}

impl Drop for Permit<'_> {
    fn drop(&mut self) {
        self.pool.connections().open.remove(&self.number);
    }
}
