//! A frozen encoder with outside weights, through the real binary: train, stop, go on, reconstruct, evaluate.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

const CONFIG: &str = r#"
seed = 5

[model]
image_size = 28
hidden = 32
blocks = 1
heads = 2
registers = 2
gaussians_per_token = 4
time_features = 8

[model.encoder]
kind = "dinov2"
hidden = 48
layers = 3
heads = 4
patch_size = 14
image_size = 56
WEIGHTS

[data]
window = 2
fresh = 1
statistics_objects = 2

[data.object]
views = 4
samples_per_axis = 1

[data.object.cameras]
resolution = 28

[data.object.surface]
points = 256

[loss]
held_views = 0
held = false
input_views = [2, 2]
render_size = 28
gradient_size = 28

[[stage]]
depth = 6
image_size = 28
batch = 2
steps = 3

[validation]
every = 2
objects = 1

[sample]
steps = 2
gradient_size = 28
"#;

fn root() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
}

/// A folder with the encoder `encoder`, `other` of the same architecture, and configurations.
struct RunFolder {
    folder: tempfile::TempDir,
}

impl RunFolder {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let golden = root().join("tests/golden/dino/mlp_img56");
        for name in ["encoder", "other"] {
            let to = folder.path().join(name);
            fs::create_dir(&to).unwrap();
            for file in ["config.json", "model.safetensors"] {
                fs::copy(golden.join(file), to.join(file)).unwrap();
            }
        }
        let weights = folder.path().join("other/model.safetensors");
        let mut bytes = fs::read(&weights).unwrap();
        let end = bytes.len();
        bytes[end - 4..].copy_from_slice(&0.5f32.to_le_bytes());
        fs::write(weights, bytes).unwrap();
        Self { folder }
    }

    fn path(&self, name: &str) -> String {
        self.folder.path().join(name).to_str().unwrap().to_owned()
    }

    fn config(&self, name: &str, weights: &str) -> String {
        fs::write(self.path(name), CONFIG.replace("WEIGHTS", weights)).unwrap();
        self.path(name)
    }

    /// Runs the program with `cache` as the cache folder and expects this exit code; all that it says.
    fn run(&self, code: i32, arguments: &[&str]) -> String {
        let done = Command::new(env!("CARGO_BIN_EXE_freerange"))
            .args(arguments)
            .env("XDG_CACHE_HOME", self.path("cache"))
            .env("HOME", self.path("home"))
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&done.stderr).into_owned() + &String::from_utf8_lossy(&done.stdout);
        assert_eq!(done.status.code(), Some(code), "{arguments:?}: {text}");
        text
    }

    /// The same, of which every one of `words` must be said.
    fn says(&self, code: i32, arguments: &[&str], words: &[&str]) {
        let text = self.run(code, arguments);
        words.iter().for_each(|word| assert!(text.contains(word), "expected {word:?} in: {text}"));
    }

    fn reconstruct(&self, checkpoint: &str, output: &str, extra: &[&str]) -> Vec<u8> {
        let (scene, output) = (example(), self.path(output));
        let arguments =
            ["reconstruct", &scene, "-o", &output, "--checkpoint", checkpoint, "--set", "propose.flow.lambda_pg=0"];
        self.run(0, &[&arguments[..], extra].concat());
        fs::read(Path::new(&output).join("gaussians.ply")).unwrap()
    }

    fn refused(&self, checkpoint: &str, extra: &[&str], words: &[&str]) {
        let (scene, output) = (example(), self.path("nothing"));
        let arguments = ["reconstruct", &scene, "-o", &output, "--checkpoint", checkpoint];
        self.says(2, &[&arguments[..], extra].concat(), words);
        assert!(!Path::new(&output).exists());
    }

    /// Training on from a checkpoint with other encoder weights.
    fn refused_training(&self, arguments: &[&str], sha: &str) {
        let mut arguments = arguments.to_vec();
        let output = self.path("never");
        let at = arguments.iter().position(|a| *a == "-o").unwrap() + 1;
        arguments[at] = &output;
        self.says(2, &arguments, &["sha256", sha]);
        assert!(!Path::new(&output).exists());
    }
}

fn example() -> String {
    root().join("examples/bowl").to_str().unwrap().to_owned()
}

/// The tensors of a checkpoint, without what its header says of time.
fn tensors(run: &str) -> Vec<u8> {
    let bytes = fs::read(Path::new(run).join("checkpoint.safetensors")).unwrap();
    let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    bytes[8 + length..].to_vec()
}

fn sha256(encoder: &str) -> String {
    let encoder = freerange_model::Dinov2::load(Path::new(encoder), &burn::tensor::Device::flex()).unwrap();
    encoder.origin().unwrap().sha256.clone()
}

