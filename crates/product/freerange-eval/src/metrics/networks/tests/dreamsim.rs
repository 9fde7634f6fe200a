//! Distances against the DreamSim package's.

use std::path::Path;

use freerange_vectors::{json, json_at};

use super::{Vectors, device, golden, image};
use crate::metrics::{
    MetricsError,
    networks::{
        cosine_similarity,
        dreamsim::{BranchFile, CLIP, DINO_B16, DreamSim, IMAGENET},
        vit::VitConfig,
    },
};

pub(super) fn load(folder: &Path, adapter: &Path, branches: usize) -> Result<DreamSim, MetricsError> {
    let shape = &json("metrics/networks/dreamsim.json")["shape"];
    let n = |name: &str| shape[name].as_u64().unwrap() as usize;
    let (width, depth, heads, patch, side) = (n("width"), n("depth"), n("heads"), n("patch"), n("side"));
    let dino = VitConfig { width, depth, heads, patch, side, ..DINO_B16 };
    let open_clip = VitConfig { pre_norm: true, epsilon: 1e-5, projection: Some(n("projection")), ..dino };
    let clip = VitConfig { quick_gelu: true, ..open_clip };
    let paths = ["dino.pth", "clip.pth.tar", "open_clip.pth.tar"].map(|name| folder.join(name));
    let key = Some("state_dict");
    let files = [
        BranchFile { path: &paths[0], key: None, config: dino, mean_and_deviation: IMAGENET },
        BranchFile { path: &paths[1], key, config: clip, mean_and_deviation: CLIP },
        BranchFile { path: &paths[2], key, config: open_clip, mean_and_deviation: CLIP },
    ];
    DreamSim::load(&files[..branches], adapter, &device())
}

#[test]
fn distances_are_the_packages() {
    let folder = golden("networks");
    let v = Vectors::open(&folder.join("dreamsim.safetensors"));
    let distances = json_at(&folder.join("dreamsim.json"))["distances"].clone();
    let images: Vec<_> = (0..3).map(|i| image(&v, &format!("in/image{i}"))).collect();
    for (label, branches) in [("dino", 1), ("ensemble", 3)] {
        let network = load(&folder, &folder.join(format!("{label}_lora")), branches).unwrap();
        let embeddings = network.embed(&images);
        for (a, b) in [(0, 1), (0, 2), (1, 2)] {
            let expected = distances[format!("{label}/{a}{b}")].as_f64().unwrap();
            let found = 1.0 - cosine_similarity(&embeddings[a], &embeddings[b]);
            assert!((found - expected).abs() < 1e-5, "{label} {a}{b}: expected {expected}, found {found}");
            assert!(expected > 1e-3, "the vectors tell images apart");
        }
        // One by one the embeddings are the same as in a batch.
        let alone = network.embed(&images[1..2]);
        assert!(1.0 - cosine_similarity(&alone[0], &embeddings[1]) < 1e-10);
    }
}

#[test]
fn the_adapter_must_fit_the_networks() {
    let folder = golden("networks");
    // The ensemble's adapter has parts that the single network does not take.
    let error = load(&folder, &folder.join("ensemble_lora"), 1).err().unwrap();
    assert!(matches!(&error, MetricsError::Tensor { tensor, .. } if tensor.contains("extractor_list.1")), "{error}");

    let temporary = tempfile::tempdir().unwrap();
    let missing = load(&folder, temporary.path(), 1).err().unwrap();
    assert!(missing.to_string().contains("adapter_config.json"), "{missing}");
    let config = temporary.path().join("adapter_config.json");
    for (text, says) in [
        ("{", "adapter configuration"),
        (r#"{"r": 4}"#, "lora_alpha"),
        (r#"{"r": 0, "lora_alpha": 1}"#, "`r` is 0"),
        (r#"{"r": 4, "lora_alpha": 1, "use_rslora": true}"#, "use_rslora"),
    ] {
        std::fs::write(&config, text).unwrap();
        let error = load(&folder, temporary.path(), 1).err().unwrap().to_string();
        assert!(error.contains(says), "{error}");
    }
    std::fs::write(&config, r#"{"r": 4, "lora_alpha": 1}"#).unwrap();
    let error = load(&folder, temporary.path(), 1).err().unwrap().to_string();
    assert!(error.contains("adapter_model.bin"), "{error}");
}
