//! What is answered to whom.

use std::{
    fs::File,
    io::{self, Write},
    path::Path,
    sync::{Arc, atomic::Ordering::Relaxed},
    time::{Duration, Instant},
};

use freerange_gaussians::formats::Format;
use serde_json::json;

use crate::{
    Example, JobOptions, Refusal,
    board::{Board, Held, Submission, is_id},
    guard::{Guard, cookie},
    http::{Content, Request, Response, Until},
    multipart::{Multipart, boundary},
    page, record,
    scene::{self, SceneOptions},
    upload::Upload,
};

/// Most bytes of a JSON body or a text field.
const TEXT: u64 = 64 << 10;
/// Most bytes of a mask.
const MASK: u64 = 16 << 20;
/// Most Gaussians that a client may choose among, a byte each.
const KEPT: u64 = 16 << 20;
/// What is said where there is nothing to read.
const NOTHING: &str = "no photo and no file of Gaussians was sent: expected photos (JPEG, PNG or WebP) with their cameras, or one file of \
                       Gaussians (.ply, .splat, .spz, .sog, .glb, .usda, .usdz or .html)";
/// Most photos a client may number.
const PHOTOS: usize = 10_000;
/// A stream without news says so after this time, so that it is noticed when a client has gone.
const HEARTBEAT: Duration = Duration::from_secs(10);
/// Least time between two events.
const BETWEEN: Duration = Duration::from_millis(40);

/// All that answers need.
pub struct Site {
    pub board: Arc<Board>,
    pub guard: Guard,
    pub example: Option<Example>,
}

type Answer = Result<Response, Refusal>;

/// A refusal as an answer.
pub fn refused(refusal: &Refusal) -> Response {
    Response::json(&json!({ "error": refusal.text })).status(refusal.status)
}

/// Answers one request, and ends its connection.
pub fn serve(site: &Site, mut request: Request) {
    let head_only = request.method == "HEAD";
    if head_only {
        request.method = "GET".into();
    }
    // Errors in the log name it.
    let span = tracing::error_span!("request", method = %request.method, path = ?request.path);
    let response = span.in_scope(|| answer(site, &mut request)).unwrap_or_else(|e| refused(&e));
    site.board.metrics.answered(response.status);
    let limits = site.board.limits();
    // A stream ends by itself; its last event may take a moment.
    let most = match response.content {
        Content::Stream(_) => limits.stream_time + HEARTBEAT,
        _ => limits.answer_time,
    };
    response.send(request.into_stream(), head_only, most);
}

fn missing() -> Refusal {
    Refusal::new(404, "there is nothing at this address")
}

/// A number as our own addresses have it.
fn number(text: &str, below: usize) -> Result<usize, Refusal> {
    let digits = !text.is_empty() && text.len() < 10 && text.bytes().all(|b| b.is_ascii_digit());
    text.parse().ok().filter(|n| digits && *n < below).ok_or_else(missing)
}

