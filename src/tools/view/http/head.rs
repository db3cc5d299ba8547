//! Requests: their heads, and what is refused of them before anything is looked at.

use super::Answer;

/// Most bytes of a request before its body.
pub(super) const MOST_HEAD: usize = 8 << 10;
/// Most bytes of a body: a wanted frame has a few hundred.
pub(super) const MOST_BODY: usize = 4 << 10;
/// Most lines of a head.
const MOST_LINES: usize = 64;

/// What a request may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Method {
    Get,
    Head,
    Post,
}

/// A request, as far as it matters here.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Request {
    pub(crate) method: Method,
    /// As sent, with its leading `/`.
    pub(crate) path: String,
    pub(crate) host: String,
    pub(crate) origin: Option<String>,
    pub(crate) content_type: Option<String>,
    pub(crate) body: Vec<u8>,
    /// Whether the connection ends with its answer.
    pub(crate) is_last: bool,
}

#[cfg(test)]
impl Request {
    /// One without a body.
    pub(crate) fn get(path: &str, host: &str, origin: Option<&str>) -> Self {
        Self {
            method: Method::Get,
            path: path.to_owned(),
            host: host.to_owned(),
            origin: origin.map(str::to_owned),
            content_type: None,
            body: Vec::new(),
            is_last: false,
        }
    }
}

/// A head that has arrived whole.
#[derive(Debug)]
pub(super) struct Head {
    /// Without its body.
    pub(super) request: Request,
    /// Bytes of the head.
    pub(super) length: usize,
    /// Bytes of the body that follows.
    pub(super) body: usize,
}

/// Reads a head; `None` while some of it is missing.
pub(super) fn parse(bytes: &[u8]) -> Result<Option<Head>, Answer> {
    let mut lines = [httparse::EMPTY_HEADER; MOST_LINES];
    let mut parsed = httparse::Request::new(&mut lines);
    let length = match parsed.parse(&bytes[..bytes.len().min(MOST_HEAD)]) {
        Ok(httparse::Status::Complete(length)) => length,
        Ok(httparse::Status::Partial) if bytes.len() < MOST_HEAD => return Ok(None),
        Ok(httparse::Status::Partial) | Err(httparse::Error::TooManyHeaders) => {
            return Err(Answer::refusal(431, "the head of the request is too long"));
        }
        Err(_) => return Err(Answer::refusal(400, "this is no HTTP request")),
    };
    let method = match parsed.method {
        Some("GET") => Method::Get,
        Some("HEAD") => Method::Head,
        Some("POST") => Method::Post,
        _ => return Err(Answer::refusal(405, "only GET, HEAD and POST are served")),
    };
    let line = |name: &str| line(parsed.headers, name);
    if line("transfer-encoding")?.is_some() {
        return Err(Answer::refusal(411, "send the body in one piece, with Content-Length"));
    }
    let body = match line("content-length")? {
        None => 0,
        Some(text) if text.is_empty() || !text.bytes().all(|byte| byte.is_ascii_digit()) => {
            return Err(Answer::refusal(400, "Content-Length is no number"));
        }
        // Numbers without end do not fit either.
        Some(text) => text.parse().unwrap_or(usize::MAX),
    };
    if body > MOST_BODY {
        return Err(Answer::refusal(413, "the body of the request is too long"));
    }
    let Some(host) = line("host")? else {
        return Err(Answer::refusal(400, "the request names no Host"));
    };
    let closes = line("connection")?.is_some_and(|word| word.eq_ignore_ascii_case("close"));
    let request = Request {
        method,
        path: parsed.path.unwrap_or("/").to_owned(),
        host,
        origin: line("origin")?,
        content_type: line("content-type")?,
        body: Vec::new(),
        is_last: closes || parsed.version != Some(1),
    };
    Ok(Some(Head { request, length, body }))
}

/// The value of a line that may stand once.
fn line(lines: &[httparse::Header<'_>], name: &str) -> Result<Option<String>, Answer> {
    let mut found = lines.iter().filter(|line| line.name.eq_ignore_ascii_case(name));
    let first = found.next();
    if found.next().is_some() {
        return Err(Answer::refusal(400, "a line of the head stands twice"));
    }
    let text = |line: &httparse::Header<'_>| {
        let text = std::str::from_utf8(line.value).ok()?;
        Some(text.trim().to_owned())
    };
    match first {
        None => Ok(None),
        Some(line) => match text(line) {
            Some(text) => Ok(Some(text)),
            None => Err(Answer::refusal(400, "a line of the head is no text")),
        },
    }
}
