//! Mesh files: `.glb`, `.ply`, `.obj`.

use std::{
    io::{Cursor, Write},
    path::Path,
};

use freerange_util::{IoError, write_atomically};
use glam::{DMat3, DQuat, DVec3, Vec3};
use image::ImageFormat;
use serde_json::json;

use crate::meshing::{Shape, SurfaceError};

/// The kinds of mesh file that are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MeshFormat {
    /// `.glb`: binary glTF, +y up by its node's rotation; linear vertex colors, or a texture.
    Glb,
    /// `.ply`: in the frame of the Gaussians; vertex colors as sRGB bytes.
    Ply,
    /// `.obj`: in the frame of the Gaussians; vertex colors after the positions, as several programs read them.
    Obj,
}

impl MeshFormat {
    /// All formats.
    pub const ALL: [Self; 3] = [Self::Glb, Self::Ply, Self::Obj];

    /// The extension of its files, without the dot.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Glb => "glb",
            Self::Ply => "ply",
            Self::Obj => "obj",
        }
    }

    /// The format of the file `path`, by its extension.
    ///
    /// # Errors
    /// [`SurfaceError::Unknown`].
    pub fn of(path: &Path) -> Result<Self, SurfaceError> {
        let is = |name: &str| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(name));
        Self::ALL.into_iter().find(|f| is(f.extension())).ok_or_else(|| SurfaceError::unknown(path))
    }

    /// The same, for a mesh with a texture or without.
    ///
    /// # Errors
    /// [`SurfaceError::Unknown`]; [`SurfaceError::NoTexture`] for all but `.glb`.
    pub fn with_texture(path: &Path, texture: bool) -> Result<Self, SurfaceError> {
        match Self::of(path)? {
            format @ (Self::Ply | Self::Obj) if texture => Err(SurfaceError::NoTexture { file: path.into(), format }),
            format => Ok(format),
        }
    }
}

impl std::fmt::Display for MeshFormat {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.extension())
    }
}

/// Writes a mesh to a file of the format of its extension, first beside it and then renamed. `y_up` turns its frame to
/// the one with +y up.
///
/// # Errors
/// [`SurfaceError::Unknown`], [`SurfaceError::NoTexture`], [`SurfaceError::Io`].
pub fn save(shape: &Shape, path: &Path, y_up: DQuat) -> Result<(), SurfaceError> {
    let bytes = match MeshFormat::with_texture(path, shape.texture.is_some())? {
        MeshFormat::Glb => glb(shape, y_up),
        MeshFormat::Ply => ply(shape),
        MeshFormat::Obj => obj(shape),
    };
    Ok(write_atomically(path, |w| w.write_all(&bytes)).map_err(IoError::at(path))?)
}

fn linear(encoded: f32) -> f32 {
    if encoded <= 0.04045 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) }
}

