//! The listening socket of the page, and the check of who may send requests to it.
//!
//! A browser lets other open pages send requests here too. A loopback listener therefore accepts only host names of
//! this machine (against DNS rebinding) and no foreign `Origin`. If other machines can reach the page, or if it can
//! stop a run, its address also contains a random token.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener};

use super::http::{Method, Request, Response};
use densify_run::failure::{Failure, OTHER};

/// The first port tried by default.
pub const FIRST_PORT: u16 = 8080;
/// Number of ports tried by default.
const PORTS: u16 = 100;

/// The address to listen on.
#[derive(Debug, Clone, Copy)]
pub struct ListenAddress {
    /// An address of this machine; loopback addresses are not reachable from others.
    pub host: IpAddr,
    /// The port; by default the first free one from [`FIRST_PORT`] on.
    pub port: Option<u16>,
    /// True to put a random token even into a loopback address, for a page that can control a run.
    pub needs_token: bool,
}

/// An HTTP server for one page, bound to its port.
#[derive(Debug)]
pub struct Server {
    pub(super) socket: TcpListener,
    address: SocketAddr,
    /// True if other machines can reach the page.
    is_public: bool,
    /// The first component of every path, if one is required.
    token: Option<String>,
}

impl Server {
    /// Binds the port.
    ///
    /// # Errors
    /// If the port is in use or the address does not belong to this machine.
    pub fn open(address: ListenAddress) -> Result<Self, Failure> {
        let ListenAddress { host, port, needs_token } = address;
        let bind = |port: u16| {
            let socket = TcpListener::bind((host, port))?;
            Ok((socket.local_addr()?, socket))
        };
        // `needs_token` is set for `train --view=PORT`; `view` has the option `--port`.
        let flag = if needs_token { "--view=" } else { "--port " };
        let refused = |port: u16, error: std::io::Error| match error.kind() {
            std::io::ErrorKind::AddrInUse => Failure::input(format!(
                "{flag}{port}: another program uses this port; choose another, or give none to use a free one"
            )),
            std::io::ErrorKind::PermissionDenied => Failure::input(format!(
                "{flag}{port}: the system reserves this port ({error}); choose one from 1024 on"
            )),
            _ => Failure::input(format!(
                "--host {host}: cannot listen there ({error}); give an address of this machine"
            )),
        };
        let (address, socket) = match port {
            Some(port) => bind(port).map_err(|error| refused(port, error))?,
            None => {
                let free = (FIRST_PORT..FIRST_PORT + PORTS).find_map(|port| bind(port).ok());
                // With port 0 the system chooses a free port.
                free.map_or_else(|| bind(0), Ok).map_err(|error| refused(0, error))?
            }
        };
        let is_public = !host.is_loopback();
        let token = if is_public || needs_token { Some(random_token()?) } else { None };
        Ok(Self { socket, address, is_public, token })
    }

    /// The page's address for a browser on this machine.
    pub fn url(&self) -> String {
        let mut address = self.address;
        match address.ip() {
            IpAddr::V4(ip) if ip.is_unspecified() => address.set_ip(Ipv4Addr::LOCALHOST.into()),
            IpAddr::V6(ip) if ip.is_unspecified() => address.set_ip(Ipv6Addr::LOCALHOST.into()),
            _ => {}
        }
        match &self.token {
            None => format!("http://{address}/"),
            Some(token) => format!("http://{address}/{token}/"),
        }
    }

    /// True if other machines can reach the page.
    pub fn is_public(&self) -> bool {
        self.is_public
    }

    /// Checks a request; returns its path without the leading `/` and the token.
    ///
    /// # Errors
    /// The error response to a request that is not allowed.
    pub(super) fn authorise<'a>(&self, request: &'a Request) -> Result<&'a str, Response> {
        let forbidden = |message: &str| Err(Response::error(403, message));
        if !self.is_public && !is_loopback(&request.host) {
            return forbidden(
                "this page is for browsers on its own machine; open the address that densify printed",
            );
        }
        // Browsers send the origin with the forms and scripts of other pages.
        if let Some(origin) = &request.origin
            && origin.strip_prefix("http://") != Some(&request.host)
        {
            return forbidden("another page may not send requests here");
        }
        // A form of another page cannot send JSON without a preflight request.
        if request.method == Method::Post
            && request.content_type.as_deref() != Some("application/json")
        {
            return Err(Response::error(415, "send application/json"));
        }
        let not_found = "there is nothing here; use the complete address that densify printed";
        let path = match (request.path.strip_prefix('/'), &self.token) {
            (Some(path), Some(token)) => {
                path.split_at_checked(token.len()).and_then(|(given, rest)| {
                    if is_equal(given, token) { rest.strip_prefix('/') } else { None }
                })
            }
            (path, _) => path,
        };
        path.ok_or_else(|| Response::error(404, not_found))
    }
}

/// True for a loopback host, with or without a port. Any port is allowed, as the browser may use a tunnel.
fn is_loopback(host: &str) -> bool {
    let name = match host.rsplit_once(':') {
        Some((name, port)) if port.parse::<u16>().is_ok() => name,
        _ => host,
    };
    let bare = name.strip_prefix('[').and_then(|name| name.strip_suffix(']')).unwrap_or(name);
    name.eq_ignore_ascii_case("localhost") || bare.parse().is_ok_and(|ip: IpAddr| ip.is_loopback())
}

