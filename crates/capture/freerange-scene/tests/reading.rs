//! What reading photos takes of memory, and that it can be stopped. One test: the peak is the process's.
#![cfg(target_os = "linux")]

use std::{
    fs,
    path::Path,
    sync::{Arc, atomic::AtomicBool},
    time::{Duration, Instant},
};

use freerange_scene::{KeepWhole, LoadConfig, MaskSource, SceneError, load, read::cameras};
use freerange_util::{Stop, Stopped};
use image::RgbaImage;
use serde_json::Value;

/// Copies of the bowl's four photos.
const COPIES: usize = 4;

/// The bowl before something white, with many photos.
fn scene(folder: &Path) {
    let bowl = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../examples/bowl"));
    let mut json: Value = serde_json::from_slice(&fs::read(bowl.join("transforms_train.json")).unwrap()).unwrap();
    let mut frames = Vec::new();
    for frame in json["frames"].as_array().unwrap() {
        let name = frame["file_path"].as_str().unwrap().trim_start_matches("./");
        let mut photo: RgbaImage = image::open(bowl.join(format!("{name}.png"))).unwrap().into_rgba8();
        for p in photo.pixels_mut() {
            (0..3)
                .for_each(|c| p[c] = ((u16::from(p[c]) * u16::from(p[3]) + 255 * (255 - u16::from(p[3]))) / 255) as u8);
            p[3] = 255;
        }
        for copy in 0..COPIES {
            let mut frame = frame.clone();
            let name = format!("{}-{copy}.png", name.replace('/', "-"));
            photo.save(folder.join(&name)).unwrap();
            frame["file_path"] = name.into();
            frames.push(frame);
        }
    }
    json["frames"] = frames.into();
    fs::write(folder.join("transforms.json"), json.to_string()).unwrap();
}

fn kilobytes(field: &str) -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|l| l.strip_prefix(field)).unwrap();
    line.trim_matches(|c: char| !c.is_ascii_digit()).parse().unwrap()
}

#[test]
fn reading_takes_what_was_foretold_and_ends_when_it_is_stopped() {
    let folder = tempfile::tempdir().unwrap();
    scene(folder.path());
    let found = cameras(folder.path(), None, None).unwrap();
    let config = |masks: MaskSource| LoadConfig {
        masks,
        whole: KeepWhole::Folder(folder.path().into()),
        ..LoadConfig::default()
    };
    let needed = |masks: MaskSource| {
        let Err(SceneError::Memory { photos, limit: 1, needed }) =
            load(&found, &LoadConfig { memory: 1 << 20, ..config(masks) })
        else {
            panic!("expected too little memory")
        };
        assert_eq!(photos, 4 * COPIES);
        needed
    };
    let (plain, estimated) = (needed(MaskSource::Plain), needed(MaskSource::Estimate));
    // 4 bytes for each of 512 x 512 pixels, and the files that are decoded at once; estimates take more.
    assert!((16..=210).contains(&plain) && estimated > plain, "{plain} {estimated}");

    fs::write("/proc/self/clear_refs", "5").unwrap();
    let before = kilobytes("VmRSS:");
    let begin = Instant::now();
    let loaded = load(&found, &config(MaskSource::Estimate)).unwrap();
    let took = begin.elapsed();
    let peak = (kilobytes("VmHWM:") - before) >> 10;
    println!("{estimated} MB foretold, {peak} MB at most, {took:?}");
    assert!(peak <= estimated, "{peak} MB of {estimated}");
    assert_eq!(loaded.whole.get(3).unwrap().dimensions(), (512, 512));

    // It ends soon after it is asked to, and at a deadline.
    let until = |stop: Stop| {
        let begin = Instant::now();
        let result = load(&found, &LoadConfig { stop, ..config(MaskSource::Estimate) });
        (result.map(|_| ()), begin.elapsed())
    };
    let (result, spent) = until(Stop::on(Arc::default(), Some(Instant::now() + took / 8)));
    assert!(matches!(result, Err(SceneError::Stopped(Stopped::Late))), "{result:?}");
    assert!(spent < 3 * took / 4, "{spent:?} of {took:?}");
    let flag = Arc::new(AtomicBool::new(true));
    let (result, spent) = until(Stop::on(flag, None));
    assert!(matches!(result, Err(SceneError::Stopped(Stopped::Cancelled))), "{result:?}");
    assert!(spent < took / 4 + Duration::from_millis(200), "{spent:?} of {took:?}");
}
