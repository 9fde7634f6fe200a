//! The paper's tables from made-up evaluations.

use std::{collections::BTreeMap, fs, path::Path};

use freerange_eval::{
    Environment, Features, Report, RunFolder,
    paper_tables::PaperTables,
    record::{Case, Measured, Outcome, Record, SampleScores, VggFeatures, ViewScores, ViewSet, means},
};
use serde_json::json;

const OBJECTS: usize = 12;
/// Numbers that a view has instead of VGG16's 512 features, where no network looks.
const WIDTH: usize = if cfg!(feature = "networks") { 512 } else { 2 };

/// An evaluation of so many objects, whose PSNR are `full` and `partial`, give or take what differs between objects, and whose features of unseen
/// views are off by `shift`.
fn evaluation(folder: &Path, objects: usize, [full, partial]: [f64; 2], inputs: usize, shift: f32) {
    let run = RunFolder::open(folder, &json!({}), false).unwrap();
    let mut records = Vec::new();
    for object in 0..objects {
        for (views, psnr) in [(ViewSet::Full, full), (ViewSet::Partial, partial)] {
            let case = Case { object: format!("o{object:02}"), views, inputs };
            let psnr = psnr + 0.02 * (object as f64 - 5.5);
            let values = BTreeMap::from([("psnr".to_owned(), psnr), ("ssim".to_owned(), psnr / 50.0)]);
            let views = ["a", "b"].map(|name| ViewScores { name: name.into(), values: values.clone() }).to_vec();
            let samples = vec![SampleScores { seed: 0, gaussians: 1024, views }];
            let truth = |view: usize| (0..WIDTH).map(move |k| ((object * 5 + view * 3 + k) % 7) as f32 * 0.1);
            let mut vgg: Vec<f32> = (0..2).flat_map(|view| truth(view).map(|x| x + shift)).collect();
            vgg.extend((0..2).flat_map(truth));
            let measured = Measured {
                metrics: means(&samples),
                seconds: 2.0,
                peak_memory_bytes: None,
                disagreement: None,
                image_size: [8, 8],
                inputs: vec!["a".into()],
                validation_sha256: "h".into(),
                samples,
                features: 0,
                vgg: Some(VggFeatures { count: vgg.len(), unseen: vec![true, false], samples: 1 }),
                picture: false,
                notes: Vec::new(),
                commit: "c".into(),
            };
            let record = Record { case, outcome: Outcome::Measured(Box::new(measured)) };
            run.write(&record, &Features { inception: Vec::new(), vgg }, None).unwrap();
            records.push(record);
        }
    }
    let nothing = BTreeMap::new();
    let report = Report::new("m".into(), json!({}), Environment::default(), nothing, vec![], records, &run).unwrap();
    run.write_json("report.json", &report).unwrap();
}

