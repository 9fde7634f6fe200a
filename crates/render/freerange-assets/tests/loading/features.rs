//! Geometry of glTF.

use freerange_assets::mesh::{LoadLimits, MeshFormat, load_mesh, load_mesh_bytes};
use glam::{Vec3, Vec4};
use serde_json::json;

use crate::glb::*;

#[test]
fn a_triangle_arrives_in_the_canonical_frame() {
    let loaded = Glb::triangle().load();
    let mesh = &loaded.mesh;
    assert_eq!(mesh.triangles.len(), 1);
    // The box is (0..2, 0..2, 0), so its corners are sqrt(2) from the center. (x, y, z) goes to (x, -z, y).
    let s = 0.5 / 2f32.sqrt();
    assert_close(mesh.positions[0], [-s, 0.0, -s]);
    assert_close(mesh.positions[1], [s, 0.0, -s]);
    assert_close(mesh.positions[2], [-s, 0.0, s]);
    for (p, n) in mesh.positions.iter().zip(&mesh.normals) {
        assert_close(*n, [0.0, -1.0, 0.0]);
        assert!(p.length() <= 0.5);
    }
    assert_eq!(mesh.rest, mesh.positions);
    assert!(mesh.colors.is_empty() && loaded.notes.is_empty());
    assert_eq!(mesh.materials[0].factor, Vec4::ONE);
    assert_eq!((mesh.materials[0].metallic, mesh.materials[0].roughness), (1.0, 1.0));
}

#[test]
fn indices_of_all_types_and_none_give_the_same() {
    let want = file_triangles(&Glb::triangle().load());
    let reversed = [2u8, 0, 1];
    for (component, bytes) in [
        (U8, reversed.to_vec()),
        (U16, reversed.iter().flat_map(|&i| u16::from(i).to_le_bytes()).collect()),
        (U32, reversed.iter().flat_map(|&i| u32::from(i).to_le_bytes()).collect()),
    ] {
        let mut glb = Glb::triangle();
        let accessor = glb.accessor(&bytes, component, "SCALAR", 3);
        *glb.primitive("indices") = json!(accessor);
        let [c, a, b] = file_triangles(&glb.load())[0];
        for (found, want) in [a, b, c].into_iter().zip(want[0]) {
            assert_close(found, want.into());
        }
    }
}

#[test]
fn strips_and_fans_keep_their_winding() {
    // A strip in the plane z = 0 whose first triangle is counter-clockwise: then all are, once taken apart.
    let strip = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 2.0, 0.0];
    let fan = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.5, 0.0];
    for (mode, values, corner) in [(5, strip, [1.0, 1.0, 0.0]), (6, fan, [0.0, 1.0, 0.0])] {
        let mut glb = Glb::new();
        glb.attribute("POSITION", "VEC3", &values);
        *glb.primitive("mode") = json!(mode);
        let triangles = file_triangles(&glb.load());
        assert_eq!(triangles.len(), 3);
        for [a, b, c] in &triangles {
            assert!((*b - *a).cross(*c - *a).z > 0.1);
        }
        // The vertex that the second triangle adds.
        assert!(triangles[1].iter().any(|p| p.distance(corner.into()) < 1e-4));
        if mode == 6 {
            assert_close(triangles[2][2], [0.0, 0.0, 0.0]);
        }
    }
}

#[test]
fn points_and_lines_are_noted() {
    let mut glb = Glb::triangle();
    let mut lines = glb.json["meshes"][0]["primitives"][0].clone();
    lines["mode"] = json!(1);
    glb.json["meshes"][0]["primitives"].as_array_mut().unwrap().push(lines);
    let loaded = glb.load();
    assert_eq!(loaded.mesh.triangles.len(), 1);
    assert_eq!(loaded.notes, ["points and lines are ignored"]);
    *glb.primitive("mode") = json!(0);
    assert!(glb.error().contains("triangles: expected at least one"));
}

#[test]
fn node_transforms_compose() {
    let mut glb = Glb::triangle();
    // A quarter turn about z, twice as large, moved; below it a matrix (by columns) that moves along x.
    let h = 0.5f32.sqrt();
    glb.json["nodes"] = json!([
        {"children": [1], "translation": [10, 0, 0], "rotation": [0, 0, h, h], "scale": [2, 2, 2]},
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 3, 0, 0, 1]},
    ]);
    let [a, b, c] = file_triangles(&glb.load())[0];
    assert_close(a, [10.0, 6.0, 0.0]);
    assert_close(b, [10.0, 10.0, 0.0]);
    assert_close(c, [6.0, 6.0, 0.0]);
}

