//! Reports and comparisons from made-up records.

use std::collections::BTreeMap;

use freerange_eval::{
    Environment, EvalError, Report, RunFolder,
    compare::{compare, tables},
    document::{extremes, markdown},
    html::{Embed, html},
    record::{Case, Measured, Outcome, Record, SampleScores, ViewScores, ViewSet, means},
};
use serde_json::json;
use tempfile::TempDir;

fn measured(psnr: f64, hash: &str) -> Measured {
    let view = |d: f64| ViewScores { name: "v".into(), values: BTreeMap::from([("psnr".into(), psnr + d)]) };
    let samples = vec![SampleScores { seed: 0, gaussians: 1024, views: vec![view(-1.0), view(1.0)] }];
    Measured {
        metrics: means(&samples),
        seconds: 2.0,
        peak_memory_bytes: Some(1 << 20),
        disagreement: None,
        image_size: [8, 8],
        inputs: vec!["a".into()],
        validation_sha256: hash.into(),
        samples,
        features: 0,
        vgg: None,
        picture: false,
        notes: Vec::new(),
        commit: "abc".into(),
    }
}

fn record(object: &str, inputs: usize, psnr: f64, hash: &str) -> Record {
    let case = Case { object: object.into(), views: ViewSet::Full, inputs };
    Record { case, outcome: Outcome::Measured(Box::new(measured(psnr, hash))) }
}

fn report(records: Vec<Record>) -> (Report, RunFolder, TempDir) {
    let place = tempfile::tempdir().unwrap();
    let folder = RunFolder::open(&place.path().join("out"), &json!({}), false).unwrap();
    let environment = Environment { command: "freerange eval".into(), ..Environment::default() };
    let missing = BTreeMap::from([("fid".to_owned(), "run `freerange weights fetch fid`".to_owned())]);
    let settings = json!({ "source": "</script><script>alert(1)</script>" });
    let report = Report::new("model".into(), settings, environment, missing, vec![], records, &folder).unwrap();
    (report, folder, place)
}

#[test]
fn groups_add_up_what_was_measured_and_name_the_rest() {
    let mut records = vec![record("b", 4, 20.0, "h"), record("a", 4, 30.0, "h"), record("a", 2, 10.0, "h")];
    let case = |object: &str| Case { object: object.into(), views: ViewSet::Full, inputs: 4 };
    records.push(Record { case: case("c"), outcome: Outcome::Failed { reason: "c.ply: broken".into() } });
    records.push(Record { case: case("d"), outcome: Outcome::Skipped { reason: "too few".into() } });
    let (report, folder, place) = report(records);
    assert_eq!(report.groups.iter().map(|g| g.inputs).collect::<Vec<_>>(), [2, 4]);
    let group = &report.groups[1];
    assert_eq!((group.measured, group.failed, group.skipped, group.images), (2, 1, 1, 4));
    let psnr = group.metrics["psnr"];
    assert_eq!((psnr.interval.mean, psnr.least, psnr.median, psnr.most), (25.0, 20.0, 25.0, 30.0));
    assert_eq!((psnr.interval.low, psnr.interval.high), (20.0, 30.0));
    assert_eq!(report.environment.commits, ["abc"]);

    let text = markdown(&report);
    for part in
        ["c.ply: broken", "too few", "weights fetch fid", "25.00 (20.00 to 30.00)", "Free-Range Gaussians (published)"]
    {
        assert!(text.contains(part), "{part} in {text}");
    }
    // What is not computed never looks like a number.
    let row = text.lines().find(|l| l.contains("(4 inputs, 2 objects)")).unwrap();
    assert_eq!(row.matches("not computed").count(), 2, "{row}");

    folder.write_json("report.json", &report).unwrap();
    assert_eq!(Report::load(&place.path().join("out")).unwrap(), report);
    std::fs::write(place.path().join("old.json"), "{\"format\": 0}").unwrap();
    assert!(matches!(Report::load(&place.path().join("old.json")), Err(EvalError::File { .. })));
}

#[test]
fn the_worst_come_first_and_nobody_twice() {
    let (report, ..) = report((0..7).map(|i| record(&format!("o{i}"), 4, f64::from(i * 3 % 7), "h")).collect());
    let (worst, best) = extremes(&report, &report.groups[0]);
    let names = |list: &[(&Case, &Measured)]| list.iter().map(|(c, _)| c.object.clone()).collect::<Vec<_>>();
    assert_eq!(names(&worst), ["o0", "o5", "o3", "o1"]);
    assert_eq!(names(&best), ["o2", "o4", "o6"]);
}

#[test]
fn scene_names_and_settings_cannot_inject_html() {
    let name = "\"><img src=x onerror=alert(1)><script>alert('2')</script>";
    let (report, folder, _place) = report(vec![record(name, 4, 20.0, "h")]);
    for embed in [Embed::Extremes, Embed::All] {
        let page = html(&report, &folder, embed).unwrap();
        assert!(!page.contains("<script") && !page.contains("<img src=x"), "{page}");
        assert!(page.contains("&lt;script&gt;") && page.contains("default-src 'none'"));
    }
    let text = markdown(&report);
    let before_settings = text.split("```json").next().unwrap();
    assert!(!before_settings.contains("<script") && !before_settings.contains("<img"));
}

#[test]
fn differences_are_paired_by_object() {
    let a = report(vec![record("x", 4, 20.0, "h"), record("y", 4, 10.0, "i"), record("z", 4, 1.0, "j")]).0;
    let b = report(vec![record("x", 4, 21.0, "h"), record("y", 4, 13.0, "i"), record("w", 4, 99.0, "k")]).0;
    let found = compare(&a, &b, 0).unwrap();
    assert_eq!(found.len(), 1);
    let c = &found[0];
    assert_eq!((c.objects, &c.only_a[..], &c.only_b[..]), (2, &["z".to_owned()][..], &["w".to_owned()][..]));
    let psnr = &c.metrics[0];
    assert_eq!((psnr.a, psnr.b, psnr.better, psnr.worse, psnr.equal), (15.0, 17.0, 2, 0, 0));
    assert_eq!((psnr.difference.mean, psnr.difference.low, psnr.difference.high), (2.0, 1.0, 3.0));
    let seconds = c.metrics.iter().find(|m| m.metric == "seconds").unwrap();
    assert_eq!((seconds.difference.mean, seconds.equal), (0.0, 2));
    assert!(tables(&found)[0].markdown().contains("| PSNR dB | 15.00 | 17.00 | +2.00 | +1.00 to +3.00 | 2 | 0 | 0 |"));
}

#[test]
fn numbers_of_inputs_are_compared_where_each_report_has_one() {
    let a = report(vec![record("x", 2, 20.0, "h")]).0;
    let b = report(vec![record("x", 9, 22.0, "h")]).0;
    assert_eq!(compare(&a, &b, 0).unwrap()[0].inputs, [2, 9]);
    let both = report(vec![record("x", 4, 20.0, "h"), record("x", 6, 20.0, "h")]).0;
    assert!(matches!(compare(&a, &both, 0), Err(EvalError::Incomparable(_))));
}

#[test]
fn other_validation_images_are_refused_by_name() {
    let a = report(vec![record("mug", 4, 20.0, "h")]).0;
    let b = report(vec![record("mug", 4, 21.0, "other")]).0;
    let error = compare(&a, &b, 0).unwrap_err();
    assert!(matches!(error, EvalError::Incomparable(_)) && error.to_string().contains("mug"), "{error}");
    let c = report(vec![record("cup", 4, 21.0, "h")]).0;
    assert!(compare(&a, &c, 0).is_err());
}
