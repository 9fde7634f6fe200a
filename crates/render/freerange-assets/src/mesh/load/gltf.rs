//! glTF 2.0, `.glb` and `.gltf`.

use std::borrow::Cow;
use std::collections::HashMap;
use std::sync::Arc;

use glam::{DAffine3, DMat3, DMat4, DQuat, DVec3, Vec2, Vec3, Vec4};
use gltf::json::accessor::ComponentType;
use gltf::json::mesh::{Mode, Primitive, Semantic};
use gltf::json::validation::Checked;
use gltf::json::{self, Index};

use super::accessor::{Accessor, Document};
use super::gltf_material::Materials;
use super::gltf_skin::{Pose, Skins};
use super::job::{Job, Soup};
use crate::mesh::error::MeshError;

/// Extensions that a file may require.
const SUPPORTED: [&str; 7] = [
    "EXT_texture_webp",
    "KHR_lights_punctual", // lights of a file are not used anyway
    "KHR_materials_emissive_strength",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
];

/// Reads a file of either container into triangles in the frame of its scene (+y up).
pub fn read(job: &mut Job, bytes: &[u8]) -> Result<Soup, MeshError> {
    let (json, bin) = split(job, bytes)?;
    let root = parse(job, &json)?;
    check_extensions(job, &root)?;
    let buffers = read_buffers(job, &root, bin)?;
    let document = Document { root, buffers };
    let mut soup = Soup::default();
    let mut materials = Materials::default();
    let mut skins = Skins::default();
    let (order, worlds) = placed_nodes(job, &document.root)?;
    for node in order {
        add_node(job, &document, node, &worlds, &mut skins, &mut materials, &mut soup)?;
    }
    Ok(soup)
}

type Parts<'a> = (Cow<'a, [u8]>, Option<Cow<'a, [u8]>>);

/// The JSON and the binary chunk.
fn split<'a>(job: &Job, bytes: &'a [u8]) -> Result<Parts<'a>, MeshError> {
    if !bytes.starts_with(b"glTF") {
        return Ok((bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes).into(), None));
    }
    if let Some(&[a, b, c, d]) = bytes.get(4..8) {
        let version = u32::from_le_bytes([a, b, c, d]);
        if version != 2 {
            return Err(job.unsupported(format!("glTF of version {version} (2 is)")));
        }
    }
    // The crate subtracts the header's size from this length unchecked.
    let length = bytes.get(8..12).map_or(0, |b| b.iter().rev().fold(0u64, |n, &b| n << 8 | u64::from(b)));
    if length < 20 || length > bytes.len() as u64 {
        let expected = format!("at least 20 and at most the file's {} bytes (is it truncated?)", bytes.len());
        return Err(job.error("GLB header length", expected, length));
    }
    let glb =
        gltf::binary::Glb::from_slice(bytes).map_err(|e| job.error("GLB chunks", "JSON and BIN within the file", e))?;
    Ok((glb.json, glb.bin))
}

fn parse(job: &Job, json: &[u8]) -> Result<json::Root, MeshError> {
    // A parsed item takes up to a hundred times the memory of its text, so items are counted before.
    let (mut items, mut in_string, mut escaped) = (0, false, false);
    for &b in json {
        match b {
            _ if escaped => escaped = false,
            b'\\' if in_string => escaped = true,
            b'"' => in_string = !in_string,
            b'{' | b'[' | b',' if !in_string => items += 1,
            _ => {}
        }
    }
    if items > job.limits.max_json_items {
        return Err(job.error("JSON", format!("at most {} items (max_json_items)", job.limits.max_json_items), items));
    }
    let root: json::Root =
        json::deserialize::from_slice(json).map_err(|e| job.error("JSON", "a glTF 2.0 document", e))?;
    if !root.asset.version.starts_with("2.") {
        return Err(job.unsupported(format!("glTF of version {:?} (2.0 is)", root.asset.version)));
    }
    Ok(root)
}

