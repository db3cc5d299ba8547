//! Whole runs of every policy: as good as on the native backend, and as large.

use densify::backend::gpu::{GpuBackend, GpuOptions};

use super::subjects;
use crate::geometry::{Known, Run};

#[test]
fn every_policy_trains_as_it_does_natively() {
    let known = Known::new("spheres", 48, 400);
    for policy in ["vanilla", "taming", "diet", "mcmc", "igs"] {
        let run = Run { policy, set: "", budget: 900, iterations: 300, seed: 0 };
        let expected = known.train(run);
        // One driver: what differs between drivers, the twins have found, and runs take long.
        if let Some(device) = subjects().first() {
            let found = known.train_on(run, &|model, budget, near, needs| {
                let options = GpuOptions { near, needs, ..GpuOptions::new(budget) };
                Box::new(GpuBackend::new(model, &options, device).expect("a small model fits"))
            });
            let adapter = &device.adapter().name;
            let told = format!("{policy} on {adapter}: {found}\nnatively: {expected}");
            assert!((found.psnr - expected.psnr).abs() < 0.1, "{told}");
            assert!(found.rows.abs_diff(expected.rows) * 50 <= expected.rows, "{told}");
        }
    }
}
