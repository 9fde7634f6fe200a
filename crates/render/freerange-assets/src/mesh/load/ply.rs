//! Stanford PLY: ascii and binary of both byte orders.

use std::collections::HashMap;
use std::io::{Cursor, ErrorKind};
use std::sync::Arc;

use glam::{DVec3, Vec2, Vec3, Vec4};
use ply_rs_bw::parser::{Parser, Reader};
use ply_rs_bw::ply::{
    ElementDef, Encoding, Header, Property, PropertyAccess, PropertyAccessResult, PropertyType, ScalarType,
};

use super::job::{Job, Soup};
use super::picture::decode;
use crate::mesh::error::MeshError;
use crate::mesh::material::Material;
use crate::mesh::picture::{Map, Picture};
use crate::mesh::srgb::srgb_to_linear;
use crate::mesh::texture::Texture;

/// A header is short; this bounds the memory for its parsed form.
const MAX_HEADER: usize = 1 << 20;

/// Reads a file into triangles in the file's frame. Polygons become fans; colors are taken as sRGB; v is flipped to run
/// down. A `comment TextureFile name`, as some scanners' programs write it, names the texture.
pub fn read(job: &mut Job, bytes: &[u8]) -> Result<Soup, MeshError> {
    let head = &bytes[..bytes.len().min(MAX_HEADER)];
    if !head.windows(10).any(|w| w == b"end_header") {
        return Err(job.error("header", format!("end_header within {MAX_HEADER} bytes"), "none"));
    }
    let mut reader = Reader::new(Cursor::new(bytes));
    let header =
        Parser::<Ignored>::new().read_header(&mut reader).map_err(|e| job.error("header", "a PLY header", e))?;
    check_counts(job, &header, bytes.len() as u64 - reader.get_ref().position())?;
    let count = |name: &str| header.elements.get(name).map_or(0, |e| e.count as u64);
    if count("face") == 0 {
        let strips = if count("tristrips") > 0 { " (triangle strips are not read)" } else { "" };
        return Err(job.error("element face", "at least one", format!("none{strips}")));
    }
    Soup::default().check_room(job, "elements vertex and face", count("vertex"), count("face"))?;

    let (mut vertices, mut faces): (Vec<Vertex>, Vec<Face>) = (Vec::new(), Vec::new());
    for element in header.elements.values() {
        match element.name.as_str() {
            "vertex" => vertices = payload(job, &mut reader, element, &header)?,
            "face" => faces = payload(job, &mut reader, element, &header)?,
            other => {
                job.note(format!("elements {other:?} are ignored"));
                payload::<Ignored>(job, &mut reader, element, &header)?;
            }
        }
        if !vertices.is_empty() && !faces.is_empty() {
            break;
        }
    }
    let texture = texture(job, &header)?;
    build(job, &header, &vertices, &faces, texture)
}

/// Fails if the elements that the header claims cannot fit into the rest of the file.
fn check_counts(job: &Job, header: &Header, rest: u64) -> Result<(), MeshError> {
    for element in header.elements.values() {
        // An ascii value takes a character and a separator; the last one may lack the latter.
        let least = |p: &PropertyType| match (header.encoding, p) {
            (Encoding::Ascii, _) => 2,
            (_, PropertyType::Scalar(t) | PropertyType::List(t, _)) => size(t),
        };
        let size: u64 = element.properties.values().map(|p| least(&p.data_type)).sum();
        let needed = (element.count as u64).checked_mul(size);
        if element.count > 0 && (size == 0 || needed.is_none_or(|n| n > rest + 1)) {
            let expected = format!("a count that fits into the {rest} bytes after the header");
            return Err(job.error(format!("element {}", element.name), expected, element.count));
        }
    }
    Ok(())
}

fn size(t: &ScalarType) -> u64 {
    match t {
        ScalarType::Char | ScalarType::UChar => 1,
        ScalarType::Short | ScalarType::UShort => 2,
        ScalarType::Int | ScalarType::UInt | ScalarType::Float => 4,
        ScalarType::Double => 8,
    }
}

fn payload<E: PropertyAccess>(
    job: &Job,
    reader: &mut Reader<Cursor<&[u8]>>,
    element: &ElementDef,
    header: &Header,
) -> Result<Vec<E>, MeshError> {
    Parser::<E>::new().read_payload_for_element(reader, element, header).map_err(|e| {
        let expected = match e.kind() {
            ErrorKind::UnexpectedEof => format!("{} of them (is the file truncated?)", element.count),
            _ => "values as the header declares them".into(),
        };
        job.error(format!("element {}", element.name), expected, e)
    })
}

/// An element that is read to get past it.
struct Ignored;

impl PropertyAccess for Ignored {
    fn new() -> Self {
        Self
    }

    fn set_property(&mut self, _: &str, _: Property) -> PropertyAccessResult {
        PropertyAccessResult::Ignored
    }
}

