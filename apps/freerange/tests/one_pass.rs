//! Models that predict in one pass are trained, asked and measured by the same commands as the flow's.

use std::{
    path::{Path, PathBuf},
    process::{Command, Output},
};

const CONFIG: &str = r#"
seed = 5
model = { kind = "pixel_aligned", gradient_channels = false, image_size = 16, hidden = 16, blocks = 1, heads = 2, registers = 2, encoder = { kind = "patch", patch_size = 8, channels = 4 } }
loss = { flow = false, unconditional = 0.0, held_views = 1, input_views = [2, 2], render_size = 16 }
stage = [{ depth = 3, image_size = 16, batch = 2, steps = 2 }]
sample = { steps = 1, cfg_scale = 1.0, lambda_pg = 0.0 }

[data]
window = 2
fresh = 0
workers = 1
statistics_objects = 1

[data.object]
views = 4
samples_per_axis = 1

[data.object.cameras]
resolution = 16

[data.object.surface]
points = 64
"#;

fn freerange(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_freerange")).args(args).output().unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// A checkpoint of two training steps in `place`, in the folder `run`.
fn trained(place: &Path, run: &str) -> PathBuf {
    std::fs::write(place.join("model.toml"), CONFIG).unwrap();
    let run = place.join(run);
    let trained = freerange(&["train", text(&place.join("model.toml")), "-o", text(&run)]);
    assert!(trained.status.success(), "{}", String::from_utf8_lossy(&trained.stderr));
    run.join("checkpoint.safetensors")
}

#[test]
fn a_pixel_aligned_model_goes_through_every_command() {
    let place = tempfile::tempdir().unwrap();
    let path = |name: &str| -> PathBuf { place.path().join(name) };
    let checkpoint = trained(place.path(), "run");
    let dry = freerange(&["train", text(&path("model.toml")), "--dry-run"]);
    let said = String::from_utf8_lossy(&dry.stdout).into_owned();
    assert!(dry.status.success() && said.contains("512 Gaussians: 10 tokens each"), "{said}"); // two views of 16 x 16

    let info = freerange(&["model", "info", text(&checkpoint), "--json"]);
    let info: serde_json::Value = serde_json::from_slice(&info.stdout).unwrap();
    assert_eq!((&info["kind"], &info["samples"]), (&"pixel_aligned".into(), &4.0.into()));

    let scene = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/bowl");
    let out = path("out");
    let reconstruct = ["reconstruct", scene, "--checkpoint", text(&checkpoint), "--device", "cpu", "-o", text(&out)];
    let with = |more: &[&str]| freerange(&[&reconstruct[..], more].concat());
    let made = with(&["--iterations", "3", "--set", "propose.flow.coupling=independent"]); // the model's own
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let report: serde_json::Value = serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap();
    assert!(report["gaussians"].as_u64().unwrap() >= 2 * 16 * 16, "two views, one Gaussian per pixel: {report}");

    let evaluation = path("rows/full/bowl");
    let eval = ["eval", "--generated", "1", "--checkpoint", text(&checkpoint), "--device", "cpu"];
    let eval = [&eval[..], &["--metrics", "psnr", "--pictures", "none", "-o", text(&evaluation)]].concat();
    let eval = freerange(&eval);
    assert!(eval.status.success(), "{}", String::from_utf8_lossy(&eval.stderr));
    let tables = freerange(&["eval", "paper-tables", text(&path("rows"))]);
    let said = String::from_utf8_lossy(&tables.stdout).into_owned();
    assert!(said.contains("| Full |") && said.contains("Not measured yet: Full, another seed;"), "{said}");
    let nothing = freerange(&["eval", "paper-tables", text(&path("run"))]);
    assert_eq!(nothing.status.code(), Some(2), "{}", String::from_utf8_lossy(&nothing.stderr));
}

#[test]
fn settings_without_effect_on_one_pass_are_refused() {
    let place = tempfile::tempdir().unwrap();
    let checkpoint = trained(place.path(), "run");
    let out = place.path().join("out");
    let scene = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/bowl");
    let reconstruct = ["reconstruct", scene, "--checkpoint", text(&checkpoint), "--device", "cpu", "-o", text(&out)];
    let with = |more: &[&str]| freerange(&[&reconstruct[..], more].concat());
    for (option, field) in [
        (["--set", "propose.flow.steps=20"], "propose.flow.steps"),
        (["--set", "propose.flow.cfg_scale=2"], "propose.flow.cfg_scale"),
        (["--set", "propose.flow.lambda_pg=1"], "propose.flow.lambda_pg"),
        (["--set", "propose.flow.lod_depth=8"], "propose.flow.lod_depth"),
        (["--set", "propose.flow.gradient_at=estimate"], "propose.flow.gradient_at"),
        (["--set", "propose.flow.gradient_size=64"], "propose.flow.gradient_size"),
        (["--set", "propose.flow.background=white"], "propose.flow.background"),
        (["--set", "propose.flow.coupling=tree"], "propose.flow.coupling"),
        (["--samples", "2"], "seeds"),
    ] {
        let refused = with(&option);
        let error = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert_eq!(refused.status.code(), Some(2), "{option:?}: {error}");
        assert!(error.contains(field) && error.contains("pixel_aligned"), "{option:?}: {error}");
        assert!(!out.exists());
    }
    for option in [["--init", "fit"], ["--quality", "high"], ["--set", "propose.count=2"]] {
        let refused = with(&option);
        assert_eq!(refused.status.code(), Some(2), "{option:?}: {}", String::from_utf8_lossy(&refused.stderr));
    }
}

#[test]
fn the_picture_beside_the_tables_shows_the_rows_that_were_trained() {
    let place = tempfile::tempdir().unwrap();
    let path = |name: &str| -> PathBuf { place.path().join(name) };
    let checkpoint = trained(place.path(), "runs/pixel_aligned");
    let (rows, runs, picture) = (path("rows"), path("runs"), path("picture.png"));
    let source = ["--generated", "1", "--generated-size", "32"];
    let row = path("rows/full/generated");
    let eval = ["eval", "--checkpoint", text(&checkpoint), "--device", "cpu", "--metrics", "psnr", "-o", text(&row)];
    let eval = freerange(&[&eval[..], &source].concat());
    assert!(eval.status.success(), "{}", String::from_utf8_lossy(&eval.stderr));

    let tables = ["eval", "paper-tables", text(&rows), "--picture", text(&picture), "--runs", text(&runs)];
    let with = |more: &[&str]| freerange(&[&tables[..], &source, more].concat());
    let made = with(&[]);
    let error = String::from_utf8_lossy(&made.stderr).into_owned();
    assert!(made.status.success() && error.contains("no_flow_matching: not in the image"), "{error}");
    let found = image::open(&picture).unwrap().to_rgb8();
    // Inputs, true view and the one row; below them nothing, nothing and the row's Gaussians.
    assert_eq!(found.dimensions(), (3 * 32, 2 * 32));
    let ink = |x: u32, y: u32| {
        let part = image::imageops::crop_imm(&found, x * 32, y * 32, 32, 32).to_image();
        part.pixels().filter(|p| p.0 != [255; 3]).count()
    };
    assert!(ink(0, 0) > 0 && ink(1, 0) > 0, "{} {}", ink(0, 0), ink(1, 0));
    assert_eq!((ink(0, 1), ink(1, 1)), (0, 0));

    let refused = with(&["--objects", "nothing"]);
    let error = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(refused.status.code() == Some(2) && error.contains("--objects: expected names among"), "{error}");
}
