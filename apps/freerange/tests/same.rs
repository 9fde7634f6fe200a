//! The same settings give the same result, whoever is asked: the program, the library, and the page's server. (Python:
//! `python/tests/test_reconstruct.py`.)

use std::{
    fs,
    io::{BufRead, BufReader, Read, Write},
    net::TcpStream,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use freerange::{Choices, Detect, Device, Gaussians, Options, Reconstruction, Reconstructor, Scene};
use serde_json::Value;

fn bowl() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/bowl")
}

/// Quick, and away from the defaults.
const ITERATIONS: usize = 6;

/// What the library makes of the bowl with these settings, and all of them.
fn of_library() -> (Options, Reconstruction) {
    let model = Reconstructor::shipped(&Device::cpu()).unwrap();
    let scene = Scene::open(&bowl()).unwrap();
    let choices = Choices {
        iterations: Some(ITERATIONS),
        symmetry: Some(Detect::Off),
        set: vec![("propose.count".into(), "2".into())],
        ..Choices::default()
    };
    let mut options = model.options_of(&choices).unwrap();
    (options.seeds, options.frame) = (vec![3], scene.frame);
    let made = model.run(scene.views(), &options, &mut |_| std::ops::ControlFlow::Continue(())).unwrap();
    (options, made)
}

#[test]
fn the_library_gives_what_the_program_gives() {
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("out");
    let (scene, output) = (bowl(), out.to_str().unwrap());
    let options = ["--iterations", "6", "--symmetry", "off", "--seed", "3", "--set", "propose.count=2"];
    let command = ["reconstruct", scene.to_str().unwrap(), "-o", output, "--device", "cpu"];
    let done = Command::new(env!("CARGO_BIN_EXE_freerange")).args(command).args(options).output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));

    let (options, made) = of_library();
    let own = place.path().join("own.ply");
    made.write(&own).unwrap();
    assert_eq!(fs::read(own).unwrap(), fs::read(out.join("gaussians.ply")).unwrap());
    let report: Value = serde_json::from_slice(&fs::read(out.join("report.json")).unwrap()).unwrap();
    assert_eq!(report["pipeline"], serde_json::to_value(&options.pipeline).unwrap());
}

/// A server that ends with the test.
struct Server(Child, String);

impl Drop for Server {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().ok();
    }
}

impl Server {
    fn start(options: &[&str]) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_freerange"));
        command.args(["serve", "--port", "0", "--device", "cpu", "--no-token"]).args(options).stdout(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let mut url = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut url).unwrap();
        Self(child, url.trim().trim_start_matches("http://").trim_end_matches('/').to_owned())
    }

    /// Status and body of a request.
    fn ask(&self, method: &str, path: &str, kind: &str, body: &str) -> (u16, Vec<u8>) {
        let mut stream = TcpStream::connect(&self.1).unwrap();
        let length = body.len();
        let head = format!("{method} {path} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n", self.1);
        write!(stream, "{head}Content-Type: {kind}\r\nContent-Length: {length}\r\n\r\n{body}").unwrap();
        let mut reply = Vec::new();
        stream.read_to_end(&mut reply).unwrap();
        let end = reply.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
        let status = std::str::from_utf8(&reply[9..12]).unwrap().parse().unwrap();
        (status, reply[end + 4..].to_vec())
    }

    fn json(&self, method: &str, path: &str, kind: &str, body: &str) -> Value {
        let (status, reply) = self.ask(method, path, kind, body);
        assert!((200..300).contains(&status), "{method} {path}: {status} {}", String::from_utf8_lossy(&reply));
        serde_json::from_slice(&reply).unwrap()
    }

    /// Waits until a job has come to `state`.
    fn until(&self, id: &str, state: &str) -> Value {
        let begin = Instant::now();
        loop {
            let job = self.json("GET", &format!("/jobs/{id}"), "text/plain", "");
            if job["state"] == state {
                return job;
            }
            assert!(job["state"] != "failed" && begin.elapsed() < Duration::from_secs(300), "{job}");
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

#[test]
fn the_page_gives_what_the_library_gives() {
    let server = Server::start(&["--symmetry", "off", "--set", "propose.count=2"]);
    let field = |name: &str, value: &str| {
        format!("--line\r\nContent-Disposition: form-data; name=\"{name}\"\r\n\r\n{value}\r\n")
    };
    let form = field("example", "bowl") + &field("go", r#"{"iterations": 6, "seed": 3}"#) + "--line--\r\n";
    let job = server.json("POST", "/jobs", "multipart/form-data; boundary=line", &form);
    let id = job["id"].as_str().unwrap();
    server.until(id, "done");
    let (status, rows) = server.ask("GET", &format!("/jobs/{id}/samples/0"), "text/plain", "");
    assert_eq!(status, 200);
    let rows: Vec<f32> = rows.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();

    let (_, made) = of_library();
    let expected: &Gaussians = &made.samples[0].gaussians;
    // The server keeps results in a file, in which colors are rounded.
    assert_eq!(rows.len(), expected.rows().len());
    let worst = rows.iter().zip(expected.rows()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(worst < 1e-6, "{worst}");
}
