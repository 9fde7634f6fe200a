//! Errors as Python's own.

use std::error::Error;

use freerange_model::hub::HubError;
use freerange_raster::RasterError;
use pyo3::{
    PyErr,
    exceptions::{PyOSError, PyRuntimeError, PyValueError},
};

/// An error with its causes.
fn told(error: &(dyn Error + 'static)) -> String {
    freerange_util::with_causes(error, ": ")
}

/// `OSError` where the system refused a file.
fn of_system(error: &(dyn Error + 'static)) -> Option<PyErr> {
    let mut next = Some(error);
    while let Some(e) = next {
        if let Some(io) = e.downcast_ref::<std::io::Error>() {
            return Some(match io.raw_os_error() {
                // With a number Python chooses the subclass: FileNotFoundError, PermissionError, ...
                Some(number) => PyOSError::new_err((number, told(error))),
                None => PyOSError::new_err(told(error)),
            });
        }
        next = e.source();
    }
    None
}

/// `OSError` where the system refused a file, else `ValueError`.
fn about_input(error: &(dyn Error + 'static)) -> PyErr {
    of_system(error).unwrap_or_else(|| PyValueError::new_err(told(error)))
}

/// What the caller gave is to blame (`ValueError`, `OSError`), or a device or the arithmetic (`RuntimeError`).
pub fn of_model(error: freerange::Error) -> PyErr {
    match error.is_failure() {
        true => of_system(&error).unwrap_or_else(|| PyRuntimeError::new_err(told(&error))),
        false => about_input(&error),
    }
}

/// A name that is none, else what lies between here and the hub.
pub fn of_hub(error: HubError) -> PyErr {
    match error {
        HubError::Name { .. } => about_input(&error),
        _ => PyOSError::new_err(told(&error)),
    }
}

/// Cameras or Gaussians that cannot be rendered.
pub fn of_raster(error: RasterError) -> PyErr {
    about_input(&error)
}
