//! The rasterizer: forward, backward, and the slow one that tests compare with.

use freerange::Camera;
use freerange_raster::{RasterConfig, RenderOutput, reference as slow, render, render_backward};
use pyo3::{prelude::*, pybacked::PyBackedBytes, types::PyByteArray};

use crate::{
    arguments::{RawCamera, camera, cameras, floats},
    error::of_raster,
    process::check_process,
};

/// The bytes of numbers, for NumPy to wrap.
pub fn bytes(py: Python<'_>, values: &[f32]) -> Py<PyByteArray> {
    let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_ne_bytes()).collect();
    PyByteArray::new(py, &bytes).unbind()
}

/// As [`bytes`].
fn doubles(py: Python<'_>, values: &[f64]) -> Py<PyByteArray> {
    let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_ne_bytes()).collect();
    PyByteArray::new(py, &bytes).unbind()
}

/// Pictures, and what their gradient needs.
#[pyclass(frozen)]
pub struct Rendered {
    rows: Vec<f32>,
    output: RenderOutput,
}

/// Renders rows of 14 channels from every camera.
#[pyfunction]
pub fn rasterize(
    py: Python<'_>,
    rows: PyBackedBytes,
    raw: Vec<RawCamera>,
    backgrounds: Vec<[f32; 3]>,
    depth: bool,
) -> PyResult<Rendered> {
    check_process()?;
    let rows = floats("gaussians", &rows)?;
    let cameras: Vec<Camera> = cameras(raw)?;
    let config = RasterConfig { depth, ..RasterConfig::default() };
    let output = py.detach(|| render(&rows, &cameras, &backgrounds, &config)).map_err(of_raster)?;
    Ok(Rendered { rows, output })
}

#[pymethods]
impl Rendered {
    /// `[views, h, w, 3]`
    fn rgb(&self, py: Python<'_>) -> Py<PyByteArray> {
        bytes(py, &self.output.rgb)
    }

    /// `[views, h, w]`
    fn alpha(&self, py: Python<'_>) -> Py<PyByteArray> {
        bytes(py, &self.output.alpha)
    }

    /// Sum of blending weight times camera z, `[views, h, w]`; empty where no depth was asked for.
    fn depth(&self, py: Python<'_>) -> Py<PyByteArray> {
        bytes(py, &self.output.depth)
    }

    /// d loss / d (rgb, alpha, depth) to d loss / d rows and d loss / d backgrounds; that of depth may be empty.
    fn backward(
        &self,
        py: Python<'_>,
        d_rgb: PyBackedBytes,
        d_alpha: PyBackedBytes,
        d_depth: PyBackedBytes,
    ) -> PyResult<(Py<PyByteArray>, Py<PyByteArray>)> {
        check_process()?;
        let (d_rgb, d_alpha) = (floats("d_rgb", &d_rgb)?, floats("d_alpha", &d_alpha)?);
        let d_depth = floats("d_depth", &d_depth)?;
        let gradients = py.detach(|| render_backward(&self.rows, &self.output, &d_rgb, &d_alpha, &d_depth));
        let gradients = gradients.map_err(of_raster)?;
        Ok((bytes(py, &gradients.gaussians), bytes(py, gradients.backgrounds.as_flattened())))
    }
}

/// One view by the rasterizer's slow, obvious form in double precision: color and alpha. For tests.
#[pyfunction]
pub fn reference(
    py: Python<'_>,
    rows: PyBackedBytes,
    raw: RawCamera,
    background: [f32; 3],
) -> PyResult<(Py<PyByteArray>, Py<PyByteArray>)> {
    let (rows, camera) = (floats("gaussians", &rows)?, camera(0, raw)?);
    let image = py.detach(|| slow::render(&rows, &camera, background, &RasterConfig::default()));
    Ok((doubles(py, &image.rgb), doubles(py, &image.alpha)))
}