fn answer(site: &Site, request: &mut Request) -> Answer {
    // Probes of an orchestrator come by address and know no secret; they learn one word.
    if request.path == "/health" && request.method == "GET" {
        return Ok(Response::text("ok\n".into()));
    }
    site.guard.check_place(request)?;
    if let Some(login) = login(site, request) {
        return login;
    }
    let path = request.path.clone();
    let parts: Vec<&str> = path.split('/').skip(1).collect();
    let board = &site.board;
    if let ["jobs", id, ..] = parts[..]
        && !is_id(id)
    {
        return Err(missing());
    }
    match (request.method.as_str(), &parts[..]) {
        ("GET", ["metrics"]) => {
            let text = board.metrics.text(&board.counts(), board.disk());
            Ok(Response::new("text/plain; version=0.0.4; charset=utf-8", Content::Bytes(text.into_bytes())))
        }
        ("GET", ["server"]) => Ok(server(site)),
        ("GET", ["jobs"]) => Ok(Response::json(&board.list())),
        ("POST", ["jobs"]) => post(site, request),
        ("GET", ["jobs", id]) => Ok(Response::json(&board.get(id)?)),
        ("DELETE", ["jobs", id]) => board.remove(id).map(|()| Response::json(&json!({}))),
        ("POST", ["jobs", id, "restore"]) => {
            board.restore(id)?;
            Ok(Response::json(&board.get(id)?))
        }
        ("PUT", ["jobs", id, "title"]) => {
            let Title { title } = body(request)?;
            board.rename(id, &title)?;
            Ok(Response::json(&board.get(id)?))
        }
        ("POST", ["jobs", id, "go"]) => {
            let options: JobOptions = body(request)?;
            board.go(id, options)?;
            Ok(Response::json(&board.get(id)?))
        }
        ("POST", ["jobs", id, "cancel"]) => {
            board.cancel(id)?;
            Ok(Response::json(&board.get(id)?))
        }
        ("GET", ["jobs", id, "events"]) => events(site, id),
        ("GET", ["jobs", id, "estimates", n, sample]) => {
            let rows = board.estimate(id, number(n, usize::MAX)? as u64, number(sample, 64)?)?;
            Ok(Response::new("application/octet-stream", Content::Bytes(rows.to_vec())))
        }
        (_, ["jobs", id, "samples", rest @ ..]) => samples(board, request, id, rest),
        ("PUT", ["jobs", id, "masks", k]) => {
            board.folder(id)?;
            let (png, _held) = held_body(board, request, MASK)?;
            let covers = board.edit_mask(id, number(k, PHOTOS)?, &png)?;
            Ok(Response::json(&json!({ "covers": covers })))
        }
        ("GET", ["jobs", id, what, name]) if ["photos", "views"].contains(what) => {
            let k = number(name.strip_suffix(".png").ok_or_else(missing)?, PHOTOS)?;
            let folder = board.folder(id)?;
            picture(&if *what == "views" { scene::view_file(&folder, k) } else { scene::whole_file(&folder, k) })
        }
        ("GET", ["jobs", id, "thumbnail.png"]) => picture(&record::thumbnail_file(&board.folder(id)?)),
        ("GET", ["jobs", id, "sheet.png"]) => picture(&scene::sheet_file(&board.folder(id)?)),
        (method, _) => {
            let found = page::FILES.iter().find(|(name, ..)| *name == path);
            match (method, found) {
                ("GET", Some((_, kind, text))) => Ok(Response::new(kind, Content::Text(text))),
                (_, Some(_)) => Err(Refusal::new(405, "this address is for GET")),
                ("GET" | "POST" | "PUT" | "DELETE", None) => Err(missing()),
                _ => Err(Refusal::new(405, "this method is not served")),
            }
        }
    }
}

/// A job's new title.
#[derive(Default, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Title {
    title: String,
}

/// Where there is a token: takes it from the address or the form into a cookie, and keeps out who does not know it.
fn login(site: &Site, request: &mut Request) -> Option<Answer> {
    if !site.guard.asks() {
        return None;
    }
    // What the page that asks needs itself.
    if let Some((_, kind, text)) = page::OPEN.iter().find(|(name, ..)| *name == request.path && request.method == "GET")
    {
        return Some(Ok(Response::new(kind, Content::Text(text))));
    }
    let mut told = None;
    if request.path == "/" {
        let form = match request.method.as_str() {
            "GET" => request.query.clone(),
            "POST" => match request.body(TEXT) {
                Ok(bytes) => String::from_utf8_lossy(&bytes).into_owned(),
                Err(e) => return Some(Err(e)),
            },
            _ => String::new(),
        };
        told = form.split('&').find_map(|pair| pair.strip_prefix("token=").map(str::to_owned));
    }
    if let Some(token) = told.as_deref().filter(|t| site.guard.is_token(t)) {
        let cookie = format!("{}={token}; Path=/; HttpOnly; SameSite=Strict", cookie(request));
        // No redirect: a browser that follows a link of another site sends no Strict cookie to where it leads. This page goes on by itself.
        let enter = Response::new("text/html; charset=utf-8", Content::Text(page::ENTER));
        return Some(Ok(enter.header("Set-Cookie", cookie)));
    }
    if site.guard.admits(request) {
        return None;
    }
    if request.path == "/" {
        // Whoever followed a link of another site may have the cookie all the same: asked again from here, the browser sends it.
        let elsewhere = matches!(request.header("sec-fetch-site"), Some("cross-site" | "same-site"));
        let text = match (elsewhere && told.is_none(), told) {
            (true, _) => page::ENTER,
            (_, None) => page::LOGIN,
            (_, Some(_)) => &page::REFUSED,
        };
        return Some(Ok(Response::new("text/html; charset=utf-8", Content::Text(text)).status(401)));
    }
    Some(Ok(refused(&Refusal::new(401, "the token is needed: Authorization: Bearer TOKEN"))
        .header("WWW-Authenticate", "Bearer")))
}

