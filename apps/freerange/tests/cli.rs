//! The real binary on real files, good and broken.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

use tempfile::TempDir;

fn freerange(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_freerange")).args(args).output().unwrap()
}

fn root() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
}

fn example() -> PathBuf {
    root().join("examples/bowl")
}

/// A copy of the example scene that a test can break.
fn scene() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    copy(&example(), folder.path());
    folder
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

fn edit(scene: &TempDir, change: impl FnOnce(&mut serde_json::Value)) {
    let path = scene.path().join("transforms_train.json");
    let mut json = serde_json::from_str(&fs::read_to_string(&path).unwrap()).unwrap();
    change(&mut json);
    fs::write(path, serde_json::to_string(&json).unwrap()).unwrap();
}

/// Reconstructing `scene` must fail with exit code 2, say every one of `words`, and leave no output.
fn refused(scene: &Path, extra: &[&str], words: &[&str]) {
    let place = tempfile::tempdir().unwrap();
    let output = place.path().join("result");
    let mut args =
        vec!["reconstruct", scene.to_str().unwrap(), "-o", output.to_str().unwrap(), "--set", "refine.passes=1"];
    args.extend(["--iterations", "0", "--symmetry", "off"]);
    args.extend(extra);
    let done = freerange(&args);
    let message = String::from_utf8_lossy(&done.stderr).into_owned();
    assert_eq!(done.status.code(), Some(2), "{message}");
    for word in words {
        assert!(message.contains(word), "expected {word:?} in: {message}");
    }
    assert!(!message.contains("panicked"), "{message}");
    assert_eq!(fs::read_dir(place.path()).unwrap().count(), 0, "something was left behind");
}

#[test]
fn the_short_help_of_the_main_job_fits_a_screen() {
    let text = String::from_utf8(freerange(&["reconstruct", "-h"]).stdout).unwrap();
    let options = text.lines().filter(|line| line.trim_start().starts_with('-')).count();
    assert!(text.lines().count() <= 50 && options <= 16, "{} lines, {options} options", text.lines().count());
    assert!(text.contains("Examples") || text.contains("examples"), "{text}");
}

#[test]
fn help_and_version() {
    for args in [&["--help"][..], &["--version"], &["reconstruct", "--help"], &["data", "--help"], &["train", "--help"]]
    {
        let done = freerange(args);
        assert!(done.status.success());
        assert!(!done.stdout.is_empty());
    }
}

#[test]
fn reconstruct_writes_everything_and_its_cloud_can_be_rendered_from_the_users_cameras() {
    let place = tempfile::tempdir().unwrap();
    let output = place.path().join("result");
    let (scene, out) = (example(), output.to_str().unwrap().to_owned());
    let args = [
        "reconstruct",
        scene.to_str().unwrap(),
        "-o",
        &out,
        "--set",
        "refine.passes=3",
        "--iterations",
        "5",
        "--set",
        "optimize.max_resolution=256",
        "--json",
    ];
    let mut command = Command::new(env!("CARGO_BIN_EXE_freerange"));
    let done = command.args(args).env_remove("XDG_RUNTIME_DIR").output().unwrap();
    let said = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.success(), "{said}");
    // Without a graphics card nothing is asked of Vulkan, whose layers look for a display.
    assert!(Path::new("/dev/dri").exists() || !said.contains("XDG_RUNTIME_DIR"), "{said}");
    let report: serde_json::Value = serde_json::from_slice(&done.stdout).unwrap();
    for file in ["gaussians.ply", "turntable.gif", "report.json", "inputs"] {
        assert!(output.join(file).exists(), "{file}");
    }
    assert!(report["samples"][0]["further_views"]["psnr"].as_f64().unwrap() > 5.0);
    assert!(report["samples"][0]["before_optimization"]["input_views"]["psnr"].as_f64().is_some());
    assert!(report["seconds"].as_array().unwrap().len() >= 4);
    assert_eq!(report["gaussians"], 8192, "a lower resolution is fewer Gaussians");

    // What was exported, read back and rendered, is what was reported.
    let cameras = scene.join("transforms_test.json");
    let renders = place.path().join("renders");
    let done = freerange(&[
        "render",
        output.join("gaussians.ply").to_str().unwrap(),
        "--cameras",
        cameras.to_str().unwrap(),
        "-o",
        renders.to_str().unwrap(),
        "--depth",
        "--normals",
    ]);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let views = report["samples"][0]["further_views"]["views"].as_array().unwrap().clone();
    for view in views {
        let name = view["name"].as_str().unwrap().rsplit('/').next().unwrap().to_owned();
        let render = image::open(renders.join(format!("{name}.png"))).unwrap().to_rgba8();
        let folder = scene.join("test");
        let truth = image::open(folder.join(format!("{name}.png"))).unwrap().to_rgba8();
        let to_floats = |i: &image::RgbaImage| freerange_scene::camera::image_ops::composite(i, [1.0; 3]);
        let psnr = freerange_raster::metrics::psnr(&to_floats(&render), &to_floats(&truth)).unwrap();
        assert!((psnr - view["psnr"].as_f64().unwrap()).abs() < 0.05, "{name}: {psnr} against {}", view["psnr"]);
        surface_is_where_the_object_is(&renders, &name, &truth);
    }
}

