//! Compares the memory allocated on a device with the ledger.

use densify::render::gpu::GpuBackend;
use densify::render::{Backend, Setup};
use densify::selftest::scenes;
use densify_policies::policy::{AuxColumn, AuxRequest, ErrorScore, MaskTerm, Needs, Signal};

use crate::subject::{BLUE, devices_by_accumulation};

#[test]
fn device_allocations_match_the_ledger() {
    let needs = |signals: &[Signal]| Needs {
        signals: signals.iter().copied().collect(),
        ..Needs::default()
    };
    let mask = MaskTerm { start: 1.0, rate: 0.01, weight: 5e-4, threshold: 0.01 };
    let columns = vec![AuxColumn::PixelCount, AuxColumn::MapSum];
    // The numbers per gradient record: nine, one more for the error, another for the weight of scores, and, below,
    // another for depth in the loss.
    let cases = [
        (needs(&[]), 9),
        (needs(&[Signal::WeightedError]), 10),
        (needs(&[Signal::Position, Signal::Colour]), 9),
        (needs(&[Signal::DominantPixels]), 9),
        (Needs { mask: Some(mask), ..needs(&[Signal::Mask]) }, 9),
        (
            Needs {
                error_score: ErrorScore { edge: 1.0, ..ErrorScore::default() },
                ..needs(&[Signal::ErrorScore])
            },
            11,
        ),
        (
            Needs {
                aux: Some(AuxRequest { columns, points: 3, ..AuxRequest::default() }),
                ..needs(&[])
            },
            9,
        ),
    ];
    let both = cases
        .iter()
        .flat_map(|(needs, numbers)| [(needs, *numbers, false), (needs, *numbers + 1, true)]);
    let both: Vec<_> = both.collect();
    for (device, &(needs, numbers, depth)) in
        devices_by_accumulation().flat_map(|device| both.iter().map(move |case| (device, case)))
    {
        let camera = scenes::camera(40, 30, 32);
        let model = scenes::cloud(20, 3, &camera, 42);
        let options = Setup {
            largest_image: (40, 30),
            tile_cap: Some(700),
            needs: needs.clone(),
            depth,
            ..Setup::new(model.len())
        };
        let mut gpu = GpuBackend::new(&model, &options, device).expect("a small model fits");
        let promised = gpu.planned_bytes();
        assert_eq!(gpu.allocated_bytes(), promised);
        // Beyond the buffers: uploads of 4 MiB, which with 1 MiB of copies to the host may leave as much of their blocks
        // unused, and three blocks of 4 MiB.
        assert_eq!(gpu.ledger().on_device(), promised + ((4 + 5 + 12) << 20));
        let has_host_parts = needs.aux.is_some() || needs.error_score.edge > 0.0 || depth;
        assert_eq!(gpu.ledger().on_host() > 0, has_host_parts, "{needs:?}");
        assert_eq!(&device.memory_plan(model.sh_degree, &options), gpu.ledger());
        gpu.render(&camera, BLUE, 1).expect("a rendering");
        assert_eq!(gpu.allocated_bytes(), promised);
        let given = gpu.ledger().lines.iter().find(|line| line.what == "given depth on the device");
        assert_eq!(given.map(|line| line.bytes), depth.then_some(4 * 40 * 30));
        // Only accumulation in slots needs records.
        let record_lines = gpu.ledger().lines.iter().filter(|line| line.what.contains("per entry"));
        let record_bytes: u64 = record_lines.map(|line| line.bytes).sum();
        let is_in_slots = device.accumulation().is_deterministic();
        assert_eq!(
            record_bytes,
            if is_in_slots { 4 * numbers * 700 } else { 0 },
            "{:?}, {needs:?}",
            device.accumulation()
        );
    }
}
