//! Measures the time per training step and per stage on random scenes.
//!
//! The CPU backend runs on one, two and all threads, the GPU backend on every adapter with each of its methods of
//! accumulating gradients (software adapters: small scenes only). `cargo bench --bench stages [-- ROWS@SIZE] [avx2]`:
//! `10000@256` selects the scene of 10,000 Gaussians and 256² px; `avx2` limits the CPU backend to AVX2. Times are
//! medians: CPU time (which depends little on the load of the machine), wall time, and the wall time of each stage.

#![expect(clippy::print_stdout, reason = "the output is a table")]

mod steps;

use std::hint::black_box;
use std::time::{Duration, Instant};

use cpu_time::ProcessTime;
use densify::render::cpu::{CpuBackend, InstructionSet};
use densify::render::gpu::{GpuBackend, GpuDevice, adapters};
use densify::render::{AdapterChoice, AdapterKind, Backend, BackendError, Setup};
use pulp::{Arch, Simd, WithSimd};
use steps::{median, ms};

/// Multiply-adds on twelve independent vectors. Two execution units with a latency of four cycles need at least
/// eight such vectors to stay busy.
struct MultiplyAdds {
    rounds: u32,
}

impl WithSimd for MultiplyAdds {
    /// A sum, which prevents the work from being optimised away, and the number of operations, two per
    /// multiply-add.
    type Output = (f32, f64);

    #[inline(always)]
    fn with_simd<S: Simd>(self, s: S) -> (f32, f64) {
        let (a, b) = (s.splat_f32s(black_box(0.993)), s.splat_f32s(black_box(0.37)));
        let mut sums = [s.splat_f32s(1.0); 12];
        for _ in 0..self.rounds {
            for sum in &mut sums {
                *sum = s.mul_add_e_f32s(*sum, a, b);
            }
        }
        let total = sums.iter().map(|&sum| s.reduce_sum_f32s(sum)).sum();
        (total, 2.0 * (S::F32_LANES * sums.len()) as f64 * f64::from(self.rounds))
    }
}

/// Peak performance of one thread: arithmetic in GFLOP/s, and memory traffic in GB/s when updating an array in place.
fn peak() -> (f64, f64) {
    let mut rates = (0.0_f64, 0.0_f64);
    let mut memory = vec![1.0_f32; 32 << 20];
    for _ in 0..5 {
        let start = ProcessTime::now();
        let (sum, operations) = Arch::new().dispatch(MultiplyAdds { rounds: 5_000_000 });
        rates.0 = rates.0.max(operations / start.elapsed().as_secs_f64() * 1e-9);
        black_box(sum);
        let start = ProcessTime::now();
        for x in &mut memory {
            *x = *x * 0.999 + 0.1;
        }
        let bytes = 2.0 * size_of_val(&memory[..]) as f64;
        rates.1 = rates.1.max(bytes / start.elapsed().as_secs_f64() * 1e-9);
        black_box(&mut memory);
    }
    rates
}

/// Measures training steps, and prints a line of medians over all steps except the first two.
fn measure(backend: Result<Box<dyn Backend>, BackendError>, rows: usize, size: u32, device: &str) {
    let mut backend = match backend {
        Ok(backend) => backend,
        Err(error) => {
            println!("{rows} rows on {device}: {error}");
            return;
        }
    };
    let (camera, target) = (steps::camera(size), steps::target(size));
    let (mut cpu, mut wall) = (Vec::new(), Vec::new());
    let mut stages: Vec<Vec<Duration>> = Vec::new();
    let steps = steps::step_count(rows);
    let mut entries = 0;
    for step in 1..=steps {
        let input = steps::input(step, &camera, &target);
        let (start, cpu_start) = (Instant::now(), ProcessTime::now());
        match backend.train_step(&input) {
            Ok(output) => entries = output.entries,
            Err(error) => println!("{error}"),
        }
        if step > 2 {
            cpu.push(cpu_start.elapsed());
            wall.push(start.elapsed());
            for (i, &(_, time)) in backend.stage_times().iter().enumerate() {
                stages.resize(stages.len().max(i + 1), Vec::new());
                stages[i].push(time);
            }
        }
    }
    let line: Vec<String> = backend
        .stage_times()
        .iter()
        .zip(stages)
        .map(|(&(name, _), times)| format!("{name} {:.2}", ms(median(times))))
        .collect();
    println!(
        "{rows:7} {size:5}² {entries:9} {device:>10} {:7.2} {:8.2}  {}",
        ms(median(cpu)),
        ms(median(wall)),
        line.join(", ")
    );
}

fn main() {
    let (flops, bytes) = peak();
    println!("one thread: peak of {flops:.0} GFLOP/s, {bytes:.0} GB/s read and written");
    let selected: Vec<String> = std::env::args().skip(1).filter(|a| a.contains('@')).collect();
    let avx2 = std::env::args().any(|arg| arg == "avx2");
    let instructions = if avx2 { InstructionSet::Avx2 } else { InstructionSet::Best };
    let usable = adapters().into_iter().filter(|a| a.missing.is_empty());
    let mut devices: Vec<(GpuDevice, &str)> = Vec::new();
    for adapter in usable {
        for method in adapter.accumulations {
            let choice =
                AdapterChoice { name: Some(adapter.name.clone()), accumulation: Some(method) };
            devices.extend(GpuDevice::open(&choice).map(|device| (device, "")).ok());
            let timed = GpuDevice::open_with_clock(&choice).ok();
            devices.extend(timed.map(|device| (device, ", timed per stage, which takes longer")));
        }
    }
    for (i, (device, note)) in devices.iter().enumerate() {
        let (adapter, method) = (device.adapter(), device.accumulation());
        println!("adapter {i}: {}, {}, accumulation={method}{note}", adapter.name, adapter.driver);
    }
    let all = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let mut thread_counts = vec![1, 2];
    if all > 2 {
        thread_counts.push(all);
    }
    println!("   rows  image   entries     device  CPU ms  wall ms  stages [ms]");
    for (rows, size) in [
        (10_000, 256),
        (10_000, 512),
        (50_000, 256),
        (50_000, 512),
        (200_000, 800),
        (1_000_000, 1024),
    ] {
        if !selected.is_empty() && !selected.contains(&format!("{rows}@{size}")) {
            continue;
        }
        let model = steps::scene(rows, 3);
        for &threads in &thread_counts {
            let options = Setup {
                instructions,
                threads: Some(threads),
                largest_image: (size, size),
                tile_cap: Some(rows * 8),
                ..Setup::new(rows)
            };
            let backend = CpuBackend::new(&model, &options);
            let name = if threads == 1 { "1 thread".into() } else { format!("{threads} threads") };
            measure(backend.map(|b| Box::new(b) as Box<dyn Backend>), rows, size, &name);
        }
        for (i, (device, _)) in devices.iter().enumerate() {
            if device.adapter().kind == AdapterKind::Software && rows > 50_000 {
                continue;
            }
            let options = Setup { largest_image: (size, size), ..Setup::new(rows) };
            let backend = GpuBackend::new(&model, &options, device);
            let name = format!("adapter {i}");
            measure(backend.map(|b| Box::new(b) as Box<dyn Backend>), rows, size, &name);
        }
    }
}
