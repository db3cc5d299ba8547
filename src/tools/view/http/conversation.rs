//! One connection: requests in, answers out, until it ends or takes too long.

use std::io::{self, Read};
use std::net::{Shutdown, TcpStream};
use std::time::{Duration, Instant};

use super::connections::Seat;
use super::head::{Head, parse};
use super::{Answer, Method, Request};

/// Longest time that a request may take to arrive, and an answer to be taken.
const PATIENCE: Duration = Duration::from_secs(10);
/// Longest wait for the next request.
const IDLE: Duration = Duration::from_mins(2);
/// Most bytes that are still read, and thrown away, of a request that was refused.
const MOST_DRAINED: usize = 64 << 10;

/// Answers what comes.
pub(super) fn converse(
    mut stream: &TcpStream,
    seat: &Seat<'_>,
    answer: &(dyn Fn(&Request) -> Answer + Sync),
) -> io::Result<()> {
    stream.set_nodelay(true)?;
    stream.set_write_timeout(Some(PATIENCE))?;
    let mut bytes = Vec::new();
    loop {
        seat.waits();
        match next(stream, seat, &mut bytes)? {
            Next::End => return Ok(()),
            Next::Refused(refusal) => {
                refusal.write(stream, true, true)?;
                return drain(stream);
            }
            Next::Request(request) => {
                let with_body = request.method != Method::Head;
                answer(&request).write(&mut stream, with_body, request.is_last)?;
                if request.is_last {
                    return Ok(());
                }
            }
        }
    }
}

enum Next {
    Request(Request),
    Refused(Answer),
    End,
}

/// The next request; `bytes` has what has arrived of it, and then of the one after it.
fn next(stream: &TcpStream, seat: &Seat<'_>, bytes: &mut Vec<u8>) -> io::Result<Next> {
    let mut deadline = None;
    loop {
        if !bytes.is_empty() {
            match parse(bytes) {
                Err(refusal) => return Ok(Next::Refused(refusal)),
                Ok(Some(head)) if bytes.len() >= head.length + head.body => {
                    let Head { mut request, length, body } = head;
                    seat.works();
                    request.body = bytes[length..length + body].to_vec();
                    bytes.drain(..length + body);
                    return Ok(Next::Request(request));
                }
                Ok(_) => {}
            }
        }
        let wait = if bytes.is_empty() {
            IDLE
        } else {
            let end = *deadline.get_or_insert_with(|| Instant::now() + PATIENCE);
            end.saturating_duration_since(Instant::now())
        };
        if wait.is_zero() {
            return Ok(Next::Refused(Answer::refusal(408, "the request took too long to arrive")));
        }
        stream.set_read_timeout(Some(wait))?;
        let mut piece = [0; 2048];
        match (&mut &*stream).read(&mut piece) {
            Ok(0) => return Ok(Next::End),
            Ok(count) => bytes.extend_from_slice(&piece[..count]),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error)
                if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) =>
            {
                if bytes.is_empty() {
                    return Ok(Next::End);
                }
            }
            Err(error) => return Err(error),
        }
    }
}

/// Reads on for a moment after a refusal: to close at once would take it from who is still sending.
fn drain(mut stream: &TcpStream) -> io::Result<()> {
    stream.shutdown(Shutdown::Write)?;
    stream.set_read_timeout(Some(Duration::from_millis(200)))?;
    let (mut piece, mut left) = ([0; 2048], MOST_DRAINED);
    while left > 0 {
        let count = stream.read(&mut piece)?;
        if count == 0 {
            break;
        }
        left = left.saturating_sub(count);
    }
    Ok(())
}