fn server(site: &Site) -> Response {
    let limits = site.board.limits();
    Response::json(&json!({
        "version": env!("CARGO_PKG_VERSION"),
        "engine": site.board.engine_name(),
        "defaults": site.board.defaults(),
        "example": site.example.map(|e| e.name),
        "camera_finder": match site.board.camera_finder() {
            Ok(name) => json!({ "name": name }),
            Err(missing) => json!({ "missing": missing }),
        },
        "limits": {
            "bytes": limits.bytes, "file_bytes": limits.file_bytes, "files": limits.files, "pixels": limits.pixels,
            "job_pixels": limits.job_pixels, "side": limits.side, "memory": limits.memory, "disk": limits.disk,
            "read_seconds": limits.read_time.as_secs(), "search_seconds": limits.search_time.as_secs(),
            "job_seconds": limits.job_time.as_secs(),
        },
    }))
}

/// A JSON body; nothing at all means all defaults.
fn body<T: serde::de::DeserializeOwned + Default>(request: &mut Request) -> Result<T, Refusal> {
    let bytes = request.body(TEXT)?;
    if bytes.is_empty() {
        return Ok(T::default());
    }
    serde_json::from_slice(&bytes).map_err(|e| Refusal::new(422, format!("body: {e}")))
}

/// A body of at most so many bytes, and the memory that it takes: many that arrive slowly may not take all there is.
fn held_body(board: &Arc<Board>, request: &mut Request, most: u64) -> Result<(Vec<u8>, Held), Refusal> {
    request.at_most(most)?;
    let held = Held::bytes(board, request.length)?;
    Ok((request.body(most)?, held))
}

/// Takes the files of a new job, or the example.
fn post(site: &Site, request: &mut Request) -> Answer {
    let board = &site.board;
    let limits = *board.limits();
    // Headers of parts count, too.
    request.at_most(limits.bytes + (1 << 20))?;
    let kind = boundary(request.header("content-type"))?.to_owned();
    let arriving = board.arrive(request.length)?;
    let folder = arriving.upload.clone();
    let mut upload = Upload::new(&folder, &limits);
    let mut scene = SceneOptions::default();
    let mut options: Option<JobOptions> = None;
    let mut example = None;
    let mut form = Multipart::new(|out: &mut [u8]| request.read_body(out), &kind);
    let mut fields = 0;
    while let Some(part) = form.next()? {
        if let Some(name) = &part.file {
            upload.file(name, |out| form.read(out))?;
            if upload.bytes > limits.bytes {
                return Err(Refusal::new(413, format!("expected files of at most {} bytes together", limits.bytes)));
            }
            continue;
        }
        fields += 1;
        if fields > 8 {
            return Err(Refusal::new(422, "expected at most 8 fields beside the files"));
        }
        let text = form.text(TEXT as usize)?;
        let refused = |e: serde_json::Error| {
            Refusal::new(422, format!("field `{}`: {e}", part.name.chars().take(40).collect::<String>()))
        };
        match part.name.as_str() {
            "scene" => scene = serde_json::from_str(&text).map_err(refused)?,
            "go" => options = Some(serde_json::from_str(&text).map_err(refused)?),
            "example" => example = Some(text),
            _ => return Err(Refusal::new(422, "expected the fields scene, go or example, and files")),
        }
    }
    scene.check()?;
    if let Some(options) = &options {
        options.check().map_err(|e| Refusal::new(422, e))?;
    }
    match (example, &site.example) {
        (None, _) if !upload.is_of_use() => return Err(Refusal::new(422, NOTHING)),
        (None, _) => {}
        (Some(_), _) if upload.title.is_some() => {
            return Err(Refusal::new(422, "expected files or the example, found both"));
        }
        (Some(name), Some(example)) if name == example.name => {
            for (name, bytes) in example.files {
                let mut left = *bytes;
                upload.file(name, |out| io::Read::read(&mut left, out).map_err(Refusal::own))?;
            }
            upload.title = Some(example.name.into());
        }
        (Some(_), _) => return Err(Refusal::new(404, "there is no such example")),
    }
    let splats = upload.only_splats()?;
    if scene.find_cameras && splats.is_none() {
        board.camera_finder().map_err(|missing| Refusal::new(422, missing))?;
    }
    if splats.is_some() && options.is_some() {
        return Err(Refusal::new(422, "field `go`: expected photos; a file of Gaussians is shown, not computed"));
    }
    board.metrics.uploaded.fetch_add(upload.bytes, Relaxed);
    let title = upload.title.take().unwrap_or_default();
    let passed_over = std::mem::take(&mut upload.passed_over);
    let bytes = upload.bytes;
    let id = arriving.submit(Submission { title, scene, go: options, splats, passed_over, bytes })?;
    Ok(Response::json(&board.get(&id)?).status(201))
}

