//! Many clients at once, a third of whose jobs are cancelled and a third hostile: nothing is lost, nothing leaks.

mod common;

use std::{
    collections::BTreeMap,
    fs,
    sync::{Arc, Mutex},
    thread,
    time::Duration,
};

use common::*;
use freerange_serve::{Limits, ServeConfig};

/// Descriptors and resident memory of this process.
fn resources() -> (usize, u64) {
    let files = fs::read_dir("/proc/self/fd").map_or(0, Iterator::count);
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmRSS:")).unwrap_or("0 kB");
    (files, line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() << 10)
}

#[test]
fn two_hundred_jobs_by_twenty_clients() {
    let keep = tempfile::tempdir().unwrap();
    let limits = Limits { file_bytes: 2 << 20, open_jobs: 64, finished_jobs: 1000, side: 128, ..Limits::default() };
    let config =
        ServeConfig { keep: Some(keep.path().into()), example: Some(EXAMPLE), limits, ..ServeConfig::default() };
    let server =
        Running::start(config, Arc::new(Fake { pause: Duration::from_millis(2), steps: 20, ..Fake::default() }));
    let got: Mutex<BTreeMap<String, BTreeMap<String, usize>>> = Mutex::default();
    let count =
        |what: &str, came: String| *got.lock().unwrap().entry(what.into()).or_default().entry(came).or_default() += 1;
    let client = |c: usize| {
        for j in 0..10 {
            let n = 10 * c + j;
            match n % 3 {
                0 => {
                    let id = server.example("{}");
                    count("good", server.until(&id, &["done", "failed"])["state"].as_str().unwrap().into());
                    assert_eq!(server.get(&format!("/jobs/{id}/samples/0.glb")).status, 200);
                }
                1 => {
                    let id = server.example("{}");
                    thread::sleep(Duration::from_millis(n as u64 % 40));
                    let reply = server.send("POST", &format!("/jobs/{id}/cancel"), "", b"");
                    let state = server.until(&id, &["cancelled", "done"])["state"].as_str().unwrap().to_owned();
                    assert!(reply.status == 200 && state == "cancelled" || reply.status == 409 && state == "done");
                    count("cancelled", state);
                }
                _ => {
                    let (what, parts) = hostile(n / 3);
                    let reply = server.post_form(&parts);
                    if reply.status == 201 {
                        let id = reply.json()["id"].as_str().unwrap().to_owned();
                        count(what, server.until(&id, &["failed", "ready"])["state"].as_str().unwrap().into());
                    } else {
                        count(what, reply.status.to_string());
                    }
                }
            }
        }
    };
    // The first clients make the memory that threads keep: as many at once as afterwards.
    thread::scope(|s| (0..10).for_each(|c| drop(s.spawn(move || client(c)))));
    let before = resources();
    thread::scope(|s| (10..20).for_each(|c| drop(s.spawn(move || client(c)))));
    thread::sleep(Duration::from_millis(300));
    let after = resources();

    let got = got.into_inner().unwrap();
    println!("{got:?}\ndescriptors {} to {}, memory {} to {} MiB", before.0, after.0, before.1 >> 20, after.1 >> 20);
    let sum = |what: &str| got[what].values().sum::<usize>();
    assert_eq!((sum("good"), got["good"]["done"], sum("cancelled")), (67, 67, 67));
    for (what, came) in [
        ("bomb", "413"),
        ("path", "422"),
        ("archive", "415"),
        ("no picture", "422"),
        ("cut picture", "failed"),
        ("nested JSON", "failed"),
        ("too large", "413"),
    ] {
        assert!(got[what].len() == 1 && got[what].contains_key(came), "{what}: {:?}", got[what]);
    }
    let jobs = server.json("/jobs");
    let states = |state: &str| jobs.as_array().unwrap().iter().filter(|j| j["state"] == state).count();
    let done = got["good"]["done"] + got["cancelled"].get("done").copied().unwrap_or(0);
    assert_eq!(states("done"), done, "nothing is lost");
    assert_eq!(states("running") + states("queued") + states("reading"), 0);
    assert!(files(keep.path()).iter().all(|f| !f.contains("upload")), "no upload is left");
    assert!(after.0 <= before.0 + 2, "descriptors: {} to {}", before.0, after.0);
    assert!(after.1 < before.1 + (64 << 20), "memory: {} to {} MiB", before.1 >> 20, after.1 >> 20);
}
