//! Jobs of many clients through two kills in the middle: nothing that was told to be done is lost, and memory stays flat. Not run by default;
//! `SOAK_JOBS` says how many jobs:
//!
//!     SOAK_JOBS=400 cargo test -p freerange-serve --release --test kill -- --ignored --nocapture many

mod common;

use std::{
    collections::{BTreeMap, BTreeSet},
    env, fs,
    io::{BufRead, BufReader, Read, Write},
    net::{SocketAddr, TcpStream},
    process::{Child, Command, Stdio},
    sync::{
        Arc, Mutex,
        atomic::{AtomicUsize, Ordering::SeqCst},
    },
    thread,
    time::{Duration, Instant},
};

use common::*;
use freerange_serve::{Limits, ServeConfig, Server};

/// The server that is killed: this program, started once more.
#[test]
#[ignore = "the other half of many_jobs_survive_two_kills"]
fn server() {
    let (Ok(keep), Ok(port)) = (env::var("SOAK_KEEP"), env::var("SOAK_PORT")) else { return };
    let limits = Limits { open_jobs: 64, finished_jobs: 10_000, side: 128, file_bytes: 2 << 20, ..Limits::default() };
    let config = ServeConfig {
        keep: Some(keep.into()),
        port: port.parse().unwrap(),
        example: Some(EXAMPLE),
        limits,
        ..ServeConfig::default()
    };
    let engine = Arc::new(Fake { pause: Duration::from_millis(1), steps: 10, ..Fake::default() });
    let server = Server::bind(&config, engine).unwrap();
    println!("\nlistening {}", server.address());
    server.run().unwrap();
}

fn start(keep: &std::path::Path, port: u16) -> (Child, SocketAddr) {
    let mut child = Command::new(env::current_exe().unwrap())
        .args(["--ignored", "--exact", "server", "--nocapture"])
        .env("SOAK_KEEP", keep)
        .env("SOAK_PORT", port.to_string())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let address = lines.find_map(|line| line.unwrap().strip_prefix("listening ").map(|a| a.parse().unwrap())).unwrap();
    // What it still says is nobody's business, but somebody has to read it.
    thread::spawn(move || lines.for_each(drop));
    (child, address)
}

/// One request; none where the server is not there.
fn ask(address: SocketAddr, method: &str, path: &str, kind: &str, body: &[u8]) -> Option<(u16, serde_json::Value)> {
    let mut stream = TcpStream::connect(address).ok()?;
    let head = format!(
        "{method} {path} HTTP/1.1\r\nHost: {address}\r\nContent-Type: {kind}\r\nContent-Length: {}\r\n\r\n",
        body.len()
    );
    stream.write_all(head.as_bytes()).ok()?;
    let _ = stream.write_all(body);
    let mut bytes = Vec::new();
    let _ = stream.read_to_end(&mut bytes);
    let end = bytes.windows(4).position(|w| w == b"\r\n\r\n")?;
    let status = std::str::from_utf8(&bytes[9..12]).ok()?.parse().ok()?;
    Some((status, serde_json::from_slice(&bytes[end + 4..]).unwrap_or_default()))
}

fn resident(pid: u32) -> Option<u64> {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmRSS:"))?;
    line.trim().trim_end_matches(" kB").parse::<u64>().ok().map(|kb| kb >> 10)
}

fn descriptors(pid: u32) -> Option<usize> {
    fs::read_dir(format!("/proc/{pid}/fd")).ok().map(Iterator::count)
}

