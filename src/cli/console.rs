//! Standard output and standard error, with progress bars below the last line.

use std::cell::RefCell;
use std::fmt;
use std::io::{self, IsTerminal, Write};

use indicatif::MultiProgress;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

use densify_core::files;
use densify_core::spelling::Spelling;
use densify_run::Observer;
use densify_run::failure::{Failure, OTHER};

/// Default filter of the log; `RUST_LOG` overrides it.
const LOG_FILTER: &str = "warn,densify=info,densify_policies=info";

/// The output of a command.
#[derive(Debug)]
pub(super) struct Console {
    /// True if only results and errors are shown.
    pub(super) quiet: bool,
    /// The progress bars; lines are printed above them.
    pub(super) bars: MultiProgress,
    /// The first error in writing to standard output.
    broken: RefCell<Option<io::Error>>,
}

impl Console {
    /// A console for this process. Also sets up the log.
    pub(super) fn new(quiet: bool) -> Self {
        let bars = MultiProgress::new();
        let wanted = std::env::var("RUST_LOG").ok().filter(|_| !quiet);
        let (filter, mistake) = match wanted.map(|text| text.parse::<Targets>()) {
            Some(Err(mistake)) => (None, Some(mistake)),
            parsed => (parsed.and_then(Result::ok), None),
        };
        let default = if quiet { "error" } else { LOG_FILTER };
        let filter = filter.or_else(|| default.parse().ok()).unwrap_or_default();
        let log_bars = bars.clone();
        let lines = tracing_subscriber::fmt::layer()
            .with_writer(move || LogLine(log_bars.clone()))
            .with_ansi(io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none())
            .with_target(false)
            .without_time();
        // Keeps the log of a host program that has set one up.
        let _ = tracing_subscriber::registry().with(lines).with(filter).try_init();
        if let Some(mistake) = mistake {
            tracing::warn!("RUST_LOG is ignored: {mistake}; give a level, or TARGET=LEVEL,…");
        }
        Self { quiet, bars, broken: RefCell::new(None) }
    }

    /// Prints a line of information on standard output; nothing when quiet.
    pub(super) fn say(&self, line: impl fmt::Display) {
        if !self.quiet {
            self.result(line);
        }
    }

    /// Prints a result on standard output.
    pub(super) fn result(&self, line: impl fmt::Display) {
        let written = self.bars.suspend(|| {
            let mut out = io::stdout().lock();
            writeln!(out, "{}", files::multi_line(&line.to_string())).and_then(|()| out.flush())
        });
        match written {
            // A closed pipe is not a failure.
            Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
                self.broken.borrow_mut().get_or_insert(error);
            }
            _ => {}
        }
    }

    /// Fails if a line could not be written.
    pub(super) fn finish(&self) -> Result<(), Failure> {
        self.broken.take().map_or(Ok(()), |error| {
            Err(Failure::new(OTHER, format!("cannot write to standard output: {error}")))
        })
    }

    /// Prints a line of progress on standard error; nothing when quiet.
    pub(super) fn progress(&self, line: impl fmt::Display) {
        if !self.quiet {
            let _ = writeln!(io::stderr().lock(), "{line}");
        }
    }

    /// Prints an error on standard error.
    pub(super) fn error(&self, failure: &Failure) {
        let message = files::multi_line(&failure.words(Spelling::Terminal));
        self.bars.suspend(|| {
            let _ = writeln!(io::stderr().lock(), "error: {message}");
        });
    }
}

impl Observer for Console {
    fn say(&self, line: fmt::Arguments<'_>) {
        self.say(line);
    }
}

/// One line of the log, written above the bars.
struct LogLine(MultiProgress);

impl Write for LogLine {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        self.0.suspend(|| {
            let _ = io::stderr().lock().write_all(line);
        });
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
