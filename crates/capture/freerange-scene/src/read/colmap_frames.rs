//! COLMAP's `rigs` and `frames`: where they say that images are. `images` says it as well, for every image; COLMAP 3.12 and later
//! believes the frames, older programs the images, and a script that changes one of them makes two models of one.

use super::{
    bytes_of,
    colmap_values::{Bytes, ColmapImage, number},
    text_of,
};
use crate::SceneError;
use freerange_util::Note;
use glam::{DQuat, DVec3};
use std::{collections::HashMap, path::Path};

/// Largest angle in radians, and largest distance as a share of the cameras' own distances, that is rounding.
const SAME: f64 = 1e-4;

/// A rotation and a translation after it.
#[derive(Clone, Copy, Debug)]
pub struct Rigid {
    /// Of length 1, or not a number where the file's is zero.
    pub rotation: DQuat,
    /// In the model's lengths.
    pub translation: DVec3,
}

impl Rigid {
    fn new([w, x, y, z, a, b, c]: [f64; 7]) -> Self {
        Self { rotation: DQuat::from_xyzw(x, y, z, w).normalize(), translation: DVec3::new(a, b, c) }
    }

    fn after(&self, inner: &Self) -> Self {
        Self {
            rotation: self.rotation * inner.rotation,
            translation: self.rotation * inner.translation + self.translation,
        }
    }
}

/// Poses of sensors in their rigs, by the numbers of rig and camera.
pub type Rigs = HashMap<(u32, u32), Rigid>;
/// A frame: its rig, its pose, and the camera and image of each of its pictures.
pub type Frame = (u32, Rigid, Vec<(u32, u32)>);

/// A note where the model's frames put its images elsewhere than its images do.
pub(super) fn disagreement(folder: &Path, binary: bool, images: &[ColmapImage]) -> Result<Option<Note>, SceneError> {
    let extension = if binary { "bin" } else { "txt" };
    let file = |name: &str| Some(folder.join(format!("{name}.{extension}"))).filter(|f| f.is_file());
    let (Some(rigs_file), Some(frames_file)) = (file("rigs"), file("frames")) else { return Ok(None) };
    let (rig_bytes, frame_bytes) = (bytes_of(&rigs_file)?, bytes_of(&frames_file)?);
    let (rigs, frames) = (rigs(&rigs_file, &rig_bytes, binary)?, frames(&frames_file, &frame_bytes, binary)?);
    let mut by_frames: HashMap<u32, Rigid> = HashMap::new();
    for (rig, pose, data) in frames {
        for (camera, image) in data {
            let sensor = rigs.get(&(rig, camera)).map_or(pose, |sensor| sensor.after(&pose));
            by_frames.insert(image, sensor);
        }
    }
    let size = images.iter().map(|i| i.translation.length()).fold(0.0, f64::max);
    let differ = |i: &&ColmapImage| {
        by_frames.get(&i.id).is_some_and(|f| {
            let turn = f.rotation.angle_between(i.rotation).min(f.rotation.angle_between(-i.rotation));
            turn > SAME || f.translation.distance(i.translation) > SAME * size
        })
    };
    let off: Vec<&ColmapImage> = images.iter().filter(differ).collect();
    Ok(off.first().map(|first| {
        Note::warning(format!(
            "{}: images.{extension} and frames.{extension} put {} of {} images at different places ({} the first): images.{extension} is \
             used, COLMAP itself uses frames.{extension}",
            folder.display(),
            off.len(),
            images.len(),
            first.name
        ))
    }))
}

/// Reads `rigs.bin` or `rigs.txt`.
pub fn rigs(file: &Path, bytes: &[u8], binary: bool) -> Result<Rigs, SceneError> {
    if binary { rigs_binary(file, bytes) } else { rigs_text(file, bytes) }
}

/// Reads `frames.bin` or `frames.txt`.
pub fn frames(file: &Path, bytes: &[u8], binary: bool) -> Result<Vec<Frame>, SceneError> {
    if binary { frames_binary(file, bytes) } else { frames_text(file, bytes) }
}

/// The number of a camera's kind of sensor in binary files.
const CAMERA: u32 = 0;

