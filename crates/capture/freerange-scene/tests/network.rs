//! Masks from ONNX networks, against ONNX's own evaluator (`tools/mask_network.py`).
#![cfg(feature = "mask-model")]

use freerange_scene::{LoadConfig, MaskKind, MaskModel, MaskSource, PixelRange, load, read::cameras};
use serde_json::json;
use std::{collections::BTreeMap, path::PathBuf};

fn golden(name: &str) -> PathBuf {
    freerange_vectors::path("mask_network").join(name)
}

/// A scene of three times the golden photo.
fn scene() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let frames: Vec<_> = (0..3)
        .map(|i| {
            let name = format!("{i}.png");
            std::fs::copy(golden("photo.png"), folder.path().join(&name)).unwrap();
            let (s, c) = (2.0 * f64::from(i)).sin_cos();
            let pose = [[-s, 0.0, c, 2.0 * c], [c, 0.0, s, 2.0 * s], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
            json!({"file_path": name, "transform_matrix": pose})
        })
        .collect();
    let text = json!({"camera_angle_x": 0.8, "frames": frames}).to_string();
    std::fs::write(folder.path().join("transforms.json"), text).unwrap();
    folder
}

fn masks(file: PathBuf, pixels: PixelRange) -> Result<Vec<u8>, String> {
    let folder = scene();
    let found = cameras(folder.path(), None, None).unwrap();
    let config = LoadConfig { masks: MaskSource::Model(MaskModel { file, pixels }), ..LoadConfig::default() };
    let loaded = load(&found, &config).map_err(|e| e.to_string())?;
    assert_eq!(loaded.masks, MaskKind::Model);
    Ok(loaded.views[0].image.pixels().map(|p| p[3]).collect())
}

#[test]
fn networks_give_the_masks_that_onnx_says_they_do() {
    let expected: BTreeMap<String, Vec<f64>> =
        serde_json::from_value(freerange_vectors::json("mask_network/expected.json")).unwrap();
    assert_eq!(expected.len(), 8);
    for network in ["probabilities", "log_odds"] {
        for (name, range) in PixelRange::ALL {
            let found = masks(golden(&format!("{network}.onnx")), range).unwrap();
            let expected = &expected[&format!("{network}-{name}")];
            assert_eq!(found.len(), expected.len());
            let off = found.iter().zip(expected).map(|(f, e)| (f64::from(*f) - e).abs()).fold(0.0, f64::max);
            assert!(off < 0.6, "{network}, {name}: {off} of 255");
        }
    }
}

#[test]
fn other_networks_are_refused() {
    let says = |file: PathBuf, words: &[&str]| {
        let text = masks(file, PixelRange::Unit).unwrap_err();
        words.iter().for_each(|w| assert!(text.contains(w), "expected {w:?} in: {text}"));
    };
    says(golden("two_inputs.onnx"), &["two_inputs.onnx", "`inputs`", "expected one, found 2"]);
    says(golden("four_channels.onnx"), &["four_channels.onnx", "`input shape`", "1 x 3 x", "1 x 4 x 12 x 16"]);
    says(golden("photo.png"), &["photo.png", "ONNX"]);
    says(golden("none.onnx"), &["none.onnx"]);
    let folder = tempfile::tempdir().unwrap();
    let bytes = std::fs::read(golden("probabilities.onnx")).unwrap();
    for length in [0, 20, bytes.len() / 2] {
        let cut = folder.path().join("cut.onnx");
        std::fs::write(&cut, &bytes[..length]).unwrap();
        says(cut, &["cut.onnx"]);
    }
}
