//! Where the page is reached, and who may ask for something there.
//!
//! A page of another origin that a browser has open can send requests here too. On this machine alone, names
//! that lead elsewhere are refused (a stranger's name may be made to lead here) and so is what another origin
//! sends. Towards a network, and where a run can be stopped, the address holds a secret as well.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener};

use super::http::{Answer, Method, Request};
use densify_run::failure::{Failure, OTHER};

/// The first port that is tried where none is named.
pub const FIRST_PORT: u16 = 8080;
/// How many are tried.
const PORTS: u16 = 100;

/// Where to listen.
#[derive(Debug, Clone, Copy)]
pub struct Place {
    /// This machine alone, or an address of it that others reach.
    pub host: IpAddr,
    /// The port; the first that is free without.
    pub port: Option<u16>,
    /// Whether the address holds a secret on this machine alone, too: for what does more than show.
    pub has_secret: bool,
}

/// An open place.
#[derive(Debug)]
pub(super) struct Door {
    pub(super) listener: TcpListener,
    address: SocketAddr,
    /// Whether other machines reach it.
    is_public: bool,
    /// What the path begins with, where others reach the address or more is done than shown.
    secret: Option<String>,
}

impl Door {
    /// Opens it.
    ///
    /// # Errors
    /// When the port is taken, or the address is not this machine's.
    pub(super) fn open(place: Place) -> Result<Self, Failure> {
        let Place { host, port, has_secret } = place;
        let bind = |port: u16| {
            let listener = TcpListener::bind((host, port))?;
            Ok((listener.local_addr()?, listener))
        };
        // That of `view`, and of `train`.
        let flag = if has_secret { "--view=" } else { "--port " };
        let refused = |port: u16, error: std::io::Error| match error.kind() {
            std::io::ErrorKind::AddrInUse => Failure::input(format!(
                "{flag}{port}: another program uses this port; choose another, or name none and a free one is \
                 taken"
            )),
            std::io::ErrorKind::PermissionDenied => Failure::input(format!(
                "{flag}{port}: the system keeps this port for itself ({error}); choose one from 1024 on"
            )),
            _ => Failure::input(format!(
                "--host {host}: nothing can be served there ({error}); give an address of this machine"
            )),
        };
        let (address, listener) = match port {
            Some(port) => bind(port).map_err(|error| refused(port, error))?,
            None => {
                let free = (FIRST_PORT..FIRST_PORT + PORTS).find_map(|port| bind(port).ok());
                // 0 is whichever the system has.
                free.map_or_else(|| bind(0), Ok).map_err(|error| refused(0, error))?
            }
        };
        let is_public = !host.is_loopback();
        let secret = if is_public || has_secret { Some(secret()?) } else { None };
        Ok(Self { listener, address, is_public, secret })
    }

    /// What to type into a browser on this machine.
    pub(super) fn url(&self) -> String {
        let mut address = self.address;
        match address.ip() {
            IpAddr::V4(ip) if ip.is_unspecified() => address.set_ip(Ipv4Addr::LOCALHOST.into()),
            IpAddr::V6(ip) if ip.is_unspecified() => address.set_ip(Ipv6Addr::LOCALHOST.into()),
            _ => {}
        }
        match &self.secret {
            None => format!("http://{address}/"),
            Some(secret) => format!("http://{address}/{secret}/"),
        }
    }

    /// Whether other machines reach it.
    pub(super) fn is_public(&self) -> bool {
        self.is_public
    }

    /// What a request is for, without the leading `/` and the secret.
    ///
    /// # Errors
    /// A refusal where it may not ask.
    pub(super) fn admit<'a>(&self, request: &'a Request) -> Result<&'a str, Answer> {
        let forbidden = |why: &str| Err(Answer::refusal(403, why));
        if !self.is_public && !is_this_machine(&request.host) {
            return forbidden(
                "this page is for browsers on its own machine; open the address that densify has printed",
            );
        }
        // A form of another page, or its script, says where it is from.
        if let Some(origin) = &request.origin
            && origin.strip_prefix("http://") != Some(&request.host)
        {
            return forbidden("another page may not ask for anything here");
        }
        // What a form can send without asking first is no JSON.
        if request.method == Method::Post
            && request.content_type.as_deref() != Some("application/json")
        {
            return Err(Answer::refusal(415, "send application/json"));
        }
        let nothing = "there is nothing here; use the whole address that densify has printed";
        let path = match (request.path.strip_prefix('/'), &self.secret) {
            (Some(path), Some(secret)) => {
                path.split_at_checked(secret.len()).and_then(|(given, rest)| {
                    if is_equal(given, secret) { rest.strip_prefix('/') } else { None }
                })
            }
            (path, _) => path,
        };
        path.ok_or_else(|| Answer::refusal(404, nothing))
    }
}

