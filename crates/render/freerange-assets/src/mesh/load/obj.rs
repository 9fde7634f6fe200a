//! Wavefront OBJ.
//!
//! Parsing is `tobj`'s. What it would stumble over (indices out of range, colors or normals of some vertices only,
//! encodings other than UTF-8) is found before, line by line, together with the counts that the limits are about.

use std::collections::{BTreeMap, HashMap};
use std::io::Cursor;
use std::path::Path;

use glam::{DVec3, Vec2, Vec3, Vec4};

use super::job::{Job, Soup};
use super::obj_material::{Library, default_material, read_library};
use super::obj_text::{split, statements};
use crate::mesh::error::MeshError;
use crate::mesh::srgb::srgb_to_linear;

/// Reads a file and its material libraries into triangles in the file's frame. Polygons become fans. Vertex colors are
/// taken as sRGB, as the programs that write this extension do; v is flipped to run down.
pub fn read(job: &mut Job, bytes: &[u8]) -> Result<Soup, MeshError> {
    let text = String::from_utf8_lossy(bytes);
    let counts = count(job, &text)?;
    Soup::default().check_room(job, "v and f", counts.vertices as u64, counts.triangles as u64)?;
    let clean = clean(job, &text, &counts)?;
    let mut libraries = BTreeMap::new();
    for name in &counts.libraries {
        match read_library(job, name)? {
            Some(library) => drop(libraries.insert(name.as_str(), library)),
            None => job.note(format!("material library {name:?} is missing")),
        }
    }
    let options = tobj::LoadOptions { triangulate: true, ignore_points: true, ignore_lines: true, single_index: false };
    let find = |path: &Path| libraries.get(path.to_str().unwrap_or_default());
    let loader = |path: &Path| match find(path) {
        Some(library) => tobj::load_mtl_buf(&mut Cursor::new(&library.text)),
        None => Ok(Default::default()),
    };
    let (models, materials) = tobj::load_obj_buf(&mut Cursor::new(clean), &options, loader)
        .map_err(|e| job.error("OBJ", "well-formed statements", e))?;
    let materials = materials.map_err(|e| job.error("MTL", "well-formed statements", e))?;
    build(job, &models, &materials, &libraries)
}

/// What a file holds, counted before anything is stored.
#[derive(Default)]
struct Counts {
    vertices: usize,
    colored: usize,
    uvs: usize,
    normals: usize,
    triangles: usize,
    corners: usize,
    corners_with_uv: usize,
    corners_with_normal: usize,
    /// In order, each once.
    libraries: Vec<String>,
}

fn count(job: &mut Job, text: &str) -> Result<Counts, MeshError> {
    let mut n = Counts::default();
    for (line, statement) in statements(text).enumerate() {
        let (key, rest) = split(&statement);
        let words = rest.split_whitespace();
        match key {
            "v" => {
                n.vertices += 1;
                let numbers = words.filter(|w| w.parse::<f32>().is_ok()).count();
                if numbers != rest.split_whitespace().count() || ![3, 4, 6].contains(&numbers) {
                    return Err(job.error(format!("statement {}: v", line + 1), "3, 4 or 6 numbers", rest));
                }
                n.colored += usize::from(numbers == 6);
            }
            "vt" => n.uvs += 1,
            "vn" => n.normals += 1,
            "f" => {
                let before = n.corners;
                for corner in words {
                    let mut parts = corner.split('/').skip(1);
                    n.corners += 1;
                    n.corners_with_uv += usize::from(parts.next().is_some_and(|p| !p.is_empty()));
                    n.corners_with_normal += usize::from(parts.next().is_some_and(|p| !p.is_empty()));
                }
                n.triangles += (n.corners - before).saturating_sub(2);
            }
            "mtllib" if !rest.is_empty() && !n.libraries.iter().any(|l| l == rest) => n.libraries.push(rest.into()),
            "l" | "p" => job.note("points and lines are ignored"),
            _ => {}
        }
        if n.libraries.len() > 64 {
            return Err(job.error("mtllib", "at most 64 material libraries", "more"));
        }
    }
    if n.colored > 0 && n.colored < n.vertices {
        job.note("vertex colors are ignored: not all vertices have one");
    }
    if n.corners_with_normal > 0 && n.corners_with_normal < n.corners {
        job.note("normals are ignored: not all corners have one");
    }
    if n.corners_with_uv > 0 && n.corners_with_uv < n.corners {
        job.note("corners without texture coordinates take those of their neighbor");
    }
    Ok(n)
}

