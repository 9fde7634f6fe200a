//! Many scenes at once, and photos held out: the real binary on real files.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
    time::SystemTime,
};

use serde_json::Value;

fn freerange(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_freerange")).args(args).output().unwrap()
}

fn example() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/bowl")
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        let target = to.join(entry.file_name());
        match entry.file_type().unwrap().is_dir() {
            true => copy(&entry.path(), &target),
            false => drop(fs::copy(entry.path(), target).unwrap()),
        }
    }
}

/// Makes the scenes of a list as quickly as can be; the exit code, the table, and what was said.
fn made(list: &Path, out: &Path, more: &[&str]) -> (i32, Vec<Value>, String) {
    let mut args = vec!["reconstruct", "--list", list.to_str().unwrap(), "-o", out.to_str().unwrap(), "--json"];
    args.extend(["--set", "refine.passes=1", "--iterations", "0", "--symmetry", "off"]);
    args.extend(more);
    let done = freerange(&args);
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    (done.status.code().unwrap(), serde_json::from_slice(&done.stdout).unwrap_or_default(), said)
}

fn changed(file: &Path) -> SystemTime {
    fs::metadata(file).unwrap().modified().unwrap()
}

fn column<'a>(rows: &'a [Value], name: &str) -> Vec<&'a str> {
    rows.iter().map(|r| r[name].as_str().unwrap()).collect()
}

#[test]
fn many_scenes_are_made_once_and_a_bad_one_ends_none() {
    let place = tempfile::tempdir().unwrap();
    let (list, out) = (place.path().join("list.txt"), place.path().join("out"));
    for name in ["a/bowl", "b/bowl"] {
        copy(&example(), &place.path().join(name));
    }
    fs::create_dir(place.path().join("empty")).unwrap();
    fs::write(&list, "# three scenes\na/bowl\n\nempty\n  b/bowl  \n").unwrap();

    // The bad one in the middle is told of, and ends nothing.
    let (code, rows, said) = made(&list, &out, &[]);
    assert_eq!(code, 2, "{said}");
    assert_eq!(column(&rows, "scene"), ["a-bowl", "empty", "b-bowl"]);
    assert_eq!(column(&rows, "status"), ["done", "failed", "done"]);
    assert!(rows[1]["error"].as_str().unwrap().contains("an empty folder"), "{}", rows[1]);
    assert!(said.contains("1 of 3 scenes failed: empty"), "{said}");
    assert!(rows[0]["further_views"]["psnr"].as_f64().unwrap() > 5.0);
    assert_eq!(rows[0]["further_views"]["views"], 4);
    for file in ["gaussians.ply", "turntable.gif", "report.json", "inputs", "scene.json"] {
        assert!(out.join("a-bowl").join(file).exists(), "{file}");
    }
    assert!(!out.join("empty").exists());
    let table: Vec<Value> = serde_json::from_slice(&fs::read(out.join("scenes.json")).unwrap()).unwrap();
    assert_eq!(table, rows);

    // Again: only what was missing is made, and of the others the numbers stay.
    fs::remove_dir(place.path().join("empty")).unwrap();
    copy(&example(), &place.path().join("empty"));
    let before = changed(&out.join("a-bowl/gaussians.ply"));
    let (code, again, said) = made(&list, &out, &[]);
    assert_eq!((code, column(&again, "status")), (0, vec!["kept", "done", "kept"]), "{said}");
    assert_eq!(again[0]["further_views"], rows[0]["further_views"]);
    assert_eq!(changed(&out.join("a-bowl/gaussians.ply")), before);

    // A photo that changes makes its scene new.
    let photo = place.path().join("b/bowl/train/000.png");
    let file = fs::File::options().append(true).open(&photo).unwrap();
    file.set_modified(SystemTime::now() + std::time::Duration::from_secs(5)).unwrap();
    let (_, third, said) = made(&list, &out, &[]);
    assert_eq!(column(&third, "status"), ["kept", "kept", "done"], "{said}");

    // Other options are refused before anything is made, unless all is to be made anew.
    let (code, _, said) = made(&list, &out, &["--seed", "3"]);
    assert_eq!(code, 2);
    assert!(
        said.contains("scene.json") && said.contains("`seeds`: expected [0]") && said.contains("--overwrite"),
        "{said}"
    );
    assert_eq!(changed(&out.join("a-bowl/gaussians.ply")), before);

    // So is a record whose settings meant something else, or that does not say which they were.
    let record = out.join("a-bowl/scene.json");
    let whole = fs::read_to_string(&record).unwrap();
    let mut json: Value = serde_json::from_str(&whole).unwrap();
    for name in ["network_views", "symmetry", "propose", "refine", "optimize"] {
        assert!(json["options"][format!("pipeline.{name}")].is_string(), "{whole}");
    }
    let schema = json["options"].as_object_mut().unwrap().remove("settings_schema").unwrap();
    fs::write(&record, json.to_string()).unwrap();
    let (code, _, said) = made(&list, &out, &[]);
    assert!(
        code == 2 && said.contains("`settings_schema`: expected nothing") && said.contains("--overwrite"),
        "{said}"
    );
    json["options"]["settings_schema"] = format!("{schema}0").into();
    fs::write(&record, json.to_string()).unwrap();
    let (code, _, said) = made(&list, &out, &[]);
    assert!(code == 2 && said.contains("`settings_schema`: expected "), "{said}");
    fs::write(&record, whole).unwrap();

    let (code, rows, said) = made(&list, &out, &["--seed", "3", "--overwrite", "--shard", "0/2"]);
    assert_eq!((code, column(&rows, "scene")), (0, vec!["a-bowl", "b-bowl"]), "{said}");
    assert_eq!(column(&rows, "status"), ["done", "done"]);
    assert!(out.join("scenes-0-of-2.json").exists());
    let (_, rows, _) = made(&list, &out, &["--seed", "3", "--overwrite", "--shard", "1/2"]);
    assert_eq!(column(&rows, "scene"), ["empty"]);

    // One scene alone into a folder of these: what is replaced is named, and the scene no longer counts as finished.
    let (scene, folder) = (place.path().join("a/bowl"), out.join("a-bowl"));
    let (scene, output) = (scene.to_str().unwrap(), folder.to_str().unwrap());
    let quick = ["--set", "refine.passes=1", "--iterations", "0", "--symmetry", "off"];
    let done = freerange(&[&["reconstruct", scene, "-o", output][..], &quick].concat());
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    let words = format!("note: {output} holds a result of {scene} (no preset, seed 3), made ");
    assert!(done.status.success() && said.contains(&words), "{words}: {said}");
    assert!(folder.join("gaussians.ply").exists() && !folder.join("scene.json").exists());
}

