//! Agisoft Metashape's "Export Cameras", XML.
//!
//! `f`, `cx`, `cy` (an offset from the image's middle), `b1`, `k1` to `k4`, `p1`, `p2` as in the appendix of Metashape's manual: its `p1`,
//! `p2` are OpenCV's `p2`, `p1`. A camera's `transform` is camera to its component, 16 numbers row by row, with OpenCV's axes. A rig's
//! cameras have a master, whose transform they share: theirs follows from their sensor's rotation and location. Results are in the
//! coordinates of the chunk's component, before its transform to the ground; where photos are in several components, each is moved by its
//! own transform, as they have nothing in common without it.

use super::{Cameras, Format, Intrinsics, Photo, Photos, bytes_of, coefficients, pinhole, text_of, world_to_camera};
use crate::camera::{Camera, Lens};
use crate::{SceneError, error::In};
use freerange_util::Note;
use glam::{DMat3, DVec3};
use roxmltree::{Document, Node};
use std::{
    collections::{BTreeMap, HashMap},
    path::Path,
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
        return Err(In(file).unsupported(place, "skew (`b2`)", "optimize the cameras without b2, or undistort first"));
    }
    if value("p3")? != 0.0 || value("p4")? != 0.0 {
        let feature = "tangential distortion of higher order (`p3`, `p4`)";
        return Err(In(file).unsupported(place, feature, "optimize the cameras without p3 and p4, or undistort first"));
    }
    let k = [value("k1")?, value("k2")?, value("k3")?, value("k4")?];
    let p = [value("p2")?, value("p1")?];
    coefficients(file, place, &["k1", "k2", "k3", "k4", "p2", "p1"], &[k.as_slice(), &p].concat())?;
    let principal = [0.5 * size.0 as f64 + value("cx")?, 0.5 * size.1 as f64 + value("cy")?];
    Ok(Sensor { size, focal: [focal + value("b1")?, focal], principal, lens: Lens::brown(k, p) })
}

/// What an export holds.
#[derive(Clone, Debug)]
pub struct Export {
    /// The posed photos.
    pub photos: Vec<Labelled>,
    /// What was passed over.
    pub notes: Vec<Note>,
}

/// A camera's axes (columns) and center in another frame, or a component's: rotation, translation, and a factor on lengths.
#[derive(Clone, Copy)]
struct Placed {
    axes: DMat3,
    center: DVec3,
    scale: f64,
}

impl Placed {
    /// What lies at `inner` in this frame, in the frame that this one lies in.
    fn then(&self, inner: &Self) -> Self {
        Self {
            axes: self.axes * inner.axes,
            center: self.scale * (self.axes * inner.center) + self.center,
            scale: self.scale * inner.scale,
        }
    }
}

/// `N` numbers of an element's text.
fn numbers<const N: usize>(file: &Path, place: &str, node: Node<'_, '_>) -> Result<[f64; N], SceneError> {
    let (name, mut m) = (node.tag_name().name(), [0.0; N]);
    let words: Vec<&str> = node.text().unwrap_or("").split_ascii_whitespace().take(N + 1).collect();
    if words.len() != N {
        return Err(In(file).field(place, name, &format!("{N} numbers"), words.len()));
    }
    for (v, word) in m.iter_mut().zip(words) {
        *v = number(file, place, name, Some(word))?;
    }
    Ok(m)
}

/// A matrix that is written row by row.
fn rows([a, b, c, d, e, f, g, h, i]: [f64; 9]) -> DMat3 {
    DMat3::from_cols(DVec3::new(a, d, g), DVec3::new(b, e, h), DVec3::new(c, f, i))
}

/// A camera's own transform.
fn transform(file: &Path, place: &str, node: Node<'_, '_>) -> Result<Placed, SceneError> {
    let m: [f64; 16] = numbers(file, place, node)?;
    if m[12..] != [0.0, 0.0, 0.0, 1.0] {
        return Err(In(file).field(place, "transform", "a last row of 0 0 0 1", format!("{:?}", &m[12..])));
    }
    let axes = rows([m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]]);
    Ok(Placed { axes, center: DVec3::new(m[3], m[7], m[11]), scale: 1.0 })
}

