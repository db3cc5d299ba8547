//! Tests of the HTTP server over real connections, and of its parser.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::request::{MAX_HEAD, parse};
use super::server::MAX_CONNECTIONS;
use super::*;

const GET: &str = "GET /a HTTP/1.1\r\nHost: localhost\r\n\r\n";

/// Runs a server that echoes path and body, while `test` connects to it.
fn with_server(test: impl FnOnce(&dyn Fn() -> TcpStream)) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let over = AtomicBool::new(false);
    let respond = |request: &Request| {
        let text = format!("{} {}", request.path, String::from_utf8_lossy(&request.body));
        Response::ok("text/plain", text.into_bytes())
    };
    std::thread::scope(|scope| {
        let served = scope.spawn(|| serve(&listener, &respond, &|| over.load(Ordering::SeqCst)));
        let connect = || {
            let stream = TcpStream::connect(address).unwrap();
            stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
            stream
        };
        /// Stops the server even if the test panics; the scope would wait for ever otherwise.
        struct StopOnDrop<'a>(&'a AtomicBool);
        impl Drop for StopOnDrop<'_> {
            fn drop(&mut self) {
                self.0.store(true, Ordering::SeqCst);
            }
        }
        let stop = StopOnDrop(&over);
        test(&connect);
        drop(stop);
        served.join().unwrap().unwrap();
    });
}

/// Reads until the connection is closed.
fn read_all(mut stream: &TcpStream) -> String {
    let mut bytes = Vec::new();
    let _ = stream.read_to_end(&mut bytes);
    String::from_utf8_lossy(&bytes).into_owned()
}

/// Reads one response with a body of this length; the connection stays open.
fn read_one(mut stream: &TcpStream, body: usize) -> String {
    let mut bytes = Vec::new();
    while !bytes.ends_with(b"\r\n\r\n") {
        let mut byte = [0];
        stream.read_exact(&mut byte).unwrap();
        bytes.push(byte[0]);
    }
    let mut rest = vec![0; body];
    stream.read_exact(&mut rest).unwrap();
    bytes.extend(rest);
    String::from_utf8(bytes).unwrap()
}

/// Requests `/a` and expects status 200.
fn get(stream: &mut TcpStream) {
    stream.write_all(GET.as_bytes()).unwrap();
    assert!(read_one(stream, 3).contains(" 200 "));
}

#[test]
fn a_connection_answers_one_request_after_another() {
    with_server(|connect| {
        let mut stream = connect();
        // Two requests in one write, and one in pieces.
        stream.write_all(format!("{GET}{GET}").as_bytes()).unwrap();
        for _ in 0..2 {
            let text = read_one(&stream, 3);
            assert!(text.starts_with("HTTP/1.1 200 OK\r\n"), "{text}");
            assert!(text.ends_with("\r\n\r\n/a "), "{text}");
            assert!(text.contains("\r\nContent-Security-Policy: default-src 'none';"), "{text}");
        }
        let post = "POST /b HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\n\r\nhello";
        for piece in post.as_bytes().chunks(7) {
            stream.write_all(piece).unwrap();
        }
        assert!(read_one(&stream, 8).ends_with("/b hello"));
        stream
            .write_all(b"HEAD /c HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
            .unwrap();
        let text = read_all(&stream);
        assert!(text.contains("Content-Length: 3\r\n") && text.ends_with("\r\n\r\n"), "{text}");
    });
}

#[test]
fn invalid_requests_get_a_short_error_and_the_next_connection_is_served() {
    with_server(|connect| {
        let long = format!("GET /{} HTTP/1.1\r\n", "a".repeat(MAX_HEAD));
        let many = format!("GET / HTTP/1.1\r\n{}", "A: b\r\n".repeat(70));
        let host = "Host: localhost\r\n";
        for (request, status) in [
            ("\u{1}\u{2}\u{3}\r\n\r\n".to_owned(), 400),
            ("GET / HTTP/9.9\r\n\r\n".to_owned(), 400),
            ("GET / HTTP/1.1\r\n\r\n".to_owned(), 400),
            (format!("GET / HTTP/1.1\r\n{host}{host}\r\n"), 400),
            (format!("DELETE / HTTP/1.1\r\n{host}\r\n"), 405),
            (format!("OPTIONS / HTTP/1.1\r\n{host}\r\n"), 405),
            (format!("POST / HTTP/1.1\r\n{host}Content-Length: 99999\r\n\r\n"), 413),
            (format!("POST / HTTP/1.1\r\n{host}Content-Length: {}\r\n\r\n", "9".repeat(50)), 413),
            (format!("POST / HTTP/1.1\r\n{host}Content-Length: -1\r\n\r\n"), 400),
            (
                format!("POST / HTTP/1.1\r\n{host}Content-Length: 1\r\nContent-Length: 2\r\n\r\n"),
                400,
            ),
            (format!("POST / HTTP/1.1\r\n{host}Transfer-Encoding: chunked\r\n\r\n"), 411),
            (long, 431),
            (many, 431),
        ] {
            let mut stream = connect();
            stream.write_all(request.as_bytes()).unwrap();
            let text = read_all(&stream);
            assert!(text.starts_with(&format!("HTTP/1.1 {status} ")), "{request}: {text}");
            assert!(text.len() < 900, "{text}");
        }
        get(&mut connect());
    });
}

#[test]
fn a_thousand_idle_connections_do_not_block_others() {
    with_server(|connect| {
        let mut known = connect();
        get(&mut known);
        // Some send nothing, others an incomplete request.
        let idle: Vec<TcpStream> = (0..1000)
            .map(|number| {
                let mut stream = connect();
                if number % 2 == 0 {
                    let _ = stream.write_all(b"GET / HT");
                }
                stream
            })
            .collect();
        get(&mut connect());
        // A connection that has sent a request stays open.
        get(&mut known);
        let mut closed = 0;
        for mut stream in &idle {
            stream.set_nonblocking(true).unwrap();
            let mut byte = [0];
            closed += u32::from(!matches!(
                stream.read(&mut byte),
                Err(error) if error.kind() == std::io::ErrorKind::WouldBlock
            ));
        }
        assert!(closed as usize >= 1000 - MAX_CONNECTIONS, "{closed} were closed");
    });
}

#[test]
fn a_head_is_parsed_only_when_complete() {
    let whole = "POST /frame HTTP/1.1\r\nhost: a:1\r\nORIGIN: http://a:1\r\nContent-Type: application/json\r\n\
        Content-Length: 3\r\n\r\n";
    for end in 0..whole.len() {
        assert!(parse(&whole.as_bytes()[..end]).unwrap().is_none(), "{end} bytes");
    }
    let head = parse(format!("{whole}abcGET").as_bytes()).unwrap().unwrap();
    assert_eq!((head.length, head.body), (whole.len(), 3));
    let Request { method, path, host, origin, content_type, closes, .. } = head.request;
    assert_eq!((method, &*path, &*host, closes), (Method::Post, "/frame", "a:1", false));
    assert_eq!(origin.as_deref(), Some("http://a:1"));
    assert_eq!(content_type.as_deref(), Some("application/json"));
    let old = parse(b"GET / HTTP/1.0\r\nHost: a\r\n\r\n").unwrap().unwrap();
    assert!(old.request.closes, "HTTP/1.0 has one request per connection");
}