/// Compares in constant time, so that timing does not reveal the first difference.
fn is_equal(a: &str, b: &str) -> bool {
    let differing = a.bytes().zip(b.bytes()).fold(0, |sum, (a, b)| sum | (a ^ b));
    a.len() == b.len() && differing == 0
}

/// 128 random bits, as hexadecimal digits.
fn random_token() -> Result<String, Failure> {
    let mut bytes = [0; 16];
    getrandom::fill(&mut bytes).map_err(|error| {
        let problem = "the system provides no random numbers for the address";
        Failure::new(OTHER, format!("--host: {problem}: {error}"))
    })?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open(host: Ipv4Addr, port: Option<u16>, needs_token: bool) -> Result<Server, Failure> {
        Server::open(ListenAddress { host: host.into(), port, needs_token })
    }

    fn listener(host: Ipv4Addr) -> Server {
        open(host, Some(0), false).unwrap()
    }

    fn authorised(listener: &Server, request: &Request) -> Result<String, u16> {
        listener.authorise(request).map(str::to_owned).map_err(|error| error.status)
    }

    #[test]
    fn only_this_machine_and_this_page_may_send_requests() {
        let listener = listener(Ipv4Addr::LOCALHOST);
        let ask = |host: &str, origin: Option<&str>| {
            authorised(&listener, &Request::get("/scene", host, origin))
        };
        for host in ["localhost", "LOCALHOST:8080", "127.0.0.1:1", "[::1]:8080", "127.9.9.9"] {
            assert_eq!(ask(host, None), Ok("scene".to_owned()), "{host}");
            assert_eq!(ask(host, Some(&format!("http://{host}"))), Ok("scene".to_owned()));
            for origin in
                ["http://evil.example", "null", "https://localhost:8080", "http://localhost:3"]
            {
                assert_eq!(ask(host, Some(origin)), Err(403), "{host} {origin}");
            }
        }
        for host in
            ["evil.example", "localhost.evil.example:8080", "10.0.0.1", "", ":80", "0.0.0.0"]
        {
            assert_eq!(ask(host, None), Err(403), "{host}");
        }
    }

    #[test]
    fn only_json_may_be_posted() {
        let listener = listener(Ipv4Addr::LOCALHOST);
        let post = |content_type: Option<&str>| {
            let request = Request {
                method: Method::Post,
                content_type: content_type.map(str::to_owned),
                ..Request::get("/frame", "localhost", None)
            };
            authorised(&listener, &request)
        };
        assert_eq!(post(Some("application/json")), Ok("frame".to_owned()));
        assert_eq!(post(Some("text/plain")), Err(415));
        assert_eq!(post(None), Err(415));
    }

    #[test]
    fn a_public_address_contains_a_token() {
        let [one, other] = [(); 2].map(|()| listener(Ipv4Addr::UNSPECIFIED));
        assert!(one.is_public() && one.token != other.token);
        let token = one.token.clone().unwrap();
        assert_eq!(token.len(), 32);
        let url = one.url();
        assert!(url.starts_with("http://127.0.0.1:") && url.ends_with(&format!("/{token}/")));
        let ask = |path: &str| authorised(&one, &Request::get(path, "any.example", None)).ok();
        assert_eq!(ask(&format!("/{token}/frame")).as_deref(), Some("frame"));
        assert_eq!(ask(&format!("/{token}/")).as_deref(), Some(""));
        let wrong = format!("/{}/", "0".repeat(32));
        for path in ["/", "/frame", &wrong, &format!("/{token}"), &format!("//{token}/"), "/ä/é"]
        {
            assert_eq!(ask(path), None, "{path}");
        }
    }

    #[test]
    fn a_page_that_controls_a_run_has_a_token_and_is_for_this_machine() {
        let listener = open(Ipv4Addr::LOCALHOST, Some(0), true).unwrap();
        assert!(!listener.is_public());
        let token = listener.token.clone().unwrap();
        let ask = |path: &str, host: &str| authorised(&listener, &Request::get(path, host, None));
        assert_eq!(ask(&format!("/{token}/order"), "localhost:8080"), Ok("order".to_owned()));
        assert_eq!(ask("/order", "localhost:8080"), Err(404));
        assert_eq!(ask(&format!("/{token}/order"), "evil.example"), Err(403));
    }

    #[test]
    fn a_port_in_use_is_named_and_the_default_is_the_next_free_one() {
        let host = Ipv4Addr::LOCALHOST;
        let first = listener(host);
        let port = first.address.port();
        let refused = open(host, Some(port), false).unwrap_err();
        let message = refused.to_string();
        assert!(refused.code == 2 && message.contains(&format!("--port {port}")), "{message}");
        let two = [(); 2].map(|()| open(host, None, false).unwrap());
        assert_ne!(two[0].address, two[1].address);
        let refused = open(Ipv4Addr::new(192, 0, 2, 7), Some(0), false).unwrap_err();
        assert!(refused.code == 2 && refused.to_string().contains("--host 192.0.2.7"), "{refused}");
    }
}
