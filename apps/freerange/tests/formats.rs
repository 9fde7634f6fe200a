//! File formats through the real binary.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

use freerange_gaussians::formats::{Frame, read};
use freerange_gaussians::{Gaussians, channel, write_ply};
use glam::DVec3;

fn freerange(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_freerange")).args(args).output().unwrap()
}

fn example() -> String {
    concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/bowl").to_owned()
}

/// Ten Gaussians on a curve without symmetry, as a file in a folder of its own.
fn object() -> (tempfile::TempDir, PathBuf, Gaussians) {
    let folder = tempfile::tempdir().unwrap();
    let mut cloud = Gaussians::default();
    for i in 0..10 {
        let t = i as f32 / 10.0;
        let mut row = [0.0; channel::COUNT];
        row[channel::MEAN].copy_from_slice(&[0.4 * t, 0.3 * t * t, 0.1 - 0.2 * t]);
        row[channel::LOG_SCALE].copy_from_slice(&[-4.0, -3.5, -3.0]);
        row[channel::ROTATION].copy_from_slice(&[0.8, 0.6, 0.0, 0.0]);
        row[channel::COLOR].copy_from_slice(&[t, 1.0 - t, 0.5]);
        cloud.push(&row);
    }
    let path = folder.path().join("object.ply");
    write_ply(&cloud, &path).unwrap();
    (folder, path, cloud)
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn convert_goes_to_every_format_and_back() {
    let (folder, source, cloud) = object();
    for extension in ["ply", "spz", "sog", "glb", "html"] {
        let (there, back) = (folder.path().join(format!("there.{extension}")), folder.path().join("back.ply"));
        for (from, to) in [(&source, &there), (&there, &back)] {
            let done = freerange(&["convert", text(from), text(to), "--frame", "y-down"]);
            assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
            assert!(String::from_utf8_lossy(&done.stdout).contains("10 Gaussians"));
        }
        let found = read(&back, Frame::Y_DOWN).unwrap().splats.cloud;
        assert_eq!(found.len(), 10, "{extension}");
        for i in 0..10 {
            // A .sog is in an order of its own.
            let same = |k: &usize| (found.mean(*k) - cloud.mean(i)).length() < 1e-4;
            let k = (0..10).find(same).unwrap_or_else(|| panic!("{extension}: Gaussian {i} is not there"));
            assert!(found.covariance(k).abs_diff_eq(cloud.covariance(i), 2e-4), "{extension}");
        }
    }
    // A page knows its up, as a .ply does.
    let (page, again) = (folder.path().join("there.html"), folder.path().join("again.spz"));
    assert!(freerange(&["convert", text(&page), text(&again)]).status.success());
    let found = read(&again, Frame::Y_DOWN).unwrap();
    assert!((0..10).all(|i| (found.splats.cloud.mean(i) - cloud.mean(i)).length() < 1e-4));
    // Our own .spz is read without a word.
    let done = freerange(&["convert", text(&again), text(&folder.path().join("back.ply"))]);
    assert!(done.status.success() && done.stderr.is_empty(), "{}", String::from_utf8_lossy(&done.stderr));
    // From a frame into another.
    let turned = folder.path().join("turned.ply");
    assert!(freerange(&["convert", text(&source), text(&turned), "--frame", "y-down:z-up"]).status.success());
    let found = read(&turned, Frame::Z_UP).unwrap().splats.cloud;
    let expected = |m: DVec3| DVec3::new(m.x, m.z, -m.y);
    assert!((0..10).all(|i| (found.mean(i) - expected(cloud.mean(i))).length() < 1e-6));
}

#[test]
fn what_cannot_be_converted_is_refused() {
    let (folder, source, _) = object();
    let output = folder.path().join("out.spz");
    let refused = |input: &Path, output: &Path, extra: &[&str], words: &[&str]| {
        let done = freerange(&[&["convert", text(input), text(output)], extra].concat());
        let message = String::from_utf8_lossy(&done.stderr).into_owned();
        assert_eq!(done.status.code(), Some(2), "{message}");
        words.iter().for_each(|w| assert!(message.contains(w), "expected {w:?} in: {message}"));
        assert!(!message.contains("panicked") && !output.exists());
    };
    refused(&source, &folder.path().join("out.fbx"), &[], &["out.fbx", ".spz", "found .fbx", "--mesh writes .glb"]);
    // One file, or none: what is missing is named as in the usage.
    for files in [&[text(&source)][..], &[]] {
        let done = freerange(&[&["convert"], files].concat());
        let message = String::from_utf8_lossy(&done.stderr).into_owned();
        assert!(done.status.code() == Some(2) && message.contains("<INPUT>... <OUTPUT>: expected files"), "{message}");
        let found = files.first().map_or("found none".into(), |file| format!("found {file} alone"));
        assert!(message.contains(&found), "{message}");
    }
    refused(&folder.path().join("missing.glb"), &output, &[], &["missing.glb", "No such file"]);
    refused(&source, &output, &["--frame", "x-up"], &["expected z-up, y-up or y-down"]);
    for extension in ["ply", "splat", "spz", "sog", "glb", "usda", "usdz", "html"] {
        let broken = folder.path().join(format!("broken.{extension}"));
        fs::write(&broken, "nothing of the kind").unwrap();
        refused(&broken, &output, &[], &[&format!("broken.{extension}"), "expected", "found"]);
    }
    let empty = folder.path().join("empty.splat");
    fs::write(&empty, "").unwrap();
    refused(&empty, &output, &[], &["at least one Gaussian"]);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 10);
}

