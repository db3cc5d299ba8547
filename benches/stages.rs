//! Measures the time per training step and per stage on random scenes.
//!
//! Runs on one and on two threads, and on every adapter with each of its methods to add up gradients
//! (software adapters: small scenes only). `cargo bench --bench stages [-- ROWS@SIZE]`, such as
//! `10000@256` for one scene. Times are medians: processor time, which a loaded machine distorts little,
//! wall time, and the wall time of each stage.

#![expect(clippy::print_stdout, reason = "its output is a table")]

use std::hint::black_box;
use std::time::{Duration, Instant};

use cpu_time::ProcessTime;
use densify::backend::cpu::{CpuBackend, CpuOptions};
use densify::backend::gpu::{GpuBackend, GpuDevice, adapters};
use densify::backend::{
    AdapterChoice, AdapterKind, Backend, BackendError, BackendOptions, LearningRates, StepInput,
};
use densify::camera::Camera;
use densify::dataset::images::Image8;
use densify::gaussians::{Gaussians, sh_coefficients};
use densify_policies::policy::Cadence;
use glam::{DMat3, DVec3};
use pulp::{Arch, Simd, WithSimd};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A random cloud in front of the camera. Gaussians are smaller the more there are, so that the number of
/// tile entries per row is that of a trained scene: about 3 at 10,000 rows and 256², 2.7 at 50,000
/// rows and 512².
fn scene(rows: usize, sh_degree: u8) -> Gaussians {
    let mut rng = ChaCha8Rng::seed_from_u64(rows as u64);
    let mut uniform = |from: f32, to: f32| rng.random_range(from..to);
    let size = 0.0222 * (10_000.0 / rows as f32).powf(0.5);
    let mut model = Gaussians { sh_degree, ..Gaussians::default() };
    for _ in 0..rows {
        model.means.push([0, 1, 2].map(|_| uniform(-1.0, 1.0)));
        model.log_scales.push([0, 1, 2].map(|_| (size * uniform(0.3, 1.5)).ln()));
        model.quats.push([0, 1, 2, 3].map(|_| uniform(-1.0, 1.0)));
        model.opacity_logits.push(uniform(-2.0, 2.5));
        model.sh.extend((0..3 * sh_coefficients(sh_degree)).map(|_| uniform(-0.3, 0.5)));
    }
    model
}

fn camera(size: u32) -> Camera {
    let f = f64::from(size);
    Camera {
        width: size,
        height: size,
        fx: f,
        fy: f,
        cx: 0.5 * f,
        cy: 0.5 * f,
        rotation: DMat3::IDENTITY,
        translation: DVec3::new(0.0, 0.0, 3.0),
    }
}

fn target(size: u32) -> Image8 {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let rgb = (0..3 * size * size).map(|_| rng.random::<u8>()).collect();
    Image8 { width: size, height: size, rgb, alpha: None, mask: None }
}

fn median(mut times: Vec<Duration>) -> f64 {
    times.sort();
    times[times.len() / 2].as_secs_f64() * 1e3
}

/// Multiply-adds on twelve independent vectors: 1.5 times as many as two units of latency four need.
struct MultiplyAdds {
    rounds: u32,
}

impl WithSimd for MultiplyAdds {
    /// A sum, so that no work is optimised away, and the number of operations, two per multiply-add.
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

/// Peak performance of one thread: GFLOP/s, and GB/s read and written in place.
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

const RATES: LearningRates = LearningRates {
    mean: 1e-6,
    log_scale: 1e-6,
    quat: 1e-6,
    opacity: 1e-6,
    sh_dc: 1e-6,
    sh_rest: 1e-6,
};

/// Prints a line with medians over all steps but the first two.
fn measure(backend: Result<Box<dyn Backend>, BackendError>, rows: usize, size: u32, on: &str) {
    let mut backend = match backend {
        Ok(backend) => backend,
        Err(error) => {
            println!("{rows} rows on {on}: {error}");
            return;
        }
    };
    let (camera, target) = (camera(size), target(size));
    let (mut cpu, mut wall) = (Vec::new(), Vec::new());
    let mut stages: Vec<Vec<Duration>> = Vec::new();
    let steps = (6_000_000 / rows).clamp(7, 60) as u32;
    let mut entries = 0;
    for step in 1..=steps {
        let input = StepInput {
            step,
            view: 0,
            camera: &camera,
            target: &target,
            background: [0.0; 3],
            sh_degree: 3,
            rates: RATES,
            cadence: Cadence::default(),
            seed: 1,
        };
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
        .map(|(&(name, _), times)| format!("{name} {:.2}", median(times)))
        .collect();
    println!(
        "{rows:7} {size:5}² {entries:9} {on:>10} {:7.2} {:8.2}  {}",
        median(cpu),
        median(wall),
        line.join(", ")
    );
}

fn main() {
    let (flops, bytes) = peak();
    println!("one thread: peak of {flops:.0} GFLOP/s, {bytes:.0} GB/s read and written");
    let only: Vec<String> = std::env::args().skip(1).filter(|a| a.contains('@')).collect();
    let usable = adapters().into_iter().filter(|a| a.missing.is_empty());
    let mut devices: Vec<GpuDevice> = Vec::new();
    for adapter in usable {
        for method in adapter.accumulations {
            let name = Some(adapter.name.clone());
            devices
                .extend(GpuDevice::open(&AdapterChoice { name, accumulation: Some(method) }).ok());
        }
    }
    for (i, device) in devices.iter().enumerate() {
        let (adapter, method) = (device.adapter(), device.accumulation());
        println!("adapter {i}: {}, {}, accumulation={method}", adapter.name, adapter.driver);
    }
    println!("   rows  image   entries         on  CPU ms  wall ms  stages [ms]");
    for (rows, size) in [
        (10_000, 256),
        (10_000, 512),
        (50_000, 256),
        (50_000, 512),
        (200_000, 800),
        (1_000_000, 1024),
    ] {
        if !only.is_empty() && !only.contains(&format!("{rows}@{size}")) {
            continue;
        }
        let model = scene(rows, 3);
        for threads in [1, 2] {
            let options = CpuOptions {
                threads: Some(threads),
                largest_image: (size, size),
                tile_cap: rows * 8,
                ..CpuOptions::new(rows)
            };
            let backend = CpuBackend::new(&model, &options);
            let on = if threads == 1 { "1 thread" } else { "2 threads" };
            measure(backend.map(|b| Box::new(b) as Box<dyn Backend>), rows, size, on);
        }
        for (i, device) in devices.iter().enumerate() {
            if device.adapter().kind == AdapterKind::Software && rows > 50_000 {
                continue;
            }
            let options =
                BackendOptions { largest_image: (size, size), ..BackendOptions::new(rows) };
            let backend = GpuBackend::new(&model, &options, device);
            let on = format!("adapter {i}");
            measure(backend.map(|b| Box::new(b) as Box<dyn Backend>), rows, size, &on);
        }
    }
}
