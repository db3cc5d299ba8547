//! HTTP responses, with the headers that restrict what a browser may do with them.

use std::fmt::Write as _;
use std::io::{self, Write};
use std::sync::Arc;

/// Sent with every response: nothing is cached or loaded from elsewhere, and no other page may embed this one or use
/// its pictures.
const COMMON_HEADERS: &str = "Cache-Control: no-store\r\n\
    Content-Security-Policy: default-src 'none'; script-src 'self'; style-src 'self'; \
    img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; form-action 'none'; \
    frame-ancestors 'none'\r\n\
    Cross-Origin-Resource-Policy: same-origin\r\n\
    Referrer-Policy: no-referrer\r\n\
    X-Content-Type-Options: nosniff\r\n";

/// A complete response.
#[derive(Debug, Clone)]
pub(crate) struct Response {
    pub(crate) status: u16,
    content_type: &'static str,
    /// Headers in addition to the common ones.
    headers: Vec<(&'static str, String)>,
    /// Shared, so that a body that every page requests is in memory only once.
    pub(crate) body: Arc<[u8]>,
}

impl Response {
    /// Status 200 with this body.
    pub(crate) fn ok(content_type: &'static str, body: impl Into<Arc<[u8]>>) -> Self {
        Self { status: 200, content_type, headers: Vec::new(), body: body.into() }
    }

    /// An error status with one sentence.
    pub(crate) fn error(status: u16, message: impl std::fmt::Display) -> Self {
        let body = format!("{message}\n").into_bytes();
        Self { status, ..Self::ok("text/plain; charset=utf-8", body) }
    }

    /// Adds a header.
    pub(crate) fn with_header(mut self, name: &'static str, value: impl ToString) -> Self {
        self.headers.push((name, value.to_string()));
        self
    }

    /// Sends the response; `HEAD` requests get no body.
    pub(super) fn write(
        &self,
        mut out: impl Write,
        with_body: bool,
        closes: bool,
    ) -> io::Result<()> {
        let mut head = String::new();
        let (status, reason) = (self.status, reason(self.status));
        let connection = if closes { "close" } else { "keep-alive" };
        let _ = write!(
            head,
            "HTTP/1.1 {status} {reason}\r\nContent-Type: {}\r\nContent-Length: {}\r\nConnection: {connection}\r\n{COMMON_HEADERS}",
            self.content_type,
            self.body.len()
        );
        for (name, value) in &self.headers {
            let _ = write!(head, "{name}: {value}\r\n");
        }
        head.push_str("\r\n");
        out.write_all(head.as_bytes())?;
        if with_body {
            out.write_all(&self.body)?;
        }
        out.flush()
    }
}

fn reason(status: u16) -> &'static str {
    match status {
        200 => "OK",
        400 => "Bad Request",
        403 => "Forbidden",
        404 => "Not Found",
        405 => "Method Not Allowed",
        408 => "Request Timeout",
        409 => "Conflict",
        411 => "Length Required",
        413 => "Content Too Large",
        415 => "Unsupported Media Type",
        431 => "Request Header Fields Too Large",
        503 => "Service Unavailable",
        _ => "Internal Server Error",
    }
}
