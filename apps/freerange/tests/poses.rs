//! Photos without cameras, by the command line and by the page: the real binary.

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

/// A ring of photos of a striped ball, whose file is `NN.png`.
fn ring(count: usize) -> Vec<View> {
    around(&(0..count).map(|i| 360.0 * i as f64 / count as f64).collect::<Vec<_>>())
}

/// Photos of the ball from these directions, in degrees.
fn around(degrees: &[f64]) -> Vec<View> {
    let one = |(i, degrees): (usize, &f64)| {
        let a = degrees.to_radians();
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
    };
    degrees.iter().enumerate().map(one).collect()
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
    let engine = engine(folder, found, models, "");
    posed_by(&engine, folder, views, more)
}

/// Runs `poses` with this engine on photos in `folder`.
#[cfg(unix)]
fn posed_by(engine: &Path, folder: &Path, views: &[View], more: &[&str]) -> (i32, String, Option<Value>) {
    let (photos, out) = (folder.join("photos"), folder.join("out"));
    for path in [&photos, &out] {
        drop(fs::remove_dir_all(path));
    }
    fs::create_dir_all(&photos).unwrap();
    views.iter().for_each(|v| v.image.save(photos.join(format!("{}.png", v.name))).unwrap());
    let text = |p: &Path| p.to_str().unwrap().to_owned();
    let (photos, out_text, engine) = (text(&photos), text(&out), text(engine));
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

/// Masks of the ball in a folder, as images of some kind.
#[cfg(unix)]
fn write_masks(to: &Path, views: &[View], kind: &str) {
    drop(fs::remove_dir_all(to));
    fs::create_dir(to).unwrap();
    for view in views {
        let mut mask = view.image.clone();
        for p in mask.pixels_mut() {
            let gray = |v: u8| Rgba([v, v, v, 255]);
            let there = p[3] == 255;
            *p = match kind {
                "0 and 255" => gray(if there { 255 } else { 0 }),
                "0 and 1" => gray(there.into()),
                _ => *p,
            };
        }
        mask.save(to.join(format!("{}.png", view.name))).unwrap();
    }
}

#[cfg(unix)]
#[test]
fn masks_are_read_as_reconstruct_reads_them() {
    let folder = tempfile::tempdir().unwrap();
    let views = ring(16);
    let given = folder.path().join("given");
    for kind in ["0 and 1", "photos cut out"] {
        write_masks(&given, &views, kind);
        let more = ["--masks", given.to_str().unwrap()];
        let (code, said, _) = posed(folder.path(), &views, &views, "[16]", &more);
        assert_eq!(code, 0, "{kind}: {said}");
        for view in &views {
            let file = folder.path().join(format!("out/masks/{}.png.png", view.name));
            let mask = image::open(file).unwrap().into_luma8();
            assert!(view.image.pixels().zip(mask.pixels()).all(|(p, m)| p[3] == m[0]), "{kind}: {}", view.name);
        }
    }
    // One that shows nothing is named before the engine runs.
    image::GrayImage::new(96, 72).save(given.join("03.png")).unwrap();
    let (code, said, json) = posed(folder.path(), &views, &views, "[16]", &["--masks", given.to_str().unwrap()]);
    assert!(code == 2 && json.is_none() && said.contains("given/03.png"), "{said}");
}

#[cfg(unix)]
#[test]
fn turns_that_may_be_wrong_are_named() {
    let folder = tempfile::tempdir().unwrap();
    // The sixth photo farther along the way, by so much of a step.
    for (late, warned) in [(0.7, false), (0.85, true), (1.05, true)] {
        let at = |i: usize| 22.5 * (i as f64 + if i == 5 { late } else { 0.0 });
        let views = around(&(0..16).map(at).collect::<Vec<_>>());
        let (code, said, json) = posed(folder.path(), &views, &views, "[16]", &[]);
        assert_eq!(code, 0, "{late}: {said}");
        let warnings = json.unwrap()["judgement"]["warnings"].to_string();
        for text in [&said, &warnings] {
            assert_eq!(text.contains("degrees from 04.png to 05.png"), warned, "{late}: {text}");
        }
    }
}

#[cfg(unix)]
#[test]
fn photos_that_the_others_do_not_predict_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let right = ring(16);
    let said = |views: &[View]| {
        let (code, said, _) = posed(folder.path(), views, &right, "[16]", &[]);
        assert_eq!(code, 0, "{said}");
        said
    };
    assert!(!said(&right).contains("do not predict"));
    // The ball from its other side: of the same outline, under a pose that is not its own.
    let mut swapped = right.clone();
    (swapped[3].image, swapped[11].image) = (right[11].image.clone(), right[3].image.clone());
    let said = said(&swapped);
    assert!(said.contains("the other photos do not predict 03, 11: "), "{said}");
}