#[test]
fn a_model_with_an_outside_encoder_goes_the_whole_road() {
    let place = RunFolder::new();
    let config = place.config("config.toml", "weights = \"encoder\"");
    let (whole, halves) = (place.path("whole"), place.path("halves"));
    let sha = sha256(&place.path("encoder"));

    // Trained at once, and stopped after each step.
    place.says(0, &["train", &config, "-o", &whole], &["encoder weights", &sha, "validation after 2"]);
    for _ in 0..3 {
        place.run(0, &["train", &config, "-o", &halves, "--minutes", "0"]);
    }
    assert!(tensors(&whole) == tensors(&halves), "a run that was stopped is the one that was not");
    place.says(
        2,
        &["train", &config, "-o", &halves, "--encoder-weights", &place.path("other")],
        &["model.encoder.weights", &sha],
    );
    // The frozen weights are in none of its files.
    let frozen = fs::metadata(place.path("encoder/model.safetensors")).unwrap().len();
    for entry in fs::read_dir(Path::new(&whole).join("state-000000003")).unwrap() {
        let entry = entry.unwrap();
        assert!(entry.metadata().unwrap().len() < frozen, "{:?}", entry.path());
    }

    // Found again where it was, where the user says, nowhere; and no other.
    let checkpoint = Path::new(&whole).join("checkpoint.safetensors").to_str().unwrap().to_owned();
    let expected = place.reconstruct(&checkpoint, "out", &[]);
    place.says(0, &["model", "info", &checkpoint], &[&sha, &place.path("encoder"), "found in"]);
    place.says(0, &["model", "info", &checkpoint, "--json"], &["\"encoder_weights\"", &sha, &place.path("encoder")]);
    fs::rename(place.path("encoder"), place.path("moved")).unwrap();
    place.refused(&checkpoint, &[], &[&place.path("encoder"), "config.json", "--encoder-weights"]);
    place.says(0, &["model", "info", &checkpoint], &[&sha, "not found"]);
    let moved = ["--encoder-weights", &place.path("moved")];
    assert!(place.reconstruct(&checkpoint, "out2", &moved) == expected);
    let other = place.path("other");
    place.refused(&checkpoint, &["--encoder-weights", &other], &[&other, &sha, "sha256"]);

    // Evaluated, shrunk, and gone on from.
    let eval = ["eval", "--generated", "1", "--generated-size", "32", "--views", "full", "--metrics", "psnr", "--json"];
    place.says(0, &[&eval[..], &["--checkpoint", &checkpoint], &moved].concat(), &["\"psnr\""]);
    place.run(0, &[&["model", "shrink", &checkpoint, &place.path("small.safetensors")][..], &moved].concat());
    place.reconstruct(&place.path("small.safetensors"), "out3", &moved);
    let next = ["train", &config, "-o", &place.path("next"), "--initial", &checkpoint, "--minutes", "0"];
    place.run(0, &[&next[..], &moved].concat());
    place.refused_training(&[&next[..], &["--encoder-weights", &other]].concat(), &sha);
}

#[test]
fn the_hubs_weights_are_those_in_the_cache() {
    let place = RunFolder::new();
    let config = place.config("config.toml", "weights = \"hf:someone/tiny-encoder\"");
    let run = place.path("run");
    place.says(
        2,
        &["train", &config, "-o", &run],
        &["hf:someone/tiny-encoder", "cache/freerange/weights/tiny-encoder"],
    );
    assert!(!Path::new(&run).exists(), "nothing is written for a run that cannot start");
    fs::create_dir_all(place.path("cache/freerange/weights")).unwrap();
    fs::rename(place.path("encoder"), place.path("cache/freerange/weights/tiny-encoder")).unwrap();
    place.run(0, &["train", &config, "-o", &run, "--minutes", "0"]);
    let checkpoint = format!("{run}/checkpoint.safetensors");
    place.reconstruct(&checkpoint, "out", &[]);
    fs::rename(place.path("cache"), place.path("gone")).unwrap();
    place.refused(&checkpoint, &[], &["hf:someone/tiny-encoder", "weights fetch tiny-encoder"]);
}

#[test]
fn a_frozen_encoder_without_weights_is_for_dry_runs_alone() {
    let place = RunFolder::new();
    let run = place.path("run");
    let config = place.config("none.toml", "");
    place.says(2, &["train", &config, "-o", &run], &["model.encoder.weights", "random = true"]);
    assert!(!Path::new(&run).exists());
    let config = place.config("both.toml", "weights = \"encoder\"\nrandom = true");
    place.says(2, &["train", &config, "-o", &run], &["encoder.random"]);
    let config = place.config("random.toml", "random = true");
    place.says(0, &["train", &config, "-o", &run, "--minutes", "0"], &["WARNING", "random"]);
    place.says(0, &["train", &config, "-o", &run, "--minutes", "0"], &["continuing", "WARNING"]);
    place.refused(&format!("{run}/checkpoint.safetensors"), &[], &["dry run"]);
    let config = place.config("size.toml", "weights = \"encoder\"");
    fs::write(
        &config,
        fs::read_to_string(&config).unwrap().replace("image_size = 28\nbatch", "image_size = 32\nbatch"),
    )
    .unwrap();
    place.says(2, &["train", &config, "-o", &place.path("size")], &["stage.image_size", "14"]);
    let config = place.config("misfit.toml", "weights = \"encoder\"\nregisters = 4");
    place.says(2, &["train", &config, "-o", &place.path("misfit")], &["encoder", "architecture"]);
}
