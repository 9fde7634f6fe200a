//! Distances against the LPIPS package's.

use std::{collections::HashMap, path::PathBuf};

use burn::tensor::Tensor;
use freerange_vectors::json_at;

use super::{Vectors, close, device, golden, tensor, uniform};
use crate::metrics::{
    MetricsError,
    networks::{
        Lpips, LpipsNet, host,
        source::{Source, TensorFile},
    },
};

/// Weights by the rule that the vectors' JSON states.
struct Rule(serde_json::Value);

impl Source for Rule {
    fn values(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, MetricsError> {
        let rule = &self.0["meta"]["procedural"]["tensors"][name];
        let bound = rule["bound"].as_f64().unwrap();
        let unit = uniform(rule["seed"].as_u64().unwrap(), shape.iter().product(), 0.0, 1.0);
        let values: Vec<f32> = unit.into_iter().map(|u| ((2.0 * f64::from(u) - 1.0) * bound) as f32).collect();
        let first: Vec<f32> = rule["first4"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap() as f32).collect();
        close(&values[..4], &first, 1e-7);
        Ok(values)
    }
}

/// Weights and heads that lie in the vectors themselves.
struct InFile<'a>(&'a Vectors);

impl Source for InFile<'_> {
    fn values(&mut self, name: &str, _: &[usize]) -> Result<Vec<f32>, MetricsError> {
        let name = name.strip_suffix(".model.1.weight").unwrap_or(name); // heads have short names there
        let weight = format!("net/{name}");
        Ok(self.0.floats(if self.0.has(name) { name } else { &weight }).to_vec())
    }
}

fn check(net: LpipsNet, path: PathBuf, procedural: bool) {
    let v = Vectors::open(&path);
    let expected = json_at(&path.with_extension("json"));
    let mut heads = InFile(&v);
    let lpips = match procedural {
        true => Lpips::build(net, &mut Rule(expected.clone()), &mut heads, &device()),
        false => Lpips::build(net, &mut InFile(&v), &mut heads, &device()),
    };
    let lpips = lpips.unwrap();
    let scalars: HashMap<String, f64> = serde_json::from_value(expected["scalars_f64"].clone()).unwrap();
    let sizes: Vec<&str> = scalars.keys().filter_map(|key| key.strip_prefix("lpips_same_")).collect();
    assert!(!sizes.is_empty());
    let mut averaged = 0;
    for size in sizes {
        let unit = |name: &str| (tensor(&v, &format!("in/{name}_{size}")) + 1.0) / 2.0;
        let (a, b): (Tensor<4>, Tensor<4>) = (unit("img0"), unit("img1"));
        let found = f64::from(host(lpips.distance(a.clone(), b))[0]);
        let truth = scalars[&format!("lpips_{size}")];
        assert!((found - truth).abs() <= 5e-4 * truth + 1e-6, "{size}: expected {truth}, found {found}");
        assert_eq!(host(lpips.distance(a.clone(), a.clone()))[0], 0.0, "equal images");
        let deepest = host(lpips.deepest(a.clone()));
        let features = lpips.features(a);
        for layer in [1, 5] {
            let name = format!("out/relu{layer}_{size}");
            if v.has(&name) {
                let expected = v.floats(&name);
                let largest = expected.iter().fold(0.0f32, |m, x| m.max(x.abs()));
                close(&host(features[layer - 1].clone()), expected, 1e-4 * largest + 1e-5);
                if layer == 5 {
                    let pixels = expected.len() / deepest.len();
                    let means = expected.chunks(pixels).map(|c| c.iter().sum::<f32>() / pixels as f32);
                    close(&deepest, &means.collect::<Vec<_>>(), 1e-4 * largest + 1e-5);
                    averaged += 1;
                }
            }
        }
    }
    assert!(averaged > 0, "no deepest features in the vectors");
}

#[test]
fn alexnet() {
    check(LpipsNet::Alex, golden("lpips_alex_procedural_3102.safetensors"), true);
}

#[test]
fn vgg() {
    check(LpipsNet::Vgg, golden("lpips_vgg_procedural_3103.safetensors"), true);
}

#[test]
fn published_heads_are_read() {
    // As its authors ship it (R. Zhang et al., BSD-2-Clause): the format before PyTorch 1.6, saved on a GPU.
    let path = golden("networks/lpips_alex_v0.1.pth");
    let published = crate::metrics::weights::set("lpips-alex").unwrap().files[1].sha256;
    assert_eq!(freerange_util::sha256(&std::fs::read(&path).unwrap()), published);
    let mut file = TensorFile::open(&path, None).unwrap();
    let v = Vectors::open(&golden("lpips_alex_procedural_3102.safetensors"));
    for (i, channels) in [64, 192, 384, 256, 256].into_iter().enumerate() {
        let found = file.values(&format!("lin{i}.model.1.weight"), &[1, channels, 1, 1]).unwrap();
        assert_eq!(found, v.floats(&format!("lin{i}")));
    }
}

#[test]
#[ignore = "needs FREERANGE_SHARED"]
fn alexnet_with_weights_in_the_file() {
    let shared = std::env::var("FREERANGE_SHARED").unwrap();
    let path = PathBuf::from(shared).join("golden/dev/metrics/lpips_alex_file_3101.safetensors");
    check(LpipsNet::Alex, path, false);
}