/// One scene is always computed. What lies in its folder is named first.
#[test]
fn a_scene_names_the_result_that_it_replaces() {
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("out");
    let run = |more: &[&str]| {
        let (scene, output) = (example(), out.to_str().unwrap());
        let done = freerange(&[&["reconstruct", scene.to_str().unwrap(), "-o", output][..], more].concat());
        let said = String::from_utf8_lossy(&done.stderr).into_owned();
        assert!(done.status.success(), "{said}");
        (said, fs::read(out.join("gaussians.ply")).unwrap())
    };
    let (said, draft) = run(&["--quality", "draft", "--seed", "3"]);
    assert!(!said.contains("replaced"), "{said}");
    let (said, quick) = run(&["--set", "refine.passes=1", "--iterations", "0", "--symmetry", "off"]);
    let words = format!("{} holds a result of {} (draft, seed 3), made ", out.display(), example().display());
    assert!(said.contains(&words) && said.contains(" ago: it is replaced when this one is done"), "{words}: {said}");
    assert_ne!(draft, quick);
}

/// White beside white is as good as can be; it has no finite PSNR, which JSON would not hold.
#[test]
fn a_view_that_sees_nothing_ends_no_batch() {
    let place = tempfile::tempdir().unwrap();
    let (list, out) = (place.path().join("list.txt"), place.path().join("out"));
    for name in ["a", "b"] {
        copy(&example(), &place.path().join(name));
    }
    fs::write(&list, "a\nb\n").unwrap();
    // The first further view of one of them turns its back on the object.
    let file = place.path().join("a/transforms_test.json");
    let mut scene: Value = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
    let frame = &mut scene["frames"][0];
    for row in 0..3 {
        for column in [0, 2] {
            let x = frame["transform_matrix"][row][column].as_f64().unwrap();
            frame["transform_matrix"][row][column] = (-x).into();
        }
    }
    let picture = place.path().join("a/test/000.png");
    fs::write(&file, scene.to_string()).unwrap();
    let (width, height) = image::image_dimensions(&picture).unwrap();
    image::RgbaImage::new(width, height).save(&picture).unwrap();

    let (code, rows, said) = made(&list, &out, &[]);
    assert_eq!((code, column(&rows, "status")), (0, vec!["done", "done"]), "{said}");
    let psnr = |row: &Value| row["further_views"]["psnr"].as_f64().unwrap();
    assert!(psnr(&rows[0]) > psnr(&rows[1]) && psnr(&rows[0]).is_finite(), "{rows:?}");
    let report: Value = serde_json::from_slice(&fs::read(out.join("a/report.json")).unwrap()).unwrap();
    let views = report["samples"][0]["further_views"]["views"].as_array().unwrap();
    assert!(views.iter().any(|view| view["psnr"].as_f64() == Some(100.0)), "{views:?}");
    let (code, rows, said) = made(&list, &out, &[]);
    assert_eq!((code, column(&rows, "status")), (0, vec!["kept", "kept"]), "{said}");

    // A record that cannot be read does not stand in the way of a new one.
    let record = out.join("a/scene.json");
    let broken = fs::read_to_string(&record).unwrap().replace("\"seconds\": ", "\"seconds\": null, \"was\": ");
    fs::write(&record, broken).unwrap();
    let (code, _, said) = made(&list, &out, &[]);
    assert!(code == 2 && said.contains("scene.json"), "{said}");
    let (code, rows, said) = made(&list, &out, &["--overwrite"]);
    assert_eq!((code, column(&rows, "status")), (0, vec!["done", "done"]), "{said}");
}

