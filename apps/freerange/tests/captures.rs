//! Captures far from the origin and in small units, models for other programs, and photos without cameras: the real binary.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

use freerange_scene::camera::{Camera, View};
use glam::{DMat4, DVec3};
use image::{Rgba, RgbaImage};
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

/// A ring of photos of a striped ball, whose file is `NN.png`.
fn ring(count: usize) -> Vec<View> {
    (0..count)
        .map(|i| {
            let a = std::f64::consts::TAU * i as f64 / count as f64;
            let eye = DVec3::new(2.0 * a.cos(), 2.0 * a.sin(), 0.9);
            let camera = Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.8, 96, 72);
            let image = RgbaImage::from_fn(96, 72, |x, y| {
                let d = camera.ray_direction(f64::from(x) + 0.5, f64::from(y) + 0.5);
                let (b, c) = (eye.dot(d), eye.length_squared() - 0.16);
                let root = b * b - c;
                if root < 0.0 {
                    return Rgba([0; 4]);
                }
                let p = eye + (-b - root.sqrt()) * d;
                let v = |t: f64| (128.0 + 90.0 * t.sin()) as u8;
                Rgba([v(9.0 * p.x), v(8.0 * p.y + 1.0), v(11.0 * p.z), 255])
            });
            View { name: format!("{i:02}"), camera, image }
        })
        .collect()
}

/// A program that finds these cameras: it stands for a Python with pycolmap. `models`: photos in each; before a bar those that it finds under
/// given masks. `before` is run first.
#[cfg(unix)]
fn engine(folder: &Path, found: &[View], models: &str, before: &str) -> PathBuf {
    use std::os::unix::fs::PermissionsExt;
    let (model, engine) = (folder.join("model"), folder.join("python"));
    drop(fs::remove_dir_all(&model));
    let point = [(DVec3::ZERO, [0; 3])];
    freerange_scene::write_colmap(&model, found, DVec3::ZERO, &point).unwrap();
    let (masked, models) = models.split_once('|').unwrap_or((models, models));
    let script = format!(
        "#!/bin/sh\nif [ \"$1\" = -c ]; then echo 0.0-test; exit 0; fi\n{before}\nwork=$(dirname \"$2\")\nm='{models}'\n\
         grep -q '\"masks\": \"[^\"]*/masks\"' \"$2\" && m='{masked}'\nmkdir -p \"$work/model\"\n\
         cp {}/sparse/0/*.bin \"$work/model/\"\necho '{{\"engine\": \"test\", \"models\": '\"$m\"', \"pairs\": \"neighbors\", \"points\": 1}}' \
         > \"$work/result.json\"\n",
        model.display()
    );
    fs::write(&engine, script).unwrap();
    fs::set_permissions(&engine, fs::Permissions::from_mode(0o755)).unwrap();
    engine
}

/// Runs `poses` with [`engine`] on photos in `folder`.
#[cfg(unix)]
fn posed(folder: &Path, views: &[View], found: &[View], models: &str, more: &[&str]) -> (i32, String, Option<Value>) {
    let (photos, out) = (folder.join("photos"), folder.join("out"));
    for path in [&photos, &out] {
        drop(fs::remove_dir_all(path));
    }
    fs::create_dir_all(&photos).unwrap();
    views.iter().for_each(|v| v.image.save(photos.join(format!("{}.png", v.name))).unwrap());
    let engine = engine(folder, found, models, "");
    let text = |p: &Path| p.to_str().unwrap().to_owned();
    let (photos, out_text, engine) = (text(&photos), text(&out), text(&engine));
    let mut args = vec!["poses", &photos, "-o", &out_text, "--python", &engine];
    args.extend(more);
    let done = freerange(&args);
    let json = fs::read(out.join("poses.json")).ok().map(|b| serde_json::from_slice(&b).unwrap());
    (done.status.code().unwrap(), String::from_utf8_lossy(&done.stderr).into_owned(), json)
}

