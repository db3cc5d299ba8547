//! Where numbers are hardest, on every adapter.

use densify::selftest::Bench;

use super::subjects;
use crate::extremes::check;

#[test]
fn every_case_holds_on_every_device() {
    for device in subjects() {
        check(&Bench::Gpu(device.clone()));
    }
}
