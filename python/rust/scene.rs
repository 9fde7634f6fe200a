//! Scenes and Gaussians on disk.

use std::path::PathBuf;

use freerange::{
    CameraFormat, Gaussians, Hints, LoadConfig, MaskSource, Note, ReadConfig, SceneConfig, Turntable, View,
};
use glam::DVec3;
use pyo3::{prelude::*, pybacked::PyBackedBytes, types::PyByteArray};

use crate::{
    arguments::{RawCamera, RawUp, floats, raw_camera, refuse, told},
    error::of_model,
    raster::bytes,
};

/// Photos with cameras, cut out.
#[pyclass(frozen)]
pub struct Scene {
    pub inner: freerange::Scene,
}

/// How photos are read; as on the command line.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Photos {
    cameras: Option<String>,
    turntable: Option<String>,
    images: Option<PathBuf>,
    masks: String,
    mask_folder: Option<PathBuf>,
    invert_masks: bool,
    max_side: u32,
    center: Option<[f64; 3]>,
    radius: Option<f64>,
}

/// Reads a scene.
#[pyfunction]
pub fn read_scene(py: Python<'_>, path: PathBuf, photos: Photos, up: RawUp) -> PyResult<Scene> {
    let format = photos.cameras.map(|name| {
        let known = CameraFormat::ALL.into_iter().find(|f| f.name() == name);
        let expected = "'transforms', 'colmap', 'polycam', 'metashape', 'realitycapture' or 'opf'";
        known.ok_or_else(|| refuse("cameras", expected, format!("'{name}'")))
    });
    let turntable =
        photos.turntable.map(|text| text.parse::<Turntable>().map_err(|expected| told("turntable", &expected, &text)));
    let masks = match (photos.masks.as_str(), photos.mask_folder) {
        (_, Some(folder)) => MaskSource::Files(folder),
        ("alpha", _) => MaskSource::Alpha,
        ("plain", _) => MaskSource::Plain,
        ("estimate", _) => MaskSource::Estimate,
        _ => MaskSource::Auto,
    };
    let center = photos.center.map(DVec3::from);
    let read = ReadConfig { format: format.transpose()?, turntable: turntable.transpose()?, images: photos.images };
    let config = LoadConfig {
        masks,
        invert_masks: photos.invert_masks,
        max_side: photos.max_side,
        hints: Hints { center, radius: photos.radius, others: None },
        ..LoadConfig::default()
    };
    let up = up.read(true)?;
    py.detach(|| {
        let config = SceneConfig { cameras: read, photos: config, up };
        Ok(Scene { inner: freerange::Scene::open_with(&path, &config).map_err(of_model)? })
    })
}

/// A view: its name, its camera, RGBA of 8 bits.
type Whole = (String, RawCamera, Py<PyByteArray>);

fn all(py: Python<'_>, views: &[View]) -> Vec<Whole> {
    let view = |v: &View| (v.name.clone(), raw_camera(&v.camera), PyByteArray::new(py, v.image.as_raw()).unbind());
    views.iter().map(view).collect()
}

#[pymethods]
impl Scene {
    /// What it is reconstructed from.
    fn views(&self, py: Python<'_>) -> Vec<Whole> {
        all(py, self.inner.views())
    }

    /// What it is only compared with.
    fn further(&self, py: Python<'_>) -> Vec<Whole> {
        all(py, self.inner.further())
    }

    /// What was understood, for the user to read.
    #[pyo3(name = "notes")]
    fn notes_in_python(&self) -> Vec<String> {
        self.notes()
    }
}

impl Scene {
    pub fn notes(&self) -> Vec<String> {
        self.inner.notes.iter().map(|note| note.text.clone()).collect()
    }
}

fn texts(notes: Vec<Note>) -> Vec<String> {
    notes.into_iter().map(|note| note.text).collect()
}

/// Writes Gaussians in the format of the file's extension; what the format could not hold.
#[pyfunction]
pub fn write_gaussians(py: Python<'_>, rows: PyBackedBytes, path: PathBuf, up: [f64; 3]) -> PyResult<Vec<String>> {
    let cloud = cloud(&rows)?;
    py.detach(|| freerange::write_gaussians(&cloud, &path, up.into())).map(texts).map_err(of_model)
}

/// Reads Gaussians from a file; those that fix their frame are turned into the one in which `up` is up.
#[pyfunction]
pub fn read_gaussians(py: Python<'_>, path: PathBuf, up: [f64; 3]) -> PyResult<(Py<PyByteArray>, Vec<String>)> {
    let (cloud, notes) = py.detach(|| freerange::read_gaussians(&path, up.into())).map_err(of_model)?;
    Ok((bytes(py, cloud.rows()), texts(notes)))
}

fn cloud(rows: &[u8]) -> PyResult<Gaussians> {
    let rows = floats("gaussians", rows)?;
    match rows.len() % freerange_raster::CHANNELS {
        0 => Ok(Gaussians::from_rows(rows)),
        _ => Err(refuse("gaussians", "rows of 14 numbers", format!("{} numbers", rows.len()))),
    }
}