#[cfg(unix)]
#[test]
fn poses_that_an_engine_finds_are_judged() {
    let folder = tempfile::tempdir().unwrap();
    let views = ring(16);
    let at = |name: &str| folder.path().join("out").join(name);
    // Right ones: a scene.
    let (code, said, json) = posed(folder.path(), &views, &views, "[16, 3]", &[]);
    assert!(code == 0 && !said.contains("fit together"), "{said}");
    assert!(at("sparse/0/images.bin").is_file() && at("images/03.png").is_file());
    let json = json.unwrap();
    assert_eq!(json["judgement"]["refused"].as_array().unwrap().len(), 0);
    assert!((json["judgement"]["turns"][0].as_f64().unwrap() - 22.0).abs() < 3.0, "{json}");
    assert_eq!(freerange_scene::read::cameras(&folder.path().join("out"), None, None).unwrap().photos.len(), 16);
    // Masks of all photos are part of it; masks of some are not, which is said.
    let masks = folder.path().join("given");
    fs::create_dir(&masks).unwrap();
    for view in &views {
        let mask = |x: u32, y: u32| image::Luma([if *view.image.get_pixel(x, y) == Rgba([0; 4]) { 0 } else { 255 }]);
        let (w, h) = view.image.dimensions();
        image::GrayImage::from_fn(w, h, mask).save(masks.join(format!("{}.png", view.name))).unwrap();
    }
    let given = ["--masks", masks.to_str().unwrap()];
    let (code, said, _) = posed(folder.path(), &views, &views, "[16]", &given);
    assert_eq!(code, 0, "{said}");
    assert!(at("masks/15.png.png").is_file());
    let found = freerange_scene::read::cameras(&folder.path().join("out"), None, None).unwrap();
    let loaded = freerange_scene::load(&found, &freerange_scene::LoadConfig::default()).unwrap();
    assert_eq!(loaded.masks, freerange_scene::MaskKind::Files);
    // Where too little is found under them, what is beside them is looked at, too.
    let (code, said, _) = posed(folder.path(), &views, &views, "[2]|[16]", &given);
    assert!(code == 0 && said.contains("trying again with features beside the masks"), "{said}");
    assert!(at("masks/15.png.png").is_file());
    fs::remove_file(masks.join("03.png")).unwrap();
    let (code, said, _) = posed(folder.path(), &views, &views, "[16]", &given);
    assert!(code == 0 && said.contains("15 of 16 photos have a mask"), "{said}");
    assert!(!at("masks").exists());
    // Some a third of a turn off, as where a pattern repeats: no scene, and where it begins is named.
    let mut wrong = views.clone();
    let turn = DMat4::from_rotation_z(std::f64::consts::TAU / 3.0);
    wrong[5..11].iter_mut().for_each(|v| v.camera.world_to_camera *= turn);
    let (code, said, json) = posed(folder.path(), &views, &wrong, "[16]", &[]);
    assert_eq!(code, 2, "{said}");
    assert!(said.contains("04.png to 05.png") || said.contains("10.png to 11.png"), "{said}");
    assert!(said.contains("16 photos or more"), "{said}");
    assert!(json.is_some() && at("poses.log").is_file() && !at("sparse").exists() && !at("images").exists());
    // Most of the photos left out, or some of them.
    let (code, said, _) = posed(folder.path(), &views, &views[..11], "[11, 3]", &[]);
    assert_eq!(code, 2);
    assert!(said.contains("only 11 of 16 photos could be placed"), "{said}");
    let (code, said, _) = posed(folder.path(), &views, &views[..14], "[14, 2]", &[]);
    assert!(code == 0 && said.contains("2 photos fit together by themselves"), "{said}");
    assert!(said.contains("no pose was found for 14.png, 15.png"), "{said}");
    // A focal length of no lens; photos too far apart.
    let mut wrong = views.clone();
    wrong.iter_mut().for_each(|v| (v.camera.fx, v.camera.fy) = (20.0, 20.0));
    let (code, said, _) = posed(folder.path(), &views, &wrong, "[16]", &[]);
    assert!(code == 2 && said.contains("focal length"), "{said}");
    let few = ring(5);
    let (code, said, _) = posed(folder.path(), &few, &few, "[5]", &[]);
    assert!(code == 2 && said.contains("degrees apart, too far"), "{said}");
    // Half of a turn: refused, and used where the user says so.
    let half = views[..9].to_vec();
    let (code, said, _) = posed(folder.path(), &half, &half, "[9]", &[]);
    assert!(code == 2 && said.contains("--uneven"), "{said}");
    let (code, said, _) = posed(folder.path(), &half, &half, "[9]", &["--uneven"]);
    assert!(code == 0 && said.contains("warning"), "{said}");
}

