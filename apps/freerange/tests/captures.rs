//! Captures far from the origin and in small units, and models for other programs: the real binary.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

use glam::DVec3;
use serde_json::Value;

fn freerange(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_freerange")).args(args).output().unwrap()
}

/// The bowl with its coordinates scaled and moved, as a scene.
fn bowl(to: &Path, scale: f64, shift: [f64; 3]) {
    let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/bowl");
    let mut root: Value = serde_json::from_slice(&fs::read(from.join("transforms_train.json")).unwrap()).unwrap();
    for frame in root["frames"].as_array_mut().unwrap() {
        let name = format!("{}.png", frame["file_path"].as_str().unwrap());
        fs::create_dir_all(to.join(&name).parent().unwrap()).unwrap();
        fs::copy(from.join(&name), to.join(&name)).unwrap();
        for (i, shift) in shift.iter().enumerate() {
            let v = frame["transform_matrix"][i][3].as_f64().unwrap();
            frame["transform_matrix"][i][3] = (scale * v + shift).into();
        }
    }
    fs::write(to.join("transforms.json"), root.to_string()).unwrap();
}

/// Reconstructs as quickly as can be; the report, and what was said on standard error.
fn reconstructed(scene: &Path, out: &Path, more: &[&str]) -> (Value, String) {
    let mut args = vec!["reconstruct", scene.to_str().unwrap(), "-o", out.to_str().unwrap(), "--iterations", "0"];
    args.extend(["--set", "refine.passes=1", "--symmetry", "off"]);
    args.extend(more);
    let done = freerange(&args);
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(done.status.success(), "{said}");
    (serde_json::from_slice(&fs::read(out.join("report.json")).unwrap()).unwrap(), said)
}

fn psnr(report: &Value) -> f64 {
    report["samples"][0]["input_views"]["psnr"].as_f64().unwrap()
}

/// Mean difference of two pictures, in 8-bit steps.
fn differ(a: &Path, b: &Path) -> f64 {
    let (a, b) = (image::open(a).unwrap().into_rgb8(), image::open(b).unwrap().into_rgb8());
    let sum: f64 = a.iter().zip(b.iter()).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
    sum / a.len() as f64
}

#[test]
fn place_and_units_of_a_scene_do_not_matter() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let place = [448_000.0, 5_411_000.0, 300.0];
    bowl(&at("near"), 1.0, [0.0; 3]);
    bowl(&at("far"), 1.0, place);
    bowl(&at("small"), 1e-3, [0.0; 3]);
    bowl(&at("large"), 1e3, [0.0; 3]);
    let (near, _) = reconstructed(&at("near"), &at("near-out"), &[]);
    let (far, said) = reconstructed(&at("far"), &at("far-out"), &["--format", "colmap"]);
    let (small, _) = reconstructed(&at("small"), &at("small-out"), &[]);
    let (large, _) = reconstructed(&at("large"), &at("large-out"), &[]);
    for other in [&far, &small, &large] {
        assert!((psnr(other) - psnr(&near)).abs() < 0.5, "{} {}", psnr(other), psnr(&near));
    }
    // What was subtracted is written down and told.
    assert!(near.get("origin").is_none());
    let origin: Vec<f64> = far["origin"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
    assert!(origin.iter().zip(place).all(|(o, p)| (o - p).abs() <= 2.0), "{origin:?}");
    let notes = far["notes"].as_array().unwrap();
    assert!(
        notes.iter().any(|n| n["kind"] == "changed" && n["text"].as_str().unwrap().contains("far from the origin"))
    );
    assert!(said.contains("note: the cameras lie far from the origin"), "{said}");
    let header = fs::read(at("far-out/gaussians.ply")).unwrap();
    assert!(
        String::from_utf8_lossy(&header[..300])
            .contains(&format!("comment Origin: {} {} {}\n", origin[0], origin[1], origin[2]))
    );
    // Cameras of the scene's own coordinates see the result.
    for name in ["near", "far", "small", "large"] {
        let file = at(&format!("{name}-out/gaussians.ply"));
        let (renders, cameras) = (at(&format!("{name}-renders")), at(name));
        let done = freerange(&[
            "render",
            file.to_str().unwrap(),
            "--cameras",
            cameras.to_str().unwrap(),
            "-o",
            renders.to_str().unwrap(),
        ]);
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    }
    let mut pictures: Vec<PathBuf> = fs::read_dir(at("near-renders")).unwrap().map(|e| e.unwrap().path()).collect();
    pictures.retain(|p| p.extension().is_some_and(|e| e == "png"));
    assert_eq!(pictures.len(), 4);
    for picture in &pictures {
        for other in ["far", "small", "large"] {
            let off = differ(picture, &at(&format!("{other}-renders")).join(picture.file_name().unwrap()));
            assert!(off < 1.0, "{other}: {off}");
        }
    }
    // Models of other programs have 64 bits.
    let found = freerange_scene::read::cameras(&at("far-out/colmap"), None, None).unwrap();
    assert_eq!(found.photos.len(), 4);
    assert!((found.origin - DVec3::from_array(place)).length() < 4.0, "{}", found.origin);
    assert!(fs::metadata(at("far-out/colmap/sparse/0/points3D.bin")).unwrap().len() > 10_000);
}

