//! Which request gets what. No path names a file: what is served is built in, or made on request.

use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::Deserialize;

use super::asked::{self, Wanted};
use super::board::{Board, Order};
use super::darkroom::Frame;
use super::desk::{Desk, Unmade};
use super::door::Door;
use super::http::{Answer, Method, Request};
use super::stage::Extent;

const PAGE: &str = include_str!("page/index.html");
const STYLE: &str = concat!(include_str!("../html/palette.css"), include_str!("page/view.css"));
const SCRIPT: &str = include_str!("page/view.js");
const LIVE_SCRIPT: &str = include_str!("page/live.js");

/// What answers need.
pub(super) struct Routes<'a> {
    pub(super) door: &'a Door,
    pub(super) desk: &'a Desk,
    pub(super) extent: Extent,
    /// The [description](super::describe) of what is shown, as JSON.
    pub(super) description: Arc<[u8]>,
    /// What is said of a run in training, and asked of it.
    pub(super) board: Option<&'a Board>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Asked {
    order: Order,
}

impl Routes<'_> {
    /// The answer to a request.
    pub(super) fn answer(&self, request: &Request) -> Answer {
        let path = match self.door.admit(request) {
            Ok(path) => path,
            Err(refusal) => return refusal,
        };
        let text = |kind, text: &'static str| Answer::of(kind, text.as_bytes());
        let json = |text: String| Answer::of("application/json", text.into_bytes());
        let known = ["", "view.css", "view.js", "live.js", "scene", "frame"];
        let known_of_training = ["progress", "order"];
        match (request.method, path) {
            (Method::Post, "order") if let Some(board) = self.board => {
                match serde_json::from_slice(&request.body) {
                    Ok(Asked { order }) => {
                        board.order(order);
                        json("{}".to_owned())
                    }
                    Err(error) => Answer::refusal(400, format_args!("this is no order: {error}")),
                }
            }
            (Method::Get | Method::Head, "progress") if let Some(board) = self.board => {
                json(board.json())
            }
            (Method::Post, "frame") => match asked::read(&request.body, &self.extent) {
                Ok(wanted) => self.frame(wanted),
                Err(refusal) => refusal,
            },
            (Method::Get | Method::Head, "") => text("text/html; charset=utf-8", PAGE),
            (Method::Get | Method::Head, "view.css") => text("text/css; charset=utf-8", STYLE),
            (Method::Get | Method::Head, "view.js") => {
                text("text/javascript; charset=utf-8", SCRIPT)
            }
            (Method::Get | Method::Head, "live.js") => {
                text("text/javascript; charset=utf-8", LIVE_SCRIPT)
            }
            (Method::Get | Method::Head, "scene") => {
                Answer::of("application/json", self.description.clone())
            }
            (_, path)
                if known.contains(&path)
                    || self.board.is_some() && known_of_training.contains(&path) =>
            {
                Answer::refusal(405, "this is asked for in another way")
            }
            _ => Answer::refusal(404, "there is nothing here"),
        }
    }

    fn frame(&self, wanted: Wanted) -> Answer {
        let begun = Instant::now();
        match self.desk.ask(wanted) {
            Ok(frame) => sent(frame, begun.elapsed()),
            Err(Unmade::Superseded) => {
                Answer::refusal(409, "a newer picture was asked for meanwhile")
            }
            Err(Unmade::Crowded) => Answer::refusal(503, "too many pages look at once; close some"),
            Err(Unmade::Failed(why)) => Answer::refusal(500, why),
            Err(Unmade::Over) => Answer::refusal(
                503,
                "no more pictures are made; start densify again when it has ended",
            ),
        }
    }
}