/// A folder with a program that stands for COLMAP 3.8: it lists its options, writes down in `calls` what it is called with, and finds these
/// cameras.
#[cfg(unix)]
fn colmap(folder: &Path, found: &[View]) -> PathBuf {
    use std::os::unix::fs::PermissionsExt;
    let (model, programs) = (folder.join("model"), folder.join("programs"));
    drop(fs::remove_dir_all(&model));
    fs::create_dir_all(&programs).unwrap();
    freerange_scene::write_colmap(&model, found, DVec3::ZERO, &[(DVec3::ZERO, [0; 3])]).unwrap();
    let options = [
        "--database_path --image_path --image_list_path --match_list_path --match_type --output_path --random_seed",
        "--ImageReader.single_camera --ImageReader.camera_model --ImageReader.mask_path --SiftExtraction.use_gpu",
        "--SiftExtraction.max_num_features --SiftExtraction.peak_threshold --SiftExtraction.estimate_affine_shape",
        "--SiftExtraction.domain_size_pooling --SiftMatching.use_gpu --SiftMatching.guided_matching",
        "--Mapper.min_model_size --Mapper.num_threads --Mapper.abs_pose_min_num_inliers --Mapper.init_min_tri_angle",
        "--Mapper.init_min_num_inliers --Mapper.tri_ignore_two_view_tracks",
    ];
    let script = format!(
        "#!/bin/sh\nif [ \"$1\" = help ]; then echo 'COLMAP 3.8 -- Structure-from-Motion'; exit 0; fi\n\
         if [ \"$2\" = -h ]; then echo '{}'; exit 0; fi\necho \"$@\" >> '{}'\n[ \"$1\" = mapper ] || exit 0\n\
         while [ \"$1\" != --output_path ]; do shift; done\nmkdir -p \"$2/0\"\ncp '{}'/sparse/0/*.bin \"$2/0/\"\n",
        options.join(" "),
        folder.join("calls").display(),
        model.display()
    );
    let program = programs.join("colmap");
    fs::write(&program, script).unwrap();
    fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
    programs
}

