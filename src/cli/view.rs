//! `densify view`: a model in the browser.

use std::net::{IpAddr, Ipv4Addr};
use std::path::PathBuf;

use clap::{ArgMatches, Args};

use super::console::Console;
use super::interrupt::Interrupts;
use super::render::{RenderingArgs, refuse_scene_options};
use super::threads::open_machine;
use densify_core::numbers::gaussians;
use densify_run::failure::Failure;
use densify_view as view;
use densify_view::{FIRST_PORT, ListenAddress, Server, ViewOptions};

/// Shows a model, or a scene, in the browser.
///
/// Serves a page on this machine, with the pictures that `densify render` makes: turn the model with mouse,
/// fingers or keys, visit the photographs' cameras, compare render and photograph, see depth, opacity,
/// and Gaussians coloured by their training statistics, and save a camera path for `densify render --path`.
/// Two runs are shown with a slider between them. Ctrl-C closes the page.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct ViewArgs {
    /// Folder that `densify train` wrote, a file of Gaussian splats, or a dataset (or scene:NAME), whose points are
    /// shown
    #[arg(value_name = "RUN|MODEL|SCENE")]
    path: PathBuf,
    /// Another run or model of the same scene, to compare with
    #[arg(value_name = "RUN|MODEL")]
    other: Option<PathBuf>,
    /// Folder or ZIP archive of the dataset: brings cameras and photographs to a file, and is needed for a run
    /// whose dataset has moved
    #[arg(long, value_name = "DIR")]
    scene: Option<PathBuf>,
    /// Saved iteration of the run `[default: the last]`
    #[arg(long, value_name = "N")]
    iteration: Option<u32>,
    /// Port of the page `[default: the first free one from 8080 on]`
    #[arg(long, value_name = "N", help_heading = "Page")]
    port: Option<u16>,
    /// Address of this machine to serve the page on. With an address other than loopback, such as 0.0.0.0, anyone on
    /// the network who knows the page's whole address, with its random part, can open it, too, unencrypted
    #[arg(long, value_name = "ADDRESS", default_value_t = Ipv4Addr::LOCALHOST.into(), help_heading = "Page")]
    host: IpAddr,
    #[command(flatten)]
    rendering: RenderingArgs,
}

const EXAMPLES: &str = "\
Options under Scene are for a model file or a scene; a run brings its own. To view the page from another
machine without --host, run there: ssh -L 8080:127.0.0.1:8080 NAME, where NAME is this machine, and open
http://127.0.0.1:8080/.

Examples:
  densify view output/garden-diet
  densify view output/garden-diet output/garden-mcmc
  densify view others.spz --scene data/garden --eval
  densify view scene:room --port 9000";

pub(super) fn run(args: &ViewArgs, matches: &ArgMatches, console: &Console) -> Result<(), Failure> {
    const _: () = assert!(FIRST_PORT == 8080, "the help says so");
    if view::is_run(&args.path) {
        refuse_scene_options(matches)?;
    }
    // Bind the port first: a failure then shows at once, although a model may take long to read.
    let address = ListenAddress { host: args.host, port: args.port, needs_token: false };
    let server = Server::open(address)?;
    let RenderingArgs { near, antialias, device, data } = &args.rendering;
    let machine = open_machine(device, console)?;
    let options = ViewOptions {
        path: &args.path,
        other: args.other.as_deref(),
        dataset: args.scene.clone(),
        iteration: args.iteration,
        near: *near,
        antialias: *antialias,
        data: data.clone(),
    };
    let scene = view::open(options, machine, console)?;
    for (name, rows) in scene.models() {
        console.say(format_args!("model    {name}: {}", gaussians(rows)));
    }
    // From here on, a signal ends the page cleanly instead of killing the process.
    let interrupts = Interrupts::listen();
    console.result(format_args!("page     {}", server.url()));
    if server.is_public() {
        console.say(
            "note: anyone who knows this address can open the page; on another machine, replace its host with the \
             name of this machine",
        );
    }
    console.say("         Ctrl-C ends it");
    server.serve(scene, &|| interrupts.received().is_some())
}