fn check_extensions(job: &mut Job, root: &json::Root) -> Result<(), MeshError> {
    for name in &root.extensions_required {
        let help = match name.as_str() {
            name if SUPPORTED.contains(&name) => continue,
            "KHR_draco_mesh_compression" | "EXT_meshopt_compression" | "KHR_meshopt_compression" => {
                "; decompress the file first, as with `gltf-transform copy in.glb out.glb`"
            }
            "KHR_texture_basisu" => {
                "; convert its textures first, as with `gltf-transform ktxdecompress in.glb out.glb`"
            }
            _ => "",
        };
        return Err(job.unsupported(format!("the required extension {name:?}{help}")));
    }
    for name in root.extensions_used.iter().filter(|name| !SUPPORTED.contains(&name.as_str())) {
        job.note(format!("extension {name:?} is ignored"));
    }
    if !root.animations.is_empty() {
        job.note("animations are ignored");
    }
    Ok(())
}

fn read_buffers<'a>(
    job: &mut Job,
    root: &json::Root,
    mut bin: Option<Cow<'a, [u8]>>,
) -> Result<Vec<Cow<'a, [u8]>>, MeshError> {
    let mut buffers = Vec::with_capacity(root.buffers.len());
    for (i, buffer) in root.buffers.iter().enumerate() {
        let name = format!("buffers[{i}]");
        let mut bytes = match &buffer.uri {
            Some(uri) => Cow::Owned(job.read_uri(&format!("{name}.uri"), uri)?),
            None if i == 0 => bin.take().unwrap_or_default(),
            // A place-holder for compressed data; views into it fail.
            None => Cow::default(),
        };
        let length = usize::try_from(buffer.byte_length.0).unwrap_or(usize::MAX);
        if (buffer.uri.is_some() || i == 0) && length > bytes.len() {
            return Err(job.error(
                format!("{name}.byteLength"),
                format!("at most the {} bytes there are", bytes.len()),
                length,
            ));
        }
        match &mut bytes {
            Cow::Borrowed(b) => *b = &b[..length.min(b.len())],
            Cow::Owned(b) => b.truncate(length),
        }
        buffers.push(bytes);
    }
    Ok(buffers)
}

/// The nodes of the scene, parents first, and the world transform of each of the file's nodes that is in the scene. Every
/// node may be placed once.
fn placed_nodes(job: &Job, root: &json::Root) -> Result<(Vec<usize>, Vec<Option<DAffine3>>), MeshError> {
    let nodes = &root.nodes;
    let mut has_parent = vec![false; nodes.len()];
    for (i, node) in nodes.iter().enumerate() {
        for child in node.children.iter().flatten() {
            let Some(flag) = has_parent.get_mut(child.value()) else {
                let expected = format!("an index below {}", nodes.len());
                return Err(job.error(format!("nodes[{i}].children"), expected, child.value()));
            };
            if std::mem::replace(flag, true) {
                return Err(job.error(format!("nodes[{}]", child.value()), "one parent at most", "a second one"));
            }
        }
    }
    let roots: Vec<usize> = match root.scene.map(|s| s.value()).or((!root.scenes.is_empty()).then_some(0)) {
        Some(scene) => match root.scenes.get(scene) {
            Some(scene) => scene.nodes.iter().map(|n| n.value()).collect(),
            None => return Err(job.error("scene", format!("an index below {}", root.scenes.len()), scene)),
        },
        None => (0..nodes.len()).filter(|&i| !has_parent[i]).collect(),
    };
    let mut worlds = vec![None; nodes.len()];
    let mut order = Vec::new();
    // A stack of our own: chains of nodes may be as deep as the file is long.
    let mut stack: Vec<(usize, DAffine3)> = roots.into_iter().rev().map(|i| (i, DAffine3::IDENTITY)).collect();
    while let Some((i, parent)) = stack.pop() {
        let Some(node) = nodes.get(i) else {
            return Err(job.error("scene nodes", format!("indices below {}", nodes.len()), i));
        };
        if worlds[i].is_some() {
            return Err(job.error(format!("nodes[{i}]"), "a tree", "a node that is reached twice (a cycle?)"));
        }
        let world = parent * local_transform(job, i, node)?;
        if !world.is_finite() {
            return Err(job.error(format!("nodes[{i}]"), "a finite transform", "an infinite one"));
        }
        worlds[i] = Some(world);
        order.push(i);
        stack.extend(node.children.iter().flatten().rev().map(|child| (child.value(), world)));
    }
    // With one parent each, what no parentless node leads to goes around in a circle.
    let mut stack: Vec<usize> = (0..nodes.len()).filter(|&i| !has_parent[i]).collect();
    let mut reached = vec![false; nodes.len()];
    while let Some(i) = stack.pop() {
        reached[i] = true;
        stack.extend(nodes[i].children.iter().flatten().map(|c| c.value()));
    }
    match reached.iter().position(|&r| !r) {
        Some(i) => Err(job.error(format!("nodes[{i}]"), "a tree", "a cycle of nodes")),
        None => Ok((order, worlds)),
    }
}