#[derive(Clone, Copy)]
struct Vertex {
    position: DVec3,
    normal: Vec3,
    /// sRGB, 0 to 1.
    color: Vec4,
    uv: Vec2,
}

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Self { position: DVec3::ZERO, normal: Vec3::ZERO, color: Vec4::ONE, uv: Vec2::ZERO }
    }

    fn set_property(&mut self, name: &str, value: Property) -> PropertyAccessResult {
        // The value, and the number that stands for a full color channel.
        let (x, full) = match value {
            Property::Char(x) => (f64::from(x), 127.0),
            Property::UChar(x) => (x.into(), 255.0),
            Property::Short(x) => (x.into(), 32767.0),
            Property::UShort(x) => (x.into(), 65535.0),
            Property::Int(x) => (x.into(), 255.0),
            Property::UInt(x) => (x.into(), 255.0),
            Property::Float(x) => (x.into(), 1.0),
            Property::Double(x) => (x, 1.0),
            _ => return PropertyAccessResult::Ignored,
        };
        match name {
            "x" => self.position.x = x,
            "y" => self.position.y = x,
            "z" => self.position.z = x,
            "nx" => self.normal.x = x as f32,
            "ny" => self.normal.y = x as f32,
            "nz" => self.normal.z = x as f32,
            "red" | "r" | "diffuse_red" => self.color.x = (x / full) as f32,
            "green" | "g" | "diffuse_green" => self.color.y = (x / full) as f32,
            "blue" | "b" | "diffuse_blue" => self.color.z = (x / full) as f32,
            "alpha" | "a" => self.color.w = (x / full) as f32,
            "s" | "u" | "texture_u" | "texture_s" => self.uv.x = x as f32,
            "t" | "v" | "texture_v" | "texture_t" => self.uv.y = x as f32,
            _ => return PropertyAccessResult::Ignored,
        }
        PropertyAccessResult::Set
    }
}

#[derive(Default)]
struct Face {
    corners: Vec<u32>,
    /// Two numbers per corner, or none.
    uvs: Vec<f32>,
}

impl PropertyAccess for Face {
    fn new() -> Self {
        Self::default()
    }

    fn set_property(&mut self, name: &str, value: Property) -> PropertyAccessResult {
        match (name, value) {
            ("vertex_indices" | "vertex_index", value) => match indices(value) {
                Some(corners) => self.corners = corners,
                None => return PropertyAccessResult::UnsupportedType,
            },
            ("texcoord", Property::ListFloat(uvs)) => self.uvs = uvs,
            _ => return PropertyAccessResult::Ignored,
        }
        PropertyAccessResult::Set
    }
}

/// Non-negative integers as indices; `None` for other values. Those that no vertex can have are found later.
fn indices(value: Property) -> Option<Vec<u32>> {
    fn all<T: TryInto<u32>>(list: Vec<T>) -> Option<Vec<u32>> {
        list.into_iter().map(|i| i.try_into().ok()).collect()
    }
    match value {
        Property::ListChar(list) => all(list),
        Property::ListUChar(list) => all(list),
        Property::ListShort(list) => all(list),
        Property::ListUShort(list) => all(list),
        Property::ListInt(list) => all(list),
        Property::ListUInt(list) => Some(list),
        _ => None,
    }
}

/// The texture that a comment names.
fn texture(job: &mut Job, header: &Header) -> Result<Option<Map>, MeshError> {
    let mut names = header.comments.iter().filter_map(|c| c.trim().strip_prefix("TextureFile")).map(str::trim);
    let Some(name) = names.next() else { return Ok(None) };
    if names.next().is_some() {
        job.note("textures after the first are ignored");
    }
    let bytes = match job.resolve("comment TextureFile", name).and_then(|path| job.read_file(&path)) {
        Ok(bytes) => bytes,
        Err(e) => {
            job.note(format!("no texture: {e}"));
            return Ok(None);
        }
    };
    let image = decode(job, &format!("texture {name:?}"), &bytes)?;
    Ok(Some(Map::new(Arc::new(Picture::new(image, true)))))
}

fn build(
    job: &mut Job,
    header: &Header,
    vertices: &[Vertex],
    faces: &[Face],
    texture: Option<Map>,
) -> Result<Soup, MeshError> {
    let mut soup = Soup::default();
    let triangles: u64 = faces.iter().map(|f| (f.corners.len() as u64).saturating_sub(2)).sum();
    soup.check_room(job, "element face", 0, triangles)?;
    let has_color = header
        .elements
        .get("vertex")
        .is_some_and(|e| ["red", "r", "diffuse_red"].iter().any(|&name| e.properties.contains_key(name)));
    let base = match (texture, has_color) {
        (Some(map), _) => Texture::Image(map),
        (None, true) => Texture::Flat(Vec3::ONE),
        (None, false) => Texture::Flat(Vec3::splat(0.8)),
    };
    let material = soup.material(job, Material::matt(base))?;
    let add = |soup: &mut Soup, vertex: &Vertex, uv: Vec2| {
        let color = vertex.color.clamp(Vec4::ZERO, Vec4::ONE);
        let linear = color.truncate().map(srgb_to_linear).extend(color.w);
        soup.vertex(vertex.position, vertex.normal, Vec2::new(uv.x, 1.0 - uv.y), linear)
    };
    for vertex in vertices {
        add(&mut soup, vertex, vertex.uv);
    }
    let mut split: HashMap<(u32, [u32; 2]), u32> = HashMap::new();
    for (f, face) in faces.iter().enumerate() {
        if let Some(&i) = face.corners.iter().find(|&&i| i as usize >= vertices.len()) {
            return Err(job.error(format!("face {f}"), format!("vertex indices below {}", vertices.len()), i));
        }
        if face.corners.len() < 3 {
            job.note("faces of fewer than three corners are ignored");
            continue;
        }
        // Texture coordinates of corners: a vertex for each pair of vertex and coordinates.
        let with_uvs = face.uvs.len() == 2 * face.corners.len();
        let mut corner = |k: usize| {
            let i = face.corners[k];
            if !with_uvs {
                return i;
            }
            let uv = Vec2::new(face.uvs[2 * k], face.uvs[2 * k + 1]);
            let key = (i, uv.to_array().map(f32::to_bits));
            *split.entry(key).or_insert_with(|| add(&mut soup, &vertices[i as usize], uv))
        };
        let corners: Vec<u32> = (0..face.corners.len()).map(&mut corner).collect();
        for k in 1..corners.len() - 1 {
            soup.triangle([corners[0], corners[k], corners[k + 1]], material);
        }
    }
    Ok(soup)
}
