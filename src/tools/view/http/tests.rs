use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::connections::SEATS;
use super::head::{MOST_HEAD, parse};
use super::*;

const GET: &str = "GET /a HTTP/1.1\r\nHost: localhost\r\n\r\n";

/// Serves echoes of paths and bodies while `body` asks.
fn with_server(body: impl FnOnce(&dyn Fn() -> TcpStream)) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let over = AtomicBool::new(false);
    let answer = |request: &Request| {
        let said = format!("{} {}", request.path, String::from_utf8_lossy(&request.body));
        Answer::of("text/plain", said.into_bytes())
    };
    std::thread::scope(|scope| {
        let served = scope.spawn(|| serve(&listener, &answer, &|| over.load(Ordering::SeqCst)));
        let connect = || {
            let stream = TcpStream::connect(address).unwrap();
            stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
            stream
        };
        /// Ends the server even if the test fails: its failure would wait for ever otherwise.
        struct Ends<'a>(&'a AtomicBool);
        impl Drop for Ends<'_> {
            fn drop(&mut self) {
                self.0.store(true, Ordering::SeqCst);
            }
        }
        let ends = Ends(&over);
        body(&connect);
        drop(ends);
        served.join().unwrap().unwrap();
    });
}

/// Everything until the connection ends.
fn all(mut stream: &TcpStream) -> String {
    let mut bytes = Vec::new();
    let _ = stream.read_to_end(&mut bytes);
    String::from_utf8_lossy(&bytes).into_owned()
}

/// One answer of a connection that goes on; its body has this length.
fn one(mut stream: &TcpStream, body: usize) -> String {
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

#[test]
fn a_connection_answers_one_request_after_another() {
    with_server(|connect| {
        let mut stream = connect();
        // Two at once, and one in pieces.
        stream.write_all(format!("{GET}{GET}").as_bytes()).unwrap();
        for _ in 0..2 {
            let said = one(&stream, 3);
            assert!(
                said.starts_with("HTTP/1.1 200 OK\r\n") && said.ends_with("\r\n\r\n/a "),
                "{said}"
            );
            assert!(said.contains("\r\nContent-Security-Policy: default-src 'none';"), "{said}");
        }
        let post = "POST /b HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\n\r\nhello";
        for piece in post.as_bytes().chunks(7) {
            stream.write_all(piece).unwrap();
        }
        assert!(one(&stream, 8).ends_with("/b hello"));
        stream
            .write_all(b"HEAD /c HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
            .unwrap();
        let said = all(&stream);
        assert!(said.contains("Content-Length: 3\r\n") && said.ends_with("\r\n\r\n"), "{said}");
    });
}

#[test]
fn what_is_no_request_is_refused_in_a_word_and_the_next_guest_is_served() {
    with_server(|connect| {
        let long = format!("GET /{} HTTP/1.1\r\n", "a".repeat(MOST_HEAD));
        let many = format!("GET / HTTP/1.1\r\n{}", "A: b\r\n".repeat(70));
        let host = "Host: localhost\r\n";
        for (text, status) in [
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
            stream.write_all(text.as_bytes()).unwrap();
            let said = all(&stream);
            assert!(said.starts_with(&format!("HTTP/1.1 {status} ")), "{text}: {said}");
            assert!(said.len() < 900, "{said}");
        }
        let mut stream = connect();
        stream.write_all(GET.as_bytes()).unwrap();
        assert!(one(&stream, 3).contains(" 200 "));
    });
}

#[test]
fn a_thousand_idle_connections_keep_nobody_out() {
    with_server(|connect| {
        let mut known = connect();
        known.write_all(GET.as_bytes()).unwrap();
        one(&known, 3);
        // Some say nothing, others begin and do not end.
        let idle: Vec<TcpStream> = (0..1000)
            .map(|number| {
                let mut stream = connect();
                if number % 2 == 0 {
                    let _ = stream.write_all(b"GET / HT");
                }
                stream
            })
            .collect();
        let mut stream = connect();
        stream.write_all(GET.as_bytes()).unwrap();
        assert!(one(&stream, 3).contains(" 200 "));
        // Who has asked before keeps the seat.
        known.write_all(GET.as_bytes()).unwrap();
        assert!(one(&known, 3).contains(" 200 "));
        let mut closed = 0;
        for mut stream in &idle {
            stream.set_nonblocking(true).unwrap();
            let mut byte = [0];
            closed += u32::from(!matches!(
                stream.read(&mut byte),
                Err(error) if error.kind() == std::io::ErrorKind::WouldBlock
            ));
        }
        assert!(closed as usize >= 1000 - SEATS, "{closed} have made room");
    });
}

#[test]
fn heads_are_understood_to_the_last_byte() {
    let whole = "POST /frame HTTP/1.1\r\nhost: a:1\r\nORIGIN: http://a:1\r\nContent-Type: application/json\r\n\
        Content-Length: 3\r\n\r\n";
    for end in 0..whole.len() {
        assert!(parse(&whole.as_bytes()[..end]).unwrap().is_none(), "{end} bytes");
    }
    let head = parse(format!("{whole}abcGET").as_bytes()).unwrap().unwrap();
    assert_eq!((head.length, head.body), (whole.len(), 3));
    let Request { method, path, host, origin, content_type, is_last, .. } = head.request;
    assert_eq!((method, &*path, &*host, is_last), (Method::Post, "/frame", "a:1", false));
    assert_eq!(origin.as_deref(), Some("http://a:1"));
    assert_eq!(content_type.as_deref(), Some("application/json"));
    let old = parse(b"GET / HTTP/1.0\r\nHost: a\r\n\r\n").unwrap().unwrap();
    assert!(old.request.is_last, "HTTP/1.0 has one request per connection");
}
