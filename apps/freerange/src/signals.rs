//! Ctrl-C, and the system's request to end.

use crate::error::CliError;

/// The signals, kept for the thread that waits for them. On other systems than Unix they end the program at once.
pub struct Signals;

#[cfg(unix)]
impl Signals {
    fn set() -> libc::sigset_t {
        // SAFETY: both calls initialize or change this set alone.
        unsafe {
            let mut set = std::mem::zeroed();
            libc::sigemptyset(&mut set);
            libc::sigaddset(&mut set, libc::SIGINT);
            libc::sigaddset(&mut set, libc::SIGTERM);
            set
        }
    }

    /// To be called before there are other threads, which take over what is set here.
    pub fn take() -> Self {
        // SAFETY: the set is initialized.
        unsafe {
            libc::pthread_sigmask(libc::SIG_BLOCK, &Self::set(), std::ptr::null_mut());
        }
        Self
    }

    /// Calls `begin_to_end` at the first; the second ends the program at once.
    ///
    /// # Errors
    /// Where no thread can be had.
    pub fn on_first(self, begin_to_end: impl FnOnce() + Send + 'static) -> Result<(), CliError> {
        let wait = || {
            let mut signal = 0;
            // SAFETY: both places are ours and initialized.
            unsafe { libc::sigwait(&Self::set(), &mut signal) };
            signal
        };
        let waits = move || {
            wait();
            begin_to_end();
            std::process::exit(128 + wait());
        };
        std::thread::Builder::new().name("signals".into()).spawn(waits).map(drop).map_err(CliError::failure)
    }
}

#[cfg(not(unix))]
impl Signals {
    pub fn take() -> Self {
        Self
    }

    pub fn on_first(self, _: impl FnOnce() + Send + 'static) -> Result<(), CliError> {
        Ok(())
    }
}
