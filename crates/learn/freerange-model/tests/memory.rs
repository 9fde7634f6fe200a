//! The memory that `ModelInfo` predicts, against what a process needs for a training step on the CPU.
#![cfg(target_os = "linux")]

use burn::tensor::{Device, Distribution, Tensor};
use freerange_model::{EncoderConfig, Execution, FreeRange, ModelConfig, ModelInfo, PatchConfig, Workload};
use rand::SeedableRng;

/// Set for a child process: whether it recomputes.
const CHILD: &str = "FREERANGE_MEMORY_CHILD";

const LOAD: Workload = Workload { batch: 2, views: 4, gaussians: 1024 };

fn config() -> ModelConfig {
    ModelConfig {
        image_size: 224,
        encoder: EncoderConfig::Patch(PatchConfig { patch_size: 16, channels: 4 }),
        hidden: 192,
        blocks: 8,
        heads: 3,
        registers: 8,
        gaussians_per_token: 2,
        ..ModelConfig::default()
    }
}

/// A line of `/proc/self/status`, in bytes.
fn status(name: &str) -> u64 {
    let text = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = text.lines().find_map(|line| line.strip_prefix(name)).unwrap();
    line.trim_start_matches(':').trim().trim_end_matches(" kB").parse::<u64>().unwrap() * 1024
}

/// One training step without an optimizer; prints by how much memory rose at most.
#[test]
#[ignore = "a child process of the other test"]
fn child() {
    // Also started by whoever runs all ignored tests: then there is nothing to measure.
    let Ok(recompute) = std::env::var(CHILD) else { return };
    let recompute = recompute == "true";
    let device = Device::flex().autodiff();
    let config = config();
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
    let model = FreeRange::new(&config, &mut rng, &device).unwrap().with_recompute(recompute);
    let tokens = LOAD.views * config.patches_per_side().pow(2);
    let random = |shape: [usize; 3]| Tensor::random(shape, Distribution::Default, &device);
    let images = random([LOAD.batch, tokens, config.image_token_width()]);
    let noisy = random([LOAD.batch, LOAD.gaussians, 14]);
    let t = Tensor::from_floats([0.2, 0.7], &device);
    let before = status("VmRSS");
    let gradients = model.denoise(noisy, None, images, t).sum().backward();
    println!("rose by {}", status("VmHWM") - before);
    drop(gradients);
}

#[test]
fn prediction_holds() {
    for recompute in [false, true] {
        let out = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "child", "--ignored", "--nocapture"])
            .env(CHILD, recompute.to_string())
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&out.stdout);
        assert!(out.status.success(), "{text}");
        let found = text.lines().find_map(|line| line.split("rose by ").nth(1)).expect("the child says it");
        let found: f64 = found.trim().parse().unwrap();
        let info = ModelInfo::with_execution(&config(), LOAD, Execution { recompute, ..Execution::default() });
        // Weights were there before; there are gradients, but no moments and no average.
        let predicted = (info.step_bytes - info.state_bytes + 4 * info.trainable) as f64;
        let mib = |bytes: f64| bytes / f64::from(1 << 20);
        println!("recompute {recompute}: predicted {:.0} MiB, found {:.0} MiB", mib(predicted), mib(found));
        assert!((found / predicted - 1.0).abs() < 0.2, "predicted {:.0} MiB, found {:.0}", mib(predicted), mib(found));
    }
}