fn local_transform(job: &Job, i: usize, node: &json::Node) -> Result<DAffine3, MeshError> {
    if let Some(m) = node.matrix {
        return Ok(DAffine3::from_mat4(DMat4::from_cols_array(&m.map(f64::from))));
    }
    let vector = |v: Option<[f32; 3]>, default| v.map_or(default, |v| Vec3::from(v).as_dvec3());
    let rotation = match node.rotation {
        Some(q) => {
            let q = DQuat::from_array(q.0.map(f64::from));
            let length = q.length();
            if !(length.is_finite() && length > 1e-6) {
                return Err(job.error(format!("nodes[{i}].rotation"), "a unit quaternion", q));
            }
            q / length
        }
        None => DQuat::IDENTITY,
    };
    Ok(DAffine3::from_scale_rotation_translation(
        vector(node.scale, DVec3::ONE),
        rotation,
        vector(node.translation, DVec3::ZERO),
    ))
}

fn add_node(
    job: &mut Job,
    document: &Document,
    node: usize,
    worlds: &[Option<DAffine3>],
    skins: &mut Skins,
    materials: &mut Materials,
    soup: &mut Soup,
) -> Result<(), MeshError> {
    let world_from_node = worlds[node].unwrap_or(DAffine3::IDENTITY);
    let node = &document.root.nodes[node];
    let Some(index) = node.mesh.map(|m| m.value()) else { return Ok(()) };
    let Some(mesh) = document.root.meshes.get(index) else {
        return Err(job.error("node.mesh", format!("an index below {}", document.root.meshes.len()), index));
    };
    for (i, primitive) in mesh.primitives.iter().enumerate() {
        let name = format!("meshes[{index}].primitives[{i}]");
        job.charge_primitive()?;
        let joints = match node.skin {
            Some(skin) => Some(skins.get(job, document, skin.value(), worlds)?),
            None => None,
        };
        add_primitive(job, document, &name, primitive, world_from_node, joints, materials, soup)?;
    }
    Ok(())
}

