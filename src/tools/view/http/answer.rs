//! Answers, with the lines that keep a browser from doing with them what is not meant.

use std::fmt::Write as _;
use std::io::{self, Write};
use std::sync::Arc;

/// Sent with every answer. Nothing is kept, nothing of others is loaded, and no other page may frame this one
/// or use its pictures.
const ALWAYS: &str = "Cache-Control: no-store\r\n\
    Content-Security-Policy: default-src 'none'; script-src 'self'; style-src 'self'; \
    img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; form-action 'none'; \
    frame-ancestors 'none'\r\n\
    Cross-Origin-Resource-Policy: same-origin\r\n\
    Referrer-Policy: no-referrer\r\n\
    X-Content-Type-Options: nosniff\r\n";

/// What is sent back.
#[derive(Debug, Clone)]
pub(crate) struct Answer {
    status: u16,
    content_type: &'static str,
    /// Lines of the head beyond those that every answer has.
    lines: Vec<(&'static str, String)>,
    /// Shared, so that what all ask for is there once.
    body: Arc<[u8]>,
}

impl Answer {
    /// What was asked for.
    pub(crate) fn of(content_type: &'static str, body: impl Into<Arc<[u8]>>) -> Self {
        Self { status: 200, content_type, lines: Vec::new(), body: body.into() }
    }

    /// A status with one sentence.
    pub(crate) fn refusal(status: u16, why: impl std::fmt::Display) -> Self {
        let body = format!("{why}\n").into_bytes();
        Self { status, ..Self::of("text/plain; charset=utf-8", body) }
    }

    /// The same with another line in its head.
    pub(crate) fn with(mut self, name: &'static str, value: impl ToString) -> Self {
        self.lines.push((name, value.to_string()));
        self
    }

    #[cfg(test)]
    pub(crate) fn status(&self) -> u16 {
        self.status
    }

    #[cfg(test)]
    pub(crate) fn body(&self) -> &[u8] {
        &self.body
    }

    /// Sends it; without its body to a request for the head alone.
    pub(super) fn write(
        &self,
        mut out: impl Write,
        with_body: bool,
        is_last: bool,
    ) -> io::Result<()> {
        let mut head = String::new();
        let (status, reason) = (self.status, reason(self.status));
        let after = if is_last { "close" } else { "keep-alive" };
        let _ = write!(
            head,
            "HTTP/1.1 {status} {reason}\r\nContent-Type: {}\r\nContent-Length: {}\r\nConnection: {after}\r\n{ALWAYS}",
            self.content_type,
            self.body.len()
        );
        for (name, value) in &self.lines {
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
