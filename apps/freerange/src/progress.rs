//! Progress on standard error: a bar on a terminal, a line now and then in a log.

use std::{
    io::IsTerminal,
    time::{Duration, Instant},
};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// Time between two lines in a log.
const LINE_EVERY: Duration = Duration::from_secs(5);

/// The progress of one task.
pub struct Progress {
    bar: ProgressBar,
    label: String,
    total: u64,
    last_line: Instant,
}

impl Progress {
    /// A task of `total` steps.
    pub fn new(label: &str, total: u64) -> Self {
        let target = match std::io::stderr().is_terminal() {
            true => ProgressDrawTarget::stderr(),
            false => ProgressDrawTarget::hidden(),
        };
        let style =
            ProgressStyle::with_template("{prefix:>12} {bar:32} {pos}/{len} {eta} {msg}").expect("a valid template");
        let bar = ProgressBar::with_draw_target(Some(total), target).with_style(style).with_prefix(label.to_owned());
        Self { bar, label: label.into(), total, last_line: Instant::now() }
    }

    /// Prints a line on standard output without disturbing the bar.
    pub fn line(&self, text: &str) {
        self.bar.suspend(|| println!("{text}"));
    }

    /// The task turns out to have `total` steps.
    #[cfg(feature = "fetch")]
    pub fn of(&mut self, total: u64) {
        self.bar.set_length(total);
        self.total = total;
    }

    /// `done` steps are done; `message` says more.
    pub fn at(&mut self, done: u64, message: &str) {
        self.bar.set_position(done);
        self.bar.set_message(message.to_owned());
        // The first line waits too: quick tasks need none.
        if self.bar.is_hidden() && self.last_line.elapsed() >= LINE_EVERY {
            eprintln!("{}: {done}/{} {message}", self.label, self.total);
            self.last_line = Instant::now();
        }
    }

    /// The task is over: the bar goes away.
    pub fn finish(self) {
        self.bar.finish_and_clear();
    }
}

/// A task of one piece, whose end is not known before: on a terminal the time since it began, in a log one line.
pub struct Waiting(ProgressBar);

impl Waiting {
    /// Begins; `about` says how long it may take.
    pub fn new(label: &str, about: &str) -> Self {
        let bar = ProgressBar::new_spinner().with_prefix(label.to_owned()).with_message(about.to_owned());
        let style = ProgressStyle::with_template("{prefix:>12} {elapsed_precise} {msg}").expect("a valid template");
        bar.set_style(style);
        match bar.is_hidden() {
            true => eprintln!("{label}: {about}"),
            false => bar.enable_steady_tick(Duration::from_secs(1)),
        }
        Self(bar)
    }
}

impl Drop for Waiting {
    /// The task is over, well or not: the line goes away.
    fn drop(&mut self) {
        self.0.finish_and_clear();
    }
}
