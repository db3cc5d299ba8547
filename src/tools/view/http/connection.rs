//! One connection: reads requests and writes responses until the client closes it or a time limit passes.

use std::io::{self, Read};
use std::net::{Shutdown, TcpStream};
use std::time::{Duration, Instant};

use super::request::{Head, parse};
use super::server::Permit;
use super::{Method, Request, Response};

/// Time limit for a request to arrive completely, and for a response to be received.
const TIMEOUT: Duration = Duration::from_secs(10);
/// Time limit for the next request to begin.
const IDLE: Duration = Duration::from_mins(2);
/// Maximum number of bytes of a refused request that are read and discarded.
const MAX_DRAINED: usize = 64 << 10;

/// Answers the requests of a connection.
pub(super) fn serve_connection(
    mut stream: &TcpStream,
    permit: &Permit<'_>,
    respond: &(dyn Fn(&Request) -> Response + Sync),
) -> io::Result<()> {
    stream.set_nodelay(true)?;
    stream.set_write_timeout(Some(TIMEOUT))?;
    let mut bytes = Vec::new();
    loop {
        permit.mark_idle();
        match read_request(stream, permit, &mut bytes)? {
            Next::End => return Ok(()),
            Next::Refused(response) => {
                response.write(stream, true, true)?;
                return drain(stream);
            }
            Next::Request(request) => {
                let with_body = request.method != Method::Head;
                respond(&request).write(&mut stream, with_body, request.closes)?;
                if request.closes {
                    return Ok(());
                }
            }
        }
    }
}

/// The next request of a connection, or the reason why there is none.
enum Next {
    Request(Request),
    Refused(Response),
    End,
}

/// Reads the next request. `bytes` holds the bytes that have arrived but belong to no complete request yet.
fn read_request(stream: &TcpStream, permit: &Permit<'_>, bytes: &mut Vec<u8>) -> io::Result<Next> {
    let mut deadline = None;
    loop {
        if !bytes.is_empty() {
            match parse(bytes) {
                Err(response) => return Ok(Next::Refused(response)),
                Ok(Some(head)) if bytes.len() >= head.length + head.body => {
                    let Head { mut request, length, body } = head;
                    permit.mark_busy();
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
            let end = *deadline.get_or_insert_with(|| Instant::now() + TIMEOUT);
            end.saturating_duration_since(Instant::now())
        };
        if wait.is_zero() {
            return Ok(Next::Refused(Response::error(408, "the request took too long to arrive")));
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

/// Keeps reading briefly after a refusal: closing at once would discard the response if the client is still sending.
fn drain(mut stream: &TcpStream) -> io::Result<()> {
    stream.shutdown(Shutdown::Write)?;
    stream.set_read_timeout(Some(Duration::from_millis(200)))?;
    let (mut piece, mut left) = ([0; 2048], MAX_DRAINED);
    while left > 0 {
        let count = stream.read(&mut piece)?;
        if count == 0 {
            break;
        }
        left = left.saturating_sub(count);
    }
    Ok(())
}
