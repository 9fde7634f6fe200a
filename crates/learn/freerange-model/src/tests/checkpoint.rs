//! Checkpoints written, read, and refused.

use std::path::Path;

use burn::{
    module::Module,
    optim::{AdamWConfig, GradientsParams},
    tensor::{Device, Tensor},
};
use freerange_gaussians::Normalization;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{assert_close, numbers, path};
use crate::{Checkpoint, Dinov2, EncoderConfig, FreeRange, ModelConfig, PatchConfig, Precision};

fn config() -> ModelConfig {
    ModelConfig {
        image_size: 8,
        encoder: EncoderConfig::Patch(PatchConfig { patch_size: 4, channels: 4 }),
        hidden: 16,
        blocks: 2,
        heads: 2,
        registers: 3,
        time_features: 8,
        ..ModelConfig::default()
    }
}

/// A checkpoint in which no weight is zero.
fn checkpoint(config: ModelConfig) -> Checkpoint {
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let model = FreeRange::new(&config, &mut rng, &Device::flex()).unwrap();
    let values: Vec<Vec<f32>> =
        model.parameters().iter().map(|p| p.values.iter().map(|_| rng.random_range(-0.5..0.5)).collect()).collect();
    Checkpoint {
        config,
        model: model.set_parameters(&values).unwrap(),
        normalization: Normalization::new([0.25; 14], [1.5; 14]).unwrap(),
        gradient_rms: std::array::from_fn(|i| 0.1 + i as f32),
        depth: 9,
        provenance: serde_json::json!({"data": "three objects", "steps": 7}),
    }
}

fn output(model: &FreeRange) -> Vec<f32> {
    let device = Device::flex();
    let tokens = model.encode(Tensor::ones([1, 2, 8, 8, 4], &device), Tensor::ones([1, 2, 2, 2, 6], &device));
    let z = Tensor::<3>::ones([1, 4, 14], &device);
    numbers(model.denoise(z.clone(), Some(z), tokens, Tensor::from_floats([0.3], &device)))
}

#[test]
fn what_is_saved_is_loaded() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    let saved = checkpoint(config());
    for precision in [Precision::F32, Precision::F16] {
        saved.save_as(&path, precision).unwrap();
        let loaded = Checkpoint::load(&path, &Device::flex()).unwrap();
        assert_eq!(loaded.config, saved.config);
        assert_eq!(loaded.normalization, saved.normalization);
        assert_eq!(loaded.gradient_rms, saved.gradient_rms);
        assert_eq!((loaded.depth, &loaded.provenance), (saved.depth, &saved.provenance));
        match precision {
            Precision::F32 => assert_eq!(loaded.model.parameters(), saved.model.parameters()),
            Precision::F16 => assert_close("f16", &output(&loaded.model), &output(&saved.model), 5e-3),
        }
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing is left beside the checkpoint");
}

#[test]
fn half_precision_halves_the_file_and_refuses_overflow() {
    let folder = tempfile::tempdir().unwrap();
    let size = |precision| {
        let path = folder.path().join("model.safetensors");
        checkpoint(config()).save_as(&path, precision).unwrap();
        std::fs::metadata(&path).unwrap().len()
    };
    let weights: usize = checkpoint(config()).model.parameters().iter().map(|p| p.values.len()).sum();
    let saved = (size(Precision::F32) - size(Precision::F16)) as usize;
    assert!(saved.abs_diff(2 * weights) < 4096, "{saved} {weights}");
    let mut large = checkpoint(config());
    let mut values: Vec<Vec<f32>> = large.model.parameters().into_iter().map(|p| p.values).collect();
    values[3][0] = 1e5;
    large.model = large.model.set_parameters(&values).unwrap();
    let message = large.save_as(&folder.path().join("x"), Precision::F16).unwrap_err().to_string();
    assert!(message.contains("not finite"), "{message}");
}

#[test]
fn names_are_pytorchs() {
    let parameters = checkpoint(config()).model.parameters();
    let shape =
        |name: &str| parameters.iter().find(|p| p.name == name).unwrap_or_else(|| panic!("{name}")).shape.clone();
    assert_eq!(shape("dit.registers"), [3, 16]);
    assert_eq!(shape("dit.gs_in.weight"), [16, 56]);
    assert_eq!(shape("dit.t_mlp.0.weight"), [16, 8]);
    assert_eq!(shape("dit.t_mlp.2.bias"), [16]);
    assert_eq!(shape("dit.blocks.1.attn.qkv.weight"), [48, 16]);
    assert_eq!(shape("dit.blocks.0.attn.q_norm.weight"), [8]);
    assert_eq!(shape("dit.blocks.0.ffn.proj_in.weight"), [128, 16]);
    assert_eq!(shape("dit.final.adaln.weight"), [32, 16]);
    assert_eq!(shape("dit.final.linear.weight"), [28, 16]);
}

