//! Reading `.glb` with `KHR_gaussian_splatting`. Gaussians come with +y up, through the transforms of their nodes.

use std::collections::HashMap;

use freerange_core::Invalid;
use freerange_splat::{Cloud, channel};
use glam::{DMat3, DMat4, DQuat, DVec3};
use serde::Deserialize;
use serde_json::Value;

use crate::{
    Loaded,
    bytes::{Cursor, check_expansion},
    error::problem,
    glb::{BINARY, EXTENSION, JSON, MAGIC},
    quantize::{Row, color_of_sh, log_scale, logit, set_rotation},
};

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
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: usize,
    component_type: u32,
    #[serde(default)]
    normalized: bool,
    count: usize,
    r#type: String,
    sparse: Option<Value>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct View {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
    #[serde(default)]
    extensions: HashMap<String, Value>,
}

#[derive(Deserialize)]
struct Buffer {
    uri: Option<Value>,
}

/// `x -> scale * rotation * x + translation`.
#[derive(Clone, Copy)]
struct Similarity {
    scale: f64,
    rotation: DQuat,
    translation: DVec3,
}

pub fn decode(bytes: &[u8]) -> Result<Loaded, Invalid> {
    let (json, binary) = chunks(bytes)?;
    let gltf: Gltf = serde_json::from_slice(json).map_err(|e| problem("JSON chunk", "glTF 2.0", e))?;
    let known = [EXTENSION, "KHR_mesh_quantization"];
    if let Some(other) = gltf.extensions_required.iter().find(|e| !known.contains(&e.as_str())) {
        return Err(problem("extensionsRequired", known.join(" or "), other));
    }
    let file = File { gltf, binary, size: bytes.len() };
    let mut rows = Vec::new();
    let mut skipped = 0;
    file.placed(|mesh, place| {
        for (p, primitive) in file.gltf.meshes[mesh].primitives.iter().enumerate() {
            match primitive.extensions.get(EXTENSION) {
                Some(extension) => {
                    file.primitive(&format!("mesh {mesh}, primitive {p}"), primitive, extension, place, &mut rows)?
                }
                None => skipped += 1,
            }
        }
        Ok(())
    })?;
    if rows.is_empty() {
        let found = format!("{skipped} primitives without it");
        return Err(problem("scene", format!("a primitive with {EXTENSION}"), found));
    }
    let mut notes = Vec::new();
    if skipped > 0 {
        notes.push(format!("{skipped} primitives that are no Gaussians are left out"));
    }
    let splats = file.gltf.meshes.iter().flat_map(|m| &m.primitives);
    if splats.flat_map(|p| p.attributes.keys()).any(|name| name.contains(":SH_DEGREE_1")) {
        notes.push("SH_DEGREE_1 and higher (colour that depends on the viewing direction) are left out".into());
    }
    Ok(Loaded { cloud: Cloud::from_rows(rows), notes })
}

/// The JSON and the binary chunk; the latter may be missing.
fn chunks(bytes: &[u8]) -> Result<(&[u8], &[u8]), Invalid> {
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
        return Err(problem("length", format!("{} as the file", bytes.len()), length));
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
    Ok((json, binary.unwrap_or_default()))
}

struct File<'a> {
    gltf: Gltf,
    binary: &'a [u8],
    size: usize,
}