/// Whether a name, with a port or without, leads to the machine of whoever uses it. A browser may reach it
/// through a tunnel, so that any port will do.
fn is_this_machine(host: &str) -> bool {
    let name = match host.rsplit_once(':') {
        Some((name, port)) if port.parse::<u16>().is_ok() => name,
        _ => host,
    };
    let bare = name.strip_prefix('[').and_then(|name| name.strip_suffix(']')).unwrap_or(name);
    name.eq_ignore_ascii_case("localhost") || bare.parse().is_ok_and(|ip: IpAddr| ip.is_loopback())
}

/// Compares in a time that does not say where they differ.
fn is_equal(a: &str, b: &str) -> bool {
    let differing = a.bytes().zip(b.bytes()).fold(0, |sum, (a, b)| sum | (a ^ b));
    a.len() == b.len() && differing == 0
}

/// 128 bits that nobody can guess.
fn secret() -> Result<String, Failure> {
    let mut bytes = [0; 16];
    getrandom::fill(&mut bytes).map_err(|error| {
        Failure::new(
            OTHER,
            format!("--host: the system has no random numbers for the address: {error}"),
        )
    })?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn door(host: IpAddr) -> Door {
        Door::open(Place { host, port: Some(0), has_secret: false }).unwrap()
    }

    fn request(path: &str, host: &str, origin: Option<&str>) -> Request {
        Request::get(path, host, origin)
    }

    #[test]
    fn only_this_machine_and_this_page_may_ask() {
        let door = door(Ipv4Addr::LOCALHOST.into());
        let ask = |host: &str, origin: Option<&str>| {
            door.admit(&request("/scene", host, origin))
                .map(str::to_owned)
                .map_err(|no| no.status())
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
    fn a_form_cannot_send_what_is_asked_for() {
        let door = door(Ipv4Addr::LOCALHOST.into());
        let post = |content_type: Option<&str>| {
            let request = Request {
                method: Method::Post,
                content_type: content_type.map(str::to_owned),
                ..request("/frame", "localhost", None)
            };
            door.admit(&request).map(str::to_owned).map_err(|no| no.status())
        };
        assert_eq!(post(Some("application/json")), Ok("frame".to_owned()));
        assert_eq!(post(Some("text/plain")), Err(415));
        assert_eq!(post(None), Err(415));
    }

    #[test]
    fn towards_a_network_the_address_holds_a_secret() {
        let [one, other] = [(); 2].map(|()| door(Ipv4Addr::UNSPECIFIED.into()));
        assert!(one.is_public() && one.secret != other.secret);
        let secret = one.secret.clone().unwrap();
        assert_eq!(secret.len(), 32);
        assert!(
            one.url().starts_with("http://127.0.0.1:")
                && one.url().ends_with(&format!("/{secret}/"))
        );
        let ask =
            |path: &str| one.admit(&request(path, "any.example", None)).map(str::to_owned).ok();
        assert_eq!(ask(&format!("/{secret}/frame")).as_deref(), Some("frame"));
        assert_eq!(ask(&format!("/{secret}/")).as_deref(), Some(""));
        let wrong = format!("/{}/", "0".repeat(32));
        for path in ["/", "/frame", &wrong, &format!("/{secret}"), &format!("//{secret}/"), "/ä/é"]
        {
            assert_eq!(ask(path), None, "{path}");
        }
    }

    #[test]
    fn what_stops_a_run_has_a_secret_and_is_for_this_machine_alone() {
        let host = Ipv4Addr::LOCALHOST.into();
        let door = Door::open(Place { host, port: Some(0), has_secret: true }).unwrap();
        assert!(!door.is_public());
        let secret = door.secret.clone().unwrap();
        let ask = |path: &str, host: &str| {
            door.admit(&request(path, host, None)).map(str::to_owned).map_err(|no| no.status())
        };
        assert_eq!(ask(&format!("/{secret}/order"), "localhost:8080"), Ok("order".to_owned()));
        assert_eq!(ask("/order", "localhost:8080"), Err(404));
        assert_eq!(ask(&format!("/{secret}/order"), "evil.example"), Err(403));
    }

    #[test]
    fn a_port_in_use_is_named_and_without_one_the_next_is_taken() {
        let first = door(Ipv4Addr::LOCALHOST.into());
        let port = first.address.port();
        let host = Ipv4Addr::LOCALHOST.into();
        let refused = Door::open(Place { host, port: Some(port), has_secret: false }).unwrap_err();
        assert!(
            refused.code == 2 && refused.to_string().contains(&format!("--port {port}")),
            "{refused}"
        );
        let two =
            [(); 2].map(|()| Door::open(Place { host, port: None, has_secret: false }).unwrap());
        assert_ne!(two[0].address, two[1].address);
        let elsewhere =
            Place { host: Ipv4Addr::new(192, 0, 2, 7).into(), port: Some(0), has_secret: false };
        let refused = Door::open(elsewhere).unwrap_err();
        assert!(refused.code == 2 && refused.to_string().contains("--host 192.0.2.7"), "{refused}");
    }
}
