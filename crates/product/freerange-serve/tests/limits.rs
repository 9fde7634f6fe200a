//! What many clients at once may take of memory, time and disk, tried through real sockets.

mod common;

use std::{
    fs,
    io::{Read, Write},
    net::TcpStream,
    path::{Path, PathBuf},
    thread,
    time::{Duration, Instant},
};

use common::*;
use freerange_gaussians::{
    Splats,
    formats::{Format, WriteOptions, encode},
};
use freerange_serve::{Limits, ServeConfig};

fn with(limits: Limits) -> Running {
    Running::start(ServeConfig { example: Some(EXAMPLE), limits, ..ServeConfig::default() }, Fake::quick())
}

/// Many photos of the bowl before something white, without masks: finding those takes long.
fn slow_scene(copies: usize) -> Vec<Part> {
    let mut json: serde_json::Value = serde_json::from_slice(EXAMPLE.files[0].1).unwrap();
    let (mut frames, mut parts) = (Vec::new(), vec![Part::field("scene", r#"{"masks": "estimate"}"#)]);
    for (k, (_, bytes)) in EXAMPLE.files[1..].iter().enumerate() {
        let mut photo = image::load_from_memory(bytes).unwrap().into_rgba8();
        for p in photo.pixels_mut() {
            if p[3] < 128 {
                *p = image::Rgba([255; 4]);
            }
            p[3] = 255;
        }
        let bytes = png(&photo);
        for copy in 0..copies {
            let mut frame = json["frames"][k].clone();
            frame["file_path"] = format!("{k}-{copy}.png").into();
            frames.push(frame);
            parts.push(Part::file(&format!("slow/{k}-{copy}.png"), bytes.clone()));
        }
    }
    json["frames"] = frames.into();
    parts.push(Part::file("slow/transforms.json", json.to_string()));
    parts
}

fn posted(server: &Running, parts: &[Part]) -> String {
    let reply = server.post_form(parts);
    assert_eq!(reply.status, 201, "{}", reply.text());
    reply.json()["id"].as_str().unwrap().to_owned()
}

/// V1.
#[test]
fn photos_take_no_more_memory_than_they_may() {
    let server = with(Limits { memory: 6 << 20, ..Limits::default() });
    let id = posted(&server, &folder("x/"));
    let error = server.until(&id, &["failed", "ready"])["error"].as_str().unwrap_or_default().to_owned();
    // What is too much, how much it is, and what to do.
    for words in ["4 photos", "at most 6 MB of memory", "fewer photos", "smaller ones", "masks with them"] {
        assert!(error.contains(words), "{words}: {error}");
    }
    // Four photos of 512 x 512 pixels take 4 MB, and decoding them 16.
    let server = with(Limits { memory: 21 << 20, ..Limits::default() });
    let id = posted(&server, &folder("x/"));
    server.until(&id, &["ready"]);
    // Finding masks takes more.
    let id = posted(&server, &slow_scene(1));
    let error = server.until(&id, &["failed", "ready"])["error"].as_str().unwrap_or_default().to_owned();
    assert!(error.contains("at most 21 MB"), "{error}");
}

/// V1.
#[test]
fn large_results_on_their_way_take_no_more_memory_than_they_may() {
    let server = with(Limits { memory: 128 << 20, ..Limits::default() });
    let mut cloud = Fake::cloud(1, 1);
    let row = *cloud.row(0);
    (0..300_000).for_each(|_| cloud.push(&row));
    let ply = encode(&Splats::from(cloud), Format::Ply, &WriteOptions::default()).unwrap().bytes;
    let id = posted(&server, &[Part::file("large.ply", ply)]);
    let job = server.until(&id, &["done", "failed"]);
    assert_eq!(job["state"], "done", "{job}");
    let path = format!("/jobs/{id}/samples/0");
    // Somebody asks for it, and reads no more than its first byte.
    let mut slow = TcpStream::connect(server.address).unwrap();
    slow.write_all(format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n").as_bytes()).unwrap();
    slow.read_exact(&mut [0]).unwrap();
    for more in ["", "/whole", ".glb"] {
        let refused = server.get(&format!("{path}{more}"));
        assert!(refused.status == 503 && refused.error().contains("try again"), "{more}: {}", refused.status);
    }
    drop(slow);
    let begin = Instant::now();
    while server.get(&path).status != 200 {
        assert!(begin.elapsed() < Duration::from_secs(30), "its memory is never free again");
        thread::sleep(Duration::from_millis(20));
    }
}

/// V1.
#[test]
fn bodies_that_arrive_slowly_take_no_more_memory_than_they_may() {
    let server = with(Limits { memory: 8 << 20, ..Limits::default() });
    let job = |gaussians: usize| {
        let mut cloud = Fake::cloud(1, 1);
        let row = *cloud.row(0);
        (1..gaussians).for_each(|_| cloud.push(&row));
        let ply = encode(&Splats::from(cloud), Format::Ply, &WriteOptions::default()).unwrap().bytes;
        let id = posted(&server, &[Part::file("some.ply", ply)]);
        server.until(&id, &["done"]);
        id
    };
    // A result that needs more than what five of the eight MiB leave, and one that does not.
    let (id, large) = (job(1), format!("/jobs/{}/samples/0", job(10_000)));
    assert_eq!(server.get(&large).status, 200);
    let until = |status: u16, what: &str| {
        let begin = Instant::now();
        while server.get(&large).status != status {
            assert!(begin.elapsed() < Duration::from_secs(30), "{what}");
            thread::sleep(Duration::from_millis(20));
        }
    };
    let paths = [format!("/jobs/{id}/samples/0/kept"), format!("/jobs/{id}/masks/0")];
    for path in &paths {
        // What it is for has to be there before the first byte is read.
        assert_eq!(server.begun(&path.replace(&id, "0123456789abcdef"), 5 << 20).status, 404, "{path}");
        let (host, length) = (server.address, 5 << 20);
        let head = format!("PUT {path} HTTP/1.1\r\nHost: {host}\r\nContent-Length: {length}\r\n\r\n1");
        let begin = || {
            let mut slow = TcpStream::connect(server.address).unwrap();
            slow.write_all(head.as_bytes()).unwrap();
            slow.set_nonblocking(true).unwrap();
            slow
        };
        let (since, mut slow) = (Instant::now(), begin());
        while server.get(&large).status != 503 {
            assert!(since.elapsed() < Duration::from_secs(30), "its body is not counted");
            thread::sleep(Duration::from_millis(20));
            // The result that is asked for meanwhile may have had the memory first: an answer before the body has ended is a refusal.
            if slow.peek(&mut [0]).is_ok() {
                slow = begin();
            }
        }
        for other in &paths {
            assert_eq!(server.begun(other, 5 << 20).status, 503, "{other} beside {path}");
        }
        assert_eq!(server.get(&format!("/jobs/{id}/samples/0")).status, 200);
        drop(slow);
        until(200, "its memory is never free again");
    }
}

/// V2.
#[test]
fn reading_gaussians_has_a_limit_of_time() {
    let server = with(Limits { read_time: Duration::ZERO, ..Limits::default() });
    let ply = encode(&Splats::from(Fake::cloud(1, 1)), Format::Ply, &WriteOptions::default()).unwrap().bytes;
    let id = posted(&server, &[Part::file("small.ply", ply)]);
    let job = server.until(&id, &["failed", "done"]);
    assert!(job["error"].as_str().unwrap_or_default().contains("longer than 0 seconds"), "{job}");
}

/// V2.
#[test]
fn reading_has_a_limit_of_time() {
    let server = with(Limits { read_time: Duration::from_millis(700), memory: 64 << 30, ..Limits::default() });
    let begin = Instant::now();
    let job = {
        let id = posted(&server, &slow_scene(20));
        server.until(&id, &["failed", "ready"])
    };
    let error = job["error"].as_str().unwrap_or_default();
    assert!(error.contains("longer than 0.7 seconds") && error.contains("fewer"), "{job}");
    assert!(begin.elapsed() < Duration::from_secs(60), "{:?}", begin.elapsed());
}

/// V2.
#[test]
fn one_slow_job_is_not_in_the_others_way_and_cancelling_it_frees_whoever_reads() {
    for readers in [2, 1] {
        let server =
            with(Limits { readers, memory: 64 << 30, read_time: Duration::from_secs(3600), ..Limits::default() });
        let state = |id: &str| server.json(&format!("/jobs/{id}"))["state"].as_str().unwrap().to_owned();
        let slow = posted(&server, &slow_scene(20));
        let quick = posted(&server, &[Part::field("example", "bowl")]);
        if readers == 2 {
            server.until(&quick, &["ready"]);
            assert_eq!(state(&slow), "reading", "one is read beside the other");
        }
        thread::sleep(Duration::from_millis(200));
        assert_eq!((state(&slow).as_str(), readers), ("reading", readers), "this scene is read for longer");
        let begin = Instant::now();
        assert_eq!(server.send("POST", &format!("/jobs/{slow}/cancel"), "", b"").json()["state"], "cancelled");
        let next = posted(&server, &[Part::field("example", "bowl")]);
        server.until(&quick, &["ready"]);
        server.until(&next, &["ready"]);
        assert!(begin.elapsed() < Duration::from_secs(30), "its thread is free after {:?}", begin.elapsed());
        assert_eq!(state(&slow), "cancelled");
        assert_eq!(server.send("POST", &format!("/jobs/{slow}/go"), "", b"{}").status, 409);
    }
}

/// V4.
#[test]
fn no_answer_tells_where_files_are() {
    let place = tempfile::tempdir().unwrap();
    let real = place.path().canonicalize().unwrap().join("home-of-somebody");
    fs::create_dir_all(&real).unwrap();
    // The folder is reached through a link: paths that are followed have another beginning.
    let link = place.path().join("link");
    std::os::unix::fs::symlink(&real, &link).unwrap();
    let server = Running::start(ServeConfig { keep: Some(link), ..ServeConfig::default() }, Fake::quick());
    // A COLMAP model at the top of the dropped folder: its photos are looked for around it.
    let cameras = "1 PINHOLE 512 512 500 500 256 256\n";
    let images = "1 1 0 0 0 0 0 2 1 a.png\n\n2 1 0 0 0 1 0 2 1 b.png\n\n";
    let photo = EXAMPLE.files[1].1;
    let colmap = |prefix: &str| {
        let at = |name: &str| format!("{prefix}{name}");
        vec![
            Part::file(&at("cameras.txt"), cameras),
            Part::file(&at("images.txt"), images),
            Part::file(&at("x.png"), photo),
        ]
    };
    let mut cut = folder("x/");
    cut[2].bytes.truncate(30_000);
    let mut broken = folder("x/");
    broken[0].bytes = "{\"frames\": 3}".into();
    let nothing = vec![Part::file("a.txt", "x"), Part::file("b.png", photo)];
    let mut both = folder("x/");
    both.extend(colmap("x/sparse/0/"));
    for parts in [colmap("s/"), colmap(""), colmap("s/sparse/0/"), cut, broken, nothing, both] {
        let id = posted(&server, &parts);
        let job = server.until(&id, &["failed", "ready"]).to_string();
        for word in ["home-of-somebody", "link", "upload", "tmp", &id[..]] {
            let told = job.replace(&format!("\"id\":\"{id}\""), "");
            assert!(!told.contains(word), "{word}: {job}");
        }
        assert!(!job.contains(" --") && !job.contains("`freerange"), "the page has no options and no commands: {job}");
    }
    for path in ["/server", "/jobs", "/metrics"] {
        assert!(!server.get(path).text().contains("home-of-somebody"), "{path}");
    }
}

/// V5.
#[test]
fn json_is_bounded_before_it_becomes_values() {
    let server = with(Limits::default());
    let mut parts = folder("x/");
    parts[0].bytes = format!("{{\"frames\": [{}0]}}", "0,".repeat(1_000_000)).into();
    let reply = server.post_form(&parts);
    assert!(reply.status == 413 && reply.error().contains("at most 300000 values"), "{}", reply.text());
    parts[0].bytes = vec![b' '; (8 << 20) + 1];
    let reply = server.post_form(&parts);
    assert!(reply.status == 413 && reply.error().contains("at most 8388608 bytes"), "{}", reply.text());
}

/// V6.
#[test]
fn probes_have_places_of_their_own() {
    let server = with(Limits { connections: 4, ..Limits::default() });
    let idle: Vec<TcpStream> = (0..4).map(|_| TcpStream::connect(server.address).unwrap()).collect();
    thread::sleep(Duration::from_millis(100));
    assert_eq!(server.get("/jobs").status, 503, "all places are taken");
    assert_eq!(server.get("/health").status, 200);
    assert!(server.get("/metrics").text().contains("freerange_turned_away_total 1"));
    drop(idle);
}

/// V6.
#[test]
fn streams_of_events_end_and_leave_places_for_all_else() {
    let server = with(Limits { connections: 6, stream_time: Duration::from_millis(700), ..Limits::default() });
    let id = posted(&server, &[Part::field("example", "bowl")]);
    server.until(&id, &["ready"]);
    let open = || {
        let mut stream = TcpStream::connect(server.address).unwrap();
        stream.write_all(format!("GET /jobs/{id}/events HTTP/1.1\r\nHost: localhost\r\n\r\n").as_bytes()).unwrap();
        stream
    };
    let begin = Instant::now();
    let streams: Vec<TcpStream> = (0..4).map(|_| open()).collect();
    thread::sleep(Duration::from_millis(150));
    assert_eq!(Reply::read(open()).status, 503, "two thirds of the places may be streams");
    assert_eq!(server.get("/jobs").status, 200);
    for mut stream in streams {
        let mut text = String::new();
        stream.read_to_string(&mut text).unwrap();
        assert!(text.contains("event: job") && text.contains("retry: "), "{text}");
    }
    assert!(begin.elapsed() < Duration::from_secs(10), "{:?}", begin.elapsed());
    assert_eq!(server.get(&format!("/jobs/{id}")).status, 200);
}

/// Where a server without a folder of its own keeps a job.
fn temporary(id: &str) -> PathBuf {
    let all = fs::read_dir(std::env::temp_dir()).unwrap().map(|e| e.unwrap().path().join(id));
    all.into_iter().find(|path| path.is_dir()).unwrap()
}

/// V9.
#[test]
fn nobody_waits_while_a_large_job_is_deleted() {
    let server = with(Limits { finished_jobs: 1, ..Limits::default() });
    let old = server.example("{}");
    server.until(&old, &["done"]);
    let folder = temporary(&old);
    fs::create_dir(folder.join("many")).unwrap();
    for i in 0..60_000 {
        fs::File::create(folder.join(format!("many/{i}"))).unwrap();
    }
    let begin = Instant::now();
    // The new job takes the place of the old one.
    let reply = server.post_form(&[Part::field("example", "bowl")]);
    let posted = begin.elapsed();
    assert_eq!(reply.status, 201, "{}", reply.text());
    let mut longest = posted;
    while folder.exists() {
        let asked = Instant::now();
        assert_eq!(server.get("/jobs").status, 200);
        longest = longest.max(asked.elapsed());
        assert!(begin.elapsed() < Duration::from_secs(120), "it is never deleted");
    }
    let deleted = begin.elapsed();
    println!("deleted after {deleted:?}, longest answer {longest:?}");
    assert!(2 * longest < deleted, "an answer took {longest:?}, and deleting {deleted:?}");
}

/// V10.
#[test]
fn jobs_have_a_quota_on_disk() {
    let keep = tempfile::tempdir().unwrap();
    let limits = Limits { disk: 5 << 20, ..Limits::default() };
    let config = |keep: Option<PathBuf>| ServeConfig { keep, example: Some(EXAMPLE), limits, ..ServeConfig::default() };
    let server = Running::start(config(Some(keep.path().into())), Fake::quick());
    let mut last = (0, String::new());
    let mut ids = Vec::new();
    for _ in 0..12 {
        let reply = server.post_form(&folder("x/"));
        if reply.status != 201 {
            last = (reply.status, reply.error());
            break;
        }
        let id = reply.json()["id"].as_str().unwrap().to_owned();
        let job = server.until(&id, &["ready", "failed"]);
        if job["state"] == "failed" {
            last = (507, job["error"].as_str().unwrap().to_owned());
            break;
        }
        ids.push(id);
    }
    assert!(last.0 == 507 && last.1.contains("MB") && last.1.contains("remove some"), "{last:?}");
    assert!(!ids.is_empty());
    assert!(size(keep.path()) < 6 << 20, "{} bytes", size(keep.path()));
    assert!(server.get("/metrics").text().contains("freerange_disk_bytes "));
    // Removed jobs make way.
    for id in &ids {
        assert_eq!(server.send("DELETE", &format!("/jobs/{id}"), "", b"").status, 200);
    }
    for job in server.json("/jobs").as_array().unwrap() {
        server.send("DELETE", &format!("/jobs/{}", job["id"].as_str().unwrap()), "", b"");
    }
    let id = posted(&server, &folder("x/"));
    server.until(&id, &["ready"]);
    // Without a folder to keep them, the oldest finished jobs do.
    let server = Running::start(config(None), Fake::quick());
    let first = server.example("{}");
    server.until(&first, &["done"]);
    for _ in 0..6 {
        let id = server.example("{}");
        server.until(&id, &["done"]);
    }
    assert_eq!(server.get(&format!("/jobs/{first}")).status, 404);
}

fn size(folder: &Path) -> u64 {
    files(folder).iter().map(|f| fs::metadata(f).map_or(0, |m| m.len())).sum()
}

#[test]
fn parts_of_a_result_are_left_out_and_had_back() {
    let server = with(Limits::default());
    let id = server.example(r#"{"samples": 2}"#);
    server.until(&id, &["done"]);
    let (rows, kept) = (format!("/jobs/{id}/samples/1"), format!("/jobs/{id}/samples/1/kept"));
    let put = |bytes: &[u8]| server.send("PUT", &kept, "", bytes);
    let before = server.get(&rows).body;
    assert_eq!(server.get(&kept).body, [1; 40]);
    for (odd, words) in [
        (&[1; 39][..], "expected 40 bytes"),
        (&[2; 40][..], "each 0 or 1"),
        (&[0; 40][..], "found none"),
        (&[][..], "expected 40 bytes"),
    ] {
        let refused = put(odd);
        assert!(refused.status == 422 && refused.error().contains(words), "{}", refused.text());
    }
    let third: Vec<u8> = (0..40).map(|i| u8::from(i % 3 == 0)).collect();
    assert_eq!(put(&third).json()["gaussians"], 14);
    let after = server.get(&rows).body;
    assert!(after.len() == 14 * 56 && after[56..112] == before[3 * 56..4 * 56]);
    assert_eq!(server.get(&format!("/jobs/{id}/samples/1/whole")).body, before);
    assert_eq!(server.get(&kept).body, third);
    assert_eq!(server.json(&format!("/jobs/{id}"))["samples"][1]["gaussians"], 14);
    let splat = server.get(&format!("/jobs/{id}/samples/1.splat")).body;
    assert_eq!(splat.len(), 14 * 32, "files of all formats follow");
    assert_eq!(put(&[1; 40]).json()["gaussians"], 40);
    assert_eq!(server.get(&rows).body, before);
    // A new run makes new Gaussians.
    put(&third);
    server.send("POST", &format!("/jobs/{id}/go"), "", br#"{"samples": 2}"#);
    assert_eq!(server.until(&id, &["done"])["samples"][1]["gaussians"], 40);
    assert_eq!(server.get(&kept).body, [1; 40]);
    assert_eq!(server.send("PUT", &format!("/jobs/{id}/samples/2/kept"), "", &[1; 40]).status, 404);
}

#[test]
fn what_is_removed_can_be_had_back_until_the_next_start() {
    let keep = tempfile::tempdir().unwrap();
    let config = || ServeConfig { keep: Some(keep.path().into()), example: Some(EXAMPLE), ..ServeConfig::default() };
    let server = Running::start(config(), Fake::quick());
    let ids = [0, 1].map(|_| server.example("{}"));
    ids.iter().for_each(|id| drop(server.until(id, &["done"])));
    let before = server.get(&format!("/jobs/{}/samples/0.ply", ids[0])).body;
    let remove = |server: &Running, id: &str| server.send("DELETE", &format!("/jobs/{id}"), "", b"").status;
    assert_eq!(remove(&server, &ids[0]), 200);
    assert_eq!(server.get(&format!("/jobs/{}", ids[0])).status, 404);
    assert_eq!(server.get(&format!("/jobs/{}/samples/0.ply", ids[0])).status, 404);
    let restore = |server: &Running, id: &str| server.send("POST", &format!("/jobs/{id}/restore"), "", b"");
    let back = restore(&server, &ids[0]);
    assert!(back.status == 200 && back.json()["state"] == "done", "{}", back.text());
    assert_eq!(server.get(&format!("/jobs/{}/samples/0.ply", ids[0])).body, before);
    assert_eq!(restore(&server, &ids[0]).status, 404, "it is there");
    // A title of one's own.
    let rename = |title: &str| {
        let body = serde_json::json!({ "title": title }).to_string();
        server.send("PUT", &format!("/jobs/{}/title", ids[0]), "", body.as_bytes())
    };
    assert_eq!(rename(" a <b>mug</b> ").json()["title"], "a <b>mug</b>");
    for odd in ["", "  ", "two\nlines", &"x".repeat(121)] {
        assert_eq!(rename(odd).status, 422, "{odd:?}");
    }
    assert_eq!(remove(&server, &ids[1]), 200);
    server.stop();
    let server = Running::start(config(), Fake::quick());
    assert_eq!(server.json(&format!("/jobs/{}", ids[0]))["title"], "a <b>mug</b>");
    assert_eq!(restore(&server, &ids[1]).status, 404);
    let begin = Instant::now();
    while files(keep.path()).iter().any(|f| f.contains(&ids[1])) {
        assert!(begin.elapsed() < Duration::from_secs(20), "the bin is emptied at the start");
        thread::sleep(Duration::from_millis(20));
    }
}
