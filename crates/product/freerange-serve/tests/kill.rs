//! Jobs of many clients through two kills in the middle, and a disk that is full for a while: nothing that was told to be done is lost, jobs say why
//! they failed, and memory stays flat. Not run by default; `SOAK_JOBS` says how many jobs:
//!
//!     SOAK_JOBS=400 cargo test -p freerange-serve --release --test kill -- --ignored --nocapture many
//!
//! The disk is a tmpfs, which only root may mount. Without it, or with fewer than 200 jobs, that part is left out, with a message. With `SOAK_PLOT`
//! a plot of the memory is written there, an SVG file.

mod common;

use std::{
    collections::{BTreeMap, BTreeSet},
    env,
    fs::{self, File},
    io::{BufRead, BufReader, Read, Write},
    net::{SocketAddr, TcpStream},
    path::{Path, PathBuf},
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

fn start(keep: &Path, port: u16) -> (Child, SocketAddr) {
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

/// What jobs and answers say of a disk without room.
const FULL: &str = "the server's disk is full";

/// A file system of its own for the server's folder, in memory.
struct Disk(PathBuf);

impl Disk {
    /// None where mounting is not allowed.
    fn mount(at: &Path, megabytes: usize) -> Option<Self> {
        let size = format!("size={megabytes}m");
        let done = Command::new("mount").args(["-t", "tmpfs", "-o", &size, "freerange-soak"]).arg(at).output();
        let why = match done {
            Ok(done) if done.status.success() => return Some(Self(at.into())),
            Ok(done) => String::from_utf8_lossy(&done.stderr).trim().to_owned(),
            Err(e) => format!("mount: {e}"),
        };
        println!("LEFT OUT: a disk that fills up: {why}");
        None
    }

    /// Takes all room for a while; what is freed meanwhile, too.
    fn fill(&self, time: Duration) {
        let path = self.0.join("filler");
        let mut file = File::create(&path).unwrap();
        let (begin, mut bytes) = (Instant::now(), vec![0u8; 1 << 20]);
        while begin.elapsed() < time {
            if file.write_all(&bytes).is_err() {
                // Down to the last page; then until somebody frees one.
                match bytes.len() {
                    0..=4096 => thread::sleep(Duration::from_millis(1)),
                    more => bytes.truncate(more / 2),
                }
            }
        }
        drop(file);
        fs::remove_file(path).unwrap();
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        // At once, whoever still has files open there.
        Command::new("umount").arg("-l").arg(&self.0).status().ok();
    }
}

/// What the server's memory was, and what was done to it; times are in seconds.
#[derive(Default)]
struct Watched {
    /// Times and megabytes.
    memory: Vec<(f64, u64)>,
    kills: Vec<f64>,
    full: Option<[f64; 2]>,
}

impl Watched {
    /// What is looked at after the last kill: the memory of one process.
    fn last(&self) -> Vec<u64> {
        let from = self.kills.last().copied().unwrap_or(0.0);
        self.memory.iter().filter(|(t, _)| *t > from).map(|(_, mb)| *mb).collect()
    }

    /// The memory as a picture.
    fn svg(&self) -> String {
        let end = self.memory.last().map_or(1.0, |(t, _)| t.max(1.0));
        let most = self.memory.iter().map(|(_, mb)| *mb).max().unwrap_or(0).div_ceil(50).max(1) * 50;
        let x = |t: f64| 50.0 + 650.0 * t / end;
        let y = |mb: f64| 200.0 - 180.0 * mb / most as f64;
        let text = |x: f64, y: f64, anchor: &str, text: String| {
            format!("<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{text}</text>\n")
        };
        let mut svg = "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 720 240\" font-family=\"sans-serif\" font-size=\"12\">\n\
             <rect width=\"720\" height=\"240\" fill=\"#fff\"/>\n"
            .to_owned();
        if let Some([from, to]) = self.full {
            let width = x(to) - x(from);
            svg +=
                &format!("<rect x=\"{:.1}\" y=\"20\" width=\"{width:.1}\" height=\"180\" fill=\"#eee\"/>\n", x(from));
            svg += &text(x(from) + width / 2.0, 34.0, "middle", "disk full".into());
        }
        for kill in &self.kills {
            let at = x(*kill);
            svg += &format!("<path d=\"M{at:.1} 20V200\" stroke=\"#777\" stroke-dasharray=\"4\"/>\n");
            svg += &text(at, 14.0, "middle", "kill -9".into());
        }
        for mb in [0, most / 2, most] {
            svg += &format!("<path d=\"M50 {:.1}H700\" stroke=\"#ccc\"/>\n", y(mb as f64));
            svg += &text(45.0, y(mb as f64) + 4.0, "end", format!("{mb} MB"));
        }
        for part in 0..=4 {
            let t = end * f64::from(part) / 4.0;
            svg += &text(x(t), 216.0, "middle", format!("{t:.0} s"));
        }
        let points: String = self.memory.iter().map(|(t, mb)| format!("{:.1},{:.1} ", x(*t), y(*mb as f64))).collect();
        svg += &format!(
            "<polyline points=\"{}\" fill=\"none\" stroke=\"#1f5fae\" stroke-width=\"1.5\"/>\n",
            points.trim()
        );
        svg += &text(375.0, 234.0, "middle", "resident memory of the server".into());
        svg + "</svg>\n"
    }
}

/// The middle of some numbers.
fn median(mut values: Vec<u64>) -> u64 {
    values.sort_unstable();
    values.get(values.len() / 2).copied().unwrap_or(0)
}

#[test]
#[ignore = "minutes"]
fn many_jobs_survive_two_kills() {
    let jobs: usize = env::var("SOAK_JOBS").map_or(60, |n| n.parse().unwrap());
    let keep = tempfile::tempdir().unwrap();
    // A job of these small photos has less than a megabyte.
    let disk = match jobs {
        0..200 => {
            println!("LEFT OUT: a disk that fills up: expected 200 jobs or more, found {jobs}");
            None
        }
        _ => Disk::mount(keep.path(), 64 + jobs),
    };
    let (child, address) = start(keep.path(), 0);
    let child = Mutex::new(child);
    let (next, ended) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let done: Mutex<BTreeSet<String>> = Mutex::default();
    // What came of each hostile input, and how often: a status, or how its job ended.
    let answers: Mutex<BTreeMap<(&str, String), usize>> = Mutex::default();
    // Answers that the disk is full, and jobs that failed for it.
    let (refused, failed) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let kind = format!("multipart/form-data; boundary={BOUNDARY}");
    let (begin, mut watched) = (Instant::now(), Watched::default());
    let client = || {
        loop {
            let n = next.fetch_add(1, SeqCst);
            if n >= jobs {
                return;
            }
            let (what, parts) = match n % 3 {
                0 | 1 => ("", vec![Part::field("example", "bowl"), Part::field("go", "{}")]),
                _ => hostile(n / 3),
            };
            let count = |came: &str| *answers.lock().unwrap().entry((what, came.to_owned())).or_default() += 1;
            let id = loop {
                match ask(address, "POST", "/jobs", &kind, &form(&parts)) {
                    Some((201, job)) => break job["id"].as_str().map(str::to_owned),
                    Some((429 | 503, _)) | None => thread::sleep(Duration::from_millis(50)),
                    Some((507, told)) => {
                        assert_eq!(told["error"], FULL);
                        refused.fetch_add(1, SeqCst);
                        thread::sleep(Duration::from_millis(50));
                    }
                    Some((status, _)) => {
                        assert!(n % 3 == 2 && (400..500).contains(&status), "{status}");
                        count(&status.to_string());
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
                let job = loop {
                    match ask(address, "GET", &format!("/jobs/{id}"), "", b"") {
                        Some((_, job)) if job["state"].as_str().is_some_and(|s| states.contains(&s)) => break job,
                        _ => thread::sleep(Duration::from_millis(20)),
                    }
                };
                if n % 3 == 2 {
                    count(job["state"].as_str().unwrap());
                }
                if job["state"] == "failed" && job["error"] == FULL {
                    failed.fetch_add(1, SeqCst);
                } else {
                    assert!(job["state"] != "failed" || n % 3 == 2, "a good job failed: {job}");
                }
                if job["state"] == "done" {
                    done.lock().unwrap().insert(id);
                }
            }
            ended.fetch_add(1, SeqCst);
        }
    };
    thread::scope(|s| {
        (0..40).for_each(|_| drop(s.spawn(client)));
        let mut before = None;
        while ended.load(SeqCst) < jobs {
            if let (Some(disk), None) = (&disk, before)
                && ended.load(SeqCst) >= jobs / 2
            {
                let from = begin.elapsed().as_secs_f64();
                disk.fill(Duration::from_secs(3));
                watched.full = Some([from, begin.elapsed().as_secs_f64()]);
                before = Some(done.lock().unwrap().len());
            }
            let kills = watched.kills.len();
            if kills < 2 && ended.load(SeqCst) >= (kills + 1) * jobs / 3 {
                let mut child = child.lock().unwrap();
                child.kill().unwrap();
                child.wait().unwrap();
                watched.kills.push(begin.elapsed().as_secs_f64());
                *child = start(keep.path(), address.port()).0;
            }
            if let Some(mb) = resident(child.lock().unwrap().id()) {
                watched.memory.push((begin.elapsed().as_secs_f64(), mb));
            }
            thread::sleep(Duration::from_millis(500));
        }
        assert_eq!(watched.kills.len(), 2);
        if let Some(before) = before {
            let (refused, failed, after) = (refused.load(SeqCst), failed.load(SeqCst), done.lock().unwrap().len());
            println!(
                "a full disk: {refused} requests refused, {failed} jobs failed; {before} done before, {after} at the end"
            );
            assert!(refused + failed > 0 && after > before, "the disk was full, and jobs are done afterwards");
        }
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
    let states = all.iter().fold(BTreeMap::<_, usize>::new(), |mut counts, j| {
        *counts.entry(j["state"].as_str().unwrap_or_default()).or_default() += 1;
        counts
    });
    println!("{jobs} jobs, {} done, {:?}, {states:?}", done.len(), begin.elapsed());
    for ((what, came), count) in answers.into_inner().unwrap() {
        println!("{what}: {count} x {came}");
    }
    // All clients have gone: what is open is the server's own.
    let open = descriptors(child.lock().unwrap().id());
    println!("{open:?} descriptors");
    assert!(open.is_none_or(|n| n < 40), "{open:?} descriptors");
    let most = watched.memory.iter().map(|m| m.1).max().unwrap_or(0);
    let last = watched.last();
    let [early, late] = [0..last.len() / 2, last.len() / 2..last.len()].map(|half| median(last[half].to_vec()));
    println!("memory: at most {most} MB; after the last kill {early} MB, later {late} MB");
    if let Ok(path) = env::var("SOAK_PLOT") {
        fs::write(path, watched.svg()).unwrap();
    }
    assert!(most < 400, "{most} MB");
    assert!(late < early + 32, "memory grows: {early} MB, later {late} MB");
    let mut child = child.into_inner().unwrap();
    child.kill().unwrap();
    child.wait().unwrap();
}
