//! Small glTF files, put together by hand.

use freerange_assets::mesh::{LoadLimits, Loaded, MeshError, MeshFormat, load_mesh_bytes};
use glam::Vec3;
use serde_json::{Value, json};

pub const U8: u32 = 5121;
pub const I16: u32 = 5122;
pub const U16: u32 = 5123;
pub const U32: u32 = 5125;
pub const F32: u32 = 5126;

/// The JSON and the binary chunk of a file. `json` may be changed at will.
#[derive(Clone)]
pub struct Glb {
    pub json: Value,
    pub bin: Vec<u8>,
}

impl Glb {
    /// One node with one mesh of one primitive without attributes.
    pub fn new() -> Self {
        let json = json!({
            "asset": {"version": "2.0"},
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {}}]}],
            "accessors": [], "bufferViews": [], "buffers": [{"byteLength": 0}],
        });
        Self { json, bin: Vec::new() }
    }

    /// A triangle of corners (0, 0, 0), (2, 0, 0), (0, 2, 0), without normals.
    pub fn triangle() -> Self {
        let mut glb = Self::new();
        glb.attribute("POSITION", "VEC3", &[0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 2.0, 0.0]);
        glb
    }

    /// The same with texture coordinates (0, 0), (1, 0), (0, 1) and material 0.
    pub fn textured(material: Value, image: &[u8]) -> Self {
        let mut glb = Self::triangle();
        glb.attribute("TEXCOORD_0", "VEC2", &[0.0, 0.0, 1.0, 0.0, 0.0, 1.0]);
        *glb.primitive("material") = json!(0);
        let view = glb.view(image);
        glb.json["images"] = json!([{"bufferView": view}]);
        glb.json["textures"] = json!([{"source": 0}]);
        glb.json["materials"] = json!([material]);
        glb
    }

    pub fn view(&mut self, bytes: &[u8]) -> usize {
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        let views = self.json["bufferViews"].as_array_mut().unwrap();
        views.push(json!({"buffer": 0, "byteOffset": self.bin.len(), "byteLength": bytes.len()}));
        self.bin.extend_from_slice(bytes);
        views.len() - 1
    }

    pub fn accessor(&mut self, bytes: &[u8], component: u32, kind: &str, count: usize) -> usize {
        let view = self.view(bytes);
        let accessors = self.json["accessors"].as_array_mut().unwrap();
        accessors.push(json!({"bufferView": view, "componentType": component, "type": kind, "count": count}));
        accessors.len() - 1
    }

    /// Adds floats as an attribute of the first primitive.
    pub fn attribute(&mut self, key: &str, kind: &str, values: &[f32]) -> usize {
        let width: usize = kind[3..].parse().unwrap();
        let bytes: Vec<u8> = values.iter().flat_map(|x| x.to_le_bytes()).collect();
        let accessor = self.accessor(&bytes, F32, kind, values.len() / width);
        self.primitive("attributes")[key] = json!(accessor);
        accessor
    }

    pub fn indices(&mut self, indices: &[u16]) {
        let bytes: Vec<u8> = indices.iter().flat_map(|x| x.to_le_bytes()).collect();
        let accessor = self.accessor(&bytes, U16, "SCALAR", indices.len());
        *self.primitive("indices") = json!(accessor);
    }

    /// A field of the first primitive.
    pub fn primitive(&mut self, key: &str) -> &mut Value {
        &mut self.json["meshes"][0]["primitives"][0][key]
    }

    pub fn bytes(&self) -> Vec<u8> {
        let mut json = self.json.clone();
        if json["buffers"][0]["byteLength"] == json!(0) {
            json["buffers"][0]["byteLength"] = json!(self.bin.len());
        }
        let mut text = json.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut bin = self.bin.clone();
        bin.resize(bin.len().next_multiple_of(4), 0);
        let length = 12 + 8 + text.len() + 8 + bin.len();
        let mut bytes = b"glTF".to_vec();
        for word in [2, length as u32, text.len() as u32] {
            bytes.extend(word.to_le_bytes());
        }
        bytes.extend(b"JSON");
        bytes.extend(text);
        bytes.extend((bin.len() as u32).to_le_bytes());
        bytes.extend(b"BIN\0");
        bytes.extend(bin);
        bytes
    }

    pub fn try_load(&self) -> Result<Loaded, MeshError> {
        load_mesh_bytes(MeshFormat::Gltf, &self.bytes(), &LoadLimits::default())
    }

    pub fn load(&self) -> Loaded {
        self.try_load().unwrap()
    }

    /// The message of the error that loading must give.
    #[track_caller]
    pub fn error(&self) -> String {
        self.try_load().expect_err("the file must be refused").to_string()
    }
}

/// Corners of all triangles in the file's frame.
pub fn file_triangles(loaded: &Loaded) -> Vec<[Vec3; 3]> {
    let back = loaded.canonical_from_file.inverse();
    let mesh = &loaded.mesh;
    (0..mesh.triangles.len()).map(|t| mesh.corners(t).map(|p| back.transform_point3(p.as_dvec3()).as_vec3())).collect()
}

#[track_caller]
pub fn assert_close(found: Vec3, want: [f32; 3]) {
    assert!(found.distance(want.into()) < 1e-4, "found {found}, want {want:?}");
}

/// A picture of 4 x 2 pixels: red and half transparent at the upper left, green elsewhere.
pub fn small_picture(format: image::ImageFormat) -> Vec<u8> {
    let picture = image::RgbaImage::from_fn(4, 2, |x, y| {
        image::Rgba(if (x, y) == (0, 0) { [255, 0, 0, 128] } else { [0, 255, 0, 255] })
    });
    let mut bytes = std::io::Cursor::new(Vec::new());
    let dynamic = image::DynamicImage::ImageRgba8(picture);
    if format == image::ImageFormat::Jpeg {
        dynamic.to_rgb8().write_to(&mut bytes, format).unwrap();
    } else {
        dynamic.write_to(&mut bytes, format).unwrap();
    }
    bytes.into_inner()
}
