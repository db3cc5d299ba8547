//! Replaces the live page of a run if the program was built without the feature `view`: `--view` is refused.

use super::Follower;
use crate::console::Console;
use crate::without::without;
use densify_run::failure::Failure;
use densify_run::{Companion, Occupied, Run};

/// Never used, because [`open`] fails first.
pub(super) const COMPANION: Companion = Companion { reserve: |_, _| {}, points: 0 };

/// Never constructed.
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