fn add_primitive(
    job: &mut Job,
    document: &Document,
    name: &str,
    primitive: &Primitive,
    world_from_node: DAffine3,
    joints: Option<Arc<Vec<DAffine3>>>,
    materials: &mut Materials,
    soup: &mut Soup,
) -> Result<(), MeshError> {
    let Checked::Valid(mode) = primitive.mode else {
        return Err(job.error(format!("{name}.mode"), "0 to 6", "another number"));
    };
    if !matches!(mode, Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan) {
        job.note("points and lines are ignored");
        return Ok(());
    }
    if primitive.targets.as_ref().is_some_and(|t| !t.is_empty()) {
        job.note("morph targets are ignored");
    }
    let attribute = |semantic: Semantic| primitive.attributes.get(&Checked::Valid(semantic)).copied();
    let Some(positions) = attribute(Semantic::Positions) else {
        job.note("primitives without positions are ignored");
        return Ok(());
    };
    let positions = open(job, document, name, "POSITION", positions, &[3])?;
    let corners = read_corners(job, document, name, primitive.indices, mode, positions.count, soup)?;
    if corners.is_empty() {
        return Ok(());
    }
    let (corners, used) = compact(&corners);
    soup.check_room(job, name, used.len() as u64, corners.len() as u64 / 3)?;

    let material = materials.get(job, document, primitive.material, soup)?;
    let optional = |job: &Job, semantic: Semantic, key: &str, widths: &[usize]| {
        open_optional(job, document, name, key, attribute(semantic), widths, positions.count)
    };
    let normals = optional(job, Semantic::Normals, "NORMAL", &[3])?;
    let colors = optional(job, Semantic::Colors(0), "COLOR_0", &[3, 4])?;
    let uvs = match material.uv_set {
        None => None,
        Some(set) => {
            let uvs = optional(job, Semantic::TexCoords(set), &format!("TEXCOORD_{set}"), &[2])?;
            if uvs.is_none() {
                job.note(format!("a textured primitive without TEXCOORD_{set} shows one texel"));
            }
            uvs
        }
    };

    let pose = pose_of(job, document, name, primitive, positions.count, world_from_node, joints)?;
    // A mirror turns triangles inside out. Joints that mirror do so alike.
    let mirrored = pose.at(job, name, used[0] as usize)?.matrix3.determinant() < 0.0;
    let base = soup.positions.len() as u32;
    for &i in &used {
        let i = i as usize;
        let world = pose.at(job, name, i)?;
        let position = world.transform_point3(DVec3::from(positions.numbers::<3>(i).map(f64::from)));
        let normal = normals.as_ref().map_or(DVec3::ZERO, |a| {
            let side = if mirrored { -1.0 } else { 1.0 };
            cofactors(&world.matrix3) * DVec3::from(a.numbers::<3>(i).map(f64::from)) * side
        });
        let uv = uvs.as_ref().map_or(Vec2::ZERO, |a| a.numbers::<2>(i).into());
        let color = colors.as_ref().map_or(Vec4::ONE, |a| {
            let [r, g, b, alpha] = a.numbers::<4>(i);
            Vec4::new(r, g, b, if a.width == 4 { alpha } else { 1.0 })
        });
        // Normalized in double precision: the cofactors of small scales would underflow.
        soup.vertex(position, normal.normalize_or_zero().as_vec3(), uv, color);
    }
    for t in corners.chunks_exact(3) {
        let [a, b, c] = [base + t[0], base + t[1], base + t[2]];
        soup.triangle(if mirrored { [a, c, b] } else { [a, b, c] }, material.index);
    }
    Ok(())
}

fn open<'a>(
    job: &Job,
    document: &'a Document,
    name: &str,
    key: &str,
    index: Index<json::Accessor>,
    widths: &[usize],
) -> Result<Accessor<'a>, MeshError> {
    let name = format!("{name}.{key}");
    let accessor = document.accessor(job, &name, index)?;
    accessor.expect_kind(job, &name, widths)?;
    Ok(accessor)
}

/// How vertices come into the world: with their node, or with the joints of a skin.
fn pose_of<'a>(
    job: &mut Job,
    document: &'a Document,
    name: &str,
    primitive: &Primitive,
    count: usize,
    world_from_node: DAffine3,
    joints: Option<Arc<Vec<DAffine3>>>,
) -> Result<Pose<'a>, MeshError> {
    let pose = match joints {
        None => None,
        Some(joints) => Pose::skinned(job, document, name, primitive, count, joints)?,
    };
    if pose.is_some() {
        job.note("skins are applied in the pose of the file's nodes");
    }
    Ok(pose.unwrap_or(Pose::Rigid(world_from_node)))
}