fn glb(shape: &Shape, y_up: DQuat) -> Vec<u8> {
    const FLOAT: u32 = 5126;
    const UNSIGNED_INT: u32 = 5125;
    let mut binary: Vec<u8> = Vec::new();
    let (mut views, mut accessors) = (Vec::new(), Vec::new());
    let mut add = |bytes: Vec<u8>, component: u32, kind: &str, count: usize, target: u32| {
        let view = json!({ "buffer": 0, "byteOffset": binary.len(), "byteLength": bytes.len(), "target": target });
        views.push(view);
        binary.extend(bytes);
        accessors
            .push(json!({ "bufferView": views.len() - 1, "componentType": component, "count": count, "type": kind }));
        views.len() - 1
    };
    let vectors =
        |values: &[Vec3]| values.iter().flat_map(|v| v.to_array()).flat_map(f32::to_le_bytes).collect::<Vec<u8>>();
    let n = shape.positions.len();
    let position = add(vectors(&shape.positions), FLOAT, "VEC3", n, 34962);
    let normal = add(vectors(&shape.normals), FLOAT, "VEC3", n, 34962);
    let mut attributes = json!({ "POSITION": position, "NORMAL": normal });
    if !shape.colors.is_empty() {
        let colors: Vec<Vec3> = shape.colors.iter().map(|c| c.map(linear)).collect();
        attributes["COLOR_0"] = add(vectors(&colors), FLOAT, "VEC3", n, 34962).into();
    }
    let mut material = json!({
        "pbrMetallicRoughness": { "metallicFactor": 0.0, "roughnessFactor": 1.0 },
        // The light is in the colors.
        "extensions": { "KHR_materials_unlit": {} },
    });
    if let Some(texture) = &shape.texture {
        let uvs = texture.uvs.iter().flat_map(|v| v.to_array()).flat_map(f32::to_le_bytes).collect();
        attributes["TEXCOORD_0"] = add(uvs, FLOAT, "VEC2", n, 34962).into();
        material["pbrMetallicRoughness"]["baseColorTexture"] = json!({ "index": 0 });
    }
    let indices = shape.triangles.iter().flatten().flat_map(|i| i.to_le_bytes()).collect();
    let index = add(indices, UNSIGNED_INT, "SCALAR", 3 * shape.triangles.len(), 34963);
    let corner =
        |pick: fn(Vec3, Vec3) -> Vec3| shape.positions.iter().copied().reduce(pick).unwrap_or_default().to_array();
    accessors[position]["min"] = json!(corner(Vec3::min));
    accessors[position]["max"] = json!(corner(Vec3::max));
    let picture = shape.texture.as_ref().map(|texture| {
        let mut png = Cursor::new(Vec::new());
        texture.image.write_to(&mut png, ImageFormat::Png).expect("a picture in memory");
        let png = png.into_inner();
        views.push(json!({ "buffer": 0, "byteOffset": binary.len(), "byteLength": png.len() }));
        binary.extend(png);
        views.len() - 1
    });
    let mut node = json!({ "mesh": 0, "rotation": y_up.to_array() });
    if shape.origin != DVec3::ZERO {
        node["translation"] = json!((y_up * shape.origin).to_array());
    }
    let mut json = json!({
        "asset": { "version": "2.0", "generator": concat!("free-range ", env!("CARGO_PKG_VERSION")) },
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [node],
        "meshes": [{ "primitives": [{ "attributes": attributes, "indices": index, "material": 0 }] }],
        "extensionsUsed": ["KHR_materials_unlit"],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{ "byteLength": binary.len() }],
    });
    if let Some(view) = picture {
        json["images"] = json!([{ "bufferView": view, "mimeType": "image/png" }]);
        // Linear, with smaller copies, and no repetition.
        json["samplers"] = json!([{ "magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071 }]);
        json["textures"] = json!([{ "source": 0, "sampler": 0 }]);
    }
    let mut json = serde_json::to_vec(&json).expect("finite numbers and strings");
    json.resize(json.len().next_multiple_of(4), b' ');
    binary.resize(binary.len().next_multiple_of(4), 0);
    let words = |values: &[u32]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
    let total = (28 + json.len() + binary.len()) as u32;
    let head = words(&[0x4654_6c67, 2, total, json.len() as u32, 0x4e4f_534a]);
    [head, json, words(&[binary.len() as u32, 0x004e_4942]), binary].concat()
}

fn ply(shape: &Shape) -> Vec<u8> {
    let colored = !shape.colors.is_empty();
    let mut head = String::from("ply\nformat binary_little_endian 1.0\n");
    if shape.origin != DVec3::ZERO {
        let [x, y, z] = shape.origin.to_array();
        head += &format!("comment Origin: {x} {y} {z}\n");
    }
    head += &format!("element vertex {}\n", shape.positions.len());
    for name in ["x", "y", "z", "nx", "ny", "nz"] {
        head += &format!("property float {name}\n");
    }
    for name in ["red", "green", "blue"].into_iter().filter(|_| colored) {
        head += &format!("property uchar {name}\n");
    }
    head += &format!("element face {}\nproperty list uchar int vertex_indices\nend_header\n", shape.triangles.len());
    let mut bytes = head.into_bytes();
    for (i, (p, n)) in shape.positions.iter().zip(&shape.normals).enumerate() {
        [*p, *n].iter().flat_map(|v| v.to_array()).for_each(|v| bytes.extend(v.to_le_bytes()));
        if colored {
            bytes.extend(shape.colors[i].to_array().map(|c| (c * 255.0).round() as u8));
        }
    }
    for triangle in &shape.triangles {
        bytes.push(3);
        triangle.iter().for_each(|i| bytes.extend(i.to_le_bytes()));
    }
    bytes
}

fn obj(shape: &Shape) -> Vec<u8> {
    let mut text = String::new();
    for (i, p) in shape.positions.iter().enumerate() {
        // As text, positions need not be relative to anything.
        let p = p.as_dvec3() + shape.origin;
        text += &format!("v {} {} {}", p.x, p.y, p.z);
        if let Some(c) = shape.colors.get(i) {
            text += &format!(" {:.4} {:.4} {:.4}", c.x, c.y, c.z);
        }
        text += "\n";
    }
    shape.normals.iter().for_each(|n| text += &format!("vn {:.5} {:.5} {:.5}\n", n.x, n.y, n.z));
    for [a, b, c] in &shape.triangles {
        let [a, b, c] = [a + 1, b + 1, c + 1];
        text += &format!("f {a}//{a} {b}//{b} {c}//{c}\n");
    }
    text.into_bytes()
}

impl Shape {
    /// Turns and scales it: `x -> scale * rotation * x`.
    pub fn transform(&mut self, scale: f64, rotation: DQuat) {
        let matrix = DMat3::from_quat(rotation);
        self.positions.iter_mut().for_each(|p| *p = (scale * (matrix * p.as_dvec3())).as_vec3());
        self.normals.iter_mut().for_each(|n| *n = (matrix * n.as_dvec3()).as_vec3());
        self.origin = scale * (matrix * self.origin);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A tetrahedron of four colors.
    fn example() -> Shape {
        let positions = vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z];
        let normals = positions.iter().map(|p| (*p - Vec3::splat(0.25)).normalize()).collect();
        let colors = vec![Vec3::splat(0.5), Vec3::X, Vec3::Y, Vec3::Z];
        let triangles = vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
        Shape { positions, normals, colors, triangles, ..Shape::default() }
    }

    #[test]
    fn files_read_back_by_the_readers_of_meshes() {
        let folder = tempfile::tempdir().unwrap();
        let shape = example();
        assert!(shape.is_closed_manifold() && (shape.volume() - 1.0 / 6.0).abs() < 1e-12);
        for name in ["m.glb", "m.ply", "m.obj"] {
            let path = folder.path().join(name);
            save(&shape, &path, DQuat::IDENTITY).unwrap();
            let mesh =
                freerange_assets::mesh::load_mesh(&path, &freerange_assets::mesh::LoadLimits::default()).unwrap().mesh;
            assert_eq!(mesh.triangles.len(), 4, "{name}");
            let volume: f32 = mesh
                .triangles
                .iter()
                .map(|t| {
                    let [a, b, c] = t.map(|i| mesh.positions[i as usize]);
                    a.dot(b.cross(c)) / 6.0
                })
                .sum();
            assert!(volume > 0.0, "{name}: triangles face inwards");
            if name != "m.obj" {
                // Linear, whatever the file has.
                let gray = mesh.colors.iter().map(|c| c.x).filter(|v| *v > 0.01 && *v < 0.99).fold(0.0, f32::max);
                assert!((gray - 0.214).abs() < 0.003, "{name}: {gray}");
            }
        }
        let error = save(&shape, &folder.path().join("m.stl"), DQuat::IDENTITY).unwrap_err().to_string();
        assert!(error.contains("m.stl: extension: expected .glb, .ply or .obj, found .stl"), "{error}");
    }
}