/// The statements that matter, with indices checked.
fn clean(job: &Job, text: &str, total: &Counts) -> Result<String, MeshError> {
    let drop_colors = total.colored < total.vertices;
    let drop_normals = total.corners_with_normal < total.corners;
    let mut clean = String::with_capacity(text.len());
    let mut seen = [0usize; 3];
    let mut libraries = 0;
    for (line, statement) in statements(text).enumerate() {
        let (key, rest) = split(&statement);
        match key {
            "v" if drop_colors && rest.split_whitespace().count() == 6 => {
                clean.push('v');
                rest.split_whitespace().take(3).for_each(|w| {
                    clean.push(' ');
                    clean.push_str(w);
                });
            }
            "vt" if rest.split_whitespace().count() == 1 => {
                clean.push_str(&format!("vt {rest} 0"));
            }
            "v" | "vt" | "vn" => clean.push_str(&format!("{key} {rest}")),
            "usemtl" if !rest.is_empty() => clean.push_str(&format!("usemtl {rest}")),
            "mtllib" if total.libraries.get(libraries).is_some_and(|l| l == rest) => {
                libraries += 1;
                clean.push_str("mtllib ");
                clean.push_str(rest);
            }
            "f" => {
                if rest.split_whitespace().count() < 3 {
                    continue;
                }
                clean.push('f');
                for corner in rest.split_whitespace() {
                    check_corner(job, line, corner, seen, [total.vertices, total.uvs, total.normals])?;
                    clean.push(' ');
                    match corner.match_indices('/').nth(1) {
                        Some((second, _)) if drop_normals => clean.push_str(&corner[..second]),
                        _ => clean.push_str(corner),
                    }
                }
            }
            _ => continue,
        }
        if let Some(i) = ["v", "vt", "vn"].iter().position(|&k| k == key) {
            seen[i] += 1;
        }
        clean.push('\n');
    }
    Ok(clean)
}

/// Checks a corner `v/vt/vn`: `v` must be there, and all indices in range. `seen` counts what was before, for negative
/// indices, which count backwards.
fn check_corner(job: &Job, line: usize, corner: &str, seen: [usize; 3], total: [usize; 3]) -> Result<(), MeshError> {
    for (k, part) in corner.split('/').enumerate() {
        let in_range = |i: i64| match i {
            1.. => i as u64 <= total[k] as u64,
            0 => false,
            _ => i.unsigned_abs() <= seen[k] as u64,
        };
        let ok = k < 3 && (part.is_empty() && k > 0 || part.parse().is_ok_and(in_range));
        if !ok {
            let counts = format!("v/vt/vn with indices within {} / {} / {}", total[0], total[1], total[2]);
            return Err(job.error(format!("statement {}: f", line + 1), counts, corner));
        }
    }
    Ok(())
}

fn build(
    job: &mut Job,
    models: &[tobj::Model],
    materials: &[tobj::Material],
    libraries: &BTreeMap<&str, Library>,
) -> Result<Soup, MeshError> {
    let mut soup = Soup::default();
    let mut made: HashMap<Option<usize>, u16> = HashMap::new();
    let mut pictures = HashMap::new();
    for model in models {
        let mesh = &model.mesh;
        if mesh.indices.is_empty() {
            continue;
        }
        let key = mesh.material_id.filter(|&id| id < materials.len());
        let material = match made.get(&key) {
            Some(&m) => m,
            None => {
                let material = match key {
                    None => {
                        if !libraries.is_empty() {
                            job.note("faces without a known material are gray");
                        }
                        default_material()
                    }
                    Some(id) => super::obj_material::convert(job, &materials[id], libraries, &mut pictures)?,
                };
                let m = soup.material(job, material)?;
                made.insert(key, m);
                m
            }
        };
        let mut vertices: HashMap<[u32; 3], u32> = HashMap::with_capacity(mesh.positions.len() / 3);
        let at = |list: &[f32], i: u32| -> Option<[f32; 3]> { list.chunks_exact(3).nth(i as usize)?.try_into().ok() };
        let mut corner = |k: usize| -> u32 {
            let none = u32::MAX;
            let v = mesh.indices[k];
            let vt = mesh.texcoord_indices.get(k).copied().unwrap_or(none);
            let vn = mesh.normal_indices.get(k).copied().unwrap_or(none);
            *vertices.entry([v, vt, vn]).or_insert_with(|| {
                let position = at(&mesh.positions, v).unwrap_or([f32::NAN; 3]);
                let normal = at(&mesh.normals, vn);
                let uv = mesh.texcoords.chunks_exact(2).nth(vt as usize);
                let uv = uv.map_or(Vec2::ZERO, |uv| Vec2::new(uv[0], 1.0 - uv[1]));
                let color = at(&mesh.vertex_color, v)
                    .map_or(Vec4::ONE, |c| Vec3::from(c.map(|x| srgb_to_linear(x.clamp(0.0, 1.0)))).extend(1.0));
                let position = DVec3::from(position.map(f64::from));
                soup.vertex(position, normal.map_or(Vec3::ZERO, Vec3::from), uv, color)
            })
        };
        let triangles: Vec<[u32; 3]> =
            (0..mesh.indices.len() / 3).map(|t| [corner(3 * t), corner(3 * t + 1), corner(3 * t + 2)]).collect();
        for t in triangles {
            soup.triangle(t, material);
        }
    }
    Ok(soup)
}
