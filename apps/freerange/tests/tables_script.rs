//! `tools/tables.sh` with a program that does nothing but record its arguments.
#![cfg(unix)]

use std::{
    fs,
    os::unix::fs::PermissionsExt,
    path::Path,
    process::{Command, Output},
};

/// Writes what the commands of the script write. `eval paper-tables` lists the reports that it sees, and fails after the
/// first row if told to.
const STUB: &str = r#"#!/usr/bin/env bash
set -euo pipefail
echo "$*" >>"$CALLS"
out=
for ((i = 1; i <= $#; i++)); do
  if [ "${!i}" = -o ]; then j=$((i + 1)) && out=${!j}; fi
done
case "$1 $2" in
  "train "*) mkdir -p "$out" && echo '{"step":10}' >"$out/log.jsonl" && echo c >"$out/checkpoint.safetensors" ;;
  "model info") echo '{}' ;;
  "eval paper-tables")
    (cd "$3" && ls -d -- */*/report.json && cat -- */*/report.json) >>"$CALLS"
    if [ "${FAIL:-}" = "$(grep -c paper-tables "$CALLS")" ]; then exit 1; fi
    ;;
  "eval "*) [ ! -e "$out/report.json" ] && mkdir -p "$out" && echo new >"$out/report.json" && echo s >"$out/settings.json" ;;
esac
"#;

/// A checkout with the script, two rows that are kept, and the stub.
fn checkout(root: &Path) {
    let write = |path: &str, text: &str| {
        let path = root.join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    };
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tools/tables.sh");
    write("tools/tables.sh", &fs::read_to_string(script).unwrap());
    write("configs/tables/full.toml", "steps = 1250\n");
    for row in ["full", "no_flow_matching"] {
        write(&format!("docs/results/paper-tables/{row}/generated/report.json"), "kept\n");
    }
    write("docs/results/paper-tables/claims.json", "[]");
    write("stub", STUB);
    fs::set_permissions(root.join("stub"), fs::Permissions::from_mode(0o755)).unwrap();
}

fn tables(root: &Path, fail: &str, rows: &[&str]) -> (Output, String) {
    let _ = fs::remove_file(root.join("calls"));
    let done = Command::new("bash")
        .arg(root.join("tools/tables.sh"))
        .args([root.join("stub"), root.join("place")])
        .args(rows)
        .env("CALLS", root.join("calls"))
        .env("FAIL", fail)
        .env("FREERANGE_SHARED", root.join("nothing"))
        .env_remove("WEIGHTS")
        .output()
        .unwrap();
    let calls = fs::read_to_string(root.join("calls")).unwrap_or_default();
    (done, calls)
}

#[test]
fn rows_are_trained_and_evaluated_beside_those_that_are_kept() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    checkout(root);
    let (done, calls) = tables(root, "", &["no_flow_matching", "voxel_aligned"]);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let place = root.join("place").canonicalize().unwrap();
    let commands: Vec<&str> = calls.lines().filter(|line| line.contains(' ')).collect();
    let begins = [
        "data generate",
        "train ",
        "model info",
        "eval --pictures none --precision f32 --generated 100",
        "eval paper-tables",
    ];
    let again = &begins[1..];
    for (command, begin) in commands.iter().zip(begins.iter().chain(again)) {
        assert!(command.starts_with(begin), "{command}, not {begin}");
    }
    assert_eq!(commands.len(), begins.len() + again.len(), "{calls}");
    assert!(commands[1].contains(&format!("{}/configs/tables/no_flow_matching.toml", place.display())), "{calls}");
    // Full is the one that is kept; the others are those that were made now.
    let listed = "full/generated/report.json\nno_flow_matching/generated/report.json\n";
    assert!(calls.contains(&format!("{listed}kept\nnew\n")), "{calls}");
    assert!(calls.ends_with(&format!("{listed}voxel_aligned/generated/report.json\nkept\nnew\nnew\n")), "{calls}");
    assert!(place.join("tables/claims.json").is_file() && place.join("rows/voxel_aligned/log.jsonl").is_file());
    assert!(String::from_utf8_lossy(&done.stdout).contains("LEFT OUT: the 21 objects"));
}

#[test]
fn tables_that_fail_do_not_end_the_rows() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    checkout(root);
    let (done, calls) = tables(root, "1", &["full", "pipeline"]);
    assert_eq!(done.status.code(), Some(1), "{}", String::from_utf8_lossy(&done.stderr));
    assert!(String::from_utf8_lossy(&done.stdout).contains("FAILED: the tables after full"));
    assert_eq!(calls.matches("eval paper-tables").count(), 2, "{calls}");
    let shipped = calls.lines().rfind(|line| line.starts_with("eval --pictures")).unwrap();
    assert!(shipped.contains("rows/pipeline/generated") && !shipped.contains("--checkpoint"), "{shipped}");
}

#[test]
fn a_report_without_settings_begins_again() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    checkout(root);
    let copy = root.join("place/rows/full/generated");
    fs::create_dir_all(&copy).unwrap();
    fs::write(copy.join("report.json"), "copy\n").unwrap();
    let (done, _) = tables(root, "", &["full"]);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    assert_eq!(fs::read_to_string(copy.join("report.json")).unwrap(), "new\n");
    // With settings it is continued: the stub refuses what is done.
    let (done, calls) = tables(root, "", &["full"]);
    assert!(!done.status.success() && !calls.contains("paper-tables"), "{calls}");
}

#[test]
fn evaluations_at_test_time_are_of_half_of_the_objects() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    checkout(root);
    let (done, calls) = tables(root, "", &["test_time"]);
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let evaluations: Vec<&str> = calls.lines().filter(|line| line.starts_with("eval --pictures")).collect();
    assert!(evaluations.iter().all(|line| line.contains("--generated 50")), "{calls}");
    for part in ["no-cfg", "no-photometric", "inputs-2", "inputs-6", "inputs-9", "four-samples"] {
        let own = format!("rows/full/{part}/generated");
        assert_eq!(evaluations.iter().filter(|line| line.contains(&own)).count(), 1, "{part}: {calls}");
    }
}