/// Depth and normals of a render, against the photo from there: a surface where the photo has the object, facing it.
fn surface_is_where_the_object_is(renders: &Path, name: &str, truth: &image::RgbaImage) {
    let depth = fs::read(renders.join(format!("{name}_depth.npy"))).unwrap();
    assert_eq!(&depth[..8], b"\x93NUMPY\x01\x00");
    let start = 10 + usize::from(u16::from_le_bytes([depth[8], depth[9]]));
    let header = std::str::from_utf8(&depth[10..start]).unwrap();
    let (width, height) = truth.dimensions();
    assert!(start.is_multiple_of(64) && header.ends_with('\n'), "{header:?}");
    assert!(header.contains("'<f4'") && header.contains(&format!("({height}, {width})")), "{header}");
    let depth: Vec<f32> = depth[start..].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    let normals = image::open(renders.join(format!("{name}_normals.png"))).unwrap().to_rgba8();
    assert_eq!((depth.len(), normals.dimensions()), ((width * height) as usize, (width, height)));
    let (mut agree, mut facing, mut surface) = (0, 0, 0);
    for ((z, normal), pixel) in depth.iter().zip(normals.pixels()).zip(truth.pixels()) {
        agree += usize::from(z.is_finite() == (pixel[3] > 127));
        surface += usize::from(normal[3] == 255);
        facing += usize::from(normal[3] == 255 && normal[2] > 127);
        assert!(z.is_infinite() || *z > 0.0);
    }
    assert!(agree as f64 > 0.97 * depth.len() as f64, "{name}: {agree} of {}", depth.len());
    assert!(surface > 1000 && facing as f64 > 0.9 * surface as f64, "{name}: {facing} of {surface}");
}

#[test]
fn the_same_seed_gives_the_same_bytes() {
    let place = tempfile::tempdir().unwrap();
    let run = |name: &str, seed: &str| {
        let output = place.path().join(name);
        let (scene, out) = (example(), output.to_str().unwrap().to_owned());
        let done = freerange(&[
            "reconstruct",
            scene.to_str().unwrap(),
            "-o",
            &out,
            "--set",
            "refine.passes=2",
            "--iterations",
            "3",
            "--symmetry",
            "off",
            "--seed",
            seed,
        ]);
        assert!(done.status.success());
        fs::read(output.join("gaussians.ply")).unwrap()
    };
    assert_eq!(run("a", "7"), run("b", "7"));
    assert_ne!(run("a", "7"), run("c", "8"));
}

#[test]
fn resolutions_that_make_no_sense() {
    for size in ["0", "300", "4352"] {
        let set = format!("optimize.max_resolution={size}");
        let found = format!("found {size}");
        refused(&example(), &["--set", &set], &["optimize.max_resolution", "a multiple of 256, up to 4096", &found]);
    }
}

