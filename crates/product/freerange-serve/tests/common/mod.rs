//! A server with an engine that needs no model, and a client that speaks plain sockets.
#![allow(dead_code)]

use std::{
    collections::BTreeMap,
    io::{Read, Write},
    net::{SocketAddr, TcpStream},
    ops::ControlFlow,
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex,
        atomic::{AtomicUsize, Ordering::SeqCst},
    },
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

use freerange_gaussians::{Gaussians, channel};
use freerange_scene::camera::{Camera, View};
use freerange_scene::estimate::LeaveOneOut;
use freerange_serve::{
    Engine, EngineError, Example, FoundCameras, JobOptions, Outcome, Quality, Scene, Search, SearchStep, ServeConfig,
    Server, Step, Stopper,
};
use image::RgbaImage;
use serde_json::Value;

pub fn bowl() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../examples/bowl"))
}

macro_rules! files {
    ($($name:literal),*) => { &[$(($name, include_bytes!(concat!("../../../../../examples/bowl/", $name)))),*] };
}

pub const EXAMPLE: Example = Example {
    name: "bowl",
    files: files!["transforms_train.json", "train/000.png", "train/001.png", "train/002.png", "train/003.png"],
};

/// Names of a job's views, which of them it was shown, and its options.
pub type Seen = (Vec<String>, Vec<usize>, JobOptions);

/// Moves a cloud step by step to where the first camera looks from.
#[derive(Default)]
pub struct Fake {
    /// Time per step.
    pub pause: Duration,
    pub steps: usize,
    /// What runs were given: views' names, share of alpha, options.
    pub seen: Mutex<Vec<Seen>>,
    pub running: AtomicUsize,
    pub most_at_once: AtomicUsize,
    pub panics: bool,
    /// What a search for cameras ends with.
    pub finds: Finds,
    /// Searches that were begun, and photos of each.
    pub searches: Mutex<Vec<Vec<String>>>,
}

/// What a search for cameras ends with.
#[derive(Default)]
pub enum Finds {
    /// There is nothing that searches.
    #[default]
    Nobody,
    /// The example's cameras, and a warning.
    Cameras,
    /// A refusal; `SCENE` and `PHOTOS` are the places of these.
    Refused(&'static str),
    /// It goes on until it is stopped.
    Waits,
}

impl Fake {
    pub fn quick() -> Arc<Self> {
        Arc::new(Self { pause: Duration::from_millis(1), steps: 5, ..Self::default() })
    }

    pub fn slow() -> Arc<Self> {
        Arc::new(Self { pause: Duration::from_millis(20), steps: 2000, ..Self::default() })
    }

    pub fn cloud(seed: u64, done: usize) -> Gaussians {
        let mut rows = Vec::new();
        for i in 0..40 {
            let mut row = [0.0; channel::COUNT];
            let t = i as f32;
            (row[0], row[1], row[2]) =
                (0.3 * t.cos(), 0.3 * t.sin(), 0.01 * t + 0.001 * done as f32 + 0.1 * seed as f32);
            (row[3], row[4], row[5], row[6], row[10], row[11]) = (-3.0, -3.0, -3.0, 1.0, 2.0, 0.5);
            rows.extend(row);
        }
        Gaussians::from_rows(rows)
    }
}

impl Engine for Fake {
    fn name(&self) -> String {
        "a cloud that moves".into()
    }

    fn defaults(&self) -> JobOptions {
        JobOptions { quality: Some(Quality::Draft), ..JobOptions::default() }
    }

    fn choose(&self, views: &[View]) -> Result<Vec<usize>, String> {
        Ok((0..views.len()).collect())
    }

    fn leave_one_out(&self) -> Option<LeaveOneOut> {
        None
    }

