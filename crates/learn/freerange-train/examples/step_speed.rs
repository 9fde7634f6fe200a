//! How fast training steps are, and what else they take of the machine.
//!
//! `cargo run --release -p freerange-train --example step_speed -- configs/tiny.toml [steps per stage]`

use std::process::Command;

use burn::tensor::Device;
use freerange_train::{
    config::{self, Stage},
    trainer::Trainer,
};

fn main() {
    freerange_model::keep_freed_memory();
    let arguments: Vec<String> = std::env::args().collect();
    let path = arguments.get(1).map_or("configs/tiny.toml", String::as_str);
    let steps: u64 = arguments.get(2).map_or(20, |s| s.parse().expect("a number of steps"));
    println!("machine: {}", machine());
    println!("commit: {}", output("git", &["describe", "--always", "--dirty"]));
    println!("command: {}", arguments.join(" "));
    println!(
        "| stage | samples/step | s/step | steps/s | waiting for data | CPU s/step | of which system | page faults/step |"
    );
    println!("|---|---|---|---|---|---|---|---|");
    let config =
        config::TrainConfig::<freerange_data::build::MakingConfig>::load(path.as_ref()).expect("a valid configuration");
    for stage in &config.stages {
        let mut one = config.clone();
        one.stages = vec![Stage { steps: u64::MAX / 2, ..stage.clone() }];
        // Objects made on the fly, without fits to refine: a step takes as long.
        (one.data.shards, one.loss.refinement) = (None, None);
        one.data.statistics_objects = 8;
        one.data.window = 16;
        let folder = tempfile::tempdir().expect("a temporary folder");
        let device = Device::flex();
        let mut trainer = Trainer::open(one, folder.path(), None, &device, |_| {}).expect("a run");
        for _ in 0..3 {
            trainer.step().expect("a warm-up step");
        }
        let (mut seconds, mut data) = (0.0, 0.0);
        let begin = usage();
        for _ in 0..steps {
            let report = trainer.step().expect("a step");
            seconds += report.seconds;
            data += report.data_seconds;
        }
        let n = steps as f64;
        let [user, system, faults] = std::array::from_fn(|i| (usage()[i] - begin[i]) / n);
        println!(
            "| depth {}, {} px | {} | {:.3} | {:.2} | {:.3} s | {:.3} | {:.3} | {faults:.0} |",
            stage.depth,
            stage.image_size,
            stage.batch,
            seconds / n,
            n / seconds,
            data / n,
            user + system,
            system,
        );
    }
}

/// Seconds of user and of system time that this process has taken with all its threads, and its minor page faults.
#[cfg(unix)]
fn usage() -> [f64; 3] {
    // SAFETY: plain numbers, of which zeros are valid.
    let mut usage: libc::rusage = unsafe { std::mem::zeroed() };
    // SAFETY: `usage` is ours to be written.
    unsafe { libc::getrusage(libc::RUSAGE_SELF, &raw mut usage) };
    let seconds = |t: libc::timeval| t.tv_sec as f64 + t.tv_usec as f64 * 1e-6;
    [seconds(usage.ru_utime), seconds(usage.ru_stime), usage.ru_minflt as f64]
}

/// Unknown.
#[cfg(not(unix))]
fn usage() -> [f64; 3] {
    [f64::NAN; 3]
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
