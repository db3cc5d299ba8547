//! A small HTTP/1.1 server for one page and a few browsers.
//!
//! `httparse` parses request heads. The rest is written here because requests from strangers must be bounded in every
//! respect: head, body, number of connections, and the time each may take. Every connection has a thread with a small
//! stack. When all permits are taken, the connection that has been idle longest is closed. This module does not know
//! what is served.

mod connection;
mod request;
mod response;
mod server;

pub(super) use request::{Method, Request};
pub(super) use response::Response;
pub(super) use server::{MAX_CONNECTIONS, serve};

#[cfg(test)]
mod tests;