fn rigs_binary(file: &Path, bytes: &[u8]) -> Result<Rigs, SceneError> {
    let mut bytes = Bytes::new(file, bytes);
    let mut rigs = Rigs::new();
    for i in 0..bytes.u64("number of rigs")? {
        let place = format!("rig {i}");
        let (rig, sensors) = (bytes.u32(&place)?, bytes.u32(&place)?);
        for k in 0..sensors {
            let (kind, sensor) = (bytes.u32(&place)?, bytes.u32(&place)?);
            // The first is the rig's own frame.
            if k > 0 && bytes.u8(&place)? != 0 {
                let pose = Rigid::new(bytes.f64s(&place)?);
                if kind == CAMERA {
                    rigs.insert((rig, sensor), pose);
                }
            }
        }
    }
    Ok(rigs)
}

fn frames_binary(file: &Path, bytes: &[u8]) -> Result<Vec<Frame>, SceneError> {
    let mut bytes = Bytes::new(file, bytes);
    let mut frames = Vec::new();
    for i in 0..bytes.u64("number of frames")? {
        let place = format!("frame {i}");
        bytes.u32(&place)?;
        let rig = bytes.u32(&place)?;
        let pose = Rigid::new(bytes.f64s(&place)?);
        let mut data = Vec::new();
        for _ in 0..bytes.u32(&place)? {
            let (kind, sensor, image) = (bytes.u32(&place)?, bytes.u32(&place)?, bytes.u64(&place)?);
            if kind == CAMERA && image <= u64::from(u32::MAX) {
                data.push((sensor, image as u32));
            }
        }
        frames.push((rig, pose, data));
    }
    Ok(frames)
}

/// Lines with something on them: their place, and their words.
fn lines<'a>(file: &Path, bytes: &'a [u8]) -> Result<Vec<(String, std::str::SplitAsciiWhitespace<'a>)>, SceneError> {
    let said =
        text_of(file, bytes)?.lines().enumerate().filter(|(_, l)| !l.trim().is_empty() && !l.trim().starts_with('#'));
    Ok(said.map(|(i, line)| (format!("line {}", i + 1), line.split_ascii_whitespace())).collect())
}

fn pose<'a>(file: &Path, place: &str, words: &mut impl Iterator<Item = &'a str>) -> Result<Rigid, SceneError> {
    let mut v = [0.0; 7];
    for (v, name) in v.iter_mut().zip(["QW", "QX", "QY", "QZ", "TX", "TY", "TZ"]) {
        *v = number(file, place, name, words.next())?;
    }
    Ok(Rigid::new(v))
}

fn rigs_text(file: &Path, bytes: &[u8]) -> Result<Rigs, SceneError> {
    let mut rigs = Rigs::new();
    for (place, mut words) in lines(file, bytes)? {
        let rig = number(file, &place, "RIG_ID", words.next())?;
        let sensors: u32 = number(file, &place, "NUM_SENSORS", words.next())?;
        words.by_ref().nth(1);
        for _ in 1..sensors {
            let kind = words.next();
            let sensor = number(file, &place, "SENSOR_ID", words.next())?;
            if number::<u8>(file, &place, "HAS_POSE", words.next())? != 0 {
                let pose = pose(file, &place, &mut words)?;
                if kind == Some("CAMERA") {
                    rigs.insert((rig, sensor), pose);
                }
            }
        }
    }
    Ok(rigs)
}

fn frames_text(file: &Path, bytes: &[u8]) -> Result<Vec<Frame>, SceneError> {
    let mut frames = Vec::new();
    for (place, mut words) in lines(file, bytes)? {
        number::<u32>(file, &place, "FRAME_ID", words.next())?;
        let rig = number(file, &place, "RIG_ID", words.next())?;
        let pose = pose(file, &place, &mut words)?;
        let mut data = Vec::new();
        for _ in 0..number::<u32>(file, &place, "NUM_DATA_IDS", words.next())? {
            let kind = words.next();
            let sensor = number(file, &place, "SENSOR_ID", words.next())?;
            let image = number(file, &place, "DATA_ID", words.next())?;
            if kind == Some("CAMERA") {
                data.push((sensor, image));
            }
        }
        frames.push((rig, pose, data));
    }
    Ok(frames)
}