/// Rotation, location or translation, and scale of a sensor in its rig or of a component; none of them: nothing is moved.
fn offset(
    file: &Path,
    place: &str,
    node: Option<Node<'_, '_>>,
    translation: &str,
) -> Result<Option<Placed>, SceneError> {
    let Some(node) = node else { return Ok(None) };
    let (rotation, shift, scale) = (child(node, "rotation"), child(node, translation), child(node, "scale"));
    if rotation.is_none() && shift.is_none() && scale.is_none() {
        return Ok(None);
    }
    let axes = rotation.map_or(Ok(DMat3::IDENTITY), |n| numbers(file, place, n).map(rows))?;
    let center = shift.map_or(Ok(DVec3::ZERO), |n| numbers(file, place, n).map(DVec3::from_array))?;
    let scale = scale.map_or(Ok(1.0), |n| number(file, place, "scale", n.text()))?;
    let sound = scale > 0.0;
    if !sound {
        return Err(In(file).field(place, "scale", "a number above 0", scale));
    }
    Ok(Some(Placed { axes, center, scale }))
}

/// An export while it is read.
struct Chunk<'a> {
    file: &'a Path,
    /// By their ids, with what messages call them.
    sensors: HashMap<String, (Node<'a, 'a>, String)>,
    cameras: HashMap<String, Node<'a, 'a>>,
    components: BTreeMap<String, Node<'a, 'a>>,
}

impl<'a> Chunk<'a> {
    fn new(file: &'a Path, chunk: Node<'a, 'a>, list: Node<'a, 'a>) -> Self {
        let of = |name: &str, inner: &'static str| {
            child(chunk, name).into_iter().flat_map(move |s| s.children().filter(move |n| n.has_tag_name(inner)))
        };
        let id = |node: Node<'a, 'a>| node.attribute("id").unwrap_or("").to_owned();
        Self {
            file,
            sensors: of("sensors", "sensor").map(|n| (id(n), (n, format!("sensor {:?}", id(n))))).collect(),
            cameras: list.descendants().filter(|n| n.has_tag_name("camera")).map(|n| (id(n), n)).collect(),
            components: of("components", "component").map(|n| (id(n), n)).collect(),
        }
    }

    /// Where a camera is in its component, and which that is; none where it has no pose.
    fn placed(&self, node: Node<'a, 'a>, place: &str) -> Result<Option<(Placed, String)>, SceneError> {
        let component = |n: Node<'a, 'a>| n.attribute("component_id").unwrap_or("").to_owned();
        if let Some(own) = child(node, "transform") {
            return Ok(Some((transform(self.file, place, own)?, component(node))));
        }
        // In a rig only the master has a transform.
        let Some(master) = node.attribute("master_id") else { return Ok(None) };
        let Some(master_node) = self.cameras.get(master).filter(|n| n.id() != node.id()) else {
            return Err(In(self.file).field(place, "master_id", "the id of another camera", master));
        };
        let Some(of_master) = child(*master_node, "transform") else { return Ok(None) };
        let (sensor, sensor_place) = self.sensor(node, place)?;
        let Some(within) = offset(self.file, sensor_place, Some(*sensor), "location")? else {
            let expected = "the sensor's place in its rig, as the camera has a master";
            return Err(In(self.file).field(sensor_place, "rotation", expected, "nothing"));
        };
        let there = transform(self.file, place, of_master)?.then(&within);
        Ok(Some((there, component(*master_node))))
    }

    fn sensor(&self, node: Node<'a, 'a>, place: &str) -> Result<&(Node<'a, 'a>, String), SceneError> {
        let id = node.attribute("sensor_id").unwrap_or("");
        self.sensors.get(id).ok_or_else(|| In(self.file).field(place, "sensor_id", "the id of a sensor", id))
    }
}

