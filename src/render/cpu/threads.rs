//! The thread pool of the native backend. Each parallel loop is a *region*: it has a name and is split into tasks at
//! fixed places. On one thread the durations of tasks can be recorded, from which the benchmark estimates the time
//! of a step on many cores.

use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use rayon::prelude::*;

use crate::BackendError;

/// The thread pool, and the recorder of its tasks once recording has started.
#[derive(Debug)]
pub(super) struct Threads {
    pool: rayon::ThreadPool,
    recorder: OnceLock<Recorder>,
}

/// The durations of a training step on one thread.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct StepTasks {
    /// The whole step.
    pub total: Duration,
    /// The tasks of each region, in the order of execution. The rest of `total` is serial at any number of threads.
    pub regions: Vec<(&'static str, Vec<Duration>)>,
}

#[derive(Debug, Default)]
struct Recorder(Mutex<Recording>);

/// The recording of one step. Its vectors are reused, as allocations would distort the durations.
#[derive(Debug, Default)]
struct Recording {
    total: Duration,
    /// The name of each region and the index of its first task.
    regions: Vec<(&'static str, usize)>,
    tasks: Vec<Duration>,
    /// The end of the last task, or the start of the region.
    last: Option<Instant>,
}

impl Threads {
    /// Starts `count` threads; `None` means one per core.
    pub(super) fn new(count: Option<usize>) -> Result<Self, BackendError> {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(count.unwrap_or(0))
            .thread_name(|i| format!("densify-{i}"))
            .build()
            .map_err(|error| BackendError::Threads(error.to_string()))?;
        Ok(Self { pool, recorder: OnceLock::new() })
    }

    pub(super) fn count(&self) -> usize {
        self.pool.current_num_threads()
    }

    /// Starts recording.
    pub(super) fn start_recording(&self) {
        assert_eq!(self.count(), 1, "tasks are recorded on one thread");
        self.recorder.get_or_init(Recorder::default);
    }

    /// The tasks of the last step; empty unless they are recorded.
    pub(super) fn recorded(&self) -> StepTasks {
        self.recorder.get().map(Recorder::tasks).unwrap_or_default()
    }

    /// Runs a whole step on a thread of the pool, so that its regions need not be submitted to the pool one by one.
    pub(super) fn step<R: Send>(&self, run: impl FnOnce() -> R + Send) -> R {
        self.install(|| {
            let Some(recorder) = self.recorder.get() else { return run() };
            let start = recorder.begin_step();
            let result = run();
            recorder.end_step(start);
            result
        })
    }

    /// Runs code that contains regions on a thread of the pool.
    pub(super) fn install<R: Send>(&self, run: impl FnOnce() -> R + Send) -> R {
        self.pool.install(run)
    }

    /// Runs a region.
    pub(super) fn each<T>(
        &self,
        region: &'static str,
        tasks: T,
        run: impl Fn(T::Item) + Send + Sync,
    ) where
        T: IntoParallelIterator<Iter: IndexedParallelIterator>,
    {
        self.each_with(region, tasks, || (), |(), task| run(task));
    }

    /// Runs a region whose tasks need scratch memory, which successive tasks share.
    pub(super) fn each_with<T, S>(
        &self,
        region: &'static str,
        tasks: T,
        scratch: impl Fn() -> S + Send + Sync,
        run: impl Fn(&mut S, T::Item) + Send + Sync,
    ) where
        T: IntoParallelIterator<Iter: IndexedParallelIterator>,
    {
        let tasks = tasks.into_par_iter();
        let recorder = self.begin(region, tasks.len());
        tasks.for_each_init(scratch, |scratch, task| timed(recorder, || run(scratch, task)));
    }

    /// Runs a region and collects the results of its tasks in order.
    pub(super) fn collect<T, R: Send>(
        &self,
        region: &'static str,
        tasks: T,
        run: impl Fn(T::Item) -> R + Send + Sync,
    ) -> Vec<R>
    where
        T: IntoParallelIterator<Iter: IndexedParallelIterator>,
    {
        self.collect_with(region, tasks, || (), |(), task| run(task))
    }

