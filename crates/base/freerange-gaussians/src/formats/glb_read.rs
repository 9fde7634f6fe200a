//! Reading `.glb` and `.gltf` with `KHR_gaussian_splatting`. Gaussians come with +y up, through the transforms of their
//! nodes.

use std::{borrow::Cow, collections::HashMap};

use crate::{Gaussians, Harmonics, MAX_DEGREE, Splats, channel, coefficients};
use base64::{Engine, engine::general_purpose::STANDARD};
use freerange_util::{Invalid, Note};
use glam::{DMat3, DMat4, DQuat, DVec3};
use serde::Deserialize;
use serde_json::Value;

use crate::formats::{
    Decoded, Frame,
    bytes::{Beside, Cursor, check_expansion},
    error::{CUT_OFF, json_problem, problem},
    glb::{BINARY, EXTENSION, JSON, MAGIC},
    glb_accessor::{Accessor, View},
    placed::{EXPECTED, Similarity},
    quantize::{Row, color_of_sh, encoded, log_scale, logit, set_rotation},
};

/// Most bytes of a buffer beside a `.gltf`.
const BUFFER_LIMIT: u64 = 1 << 32;

/// What we read of glTF's JSON; all else is left alone.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase", default)]
#[derive(Default)]
struct Gltf {
    extensions_required: Vec<String>,
    scene: Option<usize>,
    scenes: Vec<Scene>,
    nodes: Vec<Node>,
    meshes: Vec<Mesh>,
    accessors: Vec<Accessor>,
    buffer_views: Vec<View>,
    buffers: Vec<Buffer>,
}

#[derive(Deserialize)]
struct Scene {
    #[serde(default)]
    nodes: Vec<usize>,
}

#[derive(Deserialize)]
struct Node {
    mesh: Option<usize>,
    #[serde(default)]
    children: Vec<usize>,
    matrix: Option<[f64; 16]>,
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
    translation: Option<[f64; 3]>,
}

#[derive(Deserialize)]
struct Mesh {
    primitives: Vec<Primitive>,
}

#[derive(Deserialize)]
struct Primitive {
    mode: Option<u32>,
    attributes: HashMap<String, usize>,
    #[serde(default)]
    extensions: HashMap<String, Value>,
}

#[derive(Deserialize)]
struct Buffer {
    uri: Option<String>,
}

pub fn decode(bytes: &[u8], beside: &Beside) -> Result<Decoded, Invalid> {
    let (json, binary) = match bytes.trim_ascii_start() {
        text @ [b'{', ..] => (text, None),
        _ => chunks(bytes)?,
    };
    let gltf: Gltf = serde_json::from_slice(json).map_err(|e| json_problem("JSON", "glTF 2.0", &e))?;
    let known = [EXTENSION, "KHR_mesh_quantization"];
    if let Some(other) = gltf.extensions_required.iter().find(|e| !known.contains(&e.as_str())) {
        return Err(problem("extensionsRequired", known.join(" or "), other));
    }
    let buffers = buffers(&gltf, binary, beside)?;
    let size =
        bytes.len() + buffers.iter().map(|b| if matches!(b, Cow::Owned(_)) { b.len() } else { 0 }).sum::<usize>();
    let file = File { gltf, buffers, size };
    let mut found = Found::default();
    file.placed(|mesh, place| {
        for (p, primitive) in file.gltf.meshes[mesh].primitives.iter().enumerate() {
            match primitive.extensions.get(EXTENSION) {
                Some(extension) => {
                    let name = format!("mesh {mesh}, primitive {p}");
                    file.primitive(&name, primitive, extension, place, &mut found)?;
                }
                None => found.skipped += 1,
            }
        }
        Ok(())
    })?;
    if found.positions.is_empty() {
        let skipped = format!("{} primitives without it", found.skipped);
        return Err(problem("scene", format!("a primitive with {EXTENSION}"), skipped));
    }
    let notes = found.notes();
    let Found { mut splats, positions, .. } = found;
    splats.place(&positions);
    Ok(Decoded { splats, frame: Some(Frame::Y_UP), notes })
}

/// What the primitives of a scene hold.
#[derive(Default)]
struct Found {
    splats: Splats,
    /// Of 64 bits: nodes may move Gaussians far away.
    positions: Vec<DVec3>,
    /// Primitives without Gaussians.
    skipped: usize,
    /// Whether a color space was linear.
    linear: bool,
    /// The highest degree of harmonics in the file.
    degree: usize,
}