#[test]
fn missing_images() {
    let s = scene();
    let mut photos: Vec<PathBuf> =
        fs::read_dir(s.path().join("train")).unwrap().map(|entry| entry.unwrap().path()).collect();
    photos.sort();
    fs::remove_file(&photos[0]).unwrap();
    // One is left out, and said to be.
    let output = s.path().join("out");
    let (scene, output) = (s.path().to_str().unwrap(), output.to_str().unwrap());
    let quick = ["--set", "refine.passes=1", "--iterations", "0", "--symmetry", "off"];
    let done = freerange(&[&["reconstruct", scene, "-o", output][..], &quick].concat());
    let message = String::from_utf8_lossy(&done.stderr).into_owned();
    assert_eq!(done.status.code(), Some(0), "{message}");
    let name = photos[0].file_stem().unwrap().to_str().unwrap();
    assert!(message.contains("1 of 4 photos") && message.contains(name), "{message}");
    // Of one photo alone nothing can be made.
    photos[1..3].iter().for_each(|photo| fs::remove_file(photo).unwrap());
    refused(s.path(), &[], &["transforms_train.json"]);
}

#[test]
fn image_size_differs_from_the_intrinsics() {
    let s = scene();
    edit(&s, |json| {
        json["w"] = 640.into();
        json["h"] = 480.into();
    });
    refused(s.path(), &[], &["640", "512"]);
}

#[test]
fn one_view_only() {
    let s = scene();
    edit(&s, |json| json["frames"].as_array_mut().unwrap().truncate(1));
    refused(s.path(), &[], &["transforms_train.json", "1"]);
}

#[test]
fn all_cameras_identical() {
    let s = scene();
    edit(&s, |json| {
        let pose = json["frames"][0]["transform_matrix"].clone();
        json["frames"].as_array_mut().unwrap().iter_mut().for_each(|f| f["transform_matrix"] = pose.clone());
    });
    refused(s.path(), &[], &["transforms_train.json"]);
}

#[test]
fn a_pose_that_is_no_rigid_transform() {
    let s = scene();
    edit(&s, |json| json["frames"][1]["transform_matrix"][0][0] = 3.0.into());
    refused(s.path(), &[], &["frame 1", "transform_matrix"]);
}

#[test]
fn nan_in_the_json() {
    let s = scene();
    let path = s.path().join("transforms_train.json");
    let text = fs::read_to_string(&path).unwrap().replacen("\"camera_angle_x\":", "\"camera_angle_x\": NaN, \"x\":", 1);
    fs::write(path, text).unwrap();
    refused(s.path(), &[], &["transforms_train.json"]);
}

#[test]
fn truncated_png() {
    let s = scene();
    let first = fs::read_dir(s.path().join("train")).unwrap().next().unwrap().unwrap().path();
    let bytes = fs::read(&first).unwrap();
    fs::write(&first, &bytes[..bytes.len() / 2]).unwrap();
    refused(s.path(), &[], &[first.file_name().unwrap().to_str().unwrap()]);
}

#[test]
fn truncated_or_foreign_checkpoint() {
    let s = scene();
    let place = tempfile::tempdir().unwrap();
    let shipped = fs::read(root().join("checkpoints/tiny.safetensors")).unwrap();
    let cut = place.path().join("cut.safetensors");
    fs::write(&cut, &shipped[..shipped.len() / 2]).unwrap();
    refused(s.path(), &["--checkpoint", cut.to_str().unwrap()], &["cut.safetensors"]);
    // A safetensors file that holds something else.
    let foreign = root().join("tests/golden/dit/pieces.safetensors");
    refused(s.path(), &["--checkpoint", foreign.to_str().unwrap()], &["pieces.safetensors"]);
    let missing = place.path().join("nowhere.safetensors");
    refused(s.path(), &["--checkpoint", missing.to_str().unwrap()], &["nowhere.safetensors"]);
}

#[test]
fn a_ply_with_a_lying_element_count() {
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("liar.ply");
    let properties = [
        "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1",
        "rot_2", "rot_3",
    ];
    let mut text = "ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\n".to_owned();
    properties.iter().for_each(|p| text += &format!("property float {p}\n"));
    text += "end_header\n";
    fs::write(&file, text).unwrap();
    let output = place.path().join("renders");
    let cameras = example().join("transforms_test.json");
    let done = freerange(&[
        "render",
        file.to_str().unwrap(),
        "--cameras",
        cameras.to_str().unwrap(),
        "-o",
        output.to_str().unwrap(),
    ]);
    let message = String::from_utf8_lossy(&done.stderr).into_owned();
    assert_eq!(done.status.code(), Some(2), "{message}");
    assert!(message.contains("liar.ply"), "{message}");
    assert!(!output.exists());
}

