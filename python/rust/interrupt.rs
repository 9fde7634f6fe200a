//! Ctrl-C while something computes that reports nothing.

use std::{
    panic::resume_unwind,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
        mpsc::{self, RecvTimeoutError},
    },
    thread,
    time::Duration,
};

use freerange::Stop;
use pyo3::{exceptions::PyRuntimeError, prelude::*};

/// How often Ctrl-C is looked for.
const SIGNALS: Duration = Duration::from_millis(50);
/// As the main thread's.
const STACK: usize = 8 << 20;

/// The result of `work`, which runs in a thread of its own while others have the interpreter. Ctrl-C ends the wait at
/// once; the work then ends as soon as it looks at its [`Stop`].
pub fn interruptible<T: Send + 'static>(py: Python<'_>, work: impl FnOnce(&Stop) -> T + Send + 'static) -> PyResult<T> {
    let flag = Arc::<AtomicBool>::default();
    let stop = Stop::on(flag.clone(), None);
    let (done, result) = mpsc::channel();
    let run = move || drop(done.send(work(&stop)));
    let thread = thread::Builder::new().stack_size(STACK).spawn(run)?;
    py.detach(move || {
        loop {
            match result.recv_timeout(SIGNALS) {
                Ok(result) => return Ok(result),
                Err(RecvTimeoutError::Timeout) => {
                    if let Err(interrupt) = Python::attach(|py| py.check_signals()) {
                        flag.store(true, Relaxed);
                        return Err(interrupt);
                    }
                }
                Err(RecvTimeoutError::Disconnected) => match thread.join() {
                    Err(panic) => resume_unwind(panic),
                    Ok(()) => return Err(PyRuntimeError::new_err("a thread ended without a result")),
                },
            }
        }
    })
}
