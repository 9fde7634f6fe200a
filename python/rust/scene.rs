//! Scenes and Gaussians on disk.

use std::path::PathBuf;

use freerange::{
    CameraFormat, Error, FrameConfig, Gaussians, Harmonics, Hints, LoadConfig, Loaded, MaskSource, Note, NoteKind,
    ReadConfig, SceneConfig, Splats, Turntable, View, load_views, warnings_of,
};
use glam::{DQuat, DVec3};
use pyo3::{prelude::*, pybacked::PyBackedBytes, types::PyByteArray};

use crate::{
    arguments::{RawCamera, RawUp, RawView, floats, raw_camera, refuse, told, views},
    error::of_model,
    interrupt::interruptible,
    process::check_process,
    raster::bytes,
};

/// Photos with cameras, cut out.
#[pyclass(frozen)]
pub struct Scene {
    pub loaded: Loaded,
    pub frame: FrameConfig,
    notes: Vec<Note>,
}

impl Scene {
    /// With what may go wrong among the notes. What cannot be reconstructed at all is refused once somebody wants that.
    fn new(loaded: Loaded, frame: FrameConfig, mut notes: Vec<Note>) -> Self {
        notes.extend(warnings_of(&loaded, &frame, usize::MAX).unwrap_or_default());
        Self { loaded, frame, notes }
    }
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
    check_process()?;
    let made = interruptible(py, move |stop| {
        let config = SceneConfig { cameras: read, photos: LoadConfig { stop: stop.clone(), ..config }, up };
        let read = freerange::Scene::open_with(&path, &config)?;
        Ok::<_, Error>(Scene::new(read.loaded, read.frame, read.notes))
    });
    made?.map_err(of_model)
}

/// Makes a scene of views in memory; those without a mask get one.
#[pyfunction]
pub fn scene_of_views(
    py: Python<'_>,
    raw: Vec<RawView>,
    up: RawUp,
    center: Option<[f64; 3]>,
    radius: Option<f64>,
) -> PyResult<Scene> {
    let (views, up) = (views(raw)?, up.read(false)?.unwrap_or_default());
    let center = center.map(DVec3::from);
    let frame = FrameConfig { up, center, radius, ..FrameConfig::default() };
    let hints = Hints { center, radius, ..Hints::default() };
    check_process()?;
    let made = interruptible(py, move |stop| {
        let loaded = load_views(views, &hints, stop)?;
        let notes = loaded.notes.clone();
        Ok::<_, Error>(Scene::new(loaded, frame, notes))
    });
    made?.map_err(of_model)
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
        all(py, &self.loaded.views)
    }

    /// What it is only compared with.
    fn further(&self, py: Python<'_>) -> Vec<Whole> {
        all(py, &self.loaded.further)
    }

    /// What was understood, for the user to read.
    #[pyo3(name = "notes")]
    fn notes_in_python(&self) -> Vec<(bool, String)> {
        self.notes()
    }
}

impl Scene {
    pub fn notes(&self) -> Vec<(bool, String)> {
        told_notes(self.notes.clone())
    }
}

/// Sentences for the user, and whether each tells of something that is left out or may be wrong.
pub fn told_notes(notes: Vec<Note>) -> Vec<(bool, String)> {
    let grave = |kind| matches!(kind, NoteKind::Dropped | NoteKind::Warning);
    notes.into_iter().map(|note| (grave(note.kind), note.text)).collect()
}

/// Rows of 14 channels, and harmonics `[n, k, 3]` of a degree: what Python has of Gaussians.
type RawSplats = (Py<PyByteArray>, usize, Py<PyByteArray>);

fn raw(py: Python<'_>, splats: Splats) -> RawSplats {
    let harmonics = bytes(py, splats.harmonics.rows());
    let degree = splats.harmonics.degree();
    (bytes(py, splats.into_cloud().rows()), degree, harmonics)
}

/// Writes Gaussians in the format of the file's extension; what the format could not hold.
#[pyfunction]
pub fn write_gaussians(
    py: Python<'_>,
    rows: PyBackedBytes,
    degree: usize,
    harmonics: PyBackedBytes,
    path: PathBuf,
    up: [f64; 3],
) -> PyResult<Vec<(bool, String)>> {
    let splats = splats(&rows, degree, &harmonics)?;
    py.detach(|| freerange::write_splats(&splats, &path, up.into())).map(told_notes).map_err(of_model)
}

/// Gaussians of a file, the direction of up, and notes.
type ReadSplats = (RawSplats, [f64; 3], Vec<(bool, String)>);

/// Reads Gaussians from a file; those that fix their frame are turned into the one in which `up` is up. None: the
/// file's word.
#[pyfunction]
pub fn read_gaussians(py: Python<'_>, path: PathBuf, up: Option<[f64; 3]>) -> PyResult<ReadSplats> {
    let read = py.detach(|| freerange::read_splats(&path, up.map(DVec3::from)));
    let (splats, up, notes) = read.map_err(of_model)?;
    Ok((raw(py, splats), up.to_array(), told_notes(notes)))
}

/// Gaussians moved by `x -> scale * rotation * x + translation`; `rotation` is w x y z.
#[pyfunction]
pub fn transform(
    py: Python<'_>,
    rows: PyBackedBytes,
    degree: usize,
    harmonics: PyBackedBytes,
    scale: f64,
    rotation: [f64; 4],
    translation: [f64; 3],
) -> PyResult<RawSplats> {
    let mut splats = splats(&rows, degree, &harmonics)?;
    let [w, x, y, z] = rotation;
    splats.transform(scale, DQuat::from_xyzw(x, y, z, w), translation.into());
    Ok(raw(py, splats))
}

/// The rows with the colors that are seen from `eye`.
#[pyfunction]
pub fn seen_from(
    py: Python<'_>,
    rows: PyBackedBytes,
    degree: usize,
    harmonics: PyBackedBytes,
    eye: [f64; 3],
) -> PyResult<Py<PyByteArray>> {
    Ok(bytes(py, splats(&rows, degree, &harmonics)?.seen_from(eye.into()).rows()))
}

fn splats(rows: &[u8], degree: usize, harmonics: &[u8]) -> PyResult<Splats> {
    let (rows, harmonics) = (floats("gaussians", rows)?, floats("sh", harmonics)?);
    if rows.len() % freerange_raster::CHANNELS != 0 {
        return Err(refuse("gaussians", "rows of 14 numbers", format!("{} numbers", rows.len())));
    }
    let cloud = Gaussians::from_rows(rows);
    let each = 3 * ((degree + 1) * (degree + 1) - 1);
    if degree > 3 || harmonics.len() != each * cloud.len() {
        let expected = format!("{each} numbers for each of {} Gaussians, degree 3 at most", cloud.len());
        return Err(refuse("sh", &expected, format!("{} numbers of degree {degree}", harmonics.len())));
    }
    Ok(Splats { harmonics: Harmonics::from_rows(degree, harmonics), ..Splats::from(cloud) })
}
