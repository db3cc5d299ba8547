//! Where numbers are hardest, on every adapter.

use densify::selftest::Bench;

use super::ways;
use crate::extremes::check;

/// Cases that take software drivers a minute or more each; `densify selftest --gpu NAME 11 21 30`
/// runs them.
const SLOW: [u8; 3] = [11, 21, 30];

#[test]
fn every_case_holds_on_every_device() {
    for device in ways() {
        check(&Bench::Gpu(device.clone()), &SLOW);
    }
}