impl Found {
    fn notes(&self) -> Vec<Note> {
        let mut notes = Vec::new();
        if self.skipped > 0 {
            notes.push(Note::dropped(format!("{} primitives that are no Gaussians are left out", self.skipped)));
        }
        if self.degree > MAX_DEGREE {
            let text = format!("color that depends on the viewing direction is left out beyond degree {MAX_DEGREE}");
            notes.push(Note::dropped(text));
        }
        if self.linear && self.splats.harmonics.degree() > 0 {
            let text = "colors are linear: turned to sRGB, those that depend on the viewing direction to first order";
            notes.push(Note::changed(text));
        }
        notes
    }
}

/// The buffers that there is anything of: the binary chunk, data in the file, files beside it.
fn buffers<'a>(gltf: &Gltf, binary: Option<&'a [u8]>, beside: &Beside) -> Result<Vec<Cow<'a, [u8]>>, Invalid> {
    const DATA: &str = "data:";
    let read = |(n, buffer): (usize, &Buffer)| {
        let wrong =
            |expected: &str, found: &dyn std::fmt::Display| problem(format!("buffer {n}, uri"), expected, found);
        match (&buffer.uri, binary) {
            (None, Some(binary)) if n == 0 => Ok(Cow::Borrowed(binary)),
            (None, _) => Err(wrong("one, as the binary chunk of a .glb is buffer 0 alone", &"none")),
            (Some(uri), _) => match uri.strip_prefix(DATA) {
                Some(data) => {
                    let Some((_, data)) = data.split_once(";base64,") else {
                        return Err(wrong("base64 data", &"other data"));
                    };
                    Ok(Cow::Owned(STANDARD.decode(data).map_err(|e| wrong("base64 data", &e))?))
                }
                None => {
                    let name =
                        percent_encoding::percent_decode_str(uri).decode_utf8().map_err(|e| wrong("UTF-8", &e))?;
                    Ok(Cow::Owned(beside.file(&name, BUFFER_LIMIT)?))
                }
            },
        }
    };
    gltf.buffers.iter().enumerate().map(read).collect()
}

fn chunks(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>), Invalid> {
    let mut cursor = Cursor { left: bytes };
    if cursor.u32("header")? != MAGIC {
        return Err(problem("header", "\"glTF\"", format!("{:?}", String::from_utf8_lossy(&bytes[..4]))));
    }
    let version = cursor.u32("version")?;
    if version != 2 {
        return Err(problem("version", "2", version));
    }
    let length = cursor.u32("length")?;
    if length as usize != bytes.len() {
        let why = if length as usize > bytes.len() { format!(": {CUT_OFF}") } else { String::new() };
        let expected = format!("{length} bytes, as the header says");
        return Err(problem("length", expected, format!("{}{why}", bytes.len())));
    }
    let (mut json, mut binary) = (None, None);
    while !cursor.left.is_empty() {
        let length = cursor.u32("chunk, length")?;
        let kind = cursor.u32("chunk, type")?;
        let chunk = cursor.take("chunk", length as usize)?;
        match kind {
            JSON if json.is_none() => json = Some(chunk),
            BINARY if binary.is_none() => binary = Some(chunk),
            _ => {} // to be ignored, says the specification
        }
    }
    let json = json.ok_or_else(|| problem("chunks", "one of type JSON", "none"))?;
    Ok((json, Some(binary.unwrap_or_default())))
}

struct File<'a> {
    gltf: Gltf,
    buffers: Vec<Cow<'a, [u8]>>,
    size: usize,
}

