//! `freerange._core`: what the Python package `freerange` is made of.
//!
//! The package's own Python checks what users give and says what is wrong with it, field by field; only lists of checked numbers and the
//! bytes of arrays come here. They leave as `bytearray`s, which NumPy wraps without a copy.

mod arguments;
mod error;
mod interrupt;
mod model;
mod process;
mod raster;
mod scene;

use pyo3::prelude::*;

#[pymodule]
mod _core {
    use super::*;
    #[pymodule_export]
    use super::{
        model::{Model, load},
        raster::{Rendered, rasterize, reference},
        scene::{Scene, read_gaussians, read_scene, scene_of_views, seen_from, transform, write_gaussians},
    };

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }

    /// Every device, the best first: name, hardware, and why it cannot be used if it cannot.
    #[pyfunction]
    fn devices(py: Python<'_>) -> PyResult<Vec<(String, String, Option<String>)>> {
        process::check_process_for("auto")?;
        let found = py.detach(freerange::Device::list);
        Ok(found.into_iter().map(|d| (d.name, d.properties.hardware, d.problem)).collect())
    }
}