#[test]
fn warnings_of_inspect_are_told_and_kept() {
    let folder = tempfile::tempdir().unwrap();
    let few = |name: &str, count: usize| {
        let scene = folder.path().join(name);
        bowl(&scene, 1.0, [0.0; 3]);
        let file = scene.join("transforms.json");
        let mut root: Value = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
        root["frames"].as_array_mut().unwrap().truncate(count);
        fs::write(&file, root.to_string()).unwrap();
        scene
    };
    // In the report, by kind, and on standard error.
    let holds = |(report, said): &(Value, String), kind: &str, text: &str| {
        let found = |n: &Value| n["kind"] == kind && n["text"].as_str().unwrap().contains(text);
        assert!(report["notes"].as_array().unwrap().iter().any(found), "{text}: {}", report["notes"]);
        let word = if kind == "warning" { "warning" } else { "note" };
        assert!(said.lines().any(|l| l.starts_with(&format!("{word}: ")) && l.contains(text)), "{text}: {said}");
    };
    let alpha = reconstructed(&few("alpha", 3), &folder.path().join("alpha-out"), &[]);
    holds(&alpha, "warning", "only 3 photos");
    holds(&alpha, "understood", "masks are the alpha of 3 photos");
    // From one side, with masks in files.
    let scene = few("masked", 2);
    fs::create_dir(scene.join("masks")).unwrap();
    for name in ["000", "001"] {
        let file = scene.join(format!("train/{name}.png"));
        let mut photo = image::open(&file).unwrap().into_rgba8();
        let (w, h) = photo.dimensions();
        let mask = image::GrayImage::from_fn(w, h, |x, y| image::Luma([photo.get_pixel(x, y)[3]]));
        mask.save(scene.join(format!("masks/{name}.png"))).unwrap();
        photo.pixels_mut().for_each(|p| p[3] = 255);
        photo.save(&file).unwrap();
    }
    let masked = reconstructed(&scene, &folder.path().join("masked-out"), &[]);
    holds(&masked, "warning", "only 2 photos");
    holds(&masked, "warning", "taken from one side");
    holds(&masked, "understood", "masks are read from files, those of the folder masks");
}

#[test]
fn inspect_names_views_as_its_sheet_does() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, out) = (folder.path().join("scene"), folder.path().join("inspect"));
    bowl(&scene, 1.0, [0.0; 3]);
    let done = freerange(&["inspect", scene.to_str().unwrap(), "-o", out.to_str().unwrap(), "--views", "2"]);
    let said = String::from_utf8_lossy(&done.stdout).into_owned();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    assert!(said.contains("4 photos, 2 seen by the network"), "{said}");
    assert_eq!(said.lines().filter(|line| line.ends_with(", for the optimization")).count(), 2, "{said}");
    let json: Value = serde_json::from_slice(&fs::read(out.join("inspect.json")).unwrap()).unwrap();
    let shown: Vec<&Value> = json["views"].as_array().unwrap().iter().filter(|v| v["shown"] == true).collect();
    assert_eq!(shown.len(), 2);
}
