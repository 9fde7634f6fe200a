//! `freerange train` is killed again and again, and asked to end, and nothing comes of it.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    thread,
    time::{Duration, Instant},
};

/// The smallest model, with objects that come and go and threads that make them.
const CONFIG: &str = r#"
seed = 5
model = { image_size = 16, hidden = 16, blocks = 1, heads = 2, registers = 2, gaussians_per_token = 4, time_features = 8, encoder = { kind = "patch", patch_size = 8, channels = 4 } }
loss = { held_views = 1, input_views = [2, 2], render_size = 16, gradient_size = 16 }
validation = { every = 5, objects = 1 }
stage = [
    { depth = 3, image_size = 16, batch = 2, steps = 30 },
    { depth = 4, image_size = 16, batch = 3, micro_batch = 2, steps = 60 },
]

[sample]
steps = 1
cfg_scale = 1.0
gradient_size = 16

[data]
window = 5
fresh = 2
workers = 2
statistics_objects = 2

[data.object]
views = 4
samples_per_axis = 1

[data.object.cameras]
resolution = 16

[data.object.surface]
points = 64
"#;

/// Steps between states, and steps in all.
const SAVE_EVERY: u64 = 4;
const STEPS: u64 = 90;
const KILLS: u64 = 10;

fn train(config: &Path, run: &Path, save_every: u64) -> Child {
    Command::new(env!("CARGO_BIN_EXE_freerange"))
        .args(["train".as_ref(), config.as_os_str(), "-o".as_ref(), run.as_os_str()])
        .args(["--save-every", &save_every.to_string()])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap()
}

/// The step of the latest state in a run's folder.
fn saved(run: &Path) -> u64 {
    let names = fs::read_dir(run).into_iter().flatten().flatten().map(|e| e.file_name());
    names.filter_map(|n| n.to_str()?.strip_prefix("state-")?.parse().ok()).max().unwrap_or(0)
}

/// What a run has learned and said: weights, and the log without times.
fn outcome(run: &Path) -> (Vec<u8>, Vec<u8>, Vec<serde_json::Value>) {
    // The header has the time that training took.
    let weights = |name: &str| {
        let bytes = fs::read(run.join(name)).unwrap();
        let header = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        bytes[8 + header..].to_vec()
    };
    let log = fs::read_to_string(run.join("log.jsonl")).unwrap();
    let lines = log.lines().map(|line| {
        let mut line: serde_json::Value = serde_json::from_str(line).unwrap();
        let fields = line.as_object_mut().unwrap();
        ["seconds", "data_seconds"].iter().for_each(|field| drop(fields.remove(*field)));
        line
    });
    (weights("checkpoint.safetensors"), weights("best.safetensors"), lines.collect())
}

/// Waits until a run has saved this step.
fn wait_for(run: &Path, step: u64) {
    let begin = Instant::now();
    while saved(run) < step {
        assert!(begin.elapsed() < Duration::from_secs(300), "it makes no progress");
        thread::sleep(Duration::from_millis(1));
    }
}

#[cfg(unix)]
fn ask_to_end(child: &Child) {
    let asked = Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap();
    assert!(asked.success());
}

/// A measurement takes as long as anything; nobody who is asked to end waits for it. Meanwhile nobody else trains there.
#[cfg(unix)]
#[test]
fn asked_to_end_while_it_measures_it_ends_with_its_state() {
    let place = tempfile::tempdir().unwrap();
    let (config, run) = (place.path().join("train.toml"), place.path().join("run"));
    let long =
        CONFIG.replace("every = 5, objects = 1", "every = 2, objects = 1").replace("steps = 1\n", "steps = 10000\n");
    assert!(long.contains("steps = 10000\n"));
    fs::write(&config, long).unwrap();
    let mut child = train(&config, &run, 1);
    wait_for(&run, 1);
    thread::sleep(Duration::from_millis(500));
    assert!(child.try_wait().unwrap().is_none() && saved(&run) == 1, "it does not measure after step 2");

    let second = Command::new(env!("CARGO_BIN_EXE_freerange"))
        .args(["train".as_ref(), config.as_os_str(), "-o".as_ref(), run.as_os_str()])
        .output()
        .unwrap();
    let error = String::from_utf8_lossy(&second.stderr);
    assert!(second.status.code() == Some(2) && error.contains("another process trains in it"), "{error}");
    assert_eq!(saved(&run), 1);

    ask_to_end(&child);
    let begin = Instant::now();
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert!(begin.elapsed() < Duration::from_secs(10), "it took {:?} to end", begin.elapsed());
    assert_eq!(saved(&run), 2);
    // The measurement is still due.
    let mut child = train(&config, &run, 1);
    thread::sleep(Duration::from_millis(1000));
    assert!(child.try_wait().unwrap().is_none() && saved(&run) == 2);
    child.kill().unwrap();
    child.wait().unwrap();
}