impl File<'_> {
    /// Calls `each` with every mesh in the scene and where it is placed.
    fn placed(&self, mut each: impl FnMut(usize, Similarity) -> Result<(), Invalid>) -> Result<(), Invalid> {
        let scene = self.gltf.scene.unwrap_or(0);
        let Some(scene) = self.gltf.scenes.get(scene) else {
            return Err(problem("scene", "the number of a scene", format!("{scene} of {}", self.gltf.scenes.len())));
        };
        let mut seen = vec![false; self.gltf.nodes.len()];
        let mut next: Vec<_> = scene.nodes.iter().rev().map(|n| (*n, Similarity::NONE)).collect();
        while let Some((n, parent)) = next.pop() {
            let Some(node) = self.gltf.nodes.get(n) else {
                return Err(problem("node", format!("a number below {}", self.gltf.nodes.len()), n));
            };
            if std::mem::replace(&mut seen[n], true) {
                return Err(problem(format!("node {n}"), "one parent", "more, or a circle"));
            }
            let own = node.similarity(n)?;
            let place = parent.after(&own);
            match node.mesh {
                Some(mesh) if mesh < self.gltf.meshes.len() => each(mesh, place)?,
                Some(mesh) => {
                    let expected = format!("a number below {}", self.gltf.meshes.len());
                    return Err(problem(format!("node {n}, mesh"), expected, mesh));
                }
                None => {}
            }
            next.extend(node.children.iter().rev().map(|child| (*child, place)));
        }
        Ok(())
    }

    /// Appends the Gaussians of a primitive.
    fn primitive(
        &self,
        name: &str,
        primitive: &Primitive,
        extension: &Value,
        place: Similarity,
        found: &mut Found,
    ) -> Result<(), Invalid> {
        let linear = check_primitive(name, primitive, extension)?;
        let get = |attribute: &str, kind: &str| self.numbers(name, primitive, attribute, kind);
        let positions = get("POSITION", "VEC3")?;
        let rotations = get("KHR_gaussian_splatting:ROTATION", "VEC4")?;
        let scales = get("KHR_gaussian_splatting:SCALE", "VEC3")?;
        let opacities = get("KHR_gaussian_splatting:OPACITY", "SCALAR")?;
        let colors = get("KHR_gaussian_splatting:SH_DEGREE_0_COEF_0", "VEC3")?;
        let count = positions.len() / 3;
        let lengths = [("ROTATION", rotations.len() / 4), ("SCALE", scales.len() / 3), ("OPACITY", opacities.len())];
        for (attribute, length) in [&lengths[..], &[("SH_DEGREE_0_COEF_0", colors.len() / 3)]].concat() {
            if length != count {
                return Err(problem(format!("{name}, {attribute}, count"), count.to_string(), length));
            }
        }
        let (in_file, harmonics) = self.harmonics(name, primitive, count)?;
        // Nodes may show one mesh many times.
        let total = found.positions.len() + count;
        check_expansion("count of Gaussians", total as u64, 4 * (channel::COUNT + harmonics.width()), self.size)?;
        let mut rows = Vec::with_capacity(count * channel::COUNT);
        for i in 0..count {
            let bad = |attribute: &str, expected: &str, found: f32| {
                Err(problem(format!("{name}, {attribute}, element {i}"), expected, found))
            };
            let vector = |values: &[f32]| DVec3::from_array([0, 1, 2].map(|k| f64::from(values[3 * i + k])));
            let mut row = Row::default();
            let mean = place.apply(vector(&positions));
            row[channel::MEAN].copy_from_slice(&mean.as_vec3().to_array());
            found.positions.push(mean);
            for (k, scale) in scales[3 * i..][..3].iter().enumerate() {
                if *scale < 0.0 {
                    return bad("SCALE", "a number, at least 0", *scale);
                }
                row[channel::LOG_SCALE.start + k] = log_scale(f64::from(*scale) * place.scale);
            }
            let q = [0, 1, 2, 3].map(|k| f64::from(rotations[4 * i + k]));
            let turned = place.rotation * DQuat::from_array(q);
            set_rotation(&mut row, [turned.w, turned.x, turned.y, turned.z]);
            if opacities[i] < 0.0 || opacities[i] > 1.0 {
                return bad("OPACITY", "0 to 1", opacities[i]);
            }
            row[channel::LOGIT_OPACITY] = logit(opacities[i].into());
            row[channel::COLOR].copy_from_slice(&vector(&colors).to_array().map(color_of_sh));
            rows.extend(row);
        }
        let mut part = Splats { harmonics, ..Gaussians::from_rows(rows).into() };
        part.harmonics.turn(DMat3::from_quat(place.rotation));
        if linear {
            encode_srgb(&mut part);
        }
        found.linear |= linear;
        found.degree = found.degree.max(in_file);
        found.splats.append(&part);
        Ok(())
    }

    /// The degree of a primitive's harmonics, and what is kept of them.
    fn harmonics(&self, name: &str, primitive: &Primitive, count: usize) -> Result<(usize, Harmonics), Invalid> {
        let attribute = |l: usize, m: usize| format!("{EXTENSION}:SH_DEGREE_{l}_COEF_{m}");
        let in_file = (1..=9).take_while(|l| primitive.attributes.contains_key(&attribute(*l, 0))).count();
        let degree = in_file.min(MAX_DEGREE);
        let width = 3 * coefficients(degree);
        check_expansion("count of Gaussians", count as u64, 4 * width.max(1), self.size)?;
        let mut data = vec![0f32; width * count];
        for (l, m) in (1..=degree).flat_map(|l| (0..2 * l + 1).map(move |m| (l, m))) {
            let values = self.numbers(name, primitive, &attribute(l, m), "VEC3")?;
            if values.len() != 3 * count {
                let field = format!("{name}, SH_DEGREE_{l}_COEF_{m}, count");
                return Err(problem(field, count.to_string(), values.len() / 3));
            }
            let at = 3 * (coefficients(l - 1) + m);
            let rows = data.chunks_exact_mut(width).zip(values.as_chunks::<3>().0);
            rows.for_each(|(row, value)| row[at..at + 3].copy_from_slice(value));
        }
        Ok((in_file, Harmonics::from_rows(degree, data)))
    }

    /// All numbers of an attribute, one element after the other.
    fn numbers(&self, name: &str, primitive: &Primitive, attribute: &str, kind: &str) -> Result<Vec<f32>, Invalid> {
        let problem =
            |expected: &str, found: &dyn std::fmt::Display| problem(format!("{name}, {attribute}"), expected, found);
        let Some(number) = primitive.attributes.get(attribute) else { return Err(problem("it", &"no such attribute")) };
        let accessor = self.gltf.accessors.get(*number).ok_or_else(|| problem("the number of an accessor", number))?;
        accessor.numbers(kind, &self.gltf.buffer_views, &self.buffers, self.size, &problem)
    }
}