#[test]
#[ignore = "minutes"]
fn many_jobs_survive_two_kills() {
    let jobs: usize = env::var("SOAK_JOBS").map_or(60, |n| n.parse().unwrap());
    let keep = tempfile::tempdir().unwrap();
    let (child, address) = start(keep.path(), 0);
    let child = Mutex::new(child);
    let (next, ended) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let done: Mutex<BTreeSet<String>> = Mutex::default();
    let memory: Mutex<Vec<(u64, u64)>> = Mutex::default();
    // What each hostile input was answered, and how often.
    let answers: Mutex<BTreeMap<(&str, u16), usize>> = Mutex::default();
    let kind = format!("multipart/form-data; boundary={BOUNDARY}");
    let begin = Instant::now();
    let client = || {
        loop {
            let n = next.fetch_add(1, SeqCst);
            if n >= jobs {
                return;
            }
            let mut cut = folder("x/");
            cut[3].bytes.truncate(10_000);
            let parts = match n % 3 {
                0 | 1 => vec![Part::field("example", "bowl"), Part::field("go", "{}")],
                _ => [cut, vec![Part::file("a.png", bomb(60_000, 60_000))], vec![Part::file("../a.png", "x")]]
                    [n / 3 % 3]
                    .clone(),
            };
            let id = loop {
                match ask(address, "POST", "/jobs", &kind, &form(&parts)) {
                    Some((201, job)) => break job["id"].as_str().map(str::to_owned),
                    Some((429 | 503, _)) | None => thread::sleep(Duration::from_millis(50)),
                    Some((status, _)) => {
                        assert!(n % 3 == 2 && (400..500).contains(&status), "{status}");
                        let which = ["a cut photo", "a large image", "a path outside"][n / 3 % 3];
                        *answers.lock().unwrap().entry((which, status)).or_default() += 1;
                        break None;
                    }
                }
            };
            if let Some(id) = id {
                if n % 3 == 1 {
                    thread::sleep(Duration::from_millis(n as u64 % 40));
                    ask(address, "POST", &format!("/jobs/{id}/cancel"), "", b"");
                }
                let states = ["done", "failed", "cancelled", "interrupted", "ready"];
                let state = loop {
                    let told = ask(address, "GET", &format!("/jobs/{id}"), "", b"");
                    match told.and_then(|(_, job)| job["state"].as_str().map(str::to_owned)) {
                        Some(state) if states.contains(&&*state) => break state,
                        _ => thread::sleep(Duration::from_millis(20)),
                    }
                };
                if state == "done" {
                    done.lock().unwrap().insert(id);
                }
            }
            ended.fetch_add(1, SeqCst);
        }
    };
    thread::scope(|s| {
        (0..40).for_each(|_| drop(s.spawn(client)));
        let mut kills = 0;
        while ended.load(SeqCst) < jobs {
            if kills < 2 && ended.load(SeqCst) >= (kills + 1) * jobs / 3 {
                let mut child = child.lock().unwrap();
                child.kill().unwrap();
                child.wait().unwrap();
                *child = start(keep.path(), address.port()).0;
                kills += 1;
            }
            if let Some(mb) = resident(child.lock().unwrap().id()) {
                memory.lock().unwrap().push((begin.elapsed().as_secs(), mb));
            }
            thread::sleep(Duration::from_millis(500));
        }
        assert_eq!(kills, 2);
    });
    let (_, all) = ask(address, "GET", "/jobs", "", b"").unwrap();
    let all = all.as_array().unwrap();
    let state = |id: &str| all.iter().find(|j| j["id"] == id).map(|j| j["state"].as_str().unwrap().to_owned());
    let done = done.into_inner().unwrap();
    for id in &done {
        assert_eq!(state(id).as_deref(), Some("done"), "{id} is lost");
        assert_eq!(ask(address, "GET", &format!("/jobs/{id}/samples/0"), "", b"").unwrap().0, 200);
    }
    let busy = ["running", "queued", "reading"];
    let idle = |j: &serde_json::Value| !busy.contains(&j["state"].as_str().unwrap_or_default());
    assert!(all.iter().all(idle), "somebody still waits");
    assert!(files(keep.path()).iter().all(|f| !f.contains("upload")), "no upload is left");
    let memory = memory.into_inner().unwrap();
    let states = all.iter().fold(BTreeMap::<_, usize>::new(), |mut counts, j| {
        *counts.entry(j["state"].as_str().unwrap_or_default()).or_default() += 1;
        counts
    });
    println!("{} jobs, {} done, {:?}\nseconds and MB: {memory:?}", jobs, done.len(), begin.elapsed());
    println!("{states:?}\nhostile: {:?}", answers.into_inner().unwrap());
    // All clients have gone: what is open is the server's own.
    let open = descriptors(child.lock().unwrap().id());
    println!("{open:?} descriptors");
    assert!(open.is_none_or(|n| n < 40), "{open:?} descriptors");
    let most = memory.iter().map(|m| m.1).max().unwrap_or(0);
    assert!(most < 400, "{most} MB");
    let mut child = child.into_inner().unwrap();
    child.kill().unwrap();
    child.wait().unwrap();
}