    fn run(
        &self,
        scene: &Scene,
        options: &JobOptions,
        tell: &mut dyn FnMut(&Step<'_>) -> ControlFlow<()>,
    ) -> Result<Outcome, EngineError> {
        let now = self.running.fetch_add(1, SeqCst) + 1;
        self.most_at_once.fetch_max(now, SeqCst);
        let covered = |v: &View| v.image.pixels().filter(|p| p[3] >= 128).count();
        let names = scene.views.iter().map(|v| v.name.clone()).collect();
        self.seen.lock().unwrap().push((names, scene.views.iter().map(covered).collect(), *options));
        assert!(!self.panics, "this engine panics");
        let seeds = options.seeds();
        let mut ended = false;
        for done in 0..=self.steps {
            let sample = seeds.len() - 1;
            let preview = || Ok(Some(Self::cloud(seeds[sample], done)));
            let step = Step { stage: "refine", sample, done, total: self.steps, loss: None, preview: &preview };
            if tell(&step).is_break() {
                ended = true;
                break;
            }
            thread::sleep(self.pause);
        }
        self.running.fetch_sub(1, SeqCst);
        if ended {
            return Err(EngineError::Cancelled);
        }
        Ok(Outcome {
            samples: seeds.iter().map(|s| (*s, Self::cloud(*s, self.steps))).collect(),
            up: [0.0, 0.0, 1.0],
            notes: vec!["a <b>note</b>".into()],
            seconds: vec![("refine".into(), 0.1)],
        })
    }

    fn picture(&self, cloud: &Gaussians, camera: &Camera) -> Result<RgbaImage, String> {
        let shade = (cloud.len() % 256) as u8;
        Ok(RgbaImage::from_pixel(camera.width, camera.height, image::Rgba([shade, 0, 0, 255])))
    }

    fn camera_finder(&self) -> Result<String, String> {
        match self.finds {
            Finds::Nobody => Err("nobody here finds cameras".into()),
            _ => Ok("a finder".into()),
        }
    }

    fn find_cameras(&self, search: &Search<'_>, tell: &mut dyn FnMut(SearchStep)) -> Result<FoundCameras, EngineError> {
        let mut names = files(search.photos);
        names.sort();
        self.searches.lock().unwrap().push(names);
        assert!(search.work.is_dir() && search.scene.read_dir().unwrap().next().is_none());
        tell(SearchStep { stage: "matches", done: 1, total: 6 });
        match self.finds {
            Finds::Nobody => panic!("nobody was asked"),
            Finds::Cameras => {
                for (name, bytes) in EXAMPLE.files {
                    let path = search.scene.join(name);
                    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
                    std::fs::write(path, bytes).unwrap();
                }
                Ok(FoundCameras {
                    notes: vec!["4 of 4 photos".into()],
                    warnings: vec!["few (--uneven if they did)".into()],
                })
            }
            Finds::Refused(text) => {
                let place = |path: &Path| path.display().to_string();
                Err(EngineError::Input(
                    text.replace("SCENE", &place(search.scene)).replace("PHOTOS", &place(search.photos)),
                ))
            }
            Finds::Waits => {
                while search.stop.check().is_ok() {
                    thread::sleep(Duration::from_millis(5));
                }
                Err(EngineError::Cancelled)
            }
        }
    }
}

/// A server on loopback that ends with the test.
pub struct Running {
    pub address: SocketAddr,
    stopper: Stopper,
    thread: Option<JoinHandle<()>>,
}

impl Running {
    pub fn start(config: ServeConfig, engine: Arc<Fake>) -> Self {
        let server = Server::bind(&config, engine).unwrap();
        let (mut address, stopper) = (server.address(), server.stopper());
        address.set_ip([127, 0, 0, 1].into());
        let thread = thread::spawn(move || server.run().unwrap());
        Self { address, stopper, thread: Some(thread) }
    }

    pub fn plain(engine: Arc<Fake>) -> Self {
        Self::start(ServeConfig { example: Some(EXAMPLE), ..ServeConfig::default() }, engine)
    }

    pub fn stop(mut self) {
        self.end();
    }

    fn end(&mut self) {
        self.stopper.stop();
        if let Some(thread) = self.thread.take() {
            thread.join().unwrap();
        }
    }

    /// Sends bytes, and reads until the server closes.
    pub fn raw(&self, bytes: &[u8]) -> Reply {
        let mut stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        // A server may answer and close before it has read all.
        let _ = stream.write_all(bytes);
        Reply::read(stream)
    }

    pub fn send(&self, method: &str, path: &str, headers: &str, body: &[u8]) -> Reply {
        let head = format!(
            "{method} {path} HTTP/1.1\r\nHost: {}\r\n{headers}Content-Length: {}\r\n\r\n",
            self.address,
            body.len()
        );
        self.raw(&[head.as_bytes(), body].concat())
    }

    /// The answer to a `PUT` of which only the head and the first byte were sent.
    pub fn begun(&self, path: &str, length: usize) -> Reply {
        let head = format!("PUT {path} HTTP/1.1\r\nHost: {}\r\nContent-Length: {length}\r\n\r\n1", self.address);
        self.raw(head.as_bytes())
    }

    pub fn get(&self, path: &str) -> Reply {
        self.send("GET", path, "", b"")
    }

    pub fn json(&self, path: &str) -> Value {
        let reply = self.get(path);
        assert_eq!(reply.status, 200, "{path}: {}", reply.text());
        reply.json()
    }

    pub fn post_form(&self, parts: &[Part]) -> Reply {
        self.send("POST", "/jobs", &format!("Content-Type: multipart/form-data; boundary={BOUNDARY}\r\n"), &form(parts))
    }

    /// Posts the example, at once to be computed, and returns its id.
    pub fn example(&self, go: &str) -> String {
        let reply = self.post_form(&[Part::field("example", "bowl"), Part::field("go", go)]);
        assert_eq!(reply.status, 201, "{}", reply.text());
        reply.json()["id"].as_str().unwrap().to_owned()
    }

