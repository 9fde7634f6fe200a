//! A model on a device.

use std::{
    borrow::Cow,
    ops::ControlFlow,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use freerange::{DeviceName, EncoderPlaces, Options, Reconstructor, View, internal::shipped, machine::cache_folder};
use freerange_model::hub::Hub;
use pyo3::{prelude::*, types::PyByteArray};

use crate::{
    arguments::{RawOptions, refuse, told},
    error::{of_hub, of_model},
    process::{check_process, check_process_for},
    raster::bytes,
    scene::{Scene, told_notes},
};

/// How often Ctrl-C is looked for, at least; asking at every step of a fit would take the interpreter from other threads.
const SIGNALS: Duration = Duration::from_millis(20);
/// What hubs call a model's weights.
const WEIGHTS: &str = "model.safetensors";

/// A model on a device.
#[pyclass(frozen)]
pub struct Model {
    model: Reconstructor,
    device: String,
}

/// Reads a checkpoint, or the shipped one.
#[pyfunction]
pub fn load(
    py: Python<'_>,
    checkpoint: Option<PathBuf>,
    device: &str,
    encoder_weights: Option<PathBuf>,
) -> PyResult<Model> {
    let name: DeviceName = device.parse().map_err(|e: String| told("device", &e, device))?;
    check_process_for(device)?;
    py.detach(|| {
        let opened = name.open().map_err(of_model)?;
        let model = match &checkpoint {
            None => shipped(&opened),
            Some(path) => Reconstructor::load(&local(path)?, &EncoderPlaces::at(encoder_weights), &opened),
        };
        Ok(Model { model: model.map_err(of_model)?, device: name.to_string() })
    })
}

/// The file that a checkpoint's name stands for; of `hf:owner/name[@revision]` the one in the cache, downloaded if need be.
fn local(path: &Path) -> PyResult<Cow<'_, Path>> {
    let Some(name) = path.to_str().filter(|name| name.starts_with("hf:")) else { return Ok(path.into()) };
    let cache = cache_folder().ok_or_else(|| refuse("checkpoint", "a file: no cache folder is known here", name))?;
    let pinned = Hub::new(cache).files(&name.parse().map_err(of_hub)?, &[WEIGHTS], &mut |_, _, _| {});
    Ok(pinned.map_err(of_hub)?.folder.join(WEIGHTS).into())
}

/// Samples as rows of `float32`, the direction of up, notes, and seconds per stage.
type Made = (Vec<Py<PyByteArray>>, [f64; 3], Vec<(bool, String)>, Vec<(&'static str, f64)>);

#[pymethods]
impl Model {
    /// As the user named it.
    #[getter]
    fn device(&self) -> &str {
        &self.device
    }

    /// Most views that it has seen at once in training.
    #[getter]
    fn network_views(&self) -> PyResult<usize> {
        self.model.network_views().map_err(of_model)
    }

    /// Gaussians that the network makes, before the optimization.
    #[getter]
    fn gaussians(&self) -> PyResult<usize> {
        self.model.gaussians().map_err(of_model)
    }

    /// What the checkpoint says of its making, as JSON.
    #[getter]
    fn provenance(&self) -> String {
        self.model.provenance().to_string()
    }

    /// Refuses options that it cannot follow.
    fn check(&self, chosen: RawOptions) -> PyResult<()> {
        self.model.check(&chosen.options(&self.model)?).map_err(of_model)
    }

    /// Samples for a scene.
    fn reconstruct_scene(
        &self,
        py: Python<'_>,
        scene: &Scene,
        chosen: RawOptions,
        on_step: Option<Py<PyAny>>,
    ) -> PyResult<Made> {
        check_process()?;
        let mut options = chosen.options(&self.model)?;
        options.frame = scene.frame;
        self.run(py, &scene.loaded.views, &options, scene.notes(), on_step)
    }
}

impl Model {
    fn run(
        &self,
        py: Python<'_>,
        views: &[View],
        options: &Options,
        mut notes: Vec<(bool, String)>,
        on_step: Option<Py<PyAny>>,
    ) -> PyResult<Made> {
        let mut stopped: PyResult<()> = Ok(());
        let mut last = Instant::now();
        let mut tell = |told: &freerange::Progress<'_>| -> PyResult<()> {
            let Some(on_step) = &on_step else {
                if last.elapsed() < SIGNALS {
                    return Ok(());
                }
                last = Instant::now();
                return Python::attach(|py| py.check_signals());
            };
            let preview = told.preview().map_err(of_model)?;
            Python::attach(|py| {
                py.check_signals()?;
                let cloud = preview.map(|cloud| bytes(py, cloud.rows()));
                let told = (told.stage.name(), told.sample, told.done, told.total, told.loss, cloud);
                on_step.call1(py, told).map(drop)
            })
        };
        let result = py.detach(|| {
            self.model.run(views, options, &mut |told| match tell(told) {
                Ok(()) => ControlFlow::Continue(()),
                Err(e) => {
                    stopped = Err(e);
                    ControlFlow::Break(())
                }
            })
        });
        stopped?;
        let result = result.map_err(of_model)?;
        let samples = result.samples.iter().map(|s| bytes(py, s.gaussians.rows())).collect();
        let up = result.up().to_array();
        notes.extend(told_notes(result.notes.clone()));
        Ok((samples, up, notes, result.seconds.iter().map(|(stage, s)| (stage.name(), *s)).collect()))
    }
}