#[test]
fn what_cannot_be_a_list_of_scenes_is_refused() {
    let place = tempfile::tempdir().unwrap();
    let says = |args: &[&str], words: &[&str]| {
        let out = place.path().join("out");
        let done = freerange(&[&["reconstruct", "-o", out.to_str().unwrap()], args].concat());
        let said = String::from_utf8_lossy(&done.stderr).into_owned();
        assert_eq!(done.status.code(), Some(2), "{said}");
        words.iter().for_each(|w| assert!(said.contains(w), "expected {w:?} in: {said}"));
        assert!(!out.exists());
    };
    let (list, bowl) = (place.path().join("list"), example());
    let (list_name, bowl) = (list.to_str().unwrap(), bowl.to_str().unwrap());
    says(&[], &["SCENE"]);
    says(&["--list", list_name], &["list"]);
    fs::write(&list, "# nothing\n").unwrap();
    says(&["--list", list_name], &["expected a scene on each line"]);
    says(&[bowl, bowl], &["bowl", "every scene once"]);
    says(&[bowl, "elsewhere", "--eval-scene", bowl], &["--eval-scene", "one scene"]);
    says(&[bowl, "--overwrite"], &["--overwrite", "several scenes"]);
    says(&[bowl, "--shard", "2/2"], &["0 to N - 1"]);
}

#[test]
fn photos_held_out_are_compared_with_and_not_used() {
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("out");
    let args = |holdout: &[&'static str]| {
        let (scene, out) = (example().to_str().unwrap().to_owned(), out.to_str().unwrap().to_owned());
        let quick = ["--set", "refine.passes=1", "--iterations", "2", "--symmetry", "off"];
        let words = [&["reconstruct", &scene, "-o", &out], &quick[..], &["--json"], holdout].concat();
        words.into_iter().map(ToOwned::to_owned).collect::<Vec<_>>()
    };
    let run = |holdout: &[&'static str]| freerange(&args(holdout).iter().map(String::as_str).collect::<Vec<_>>());
    let done = run(&["--holdout", "001,003.png"]);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let report: Value = serde_json::from_slice(&done.stdout).unwrap();
    // What it was made by can be traced.
    assert_eq!((&report["device"], &report["version"]), (&"cpu".into(), &env!("CARGO_PKG_VERSION").into()));
    assert!(report["commit"].is_string() && report["settings_schema"].is_number());
    assert_eq!(report["checkpoint_sha256"].as_str().map(str::len), Some(64));
    assert_eq!(report["held_out"], serde_json::json!(["001", "003"]));
    assert_eq!(report["network_views"], serde_json::json!(["000", "002"]));
    // The scene's own four further views, and these two; which are not among the inputs.
    let sample = &report["samples"][0];
    assert_eq!(sample["further_views"]["views"].as_array().unwrap().len(), 6);
    assert_eq!(sample["input_views"]["views"].as_array().unwrap().len(), 2);
    assert!(!out.join("inputs/001.png").exists() && out.join("inputs/000.png").exists());
    let done = run(&["--holdout-every", "3"]);
    let report: Value = serde_json::from_slice(&done.stdout).unwrap();
    assert_eq!(report["held_out"], serde_json::json!(["000", "003"]));
    let done = run(&["--holdout", "000,001,002"]);
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(done.status.code() == Some(2) && said.contains("at most 2 of 4 photos held out, found 3"), "{said}");
}
