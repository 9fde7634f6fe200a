//! Agisoft Metashape's "Export Cameras", XML.
//!
//! `f`, `cx`, `cy` (an offset from the image's middle), `b1`, `k1` to `k4`, `p1`, `p2` as in the appendix of Metashape's manual: its `p1`,
//! `p2` are OpenCV's `p2`, `p1`. A camera's `transform` is camera to chunk, 16 numbers row by row, with OpenCV's axes. Results are in the
//! chunk's own coordinates; the chunk's or component's transform to the ground is not applied.

use super::{
    Cameras, Format, Intrinsics, Photo, bytes_of, coefficients, find_image, pinhole, text_of, world_to_camera,
};
use crate::{SceneError, error::In};
use freerange_camera::{Camera, Lens};
use glam::{DMat3, DVec3};
use roxmltree::{Document, Node};
use std::{
    collections::HashMap,
    path::{Path, PathBuf},
};

/// Whether a file's beginning looks like one of these.
pub(super) fn is_one(start: &[u8]) -> bool {
    let text = String::from_utf8_lossy(start);
    text.contains("<document") && text.contains("<chunk")
}

/// A posed photo: its label, camera and lens.
#[derive(Clone, Debug)]
pub struct Labelled {
    /// The photo's label: mostly its file name, with or without extension.
    pub label: String,
    /// Its camera.
    pub camera: Camera,
    /// Its lens.
    pub lens: Lens,
}

fn child<'a>(node: Node<'a, 'a>, name: &str) -> Option<Node<'a, 'a>> {
    node.children().find(|n| n.has_tag_name(name))
}

fn number(file: &Path, place: &str, name: &str, text: Option<&str>) -> Result<f64, SceneError> {
    let text = text.unwrap_or("nothing").trim();
    let value = text.parse().ok().filter(|v: &f64| v.is_finite());
    value.ok_or_else(|| In(file).field(place, name, "a number", text))
}

struct Sensor {
    size: (u64, u64),
    focal: [f64; 2],
    principal: [f64; 2],
    lens: Lens,
}

fn sensor(file: &Path, node: Node<'_, '_>, place: &str) -> Result<Sensor, SceneError> {
    if let Some(kind) = node.attribute("type").filter(|t| *t != "frame") {
        return Err(In(file).unsupported(place, format!("the sensor type {kind}"), "undistort the photos first"));
    }
    // The adjusted calibration, where there are two.
    let calibrations: Vec<Node<'_, '_>> = node.children().filter(|n| n.has_tag_name("calibration")).collect();
    let adjusted = calibrations.iter().find(|n| n.attribute("class") == Some("adjusted"));
    let Some(calibration) = adjusted.or(calibrations.first()) else {
        return Err(In(file).field(place, "calibration", "a calibration", "nothing"));
    };
    let resolution = calibration.children().chain(node.children()).find(|n| n.has_tag_name("resolution"));
    let side = |name: &str| {
        let v = number(file, place, name, resolution.and_then(|r| r.attribute(name)))?;
        match v.fract() == 0.0 && v > 0.0 {
            true => Ok(v as u64),
            false => Err(In(file).field(place, name, "a whole number of pixels", v)),
        }
    };
    let value = |name: &str| match calibration.children().find(|n| n.has_tag_name(name)) {
        Some(n) => number(file, place, name, n.text()),
        None => Ok(0.0),
    };
    let size = (side("width")?, side("height")?);
    let focal = match calibration.children().find(|n| n.has_tag_name("f")) {
        Some(n) => number(file, place, "f", n.text())?,
        None => return Err(In(file).field(place, "f", "a focal length in pixels", "nothing")),
    };
    if value("b2")? != 0.0 {
        return Err(In(file).unsupported(place, "skew (`b2`)", "optimise the cameras without b2, or undistort first"));
    }
    let k = [value("k1")?, value("k2")?, value("k3")?, value("k4")?];
    let p = [value("p2")?, value("p1")?];
    coefficients(file, place, &["k1", "k2", "k3", "k4", "p2", "p1"], &[k.as_slice(), &p].concat())?;
    let principal = [0.5 * size.0 as f64 + value("cx")?, 0.5 * size.1 as f64 + value("cy")?];
    Ok(Sensor { size, focal: [focal + value("b1")?, focal], principal, lens: Lens::brown(k, p) })
}