    /// Waits until the job is in one of `states`.
    pub fn until(&self, id: &str, states: &[&str]) -> Value {
        let begin = Instant::now();
        loop {
            let job = self.json(&format!("/jobs/{id}"));
            if states.contains(&job["state"].as_str().unwrap()) {
                return job;
            }
            assert!(begin.elapsed() < Duration::from_secs(120), "{states:?} never came: {job}");
            thread::sleep(Duration::from_millis(5));
        }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.end();
    }
}

pub struct Reply {
    pub status: u16,
    pub headers: BTreeMap<String, String>,
    pub body: Vec<u8>,
}

impl Reply {
    pub fn read(mut stream: TcpStream) -> Self {
        let mut bytes = Vec::new();
        let mut chunk = [0; 65536];
        // A reset after the answer takes nothing back of what was read.
        while let Ok(n @ 1..) = stream.read(&mut chunk) {
            bytes.extend_from_slice(&chunk[..n]);
        }
        let Some(end) = bytes.windows(4).position(|w| w == b"\r\n\r\n") else {
            return Self { status: 0, headers: BTreeMap::new(), body: bytes };
        };
        let head = String::from_utf8(bytes[..end].to_vec()).unwrap();
        let mut lines = head.split("\r\n");
        let status = lines.next().unwrap().split(' ').nth(1).unwrap().parse().unwrap();
        let headers =
            lines.map(|l| l.split_once(": ").unwrap()).map(|(k, v)| (k.to_lowercase(), v.to_owned())).collect();
        Self { status, headers, body: bytes[end + 4..].to_vec() }
    }

    pub fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }

    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|e| panic!("{e}: {}", self.text()))
    }

    pub fn error(&self) -> String {
        self.json()["error"].as_str().unwrap().to_owned()
    }
}

pub const BOUNDARY: &str = "----a-boundary";

#[derive(Clone)]
pub struct Part {
    pub name: String,
    pub file: Option<String>,
    pub bytes: Vec<u8>,
}

impl Part {
    pub fn field(name: &str, text: &str) -> Self {
        Self { name: name.into(), file: None, bytes: text.into() }
    }

    pub fn file(path: &str, bytes: impl Into<Vec<u8>>) -> Self {
        Self { name: "files".into(), file: Some(path.into()), bytes: bytes.into() }
    }
}

pub fn form(parts: &[Part]) -> Vec<u8> {
    let mut body = Vec::new();
    for part in parts {
        let file = part.file.as_ref().map_or(String::new(), |f| format!("; filename=\"{f}\""));
        body.extend(
            format!("--{BOUNDARY}\r\nContent-Disposition: form-data; name=\"{}\"{file}\r\n\r\n", part.name).bytes(),
        );
        body.extend(&part.bytes);
        body.extend(b"\r\n");
    }
    body.extend(format!("--{BOUNDARY}--\r\n").bytes());
    body
}

/// The example as a browser sends a dropped folder.
pub fn folder(prefix: &str) -> Vec<Part> {
    EXAMPLE.files.iter().map(|(name, bytes)| Part::file(&format!("{prefix}{name}"), *bytes)).collect()
}

pub fn png(image: &RgbaImage) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}

/// A PNG's head with this size, and nothing to decode: four billion pixels cost a client 33 bytes.
pub fn bomb(width: u32, height: u32) -> Vec<u8> {
    let mut bytes = png(&RgbaImage::new(1, 1));
    bytes[16..20].copy_from_slice(&width.to_be_bytes());
    bytes[20..24].copy_from_slice(&height.to_be_bytes());
    let sum = crc(&bytes[12..29]);
    bytes[29..33].copy_from_slice(&sum.to_be_bytes());
    bytes
}

fn crc(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |crc, b| {
        (0..8).fold(crc ^ u32::from(*b), |c, _| if c & 1 == 1 { 0xedb8_8320 ^ (c >> 1) } else { c >> 1 })
    })
}

/// Hostile uploads, by name; a file of more than two megabytes is too large.
pub fn hostile(i: usize) -> (&'static str, Vec<Part>) {
    let mut cut = folder("x/");
    cut[3].bytes.truncate(10_000);
    let mut nested = folder("x/");
    nested[0].bytes = "[".repeat(50_000).into();
    let kinds = [
        ("bomb", vec![Part::file("a.png", bomb(60_000, 60_000))]),
        ("path", vec![Part::file("../../../a.png", EXAMPLE.files[1].1)]),
        ("archive", vec![Part::file("a.zip", "PK")]),
        ("no picture", vec![Part::file("a.png", "no picture")]),
        ("cut picture", cut),
        ("nested JSON", nested),
        ("too large", vec![Part::file("a.bin", vec![0; 3 << 20])]),
    ];
    kinds[i % kinds.len()].clone()
}

/// Every file below `folder`.
pub fn files(folder: &Path) -> Vec<String> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap().map(Result::unwrap) {
        match entry.file_type().unwrap().is_dir() {
            true => found.extend(files(&entry.path())),
            false => found.push(entry.path().to_string_lossy().into_owned()),
        }
    }
    found
}