/// What is below the samples of a job.
fn samples(board: &Arc<Board>, request: &mut Request, id: &str, rest: &[&str]) -> Answer {
    match (request.method.as_str(), rest) {
        ("GET", [name]) => sample(board, id, name),
        ("GET", [i, what @ ("whole" | "kept")]) => {
            let i = number(i, 64)?;
            let held = Held::take(board, id, i)?;
            let bytes = if *what == "kept" { board.kept(id, i)? } else { board.whole_rows(id, i)? };
            Ok(Response::new("application/octet-stream", Content::Bytes(bytes)).holding(held))
        }
        ("PUT", [i, "kept"]) => {
            let i = number(i, 64)?;
            drop(Held::take(board, id, i)?);
            // A byte of it goes with many of the result, which are counted from here on.
            let (kept, _) = held_body(board, request, KEPT)?;
            let _held = Held::take(board, id, i)?;
            Ok(Response::json(&json!({ "gaussians": board.keep(id, i, &kept)? })))
        }
        _ => Err(missing()),
    }
}

fn sample(board: &Arc<Board>, id: &str, name: &str) -> Answer {
    let (i, format) = name.split_once('.').map_or((name, None), |(i, f)| (i, Some(f)));
    let i = number(i, 64)?;
    let Some(format) = format else {
        let held = Held::take(board, id, i)?;
        return Ok(Response::new("application/octet-stream", Content::Bytes(board.rows(id, i)?)).holding(held));
    };
    let format = Format::ALL.into_iter().find(|f| f.extension() == format).ok_or_else(missing)?;
    let held = Held::take(board, id, i)?;
    let (bytes, name) = board.result(id, i, format)?;
    let disposition = format!("attachment; filename=\"{name}\"");
    let file = Response::new("application/octet-stream", Content::Bytes(bytes));
    Ok(file.header("Content-Disposition", disposition).holding(held))
}

fn picture(path: &Path) -> Answer {
    let file = File::open(path).map_err(|_| missing())?;
    let length = file.metadata().map_err(Refusal::own)?.len();
    Ok(Response::new("image/png", Content::File(file, length)))
}

/// One of the streams that may be open at a time: they leave places for all else.
struct StreamPlace(Arc<Board>);

impl StreamPlace {
    fn take(board: &Arc<Board>) -> Result<Self, Refusal> {
        let place = Self(board.clone());
        let before = board.metrics.streams.fetch_add(1, Relaxed);
        let most = (board.limits().connections as u64 * 2).div_ceil(3);
        match before < most {
            true => Ok(place),
            false => Err(Refusal::new(503, format!("{most} streams of events are open, which is the limit"))),
        }
    }
}

impl Drop for StreamPlace {
    fn drop(&mut self) {
        self.0.metrics.streams.fetch_sub(1, Relaxed);
    }
}

/// Server-sent events: the job's status, whenever it changes, until it is gone or the client is.
fn events(site: &Site, id: &str) -> Answer {
    let (board, id) = (site.board.clone(), id.to_owned());
    board.folder(&id)?;
    let place = StreamPlace::take(&board)?;
    let end = Instant::now() + board.limits().stream_time;
    let write = move |stream: &mut Until| -> io::Result<()> {
        let _place = place;
        let mut version = 0;
        stream.write_all(b"retry: 1000\n\n")?;
        loop {
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() || stream.is_over() {
                // The page opens another one.
                return Ok(());
            }
            match board.wait(&id, version, HEARTBEAT.min(left)) {
                Ok(Some((newer, status))) => {
                    version = newer;
                    stream.write_all(format!("event: job\nid: {version}\ndata: {status}\n\n").as_bytes())?;
                    std::thread::sleep(BETWEEN);
                }
                Ok(None) => stream.write_all(b": still here\n\n")?,
                Err(e) => {
                    let told = json!({ "error": e.text });
                    return stream.write_all(format!("event: gone\ndata: {told}\n\n").as_bytes());
                }
            }
        }
    };
    Ok(Response::new("text/event-stream", Content::Stream(Box::new(write))).header("X-Accel-Buffering", "no"))
}