#[test]
fn a_mirroring_node_flips_the_winding_and_keeps_normals_outside() {
    let mut glb = Glb::triangle();
    glb.attribute("NORMAL", "VEC3", &[0.0, 0.6, 0.8, 0.0, 0.6, 0.8, 0.0, 0.6, 0.8]);
    glb.json["nodes"][0]["scale"] = json!([-1, 2, 1]);
    let loaded = glb.load();
    let [a, b, c] = file_triangles(&loaded)[0];
    assert!((b - a).cross(c - a).z > 0.0, "counter-clockwise from outside");
    // The inverse transpose takes (0, 0.6, 0.8) to (0, 0.3, 0.8); then +y up becomes +z up.
    let want = Vec3::new(0.0, -0.8, 0.3).normalize();
    for n in &loaded.mesh.normals {
        assert_close(*n, want.into());
    }
}

#[test]
fn the_scene_chooses_the_nodes() {
    let mut glb = Glb::triangle();
    glb.json["nodes"] = json!([{"mesh": 0}, {"mesh": 0, "translation": [5, 0, 0]}]);
    assert_eq!(glb.load().mesh.triangles.len(), 2, "no scene: all root nodes, a mesh twice");
    glb.json["scenes"] = json!([{"nodes": [0]}, {"nodes": [1]}]);
    glb.json["scene"] = json!(1);
    let loaded = glb.load();
    assert_close(file_triangles(&loaded)[0][0], [5.0, 0.0, 0.0]);
    assert_eq!(loaded.mesh.triangles.len(), 1);
}

#[test]
fn vertex_colors_of_all_types() {
    let floats = |v: &[f32]| v.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
    let shorts = |v: &[u16]| v.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
    for (component, kind, bytes, stride) in [
        (F32, "VEC4", floats(&[0.2, 0.4, 0.6, 0.8].repeat(3)), 16),
        (U16, "VEC4", shorts(&[13107, 26214, 39321, 52428].repeat(3)), 8),
        (U8, "VEC4", [51, 102, 153, 204].repeat(3), 4),
        (F32, "VEC3", floats(&[0.2, 0.4, 0.6].repeat(3)), 12),
        (U8, "VEC3", [51, 102, 153, 0].repeat(3), 4),
    ] {
        let mut glb = Glb::triangle();
        let accessor = glb.accessor(&bytes, component, kind, 3);
        glb.json["accessors"][accessor]["normalized"] = json!(component != F32);
        glb.json["bufferViews"][accessor]["byteStride"] = json!(stride);
        glb.primitive("attributes")["COLOR_0"] = json!(accessor);
        let want = Vec4::new(0.2, 0.4, 0.6, if kind == "VEC4" { 0.8 } else { 1.0 });
        let colors = glb.load().mesh.colors;
        assert_eq!(colors.len(), 3);
        assert!(colors.iter().all(|c| c.distance(want) < 1e-6), "{component} {kind}: {colors:?}");
    }
}

#[test]
fn quantized_positions_are_scaled_by_the_node() {
    let mut glb = Glb::new();
    let values: Vec<u8> =
        [0i16, 0, 0, 0, 32767, 0, 0, 0, 0, -32767, 0, 0].iter().flat_map(|x| x.to_le_bytes()).collect();
    let accessor = glb.accessor(&values, I16, "VEC3", 3);
    glb.json["accessors"][accessor]["normalized"] = json!(true);
    glb.json["bufferViews"][accessor]["byteStride"] = json!(8);
    glb.primitive("attributes")["POSITION"] = json!(accessor);
    glb.json["nodes"][0]["scale"] = json!([7, 7, 7]);
    glb.json["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
    let [a, b, c] = file_triangles(&glb.load())[0];
    assert_close(a, [0.0, 0.0, 0.0]);
    assert_close(b, [7.0, 0.0, 0.0]);
    assert_close(c, [0.0, -7.0, 0.0]);
}

#[test]
fn sparse_values_replace_others() {
    let mut glb = Glb::new();
    let indices = glb.view(&[1, 0, 2, 0]);
    let values = glb.view(&[3.0f32, 0.0, 0.0, 0.0, 4.0, 0.0].iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>());
    let sparse =
        json!({"count": 2, "indices": {"bufferView": indices, "componentType": U16}, "values": {"bufferView": values}});
    // Without a buffer view of its own, the others are zero.
    glb.json["accessors"] = json!([{"componentType": F32, "type": "VEC3", "count": 3, "sparse": sparse}]);
    glb.primitive("attributes")["POSITION"] = json!(0);
    let [a, b, c] = file_triangles(&glb.load())[0];
    assert_close(a, [0.0, 0.0, 0.0]);
    assert_close(b, [3.0, 0.0, 0.0]);
    assert_close(c, [0.0, 4.0, 0.0]);
}

#[test]
fn a_long_shared_accessor_is_read_only_where_it_is_used() {
    let mut glb = Glb::new();
    let mut values = vec![f32::NAN; 3 * 5000];
    values[..9].copy_from_slice(&[0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 2.0, 0.0]);
    values[3 * 4999..].copy_from_slice(&[2.0, 2.0, 0.0]);
    glb.attribute("POSITION", "VEC3", &values);
    glb.indices(&[0, 1, 2, 1, 4999, 2]);
    let loaded = glb.load();
    assert_eq!(loaded.mesh.positions.len(), 4);
    assert_close(file_triangles(&loaded)[1][1], [2.0, 2.0, 0.0]);
}

#[test]
fn skins_stand_in_the_pose_of_their_joints() {
    let mut glb = Glb::triangle();
    glb.attribute("NORMAL", "VEC3", &[0.0, 0.0, 1.0].repeat(3));
    let joints = glb.accessor(&[0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0], U8, "VEC4", 3);
    glb.primitive("attributes")["JOINTS_0"] = json!(joints);
    glb.attribute("WEIGHTS_0", "VEC4", &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.0, 0.0]);
    // Inverse bind matrices: the identity, and a shift by -1 along x.
    let mut binds =
        [[1.0f32, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]].concat().repeat(2);
    binds[16 + 12] = -1.0;
    let bytes: Vec<u8> = binds.iter().flat_map(|x| x.to_le_bytes()).collect();
    let binds = glb.accessor(&bytes, F32, "MAT4", 2);
    glb.json["skins"] = json!([{"joints": [1, 2], "inverseBindMatrices": binds}]);
    // The mesh's own node does not count.
    glb.json["nodes"] = json!([
        {"mesh": 0, "skin": 0, "translation": [100, 100, 100]},
        {"children": [2], "translation": [0, 0, 7]},
        {"scale": [3, 3, 3]},
    ]);
    let loaded = glb.load();
    let [a, b, c] = file_triangles(&loaded)[0];
    assert_close(a, [0.0, 0.0, 7.0]);
    assert_close(b, [3.0, 0.0, 7.0]);
    // Half of (0, 2, 7) and half of (-3, 6, 7).
    assert_close(c, [-1.5, 4.0, 7.0]);
    assert_close(loaded.mesh.normals[2], [0.0, -1.0, 0.0]);
    glb.json["skins"][0]["joints"] = json!([1]);
    assert!(glb.error().contains("JOINTS_0"));
    glb.json["skins"][0]["joints"] = json!([1, 9]);
    assert!(glb.error().contains("joints"));
    glb.json["skins"][0] = json!({"joints": [1, 2, 2], "inverseBindMatrices": binds});
    assert!(glb.error().contains("inverseBindMatrices"));
}

