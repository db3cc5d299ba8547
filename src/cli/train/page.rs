//! The live page of a run.

use std::net::Ipv4Addr;

use super::Follower;
use crate::console::Console;
use densify_run::failure::Failure;
use densify_run::{Occupied, Run};
pub(super) use densify_view::COMPANION;
use densify_view::{ListenAddress, Server};

/// Binds the port; 0 stands for the first free one.
pub(super) fn open(port: u16) -> Result<Server, Failure> {
    let port = (port != 0).then_some(port);
    Server::open(ListenAddress { host: Ipv4Addr::LOCALHOST.into(), port, needs_token: true })
}

/// Trains the run while serving its page.
pub(super) fn train(
    page: &Server,
    run: Run,
    occupied: Occupied,
    follower: &Follower<'_>,
    console: &Console,
) -> Result<(), Failure> {
    // The page is useless without its address, so even a quiet run prints the address.
    console.result(format_args!("page     {}", page.url()));
    page.follow(run, follower, |run, observer| run.train(occupied, observer).map(drop))
}
