//! Where numbers are hardest, on every adapter.

use densify::selftest::Bench;

use super::ways;
use crate::extremes::check;

/// Cases that take software drivers a minute or more each; `densify selftest --gpu NAME 11 21 30`
/// runs them.
const SLOW: [u8; 3] = [11, 21, 30];

/// Cases that want the same bits of two runs, which sums by atomics do not have, and one of 100,000 rows
/// in a tile, which is beyond the rounds of loops that llvmpipe grants these kernels.
const IN_SLOTS: [u8; 3] = [13, 15, 26];

#[test]
fn every_case_holds_on_every_device() {
    for device in ways() {
        let is_in_slots = device.accumulation().is_deterministic();
        let but = if is_in_slots { SLOW.to_vec() } else { [SLOW, IN_SLOTS].concat() };
        check(&Bench::Gpu(device.clone()), &but);
    }
}
