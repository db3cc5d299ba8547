//! Routes requests to responses. No path names a file: everything served is built in or rendered on request.

use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant};

use serde::Deserialize;

use super::encoder::EncodedPicture;
use super::http::{Method, Request, Response};
use super::listener::Server;
use super::picture_request::{self, PictureRequest};
use super::render_queue::{RenderError, RenderQueue};
use super::run_status::{Command, RunStatus};
use super::scene::Scene;

const PAGE: &str = include_str!("page/index.html");
static STYLE: LazyLock<String> =
    LazyLock::new(|| [densify_html::PALETTE, include_str!("page/view.css")].concat());
const SCRIPT: &str = include_str!("page/view.js");
const LIVE_SCRIPT: &str = include_str!("page/live.js");

/// Everything that responses are made from.
pub(super) struct Routes<'a> {
    pub(super) listener: &'a Server,
    pub(super) queue: &'a RenderQueue,
    pub(super) scene: &'a Scene,
    /// The scene's [description](super::description), as JSON.
    pub(super) description: Arc<[u8]>,
    /// The status of the run, if one is in training.
    pub(super) run_status: Option<&'a RunStatus>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CommandBody {
    order: Command,
}

impl Routes<'_> {
    /// The response to a request.
    pub(super) fn respond(&self, request: &Request) -> Response {
        let path = match self.listener.authorise(request) {
            Ok(path) => path,
            Err(response) => return response,
        };
        let text = |kind, text: &'static str| Response::ok(kind, text.as_bytes());
        let json = |text: String| Response::ok("application/json", text.into_bytes());
        let paths = ["", "view.css", "view.js", "live.js", "scene", "frame"];
        let training_paths = ["progress", "order"];
        match (request.method, path) {
            (Method::Post, "order") if let Some(run_status) = self.run_status => {
                match serde_json::from_slice(&request.body) {
                    Ok(CommandBody { order }) => {
                        run_status.command(order);
                        json("{}".to_owned())
                    }
                    Err(error) => {
                        Response::error(400, format_args!("this is not a command: {error}"))
                    }
                }
            }
            (Method::Get | Method::Head, "progress") if let Some(run_status) = self.run_status => {
                json(run_status.json())
            }
            (Method::Post, "frame") => match picture_request::parse(&request.body, self.scene) {
                Ok(request) => self.render(request),
                Err(response) => response,
            },
            (Method::Get | Method::Head, "") => text("text/html; charset=utf-8", PAGE),
            (Method::Get | Method::Head, "view.css") => text("text/css; charset=utf-8", &STYLE),
            (Method::Get | Method::Head, "view.js") => {
                text("text/javascript; charset=utf-8", SCRIPT)
            }
            (Method::Get | Method::Head, "live.js") => {
                text("text/javascript; charset=utf-8", LIVE_SCRIPT)
            }
            (Method::Get | Method::Head, "scene") => {
                Response::ok("application/json", self.description.clone())
            }
            (_, path)
                if paths.contains(&path)
                    || self.run_status.is_some() && training_paths.contains(&path) =>
            {
                Response::error(405, "this path needs another HTTP method")
            }
            _ => Response::error(404, "there is nothing here"),
        }
    }

    fn render(&self, request: PictureRequest) -> Response {
        let begun = Instant::now();
        match self.queue.submit(request) {
            Ok(picture) => picture_response(picture, begun.elapsed()),
            Err(RenderError::Superseded) => {
                Response::error(409, "a newer picture was requested meanwhile")
            }
            Err(RenderError::QueueFull) => {
                Response::error(503, "too many pages are open; close some")
            }
            Err(RenderError::Failed(message)) => Response::error(500, message),
            Err(RenderError::Closed) => Response::error(
                503,
                "densify renders no more pictures; once it has ended, start it again",
            ),
        }
    }
}