#[test]
fn bad_numbers_on_the_command_line() {
    let s = scene();
    refused(s.path(), &["--set", "propose.flow.cfg_scale=-2"], &["propose.flow.cfg_scale"]);
    refused(s.path(), &["--set", "propose.flow.lambda_pg=nan"], &["propose.flow.lambda_pg", "nan"]);
    refused(Path::new("no/such/scene"), &[], &["no/such/scene"]);
    // Options are looked at before photos are.
    refused(Path::new("no/such/scene"), &["--set", "propose.count=99"], &["propose.count"]);
    refused(Path::new("no/such/scene"), &["--set", "propose.cnt=2"], &["propose.cnt", "propose.count"]);
    refused(Path::new("no/such/scene"), &["--set", "count"], &["KEY=VALUE"]);
    // One proposal alone is used where nothing is optimized.
    refused(Path::new("no/such/scene"), &["--set", "propose.count=2"], &["propose.count", "optimization"]);
    for (options, field, with) in [
        (&["--set", "propose.flow.cfg_scale=1.5"][..], "propose.flow.cfg_scale", "propose.init: flow"),
        (&["--set", "symmetry.reflection_threshold=1"], "reflection_threshold", "detect: auto"),
        (&["--set", "optimize.max_resolution=256"], "optimize.max_resolution", "optimize.iterations"),
        (&["--set", "propose.count=1", "--init", "x.ply"], "propose.count", "Gaussians"),
    ] {
        refused(Path::new("no/such/scene"), options, &[field, "no effect", with]);
    }
    for options in
        [&["--spz-version", "2", "no.ply", "no.splat"][..], &["--spz-version", "2", "--mesh", "no.ply", "no.glb"]]
    {
        let done = freerange(&[&["convert"], options].concat());
        let message = String::from_utf8_lossy(&done.stderr).into_owned();
        assert!(done.status.code() == Some(2) && message.contains("--spz-version"), "{options:?}: {message}");
    }
    let done = freerange(&["train", "tiny", "-o", "no/such/run", "--save-every", "0"]);
    let message = String::from_utf8_lossy(&done.stderr).into_owned();
    assert_eq!(done.status.code(), Some(2), "{message}");
    assert!(message.contains("--save-every") && !message.contains("panicked"), "{message}");
}

