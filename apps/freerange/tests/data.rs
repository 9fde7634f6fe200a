//! The data engine, as its users run it.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

fn command(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_freerange"));
    command.args(args).stdin(Stdio::null());
    command
}

fn freerange(args: &[&str]) -> Output {
    command(args).output().unwrap()
}

/// Standard output of a run that must end well.
fn said(args: &[&str]) -> String {
    let done = freerange(args);
    let error = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(done.status.success(), "{args:?}: {error}");
    String::from_utf8(done.stdout).unwrap()
}

/// Standard error of a run that must end with exit code 2.
fn refused(args: &[&str]) -> String {
    let done = freerange(args);
    let error = String::from_utf8_lossy(&done.stderr).into_owned();
    assert_eq!(done.status.code(), Some(2), "{args:?}: {error}");
    assert!(!error.contains("panicked"), "{error}");
    error
}

/// Name and bytes of every file in a folder, but for locks.
fn contents(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut files = BTreeMap::new();
    let mut folders = vec![folder.to_path_buf()];
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            let name = path.strip_prefix(folder).unwrap().to_str().unwrap().to_owned();
            match path.is_dir() {
                true => folders.push(path),
                false if name.starts_with(".lock") => {}
                false => drop(files.insert(name, fs::read(&path).unwrap())),
            }
        }
    }
    files
}

/// Writes a square pyramid as an OBJ mesh.
fn write_pyramid(path: &Path) {
    let text = "v 1 0 1\nv -1 0 1\nv -1 0 -1\nv 1 0 -1\nv 0 1.5 0\nf 1 4 3 2\nf 1 5 4\nf 4 5 3\nf 3 5 2\nf 2 5 1\n";
    fs::write(path, text).unwrap();
}

/// A fast build: few views of few pixels, and no fit.
const FAST: [&str; 12] = [
    "--gaussians",
    "surface",
    "--views",
    "4",
    "--resolution",
    "32",
    "--depths",
    "3,6",
    "--min-psnr",
    "0",
    "--fits",
    "0",
];