#[test]
fn parameters_that_do_not_fit_are_refused() {
    let model = checkpoint(config()).model;
    let values: Vec<Vec<f32>> = model.parameters().into_iter().map(|p| p.values).collect();
    let mut short = values.clone();
    short.pop();
    let mut long = values.clone();
    long.push(vec![0.0]);
    let mut wrong = values.clone();
    wrong[0].push(0.0);
    for (values, word) in [(short, "no values for"), (long, "too many"), (wrong, "given")] {
        let message = model.clone().set_parameters(&values).unwrap_err().to_string();
        assert!(message.contains(word), "{message}");
    }
}

#[test]
fn set_parameters_keeps_a_model_trainable() {
    let device = Device::flex().autodiff();
    let model = FreeRange::new(&config(), &mut ChaCha8Rng::seed_from_u64(1), &device).unwrap();
    let values: Vec<Vec<f32>> = checkpoint(config()).model.parameters().into_iter().map(|p| p.values).collect();
    let mut model = model.set_parameters(&values).unwrap();
    let mut optimizer = AdamWConfig::new().init();
    let target = Tensor::<3>::ones([1, 4, 14], &device);
    let mut losses = Vec::new();
    for _ in 0..30 {
        let tokens = model.encode(Tensor::ones([1, 2, 8, 8, 4], &device), Tensor::ones([1, 2, 2, 2, 6], &device));
        let out = model.denoise(target.zeros_like(), None, tokens, Tensor::from_floats([0.3], &device));
        let loss = (out - target.clone()).square().mean();
        losses.push(numbers(loss.clone().unsqueeze::<1>())[0]);
        let gradients = GradientsParams::from_grads(loss.backward(), &model);
        assert_eq!(gradients.len(), model.parameters().len(), "every parameter has a gradient");
        model = optimizer.step(1e-2, model, gradients);
    }
    assert!(losses[29] < 0.1 * losses[0], "{losses:?}");
    assert_eq!(output(&model.valid()).len(), 56);
}

/// The metadata and tensors of a saved checkpoint, to change and store again.
fn tampered(path: &Path, change: impl Fn(&mut serde_json::Map<String, serde_json::Value>)) -> String {
    checkpoint(config()).save(path).unwrap();
    let bytes = std::fs::read(path).unwrap();
    let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let mut header: serde_json::Map<_, _> = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
    change(&mut header);
    let header = serde_json::to_vec(&header).unwrap();
    let mut out = (header.len() as u64).to_le_bytes().to_vec();
    out.extend(&header);
    out.extend(&bytes[8 + length..]);
    std::fs::write(path, out).unwrap();
    Checkpoint::load(path, &Device::flex()).unwrap_err().to_string()
}

