//! Predicts the speed-up of a training step on many cores from the times that its tasks take on one core.
//!
//! A step consists of parallel regions, one after the other, and of serial work between them. In a
//! region, a core takes the next task as soon as it is free. Contention for memory and the cost of
//! waking cores are not modelled, so the predicted speed-ups are upper bounds.
//! `cargo bench --bench cores [-- ROWS@SIZE...]`: numbers of Gaussians, and sides of square images in px.

#![expect(clippy::print_stdout, reason = "the output is a table")]

mod steps;

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::time::Duration;

use densify::render::Backend;
use densify::render::Setup;
use densify::render::cpu::{CpuBackend, StepTasks};
use densify_policies::policy::{CandidateRequest, DepthMode, ErrorMode, Needs, Signal, SignalSet};

use steps::{median, ms};

/// Numbers of cores for which the speed-up is predicted.
const CORES: [usize; 2] = [16, 64];

/// Median times of a training step.
struct StepTimes {
    /// Time outside of all regions.
    serial: Duration,
    /// Name of each parallel region, and the times of its tasks in their order.
    regions: Vec<(&'static str, Vec<Duration>)>,
}

impl StepTimes {
    /// Medians over the steps with the same number of tasks in each region as the last step. The numbers vary,
    /// because they depend on the pixels selected as candidates.
    fn median(mut steps: Vec<StepTasks>) -> Self {
        let task_counts = |step: &StepTasks| -> Vec<usize> {
            step.regions.iter().map(|(_, tasks)| tasks.len()).collect()
        };
        let last = steps.last().map(task_counts);
        steps.retain(|step| Some(task_counts(step)) == last);
        let parallel = |step: &StepTasks| step.regions.iter().flat_map(|(_, tasks)| tasks).sum();
        let serial = |step: &StepTasks| step.total.saturating_sub(parallel(step));
        let regions = steps[0].regions.iter().enumerate();
        let median_task = |region: usize, task: usize| {
            median(steps.iter().map(|step| step.regions[region].1[task]).collect())
        };
        let medians = |region, count| (0..count).map(|task| median_task(region, task)).collect();
        Self {
            serial: median(steps.iter().map(serial).collect()),
            regions: regions.map(|(i, (name, tasks))| (*name, medians(i, tasks.len()))).collect(),
        }
    }

    fn total(&self) -> Duration {
        self.time_on(1)
    }

    /// Predicted time on `cores` cores.
    fn time_on(&self, cores: usize) -> Duration {
        self.serial + self.regions.iter().map(|(_, tasks)| schedule(tasks, cores)).sum::<Duration>()
    }
}

/// Time until all tasks are done, if each core takes the next one as soon as it is free.
fn schedule(tasks: &[Duration], cores: usize) -> Duration {
    let mut free: BinaryHeap<Reverse<Duration>> =
        (0..cores).map(|_| Reverse(Duration::ZERO)).collect();
    let mut last = Duration::ZERO;
    for &task in tasks {
        let Some(Reverse(start)) = free.pop() else { break };
        last = last.max(start + task);
        free.push(Reverse(start + task));
    }
    last
}

fn percent(part: Duration, whole: Duration) -> f64 {
    100.0 * part.as_secs_f64() / whole.as_secs_f64().max(1e-12)
}

/// Measures training steps on one thread. If a step fails, prints the error and returns `None`.
fn record(rows: usize, size: u32, needs: Needs) -> Option<StepTimes> {
    let options = Setup {
        threads: Some(1),
        largest_image: (size, size),
        tile_cap: Some(rows * 8),
        needs,
        ..Setup::new(rows)
    };
    let mut backend = match CpuBackend::new(&steps::scene(rows, 3), &options) {
        Ok(backend) => backend,
        Err(error) => {
            println!("{rows} rows: {error}");
            return None;
        }
    };
    backend.record_tasks();
    let (camera, target) = (steps::camera(size), steps::target(size));
    let mut steps = Vec::new();
    // With at least 17 steps, an interruption by the system does not affect a task's median.
    for step in 1..=steps::step_count(rows).max(17) {
        if let Err(error) = backend.train_step(&steps::input(step, &camera, &target)) {
            println!("{error}");
            return None;
        }
        if step > 2 {
            steps.push(backend.recorded_tasks());
        }
    }
    Some(StepTimes::median(steps))
}

/// Prints a table with one line per region name.
fn print_regions(step: &StepTimes) {
    let total = step.total();
    let mut names: Vec<&str> = Vec::new();
    for (name, _) in &step.regions {
        if !names.contains(name) {
            names.push(name);
        }
    }
    println!(
        "  region                runs  tasks       ms  share %  largest task %  \
         busy % on {CORES:?} cores"
    );
    for name in names {
        let regions = || step.regions.iter().filter(|region| region.0 == name);
        let tasks = || regions().flat_map(|region| &region.1);
        let time: Duration = tasks().sum();
        let largest = tasks().copied().max().unwrap_or_default();
        let busy = CORES.map(|cores| {
            let spent: Duration = regions().map(|region| schedule(&region.1, cores)).sum();
            format!("{:.0}", percent(time, spent) / cores as f64)
        });
        println!(
            "  {name:20} {:5} {:6} {:8.3} {:8.2} {:15.3}  {}",
            regions().count(),
            tasks().count(),
            ms(time),
            percent(time, total),
            percent(largest, total),
            busy.join(", ")
        );
    }
}

fn print_summary(step: &StepTimes, title: &str) {
    let total = step.total();
    let tasks = step.regions.iter().flat_map(|(name, tasks)| tasks.iter().map(move |t| (t, name)));
    let (largest, name) = tasks.max().map_or((Duration::ZERO, "none"), |(t, name)| (*t, name));
    let speed_ups = CORES.map(|cores| {
        format!("{:.1} on {cores}", total.as_secs_f64() / step.time_on(cores).as_secs_f64())
    });
    println!(
        "{title}: {:.2} ms; serial {:.3} ms, {:.3} %; largest task {:.3} % ({name}); \
         {} regions; speed-up of at most {} cores",
        ms(total),
        ms(step.serial),
        percent(step.serial, total),
        percent(largest, total),
        step.regions.len(),
        speed_ups.join(", ")
    );
}

/// The needs of a policy that uses per-pixel errors and candidates at every step.
fn largest_needs(rows: usize) -> Needs {
    let candidates = CandidateRequest {
        from: 0,
        until: u32::MAX,
        rows_per_candidate: 3000,
        capacity: rows,
        error: ErrorMode::L1Dssim,
        depth: DepthMode::MaxWeight,
        min_alpha: 0.5,
        spaced: true,
    };
    let signals = [Signal::ScreenGradient, Signal::WeightedError];
    Needs { signals: SignalSet::from(signals), candidates: Some(candidates), ..Needs::default() }
}

fn main() {
    let size_of = |arg: String| {
        let (rows, size) = arg.split_once('@')?;
        Some((rows.parse().ok()?, size.parse().ok()?))
    };
    let mut sizes: Vec<(usize, u32)> = std::env::args().filter_map(size_of).collect();
    if sizes.is_empty() {
        sizes = vec![(50_000, 512), (1_000_000, 1024)];
    }
    for (rows, size) in sizes {
        if let Some(step) = record(rows, size, Needs::default()) {
            print_summary(&step, &format!("{rows}@{size}"));
            print_regions(&step);
        }
        if let Some(step) = record(rows, size, largest_needs(rows)) {
            print_summary(&step, &format!("{rows}@{size}, candidates and per-pixel errors"));
        }
    }
}