/// The response with a picture, its data in the headers. `server_time` is the time from request to response here,
/// waiting included, so that the page can subtract it from the total to find the latency of the network.
fn picture_response(picture: EncodedPicture, server_time: Duration) -> Response {
    let (width, height) = picture.size;
    let mut response = Response::ok("image/jpeg", picture.jpeg)
        .with_header("X-Size", format!("{width}x{height}"))
        .with_header("X-Milliseconds", format!("{:.1}", picture.milliseconds))
        .with_header("X-Held", format!("{:.1}", 1e3 * server_time.as_secs_f64()));
    if let Some(range) = picture.range {
        response = response.with_header("X-Range", format!("{} {}", range.start, range.end));
    }
    if let Some([seen, all]) = picture.measured_views {
        response = response.with_header("X-Measured", format!("{seen} {all}"));
    }
    let numbers = [("X-Mean", picture.mean), ("X-Distance", picture.distance)];
    for (name, value) in numbers.into_iter().filter_map(|(name, value)| Some((name, value?))) {
        response = response.with_header(name, value);
    }
    response
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;
    use crate::listener::ListenAddress;
    use crate::scene::ModelInfo;
    use densify_data::dataset::PointCloud;
    use densify_data::dataset::normalise::Normalisation;
    use densify_run::finished::Machine;

    #[test]
    fn only_built_in_paths_are_served() {
        let (host, port) = (Ipv4Addr::LOCALHOST.into(), Some(0));
        let listener = Server::open(ListenAddress { host, port, needs_token: false }).unwrap();
        let none = || [Vec::new(), Vec::new()];
        let points = PointCloud::default();
        let (machine, normalisation) = (Machine::default(), Normalisation::IDENTITY);
        let mut scene = Scene::new(machine, "a".into(), normalisation, [0.0; 3], none(), points);
        scene.models.push(ModelInfo::sample(1));
        let queue = RenderQueue::new(None, 1);
        queue.close();
        let run_status = RunStatus::default();
        let routes = |run_status| Routes {
            listener: &listener,
            queue: &queue,
            scene: &scene,
            description: Arc::from(*b"{}"),
            run_status,
        };
        let (routes, live) = (routes(None), routes(Some(&run_status)));
        let status = |request: &Request| routes.respond(request).status;
        let get = |path: &str| status(&Request::get(path, "localhost", None));
        for path in ["/", "/view.css", "/view.js", "/live.js", "/scene"] {
            assert_eq!(get(path), 200, "{path}");
        }
        for path in [
            "/etc/passwd",
            "/../Cargo.toml",
            "//",
            "/view.js/",
            "/%2e%2e/",
            "/?",
            "*",
            "",
            "/page/view.js",
            "/progress",
            "/order",
        ] {
            assert_eq!(get(path), 404, "{path}");
        }
        assert_eq!(get("/frame"), 405);
        let post_request = |path: &str, body: &str| Request {
            method: Method::Post,
            content_type: Some("application/json".into()),
            body: body.into(),
            ..Request::get(path, "localhost", None)
        };
        let post = |path: &str, body: &str| status(&post_request(path, body));
        assert_eq!(post("/scene", "{}"), 405);
        assert_eq!(post("/frame", "{}"), 400);
        let picture = r#"{"page": "a", "kind": "render", "width": 9, "height": 9, "camera":
            {"camera_to_world": [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1], "fov": 50}}"#;
        assert_eq!(post("/frame", picture), 503);
        // A run in training also has progress, and takes commands.
        let send = |body: &str| live.respond(&post_request("/order", body));
        for (body, status) in [
            ("{}", 400),
            (r#"{"order": "explode"}"#, 400),
            (r#"{"order": "stop", "now": true}"#, 400),
            ("stop", 400),
        ] {
            assert_eq!(send(body).status, status, "{body}");
        }
        assert!(!run_status.is_stopped());
        assert_eq!(send(r#"{"order": "stop"}"#).status, 200);
        assert!(run_status.is_stopped(), "the command is lost");
        let progress = live.respond(&Request::get("/progress", "localhost", None));
        let progress: serde_json::Value = serde_json::from_slice(&progress.body).unwrap();
        assert_eq!(progress["state"], "preparing");
        assert_eq!(live.respond(&Request::get("/order", "localhost", None)).status, 405);
    }

    #[test]
    fn the_page_loads_nothing_from_elsewhere() {
        for text in [PAGE, &STYLE, SCRIPT, LIVE_SCRIPT] {
            for word in ["http://", "https://", "//cdn", "@import", "eval("] {
                let without_namespace = text.replace("http://www.w3.org/", "");
                assert!(!without_namespace.contains(word), "{word}");
            }
        }
    }
}
