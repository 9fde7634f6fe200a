//! `.glb`: binary glTF 2.0 with `KHR_gaussian_splatting`.
//!
//! One node, whose rotation takes the user's frame to glTF's (+y up), with a mesh of one primitive of points.
//! Attributes are in the user's frame: `POSITION`, `KHR_gaussian_splatting:ROTATION` (`x y z w`), `:SCALE` (standard
//! deviations), `:OPACITY`, `:SH_DEGREE_0_COEF_0` and those above, and `COLOR_0` (linear, with opacity) for viewers that
//! show points only. Where positions are relative to an origin far away, the node's translation (of 64 bits) is it.
//! Source: the Khronos registry of extensions.

use crate::{Gaussians, Splats, channel, coefficients};
use glam::DVec3;
use serde_json::{Value, json};

use crate::formats::{
    Encoded, Frame,
    quantize::{linear, sh_of_color, unorm8},
};

/// The extension's name, and what its attributes' names begin with.
pub const EXTENSION: &str = "KHR_gaussian_splatting";
/// "glTF", and the types of its chunks.
pub const MAGIC: u32 = 0x4654_6c67;
pub const JSON: u32 = 0x4e4f_534a;
pub const BINARY: u32 = 0x004e_4942;
/// The type of components that are floats, and bytes.
pub const FLOAT: u32 = 5126;
pub const UNSIGNED_BYTE: u32 = 5121;

pub fn encode(splats: &Splats, frame: Frame) -> Encoded {
    let cloud = &splats.cloud;
    let mut file = Builder { cloud, binary: Vec::new(), views: Vec::new(), accessors: Vec::new() };
    let f32s = |values: &[f32]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let largest = f64::from(f32::MAX);
    let position = file.attribute("VEC3", FLOAT, |i| f32s(&cloud.row(i)[channel::MEAN]));
    let color = file.attribute("VEC4", UNSIGNED_BYTE, |i| {
        let [r, g, b] = cloud.color(i).to_array().map(|c| unorm8(linear(c.clamp(0.0, 1.0))));
        vec![r, g, b, unorm8(cloud.opacity(i))]
    });
    let rotation = file.attribute("VEC4", FLOAT, |i| f32s(&cloud.rotation(i).to_array().map(|v| v as f32)));
    let scale = file.attribute("VEC3", FLOAT, |i| f32s(&cloud.scale(i).to_array().map(|v| v.min(largest) as f32)));
    let opacity = file.attribute("SCALAR", FLOAT, |i| f32s(&[cloud.opacity(i) as f32]));
    let harmonic = file.attribute("VEC3", FLOAT, |i| f32s(&[11, 12, 13].map(|c| sh_of_color(cloud.row(i)[c]) as f32)));
    // Positions must say where they lie.
    let column = |c: usize| cloud.iter().map(move |row| row[c]);
    file.accessors[position]["min"] = json!([0, 1, 2].map(|c| column(c).fold(f32::INFINITY, f32::min)));
    file.accessors[position]["max"] = json!([0, 1, 2].map(|c| column(c).fold(f32::NEG_INFINITY, f32::max)));

    let mut attributes = json!({
        "POSITION": position,
        "COLOR_0": color,
        "KHR_gaussian_splatting:ROTATION": rotation,
        "KHR_gaussian_splatting:SCALE": scale,
        "KHR_gaussian_splatting:OPACITY": opacity,
        "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0": harmonic,
    });
    for l in 1..=splats.harmonics.degree() {
        for m in 0..2 * l + 1 {
            let at = 3 * (coefficients(l - 1) + m);
            let name = format!("{EXTENSION}:SH_DEGREE_{l}_COEF_{m}");
            attributes[name] = file.attribute("VEC3", FLOAT, |i| f32s(&splats.harmonics.row(i)[at..at + 3])).into();
        }
    }
    let turn = frame.to(Frame::Y_UP);
    let mut node = json!({ "mesh": 0, "rotation": turn.to_array() });
    if splats.origin != DVec3::ZERO {
        node["translation"] = json!((turn * splats.origin).to_array());
    }
    let splatting = json!({ EXTENSION: { "kernel": "ellipse", "colorSpace": "srgb_rec709_display" } });
    let json = json!({
        "asset": { "version": "2.0", "generator": concat!("free-range ", env!("CARGO_PKG_VERSION")) },
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [node],
        "meshes": [{ "primitives": [{ "mode": 0, "attributes": attributes, "extensions": splatting }] }],
        "accessors": file.accessors,
        "bufferViews": file.views,
        "buffers": [{ "byteLength": file.binary.len() }],
    });
    let json = serde_json::to_vec(&json).expect("finite numbers and strings");
    Encoded { bytes: container(json, file.binary), notes: Vec::new() }
}

/// Header and two chunks.
fn container(mut json: Vec<u8>, mut binary: Vec<u8>) -> Vec<u8> {
    json.resize(json.len().next_multiple_of(4), b' ');
    binary.resize(binary.len().next_multiple_of(4), 0);
    let mut file = Vec::with_capacity(28 + json.len() + binary.len());
    for word in [MAGIC, 2, (28 + json.len() + binary.len()) as u32, json.len() as u32, JSON] {
        file.extend(word.to_le_bytes());
    }
    file.extend(json);
    file.extend((binary.len() as u32).to_le_bytes());
    file.extend(BINARY.to_le_bytes());
    file.extend(binary);
    file
}

struct Builder<'a> {
    cloud: &'a Gaussians,
    binary: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Builder<'_> {
    /// Appends an attribute of all Gaussians, whole words each, and returns the number of its accessor.
    fn attribute(&mut self, kind: &str, component: u32, of: impl Fn(usize) -> Vec<u8>) -> usize {
        const ARRAY_BUFFER: u32 = 34962;
        let start = self.binary.len();
        (0..self.cloud.len()).for_each(|i| self.binary.extend(of(i)));
        let length = self.binary.len() - start;
        self.views.push(json!({ "buffer": 0, "byteOffset": start, "byteLength": length, "target": ARRAY_BUFFER }));
        let view = self.views.len() - 1;
        let mut accessor =
            json!({ "bufferView": view, "componentType": component, "count": self.cloud.len(), "type": kind });
        if component != FLOAT {
            accessor["normalized"] = true.into();
        }
        self.accessors.push(accessor);
        view
    }
}