#[test]
fn hostile_files_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    let meta = |key: &'static str, value: &'static str| {
        move |h: &mut serde_json::Map<String, serde_json::Value>| h["__metadata__"][key] = value.into()
    };
    let lacking = |key: &'static str| {
        move |h: &mut serde_json::Map<String, serde_json::Value>| {
            h["__metadata__"].as_object_mut().unwrap().remove(key);
        }
    };
    let big = r#"{"image_size":8,"encoder":{"kind":"patch","patch_size":4},"hidden":16384,"blocks":512}"#;
    let endless = r#"{"image_size":8,"encoder":{"kind":"patch","patch_size":4},"blocks":99999999999}"#;
    let cases = [
        (tampered(&path, lacking("normalization")), "`normalization`"),
        (tampered(&path, lacking("gradient_rms")), "`gradient_rms`"),
        (tampered(&path, lacking("format")), "`format`"),
        (tampered(&path, meta("format", "other")), "`other`"),
        (tampered(&path, meta("version", "2")), "version is `2`"),
        (tampered(&path, meta("depth", "-1")), "`depth` is `-1`"),
        (tampered(&path, meta("depth", "60")), "`depth` is `60`"),
        (tampered(&path, meta("depth", "21")), "from 1 to 20"), // two Gaussians are one token
        (tampered(&path, meta("depth", "0")), "`depth` is `0`"),
        (tampered(&path, meta("config", "{")), "`config`"),
        (tampered(&path, meta("config", big)), "expected [32, 16384]"),
        (tampered(&path, meta("config", endless)), "blocks: expected"),
        (tampered(&path, meta("normalization", r#"{"mean":[1],"std":[1]}"#)), "`normalization`"),
        (tampered(&path, meta("gradient_rms", "[0,0,0,0,0,0,0,0,0,0,0,0,0,0]")), "`gradient_rms`"),
        (tampered(&path, |h| drop(h.remove("__metadata__"))), "lack"),
        (tampered(&path, |h| h["dit.registers"]["shape"] = serde_json::json!([16, 3])), "dit.registers"),
        (tampered(&path, |h| h["dit.registers"]["dtype"] = "I32".into()), "I32"),
        (
            tampered(&path, |h| {
                let tensor = h.remove("dit.registers").unwrap();
                h.insert("dit.other".to_owned(), tensor);
            }),
            "dit.registers",
        ),
    ];
    for (message, word) in cases {
        assert!(message.contains(word) && message.contains("model.safetensors"), "{word}: {message}");
    }
}

#[test]
fn cut_and_foreign_files_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    checkpoint(config()).save(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    for length in [0, 7, 8, 100, bytes.len() / 2, bytes.len() - 1] {
        std::fs::write(&path, &bytes[..length]).unwrap();
        assert!(Checkpoint::load(&path, &Device::flex()).unwrap_err().to_string().contains("not a valid"));
    }
    let mut huge = bytes.clone();
    huge[..8].copy_from_slice(&u64::MAX.to_le_bytes());
    std::fs::write(&path, huge).unwrap();
    assert!(Checkpoint::load(&path, &Device::flex()).is_err());
    let mut nan = bytes;
    let end = nan.len();
    nan[end - 4..].copy_from_slice(&f32::NAN.to_le_bytes());
    std::fs::write(&path, nan).unwrap();
    assert!(Checkpoint::load(&path, &Device::flex()).unwrap_err().to_string().contains("not finite"));
    let foreign = self::path("dino/mlp_img56/model.safetensors");
    assert!(Checkpoint::load(&foreign, &Device::flex()).unwrap_err().to_string().contains("format"));
    assert!(Checkpoint::load(folder.path(), &Device::flex()).is_err());
    assert!(Checkpoint::load(&folder.path().join("none"), &Device::flex()).unwrap_err().to_string().contains("none"));
}

#[test]
fn an_outside_encoder_is_named_and_demanded() {
    let device = Device::flex();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.safetensors");
    let dinov2 = Dinov2::load(&self::path("dino/mlp_img56"), &device).unwrap();
    let config = ModelConfig { encoder: EncoderConfig::Dinov2(dinov2.config().clone()), image_size: 28, ..config() };
    let mut saved = checkpoint(config.clone());
    saved.model = saved.model.with_dinov2(&config, dinov2.clone()).unwrap();
    saved.save(&path).unwrap();
    let message = Checkpoint::load(&path, &device).unwrap_err().to_string();
    assert!(message.contains("mlp_img56") && message.contains(&dinov2.origin().unwrap().sha256), "{message}");
    let loaded = Checkpoint::load_with_dinov2(&path, dinov2.clone(), &device).unwrap();
    assert_eq!(loaded.model.parameters(), saved.model.parameters());

    // The same architecture with other weights.
    let other = folder.path().join("other");
    std::fs::create_dir(&other).unwrap();
    std::fs::copy(self::path("dino/mlp_img56/config.json"), other.join("config.json")).unwrap();
    let mut bytes = std::fs::read(self::path("dino/mlp_img56/model.safetensors")).unwrap();
    let end = bytes.len();
    bytes[end - 4..].copy_from_slice(&0.5f32.to_le_bytes());
    std::fs::write(other.join("model.safetensors"), bytes).unwrap();
    let other = Dinov2::load(&other, &device).unwrap();
    let message = Checkpoint::load_with_dinov2(&path, other, &device).unwrap_err().to_string();
    assert!(message.contains("sha256"), "{message}");

    checkpoint(self::config()).save(&path).unwrap();
    assert!(Checkpoint::load_with_dinov2(&path, dinov2, &device).is_err());
}
