//! Jobs on their way through a real socket.

mod common;

use std::{
    collections::BTreeSet,
    fs,
    io::Read,
    net::TcpStream,
    sync::Arc,
    thread,
    time::{Duration, Instant},
};

use common::*;
use freerange_gaussians::{
    Gaussians, Harmonics, Splats,
    formats::{Format, Frame, WriteOptions, encode, parse},
};
use freerange_serve::{Limits, Quality, ServeConfig};
use image::{Rgba, RgbaImage};

#[test]
fn the_example_becomes_gaussians_while_one_watches() {
    let engine = Arc::new(Fake { pause: Duration::from_millis(60), steps: 8, ..Fake::default() });
    let server = Running::plain(engine.clone());
    let id = server.example(r#"{"samples": 2, "seed": 3, "quality": "high", "iterations": 200}"#);
    // What the stream of events tells, and the Gaussians that it points at.
    let mut stream = TcpStream::connect(server.address).unwrap();
    std::io::Write::write_all(
        &mut stream,
        format!("GET /jobs/{id}/events HTTP/1.1\r\nHost: localhost\r\n\r\n").as_bytes(),
    )
    .unwrap();
    let (mut text, mut at, mut states, mut clouds) = (String::new(), 0, Vec::new(), BTreeSet::new());
    let mut chunk = [0; 4096];
    while states.last().is_none_or(|s| s != "done") {
        let n = stream.read(&mut chunk).unwrap();
        assert!(n > 0, "the stream ended after {states:?}");
        text.push_str(std::str::from_utf8(&chunk[..n]).unwrap());
        while let Some(end) = text[at..].find("\n\n") {
            let event = &text[at..at + end];
            at += end + 2;
            let Some(data) = event.lines().find_map(|l| l.strip_prefix("data: ")) else { continue };
            let status: serde_json::Value = serde_json::from_str(data).unwrap();
            states.push(status["state"].as_str().unwrap().to_owned());
            if let Some(number) = status["estimate"]["number"].as_u64() {
                assert_eq!(status["estimate"]["parts"][0]["gaussians"], 40);
                let reply = server.get(&format!("/jobs/{id}/estimates/{number}/1"));
                assert!(reply.status == 200 && reply.body.len() == 40 * 56, "{}", reply.text());
                clouds.insert(reply.body);
            }
        }
    }
    drop(stream);
    assert!(clouds.len() >= 5, "{} different estimates", clouds.len());
    assert!(states.contains(&"running".to_owned()));
    assert_eq!(server.get(&format!("/jobs/{id}/estimates/1/0")).status, 410);

    let job = server.json(&format!("/jobs/{id}"));
    assert_eq!(job["title"], "bowl");
    assert_eq!(job["samples"][1], serde_json::json!({ "seed": 4, "gaussians": 40 }));
    assert_eq!(job["understood"]["views"].as_array().unwrap().len(), 4);
    let options = engine.seen.lock().unwrap()[0].2;
    assert_eq!((options.samples, options.seed), (Some(2), Some(3)));
    assert_eq!((options.iterations, options.init), (Some(200), None));
    // The page fills its form with what the job had, and says what others would have.
    assert_eq!((options.quality, &job["options"]["quality"]), (Some(Quality::High), &"high".into()));
    assert_eq!(server.json("/server")["defaults"]["quality"], "draft");
    let plain = server.example("{}");
    assert_eq!(server.until(&plain, &["done"])["options"]["quality"], "draft", "what it had is recorded");
    assert_eq!(server.send("DELETE", &format!("/jobs/{plain}"), "", b"").status, 200);
    assert_eq!(job["thumbnail"], true);
    let expected = Fake::cloud(4, 8);
    // Colors are rounded in files.
    let alike = |rows: &[f32]| rows.iter().zip(expected.rows()).all(|(a, b)| (a - b).abs() < 1e-6);
    let rows = server.get(&format!("/jobs/{id}/samples/1")).body;
    let rows: Vec<f32> = rows.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    assert!(rows.len() == 40 * 14 && alike(&rows));
    for format in Format::ALL {
        let reply = server.get(&format!("/jobs/{id}/samples/1.{format}"));
        assert_eq!(reply.headers["content-disposition"], format!("attachment; filename=\"bowl-1.{format}\""));
        let name = format!("x.{format}");
        let read = parse(format, &reply.body, name.as_ref(), Frame::Z_UP).unwrap();
        assert_eq!(read.splats.cloud.len(), 40, "{format}");
        if format == Format::Ply {
            assert!(alike(read.splats.cloud.rows()));
        }
    }
    for (path, size) in [("thumbnail.png", (160, 160)), ("photos/0.png", (512, 512)), ("views/3.png", (512, 512))] {
        let reply = server.get(&format!("/jobs/{id}/{path}"));
        let picture = image::load_from_memory(&reply.body).unwrap().into_rgba8();
        assert_eq!((picture.dimensions(), reply.headers["content-type"].as_str()), (size, "image/png"), "{path}");
    }
    assert!(image::load_from_memory(&server.get(&format!("/jobs/{id}/sheet.png")).body).unwrap().width() > 500);
    for missing in [
        "samples/2",
        "samples/0.exe",
        "samples/-1",
        "photos/4.png",
        "photos/0",
        "views/../job.json",
        "nothing",
        "estimates/9/9",
    ] {
        assert!([404, 410].contains(&server.get(&format!("/jobs/{id}/{missing}")).status), "{missing}");
    }
    assert_eq!(server.json("/jobs")[0]["id"], id.as_str());
    assert_eq!(server.send("DELETE", &format!("/jobs/{id}"), "", b"").status, 200);
    assert_eq!(server.get(&format!("/jobs/{id}")).status, 404);
    assert_eq!(server.json("/jobs"), serde_json::json!([]));
}

#[test]
fn photos_are_looked_at_and_edited_before_they_are_computed() {
    let engine = Fake::quick();
    let server = Running::plain(engine.clone());
    let mut parts = folder("my & bowl/");
    parts.push(Part::file("my & bowl/readme.md", "of no use"));
    parts.insert(0, Part::field("scene", r#"{"masks": "alpha", "up": "z"}"#));
    let created = server.post_form(&parts);
    assert_eq!(created.status, 201, "{}", created.text());
    let id = created.json()["id"].as_str().unwrap().to_owned();
    let job = server.until(&id, &["ready", "failed"]);
    assert_eq!(job["state"], "ready", "{job}");
    assert_eq!(job["passed_over"][0], "my & bowl/readme.md");
    assert_eq!(job["title"], "my & bowl");
    let view = &job["understood"]["views"][1];
    assert!(view["covers"].as_f64().unwrap() > 0.05 && view["camera"]["fx"].as_f64().unwrap() > 100.0);

    // A half of the second photo's object is painted away, and a patch is added.
    let before = image::load_from_memory(&server.get(&format!("/jobs/{id}/views/1.png")).body).unwrap().into_rgba8();
    let mask = RgbaImage::from_fn(512, 512, |x, y| {
        let v = if x < 256 {
            before.get_pixel(x, y)[3]
        } else if y < 10 {
            255
        } else {
            0
        };
        Rgba([v, v, v, 255])
    });
    let put = |k: &str, bytes: &[u8]| server.send("PUT", &format!("/jobs/{id}/masks/{k}"), "", bytes);
    let reply = put("1", &png(&mask));
    assert_eq!(reply.status, 200, "{}", reply.text());
    let wanted = mask.pixels().filter(|p| p[0] >= 128).count();
    let after = image::load_from_memory(&server.get(&format!("/jobs/{id}/views/1.png")).body).unwrap().into_rgba8();
    for (x, y, pixel) in after.enumerate_pixels() {
        assert_eq!(pixel[3], mask.get_pixel(x, y)[0]);
        assert!(x >= 256 || pixel == before.get_pixel(x, y), "where nothing was painted, nothing changes");
    }
    assert_eq!(server.json(&format!("/jobs/{id}"))["understood"]["views"][1]["edited"], true);
    for (what, k, bytes) in [
        ("expected some of the object, found none", "1", png(&RgbaImage::from_pixel(512, 512, Rgba([0, 0, 0, 255])))),
        ("512 x 512 pixels, found 511 x 512", "1", png(&RgbaImage::new(511, 512))),
        ("found", "1", b"no picture".to_vec()),
        ("60000", "1", bomb(60000, 60000)),
        ("no such photo", "4", png(&mask)),
    ] {
        let refused = put(k, &bytes);
        assert!([404, 422].contains(&refused.status) && refused.error().contains(what), "{}", refused.text());
    }
    let go = server.send("POST", &format!("/jobs/{id}/go"), "", b"{}");
    assert_eq!(go.status, 200, "{}", go.text());
    server.until(&id, &["done"]);
    let (names, covered, _) = engine.seen.lock().unwrap()[0].clone();
    assert_eq!(names, ["000", "001", "002", "003"]);
    assert_eq!(covered[1], wanted, "the edited mask is what is computed with");
    assert_eq!(
        covered[0],
        image::open(bowl().join("train/000.png")).unwrap().into_rgba8().pixels().filter(|p| p[3] >= 128).count()
    );
}

#[test]
fn one_computes_at_a_time_and_cancelling_works_at_once() {
    let engine = Fake::slow();
    let server = Running::plain(engine.clone());
    // Two are read at the same time: the first to be read computes first.
    let first = server.example("{}");
    server.until(&first, &["running"]);
    let mut ids = vec![first];
    ids.extend((0..2).map(|_| server.example("{}")));
    ids[1..].iter().for_each(|id| drop(server.until(id, &["queued"])));
    assert_eq!(server.until(&ids[2], &["queued"])["position"], 1, "one waits before it");
    let cancel = |id: &str| server.send("POST", &format!("/jobs/{id}/cancel"), "", b"");
    // One that computes.
    let begin = Instant::now();
    assert_eq!(cancel(&ids[0]).json()["state"], "cancelled");
    assert!(begin.elapsed() < Duration::from_millis(500), "{:?}", begin.elapsed());
    server.until(&ids[1], &["running"]);
    assert!(begin.elapsed() < Duration::from_secs(2), "the next one has begun after {:?}", begin.elapsed());
    // One that waits, and one that has ended.
    assert_eq!(cancel(&ids[2]).json()["state"], "cancelled");
    assert_eq!(cancel(&ids[2]).status, 409);
    assert_eq!(server.send("DELETE", &format!("/jobs/{}", ids[1]), "", b"").status, 409, "it computes");
    cancel(&ids[1]);
    // A cancelled job may go again; what the cancelled run still says is not heard.
    assert_eq!(server.send("POST", &format!("/jobs/{}/go", ids[1]), "", br#"{"seed": 7}"#).status, 200);
    server.until(&ids[1], &["running"]);
    thread::sleep(Duration::from_millis(200));
    assert_eq!(server.json(&format!("/jobs/{}", ids[1]))["state"], "running");
    cancel(&ids[1]);
    assert_eq!(engine.most_at_once.load(std::sync::atomic::Ordering::SeqCst), 1);
    assert_eq!(server.json(&format!("/jobs/{}", ids[0]))["samples"], serde_json::json!([]));
}

/// A folder that is gone stands for a disk that cannot be written.
#[test]
fn a_job_whose_state_cannot_be_written_fails() {
    let keep = tempfile::tempdir().unwrap();
    let config = ServeConfig { keep: Some(keep.path().into()), example: Some(EXAMPLE), ..ServeConfig::default() };
    let server = Running::start(config, Fake::slow());
    let cancel = |id: &str| assert_eq!(server.send("POST", &format!("/jobs/{id}/cancel"), "", b"").status, 200);
    let first = server.example("{}");
    server.until(&first, &["running"]);
    let second = server.example("{}");
    server.until(&second, &["queued"]);
    fs::remove_dir_all(keep.path().join(&second)).unwrap();
    cancel(&first);
    // It does not count as running for ever, and the next one has its turn.
    assert_eq!(server.until(&second, &["failed"])["error"], "the server failed; its log says why");
    let third = server.example("{}");
    server.until(&third, &["running"]);
    cancel(&third);
}

#[test]
fn a_panic_is_the_jobs_not_the_servers() {
    let server = Running::plain(Arc::new(Fake { panics: true, ..Fake::default() }));
    let id = server.example("{}");
    let job = server.until(&id, &["failed", "done"]);
    assert!(job["state"] == "failed" && job["error"].as_str().unwrap().contains("the server failed"), "{job}");
    assert_eq!(server.get("/health").text(), "ok\n");
}

#[test]
fn a_job_that_takes_too_long_is_ended() {
    let limits = Limits { job_time: Duration::from_millis(300), ..Limits::default() };
    let server = Running::start(ServeConfig { example: Some(EXAMPLE), limits, ..ServeConfig::default() }, Fake::slow());
    let id = server.example("{}");
    let job = server.until(&id, &["failed", "done"]);
    assert!(job["error"].as_str().unwrap().contains("took longer than"), "{job}");
}

/// A copy of a folder as a killed server leaves it.
fn snapshot(from: &std::path::Path, to: &std::path::Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap().map(Result::unwrap) {
        match entry.file_type().unwrap().is_dir() {
            true => snapshot(&entry.path(), &to.join(entry.file_name())),
            false => drop(fs::copy(entry.path(), to.join(entry.file_name())).unwrap()),
        }
    }
}

#[test]
fn a_restart_finds_finished_jobs_and_says_of_others_that_they_did_not_survive() {
    let (keep, copy) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let config = |folder: &std::path::Path| ServeConfig {
        keep: Some(folder.into()),
        example: Some(EXAMPLE),
        ..ServeConfig::default()
    };
    let quick = Running::start(config(keep.path()), Fake::quick());
    let done = quick.example(r#"{"seed": 5}"#);
    quick.until(&done, &["done"]);
    // Two servers on one folder would overwrite each other's work.
    let other = freerange_serve::Server::bind(&config(keep.path()), Fake::quick());
    assert!(other.err().unwrap().to_string().contains("another server"));
    quick.stop();

    let slow = Running::start(config(keep.path()), Fake::slow());
    assert_eq!(slow.json(&format!("/jobs/{done}"))["state"], "done");
    assert_eq!(slow.get(&format!("/jobs/{done}/samples/0.ply")).status, 200);
    let running = slow.example("{}");
    slow.until(&running, &["running"]);
    let queued = slow.example("{}");
    slow.until(&queued, &["queued"]);
    // As after kill -9: nothing was told to end.
    snapshot(keep.path(), copy.path());
    let arriving = copy.path().join("0123456789abcdef/upload");
    fs::create_dir_all(&arriving).unwrap();
    fs::create_dir_all(copy.path().join("fedcba9876543210")).unwrap(); // somebody else's
    let engine = Fake::quick();
    let after = Running::start(config(copy.path()), engine.clone());
    assert_eq!(after.json(&format!("/jobs/{done}"))["samples"][0]["seed"], 5);
    let job = after.json(&format!("/jobs/{running}"));
    assert!(
        job["state"] == "interrupted" && job["error"].as_str().unwrap().contains("while this job was running"),
        "{job}"
    );
    after.until(&queued, &["done"]);
    assert!(!arriving.exists() && copy.path().join("fedcba9876543210").is_dir());
    // Its photos are there still: it can be computed again.
    assert_eq!(after.send("POST", &format!("/jobs/{running}/go"), "", b"{}").status, 200);
    after.until(&running, &["done"]);
    let seen = engine.seen.lock().unwrap();
    assert_eq!(seen[0].1, seen[1].1, "the same photos with the same masks");
    drop(seen);
    after.stop();
    // Asked to end, a server says so of what it computed.
    slow.stop();
    let last = Running::start(config(keep.path()), Fake::quick());
    assert_eq!(last.json(&format!("/jobs/{running}"))["state"], "interrupted");
}

#[test]
fn without_a_folder_nothing_stays() {
    let server = Running::plain(Fake::quick());
    let id = server.example("{}");
    server.until(&id, &["done"]);
    let mine = || {
        let all = fs::read_dir(std::env::temp_dir()).unwrap().map(Result::unwrap);
        all.filter(|e| e.file_name().to_string_lossy().starts_with("freerange-serve-") && e.path().join(&id).is_dir())
            .count()
    };
    assert_eq!(mine(), 1);
    server.stop();
    assert_eq!(mine(), 0);
}

fn splats() -> Splats {
    let cloud = Fake::cloud(1, 2);
    let harmonics = Harmonics::from_rows(1, (0..9 * cloud.len()).map(|i| 0.01 * (i as f32).sin()).collect());
    Splats { harmonics, ..Splats::from(cloud) }
}

fn file(format: Format, frame: Frame) -> Vec<u8> {
    encode(&splats(), format, &WriteOptions { frame, ..WriteOptions::default() }).unwrap().bytes
}

/// Gaussians of a file are shown, cropped and converted as results are; nothing of them is lost.
#[test]
fn a_file_of_gaussians_is_a_result() {
    let server = Running::plain(Fake::quick());
    for (name, format, up) in [
        ("mug.ply", Format::Ply, [0.0, -1.0, 0.0]),
        ("Mug.SPZ", Format::Spz, [0.0, 0.0, 1.0]),
        ("mug.glb", Format::Glb, [0.0, 0.0, 1.0]),
        ("mug.usdz", Format::Usdz, [0.0, 0.0, 1.0]),
        ("mug.html", Format::Html, [0.0, -1.0, 0.0]),
    ] {
        let frame = if matches!(format, Format::Ply | Format::Html) { Frame::Y_DOWN } else { Frame::Z_UP };
        let reply = server.post_form(&[Part::file(name, file(format, frame))]);
        assert_eq!(reply.status, 201, "{name}: {}", reply.text());
        let id = reply.json()["id"].as_str().unwrap().to_owned();
        let job = server.until(&id, &["done", "failed"]);
        assert_eq!(job["state"], "done", "{job}");
        assert_eq!((&job["title"], &job["may_go"]), (&name.into(), &false.into()), "{job}");
        assert_eq!(job["samples"], serde_json::json!([{ "seed": 0, "gaussians": 40 }]));
        let found: Vec<f64> = job["up"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
        assert!(found.iter().zip(up).all(|(a, b)| (a - b).abs() < 1e-6), "{name}: {found:?}");
        assert!(
            job["understood"]["radius"].as_f64().unwrap() > 0.1 && job["understood"]["views"] == serde_json::json!([])
        );
        assert_eq!(server.get(&format!("/jobs/{id}/thumbnail.png")).status, 200);
        let rows = server.get(&format!("/jobs/{id}/samples/0"));
        assert_eq!(rows.body.len(), 40 * 56);
        for to in Format::ALL {
            let reply = server.get(&format!("/jobs/{id}/samples/0.{to}"));
            assert_eq!(reply.status, 200, "{name} to {to}");
            let saved = format!("attachment; filename=\"{}-0.{to}\"", name.split('.').next().unwrap());
            assert_eq!(reply.headers["content-disposition"], saved);
            let again = parse(to, &reply.body, std::path::Path::new("x"), frame).unwrap();
            assert_eq!(again.splats.cloud.len(), 40);
        }
        // Cropped, harmonics stay with their Gaussians.
        let kept: Vec<u8> = (0..40).map(|i| u8::from(i % 2 == 0)).collect();
        assert_eq!(server.send("PUT", &format!("/jobs/{id}/samples/0/kept"), "", &kept).json()["gaussians"], 20);
        let reply = server.get(&format!("/jobs/{id}/samples/0.ply"));
        let half = parse(Format::Ply, &reply.body, std::path::Path::new("x.ply"), frame).unwrap().splats;
        assert_eq!(half.cloud.len(), 20);
        if format == Format::Ply {
            let expected = splats().select(&(0..40).step_by(2).collect::<Vec<_>>());
            assert_eq!(half.harmonics.degree(), 1);
            let apart = half.harmonics.rows().iter().zip(expected.harmonics.rows()).map(|(a, b)| (a - b).abs());
            assert!(apart.fold(0.0, f32::max) < 1e-6);
            let apart = half.cloud.rows().iter().zip(expected.cloud.rows()).map(|(a, b)| (a - b).abs());
            assert!(apart.fold(0.0, f32::max) < 1e-6);
        }
        assert_eq!(server.send("POST", &format!("/jobs/{id}/go"), "", b"").status, 409);
    }
}

#[test]
fn files_of_gaussians_that_cannot_be_shown_are_refused() {
    let limits = Limits { memory: 1 << 20, ..Limits::default() };
    let server = Running::start(ServeConfig { limits, ..ServeConfig::default() }, Fake::quick());
    let ply = file(Format::Ply, Frame::Z_UP);
    let two =
        server.post_form(&[Part::file("a.ply", ply.clone()), Part::file("b.spz", file(Format::Spz, Frame::Z_UP))]);
    assert_eq!((two.status, two.error().contains("found 2")), (422, true), "{}", two.text());
    let go = server.post_form(&[Part::file("a.ply", ply.clone()), Part::field("go", "{}")]);
    assert_eq!((go.status, go.error().contains("`go`")), (422, true), "{}", go.text());
    let mut large = splats().cloud;
    for i in 0..10_000 {
        let row = *large.row(i % 40);
        large.push(&row);
    }
    let large = encode(&Splats::from(large), Format::Ply, &WriteOptions::default()).unwrap().bytes;
    for (name, bytes, words) in [
        ("a.ply", ply[..ply.len() / 2].to_vec(), "a.ply"),
        ("a.spz", b"no such thing".to_vec(), "a.spz"),
        ("a.html", b"<p>no Gaussians here".to_vec(), "give the file of Gaussians that it shows"),
        ("a.glb", file(Format::Spz, Frame::Z_UP), "a.glb"),
        (
            "a.ply",
            encode(&Splats::from(Gaussians::default()), Format::Ply, &WriteOptions::default()).unwrap().bytes,
            "no Gaussians",
        ),
        ("a.ply", large, "MB of memory"),
    ] {
        let reply = server.post_form(&[Part::file(name, bytes)]);
        assert_eq!(reply.status, 201, "{}", reply.text());
        let job = server.until(reply.json()["id"].as_str().unwrap(), &["done", "failed"]);
        let error = job["error"].as_str().unwrap_or_default();
        assert!(job["state"] == "failed" && error.contains(words) && !error.contains('/'), "{name}: {job}");
    }
    // Beside photos they are points of a capture, which nobody reads.
    let server = Running::plain(Fake::quick());
    let parts = [folder("bowl/"), vec![Part::file("bowl/points3D.ply", ply.clone())]].concat();
    let reply = server.post_form(&parts);
    let job = server.until(reply.json()["id"].as_str().unwrap(), &["ready", "failed"]);
    assert_eq!((&job["state"], &job["passed_over"]), (&"ready".into(), &serde_json::json!(["bowl/points3D.ply"])));
    // Beside cameras alone they are what a trainer wrote.
    let reply = server.post_form(&[Part::file("run/cameras.json", "[]"), Part::file("run/cloud.ply", ply)]);
    let job = server.until(reply.json()["id"].as_str().unwrap(), &["done", "failed"]);
    assert_eq!((&job["state"], &job["title"]), (&"done".into(), &"run".into()), "{job}");
}

#[test]
fn a_file_of_gaussians_that_is_cut_off_is_said_to_be() {
    let server = Running::plain(Fake::quick());
    for format in [Format::Ply, Format::Splat, Format::Spz, Format::Sog, Format::Glb] {
        let (name, bytes) = (format!("half.{format}"), file(format, Frame::Z_UP));
        let reply = server.post_form(&[Part::file(&name, &bytes[..bytes.len() / 2 + 1])]);
        let job = server.until(reply.json()["id"].as_str().unwrap(), &["done", "failed"]);
        let error = job["error"].as_str().unwrap_or_default();
        assert!(error.starts_with(&name) && error.contains("cut off"), "{job}");
        assert_eq!((&job["title"], &job["thumbnail"]), (&name.into(), &false.into()));
    }
}
