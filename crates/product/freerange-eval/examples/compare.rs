//! The metrics of two pictures of one size, the second the true one:
//! `cargo run --release -p freerange-eval --features networks --example compare -- WEIGHTS A.png B.png`.
//! Networks are read from the folder WEIGHTS; metrics without theirs are named, with what is missing.

use std::{error::Error, path::PathBuf};

use freerange_eval::metrics::{Evaluator, EvaluatorConfig, Metric, Pair, weights::Weights};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let [weights, first, second] = &args[..] else {
        return Err("expected WEIGHTS A.png B.png".into());
    };
    let (render, truth) = (image::open(first)?.to_rgb32f(), image::open(second)?.to_rgb32f());
    let config = EvaluatorConfig {
        metrics: Metric::ALL.into_iter().filter(|metric| metric.is_per_pair()).collect(),
        ..EvaluatorConfig::default()
    };
    let (evaluator, missing) = Evaluator::open(&config, &Weights::new([weights.clone()]), &Default::default())?;
    let pair = Pair { render: render.as_raw(), truth: truth.as_raw() };
    let (width, height) = (render.width() as usize, render.height() as usize);
    for (metric, value) in &evaluator.score(&[pair], width, height)?[0].values {
        println!("{:16} {value:.6}", metric.label());
    }
    for metric in missing {
        println!("{:16} {}", metric.metric.label(), metric.reason);
    }
    for file in evaluator.used_files() {
        println!("{} {}", file.sha256, file.file);
    }
    Ok(())
}
