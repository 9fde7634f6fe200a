//! DINOv2 against golden values, and broken weights.

use burn::{
    module::Module,
    tensor::{Device, Tensor},
};

use super::{Golden, devices, half_devices, path};
use crate::{Dinov2, ModelError};

/// Every stored image size of a folder, on every device: the tokens after the last norm.
fn folder(name: &str) -> Dinov2 {
    let golden = Golden::read(&format!("dino/{name}/io.safetensors"));
    let sizes: Vec<&str> = golden.names().filter_map(|n| n.strip_prefix("in/pixel_values_")).collect();
    assert!(!sizes.is_empty());
    let load = |device: &Device| Dinov2::load(&path(&format!("dino/{name}")), device).unwrap();
    for device in devices() {
        let dinov2 = load(&device);
        for size in &sizes {
            let pixels: Tensor<4> = golden.tensor(&format!("in/pixel_values_{size}"), &device);
            golden.check_absolute(&format!("out/embeddings_{size}"), dinov2.embed(pixels.clone()), 3e-4);
            golden.check_absolute(&format!("out/last_hidden_state_{size}"), dinov2.forward(pixels), 3e-4);
        }
    }
    for (device, compute) in half_devices() {
        let mut dinov2 = load(&device);
        dinov2.set_compute(compute);
        let pixels: Tensor<4> = golden.tensor(&format!("in/pixel_values_{}", sizes[0]), &device);
        golden.check(&format!("out/last_hidden_state_{}", sizes[0]), dinov2.forward(pixels), 2e-2);
    }
    load(&Device::flex())
}

#[test]
fn mlp_matches() {
    let dinov2 = folder("mlp_img56");
    assert_eq!(dinov2.origin().unwrap().name, "mlp_img56");
    assert_eq!(dinov2.origin().unwrap().sha256.len(), 64);
}

#[test]
fn shrunk_position_embeddings_match() {
    folder("mlp_img518");
}

#[test]
fn swiglu_matches() {
    folder("swiglu_img56");
}

#[test]
fn registers_match_and_are_no_patches() {
    let dinov2 = folder("registers_img56");
    let pixels = Tensor::<4>::ones([2, 3, 56, 70], &Device::flex());
    let all = dinov2.forward(pixels.clone());
    assert_eq!(all.dims(), [2, 1 + 4 + 20, 48]);
    let patches = dinov2.patch_features(pixels);
    super::assert_close("patches", &super::numbers(patches), &super::numbers(all.narrow(1, 5, 20)), 0.0);
}

#[test]
fn weights_are_frozen() {
    let device = Device::flex().autodiff();
    let dinov2 = Dinov2::load(&path("dino/mlp_img56"), &device).unwrap();
    let out = dinov2.forward(Tensor::ones([1, 3, 56, 56], &device));
    assert!(!out.is_tracked());
    assert!(dinov2.num_params() > 0);
}

/// A copy of a golden folder with something broken.
fn broken(change: impl Fn(&mut serde_json::Value), weights: impl Fn(Vec<u8>) -> Option<Vec<u8>>) -> ModelError {
    let source = path("dino/mlp_img56");
    let folder = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(source.join("config.json")).unwrap();
    let mut config: serde_json::Value = serde_json::from_str(&text).unwrap();
    change(&mut config);
    std::fs::write(folder.path().join("config.json"), config.to_string()).unwrap();
    if let Some(bytes) = weights(std::fs::read(source.join("model.safetensors")).unwrap()) {
        std::fs::write(folder.path().join("model.safetensors"), bytes).unwrap();
    }
    Dinov2::load(folder.path(), &Device::flex()).unwrap_err()
}

#[test]
fn broken_folders_are_refused_by_name() {
    let same = |_: &mut serde_json::Value| {};
    let cases = [
        (broken(same, |_| None), vec!["model.safetensors"]),
        (broken(same, |b| Some(b[..b.len() / 2].to_vec())), vec!["model.safetensors", "not a valid"]),
        (broken(same, |_| Some(Vec::new())), vec!["model.safetensors", "not a valid"]),
        (
            broken(|c| c["hidden_size"] = 64.into(), Some),
            vec!["projection.weight", "[64, 3, 14, 14]", "[48, 3, 14, 14]"],
        ),
        (broken(|c| c["num_hidden_layers"] = 9.into(), Some), vec!["encoder.layer.3.", "missing"]),
        (broken(|c| c["num_attention_heads"] = 5.into(), Some), vec!["config.json", "divisor"]),
        (broken(|c| c["num_hidden_layers"] = u64::MAX.into(), Some), vec!["config.json", "layers"]),
        (broken(|c| c["model_type"] = "vit".into(), Some), vec!["config.json", "model_type", "vit"]),
        (broken(|c| c["hidden_act"] = "relu".into(), Some), vec!["config.json", "hidden_act"]),
        (broken(|c| c["patch_size"] = 0.into(), Some), vec!["config.json", "patch_size"]),
        (broken(|c| *c = serde_json::json!([]), Some), vec!["config.json", "not a valid"]),
    ];
    for (error, words) in cases {
        let message = error.to_string();
        assert!(words.iter().all(|w| message.contains(w)), "{message}");
    }
}