/// An attribute that may be missing, of values for `count` positions.
fn open_optional<'a>(
    job: &Job,
    document: &'a Document,
    name: &str,
    key: &str,
    index: Option<Index<json::Accessor>>,
    widths: &[usize],
    count: usize,
) -> Result<Option<Accessor<'a>>, MeshError> {
    let Some(index) = index else { return Ok(None) };
    let accessor = open(job, document, name, key, index, widths)?;
    if accessor.count < count {
        let expected = format!("as many values as there are positions ({count})");
        return Err(job.error(format!("{name}.{key}"), expected, accessor.count));
    }
    Ok(Some(accessor))
}

/// The matrix that takes normals along: the transposed inverse times the determinant, defined for singular ones too.
fn cofactors(m: &DMat3) -> DMat3 {
    DMat3::from_cols(m.y_axis.cross(m.z_axis), m.z_axis.cross(m.x_axis), m.x_axis.cross(m.y_axis))
}

/// The corners of a primitive as a list of triangles, three vertex indices each, all below `vertices`.
fn read_corners(
    job: &Job,
    document: &Document,
    name: &str,
    indices: Option<Index<json::Accessor>>,
    mode: Mode,
    vertices: usize,
    soup: &Soup,
) -> Result<Vec<u32>, MeshError> {
    let name = format!("{name}.indices");
    let accessor = match indices {
        None => None,
        Some(index) => {
            let accessor = document.accessor(job, &name, index)?;
            let unsigned = matches!(accessor.component, ComponentType::U8 | ComponentType::U16 | ComponentType::U32);
            if accessor.width != 1 || !unsigned {
                return Err(job.error(
                    &name,
                    "unsigned scalars",
                    format!("{} of {:?}", accessor.width, accessor.component),
                ));
            }
            Some(accessor)
        }
    };
    let count = accessor.as_ref().map_or(vertices, |a| a.count);
    let triangles = if mode == Mode::Triangles { count / 3 } else { count.saturating_sub(2) };
    // Before anything is allocated by a count that the file claims.
    soup.check_room(job, &name, 0, triangles as u64)?;
    let mut corners = Vec::with_capacity(3 * triangles);
    for t in 0..triangles {
        let order = match mode {
            Mode::TriangleStrip => [t, t + 1 + t % 2, t + 2 - t % 2],
            Mode::TriangleFan => [t + 1, t + 2, 0],
            _ => [3 * t, 3 * t + 1, 3 * t + 2],
        };
        for i in order {
            let vertex = accessor.as_ref().map_or(i as u32, |a| a.index(i));
            if vertex as usize >= vertices {
                return Err(job.error(&name, format!("indices below the {vertices} positions"), vertex));
            }
            corners.push(vertex);
        }
    }
    Ok(corners)
}

/// Renumbers indices by first use: returns the new ones, and the old index of each new one. Its memory depends on the
/// number of indices alone, as many primitives may share one long accessor.
fn compact(indices: &[u32]) -> (Vec<u32>, Vec<u32>) {
    let mut used = Vec::new();
    let most = indices.iter().max().map_or(0, |&m| m as usize);
    let renumbered = if most <= 4 * indices.len() {
        let mut table = vec![u32::MAX; most + 1];
        for &old in indices {
            if table[old as usize] == u32::MAX {
                table[old as usize] = used.len() as u32;
                used.push(old);
            }
        }
        indices.iter().map(|&old| table[old as usize]).collect()
    } else {
        let mut table = HashMap::new();
        let mut number = |old: u32| {
            *table.entry(old).or_insert_with(|| {
                used.push(old);
                (used.len() - 1) as u32
            })
        };
        indices.iter().map(|&old| number(old)).collect()
    };
    (renumbered, used)
}
