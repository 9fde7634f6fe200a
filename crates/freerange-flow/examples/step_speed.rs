//! How fast training steps are, and how much of that the matrix products alone would take.
//!
//! `cargo run --release -p freerange-flow --example step_speed -- configs/tiny.toml [steps per stage]`

use std::{process::Command, time::Instant};

use burn::tensor::{Device, Distribution, Tensor};
use freerange_flow::{
    config::{Stage, TrainConfig},
    trainer::Trainer,
};

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let path = arguments.get(1).map_or("configs/tiny.toml", String::as_str);
    let steps: u64 = arguments.get(2).map_or(20, |s| s.parse().expect("a number of steps"));
    println!("machine: {}", machine());
    println!("commit: {}", output("git", &["describe", "--always", "--dirty"]));
    println!("command: {}", arguments.join(" "));
    println!("| stage | samples/step | s/step | steps/s | waiting for data | matrix products alone | their share |");
    println!("|---|---|---|---|---|---|---|");
    let config = TrainConfig::load(path.as_ref()).expect("a valid configuration");
    for stage in &config.stages {
        let mut one = config.clone();
        one.stages = vec![Stage { steps: u64::MAX / 2, ..stage.clone() }];
        one.data.statistics_objects = 8;
        one.data.window = 16;
        let folder = tempfile::tempdir().expect("a temporary folder");
        let device = Device::flex();
        let mut trainer = Trainer::open(one, folder.path(), None, &device, |_| {}).expect("a run");
        for _ in 0..3 {
            trainer.step().expect("a warm-up step");
        }
        let (mut seconds, mut data, mut products) = (0.0, 0.0, 0.0);
        // Interleaved, so that both see the same load of the machine.
        for _ in 0..steps {
            let report = trainer.step().expect("a step");
            seconds += report.seconds;
            data += report.data_seconds;
            products += matrix_products(&config, stage, &device);
        }
        let n = steps as f64;
        println!(
            "| depth {}, {} px | {} | {:.3} | {:.2} | {:.3} s | {:.3} s | {:.0} % |",
            stage.depth,
            stage.image_size,
            stage.batch,
            seconds / n,
            n / seconds,
            data / n,
            products / n,
            100.0 * products / seconds
        );
    }
}

/// Seconds for the matrix products of one step: forward, and both gradients.
fn matrix_products(config: &TrainConfig, stage: &Stage, device: &Device) -> f64 {
    let m = &config.model;
    let (d, f, b) = (m.hidden, m.ffn_width(), stage.batch);
    let patches = (stage.image_size / m.encoder.patch_size()).pow(2) as usize;
    let image = patches * config.loss.input_views.1;
    let gaussian = (1usize << stage.depth) / m.gaussians_per_token;
    let tokens = m.registers + image + gaussian;
    let mut shapes = vec![
        // times, batch, rows, inner, columns
        (1, 1, b * image, m.image_token_width(), d),
        (1, 1, b * gaussian, m.gaussian_channels(), d),
        (1, 1, b * gaussian, d, m.gaussians_per_token * 14),
    ];
    let blocks = m.blocks;
    shapes.extend([
        (blocks, 1, b, d, 6 * d),
        (blocks, 1, b * tokens, d, 3 * d),
        (blocks, b * m.heads, tokens, d / m.heads, tokens),
        (blocks, b * m.heads, tokens, tokens, d / m.heads),
        (blocks, 1, b * tokens, d, d),
        (blocks, 1, b * tokens, d, 2 * f),
        (blocks, 1, b * tokens, f, d),
    ]);
    let mut seconds = 0.0;
    for (times, batch, rows, inner, columns) in shapes {
        let random = |a, b| Tensor::<3>::random([batch, a, b], Distribution::Default, device);
        let (x, w, y) = (random(rows, inner), random(inner, columns), random(rows, columns));
        let begin = Instant::now();
        for _ in 0..times {
            let forward = x.clone().matmul(w.clone());
            let to_input = y.clone().matmul(w.clone().swap_dims(1, 2));
            let to_weight = x.clone().swap_dims(1, 2).matmul(y.clone());
            // Reading one value waits for the product on any device.
            for t in [forward, to_input, to_weight] {
                let _: f32 = t.slice([0..1, 0..1, 0..1]).into_scalar();
            }
        }
        seconds += begin.elapsed().as_secs_f64();
    }
    seconds
}

fn machine() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = text.lines().find_map(|l| l.strip_prefix("model name")).unwrap_or("unknown processor");
    format!(
        "{}, {} cores",
        model.trim_start_matches([' ', '\t', ':']),
        std::thread::available_parallelism().map_or(0, usize::from)
    )
}

fn output(program: &str, arguments: &[&str]) -> String {
    let out = Command::new(program).args(arguments).output();
    out.map_or_else(|e| e.to_string(), |o| String::from_utf8_lossy(&o.stdout).trim().to_owned())
}