#[cfg(unix)]
#[test]
fn colmaps_programs_are_run_with_the_options_that_they_know() {
    let folder = tempfile::tempdir().unwrap();
    let views = ring(16);
    let (photos, out, calls) = (folder.path().join("photos"), folder.path().join("out"), folder.path().join("calls"));
    fs::create_dir(&photos).unwrap();
    views.iter().for_each(|v| v.image.save(photos.join(format!("{}.png", v.name))).unwrap());
    // All photos by their neighbors; and some, so that all pairs are compared as well.
    let neighbors = ["feature_extractor", "matches_importer", "mapper"];
    let all_pairs = ["exhaustive_matcher", "mapper"];
    for (count, more) in [(16, &all_pairs[..0]), (14, &all_pairs[..])] {
        drop(fs::remove_file(&calls));
        let programs = colmap(folder.path(), &views[..count]);
        let path = format!("{}:{}", programs.display(), std::env::var("PATH").unwrap());
        let mut command = Command::new(env!("CARGO_BIN_EXE_freerange"));
        command.args(["poses", photos.to_str().unwrap(), "-o", out.to_str().unwrap()]).env("PATH", path);
        let done = command.output().unwrap();
        let said = String::from_utf8_lossy(&done.stderr);
        assert!(done.status.success() && said.contains("16 photos, COLMAP 3.8"), "{said}");
        assert!(said.contains("has no option matches_importer TwoViewGeometry.filter_stationary_matches"), "{said}");
        assert_eq!(said.contains("no pose was found for 14.png, 15.png"), count == 14, "{said}");
        let json: Value = serde_json::from_slice(&fs::read(out.join("poses.json")).unwrap()).unwrap();
        assert_eq!((&json["engine"]["engine"], &json["engine"]["pairs"]), (&"COLMAP 3.8".into(), &"neighbors".into()));
        assert_eq!(json["engine"]["models"], serde_json::json!([count]));
        assert!(out.join("poses.log").is_file() && out.join("sparse/0/points3D.bin").is_file());
        let calls = fs::read_to_string(&calls).unwrap();
        let calls: Vec<&str> = calls.lines().collect();
        let commands: Vec<&str> = calls.iter().filter_map(|call| call.split(' ').next()).collect();
        assert_eq!(commands, [&neighbors[..], more].concat());
        // One camera, weak features, neighbors first, weak poses, and runs that repeat.
        for (call, options) in calls.iter().zip([
            &["ImageReader.single_camera 1", "ImageReader.camera_model SIMPLE_RADIAL", "SiftExtraction.use_gpu 0"][..],
            &["match_type pairs", "SiftMatching.use_gpu 0", "SiftMatching.guided_matching 0"],
            &["Mapper.abs_pose_min_num_inliers 15", "Mapper.tri_ignore_two_view_tracks 0", "Mapper.num_threads 1"],
        ]) {
            options.iter().for_each(|o| assert!(call.contains(&format!("--{o}")), "expected {o} in: {call}"));
        }
        let weak = ["--SiftExtraction.peak_threshold 0.002", "--SiftExtraction.max_num_features 16384"];
        assert!(weak.iter().all(|o| calls[0].contains(o)) && calls[2].contains("--random_seed 0"), "{calls:?}");
    }
}

/// Photos 90 degrees apart, with a real engine: whatever it makes of them is refused.
#[test]
#[ignore = "needs FREERANGE_SHARED, and COLMAP or pycolmap"]
fn eight_photos_a_quarter_turn_apart_are_refused() {
    let shared = PathBuf::from(std::env::var_os("FREERANGE_SHARED").expect("FREERANGE_SHARED"));
    for scene in ["bread", "mug"] {
        let out = tempfile::tempdir().unwrap();
        let (photos, to) = (shared.join("photos").join(scene), out.path().join("scene"));
        let done = freerange(&["poses", photos.to_str().unwrap(), "-o", to.to_str().unwrap()]);
        let said = String::from_utf8_lossy(&done.stderr).into_owned();
        if said.contains("expected COLMAP on the PATH") {
            println!("left out: neither COLMAP nor pycolmap is here");
            return;
        }
        assert_eq!(done.status.code(), Some(2), "{scene}: {said}");
        assert!(said.contains("no cameras that can be relied on") && said.contains("16 photos or more"), "{said}");
        assert!(to.join("poses.json").is_file() && !to.join("sparse").exists(), "{scene}");
    }
}

#[test]
fn poses_need_photos_and_an_engine() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().to_str().unwrap();
    let said = |args: &[&str]| {
        let done = freerange(args);
        assert_eq!(done.status.code(), Some(2));
        String::from_utf8_lossy(&done.stderr).into_owned()
    };
    let out = folder.path().join("out");
    let out = out.to_str().unwrap();
    assert!(said(&["poses", path, "-o", out]).contains("at least 3 photos"));
    for view in ring(5) {
        view.image.save(folder.path().join(format!("{}.png", view.name))).unwrap();
    }
    let text = said(&["poses", path, "-o", out, "--python", "/nowhere/python"]);
    assert!(text.contains("/nowhere/python") && text.contains("pycolmap"), "{text}");
    // No engine at all: how to install one.
    let done =
        Command::new(env!("CARGO_BIN_EXE_freerange")).args(["poses", path, "-o", out]).env("PATH", path).output();
    let done = done.unwrap();
    let text = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.code() == Some(2) && text.contains("expected COLMAP on the PATH, or pycolmap"), "{text}");
    assert!(text.contains("pip install pycolmap") && text.contains("apt install colmap"), "{text}");
    // `reconstruct` says what to do with photos alone.
    assert!(said(&["reconstruct", path, "-o", out]).contains("freerange poses"));
}

