//! What comes from Python.

use freerange::{Camera, Choices, Options, Reconstructor, Up, View};
use freerange_scene::camera::scene::nearest_rotation;
use glam::{DMat3, DMat4, DVec3};
use image::RgbaImage;
use pyo3::{exceptions::PyValueError, prelude::*, pybacked::PyBackedBytes};

/// Refuses the value of a field.
pub fn refuse(field: &str, expected: &str, found: impl std::fmt::Display) -> PyErr {
    PyValueError::new_err(format!("{field}: expected {expected}, found {found}"))
}

/// [`refuse`], where what was expected is told in words already.
pub fn told(field: &str, expected: &str, found: &str) -> PyErr {
    PyValueError::new_err(format!("{field}: {expected}, found '{found}'"))
}

/// The floats of an array of `float32` in the machine's order.
pub fn floats(field: &str, bytes: &[u8]) -> PyResult<Vec<f32>> {
    let (floats, rest) = bytes.as_chunks::<4>();
    match rest {
        [] => Ok(floats.iter().map(|b| f32::from_ne_bytes(*b)).collect()),
        _ => Err(refuse(field, "floats of four bytes each", format!("{} bytes", bytes.len()))),
    }
}

/// A camera: width, height, (fx, fy, cx, cy), rows of camera to world in OpenCV's axes.
pub type RawCamera = (u32, u32, [f64; 4], [[f64; 4]; 4]);

/// The camera number `i`.
pub fn camera(i: usize, (width, height, [fx, fy, cx, cy], rows): RawCamera) -> PyResult<Camera> {
    let field = format!("c2w[{i}]");
    if rows[3].iter().zip([0.0, 0.0, 0.0, 1.0]).any(|(v, e)| (v - e).abs() > 1e-6) {
        return Err(refuse(&field, "a last row of [0, 0, 0, 1]", format!("{:?}", rows[3])));
    }
    let column = |j: usize| DVec3::new(rows[0][j], rows[1][j], rows[2][j]);
    let found = nearest_rotation(DMat3::from_cols(column(0), column(1), column(2)));
    let axes = found.map_err(|found| refuse(&field, "a rotation and a translation", found))?;
    let camera_from_world = axes.transpose();
    let translation = -(camera_from_world * column(3));
    let world_to_camera = DMat4::from_cols(
        camera_from_world.x_axis.extend(0.0),
        camera_from_world.y_axis.extend(0.0),
        camera_from_world.z_axis.extend(0.0),
        translation.extend(1.0),
    );
    Ok(Camera { width, height, fx, fy, cx, cy, world_to_camera })
}

/// The opposite of [`camera`].
pub fn raw_camera(camera: &Camera) -> RawCamera {
    let Camera { width, height, fx, fy, cx, cy, world_to_camera } = *camera;
    // A rotation is undone by its transpose.
    let axes = DMat3::from_mat4(world_to_camera).transpose();
    let center = camera.center();
    let row = |i: usize| [axes.x_axis[i], axes.y_axis[i], axes.z_axis[i], center[i]];
    (width, height, [fx, fy, cx, cy], [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]])
}

/// All of them.
pub fn cameras(raw: Vec<RawCamera>) -> PyResult<Vec<Camera>> {
    raw.into_iter().enumerate().map(|(i, raw)| camera(i, raw)).collect()
}

/// A view: its name, its camera, and RGBA of 8 bits.
pub type RawView = (String, RawCamera, PyBackedBytes);

/// All of them.
pub fn views(raw: Vec<RawView>) -> PyResult<Vec<View>> {
    let view = |(i, (name, raw, rgba)): (usize, RawView)| {
        let camera = camera(i, raw)?;
        let found = rgba.len();
        let image = RgbaImage::from_raw(camera.width, camera.height, rgba.to_vec());
        let image = image.ok_or_else(|| {
            let expected = format!("{} x {} pixels of four bytes", camera.width, camera.height);
            refuse(&format!("images[{i}]"), &expected, format!("{found} bytes"))
        })?;
        Ok(View { name, camera, image })
    };
    raw.into_iter().enumerate().map(view).collect()
}

/// Which way is up: a name or a direction.
#[derive(FromPyObject)]
pub enum RawUp {
    Name(String),
    Direction([f64; 3]),
}

impl RawUp {
    /// None for `auto`, where that is allowed.
    pub fn read(self, auto: bool) -> PyResult<Option<Up>> {
        Ok(Some(match self {
            Self::Direction(d) => match DVec3::from(d) {
                d if d.is_finite() && d.length() > 0.0 => Up::Direction(d),
                _ => return Err(refuse("up", "a direction of finite numbers that are not all zero", format!("{d:?}"))),
            },
            Self::Name(name) => match (name.as_str(), auto) {
                ("z", _) => Up::Z,
                ("y", _) => Up::Y,
                ("cameras", _) => Up::Cameras,
                ("auto", true) => return Ok(None),
                (found, _) => {
                    let names = if auto { "'auto', 'z', 'y', 'cameras'" } else { "'z', 'y', 'cameras'" };
                    return Err(refuse("up", &format!("{names} or a direction (x, y, z)"), format!("'{found}'")));
                }
            },
        }))
    }
}

/// What the caller chooses of the pipeline; the rest is the preset's.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct RawOptions {
    seeds: Vec<u64>,
    quality: Option<String>,
    iterations: Option<usize>,
    symmetry: Option<String>,
    init: Option<String>,
    precision: Option<String>,
    network_views: Option<usize>,
    set: Vec<(String, String)>,
}

impl RawOptions {
    /// As the command line makes them of the same options.
    pub fn options(self, model: &Reconstructor) -> PyResult<Options> {
        let choices = Choices {
            quality: named("quality", self.quality, "'draft', 'default' or 'high'")?.unwrap_or_default(),
            iterations: self.iterations,
            symmetry: named("symmetry", self.symmetry, "'auto' or 'off'")?,
            init: named("init", self.init, "'fit' or 'flow'")?,
            precision: named("precision", self.precision, "'f32', 'bf16', 'f16' or 'auto'")?,
            network_views: self.network_views,
            set: self.set,
        };
        let mut options = model.options_of(&choices).map_err(crate::error::of_model)?;
        choices.check_effect(&options.pipeline, false).map_err(crate::error::of_model)?;
        options.seeds = self.seeds;
        Ok(options)
    }
}

/// One of some names.
fn named<T: serde::de::DeserializeOwned>(field: &str, name: Option<String>, expected: &str) -> PyResult<Option<T>> {
    let read = |name: String| {
        let found = serde_json::from_value(name.as_str().into());
        found.map_err(|_| refuse(field, expected, format!("'{name}'")))
    };
    name.map(read).transpose()
}
