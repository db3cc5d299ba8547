//! Where numbers are hardest, on every adapter. In slots: some cases want the same bits of two runs, which
//! sums by atomics do not have; `twins` and `oracle` hold those to the native backend and to the reference.

use densify::verify::Subject;

use super::subjects;
use crate::extremes::check;

/// Cases that take software drivers a minute or more each; `densify selftest --gpu NAME 11 21 30`
/// runs them.
const SLOW: [u8; 3] = [11, 21, 30];

#[test]
fn every_case_holds_on_every_device() {
    for device in subjects() {
        check(&Subject::Gpu(device.clone()), &SLOW);
    }
}