/// Asked to end in the middle of its work, it leaves nothing behind, and what was there before.
#[test]
#[cfg(unix)]
fn an_interrupted_result_leaves_nothing() {
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("out");
    std::fs::create_dir(&out).unwrap();
    ["gaussians.ply", "report.json"].iter().for_each(|name| std::fs::write(out.join(name), "old").unwrap());
    let mut child = Command::new(env!("CARGO_BIN_EXE_freerange"))
        .args(["reconstruct".as_ref(), example().as_os_str(), "-o".as_ref(), out.as_os_str()])
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    let names = || -> Vec<String> {
        let entries = std::fs::read_dir(place.path()).unwrap();
        entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect()
    };
    let begin = std::time::Instant::now();
    while names().len() < 2 {
        assert!(begin.elapsed().as_secs() < 120 && child.try_wait().unwrap().is_none(), "it does not begin");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    let asked = Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(asked.success());
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert_eq!(names(), ["out"]);
    ["gaussians.ply", "report.json"].iter().for_each(|name| assert_eq!(std::fs::read(out.join(name)).unwrap(), b"old"));
}

/// A limit on the size of files stands for a disk that fills up: the write fails in the middle of gaussians.ply.
#[test]
#[cfg(unix)]
fn a_full_disk() {
    let place = tempfile::tempdir().unwrap();
    let output = place.path().join("result");
    let done = Command::new("sh")
        .args(["-c", "trap '' XFSZ; ulimit -f 8; exec \"$0\" \"$@\"", env!("CARGO_BIN_EXE_freerange"), "reconstruct"])
        .args([
            example().as_os_str(),
            "-o".as_ref(),
            output.as_os_str(),
            "--set".as_ref(),
            "refine.passes=1".as_ref(),
            "--iterations".as_ref(),
            "0".as_ref(),
            "--symmetry".as_ref(),
            "off".as_ref(),
        ])
        .output()
        .unwrap();
    let message = String::from_utf8_lossy(&done.stderr).into_owned();
    assert_eq!(done.status.code(), Some(1), "the input was good: {message}");
    assert!(message.contains("gaussians.ply") && message.matches("large").count() == 1, "{message}");
    assert_eq!(fs::read_dir(place.path()).unwrap().count(), 0, "something was left behind");
}

#[test]
fn checkpoints_are_averaged_weight_by_weight() {
    let folder = tempfile::tempdir().unwrap();
    let place = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let shipped = root().join("checkpoints/tiny.safetensors").to_str().unwrap().to_owned();
    let weights = |path: &str| {
        let bytes = std::fs::read(path).unwrap();
        let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        bytes[8 + length..].to_vec()
    };
    let mut bytes = std::fs::read(&shipped).unwrap();
    let start = bytes.len() - weights(&shipped).len();
    let depth = bytes[..start].windows(12).position(|w| w == b"\"depth\":\"11\"").expect("2,048 Gaussians");
    bytes[depth + 10] = b'2';
    std::fs::write(place("deeper"), &bytes).unwrap();
    bytes[depth + 10] = b'1';
    bytes[start..].chunks_exact_mut(2).for_each(|weight| weight[1] ^= 0x80); // the sign of each
    std::fs::write(place("opposite"), &bytes).unwrap();

    let average = |inputs: &[&str], output: &str| {
        let done = freerange(&[&["model", "average", "-o", output], inputs].concat());
        (done.status.code(), String::from_utf8_lossy(&done.stderr).into_owned())
    };
    let (nothing, same, small) = (place("nothing"), place("same"), place("small"));
    assert_eq!(average(&[&shipped, &place("opposite")], &nothing).0, Some(0));
    assert!(weights(&nothing).iter().all(|&byte| byte == 0));
    assert_eq!(average(&[&shipped, &shipped], &same).0, Some(0));
    assert!(freerange(&["model", "shrink", &same, &small]).status.success());
    assert!(weights(&small) == weights(&shipped));
    let (code, message) = average(&[&shipped, &place("deeper")], &place("none"));
    assert!(code == Some(2) && message.contains("deeper") && message.contains("depth"), "{code:?} {message}");
    assert!(!folder.path().join("none").exists());
}

#[test]
fn a_checkpoint_can_be_told_how_to_sample() {
    let folder = tempfile::tempdir().unwrap();
    let (config, output) = (folder.path().join("other.toml"), folder.path().join("other.safetensors"));
    let shipped = root().join("checkpoints/tiny.safetensors");
    std::fs::write(&config, "parent = \"tiny\"\nsample.steps = 7\n").unwrap();
    let [shipped, config, output] = [&shipped, &config, &output].map(|p| p.to_str().unwrap());
    let done = freerange(&["model", "shrink", shipped, output, "--sampling", config]);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let read = |path: &str| {
        let bytes = std::fs::read(path).unwrap();
        let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        let header: serde_json::Value = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
        let provenance = header["__metadata__"]["provenance"].as_str().unwrap();
        (serde_json::from_str::<serde_json::Value>(provenance).unwrap(), bytes[8 + length..].to_vec())
    };
    let ((mut old, weights), (mut new, same_weights)) = (read(shipped), read(output));
    assert_eq!(new["sample"]["steps"], 7);
    assert_ne!(old["sample"]["steps"], 7);
    assert!(new["settings_schema"].is_number());
    for provenance in [&mut old, &mut new] {
        ["sample", "refiner", "network_views", "settings_schema"]
            .iter()
            .for_each(|field| drop(provenance[field].take()));
    }
    assert!(old == new && weights == same_weights, "nothing else changes");
}
