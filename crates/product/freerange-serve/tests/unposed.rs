//! Photos without cameras: the engine's search, and its limits.

mod common;

use std::{
    sync::Arc,
    thread,
    time::{Duration, Instant},
};

use common::*;
use freerange_serve::{Limits, ServeConfig};
use serde_json::Value;

fn engine(finds: Finds) -> Arc<Fake> {
    Arc::new(Fake { pause: Duration::from_millis(1), steps: 5, finds, ..Fake::default() })
}

/// The example's photos alone, and the wish to have their cameras found.
fn photos() -> Vec<Part> {
    let mut parts: Vec<Part> = folder("mug/").into_iter().filter(is_png).collect();
    parts.push(Part::field("scene", r#"{"find_cameras": true}"#));
    parts
}

fn is_png(part: &Part) -> bool {
    part.file.as_ref().is_some_and(|name| name.ends_with(".png"))
}

fn posted(server: &Running, parts: &[Part]) -> String {
    let reply = server.post_form(parts);
    assert_eq!(reply.status, 201, "{}", reply.text());
    reply.json()["id"].as_str().unwrap().to_owned()
}

fn texts(list: &Value) -> String {
    list.as_array().unwrap().iter().map(|text| text.as_str().unwrap()).collect::<Vec<_>>().join("; ")
}

#[test]
fn cameras_are_found_and_the_job_computed() {
    let engine = engine(Finds::Cameras);
    let server = Running::plain(engine.clone());
    assert_eq!(server.json("/server")["camera_finder"]["name"], "a finder");
    let mut parts = photos();
    parts.push(Part::field("go", "{}"));
    let id = posted(&server, &parts);
    let job = server.until(&id, &["done", "failed"]);
    assert_eq!(job["state"], "done", "{job}");
    let searches = engine.searches.lock().unwrap();
    assert_eq!((searches.len(), searches[0].len()), (1, 4), "the photos and nothing else");
    assert_eq!(job["understood"]["views"].as_array().unwrap().len(), 4);
    // What is to be said comes first, in the page's words.
    let warnings = texts(&job["understood"]["warnings"]);
    assert!(warnings.starts_with("few (tick \u{201c}not at even steps\u{201d}"), "{warnings}");
    assert!(texts(&job["understood"]["notes"]).starts_with("4 of 4 photos"));
}

#[test]
fn a_refusal_is_told_in_the_pages_words() {
    let text = "no cameras that can be relied on: the camera turned by 90 degrees from PHOTOS/0.png to SCENE/images/1.png \
                (--uneven if photos are missing there, or not in order)";
    let server = Running::plain(engine(Finds::Refused(text)));
    let id = posted(&server, &photos());
    let job = server.until(&id, &["failed", "ready"]);
    let error = job["error"].as_str().unwrap();
    assert!(error.contains("from 0.png to images/1.png (tick \u{201c}not at even steps\u{201d}"), "{error}");
    assert!(job["may_go"] == false && !error.contains("--"), "{error}");
}

#[test]
fn where_nothing_finds_cameras_it_is_said_before_and_refused() {
    let server = Running::plain(engine(Finds::Nobody));
    assert_eq!(server.json("/server")["camera_finder"]["missing"], "nobody here finds cameras");
    let reply = server.post_form(&photos());
    assert_eq!((reply.status, reply.error().as_str()), (422, "nobody here finds cameras"));
    // A turntable has cameras already.
    let server = Running::plain(engine(Finds::Cameras));
    let mut parts = photos();
    *parts.last_mut().unwrap() = Part::field("scene", r#"{"find_cameras": true, "turntable": "20,45"}"#);
    assert!(server.post_form(&parts).error().starts_with("find_cameras: expected photos without a turntable"));
}

#[test]
fn a_search_can_be_cancelled_and_is_in_nobodys_way() {
    let server = Running::plain(engine(Finds::Waits));
    let [one, next] = [0, 1].map(|_| posted(&server, &photos()));
    let begin = Instant::now();
    let status = loop {
        let job = server.json(&format!("/jobs/{one}"));
        if job["stage"] == "matches" {
            break job;
        }
        assert!(begin.elapsed() < Duration::from_secs(30), "{job}");
        thread::sleep(Duration::from_millis(5));
    };
    assert_eq!((&status["state"], &status["done"], &status["total"]), (&"reading".into(), &1.into(), &6.into()));
    assert_eq!(status["thumbnail"], false, "the page asks for no picture yet");
    // Jobs that have cameras are read and computed meanwhile.
    let other = server.example("{}");
    server.until(&other, &["done"]);
    assert_eq!(server.json(&format!("/jobs/{next}"))["stage"], "", "one searches at a time");
    for id in [&one, &next] {
        assert_eq!(server.send("POST", &format!("/jobs/{id}/cancel"), "", b"").json()["state"], "cancelled");
    }
    // Whoever searches is free again.
    let last = posted(&server, &photos());
    let begin = Instant::now();
    while server.json(&format!("/jobs/{last}"))["stage"] != "matches" {
        assert!(begin.elapsed() < Duration::from_secs(30));
        thread::sleep(Duration::from_millis(5));
    }
    // A server that ends does not wait for it.
    let begin = Instant::now();
    server.stop();
    assert!(begin.elapsed() < Duration::from_secs(10));
}

#[test]
fn a_search_has_limits() {
    let with = |limits, finds| Running::start(ServeConfig { limits, ..ServeConfig::default() }, engine(finds));
    let server = with(Limits { search_time: Duration::from_millis(200), ..Limits::default() }, Finds::Waits);
    let id = posted(&server, &photos());
    let error = server.until(&id, &["failed"])["error"].as_str().unwrap().to_owned();
    assert!(error.contains("not found within 0.2 seconds"), "{error}");
    // Masks of opaque photos that would not fit are known before anyone searches.
    let with_alpha = png(&image::RgbaImage::new(8, 6));
    let rgb = {
        let mut bytes = std::io::Cursor::new(Vec::new());
        image::RgbImage::new(8, 6).write_to(&mut bytes, image::ImageFormat::Png).unwrap();
        bytes.into_inner()
    };
    let limits = Limits { memory: 64 << 20, ..Limits::default() };
    for (bytes, refused) in [(rgb, true), (with_alpha, false)] {
        let engine = engine(Finds::Refused("something else"));
        let server = Running::start(ServeConfig { limits, ..ServeConfig::default() }, engine.clone());
        let mut parts: Vec<Part> = (0..4).map(|i| Part::file(&format!("x/{i}.png"), bytes.clone())).collect();
        parts.push(Part::field("scene", r#"{"find_cameras": true}"#));
        let id = posted(&server, &parts);
        let error = server.until(&id, &["failed"])["error"].as_str().unwrap().to_owned();
        assert_eq!(error.contains("4 photos without masks: expected at most 64 MB"), refused, "{error}");
        assert_eq!(engine.searches.lock().unwrap().is_empty(), refused);
    }
}
