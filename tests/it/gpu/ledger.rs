//! What is allocated on a device is what the ledger says.

use densify::backend::gpu::GpuBackend;
use densify::backend::{Backend, Setup};
use densify::verify::scenes;
use densify_policies::policy::{Needs, Signal};

use crate::subject::{GREY, ways};

#[test]
fn what_is_allocated_is_what_the_ledger_says() {
    // A number of each pair for the error, and for attributes none.
    let asked: [(&[Signal], u64); 3] =
        [(&[], 9), (&[Signal::WeightedError], 10), (&[Signal::Position, Signal::Colour], 9)];
    for (device, (signals, numbers)) in ways().flat_map(|device| asked.map(|asked| (device, asked)))
    {
        let camera = scenes::camera(40, 30, 32);
        let model = scenes::cloud(20, 3, &camera, 42);
        let options = Setup {
            largest_image: (40, 30),
            tile_cap: Some(700),
            needs: Needs { signals: signals.iter().copied().collect(), ..Needs::default() },
            ..Setup::new(model.len())
        };
        let mut gpu = GpuBackend::new(&model, &options, device).expect("a small model fits");
        let promised = gpu.promised();
        let lines: u64 = gpu.ledger().lines.iter().map(|line| line.bytes).sum();
        assert_eq!((gpu.allocated(), lines), (promised, promised));
        assert_eq!(gpu.ledger().on_device(), promised);
        assert_eq!(&device.promise(model.sh_degree, &options), gpu.ledger());
        gpu.render(&camera, GREY, 1).expect("a rendering");
        assert_eq!(gpu.allocated(), promised);
        // Only slots take records.
        let of_pairs = gpu.ledger().lines.iter().filter(|line| line.what.contains("per entry"));
        let records: u64 = of_pairs.map(|line| line.bytes).sum();
        let is_in_slots = device.accumulation().is_deterministic();
        assert_eq!(records, if is_in_slots { 4 * numbers * 700 } else { 0 }, "{device:?}");
    }
}