#[test]
fn what_is_not_read_is_noted() {
    let mut glb = Glb::triangle();
    glb.primitive("attributes")["_CUSTOM"] = json!(0);
    *glb.primitive("targets") = json!([{"POSITION": 0}]);
    glb.json["extensionsUsed"] = json!(["KHR_materials_sheen", "KHR_texture_transform"]);
    glb.json["animations"] = json!([{"channels": [], "samplers": []}]);
    let notes = glb.load().notes.join("; ");
    for word in ["morph", "KHR_materials_sheen", "animations"] {
        assert!(notes.contains(word), "{word} in {notes}");
    }
    assert!(!notes.contains("KHR_texture_transform"));
}

#[test]
fn gltf_with_files_beside_it_or_inside() {
    let folder = tempfile::tempdir().unwrap();
    let mut glb = Glb::textured(
        json!({"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}),
        &small_picture(image::ImageFormat::Png),
    );
    let picture = small_picture(image::ImageFormat::Png);
    glb.json["buffers"][0] = json!({"byteLength": glb.bin.len(), "uri": "my%20data/buffer.bin"});
    glb.json["images"] = json!([{"uri": "my%20data/../picture%231.png"}]);
    let path = folder.path().join("scene.gltf");
    std::fs::write(&path, format!("\u{feff}{}", glb.json)).unwrap();
    std::fs::create_dir(folder.path().join("my data")).unwrap();
    std::fs::write(folder.path().join("my data/buffer.bin"), &glb.bin).unwrap();
    let limits = LoadLimits::default();
    let missing = load_mesh(&path, &limits).unwrap_err().to_string();
    assert!(missing.contains("picture#1.png"), "{missing}");
    std::fs::write(folder.path().join("picture#1.png"), &picture).unwrap();
    let outside = load_mesh(&path, &limits).unwrap();

    let encode = |bytes: &[u8]| {
        use base64::Engine;
        base64::engine::general_purpose::STANDARD.encode(bytes)
    };
    glb.json["buffers"][0]["uri"] = json!(format!("data:application/octet-stream;base64,{}", encode(&glb.bin)));
    glb.json["images"] = json!([{"uri": format!("data:image/png;base64,{}", encode(&picture))}]);
    let inside = load_mesh_bytes(MeshFormat::Gltf, glb.json.to_string().as_bytes(), &limits).unwrap();
    assert_eq!(outside.mesh.positions, inside.mesh.positions);
    assert_eq!(outside.mesh.uvs, inside.mesh.uvs);
    let [a, b] = [&outside, &inside].map(|l| l.mesh.materials[0].albedo(Vec3::ZERO, glam::Vec2::new(0.1, 0.2)));
    assert_eq!(a, b);
}