/// The posed photos of an export, and how many photos have no pose.
pub fn parse(file: &Path, bytes: &[u8]) -> Result<(Vec<Labelled>, usize), SceneError> {
    let document =
        Document::parse(text_of(file, bytes)?).map_err(|e| In(file).malformed("", format!("not XML: {e}")))?;
    let chunks: Vec<Node<'_, '_>> = document.root_element().children().filter(|n| n.has_tag_name("chunk")).collect();
    let chunk = match chunks.as_slice() {
        [chunk] => *chunk,
        chunks => return Err(In(file).field("document", "chunk", "one chunk", chunks.len())),
    };
    let mut sensors = HashMap::new();
    for node in child(chunk, "sensors").into_iter().flat_map(|s| s.children()).filter(|n| n.has_tag_name("sensor")) {
        let id = node.attribute("id").unwrap_or("");
        sensors.insert(id.to_owned(), (node, format!("sensor {id:?}")));
    }
    let mut photos = Vec::new();
    let mut without = 0;
    let list =
        child(chunk, "cameras").ok_or_else(|| In(file).field("chunk", "cameras", "a list of cameras", "nothing"))?;
    // Photos may be in groups.
    for node in list.descendants().filter(|n| n.has_tag_name("camera")) {
        let label = node.attribute("label").unwrap_or("").to_owned();
        let place = format!("camera {label:?}");
        let Some(transform) = child(node, "transform").filter(|_| node.attribute("enabled") != Some("false")) else {
            without += 1;
            continue;
        };
        let words: Vec<&str> = transform.text().unwrap_or("").split_ascii_whitespace().take(17).collect();
        let mut m = [0.0; 16];
        if words.len() != 16 {
            return Err(In(file).field(&place, "transform", "16 numbers", words.len()));
        }
        for (v, word) in m.iter_mut().zip(words) {
            *v = number(file, &place, "transform", Some(word))?;
        }
        if m[12..] != [0.0, 0.0, 0.0, 1.0] {
            return Err(In(file).field(&place, "transform", "a last row of 0 0 0 1", format!("{:?}", &m[12..])));
        }
        let id = node.attribute("sensor_id").unwrap_or("");
        let Some((sensor_node, sensor_place)) = sensors.get(id) else {
            return Err(In(file).field(&place, "sensor_id", "the id of a sensor", id));
        };
        let s = sensor(file, *sensor_node, sensor_place)?;
        let column = |j: usize| DVec3::new(m[j], m[4 + j], m[8 + j]);
        let pose = world_to_camera(file, &place, DMat3::from_cols(column(0), column(1), column(2)), column(3))?;
        let camera = pinhole(file, sensor_place, s.size, s.focal, s.principal, pose)?;
        photos.push(Labelled { label, camera, lens: s.lens });
    }
    Ok((photos, without))
}

pub(super) fn read(file: &Path, images: Option<&Path>) -> Result<Cameras, SceneError> {
    let (labelled, without) = parse(file, &bytes_of(file)?)?;
    let folder = file.parent().unwrap_or(Path::new(""));
    let folders: Vec<PathBuf> = match images {
        Some(images) => vec![images.to_path_buf()],
        None => vec![folder.join("images"), folder.to_path_buf()],
    };
    let photos = labelled
        .into_iter()
        .map(|l| {
            let image = find_image(&file.display().to_string(), &l.label, &folders)?;
            let intrinsics = Intrinsics::Pixels(l.camera);
            Ok(Photo { name: l.label, image, mask: None, intrinsics, lens: l.lens, further: false })
        })
        .collect::<Result<Vec<_>, SceneError>>()?;
    let mut notes =
        vec!["results are in the coordinates of Metashape's chunk, before its transform to the ground".into()];
    if without > 0 {
        notes.push(format!("{without} photos have no pose or are disabled: not used"));
    }
    Ok(Cameras { format: Format::Metashape, photos, files: vec![file.into()], notes })
}
