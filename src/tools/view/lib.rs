//! `densify view`: a web page with pictures of a model, rendered on this machine by the training backend.
//!
//! One thread owns the models; for a run in training (`live`) it is the training thread. HTTP connections put picture
//! requests into the `render_queue`, which keeps only the newest request of each pane of a page. The model thread
//! renders them (`render`); a second thread turns the renderings into JPEGs (`encoder`). Every request is validated
//! first (`listener`, `picture_request`), and no file is ever served from the disk. Prints nothing.

mod colour_map;
mod description;
mod encoder;
mod http;
mod listener;
mod live;
mod open;
mod picture_kind;
mod picture_request;
mod render;
mod render_queue;
mod routes;
mod row_colours;
mod row_measurements;
mod run_status;
mod scene;

use std::thread;

pub use listener::{FIRST_PORT, ListenAddress, Server};
pub use live::COMPANION;
pub use open::{ViewOptions, is_run, open};
use render::ModelCache;
use render_queue::{CloseOnDrop, RenderQueue};
use routes::Routes;
use scene::LoadedScene;

use densify_run::failure::{Failure, OTHER};

/// Maximum number of pictures in progress: one is rendered while another is encoded.
const MAX_ACTIVE: usize = 2;

impl Server {
    /// Serves the page until `is_over` returns true.
    ///
    /// # Errors
    /// If the network or the renderer fails.
    pub fn serve(&self, loaded: LoadedScene, is_over: &dyn Fn() -> bool) -> Result<(), Failure> {
        let LoadedScene { mut scene, mut backends } = loaded;
        let queue = RenderQueue::new(None, MAX_ACTIVE);
        let description = description::describe(&mut scene);
        let routes =
            Routes { listener: self, queue: &queue, scene: &scene, description, run_status: None };
        let failed = |message: String| Failure::new(OTHER, message);
        thread::scope(|scope| {
            let (queue, scene) = (&queue, &scene);
            let encoder = encoder::start(scope, queue, scene)
                .map_err(|error| failed(format!("the system cannot start a thread: {error}")))?;
            let renderer = scope.spawn(move || {
                let _close = CloseOnDrop(queue);
                let mut caches: Vec<ModelCache> =
                    backends.iter().map(|_| ModelCache::default()).collect();
                while let Some(job) = queue.next() {
                    let (request, model) = (&job.request, job.request.model);
                    let backend = &mut *backends[model];
                    let rendered = render::render(scene, backend, &mut caches[model], request);
                    queue.finish_rendering(job, rendered);
                }
            });
            let respond = |request: &http::Request| routes.respond(request);
            // Closing the queue answers the waiting requests; their connections would stay open otherwise.
            let stops = || {
                let stops = is_over() || renderer.is_finished();
                if stops {
                    queue.close();
                }
                stops
            };
            let served = http::serve(&self.socket, &respond, &stops);
            queue.close();
            let rendered = renderer.join().and(encoder.join());
            served.map_err(|error| failed(format!("the page can no longer be served: {error}")))?;
            rendered.map_err(|_| failed("rendering for the page failed; this is a bug".into()))
        })
    }
}