impl File<'_> {
    /// Calls `each` with every mesh in the scene and where it is placed.
    fn placed(&self, mut each: impl FnMut(usize, Similarity) -> Result<(), Invalid>) -> Result<(), Invalid> {
        let scene = self.gltf.scene.unwrap_or(0);
        let Some(scene) = self.gltf.scenes.get(scene) else {
            return Err(problem("scene", "the number of a scene", format!("{scene} of {}", self.gltf.scenes.len())));
        };
        let origin = Similarity { scale: 1.0, rotation: DQuat::IDENTITY, translation: DVec3::ZERO };
        let mut seen = vec![false; self.gltf.nodes.len()];
        let mut next: Vec<_> = scene.nodes.iter().rev().map(|n| (*n, origin)).collect();
        while let Some((n, parent)) = next.pop() {
            let Some(node) = self.gltf.nodes.get(n) else {
                return Err(problem("node", format!("a number below {}", self.gltf.nodes.len()), n));
            };
            if std::mem::replace(&mut seen[n], true) {
                return Err(problem(format!("node {n}"), "one parent", "more, or a circle"));
            }
            let own = node.similarity(n)?;
            let place = Similarity {
                scale: parent.scale * own.scale,
                rotation: parent.rotation * own.rotation,
                translation: parent.translation + parent.scale * (parent.rotation * own.translation),
            };
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
        rows: &mut Vec<f32>,
    ) -> Result<(), Invalid> {
        if primitive.mode != Some(0) {
            let found = primitive.mode.map_or("none".into(), |m| m.to_string());
            return Err(problem(format!("{name}, mode"), "0 (points)", found));
        }
        let must = [("kernel", "ellipse"), ("colorSpace", "srgb_rec709_display")];
        for (field, expected) in must {
            let found = extension.get(field).unwrap_or(&Value::Null);
            if found != expected {
                return Err(problem(format!("{name}, {EXTENSION}, {field}"), expected, found));
            }
        }
        if let Some((other, _)) = extension.get("extensions").and_then(Value::as_object).and_then(|e| e.iter().next()) {
            return Err(problem(format!("{name}, {EXTENSION}, extensions"), "none", other));
        }
        let get = |attribute: &str, kind: &str| self.numbers(name, primitive, attribute, kind);
        let positions = get("POSITION", "VEC3")?;
        let rotations = get("KHR_gaussian_splatting:ROTATION", "VEC4")?;
        let scales = get("KHR_gaussian_splatting:SCALE", "VEC3")?;
        let opacities = get("KHR_gaussian_splatting:OPACITY", "SCALAR")?;
        let colors = get("KHR_gaussian_splatting:SH_DEGREE_0_COEF_0", "VEC3")?;
        let count = positions.len() / 3;
        let lengths = [("ROTATION", rotations.len() / 4), ("SCALE", scales.len() / 3), ("OPACITY", opacities.len())];
        for (attribute, found) in [&lengths[..], &[("SH_DEGREE_0_COEF_0", colors.len() / 3)]].concat() {
            if found != count {
                return Err(problem(format!("{name}, {attribute}, count"), count.to_string(), found));
            }
        }
        // Nodes may show one mesh many times.
        let total = rows.len() / channel::COUNT + count;
        check_expansion("count of Gaussians", total as u64, 4 * channel::COUNT, self.size)?;
        for i in 0..count {
            let bad = |attribute: &str, expected: &str, found: f32| {
                Err(problem(format!("{name}, {attribute}, element {i}"), expected, found))
            };
            let vector = |values: &[f32]| DVec3::from_array([0, 1, 2].map(|k| f64::from(values[3 * i + k])));
            let mut row = Row::default();
            let mean = place.scale * (place.rotation * vector(&positions)) + place.translation;
            row[channel::MEAN].copy_from_slice(&mean.as_vec3().to_array());
            for (k, scale) in scales[3 * i..][..3].iter().enumerate() {
                if !(*scale >= 0.0 && scale.is_finite()) {
                    return bad("SCALE", "a number, at least 0", *scale);
                }
                row[channel::LOG_SCALE.start + k] = log_scale(f64::from(*scale) * place.scale);
            }
            let q = [0, 1, 2, 3].map(|k| f64::from(rotations[4 * i + k]));
            let turned = place.rotation * DQuat::from_array(q);
            set_rotation(&mut row, [turned.w, turned.x, turned.y, turned.z]);
            if !(0.0..=1.0).contains(&opacities[i]) {
                return bad("OPACITY", "0 to 1", opacities[i]);
            }
            row[channel::LOGIT_OPACITY] = logit(opacities[i].into());
            row[channel::COLOR].copy_from_slice(&vector(&colors).to_array().map(color_of_sh));
            rows.extend(row);
        }
        Ok(())
    }

    /// All numbers of an attribute, one element after the other.
    fn numbers(&self, name: &str, primitive: &Primitive, attribute: &str, kind: &str) -> Result<Vec<f32>, Invalid> {
        let problem =
            |expected: &str, found: &dyn std::fmt::Display| problem(format!("{name}, {attribute}"), expected, found);
        let Some(number) = primitive.attributes.get(attribute) else { return Err(problem("it", &"no such attribute")) };
        let accessor = self.gltf.accessors.get(*number).ok_or_else(|| problem("the number of an accessor", number))?;
        if accessor.r#type != kind {
            return Err(problem(kind, &accessor.r#type));
        }
        if accessor.sparse.is_some() {
            return Err(problem("an accessor that is not sparse", &"a sparse one"));
        }
        let Some(view) = accessor.buffer_view.and_then(|v| self.gltf.buffer_views.get(v)) else {
            return Err(problem("a buffer view", &"none"));
        };
        if let Some(other) = view.extensions.keys().next() {
            return Err(problem("a buffer view without extensions", other));
        }
        if view.buffer != 0 || self.gltf.buffers.first().is_none_or(|b| b.uri.is_some()) {
            return Err(problem("the binary chunk of this file", &"another buffer"));
        }
        // Of the component: bytes, and what to divide by where it stands for 0..1 or -1..1.
        let (bytes, whole) = match accessor.component_type {
            5120 => (1, 127.0),
            5121 => (1, 255.0),
            5122 => (2, 32767.0),
            5123 => (2, 65535.0),
            5126 => (4, 1.0),
            other => return Err(problem("a component type of 5120 to 5123 or 5126", &other)),
        };
        let components = match kind {
            "VEC4" => 4,
            "VEC3" => 3,
            _ => 1,
        };
        let element = bytes * components;
        let stride = view.byte_stride.unwrap_or(element);
        if stride < element {
            return Err(problem("a byteStride of at least one element", &stride));
        }
        // Everything below is checked against the bytes that are there.
        let slice =
            view.byte_offset.checked_add(view.byte_length).and_then(|end| self.binary.get(view.byte_offset..end));
        let end = accessor.count.checked_sub(1).and_then(|n| n.checked_mul(stride)?.checked_add(element));
        let slice = match (slice, end) {
            (Some(_), None) if accessor.count == 0 => return Ok(Vec::new()),
            (Some(slice), Some(end)) => {
                let end = accessor.byte_offset.checked_add(end);
                end.and_then(|end| slice.get(accessor.byte_offset..end))
            }
            _ => None,
        };
        let Some(slice) = slice else {
            return Err(problem(
                "bytes within the binary chunk",
                &format!("{} elements beyond its end", accessor.count),
            ));
        };
        let divisor = if accessor.normalized { whole } else { 1.0 };
        let least = if accessor.normalized { -1.0 } else { f32::NEG_INFINITY };
        let component = |b: &[u8]| match accessor.component_type {
            5120 => (f32::from(b[0] as i8) / divisor).max(least),
            5121 => f32::from(b[0]) / divisor,
            5122 => (f32::from(i16::from_le_bytes([b[0], b[1]])) / divisor).max(least),
            5123 => f32::from(u16::from_le_bytes([b[0], b[1]])) / divisor,
            _ => f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
        };
        let elements = slice.chunks(stride).take(accessor.count);
        Ok(elements.flat_map(|e| e[..element].chunks_exact(bytes).map(component)).collect())
    }
}

impl Node {
    fn similarity(&self, n: usize) -> Result<Similarity, Invalid> {
        let (axes, translation) = match self.matrix {
            Some(m) => {
                let m = DMat4::from_cols_array(&m);
                (DMat3::from_mat4(m), m.w_axis.truncate())
            }
            None => {
                let q = DQuat::from_array(self.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]));
                if !q.length_recip().is_normal() {
                    return Err(problem(format!("node {n}, rotation"), "a quaternion of unit length", q));
                }
                let scale = DMat3::from_diagonal(self.scale.unwrap_or([1.0; 3]).into());
                (DMat3::from_quat(q.normalize()) * scale, self.translation.unwrap_or_default().into())
            }
        };
        let scale = axes.determinant().cbrt();
        let rotation = axes * scale.recip();
        let defect = (rotation.transpose() * rotation - DMat3::IDENTITY).to_cols_array();
        // Phrased so that what is not a number fails, too.
        if !(scale > 0.0 && defect.iter().all(|d| d.abs() < 1e-4) && translation.is_finite()) {
            let expected = "rotation, translation and the same positive scale along all axes, since Gaussians have \
                            perpendicular axes";
            return Err(problem(format!("node {n}"), expected, "another transform"));
        }
        Ok(Similarity { scale, rotation: DQuat::from_mat3(&rotation).normalize(), translation })
    }
}