/// `freerange serve` with this engine; it ends with the test.
#[cfg(unix)]
struct Page(std::process::Child, String);

#[cfg(unix)]
impl Drop for Page {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().ok();
    }
}

#[cfg(unix)]
impl Page {
    fn start(more: &[&str], path: Option<&Path>) -> Self {
        use std::io::BufRead;
        let mut command = Command::new(env!("CARGO_BIN_EXE_freerange"));
        command.args(["serve", "--port", "0", "--device", "cpu", "--no-token"]).args(more);
        if let Some(path) = path {
            command.env("PATH", path);
        }
        let mut child = command.stdout(std::process::Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        std::io::BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        Self(child, line.trim().trim_start_matches("http://").trim_end_matches('/').to_owned())
    }

    fn ask(&self, method: &str, path: &str, body: &[u8]) -> Value {
        use std::io::{Read, Write};
        let (address, kind) = (&self.1, "multipart/form-data; boundary=x");
        let mut stream = std::net::TcpStream::connect(address).unwrap();
        let length = body.len();
        let head = format!(
            "{method} {path} HTTP/1.1\r\nHost: {address}\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\n\r\n"
        );
        stream.write_all(&[head.as_bytes(), body].concat()).unwrap();
        let mut reply = Vec::new();
        stream.read_to_end(&mut reply).unwrap();
        let at = reply.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
        serde_json::from_slice(&reply[at + 4..]).unwrap()
    }

    /// Sends photos without cameras, and waits for what comes of them.
    fn photos(&self, views: &[View], until: impl Fn(&Value) -> bool) -> Value {
        let mut form =
            b"--x\r\nContent-Disposition: form-data; name=\"scene\"\r\n\r\n{\"find_cameras\": true}\r\n".to_vec();
        for view in views {
            let name = &view.name;
            let head =
                format!("--x\r\nContent-Disposition: form-data; name=\"f\"; filename=\"ball/{name}.png\"\r\n\r\n");
            let mut png = std::io::Cursor::new(Vec::new());
            view.image.write_to(&mut png, image::ImageFormat::Png).unwrap();
            form.extend([head.as_bytes(), &png.into_inner(), b"\r\n"].concat());
        }
        form.extend(b"--x--\r\n");
        let id = self.ask("POST", "/jobs", &form)["id"].as_str().unwrap().to_owned();
        for _ in 0..2400 {
            let job = self.ask("GET", &format!("/jobs/{id}"), b"");
            if until(&job) {
                return job;
            }
            std::thread::sleep(std::time::Duration::from_millis(50));
        }
        panic!("it never came");
    }
}

#[cfg(unix)]
#[test]
fn the_page_finds_cameras_by_the_same_engine() {
    let folder = tempfile::tempdir().unwrap();
    let views = ring(16);
    let read = |job: &Value| job["state"] != "reading";
    // Found, with a warning of the judge; the engine is ended when it takes too long, or is not wanted any more.
    let wait = folder.path().join("wait");
    let slow = format!("echo '{{\"step\": \"features\", \"done\": 0}}'\n[ ! -e {0} ] || sleep 300", wait.display());
    let program = engine(folder.path(), &views[..14], "[14, 2]", &slow);
    let page = Page::start(&["--python", program.to_str().unwrap(), "--max-search-time", "600"], None);
    assert_eq!(page.ask("GET", "/server", b"")["camera_finder"]["name"], "pycolmap 0.0-test");
    let job = page.photos(&views, read);
    assert_eq!(job["state"], "ready", "{job}");
    assert_eq!(job["understood"]["notes"][0], "14 of 16 photos have cameras, found by test");
    assert_eq!(job["understood"]["format"], "colmap");
    let warnings = job["understood"]["warnings"].to_string();
    assert!(warnings.contains("no pose was found for 14.png, 15.png"), "{warnings}");
    fs::write(&wait, "").unwrap();
    let job = page.photos(&views, |job| job["stage"] == "features");
    assert_eq!((&job["done"], &job["total"]), (&0.into(), &6.into()));
    let id = job["id"].as_str().unwrap();
    assert_eq!(page.ask("POST", &format!("/jobs/{id}/cancel"), b"")["state"], "cancelled");
    fs::remove_file(&wait).unwrap();
    assert_eq!(page.photos(&views, read)["state"], "ready", "the engine of the job before has ended");
    drop(page);
    // Refused, without a word of the command line.
    let program = engine(folder.path(), &views[..9], "[9]", "");
    let page = Page::start(&["--python", program.to_str().unwrap()], None);
    let job = page.photos(&views[..9], read);
    let error = job["error"].as_str().unwrap();
    assert!(error.contains("no cameras that can be relied on") && error.contains("not at even steps"), "{error}");
    assert!(error.contains("16 photos or more") && !error.contains("--") && !error.contains("/upload"), "{error}");
    drop(page);
    // Nothing that finds cameras.
    let page = Page::start(&[], Some(&folder.path().join("empty")));
    let about = page.ask("GET", "/server", b"");
    assert!(about["camera_finder"]["missing"].as_str().unwrap().contains("neither COLMAP nor pycolmap"), "{about}");
}

/// Whether the process of this number computes or sleeps: one that has ended may be listed until somebody waits for it.
#[cfg(target_os = "linux")]
fn is_alive(id: &str) -> bool {
    let stat = fs::read_to_string(format!("/proc/{id}/stat")).unwrap_or_default();
    stat.rsplit_once(") ").is_some_and(|(_, rest)| !rest.starts_with(['Z', 'X']))
}

#[cfg(target_os = "linux")]
#[test]
fn an_engine_ends_with_a_program_that_is_killed() {
    let folder = tempfile::tempdir().unwrap();
    let views = ring(5);
    let (id, photos, out) = (folder.path().join("id"), folder.path().join("photos"), folder.path().join("out"));
    fs::create_dir(&photos).unwrap();
    views.iter().for_each(|v| v.image.save(photos.join(format!("{}.png", v.name))).unwrap());
    // It says its number, and would go on for a minute.
    let sleeps = format!("echo $$ > {0}.new\nmv {0}.new {0}\nexec sleep 60", id.display());
    let program = engine(folder.path(), &views, "[5]", &sleeps);
    let soon = |what: &str, done: &dyn Fn() -> bool| {
        let begun = (0..400).any(|_| {
            std::thread::sleep(std::time::Duration::from_millis(50));
            done()
        });
        assert!(begun, "{what}");
    };
    let number = || fs::read_to_string(&id).unwrap().trim().to_owned();
    let ended = |number: &str| soon("the engine ends", &|| !is_alive(number));

    let mut poses = Command::new(env!("CARGO_BIN_EXE_freerange"));
    poses.args(["poses", photos.to_str().unwrap(), "-o", out.to_str().unwrap(), "--python", program.to_str().unwrap()]);
    let mut poses = poses.spawn().unwrap();
    soon("the engine begins", &|| id.exists());
    let engine_of_poses = number();
    assert!(is_alive(&engine_of_poses));
    poses.kill().unwrap(); // SIGKILL
    poses.wait().unwrap();
    ended(&engine_of_poses);

    fs::remove_file(&id).unwrap();
    let page = Page::start(&["--python", program.to_str().unwrap()], None);
    page.photos(&views, |_| id.exists());
    let engine_of_page = number();
    assert!(is_alive(&engine_of_page));
    drop(page);
    ended(&engine_of_page);
}
