//! A small HTTP/1.1 server for one page and the few browsers that show it.
//!
//! `httparse` reads heads; the rest is here, because a server for strangers' requests must bound everything:
//! heads, bodies, connections, and the time that each may take. A connection has a thread with a small stack,
//! and there are few of them: where all seats are taken, whoever has waited longest without asking for
//! anything makes room. Knows nothing of what is served.

mod answer;
mod connections;
mod conversation;
mod head;

pub(super) use answer::Answer;
pub(super) use connections::{SEATS, serve};
pub(super) use head::{Method, Request};

#[cfg(test)]
mod tests;
