//! Decoding and preparing the images of a scene.

use super::{
    cut_out,
    json::{Description, FrameDescription},
    locate::{CONVERT, ImageFiles, LARGEST_SIDE, Located},
};
use crate::camera::{CameraError, Lens, View};
use freerange_util::IoError;
use image::{DynamicImage, ImageDecoder, ImageReader, RgbaImage};
use std::path::{Path, PathBuf};

/// All images of a scene together, in pixels (4 bytes each).
const LARGEST_SCENE: u64 = 1 << 30;
/// What one decoder may allocate, in bytes.
const LARGEST_DECODE: u64 = 2 << 30;

/// The image file of a frame.
fn find(frame: &FrameDescription) -> Result<PathBuf, CameraError> {
    let place = || frame.place.clone();
    match ImageFiles::default().locate(&frame.image) {
        Located::There(path) | Located::Renamed(path) => Ok(path),
        Located::Several(first, second) => Err(CameraError::Field {
            place: place(),
            field: "file_path".into(),
            expected: "the name of one image".into(),
            found: format!("{}, which could be {} or {}", frame.image.display(), first.display(), second.display()),
        }),
        Located::Unreadable(path, kind) => Err(CameraError::Unsupported {
            place: place(),
            feature: format!("the {kind} image {}", path.display()),
            advice: CONVERT,
        }),
        Located::Missing => Err(CameraError::MissingImage { place: place(), image: frame.image.clone() }),
    }
}

fn decoder(path: &Path, frame: &FrameDescription) -> Result<impl ImageDecoder + use<>, CameraError> {
    let failed = |e| CameraError::Image { place: frame.place.clone(), image: path.to_path_buf(), source: Box::new(e) };
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(LARGEST_SIDE);
    limits.max_image_height = Some(LARGEST_SIDE);
    limits.max_alloc = Some(LARGEST_DECODE);
    let mut reader =
        ImageReader::open(path).and_then(|reader| reader.with_guessed_format()).map_err(IoError::at(path))?;
    reader.limits(limits);
    reader.into_decoder().map_err(failed)
}

/// Width and height of a frame's image, from its header.
pub fn image_size(frame: &FrameDescription) -> Result<(u32, u32), CameraError> {
    Ok(decoder(&find(frame)?, frame)?.dimensions())
}

/// An image whose size is not the intrinsics' own: widths and heights.
struct Rescaled {
    name: String,
    from: (u32, u32),
    to: (u32, u32),
}

/// Loads images and remembers what there is to tell about them.
#[derive(Default)]
pub(super) struct Images {
    pixels: u64,
    cut: Vec<(String, [u8; 3])>,
    rescaled: Vec<Rescaled>,
    undistorted: usize,
}

impl Images {
    /// The frames' views; `inputs` must show something.
    pub fn load_all(
        &mut self,
        description: &Description,
        frames: &[&FrameDescription],
        inputs: bool,
    ) -> Result<Vec<View>, CameraError> {
        tracing::debug!(file = %description.file.display(), frames = frames.len(), "loading images");
        frames.iter().map(|frame| self.load(frame, inputs)).collect()
    }

    fn load(&mut self, frame: &FrameDescription, input: bool) -> Result<View, CameraError> {
        let place = || frame.place.clone();
        let path = find(frame)?;
        let decoder = decoder(&path, frame)?;
        let (w, h) = decoder.dimensions();
        self.pixels += u64::from(w) * u64::from(h);
        if self.pixels > LARGEST_SCENE {
            return Err(CameraError::TooManyPixels { place: place(), limit: LARGEST_SCENE });
        }
        let mut camera = frame.camera(frame.size.unwrap_or((w, h)))?;
        if let Some(expected) = frame.size.filter(|size| *size != (w, h)) {
            // The same shape, up to one pixel of rounding.
            let (across, down) = (u64::from(w) * u64::from(expected.1), u64::from(h) * u64::from(expected.0));
            if across.abs_diff(down) > u64::from(expected.0.max(expected.1)) {
                return Err(CameraError::ImageSize { place: place(), image: path, expected, found: (w, h) });
            }
            camera = camera.resized(w, h);
            self.rescaled.push(Rescaled { name: frame.name.clone(), from: expected, to: (w, h) });
        }
        let mut image = DynamicImage::from_decoder(decoder)
            .map_err(|e| CameraError::Image { place: place(), image: path.clone(), source: Box::new(e) })?
            .into_rgba8();
        let background = |found: String| CameraError::Background { place: place(), image: path.clone(), found };
        let alpha = |image: &RgbaImage, value: u8| image.pixels().all(|p| p[3] == value);
        if alpha(&image, 255) {
            let (object, color) = cut_out(&image).map_err(background)?;
            self.cut.push((frame.name.clone(), color));
            image = object;
        } else if input && alpha(&image, 0) {
            return Err(background("an image that is transparent everywhere".into()));
        }
        if frame.lens != Lens::Ideal {
            if !frame.lens.is_one_to_one(&camera) {
                return Err(CameraError::Field {
                    place: place(),
                    field: "k1, k2, k3, k4, p1, p2".into(),
                    expected: "a distortion that maps the image one to one".into(),
                    found: format!("{:?}, which folds it", frame.lens),
                });
            }
            image = frame.lens.undistort(&image, &camera);
            self.undistorted += 1;
        }
        Ok(View { name: frame.name.clone(), camera, image })
    }

    pub fn into_notes(self) -> Vec<String> {
        let mut notes = Vec::new();
        if let Some((name, [r, g, b])) = self.cut.first() {
            let count = self.cut.len();
            notes.push(format!(
                "{count} images have no transparency: their plain background ({name}: rgb {r} {g} {b}) was cut away"
            ));
        }
        if let Some(Rescaled { name, from, to }) = self.rescaled.first() {
            let count = self.rescaled.len();
            notes.push(format!(
                "{count} images differ in size from `w`, `h` ({name}: {} x {} instead of {} x {}); intrinsics were scaled",
                to.0, to.1, from.0, from.1
            ));
        }
        if self.undistorted > 0 {
            notes.push(format!("lens distortion was removed from {} images", self.undistorted));
        }
        notes
    }
}