fn with<'a>(first: &[&'a str], rest: &[&'a str]) -> Vec<&'a str> {
    [first, rest].concat()
}

/// Objects that a build has finished so far, in shards and in parts of shards to come.
fn objects_done(folder: &Path) -> usize {
    let names = |folder: &Path| -> Vec<String> {
        let entries = fs::read_dir(folder).into_iter().flatten();
        entries.map(|e| e.unwrap().file_name().into_string().unwrap()).filter(|n| n.ends_with(".json")).collect()
    };
    // A record is there before the parts of its objects go.
    (0..60usize.div_ceil(8))
        .map(|shard| match fs::read(folder.join(format!("shard-{shard:05}.json"))) {
            Ok(record) => {
                serde_json::from_slice::<serde_json::Value>(&record).unwrap()["objects"].as_array().unwrap().len()
            }
            Err(_) => names(&folder.join(format!("parts/shard-{shard:05}"))).len(),
        })
        .sum()
}

#[test]
fn two_shards_killed_ten_times_equal_one_run() {
    let [whole, killed] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let place = |folder: &tempfile::TempDir| folder.path().to_str().unwrap().to_owned();
    let (whole_path, killed_path) = (place(&whole), place(&killed));
    let make =
        ["data", "generate", "--objects", "60", "--objects-per-shard", "8", "--resolution", "96", "--workers", "1"];
    let make = with(&make, &["--views", "8", "--fits", "0", "--depths", "8,10", "--min-psnr", "0", "-o"]);
    said(&with(&make, &[&whole_path]));

    // However slow or busy the machine is: what is counted is objects, not time.
    let (mut random, mut kills) = (12345u64, 0);
    while kills < 10 && objects_done(killed.path()) < 50 {
        let share =
            |share| command(&with(&make, &[&killed_path, "--shard", share])).stderr(Stdio::null()).spawn().unwrap();
        let mut both = [share("0/2"), share("1/2")];
        // When they have done one to four objects more, of sixty, and are at some point of the next ones.
        random = random.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        let enough = objects_done(killed.path()) + 1 + (random >> 62) as usize;
        while objects_done(killed.path()) < enough {
            let ended = both.each_mut().map(|child| child.try_wait().unwrap());
            if let [Some(a), Some(b)] = ended {
                assert!(a.success() && b.success());
                break;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        std::thread::sleep(Duration::from_millis(random >> 32 & 15));
        for child in &mut both {
            child.kill().unwrap(); // SIGKILL where there are signals
            child.wait().unwrap();
        }
        kills += 1;
    }
    assert!(kills > 0);
    said(&with(&make, &[&killed_path, "--shard", "0/2"]));
    said(&with(&make, &[&killed_path, "--shard", "1/2"]));
    let (expected, found) = (contents(whole.path()), contents(killed.path()));
    assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    assert!(found == expected, "same names, other bytes");
    let report = said(&["data", "inspect", &killed_path, "--verify"]);
    assert!(report.contains("60 objects in 8 shards") && report.contains("complete"), "{report}");
    assert!(report.contains("checksums compared"), "{report}");
}

#[test]
fn meshes_become_shards_views_and_figures() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    fs::create_dir(folder.path().join("meshes")).unwrap();
    write_pyramid(&folder.path().join("meshes/a.obj"));
    write_pyramid(&folder.path().join("meshes/b.obj"));
    let (meshes, out) = (path("meshes"), path("out"));
    let build = with(&["data", "build", &meshes, "-o", &out, "--license", "MIT", "--keep-leaves"], &FAST);
    let report = said(&build);
    assert!(report.contains("2 objects made, 0 there already, 0 failed"), "{report}");
    assert!(report.contains("fit ") && report.contains("at depth 6") && report.contains("peak memory"), "{report}");
    assert!(said(&build).contains("0 objects made, 2 there already"));

    let sheet = path("sheet.png");
    let report: serde_json::Value =
        serde_json::from_str(&said(&["data", "inspect", &out, "--json", "--verify", "--sheet", &sheet])).unwrap();
    assert_eq!((&report["licenses"]["MIT"], &report["complete"]), (&2.into(), &true.into()));
    assert_eq!(image::open(&sheet).unwrap().width(), 2 * (6 * 34 + 2));

    // What was rendered can be read as a scene; a lone mesh needs no folder of its own.
    let (scene, one) = (path("scene"), path("meshes/a.obj"));
    said(&["data", "views", &one, "-o", &scene, "--views", "24", "--resolution", "40"]);
    for (file, views) in [("transforms.json", 24), ("transforms_full.json", 4), ("transforms_val.json", 12)] {
        let loaded = freerange_scene::camera::load_cameras(&folder.path().join("scene").join(file)).unwrap();
        assert_eq!(loaded.len(), views, "{file}");
    }
    let loaded = freerange_scene::camera::Scene::load(&folder.path().join("scene/transforms_full.json")).unwrap();
    assert!(loaded.inputs.iter().all(|v| v.image.pixels().any(|p| p.0[3] == 255)));

    let cost = said(&with(&["data", "estimate", &meshes, "--objects", "140000", "--json"], &FAST));
    let cost: serde_json::Value = serde_json::from_str(&cost).unwrap();
    let hours = cost["core_hours"].as_f64().unwrap();
    let seconds: f64 = cost["measured"]["seconds"].as_object().unwrap().values().map(|v| v.as_f64().unwrap()).sum();
    assert!((hours - seconds * 140000.0 / 3600.0).abs() < 1e-6 * hours, "{cost}");

    let quality = ["data", "quality", &meshes, "--counts", "16,64", "--leaves", "128", "--iterations", "20"];
    let table =
        said(&with(&quality, &["--views", "4", "--resolution", "32", "--slice-iterations", "3", "--objects", "1"]));
    assert!(table.contains("| fit 128 | fit 16 | slice 16 | optimized 16 | surface 16 | fit 64"), "{table}");

    let gallery = path("gallery.png");
    said(&["data", "gallery", "--objects", "3", "--columns", "3", "--tile", "24", "-o", &gallery]);
    assert_eq!(image::image_dimensions(&gallery).unwrap(), (72, 24));
}

/// The example for Slurm, as the tasks of an array run it.
#[cfg(unix)]
#[test]
fn the_job_array_makes_every_shard_once() {
    let folder = tempfile::tempdir().unwrap();
    let meshes = folder.path().join("meshes");
    fs::create_dir(&meshes).unwrap();
    for name in ["a.obj", "b.obj", "c.obj"] {
        write_pyramid(&meshes.join(name));
    }
    let binary = Path::new(env!("CARGO_BIN_EXE_freerange")).parent().unwrap();
    let path = std::env::join_paths(
        [binary.to_path_buf()].into_iter().chain(std::env::split_paths(&std::env::var_os("PATH").unwrap_or_default())),
    );
    let out = folder.path().join("out");
    for task in ["5", "6"] {
        let done = Command::new("bash")
            .arg(concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/cluster/slurm.sh"))
            .args([&meshes, &out])
            .args(FAST)
            .args(["--objects-per-shard", "1"])
            .env("PATH", path.as_ref().unwrap())
            .env("SLURM_CPUS_PER_TASK", "1")
            .env("SLURM_ARRAY_TASK_MIN", "5")
            .env("SLURM_ARRAY_TASK_COUNT", "2")
            .env("SLURM_ARRAY_TASK_ID", task)
            .output()
            .unwrap();
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    }
    let report = said(&["data", "inspect", out.to_str().unwrap(), "--verify"]);
    assert!(report.contains("3 objects in 3 shards") && report.contains("complete"), "{report}");
}

#[test]
fn a_list_of_meshes_with_broken_ones_is_worked_off() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write_pyramid(&root.join("good.obj"));
    let ply = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
               element face 1\nproperty list uchar int vertex_indices\nend_header\n";
    fs::write(root.join("nan.ply"), format!("{ply}0 0 0\nnan 0 0\n0 1 0\n3 0 1 2\n")).unwrap();
    fs::write(root.join("flat.ply"), format!("{ply}0 0 0\n0 0 0\n0 0 0\n3 0 1 2\n")).unwrap();
    fs::write(root.join("huge.ply"), ply.replace("vertex 3", "vertex 1000000000")).unwrap();
    fs::write(root.join("cut.glb"), b"glTF\x02\0\0\0\xff\xff\xff\0").unwrap();
    let names = ["good.obj", "nan.ply", "flat.ply", "huge.ply", "cut.glb", "missing.glb"];
    let lines: Vec<String> = names.iter().map(|n| format!("{{\"path\": \"{n}\", \"license\": \"CC0-1.0\"}}")).collect();
    fs::write(root.join("list.jsonl"), lines.join("\n")).unwrap();
    let (list, out) = (root.join("list.jsonl"), root.join("out"));
    let [list, out] = [list, out].map(|p| p.to_str().unwrap().to_owned());
    let report = said(&with(&["data", "build", &list, "-o", &out], &FAST));
    assert!(report.contains("1 objects made, 0 there already, 5 failed"), "{report}");
    for name in ["nan", "flat", "huge", "cut", "missing"] {
        let line = report.lines().find(|l| l.contains(&format!("failed: {name}:")));
        let line = line.unwrap_or_else(|| panic!("{name} in {report}"));
        assert!(line.contains(&format!("{name}.")) && !line.contains("fault in this program"), "{line}");
    }
    assert!(said(&["data", "inspect", &out]).contains("failed: 5"));
    let (cut, other) = (root.join("cut.glb"), format!("{out}2"));
    for _ in 0..2 {
        // The second time, too, though there is nothing left to try.
        let args = with(&["data", "build", cut.to_str().unwrap(), "-o", &other], &FAST);
        assert!(refused(&args).contains("no object could be made"));
    }
}

#[test]
fn mistakes_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let out = out.to_str().unwrap();
    let generate = ["data", "generate", "--objects", "2", "-o", out];
    assert!(refused(&with(&generate, &["--shard", "2/2"])).contains("i/n"));
    assert!(refused(&with(&generate, &["--config", "large"])).contains("large"));
    assert!(refused(&with(&generate, &["--views", "0"])).contains("object.views"));
    assert!(refused(&with(&generate, &["--depths", "9,8"])).contains("ascending"));
    assert!(refused(&["data", "build", folder.path().to_str().unwrap(), "-o", out]).contains("expected mesh files"));
    assert!(refused(&["data", "inspect", out]).contains("expected a folder of shards"));
    assert!(refused(&["data", "merge", out]).contains("expected a folder of shards"));
    assert!(!Path::new(out).exists(), "nothing was made");
    said(&with(&with(&generate, &["--objects-per-shard", "1", "--shard", "0/2"]), &FAST));
    assert!(refused(&["data", "merge", out]).contains("1 of 2 shards"));
    // More processes than shards: nothing to do is no failure.
    said(&with(&with(&generate, &["--objects-per-shard", "1", "--shard", "5/9"]), &FAST));
    assert!(refused(&with(&generate, &["--objects-per-shard", "1"])).contains("another configuration"));
}