/// A picture, with what is known of it in the head: how long it took here too, waiting included, so that the page can
/// tell that from the way to it.
fn sent(frame: Frame, held: Duration) -> Answer {
    let Frame { jpeg, size: (width, height), range, mean, distance, measured, milliseconds } =
        frame;
    let mut answer = Answer::of("image/jpeg", jpeg)
        .with("X-Size", format!("{width}x{height}"))
        .with("X-Milliseconds", format!("{milliseconds:.1}"))
        .with("X-Held", format!("{:.1}", 1e3 * held.as_secs_f64()));
    if let Some(range) = range {
        answer = answer.with("X-Range", format!("{} {}", range.start, range.end));
    }
    if let Some([seen, all]) = measured {
        answer = answer.with("X-Measured", format!("{seen} {all}"));
    }
    let numbers = [("X-Mean", mean), ("X-Distance", distance)];
    for (name, value) in numbers.into_iter().filter_map(|(name, it)| Some((name, it?))) {
        answer = answer.with(name, value);
    }
    answer
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;
    use crate::door::Place;
    use crate::stage::{Shown, Stage};
    use densify_data::dataset::PointCloud;
    use densify_data::dataset::normalise::Normalisation;
    use densify_run::finished::Machine;

    #[test]
    fn only_what_is_built_in_is_served() {
        let door = Door::open(Place {
            host: Ipv4Addr::LOCALHOST.into(),
            port: Some(0),
            has_secret: false,
        })
        .unwrap();
        let none = || [Vec::new(), Vec::new()];
        let points = PointCloud::default();
        let (machine, place) = (Machine::default(), Normalisation::IDENTITY);
        let mut stage = Stage::new(machine, "a".into(), place, [0.0; 3], none(), points);
        stage.models.push(Shown {
            name: "a".into(),
            rows: 1,
            sh_degree: 0,
            near: 0.1,
            checkpoint: None,
        });
        let desk = Desk::new(None, 1);
        desk.close();
        let routes = Routes {
            door: &door,
            desk: &desk,
            extent: stage.extent(),
            description: Arc::from(*b"{}"),
            board: None,
        };
        let status = |request: &Request| routes.answer(request).status();
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
        let post = |path: &str, body: &str| {
            status(&Request {
                method: Method::Post,
                content_type: Some("application/json".into()),
                body: body.into(),
                ..Request::get(path, "localhost", None)
            })
        };
        assert_eq!(post("/scene", "{}"), 405);
        assert_eq!(post("/frame", "{}"), 400);
        let wish = r#"{"page": "a", "kind": "render", "width": 9, "height": 9, "camera":
            {"camera_to_world": [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1], "fov": 50}}"#;
        assert_eq!(post("/frame", wish), 503);
        // A run in training says more, and takes orders: those that there are.
        let board = Board::default();
        let live = Routes {
            door: &door,
            desk: &desk,
            extent: stage.extent(),
            description: Arc::from(*b"{}"),
            board: Some(&board),
        };
        let send = |body: &str| {
            live.answer(&Request {
                method: Method::Post,
                content_type: Some("application/json".into()),
                body: body.into(),
                ..Request::get("/order", "localhost", None)
            })
        };
        for (body, status) in [
            ("{}", 400),
            (r#"{"order": "explode"}"#, 400),
            (r#"{"order": "stop", "now": true}"#, 400),
            ("stop", 400),
        ] {
            assert_eq!(send(body).status(), status, "{body}");
        }
        assert!(!board.stops());
        assert_eq!(send(r#"{"order": "stop"}"#).status(), 200);
        assert!(board.stops(), "the order is not taken");
        let progress = live.answer(&Request::get("/progress", "localhost", None));
        let said: serde_json::Value = serde_json::from_slice(progress.body()).unwrap();
        assert_eq!(said["state"], "preparing");
        assert_eq!(live.answer(&Request::get("/order", "localhost", None)).status(), 405);
    }

    #[test]
    fn the_page_loads_nothing_of_others() {
        for text in [PAGE, STYLE, SCRIPT, LIVE_SCRIPT] {
            for word in ["http://", "https://", "//cdn", "@import", "eval("] {
                let strange = text.replace("http://www.w3.org/", "");
                assert!(!strange.contains(word), "{word}");
            }
        }
    }
}