/// Reads an export.
pub fn parse(file: &Path, bytes: &[u8]) -> Result<Export, SceneError> {
    let document =
        Document::parse(text_of(file, bytes)?).map_err(|e| In(file).malformed("", format!("not XML: {e}")))?;
    let chunks: Vec<Node<'_, '_>> = document.root_element().children().filter(|n| n.has_tag_name("chunk")).collect();
    let chunk = match chunks.as_slice() {
        [chunk] => *chunk,
        chunks => return Err(In(file).field("document", "chunk", "one chunk", chunks.len())),
    };
    let list =
        child(chunk, "cameras").ok_or_else(|| In(file).field("chunk", "cameras", "a list of cameras", "nothing"))?;
    let chunk = Chunk::new(file, chunk, list);
    let mut posed = Vec::new();
    let (mut without, mut disabled) = (0, 0);
    // Photos may be in groups.
    for node in list.descendants().filter(|n| n.has_tag_name("camera")) {
        let label = node.attribute("label").unwrap_or("").to_owned();
        let place = format!("camera {label:?}");
        if node.attribute("enabled") == Some("false") {
            disabled += 1;
            continue;
        }
        match chunk.placed(node, &place)? {
            Some((placed, component)) => posed.push((node, label, place, placed, component)),
            None => without += 1,
        }
    }
    let mut notes = Vec::new();
    let moves = component_moves(&chunk, posed.iter().map(|(.., component)| component.as_str()), &mut notes)?;
    let mut photos = Vec::new();
    for (node, label, place, placed, component) in posed {
        let Some(moved) = &moves[&component] else { continue };
        let (sensor_node, sensor_place) = chunk.sensor(node, &place)?;
        let s = sensor(file, *sensor_node, sensor_place)?;
        let placed = moved.then(&placed);
        let pose = world_to_camera(file, &place, placed.axes, placed.center)?;
        let camera = pinhole(file, sensor_place, s.size, s.focal, s.principal, pose)?;
        photos.push(Labelled { label, camera, lens: s.lens });
    }
    if without > 0 {
        notes.push(Note::dropped(format!("{without} photos have no pose and are left out")));
    }
    if disabled > 0 {
        notes.push(Note::dropped(format!("{disabled} photos are disabled and are left out")));
    }
    Ok(Export { photos, notes })
}

/// What moves the photos of each component into one frame; none for components that are left out. One component stays as it is.
fn component_moves<'c>(
    chunk: &Chunk<'_>,
    components: impl Iterator<Item = &'c str>,
    notes: &mut Vec<Note>,
) -> Result<HashMap<String, Option<Placed>>, SceneError> {
    const STILL: Placed = Placed { axes: DMat3::IDENTITY, center: DVec3::ZERO, scale: 1.0 };
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    components.for_each(|c| *counts.entry(c).or_default() += 1);
    if counts.len() < 2 {
        notes.push(Note::understood(
            "results are in the coordinates of Metashape's chunk, before its transform to the ground",
        ));
        return Ok(counts.keys().map(|c| ((*c).to_owned(), Some(STILL))).collect());
    }
    let mut moves = HashMap::new();
    for id in counts.keys() {
        let place = format!("component {id:?}");
        let node = chunk.components.get(*id).and_then(|n| child(*n, "transform"));
        moves.insert((*id).to_owned(), offset(chunk.file, &place, node, "translation")?);
    }
    if moves.values().all(Option::is_some) {
        notes.push(Note::understood(format!(
            "photos are in {} of Metashape's components: each is moved by its own transform",
            moves.len()
        )));
        return Ok(moves);
    }
    // Without a transform nothing says how components lie to one another.
    let most = counts.iter().max_by_key(|(_, count)| **count).map_or("", |(id, _)| *id);
    let left: usize = counts.iter().filter(|(id, _)| **id != most).map(|(_, count)| count).sum();
    notes.push(Note::warning(format!(
        "photos are in {} of Metashape's components, which have no transform to a common frame: {left} photos that are not in component \
         {most:?}, the largest, are left out",
        counts.len()
    )));
    Ok(counts.keys().map(|c| ((*c).to_owned(), (*c == most).then_some(STILL))).collect())
}

pub(super) fn read(file: &Path, images: Option<&Path>) -> Result<Cameras, SceneError> {
    let Export { photos: labeled, mut notes } = parse(file, &bytes_of(file)?)?;
    let mut found = Photos::beside(file, images);
    let mut photos = Vec::new();
    for l in labeled {
        if let Some(image) = found.find(&l.label)? {
            let intrinsics = Intrinsics::Pixels(l.camera);
            photos.push(Photo { name: l.label, image, mask: None, intrinsics, lens: l.lens, further: false });
        }
    }
    found.finish(&mut notes)?;
    Ok(Cameras::new(Format::Metashape, photos, vec![file.into()], notes))
}
