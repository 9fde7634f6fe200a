//! Files that are broken, lie about their sizes, or ask for too much.

use freerange_assets::mesh::{LoadLimits, MeshError, MeshFormat, load_mesh, load_mesh_bytes};
use image::ImageFormat;
use serde_json::json;

use crate::glb::*;

fn error_with(bytes: &[u8], limits: &LoadLimits) -> String {
    load_mesh_bytes(MeshFormat::Gltf, bytes, limits).expect_err("the file must be refused").to_string()
}

#[track_caller]
fn assert_names(error: &str, words: &[&str]) {
    for word in words {
        assert!(error.contains(word), "{word:?} in {error:?}");
    }
}

#[test]
fn truncation_at_every_byte() {
    let mut glb = Glb::textured(
        json!({"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}),
        &small_picture(ImageFormat::Png),
    );
    glb.indices(&[0, 1, 2]);
    let bytes = glb.bytes();
    assert!(glb.try_load().is_ok());
    for length in 0..bytes.len() {
        assert!(load_mesh_bytes(MeshFormat::Gltf, &bytes[..length], &LoadLimits::default()).is_err(), "{length}");
    }
    assert_names(&error_with(&bytes[..bytes.len() - 1], &LoadLimits::default()), &["GLB header length", "truncated"]);
    // A header that claims fewer bytes than a header has.
    let mut short = bytes.clone();
    short[8..12].copy_from_slice(&5u32.to_le_bytes());
    assert_names(&error_with(&short, &LoadLimits::default()), &["GLB header length", "found 5"]);
    let mut old = bytes;
    old[4] = 1;
    assert_names(&error_with(&old, &LoadLimits::default()), &["version 1"]);
}

#[test]
fn accessors_and_views_out_of_bounds() {
    for (field, value, words) in [
        ("count", json!(4), ["accessors[0]", "4 elements"]),
        ("count", json!(u64::MAX), ["accessors[0]", "18446744073709551615"]),
        ("byteOffset", json!(4), ["accessors[0]", "from byte 4"]),
        ("byteOffset", json!(u64::MAX), ["accessors[0]", "18446744073709551615"]),
        ("bufferView", json!(9), ["bufferView", "found 9"]),
        ("componentType", json!(1), ["componentType", "another"]),
        ("componentType", json!(U32), ["POSITION", "U32"]),
        ("type", json!("VEC2"), ["POSITION", "2 of F32"]),
        ("type", json!("MAT3"), ["type", "MAT4"]),
    ] {
        let mut glb = Glb::triangle();
        glb.json["accessors"][0][field] = value;
        assert_names(&glb.error(), &words);
    }
    for (field, value, words) in [
        ("byteLength", json!(37), ["bufferViews[0]", "37 bytes"]),
        ("byteLength", json!(u64::MAX), ["bufferViews[0]", "18446744073709551615"]),
        ("byteOffset", json!(1), ["bufferViews[0]", "from 1"]),
        ("byteOffset", json!(u64::MAX), ["bufferViews[0]", "18446744073709551615"]),
        ("buffer", json!(3), ["bufferViews[0].buffer", "found 3"]),
        ("byteStride", json!(0), ["byteStride", "found 0"]),
        ("byteStride", json!(4), ["byteStride", "found 4"]),
        ("byteStride", json!(1u64 << 40), ["byteStride", "1099511627776"]),
    ] {
        let mut glb = Glb::triangle();
        glb.json["bufferViews"][0][field] = value;
        assert_names(&glb.error(), &words);
    }
    let mut glb = Glb::triangle();
    glb.json["buffers"][0]["byteLength"] = json!(1_000_000);
    assert_names(&glb.error(), &["buffers[0].byteLength", "1000000"]);
    let mut glb = Glb::triangle();
    glb.primitive("attributes")["POSITION"] = json!(7);
    assert_names(&glb.error(), &["POSITION", "found 7"]);
    let mut glb = Glb::triangle();
    glb.json["accessors"][0]["sparse"] = json!({"count": 100_000_000,
        "indices": {"bufferView": 0, "componentType": U16}, "values": {"bufferView": 0}});
    assert_names(&glb.error(), &["sparse.indices", "100000000"]);
}

#[test]
fn an_attribute_shorter_than_the_positions() {
    let mut glb = Glb::triangle();
    glb.attribute("NORMAL", "VEC3", &[0.0, 0.0, 1.0]);
    assert_names(&glb.error(), &["NORMAL", "found 1"]);
}

#[test]
fn indices_out_of_range() {
    let mut glb = Glb::triangle();
    glb.indices(&[0, 1, 3]);
    assert_names(&glb.error(), &["indices", "3 positions", "found 3"]);
    let mut glb = Glb::triangle();
    *glb.primitive("indices") = json!(0);
    assert_names(&glb.error(), &["indices", "F32"]);
}

#[test]
fn nodes_that_are_no_tree() {
    for (nodes, word) in [
        (json!([{"mesh": 0}, {"children": [2]}, {"children": [1]}]), "cycle"),
        (json!([{"mesh": 0, "children": [0]}]), "cycle"),
        (json!([{"mesh": 0}, {"children": [0]}, {"children": [0]}]), "one parent"),
        (json!([{"mesh": 0, "children": [9]}]), "found 9"),
        (json!([{"mesh": 5}]), "found 5"),
        (json!([{"mesh": 0, "rotation": [0, 0, 0, 0]}]), "unit quaternion"),
    ] {
        let mut glb = Glb::triangle();
        glb.json["nodes"] = nodes.clone();
        assert!(glb.error().contains(word), "{nodes}: {}", glb.error());
    }
    // Scales that overflow only together.
    let mut glb = Glb::triangle();
    let mut nodes: Vec<_> = (1..10).map(|i| json!({"children": [i], "scale": [1e38, 1, 1]})).collect();
    nodes.push(json!({"mesh": 0}));
    glb.json["nodes"] = json!(nodes);
    assert_names(&glb.error(), &["nodes[", "finite transform"]);
    let mut glb = Glb::triangle();
    glb.json["nodes"] = json!([{"children": [1]}, {"mesh": 0}]);
    glb.json["scenes"] = json!([{"nodes": [0, 1]}]);
    assert_names(&glb.error(), &["reached twice"]);
    glb.json["scenes"] = json!([{"nodes": [8]}]);
    assert_names(&glb.error(), &["scene nodes", "found 8"]);
    glb.json["scene"] = json!(4);
    assert_names(&glb.error(), &["scene", "found 4"]);
}

#[test]
fn a_chain_of_a_hundred_thousand_nodes_is_walked() {
    let mut glb = Glb::triangle();
    let n = 100_000;
    let mut nodes: Vec<_> = (1..n).map(|i| json!({"children": [i]})).collect();
    nodes.push(json!({"mesh": 0}));
    glb.json["nodes"] = json!(nodes);
    assert_eq!(glb.load().mesh.triangles.len(), 1);
}

#[test]
fn instances_count_towards_the_limits() {
    let mut glb = Glb::triangle();
    glb.json["nodes"] = json!(vec![json!({"mesh": 0}); 1000]);
    let bytes = glb.bytes();
    let limits = |max_triangles, max_vertices| LoadLimits { max_triangles, max_vertices, ..LoadLimits::default() };
    assert!(load_mesh_bytes(MeshFormat::Gltf, &bytes, &limits(1000, 3000)).is_ok());
    assert_names(&error_with(&bytes, &limits(999, 3000)), &["max_triangles"]);
    assert_names(&error_with(&bytes, &limits(1000, 2999)), &["max_vertices"]);
    // Primitives that hold nothing take time.
    *glb.primitive("mode") = json!(0);
    assert_names(&error_with(&glb.bytes(), &limits(999, 3000)), &["primitives", "max_triangles"]);
}

#[test]
fn a_thousand_million_vertices_are_not_allocated() {
    for count in [1_000_000_000u64, u64::from(u32::MAX), 1 << 60] {
        let mut glb = Glb::new();
        glb.json["accessors"] = json!([{"componentType": F32, "type": "VEC3", "count": count}]);
        glb.primitive("attributes")["POSITION"] = json!(0);
        assert_names(&glb.error(), &["max_triangles"]);
        // Indices without data: all zeros.
        let mut glb = Glb::triangle();
        glb.json["accessors"]
            .as_array_mut()
            .unwrap()
            .push(json!({"componentType": U32, "type": "SCALAR", "count": count}));
        *glb.primitive("indices") = json!(1);
        assert_names(&glb.error(), &["indices", "max_triangles"]);
    }
}

#[test]
fn json_that_would_fill_the_memory() {
    let limits = LoadLimits { max_json_items: 1000, ..LoadLimits::default() };
    let nodes = "{},".repeat(1000);
    assert_names(&error_with(format!("{{\"nodes\":[{nodes}").as_bytes(), &limits), &["JSON", "max_json_items"]);
    // Brackets in strings are no items.
    let mut glb = Glb::triangle();
    glb.json["asset"]["generator"] = json!("{[,".repeat(1000) + "\"{");
    assert!(load_mesh_bytes(MeshFormat::Gltf, &glb.bytes(), &limits).is_ok());
    let deep = "[".repeat(100_000);
    assert_names(
        &error_with(format!("{{\"asset\":{{\"version\":\"2.0\",\"extras\":{deep}").as_bytes(), &LoadLimits::default()),
        &["JSON"],
    );
    assert_names(&error_with(b"{\"asset\":{\"version\":\"1.0\"}}", &LoadLimits::default()), &["1.0"]);
    assert_names(&error_with(b"\xff\xfe", &LoadLimits::default()), &["JSON"]);
}

#[test]
fn positions_that_are_not_numbers_or_have_no_area() {
    for bad in [f32::NAN, f32::INFINITY, f32::MAX] {
        let mut glb = Glb::new();
        glb.attribute("POSITION", "VEC3", &[0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, bad, 0.0]);
        assert_names(&glb.error(), &["positions", "finite"]);
    }
    let mut glb = Glb::new();
    glb.attribute("POSITION", "VEC3", &[1.0, 0.0, 0.0, 2.0, 0.0, 0.0, 3.0, 0.0, 0.0]);
    assert_names(&glb.error(), &["triangles", "area"]);
    glb.json["nodes"] = json!([{"mesh": 0, "scale": [0, 0, 0]}]);
    assert_names(&glb.error(), &["triangles", "area"]);
    glb.json["nodes"] = json!([]);
    assert_names(&glb.error(), &["triangles", "none"]);
    assert_names(&Glb::new().error(), &["triangles", "none"]);
    // Broken normals and colors are only replaced.
    let mut glb = Glb::triangle();
    glb.attribute("NORMAL", "VEC3", &[f32::NAN; 9]);
    glb.attribute("COLOR_0", "VEC4", &[f32::INFINITY; 12]);
    let mesh = glb.load().mesh;
    assert_close(mesh.normals[0], [0.0, -1.0, 0.0]);
    assert!(mesh.colors.is_empty());
}

fn with_picture(picture: &[u8]) -> Glb {
    Glb::textured(json!({"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}), picture)
}

fn gray_png(width: u32, height: u32) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image::GrayImage::new(width, height).write_to(&mut bytes, ImageFormat::Png).unwrap();
    bytes.into_inner()
}

#[test]
fn pictures_that_are_too_large_or_broken() {
    assert_names(&with_picture(&gray_png(20_000, 2)).error(), &["images[0]", "max_texture_side"]);
    assert_names(&with_picture(&gray_png(2, 20_000)).error(), &["images[0]", "max_texture_side"]);
    // Few bytes, many pixels.
    let limits = LoadLimits { max_texture_pixels: 1_000_000, ..LoadLimits::default() };
    let bomb = gray_png(4000, 4000);
    assert!(bomb.len() < 100_000);
    assert_names(&error_with(&with_picture(&bomb).bytes(), &limits), &["images[0]", "max_texture_pixels"]);
    // Many pictures share one limit; one picture under two names counts twice.
    let mut glb = with_picture(&gray_png(800, 800));
    glb.json["images"] = json!([glb.json["images"][0], glb.json["images"][0]]);
    glb.json["textures"] = json!([{"source": 0}, {"source": 1}]);
    glb.json["materials"][0]["emissiveTexture"] = json!({"index": 1});
    assert_names(&error_with(&glb.bytes(), &limits), &["images[1]", "max_texture_pixels"]);

    let png = small_picture(ImageFormat::Png);
    for format in [ImageFormat::Png, ImageFormat::Jpeg, ImageFormat::WebP] {
        let whole = small_picture(format);
        assert_names(&with_picture(&whole[..20]).error(), &["images[0]"]);
    }
    assert_names(&with_picture(&png[..png.len() - 20]).error(), &["images[0]"]);
    assert_names(&with_picture(b"GIF89a\x01\0\x01\0\0\0\0;").error(), &["images[0]", "Gif"]);
    assert_names(&with_picture(b"what is this?").error(), &["images[0]", "PNG, JPEG or WebP"]);
}

#[test]
fn references_to_what_is_not_there() {
    let png = small_picture(ImageFormat::Png);
    for (table, value, words) in [
        ("images", json!([{"bufferView": 44}]), ["images[0]", "found 44"]),
        ("images", json!([{}]), ["images[0]", "neither"]),
        ("images", json!([{"uri": "gone.png"}]), ["images[0].uri", "gone.png"]),
        ("textures", json!([{"source": 3}]), ["images[3]", "below 1"]),
        ("textures", json!([]), ["texture index", "found 0"]),
        ("textures", json!([{"source": 0, "sampler": 2}]), ["sampler index", "found 2"]),
        ("materials", json!([]), ["material", "found 0"]),
        ("materials", json!([{"alphaMode": "SOMETIMES"}]), ["alphaMode", "another"]),
    ] {
        let mut glb = with_picture(&png);
        glb.json[table] = value;
        assert_names(&glb.error(), &words);
    }
}

#[test]
fn required_extensions_are_refused_by_name() {
    for (name, word) in [
        ("KHR_draco_mesh_compression", "gltf-transform"),
        ("EXT_meshopt_compression", "gltf-transform"),
        ("KHR_texture_basisu", "ktxdecompress"),
        ("ACME_secret", "ACME_secret"),
    ] {
        let mut glb = Glb::triangle();
        glb.json["extensionsRequired"] = json!([name]);
        assert_names(&glb.error(), &[name, word]);
        assert!(matches!(glb.try_load(), Err(MeshError::Unsupported { .. })));
    }
}

#[test]
fn files_outside_the_folder_are_not_read() {
    let outer = tempfile::tempdir().unwrap();
    let folder = outer.path().join("inner");
    std::fs::create_dir(&folder).unwrap();
    let glb = Glb::triangle();
    std::fs::write(outer.path().join("secret.bin"), &glb.bin).unwrap();
    let absolute = outer.path().join("secret.bin").to_str().unwrap().to_owned();
    let file_uri = format!("file://{absolute}");
    for uri in [
        "../secret.bin",
        "%2e%2e/secret.bin",
        "a/../../secret.bin",
        "..%2Fsecret.bin",
        &absolute,
        &file_uri,
        "http://localhost/secret.bin",
        "",
        ".",
        "a/..",
        "x%00y",
        "data:text/plain,AAAA",
        "data:;base64,!!!",
    ] {
        let mut json = glb.json.clone();
        json["buffers"][0] = json!({"byteLength": glb.bin.len(), "uri": uri});
        let path = folder.join("scene.gltf");
        std::fs::write(&path, json.to_string()).unwrap();
        let error = load_mesh(&path, &LoadLimits::default()).expect_err(uri).to_string();
        assert!(error.contains("buffers[0].uri"), "{uri}: {error}");
    }
    let error = load_mesh(&folder.join("none.glb"), &LoadLimits::default()).unwrap_err();
    assert!(matches!(&error, MeshError::Io(e) if e.path.ends_with("none.glb")), "{error}");
    let error = load_mesh(&folder.join("mesh.stl"), &LoadLimits::default()).unwrap_err().to_string();
    assert_names(&error, &["mesh.stl", "extension", "found stl"]);
}

#[test]
fn the_bytes_of_all_files_count() {
    let folder = tempfile::tempdir().unwrap();
    let glb = Glb::triangle();
    let mut json = glb.json.clone();
    // The same file a hundred times.
    json["buffers"] = json!(vec![json!({"byteLength": 36, "uri": "b.bin"}); 100]);
    let path = folder.path().join("scene.gltf");
    let text = json.to_string();
    std::fs::write(&path, &text).unwrap();
    std::fs::write(folder.path().join("b.bin"), &glb.bin).unwrap();
    let limits = |extra: usize| LoadLimits { max_file_bytes: (text.len() + extra) as u64, ..LoadLimits::default() };
    assert!(load_mesh(&path, &limits(3600)).is_ok());
    assert_names(&load_mesh(&path, &limits(3599)).unwrap_err().to_string(), &["size", "b.bin"]);
    let small = LoadLimits { max_file_bytes: 10, ..LoadLimits::default() };
    assert_names(&load_mesh(&path, &small).unwrap_err().to_string(), &["scene.gltf", "10 bytes"]);
}
