//! Progress of training: a bar on a terminal, occasional lines elsewhere.

use std::fmt;
use std::io::{IsTerminal, stderr};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressState, ProgressStyle};

use super::console::Console;
use densify_core::numbers::{duration, grouped};

/// Interval between lines of progress if standard error is not a terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(30);
/// Interval between redraws of the bar.
const REDRAW_INTERVAL: Duration = Duration::from_millis(100);
/// Weight of the newest step in the displayed loss, which is smoothed because views differ.
const LOSS_SMOOTHING: f32 = 0.05;

/// Progress of a run.
pub(super) struct Progress<'a> {
    console: &'a Console,
    bar: Option<ProgressBar>,
    /// Steps done before this process resumed the run.
    done: u32,
    iterations: u32,
    budget: usize,
    started: Instant,
    drawn: Instant,
    loss: Option<f32>,
}

impl<'a> Progress<'a> {
    /// Progress from `done` steps towards `iterations`; silent on a quiet console.
    pub(super) fn new(console: &'a Console, done: u32, iterations: u32, budget: usize) -> Self {
        let bar = (!console.quiet && stderr().is_terminal()).then(|| {
            let style = ProgressStyle::with_template(
                "{bar:24.cyan/dim} {pos}/{len}  {speed}  {msg}  {eta} left",
            )
            .unwrap_or_else(|_| ProgressStyle::default_bar())
            .with_key("speed", |state: &ProgressState, out: &mut dyn fmt::Write| {
                // Writing to the bar's own buffer does not fail.
                let _ = write!(out, "{:.1} it/s", state.per_sec());
            });
            let bar = ProgressBar::new(u64::from(iterations)).with_style(style);
            let bar = console.bars.add(bar.with_position(u64::from(done)));
            bar.reset_eta();
            bar
        });
        let now = Instant::now();
        Self { console, bar, done, iterations, budget, started: now, drawn: now, loss: None }
    }

    /// Reports a completed step.
    pub(super) fn step(&mut self, step: u32, loss: f32, rows: usize) {
        let smooth = self.loss.map_or(loss, |before| before + LOSS_SMOOTHING * (loss - before));
        self.loss = Some(smooth);
        let text =
            || format!("loss {smooth:.4}  {} of {} Gaussians", grouped(rows), grouped(self.budget));
        if let Some(bar) = &self.bar {
            if self.drawn.elapsed() >= REDRAW_INTERVAL || step == self.iterations {
                bar.set_message(text());
                bar.set_position(u64::from(step));
                self.drawn = Instant::now();
            }
        } else if self.drawn.elapsed() >= LINE_INTERVAL || step == self.iterations {
            self.drawn = Instant::now();
            let elapsed = self.started.elapsed().as_secs_f64().max(1e-9);
            let speed = f64::from(step - self.done) / elapsed;
            let left = f64::from(self.iterations - step) / speed;
            self.console.progress(format_args!(
                "step {step}/{} ({} %)  {speed:.1} it/s  {}  {} left",
                self.iterations,
                u64::from(step) * 100 / u64::from(self.iterations),
                text(),
                duration(Duration::from_secs_f64(left)),
            ));
        }
    }

    /// Removes the bar.
    pub(super) fn finish(self) {
        if let Some(bar) = self.bar {
            bar.finish_and_clear();
        }
    }
}