/// Refuses what cannot be drawn as ellipses; returns whether colors are linear.
fn check_primitive(name: &str, primitive: &Primitive, extension: &Value) -> Result<bool, Invalid> {
    if primitive.mode != Some(0) {
        let found = primitive.mode.map_or("none".into(), |m| m.to_string());
        return Err(problem(format!("{name}, mode"), "0 (points)", found));
    }
    let field = |field: &str, allowed: &[&str]| {
        let found = extension.get(field).unwrap_or(&Value::Null);
        let at = allowed.iter().position(|a| found == a);
        at.ok_or_else(|| problem(format!("{name}, {EXTENSION}, {field}"), allowed.join(" or "), found))
    };
    field("kernel", &["ellipse"])?;
    let linear = field("colorSpace", &["srgb_rec709_display", "lin_rec709_display"])? == 1;
    if let Some((other, _)) = extension.get("extensions").and_then(Value::as_object).and_then(|e| e.iter().next()) {
        return Err(problem(format!("{name}, {EXTENSION}, extensions"), "none", other));
    }
    Ok(linear)
}

/// Linear colors as sRGB's; harmonics to first order about the constant color.
fn encode_srgb(splats: &mut Splats) {
    let slope = |v: f64| if v <= 0.003_130_8 { 12.92 } else { 1.055 / 2.4 * v.powf(1.0 / 2.4 - 1.0) };
    let width = splats.harmonics.width();
    let mut harmonics = splats.harmonics.rows().to_vec();
    for (i, row) in splats.cloud.iter_mut().enumerate() {
        for (k, c) in channel::COLOR.enumerate() {
            let linear = f64::from(row[c]);
            row[c] = encoded(linear) as f32;
            let rest = harmonics[width * i..][..width].iter_mut().skip(k).step_by(3);
            rest.for_each(|v| *v *= slope(linear) as f32);
        }
    }
    splats.harmonics = Harmonics::from_rows(splats.harmonics.degree(), harmonics);
}

impl Node {
    fn similarity(&self, n: usize) -> Result<Similarity, Invalid> {
        let matrix = match self.matrix {
            Some(m) => DMat4::from_cols_array(&m),
            None => {
                let q = DQuat::from_array(self.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]));
                if !q.length_recip().is_normal() {
                    return Err(problem(format!("node {n}, rotation"), "a quaternion of unit length", q));
                }
                let (scale, translation) = (self.scale.unwrap_or([1.0; 3]), self.translation.unwrap_or_default());
                DMat4::from_scale_rotation_translation(scale.into(), q.normalize(), translation.into())
            }
        };
        Similarity::from_matrix(matrix).ok_or_else(|| problem(format!("node {n}"), EXPECTED, "another transform"))
    }
}