#[test]
fn convert_merges_crops_cleans_and_scales() {
    let (folder, source, cloud) = object();
    let output = folder.path().join("out.ply");
    let run = |more: &[&str]| {
        let done = freerange(&[&["convert", text(&source), text(&source), text(&output)], more].concat());
        (
            done.status.code(),
            String::from_utf8_lossy(&done.stderr).into_owned(),
            read(&output, Frame::Z_UP).map(|l| l.splats.cloud),
        )
    };
    let (code, _, found) = run(&[]);
    assert_eq!((code, found.unwrap().len()), (Some(0), 20));
    let low = (0..10).map(|i| cloud.mean(i).x).fold(f64::INFINITY, f64::min);
    let (_, said, found) = run(&["--box", &format!("{},-9,-9:9,9,9", low + 1e-4)]);
    assert!(found.unwrap().len() < 20 && said.contains("are in the box"), "{said}");
    let (_, said, found) = run(&["--sphere", "0,0,0:100", "--measure", "0,0,-1:0,0,1=1"]);
    let found = found.unwrap();
    assert!(said.contains("20 of 20 Gaussians are in the sphere") && said.contains("scaled by 0.5"), "{said}");
    assert!((0..10).all(|i| (found.mean(i) - 0.5 * cloud.mean(i)).length() < 1e-6));
    for (option, value, words) in [
        ("--box", "1,2:3,4,5", "expected a point X,Y,Z"),
        ("--box", "5,5,5:6,6,6", "expected Gaussians in the box, found none of 20"),
        ("--sphere", "0,0,0:-1", "expected a length above 0"),
        ("--measure", "1,1,1:1,1,1=2", "expected two different points"),
        ("--voxels", "20", "--mesh"),
    ] {
        let (code, said, _) = run(&[option, value]);
        assert!(code == Some(2) && said.contains(words), "{option} {value}: {said}");
    }
}