#[test]
fn a_measurement_that_fails_loses_no_step() {
    let place = tempfile::tempdir().unwrap();
    let path = |name: &str| -> PathBuf { place.path().join(name) };
    fs::write(path("config.toml"), CONFIG.replace("steps = 60", "steps = 10")).unwrap();
    assert!(train(&path("config.toml"), &path("whole"), 100).wait().unwrap().success());
    let in_the_way = path("run/best.safetensors");
    fs::create_dir_all(in_the_way.join("something")).unwrap();
    for _ in 0..2 {
        assert_eq!(train(&path("config.toml"), &path("run"), 100).wait().unwrap().code(), Some(2));
        assert_eq!(saved(&path("run")), 5);
    }
    fs::remove_dir_all(&in_the_way).unwrap();
    assert!(train(&path("config.toml"), &path("run"), 100).wait().unwrap().success());
    let (expected, found) = (outcome(&path("whole")), outcome(&path("run")));
    assert!(expected.0 == found.0 && expected.1 == found.1, "other weights");
    assert_eq!(expected.2, found.2);
}

#[test]
fn sums_between_cards_are_refused_where_they_cannot_be_made() {
    let place = tempfile::tempdir().unwrap();
    let (config, run) = (place.path().join("train.toml"), place.path().join("run"));
    fs::write(&config, CONFIG).unwrap();
    let done = Command::new(env!("CARGO_BIN_EXE_freerange"))
        .args(["train".as_ref(), config.as_os_str(), "-o".as_ref(), run.as_os_str()])
        .args(["--sums", "nccl", "--device", "cpu"])
        .output()
        .unwrap();
    let error = String::from_utf8_lossy(&done.stderr);
    let expected = if cfg!(feature = "nccl") {
        "expected a CUDA device"
    } else {
        "expected a program built with `--features nccl`"
    };
    assert!(done.status.code() == Some(2) && error.contains(expected), "{error}");
    assert!(!run.exists());
}

#[test]
fn killed_at_ten_points_it_learns_what_it_would_have() {
    killed_at_ten_points(CONFIG);
}

#[test]
fn killed_at_ten_points_models_of_one_pass_learn_what_they_would_have() {
    for (kind, depth) in [
        ("kind = \"latent_tokens\", latent_tokens = 4, gaussians_per_token = 4", 4),
        ("kind = \"pixel_aligned\"", 3),
        (
            "kind = \"voxel_aligned\", volume = { tokens_per_side = 2, cells_per_token_side = 1, gaussians_per_cell = 2 }",
            3,
        ),
    ] {
        let model = format!("model = {{ {kind}, gradient_channels = false, image_size");
        let config = CONFIG
            .replace("model = { image_size", &model)
            .replace("gaussians_per_token = 4, time_features = 8, ", "")
            .replace("loss = { ", "loss = { flow = false, unconditional = 0.0, ")
            .replace("gradient_size = 16\n", "lambda_pg = 0.0\n")
            .replace("{ depth = 3,", &format!("{{ depth = {depth},"));
        killed_at_ten_points(&config);
    }
}

fn killed_at_ten_points(config: &str) {
    let place = tempfile::tempdir().unwrap();
    let path = |name: &str| -> PathBuf { place.path().join(name) };
    fs::write(path("config.toml"), config).unwrap();
    assert!(train(&path("config.toml"), &path("whole"), SAVE_EVERY).wait().unwrap().success());
    assert_eq!(saved(&path("whole")), STEPS);

    let run = path("killed");
    for kill in 1..=KILLS {
        let mut child = train(&path("config.toml"), &run, SAVE_EVERY);
        let begin = Instant::now();
        // After another state, and then at once, or while it steps or writes the next.
        while saved(&run) < kill * SAVE_EVERY {
            assert!(child.try_wait().unwrap().is_none(), "it ended before it was killed");
            assert!(begin.elapsed() < Duration::from_secs(300), "it makes no progress");
            thread::sleep(Duration::from_millis(1));
        }
        thread::sleep(Duration::from_millis(3 * (kill - 1)));
        child.kill().unwrap();
        assert!(!child.wait().unwrap().success());
    }
    let reached = saved(&run);
    assert!((KILLS * SAVE_EVERY..STEPS).contains(&reached), "killed for the last time at step {reached}");
    assert!(train(&path("config.toml"), &run, SAVE_EVERY).wait().unwrap().success());
    let (expected, found) = (outcome(&path("whole")), outcome(&run));
    assert!(expected.0 == found.0 && expected.1 == found.1, "other weights");
    assert_eq!(expected.2, found.2);
    assert_eq!(found.2.len() as u64, STEPS + STEPS / 5);

    #[cfg(unix)]
    {
        let run = path("asked");
        let mut child = train(&path("config.toml"), &run, 1);
        wait_for(&run, 3);
        ask_to_end(&child);
        assert_eq!(child.wait().unwrap().code(), Some(130));
        assert!((3..STEPS).contains(&saved(&run)), "asked to end, it saved step {}", saved(&run));
        assert!(train(&path("config.toml"), &run, STEPS).wait().unwrap().success());
        let found = outcome(&run);
        assert!(expected.0 == found.0 && expected.1 == found.1, "other weights after it was asked to end");
        assert_eq!(expected.2, found.2);
    }
}
