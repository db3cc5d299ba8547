//! HTTP requests: parses heads and enforces limits on them.

use super::Response;

/// Maximum size of a request's head `[bytes]`.
pub(super) const MAX_HEAD: usize = 8 << 10;
/// Maximum size of a body `[bytes]`; a picture request has a few hundred.
pub(super) const MAX_BODY: usize = 4 << 10;
/// Maximum number of headers of a request.
const MAX_HEADERS: usize = 64;

/// The supported methods.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Method {
    Get,
    Head,
    Post,
}

/// The parts of a request that the page uses.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Request {
    pub(crate) method: Method,
    /// As sent, including the leading `/`.
    pub(crate) path: String,
    pub(crate) host: String,
    pub(crate) origin: Option<String>,
    pub(crate) content_type: Option<String>,
    pub(crate) body: Vec<u8>,
    /// True if the connection is closed after the response.
    pub(crate) closes: bool,
}

#[cfg(test)]
impl Request {
    /// A `GET` request.
    pub(crate) fn get(path: &str, host: &str, origin: Option<&str>) -> Self {
        Self {
            method: Method::Get,
            path: path.to_owned(),
            host: host.to_owned(),
            origin: origin.map(str::to_owned),
            content_type: None,
            body: Vec::new(),
            closes: false,
        }
    }
}

/// A complete head.
#[derive(Debug)]
pub(super) struct Head {
    /// The request, its body still empty.
    pub(super) request: Request,
    /// Length of the head `[bytes]`.
    pub(super) length: usize,
    /// Length of the body that follows `[bytes]`.
    pub(super) body: usize,
}

/// Parses a head; `None` while it is incomplete.
pub(super) fn parse(bytes: &[u8]) -> Result<Option<Head>, Response> {
    let mut headers = [httparse::EMPTY_HEADER; MAX_HEADERS];
    let mut parsed = httparse::Request::new(&mut headers);
    let length = match parsed.parse(&bytes[..bytes.len().min(MAX_HEAD)]) {
        Ok(httparse::Status::Complete(length)) => length,
        Ok(httparse::Status::Partial) if bytes.len() < MAX_HEAD => return Ok(None),
        Ok(httparse::Status::Partial) | Err(httparse::Error::TooManyHeaders) => {
            return Err(Response::error(431, "the head of the request is too long"));
        }
        Err(_) => return Err(Response::error(400, "this is not an HTTP request")),
    };
    let method = match parsed.method {
        Some("GET") => Method::Get,
        Some("HEAD") => Method::Head,
        Some("POST") => Method::Post,
        _ => return Err(Response::error(405, "only GET, HEAD and POST are served")),
    };
    let header = |name: &str| header(parsed.headers, name);
    if header("transfer-encoding")?.is_some() {
        return Err(Response::error(411, "send the body with Content-Length, not in chunks"));
    }
    let body = match header("content-length")? {
        None => 0,
        Some(text) if text.is_empty() || !text.bytes().all(|byte| byte.is_ascii_digit()) => {
            return Err(Response::error(400, "Content-Length is not a number"));
        }
        // A number that overflows exceeds the limit anyway.
        Some(text) => text.parse().unwrap_or(usize::MAX),
    };
    if body > MAX_BODY {
        return Err(Response::error(413, "the body of the request is too long"));
    }
    let Some(host) = header("host")? else {
        return Err(Response::error(400, "the request names no Host"));
    };
    let closes = header("connection")?.is_some_and(|word| word.eq_ignore_ascii_case("close"));
    let request = Request {
        method,
        path: parsed.path.unwrap_or("/").to_owned(),
        host,
        origin: header("origin")?,
        content_type: header("content-type")?,
        body: Vec::new(),
        closes: closes || parsed.version != Some(1),
    };
    Ok(Some(Head { request, length, body }))
}

/// The value of a header that may occur at most once.
fn header(headers: &[httparse::Header<'_>], name: &str) -> Result<Option<String>, Response> {
    let mut matching = headers.iter().filter(|header| header.name.eq_ignore_ascii_case(name));
    let first = matching.next();
    if matching.next().is_some() {
        return Err(Response::error(400, format_args!("the header {name} is given twice")));
    }
    let Some(first) = first else { return Ok(None) };
    match std::str::from_utf8(first.value) {
        Ok(text) => Ok(Some(text.trim().to_owned())),
        Err(_) => Err(Response::error(400, format_args!("the header {name} is not text"))),
    }
}