#[test]
fn convert_makes_meshes() {
    let folder = tempfile::tempdir().unwrap();
    let bowl = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/formats/source.ply");
    for name in ["m.glb", "m.ply", "m.obj"] {
        let path = folder.path().join(name);
        let done = freerange(&["convert", text(&bowl), text(&path), "--mesh", "--voxels", "40"]);
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        assert!(String::from_utf8_lossy(&done.stdout).contains("triangles)") && path.metadata().unwrap().len() > 1000);
        let said = String::from_utf8_lossy(&done.stderr).into_owned();
        assert!(said.contains("meshing: takes some seconds") && !said.contains("--triangles"), "{said}");
    }
    let small = folder.path().join("small.glb");
    let run = |output: &Path, more: &[&str]| {
        let done = freerange(&[&["convert", text(&bowl), text(output), "--mesh", "--voxels", "40"], more].concat());
        let said = [done.stdout, done.stderr].map(|v| String::from_utf8_lossy(&v).into_owned()).concat();
        (done.status.code(), said)
    };
    let (code, said) = run(&small, &["--triangles", "300", "--texture", "256"]);
    assert!(code == Some(0) && said.contains("(300 triangles)"), "{said}");
    assert!(said.contains("meshing: takes a minute or more"), "{said}");
    for (name, more, words) in [
        ("m.spz", ["--triangles", "300"], "expected .glb, .ply or .obj, found .spz"),
        ("no.obj", ["--texture", "256"], "a texture: expected .glb, found .obj"),
        ("no.glb", ["--texture", "9999"], "texture: expected 64 to 4096 texels, found 9999"),
        ("no.glb", ["--triangles", "3"], "triangles: expected at least 4, found 3"),
        ("no.glb", ["--triangles", "many"], "invalid value 'many'"),
    ] {
        let (code, said) = run(&folder.path().join(name), &more);
        assert!(code == Some(2) && said.contains(words) && !folder.path().join(name).exists(), "{said}");
    }
}

#[test]
fn reconstruct_writes_the_formats_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("result");
    let scene = example();
    let done = freerange(&[
        "reconstruct",
        &scene,
        "-o",
        text(&output),
        "--set",
        "refine.passes=1",
        "--iterations",
        "0",
        "--symmetry",
        "off",
        "--format",
        "glb,spz,html,ply,mesh.glb,mesh.obj",
    ]);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let cloud = read(&output.join("gaussians.ply"), Frame::Z_UP).unwrap().splats.cloud;
    for name in ["gaussians.glb", "gaussians.spz", "view.html"] {
        let found = read(&output.join(name), Frame::Z_UP).unwrap().splats.cloud;
        let apart = (0..cloud.len()).map(|i| (found.mean(i) - cloud.mean(i)).length()).fold(0.0, f64::max);
        assert!(found.len() == cloud.len() && apart < 1e-4, "{name}: {apart}");
    }
    // A mesh, in two formats.
    let limits = freerange_assets::mesh::LoadLimits::default();
    let meshes = ["mesh.glb", "mesh.obj"]
        .map(|name| freerange_assets::mesh::load_mesh(&output.join(name), &limits).unwrap().mesh);
    assert!(meshes[0].triangles.len() > 1000 && meshes[0].triangles.len() == meshes[1].triangles.len());
    assert!(!meshes[0].colors.is_empty());
    // All formats can be rendered.
    let renders = folder.path().join("renders");
    let cameras = format!("{scene}/transforms_test.json");
    let done = freerange(&["render", text(&output.join("gaussians.glb")), "--cameras", &cameras, "-o", text(&renders)]);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    assert!(fs::read_dir(renders).unwrap().count() > 1);
    let done = freerange(&["reconstruct", &scene, "-o", text(&output), "--format", "fbx"]);
    assert_eq!(done.status.code(), Some(2));
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    for expected in ["expected one of ply, splat, spz, sog, glb, usda, usdz, html", "mesh.glb, mesh.ply, mesh.obj"] {
        assert!(said.contains(expected), "{said}");
    }
}

