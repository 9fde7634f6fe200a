//! What must not be possible, tried through real sockets.

mod common;

use std::{
    io::{Read, Write},
    net::TcpStream,
    time::{Duration, Instant},
};

use common::*;
use freerange_serve::{Limits, ServeConfig, Server};

const TOKEN: &str = "correct-horse-battery";

fn with(limits: Limits) -> Running {
    Running::start(ServeConfig { example: Some(EXAMPLE), limits, ..ServeConfig::default() }, Fake::quick())
}

#[test]
fn pages_of_other_sites_cannot_ask() {
    let server = Running::plain(Fake::quick());
    let ask = |method: &str, path: &str, headers: &str| {
        server.raw(format!("{method} {path} HTTP/1.1\r\n{headers}\r\n").as_bytes()).status
    };
    let own = format!("Host: {}\r\n", server.address);
    assert_eq!(ask("GET", "/jobs", &own), 200);
    assert_eq!(ask("GET", "/jobs", "Host: localhost:9\r\n"), 200, "a forwarded port");
    // Somebody's name that was bent to this address.
    for path in ["/", "/jobs", "/main.js", "/metrics", "/server"] {
        assert_eq!(ask("GET", path, "Host: evil.example\r\n"), 421, "{path}");
    }
    let refused = server.raw(b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n").error();
    assert!(!refused.contains("--"), "the page has no options: {refused}");
    assert_eq!(ask("GET", "/jobs", ""), 400, "no Host");
    assert_eq!(ask("GET", "/jobs", &format!("{own}Host: localhost\r\n")), 400, "two");
    // Another origin, or one that does not say which.
    for origin in ["http://evil.example", "null", "http://127.0.0.1:1", "file://", "http://127.0.0.1.evil.example"] {
        for (method, path) in
            [("POST", "/jobs"), ("GET", "/jobs"), ("DELETE", "/jobs/0123456789abcdef"), ("OPTIONS", "/jobs")]
        {
            assert_eq!(ask(method, path, &format!("{own}Origin: {origin}\r\n")), 403, "{origin} {method}");
        }
    }
    assert_eq!(ask("GET", "/jobs", &format!("{own}Origin: http://{}\r\n", server.address)), 200);
    assert_eq!(ask("GET", "/jobs", &format!("{own}Sec-Fetch-Site: cross-site\r\n")), 403);
    assert_eq!(ask("GET", "/jobs", &format!("{own}Sec-Fetch-Site: cross-site\r\nSec-Fetch-Mode: navigate\r\n")), 403);
    assert_eq!(
        ask("GET", "/", &format!("{own}Sec-Fetch-Site: cross-site\r\nSec-Fetch-Mode: navigate\r\n")),
        200,
        "a link to the page"
    );
    assert_eq!(ask("OPTIONS", "/jobs", &own), 405);
    assert_eq!(ask("POST", "/", &own), 405);
    assert_eq!(ask("TRACE", "/jobs", &own), 405);
}

#[test]
fn every_answer_forbids_what_is_from_outside() {
    let server = Running::plain(Fake::quick());
    let id = server.example("{}");
    server.until(&id, &["done"]);
    for path in [
        "/",
        "/main.js",
        "/viewer.js",
        "/style.css",
        "/jobs",
        "/nothing",
        "/health",
        "/metrics",
        &format!("/jobs/{id}/samples/0.html"),
    ] {
        let reply = server.get(path);
        let policy = &reply.headers["content-security-policy"];
        assert!(
            policy.starts_with("default-src 'none'; script-src 'self';") && policy.contains("frame-ancestors 'none'"),
            "{path}"
        );
        assert!(!policy.contains("unsafe") && !policy.contains("http"), "{path}");
        assert_eq!(reply.headers["x-content-type-options"], "nosniff", "{path}");
        assert!(reply.headers.keys().all(|k| !k.starts_with("access-control")), "{path}: no CORS");
    }
    assert!(server.get(&format!("/jobs/{id}/samples/0.html")).headers["content-disposition"].starts_with("attachment"));
    let page = server.get("/");
    assert_eq!(page.headers["content-type"], "text/html; charset=utf-8");
    let head = server.send("HEAD", "/", "", b"");
    assert!(
        head.status == 200 && head.body.is_empty() && head.headers["content-length"] == page.body.len().to_string()
    );
    let text = server.get("/metrics").text();
    for line in [
        "freerange_jobs{state=\"done\"} 1",
        "freerange_jobs_ended_total{state=\"done\"} 1",
        "# TYPE freerange_answers_total counter",
        "freerange_resident_bytes ",
    ] {
        assert!(text.contains(line), "{line} in {text}");
    }
}

/// V7, the cookie of all ports; V8.
#[test]
fn beyond_loopback_a_token_is_needed() {
    let config = ServeConfig { host: [0, 0, 0, 0].into(), example: Some(EXAMPLE), ..ServeConfig::default() };
    let refused = |config: &ServeConfig| Server::bind(config, Fake::quick()).err().unwrap().to_string();
    assert!(refused(&config).starts_with("token: expected one") && refused(&config).contains("--no-token"));
    let short = refused(&ServeConfig { token: Some("secret".into()), ..config.clone() });
    assert!(
        short.starts_with("token: expected 16 or more letters")
            && short.contains("6 characters")
            && !short.contains("secret"),
        "{short}"
    );
    let odd = refused(&ServeConfig { token: Some("abc+def/ghi=jklmnop".into()), ..config.clone() });
    assert!(odd.contains("other characters") && !odd.contains("abc"), "{odd}");
    assert!(
        refused(&ServeConfig { names: vec!["a:80".into()], token: Some(TOKEN.into()), ..config.clone() })
            .contains("--name")
    );

    let server = Running::start(ServeConfig { token: Some(TOKEN.into()), ..config }, Fake::quick());
    for path in ["/jobs", "/main.js", "/metrics", "/server", "/jobs/0123456789abcdef/events"] {
        assert_eq!(server.get(path).status, 401, "{path}");
    }
    assert_eq!(server.get("/health").status, 200, "probes know no secret");
    assert_eq!(server.post_form(&folder("")).status, 401);
    let asked = server.get("/?token=wrong-horse-battery-1");
    assert!(
        asked.status == 401 && asked.text().contains("<form") && !asked.text().contains("horse"),
        "{}",
        asked.text()
    );
    let known = |headers: &str| server.send("GET", "/jobs", headers, b"").status;
    assert_eq!(known(&format!("Authorization: Bearer {TOKEN}\r\n")), 200);
    assert_eq!(known(&format!("Authorization: Bearer {TOKEN}x\r\n")), 401);
    let entered = server.get(&format!("/?token={TOKEN}"));
    let cookie = &entered.headers["set-cookie"];
    // A redirect would be followed without the cookie where another site began it: the page goes on by itself.
    assert!(entered.status == 200 && !entered.headers.contains_key("location"), "{}", entered.status);
    assert!(entered.text().contains("/enter.js") && !entered.text().contains("horse"), "{}", entered.text());
    assert!(server.get("/enter.js").text().contains("location.replace"));
    assert!(cookie.contains("HttpOnly") && cookie.contains("SameSite=Strict"), "{cookie}");
    let pair = cookie.split(';').next().unwrap();
    assert_eq!(known(&format!("Cookie: other=1; {pair}\r\n")), 200);
    assert_eq!(known("Cookie: freerange_token=\r\n"), 401);
    // Other ports of this host get the same cookies: each server has a name of its own.
    assert!(pair.starts_with(&format!("freerange_token_{}=", server.address.port())), "{pair}");
    let elsewhere = format!("GET /jobs HTTP/1.1\r\nHost: localhost:1\r\nCookie: {pair}\r\n\r\n");
    assert_eq!(server.raw(elsewhere.as_bytes()).status, 401);
    // The form; and whoever follows a link without a token from another site, whose cookie the browser holds back.
    let form =
        |body: &str| server.send("POST", "/", "Content-Type: application/x-www-form-urlencoded\r\n", body.as_bytes());
    assert_eq!(form(&format!("token={TOKEN}")).headers["set-cookie"], *cookie);
    assert!(form("token=wrong-horse-battery-1").text().contains("not the token"));
    let linked = server.send("GET", "/", "Sec-Fetch-Site: cross-site\r\nSec-Fetch-Mode: navigate\r\n", b"");
    assert!(linked.status == 401 && !linked.text().contains("<form"), "{}", linked.text());
    let asked = server.send("GET", "/", "Sec-Fetch-Site: same-origin\r\nSec-Fetch-Mode: navigate\r\n", b"");
    assert!(asked.status == 401 && asked.text().contains("<form"), "{}", asked.text());
    assert!(
        freerange_serve::draw_token().len() == 48 && freerange_serve::draw_token() != freerange_serve::draw_token()
    );
    // A name is bent here: the token is no way around.
    let bent = format!("GET /jobs HTTP/1.1\r\nHost: evil.example\r\nAuthorization: Bearer {TOKEN}\r\n\r\n");
    assert_eq!(server.raw(bent.as_bytes()).status, 421);
}

#[test]
fn names_of_clients_are_no_paths_of_ours() {
    let folder_of_jobs = tempfile::tempdir().unwrap();
    let config = ServeConfig { keep: Some(folder_of_jobs.path().join("keep")), ..ServeConfig::default() };
    let server = Running::start(config, Fake::quick());
    for name in [
        "../../escaped.png",
        "/tmp/escaped.png",
        "a/../../../escaped.png",
        "..\\..\\escaped.png",
        "C:\\escaped.png",
        "a\\..\\..\\escaped.png",
        "escaped.png\u{0}.jpg",
    ] {
        let reply = server.post_form(&[Part::file(name, EXAMPLE.files[1].1)]);
        assert!([400, 422].contains(&reply.status), "{name:?}: {} {}", reply.status, reply.text());
    }
    // The same file twice, in other letters where the system does not tell them apart; a file that is a folder, too.
    let twice = [Part::file("a.png", EXAMPLE.files[1].1), Part::file("a.png", EXAMPLE.files[2].1)];
    assert!(server.post_form(&twice).error().contains("comes twice"));
    let both = [Part::file("a.png", EXAMPLE.files[1].1), Part::file("a.png/b.png", EXAMPLE.files[2].1)];
    assert!([422, 500].contains(&server.post_form(&both).status));
    // Cameras that name files of the server.
    let secret = folder_of_jobs.path().join("secret.png");
    std::fs::write(&secret, EXAMPLE.files[1].1).unwrap();
    let text = String::from_utf8(EXAMPLE.files[0].1.to_vec()).unwrap();
    for path in [secret.to_str().unwrap(), "../../../../../secret", "./train/../../../../../../secret.png"] {
        let mut parts = folder("");
        parts[0].bytes = text.replace("./train/001", path).into();
        let reply = server.post_form(&parts);
        assert!(reply.status == 422 && reply.error().contains("names of files beside it"), "{path}: {}", reply.text());
    }
    // COLMAP's names are followed within the folder only: its reader refuses them, later.
    let cameras = "1 PINHOLE 512 512 500 500 256 256\n";
    let images = format!("1 1 0 0 0 0 0 2 1 {}\n\n2 1 0 0 0 1 0 2 1 ../../../../../secret.png\n\n", secret.display());
    let parts = [
        Part::file("s/sparse/0/cameras.txt", cameras),
        Part::file("s/sparse/0/images.txt", images),
        Part::file("s/images/x.png", EXAMPLE.files[1].1),
    ];
    let id = server.post_form(&parts).json()["id"].as_str().unwrap().to_owned();
    let job = server.until(&id, &["failed", "ready"]);
    let error = job["error"].as_str().unwrap_or_default();
    assert!(job["state"] == "failed" && !error.contains("keep"), "{job}");
    // Whatever was refused has left nothing.
    let begin = Instant::now();
    loop {
        let left = files(folder_of_jobs.path());
        if left.iter().all(|f| !f.contains("escaped") && !f.contains("upload")) {
            break;
        }
        // Folders are removed by another thread.
        assert!(begin.elapsed() < Duration::from_secs(30), "{left:?}");
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(!std::path::Path::new("/tmp/escaped.png").exists());
}

#[test]
fn hostile_pictures_are_refused_before_they_are_decoded() {
    let server = Running::plain(Fake::quick());
    let refused = |name: &str, bytes: Vec<u8>, status: u16, word: &str| {
        let begin = Instant::now();
        let reply = server.post_form(&[Part::file(name, bytes)]);
        assert!(reply.status == status && reply.error().contains(word), "{name}: {} {}", reply.status, reply.text());
        assert!(begin.elapsed() < Duration::from_secs(2), "{name}: {:?}", begin.elapsed());
    };
    refused("bomb.png", bomb(60_000, 60_000), 413, "60000 x 60000");
    refused("bomb.png", bomb(u32::MAX >> 1, 1), 422, "limit");
    refused("empty.png", Vec::new(), 422, "expected the bytes of a PNG");
    refused("text.jpg", b"<script>alert(1)</script>".to_vec(), 422, "expected the bytes");
    refused("gif.png", b"GIF89a\x10\x00\x10\x00\x00\x00\x00".to_vec(), 422, "expected the bytes");
    refused("cut.png", EXAMPLE.files[1].1[..20].to_vec(), 422, "cut.png");
    refused("scene.zip", b"PK\x03\x04".to_vec(), 415, "archives are not unpacked");
    refused("scene.tar.gz", vec![0x1f, 0x8b], 415, "archives");
    // What looks right and is not is found when it is read: the job fails, the server does not.
    let mut parts = folder("x/");
    parts[2].bytes.truncate(30_000);
    let id = server.post_form(&parts).json()["id"].as_str().unwrap().to_owned();
    let job = server.until(&id, &["failed", "ready"]);
    assert!(job["state"] == "failed" && job["error"].as_str().unwrap().contains("001.png"), "{job}");
    assert!(!job["error"].as_str().unwrap().contains("/upload"), "where files lie is not told: {job}");
    for json in [
        "[".repeat(100_000),
        "{\"frames\": 3}".into(),
        "{\"frames\": [{\"file_path\": \"x\", \"transform_matrix\": [[1e999]]}]}".into(),
    ] {
        let mut parts = folder("x/");
        parts[0].bytes = json.into();
        let id = server.post_form(&parts).json()["id"].as_str().unwrap().to_owned();
        assert_eq!(server.until(&id, &["failed", "ready"])["state"], "failed");
    }
}

#[test]
fn bytes_pixels_files_and_jobs_have_limits() {
    let server = with(Limits {
        bytes: 400_000,
        file_bytes: 90_000,
        files: 6,
        pixels: 300_000,
        job_pixels: 900_000,
        open_jobs: 2,
        ..Limits::default()
    });
    let post = |parts: &[Part]| {
        let reply = server.post_form(parts);
        (reply.status, reply.error())
    };
    let (status, error) = post(&[Part::file("a.bin", vec![1; 90_001])]);
    assert!(status == 413 && error.contains("at most 90000 bytes"), "{error}");
    let many: Vec<Part> = (0..7).map(|i| Part::file(&format!("{i}.txt"), "x")).collect();
    assert_eq!(post(&many).0, 413);
    let (status, error) = post(&(0..5).map(|i| Part::file(&format!("{i}.bin"), vec![1; 85_000])).collect::<Vec<_>>());
    assert!(status == 413 && error.contains("400000 bytes together"), "{error}");
    let picture = png(&image::RgbaImage::new(600, 501));
    assert!(post(&[Part::file("a.png", picture)]).1.contains("at most 300000 pixels"));
    let (status, error) = post(&folder(""));
    assert!(status == 413 && error.contains("900000 pixels together"), "{error}");
    // Neither photos nor Gaussians: no job is made.
    for parts in [vec![Part::field("scene", "{}")], vec![Part::file("a.txt", "x")], folder("")[..1].to_vec()] {
        let (status, error) = post(&parts);
        assert!(status == 422 && error.starts_with("no photo and no file of Gaussians was sent: expected"), "{error}");
    }
    assert_eq!(server.json("/jobs"), serde_json::json!([]));
    assert_eq!(post(&[Part::field("example", "nothing")]).0, 404);
    assert_eq!(post(&[Part::field("scene", r#"{"masks": "magic"}"#), Part::file("a.txt", "x")]).0, 422);
    assert_eq!(post(&[Part::field("go", r#"{"samples": 9}"#), Part::file("a.txt", "x")]).0, 422);
    assert_eq!(post(&[Part::field("go", r#"{"sampels": 1}"#), Part::file("a.txt", "x")]).0, 422);
    // A length that is told is refused before it comes.
    let told = format!(
        "POST /jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary=x\r\nContent-Length: {}\r\n\r\n",
        1u64 << 40
    );
    assert_eq!(server.raw(told.as_bytes()).status, 413);
    assert_eq!(server.send("POST", "/jobs", "Content-Type: application/json\r\n", b"{}").status, 415);
    assert_eq!(
        server
            .send("POST", "/jobs", "Content-Encoding: gzip\r\nContent-Type: multipart/form-data; boundary=x\r\n", b"")
            .status,
        415
    );

    let server = with(Limits { open_jobs: 2, idle_time: Duration::from_secs(3), ..Limits::default() });
    let example = [Part::field("example", "bowl")];
    let ids: Vec<String> =
        (0..2).map(|_| server.post_form(&example).json()["id"].as_str().unwrap().to_owned()).collect();
    ids.iter().for_each(|id| drop(server.until(id, &["ready"])));
    // Reading may have taken longer than the idle time: looked at just now, they stay.
    ids.iter().for_each(|id| drop(server.json(&format!("/jobs/{id}"))));
    assert_eq!(server.post_form(&example).status, 429);
    std::thread::sleep(Duration::from_millis(3500));
    // Nobody came back to the first.
    assert_eq!(server.post_form(&example).status, 201);
    assert_eq!(server.get(&format!("/jobs/{}", ids[0])).status, 404);

    let keep = tempfile::tempdir().unwrap();
    let limits = Limits { finished_jobs: 1, ..Limits::default() };
    let server = Running::start(
        ServeConfig { keep: Some(keep.path().into()), example: Some(EXAMPLE), limits, ..ServeConfig::default() },
        Fake::quick(),
    );
    let id = server.example("{}");
    server.until(&id, &["done"]);
    assert_eq!(server.post_form(&example).status, 507, "what is to be kept is not thrown away");
    let server = with(limits);
    let id = server.example("{}");
    server.until(&id, &["done"]);
    assert_eq!(server.post_form(&example).status, 201);
    assert_eq!(server.get(&format!("/jobs/{id}")).status, 404, "the oldest is forgotten");
}

#[test]
fn odd_requests_are_refused() {
    let server = Running::plain(Fake::quick());
    let status = |text: &str| server.raw(text.as_bytes()).status;
    assert_eq!(status("nonsense\r\n\r\n"), 400);
    assert_eq!(status("GET / HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"), 501);
    assert_eq!(status("GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\n"), 400);
    assert_eq!(status("GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: +1\r\n\r\n"), 400);
    assert_eq!(status(&format!("GET / HTTP/1.1\r\nX: {}\r\n\r\n", "a".repeat(20_000))), 431);
    assert_eq!(status(&format!("GET / HTTP/1.1\r\n{}\r\n", "X: y\r\n".repeat(100))), 431);
    assert_eq!(status("GET /jobs/../../etc/passwd HTTP/1.1\r\nHost: localhost\r\n\r\n"), 404);
    assert_eq!(status("GET /%2e%2e/%2e%2e/etc/passwd HTTP/1.1\r\nHost: localhost\r\n\r\n"), 404);
    assert_eq!(status("GET //etc/passwd HTTP/1.1\r\nHost: localhost\r\n\r\n"), 404);
    assert_eq!(
        server
            .send("POST", "/jobs", &format!("Content-Type: multipart/form-data; boundary={BOUNDARY}\r\n"), b"no form")
            .status,
        400
    );
    // A form that ends in the middle leaves nothing.
    let body = form(&folder(""));
    assert_eq!(
        server
            .send(
                "POST",
                "/jobs",
                &format!("Content-Type: multipart/form-data; boundary={BOUNDARY}\r\n"),
                &body[..body.len() / 2]
            )
            .status,
        400
    );
    assert_eq!(server.json("/jobs"), serde_json::json!([]));
    let mut state = 1u64;
    for _ in 0..200 {
        let bytes: Vec<u8> = (0..60)
            .map(|_| {
                state = state.wrapping_mul(6364136223846793005).wrapping_add(1);
                (state >> 56) as u8
            })
            .collect();
        server.raw(&[&bytes[..], b"\r\n\r\n"].concat());
    }
    assert_eq!(server.get("/health").status, 200);
}

#[test]
fn slow_clients_and_too_many_are_let_go() {
    let limits =
        Limits { head_time: Duration::from_millis(300), request_time: Duration::from_millis(600), ..Limits::default() };
    let server = with(limits);
    let begin = Instant::now();
    // A head, letter by letter.
    let mut stream = TcpStream::connect(server.address).unwrap();
    for byte in b"GET / HTTP/1.1\r\nHost: localhost".iter() {
        if stream.write_all(&[*byte]).is_err() || begin.elapsed() > Duration::from_millis(500) {
            break;
        }
        std::thread::sleep(Duration::from_millis(30));
    }
    assert_eq!(Reply::read(stream).status, 408);
    // A body that never comes.
    let begin = Instant::now();
    let told = format!(
        "POST /jobs HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary={BOUNDARY}\r\nContent-Length: 1000\r\n\r\n"
    );
    assert_eq!(server.raw(told.as_bytes()).status, 408);
    assert!(begin.elapsed() < Duration::from_secs(5));
    // More connections than there are places. (These are given time: a starved machine must not free one.)
    let server = with(Limits { connections: 4, ..Limits::default() });
    let idle: Vec<TcpStream> = (0..4).map(|_| TcpStream::connect(server.address).unwrap()).collect();
    std::thread::sleep(Duration::from_millis(50));
    let mut text = String::new();
    let _ = TcpStream::connect(server.address).unwrap().read_to_string(&mut text);
    assert!(text.starts_with("HTTP/1.1 503"), "{text}");
    drop(idle);
    std::thread::sleep(Duration::from_millis(100));
    assert_eq!(server.get("/health").status, 200);
}
