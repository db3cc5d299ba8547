//! In place of the page of a run in training, in a program that was built without the feature `view`: its refusal.

use super::Follower;
use crate::cli::console::Console;
use crate::failure::Failure;
use crate::run::{Occupied, Run};
use crate::without::without;

/// Never made.
pub(super) enum Page {}

pub(super) fn open(_: u16) -> Result<Page, Failure> {
    Err(Failure::input(without("view", "--view")))
}

pub(super) fn train(
    page: &Page,
    _: Run,
    _: Occupied,
    _: &Follower<'_>,
    _: &Console,
) -> Result<(), Failure> {
    match *page {}
}