#[test]
fn a_model_is_exported_with_its_card() {
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("model");
    let done = freerange(&["model", "export", text(&model)]);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let card = fs::read_to_string(model.join("README.md")).unwrap();
    let head = card.strip_prefix("---\n").unwrap().split_once("\n---\n").unwrap().0;
    for line in ["license:\n- mit\n- apache-2.0", "library_name: freerange", "pipeline_tag: image-to-3d"] {
        assert!(head.contains(line), "{head}");
    }
    assert!(card.contains("19,811,000 parameters") && card.contains("2048 3D Gaussians"));
    let config: serde_json::Value = serde_json::from_slice(&fs::read(model.join("config.json")).unwrap()).unwrap();
    assert_eq!((&config["model_type"], &config["gaussians"]), (&"free-range".into(), &2048.into()));
    // The weights are those of the checkpoint, and exporting them again says where they came from.
    let weights = model.join("model.safetensors");
    let again = folder.path().join("again");
    let done = freerange(&["model", "export", text(&again), "--checkpoint", text(&weights)]);
    assert_eq!(done.status.code(), Some(2), "a license is not ours to choose");
    let license = ["--license", "cc-by-4.0"];
    let args = [&["model", "export", text(&again), "--checkpoint", text(&weights)], &license[..]].concat();
    assert!(freerange(&args).status.success());
    assert_eq!(fs::read(&weights).unwrap(), fs::read(again.join("model.safetensors")).unwrap());
    assert!(fs::read_to_string(again.join("README.md")).unwrap().contains("license:\n- cc-by-4.0\n"));
    let args =
        [&["model", "export", text(&again), "--checkpoint", text(&weights)], &["--license", "a\nb"][..]].concat();
    assert_eq!(freerange(&args).status.code(), Some(2));
    fs::write(&weights, b"no weights").unwrap();
    let other = folder.path().join("other");
    let args = [&["model", "export", text(&other), "--checkpoint", text(&weights)], &license[..]].concat();
    let done = freerange(&args);
    assert!(done.status.code() == Some(2) && !other.exists());
    assert!(String::from_utf8_lossy(&done.stderr).contains("model.safetensors"));
}

#[test]
fn a_model_on_the_hub_is_taken_from_the_cache() {
    let cache = tempfile::tempdir().unwrap();
    let run = |args: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_freerange"));
        command
            .args(args)
            .env("XDG_CACHE_HOME", cache.path())
            .env("HOME", cache.path())
            .env("LOCALAPPDATA", cache.path());
        command.output().unwrap()
    };
    let refused = |name: &str, words: &[&str]| {
        let done = run(&["reconstruct", &example(), "-o", text(&cache.path().join("out")), "--checkpoint", name]);
        let message = String::from_utf8_lossy(&done.stderr).into_owned();
        assert_eq!(done.status.code(), Some(2), "{message}");
        words.iter().for_each(|w| assert!(message.contains(w), "expected {w:?} in: {message}"));
    };
    refused("hf:../model", &["hf:owner/name[@revision]", "found \"hf:../model\""]);
    #[cfg(target_os = "linux")]
    {
        use sha2::{Digest, Sha256};
        let commit = "0123456789abcdef0123456789abcdef01234567";
        let place = cache.path().join("freerange/hub/a/b");
        let folder = place.join(commit);
        assert!(run(&["model", "export", text(&folder)]).status.success());
        let weights = fs::read(folder.join("model.safetensors")).unwrap();
        let hash: String = Sha256::digest(&weights).iter().map(|b| format!("{b:02x}")).collect();
        fs::write(folder.join("pins.json"), format!("{{\"sha256\":{{\"model.safetensors\":\"{hash}\"}}}}")).unwrap();
        fs::create_dir_all(place.join("refs")).unwrap();
        fs::write(place.join("refs/main"), commit).unwrap();
        for name in ["hf:a/b", &format!("hf:a/b@{commit}")] {
            let done = run(&["model", "info", name]);
            assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        }
        fs::write(place.join("refs/main"), "main").unwrap();
        refused("hf:a/b", &["refs/main", "40 hexadecimal digits"]);
        #[cfg(not(feature = "fetch"))]
        refused("hf:a/c", &["hf:a/c@main", "model.safetensors", "--features fetch"]);
    }
}
