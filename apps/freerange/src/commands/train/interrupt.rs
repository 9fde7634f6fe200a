//! What the user, or the system, wants of a run.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::Duration,
};

use crate::error::EXIT_CODE;

/// Among several ranks: for so long, besides two steps, what was asked to end may go on. A rank that waits for one that is
/// gone waits for ever, and launchers that end the others ask first.
const PATIENCE: Duration = Duration::from_secs(8);

/// Whether a run is asked to end, and whether it has heard.
#[derive(Default)]
pub struct Interrupt {
    asked: AtomicBool,    // to end
    stepping: AtomicBool, // there is something to save
    among: AtomicBool,    // several ranks
    heard: AtomicBool,    // by the run itself
    longest: AtomicU64,   // step so far, in milliseconds
}

impl Interrupt {
    /// At the first signal. Before there is anything to save, that ends the process.
    pub fn ask(self: Arc<Self>) {
        let end = || std::process::exit(EXIT_CODE.into());
        if !self.stepping.load(Ordering::Relaxed) {
            end();
        }
        self.end();
        eprintln!("asked to end: saving what was reached; once more ends at once");
        if self.among.load(Ordering::Relaxed) {
            std::thread::spawn(move || {
                std::thread::sleep(self.patience());
                if !self.heard.load(Ordering::Relaxed) {
                    eprintln!("the other ranks do not answer");
                    end();
                }
            });
        }
    }

    /// From now on there is something to save.
    pub fn begin(&self, ranks: usize) {
        self.among.store(ranks > 1, Ordering::Relaxed);
        self.stepping.store(true, Ordering::Relaxed);
    }

    /// Makes the run end in order.
    pub fn end(&self) {
        self.asked.store(true, Ordering::Relaxed);
    }

    pub fn is_asked(&self) -> bool {
        self.asked.load(Ordering::Relaxed)
    }

    /// The run ends by itself from here: it saves.
    pub fn heard(&self) {
        self.heard.store(true, Ordering::Relaxed);
    }

    /// Such a step was taken: others may take as long.
    pub fn stepped(&self, seconds: f64) {
        self.longest.fetch_max((1e3 * seconds) as u64, Ordering::Relaxed);
    }

    /// The step that runs when it is asked to end, and the next one, where the ranks hear of it.
    fn patience(&self) -> Duration {
        PATIENCE + 2 * Duration::from_millis(self.longest.load(Ordering::Relaxed))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_steps_are_waited_for() {
        let interrupt = Interrupt::default();
        assert_eq!(interrupt.patience(), PATIENCE);
        [12.5, 20.0, 3.0].iter().for_each(|&seconds| interrupt.stepped(seconds));
        assert_eq!(interrupt.patience(), Duration::from_secs(48));
    }
}