    /// Runs a region with scratch memory and collects the results.
    pub(super) fn collect_with<T, S, R: Send>(
        &self,
        region: &'static str,
        tasks: T,
        scratch: impl Fn() -> S + Send + Sync,
        run: impl Fn(&mut S, T::Item) -> R + Send + Sync,
    ) -> Vec<R>
    where
        T: IntoParallelIterator<Iter: IndexedParallelIterator>,
    {
        let tasks = tasks.into_par_iter();
        let recorder = self.begin(region, tasks.len());
        tasks.map_init(scratch, |scratch, task| timed(recorder, || run(scratch, task))).collect()
    }

    /// Runs a region and adds up the counts that its tasks return; integer sums do not depend on order.
    pub(super) fn sum<T>(
        &self,
        region: &'static str,
        tasks: T,
        run: impl Fn(T::Item) -> usize + Send + Sync,
    ) -> usize
    where
        T: IntoParallelIterator<Iter: IndexedParallelIterator>,
    {
        let tasks = tasks.into_par_iter();
        let recorder = self.begin(region, tasks.len());
        tasks.map(|task| timed(recorder, || run(task))).sum()
    }

    /// Begins a region; returns the recorder of its tasks, if recording has started.
    fn begin(&self, region: &'static str, tasks: usize) -> Option<&Recorder> {
        self.recorder.get().inspect(|recorder| recorder.begin_region(region, tasks))
    }
}

/// Runs a task, and records its end.
fn timed<R>(recorder: Option<&Recorder>, run: impl FnOnce() -> R) -> R {
    let result = run();
    if let Some(recorder) = recorder {
        recorder.end_task();
    }
    result
}

impl Recorder {
    fn lock(&self) -> MutexGuard<'_, Recording> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn begin_step(&self) -> Instant {
        let mut recording = self.lock();
        recording.regions.clear();
        recording.tasks.clear();
        Instant::now()
    }

    fn end_step(&self, start: Instant) {
        self.lock().total = start.elapsed();
    }

    fn begin_region(&self, region: &'static str, tasks: usize) {
        let mut recording = self.lock();
        let first = recording.tasks.len();
        recording.regions.push((region, first));
        recording.tasks.reserve(tasks);
        recording.last = Some(Instant::now());
    }

    /// Reads the clock once per task, so that the time between two tasks counts as part of the second. It is the wall
    /// clock, as reading processor time takes twenty times as long.
    fn end_task(&self) {
        let mut recording = self.lock();
        let now = Instant::now();
        let task = recording.last.replace(now).map_or(Duration::ZERO, |last| now - last);
        recording.tasks.push(task);
    }

    fn tasks(&self) -> StepTasks {
        let recording = self.lock();
        let mut rest = &recording.tasks[..];
        let mut regions: Vec<_> = recording
            .regions
            .iter()
            .rev()
            .map(|&(name, first)| {
                let (before, tasks) = rest.split_at(first);
                rest = before;
                (name, tasks.to_vec())
            })
            .collect();
        regions.reverse();
        StepTasks { total: recording.total, regions }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recording_lists_tasks_by_region_and_changes_no_results() {
        let threads = Threads::new(Some(1)).expect("a thread");
        let run = || {
            threads.step(|| {
                let mut squares = [0; 3];
                threads.each("each", squares.par_iter_mut().enumerate(), |(i, to)| *to = i * i);
                let doubled = threads.collect("collect", 0..2, |i| 2 * i);
                let sum = threads.sum("sum", 0..5_usize, |i| i);
                threads.each("nothing", 0..0, |_| {});
                (squares, doubled, sum)
            })
        };
        let expected = ([0, 1, 4], vec![0, 2], 10);
        assert_eq!(run(), expected);
        assert_eq!(threads.recorded(), StepTasks::default());
        threads.start_recording();
        for _ in 0..2 {
            assert_eq!(run(), expected);
            let StepTasks { total, regions } = threads.recorded();
            let counts: Vec<_> = regions.iter().map(|(name, tasks)| (*name, tasks.len())).collect();
            assert_eq!(counts, [("each", 3), ("collect", 2), ("sum", 5), ("nothing", 0)]);
            assert!(regions.iter().flat_map(|(_, tasks)| tasks).sum::<Duration>() <= total);
        }
    }
}