/// The right turns, but of a camera that stands still: engines find that where the background does not move.
#[cfg(unix)]
#[test]
fn cameras_at_one_place_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let views = ring(16);
    for away in [0.0, 0.1] {
        let mut wrong = views.clone();
        for (i, view) in wrong.iter_mut().enumerate() {
            let (sin, cos) = (std::f64::consts::TAU * i as f64 / 16.0).sin_cos();
            let d = DVec3::new(cos, sin, -0.4);
            view.camera = Camera::look_at(away * d, (away + 1.0) * d, DVec3::Z, 0.8, 96, 72);
        }
        let (code, said, _) = posed(folder.path(), &views, &wrong, "[16]", &[]);
        assert!(code == 2 && said.contains("the cameras do not look at one object"), "{away}: {said}");
    }
}

#[cfg(unix)]
#[test]
fn what_the_engine_says_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let views = ring(16);
    let (given, log) = (folder.path().join("given"), folder.path().join("out/poses.log"));
    write_masks(&given, &views, "0 and 255");
    let more = ["--masks", given.to_str().unwrap()];
    let masked = "grep -q '\"masks\": \"[^\"]*/masks\"' \"$2\"";
    let log_of = |code: i32, models: &str, before: &str| {
        let engine = engine(folder.path(), &views, models, before);
        let (found, said, json) = posed_by(&engine, folder.path(), &views, &more);
        assert_eq!(found, code, "{said}");
        (said, json, fs::read_to_string(&log).unwrap())
    };
    // Of each attempt, under a line of its own.
    let words = format!("{masked} && echo words under masks >&2 || echo words beside them >&2");
    let (_, _, text) = log_of(0, "[2]|[16]", &words);
    let lines: Vec<&str> = text.lines().collect();
    assert!(lines.len() == 4 && lines[0].contains("attempt 1") && lines[2].contains("attempt 2"), "{text}");
    assert_eq!((lines[1], lines[3]), ("words under masks", "words beside them"));
    // And where it fails, at first or in the end: what it said last is part of the error.
    for (before, attempts) in [("exit 3".to_owned(), 1), (format!("{masked} || exit 3"), 2)] {
        let before = format!("echo first words >&2\necho last words >&2\n{before}");
        let (said, json, text) = log_of(1, "[2]|[16]", &before);
        assert!(said.contains("pycolmap failed") && said.contains("first words / last words"), "{said}");
        assert!(said.contains(log.to_str().unwrap()) && !said.contains(".freerange-"), "{said}");
        assert_eq!(
            (text.matches("attempt ").count(), text.matches("last words").count()),
            (attempts, attempts),
            "{text}"
        );
        assert!(json.is_none());
    }
    // An engine that ends without a word.
    let engine = engine(folder.path(), &views, "[16]", "exit 3");
    let (code, said, _) = posed_by(&engine, folder.path(), &views, &[]);
    assert!(code == 1 && said.contains("pycolmap failed without a message"), "{said}");
    assert!(!log.exists() && !said.contains("poses.log"), "{said}");
    // COLMAP's programs.
    let program = colmap(folder.path(), &views).join("colmap");
    let script = fs::read_to_string(&program).unwrap();
    let fails = "[ \"$1\" = matches_importer ] && echo no matches && exit 1\n[ \"$1\" = mapper ]";
    fs::write(&program, script.replace("[ \"$1\" = mapper ]", fails)).unwrap();
    let (photos, out) = (folder.path().join("photos"), folder.path().join("out"));
    let path = format!("{}:{}", program.parent().unwrap().display(), std::env::var("PATH").unwrap());
    let mut command = Command::new(env!("CARGO_BIN_EXE_freerange"));
    let done =
        command.args(["poses", photos.to_str().unwrap(), "-o", out.to_str().unwrap()]).env("PATH", path).output();
    let said = String::from_utf8_lossy(&done.unwrap().stderr).into_owned();
    assert!(said.contains("colmap matches_importer failed") && said.contains("no matches"), "{said}");
    assert!(said.contains(log.to_str().unwrap()), "{said}");
    assert!(fs::read_to_string(&log).unwrap().ends_with("no matches\n"));
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
    // All photos by their neighbors; and some, so that all pairs are compared as well. What is around the ball, under the
    // alpha, stands still first, as on a turntable, and then changes.
    let neighbors = ["feature_extractor", "matches_importer", "mapper"];
    let all_pairs = ["exhaustive_matcher", "mapper"];
    for (count, more, threshold) in [(16, &all_pairs[..0], "0.0066"), (14, &all_pairs[..], "0.002")] {
        for (i, view) in (0u32..).zip(&views) {
            let mut photo = view.image.clone();
            for (x, y, p) in photo.enumerate_pixels_mut().filter(|(.., p)| p[3] == 0 && count < 16) {
                *p = Rgba([((x + 7 * i) / 8 * 37 % 97 + y) as u8, 0, 0, 0]);
            }
            photo.save(photos.join(format!("{}.png", view.name))).unwrap();
        }
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
        let features = [&format!("peak_threshold {threshold} "), "--SiftExtraction.max_num_features 16384"];
        assert!(features.iter().all(|o| calls[0].contains(o)) && calls[2].contains("--random_seed 0"), "{calls:?}");
        assert_eq!(calls[0].contains("--ImageReader.mask_path"), count == 16, "{calls:?}");
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
