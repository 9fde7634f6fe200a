//! Which process computes: threads do not survive a fork.

use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use freerange::GpuApi;
use pyo3::{exceptions::PyRuntimeError, prelude::*};

/// The process that computed first; 0: none.
static FIRST: AtomicU32 = AtomicU32::new(0);

/// For all that computes in threads: refuses the fork of a process that has done so before, where it would wait for
/// threads that are not there.
pub fn check_process() -> PyResult<()> {
    let own = std::process::id();
    match FIRST.compare_exchange(0, own, Relaxed, Relaxed) {
        Err(first) if first != own => Err(PyRuntimeError::new_err(format!(
            "freerange: expected a process of its own, found a fork of process {first}, which has computed with this \
             package: a fork has no threads. Start processes with multiprocessing.get_context('spawn'), or fork before \
             the first scene, reconstruction or render"
        ))),
        _ => Ok(()),
    }
}

/// The same where a GPU may be opened.
pub fn check_process_for(device: &str) -> PyResult<()> {
    let may_open = device != "cpu" && GpuApi::ALL.into_iter().any(GpuApi::compiled);
    if may_open { check_process() } else { Ok(()) }
}