#[test]
fn rows_stand_beside_the_papers_numbers_and_claims_are_answered() {
    let place = tempfile::tempdir().unwrap();
    let row = |name: &str| place.path().join(name).join("scans");
    fs::create_dir_all(place.path().join("full")).unwrap();
    evaluation(&row("full"), OBJECTS, [25.0, 23.0], 4, 0.1);
    evaluation(&row("full/inputs-2"), OBJECTS / 2, [22.0, 20.0], 2, 0.1);
    evaluation(&row("full/no-cfg"), OBJECTS / 2, [24.8, 22.4], 4, 0.1);
    evaluation(&row("no_flow_matching"), OBJECTS, [25.5, 23.0], 4, 0.3);
    evaluation(&row("pixel_aligned"), OBJECTS + 2, [26.0, 21.0], 4, 0.1);
    let facts = json!({ "trainable": 7_433_756, "samples": 40_000, "training_seconds": 3600.0 });
    fs::write(place.path().join("full/model.json"), facts.to_string()).unwrap();

    let log: String = (1..=25).map(|step| format!("{{\"step\":{step}}}\n")).collect();
    fs::write(place.path().join("full/log.jsonl"), log).unwrap();

    let found = PaperTables::read(place.path(), 0).unwrap();
    let answers: Vec<(&str, &str)> = found.claims.iter().map(|c| (&c.claim[..9], c.answer())).collect();
    let mut expected = vec![("From one ", "yes"), ("Flow matc", "no"), ("Flow matc", "not decided")];
    if cfg!(feature = "networks") {
        expected.push(("One sampl", "yes"));
    }
    assert_eq!(answers, expected);
    let lost = found.claims[0].difference;
    assert!((lost.mean - 3.0).abs() < 1e-9 && lost.low <= lost.mean && lost.mean <= lost.high, "{lost:?}");
    assert!(found.missing.iter().any(|m| m == "Random patching") && !found.missing.iter().any(|m| m == "Full"));

    let missing = |row: &str| found.missing.iter().any(|m| m == row);
    assert!(missing("Full, 6 input views (test time)") && !missing("Full, 2 input views (test time)"));
    assert!(missing("every row on the 21 objects"));

    let text = found.markdown();
    for line in [
        "| Full | 7.43 M | 40000 | 1.00 | 1.0K | 2.00 | 12 | 25.00 |  |  |  | 12 | 23.00 |  |  |  |",
        "| No flow matching |  |  |  | 1.0K | 2.00 | 12 | 25.50 | +0.50 |",
        "| No classifier-free guidance (test time) | 7.43 M | 40000 | 1.00 | 1.0K | 2.00 | 6 | 24.74 | -0.20 |",
        "| No flow matching | 12 | +1.00 (+1.00 to +1.00) |  |  | 12 | +0.00 (+0.00 to +0.00) |  |  |",
        "| Pixel-aligned (GS-LRM) | 12 | +2.00 (+2.00 to +2.00) |  |  | 12 | -4.00 (-4.00 to -4.00) |  |  |",
        "| Pixel-aligned (GS-LRM) |  |  |  | 1.0K | 2.00 | 12 | 26.00 | +1.00 |",
        "| ReconViaGen (published) | 500K | 1030 | 18.29 | 90.42 | 102.3 |  |",
        "| Free-Range Gaussians (published) | 8K | 1030 | 31.49 | 95.13 | 77.25 |  |",
        "| **Full** | **1.0K** | **12** | **23.00** |  |  |  | **46.00** |  |",
        "on the 6 objects that all of these have",
        "| 2 | 21.94 | -3.00 | -3.00 to -3.00 | 28.22 | -3.27 |",
        "| 4 | 24.94 |  |  | 31.49 |  |",
        "| 6 |  |  |  | 32.04 | +0.55 |",
        "| GS-LRM (published) | 70K | 1030 | 27.57 | 72.20 | 16.11 | 34.13 |",
    ] {
        assert!(text.contains(line), "{line}\n{text}");
    }
    // One of two validation views is unseen.
    let unseen = if cfg!(feature = "networks") { "**12** |\n" } else { "|  |\n" };
    let ours = text.lines().find(|line| line.starts_with("| **Full** | **1.0K** | **12** |")).unwrap();
    assert!(format!("{ours}\n").ends_with(unseen), "{ours}");
    assert!(text.contains("-3.09") && text.contains("Not measured yet: "), "{text}");

    let kept = tempfile::tempdir().unwrap();
    found.keep(kept.path()).unwrap();
    let log = fs::read_to_string(kept.path().join("full/log.jsonl")).unwrap();
    assert_eq!(log, "{\"step\":10}\n{\"step\":20}\n");
    // Features of the one view of two that is unseen: of the render, and of the image.
    let file = "scans/objects/o00.partial.4.vgg.f32";
    let all = fs::read(place.path().join("full").join(file)).unwrap();
    let views: Vec<&[u8]> = all.chunks(4 * WIDTH).collect();
    let features = || fs::read(kept.path().join("full").join(file)).unwrap();
    assert!(features() == [views[0], views[2]].concat());
    // From what is kept alone. The claim is kept, too, for where features are not.
    fs::remove_dir_all(kept.path().join("no_flow_matching/scans/objects")).unwrap();
    let again = PaperTables::read(kept.path(), 0).unwrap();
    assert_eq!(again.markdown(), text);
    // Onto itself, which reads the kept features.
    let files =
        || (features(), ["full/log.jsonl", "full/scans/report.json"].map(|f| fs::read(kept.path().join(f)).unwrap()));
    let before = files();
    again.keep(kept.path()).unwrap();
    assert!(files() == before);
}

#[test]
fn rows_without_the_21_objects_are_named() {
    let place = tempfile::tempdir().unwrap();
    let row = |name: &str| place.path().join(name);
    for name in ["full/objects", "full/generated", "full/four-samples/generated", "no_curriculum/generated"] {
        evaluation(&row(name), 2, [20.0, 20.0], 4, 0.0);
    }
    let missing = PaperTables::read(place.path(), 0).unwrap().missing;
    assert_eq!(missing.last().unwrap(), "on the 21 objects No LoD curriculum");
    evaluation(&row("no_curriculum/objects"), 2, [20.0, 20.0], 4, 0.0);
    let missing = PaperTables::read(place.path(), 0).unwrap().missing;
    assert!(!missing.iter().any(|m| m.contains("21 objects")), "{missing:?}");
}

#[test]
fn without_the_parent_row_there_are_no_tables() {
    let place = tempfile::tempdir().unwrap();
    evaluation(&place.path().join("no_curriculum/scans"), OBJECTS, [20.0, 20.0], 4, 0.0);
    let error = PaperTables::read(place.path(), 0).unwrap_err().to_string();
    assert!(error.contains("full/SOURCE/report.json"), "{error}");
}
