//! What glTF allows besides what we write: JSON with buffers beside or in it, sparse accessors, linear colors, nodes far
//! away.

mod common;

use std::path::Path;

use base64::{Engine, engine::general_purpose::STANDARD};
use common::{difference, object};
use freerange_gaussians::Splats;
use freerange_gaussians::formats::{Format, Frame, WriteOptions, encode, parse, read};
use glam::DVec3;
use serde_json::{Value, json};

/// JSON and binary chunk of what we write, +y up.
fn parts(splats: &Splats) -> (Value, Vec<u8>) {
    let options = WriteOptions { frame: Frame::Y_UP, ..WriteOptions::default() };
    let glb = encode(splats, Format::Glb, &options).unwrap().bytes;
    let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    (serde_json::from_slice(&glb[20..20 + length]).unwrap(), glb[28 + length..].to_vec())
}

fn same(found: &Splats, expected: &Splats) {
    difference(&expected.cloud, &found.cloud).assert_within(1e-6, 1e-6, 1e-6, 1e-6, 1e-6);
}

#[test]
fn buffers_may_lie_in_the_json_or_beside_it() {
    let splats: Splats = object(20).into();
    let (mut json, binary) = parts(&splats);
    let uri = |base64: &str| format!("data:application/octet-stream;base64,{base64}");
    json["buffers"][0]["uri"] = uri(&STANDARD.encode(&binary)).into();
    same(&parse(Format::Glb, json.to_string().as_bytes(), Path::new("a.gltf"), Frame::Y_UP).unwrap().splats, &splats);
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("the data.bin"), &binary).unwrap();
    json["buffers"][0]["uri"] = "the%20data.bin".into();
    let path = folder.path().join("a.gltf");
    std::fs::write(&path, json.to_string()).unwrap();
    same(&read(&path, Frame::Y_UP).unwrap().splats, &splats);
    let mut refused = |uri: Value, words: &[&str]| {
        json["buffers"][0]["uri"] = uri;
        std::fs::write(&path, json.to_string()).unwrap();
        let error = read(&path, Frame::Y_UP).unwrap_err().to_string();
        words.iter().for_each(|w| assert!(error.contains(w), "{w:?} in {error}"));
    };
    refused("../the data.bin".into(), &["a.gltf", "in the same folder", "another path"]);
    refused("/etc/hostname".into(), &["in the same folder", "another path"]);
    refused("missing.bin".into(), &["missing.bin", "a file in the same folder"]);
    refused(Value::Null, &["buffer 0, uri", "none"]);
    refused(uri("?").into(), &["buffer 0, uri", "base64"]);
    refused("data:text/plain,AAAA".into(), &["buffer 0, uri", "base64 data"]);
}

#[test]
fn sparse_accessors_replace_elements() {
    let splats: Splats = object(20).into();
    let (mut json, mut binary) = parts(&splats);
    let position = json["meshes"][0]["primitives"][0]["attributes"]["POSITION"].as_u64().unwrap() as usize;
    let start = binary.len();
    binary.extend([3u8, 0, 7, 0]);
    [1f32, 2.0, 3.0, -1.0, -2.0, -3.0].iter().for_each(|v| binary.extend(v.to_le_bytes()));
    let views = json["bufferViews"].as_array_mut().unwrap();
    views.push(json!({ "buffer": 0, "byteOffset": start, "byteLength": 4 }));
    views.push(json!({ "buffer": 0, "byteOffset": start + 4, "byteLength": 24 }));
    let n = views.len();
    json["accessors"][position]["sparse"] = json!({
        "count": 2,
        "indices": { "bufferView": n - 2, "componentType": 5123 },
        "values": { "bufferView": n - 1 },
    });
    let load = |json: &Value| {
        let mut json = json.clone();
        json["buffers"][0] = json!({
            "byteLength": binary.len(),
            "uri": format!("data:application/octet-stream;base64,{}", STANDARD.encode(&binary)),
        });
        parse(Format::Glb, json.to_string().as_bytes(), Path::new("a"), Frame::Y_UP)
    };
    let found = load(&json).unwrap().splats.cloud;
    for i in 0..20 {
        let expected = match i {
            3 => DVec3::new(1.0, 2.0, 3.0),
            7 => DVec3::new(-1.0, -2.0, -3.0),
            _ => splats.cloud.mean(i),
        };
        assert!(found.mean(i).abs_diff_eq(expected, 1e-6), "{i}");
    }
    // Without a view the others are zero; an index beyond the end is refused.
    let mut without = json.clone();
    without["accessors"][position].as_object_mut().unwrap().remove("bufferView");
    let found = load(&without).unwrap().splats.cloud;
    assert!(found.mean(0) == DVec3::ZERO && found.mean(3) == DVec3::new(1.0, 2.0, 3.0));
    without["accessors"][position]["count"] = 1_000_000_000.into();
    assert!(load(&without).unwrap_err().to_string().contains("sparse accessor, count"));
    json["accessors"][position]["sparse"]["indices"]["byteOffset"] = 1.into();
    json["accessors"][position]["sparse"]["count"] = 1.into();
    let error = load(&json).unwrap_err().to_string();
    assert!(error.contains("sparse indices below 20") && error.contains("1792"), "{error}");
}

#[test]
fn linear_colors_become_srgb() {
    let mut splats: Splats = object(20).into();
    for row in splats.cloud.iter_mut() {
        row[11..14].copy_from_slice(&[0.5, 0.001, 1.0]);
    }
    let (json, binary) = parts(&splats);
    let mut json: Value =
        serde_json::from_str(&json.to_string().replace("srgb_rec709_display", "lin_rec709_display")).unwrap();
    json["buffers"][0]["uri"] = format!("data:a/b;base64,{}", STANDARD.encode(&binary)).into();
    let found = parse(Format::Glb, json.to_string().as_bytes(), Path::new("a"), Frame::Y_UP).unwrap().splats;
    assert!(found.cloud.color(4).abs_diff_eq(DVec3::new(0.735_357, 0.012_92, 1.0), 1e-5), "{}", found.cloud.color(4));
}

#[test]
fn nodes_far_away_keep_the_shape() {
    let splats: Splats = object(50).into();
    let (mut json, binary) = parts(&splats);
    let far = DVec3::new(-3_959_505.25, 3_699_979.5, 3_350_245.75);
    json["nodes"][0]["translation"] = json!(far.to_array());
    json["buffers"][0]["uri"] = format!("data:a/b;base64,{}", STANDARD.encode(&binary)).into();
    let found = parse(Format::Glb, json.to_string().as_bytes(), Path::new("a"), Frame::Y_UP).unwrap().splats;
    assert!((0..50).all(|i| (found.position(i) - far - splats.cloud.mean(i)).length() < 1e-6));
}
