//! What is answered to whom.

use std::{
    fs::File,
    io::{self, Write},
    net::TcpStream,
    path::Path,
    sync::{Arc, atomic::Ordering::Relaxed},
    time::Duration,
};

use freerange_gaussians::formats::Format;
use serde_json::json;

use crate::{
    Example, JobOptions, Refusal,
    board::{Board, is_id},
    guard::{COOKIE, Guard},
    http::{Content, Request, Response},
    multipart::{Multipart, boundary},
    page, record,
    scene::{self, SceneOptions},
    upload::Upload,
};

/// Most bytes of a JSON body or a text field.
const TEXT: u64 = 64 << 10;
/// Most bytes of a mask.
const MASK: u64 = 16 << 20;
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
    let response = answer(site, &mut request).unwrap_or_else(|e| refused(&e));
    site.board.metrics.answered(response.status);
    response.send(request.into_stream(), head_only);
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
            let text = board.metrics.text(&board.counts());
            Ok(Response::new("text/plain; version=0.0.4; charset=utf-8", Content::Bytes(text.into_bytes())))
        }
        ("GET", ["server"]) => Ok(server(site)),
        ("GET", ["jobs"]) => Ok(Response::json(&board.list())),
        ("POST", ["jobs"]) => post(site, request),
        ("GET", ["jobs", id]) => Ok(Response::json(&board.get(id)?)),
        ("DELETE", ["jobs", id]) => board.remove(id).map(|()| Response::json(&json!({}))),
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
        ("GET", ["jobs", id, "samples", name]) => sample(board, id, name),
        ("PUT", ["jobs", id, "masks", k]) => {
            let png = request.body(MASK)?;
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

/// Where there is a token: takes it from the address into a cookie, and keeps out who does not know it.
fn login(site: &Site, request: &Request) -> Option<Answer> {
    if request.path == "/" && request.method == "GET" {
        let told = request.query.split('&').find_map(|pair| pair.strip_prefix("token="));
        if let Some(token) = told.filter(|t| site.guard.is_token(t)) {
            let cookie = format!("{COOKIE}={token}; Path=/; HttpOnly; SameSite=Strict");
            let there = Response::text(String::new()).status(303);
            return Some(Ok(there.header("Location", "/").header("Set-Cookie", cookie)));
        }
    }
    if site.guard.admits(request) {
        return None;
    }
    if request.path == "/" {
        let ask = Response::new("text/html; charset=utf-8", Content::Text(page::LOGIN));
        return Some(Ok(ask.status(401)));
    }
    Some(Ok(refused(&Refusal::new(401, "the token is needed: Authorization: Bearer TOKEN"))
        .header("WWW-Authenticate", "Bearer")))
}

fn server(site: &Site) -> Response {
    let limits = site.board.limits();
    Response::json(&json!({
        "version": env!("CARGO_PKG_VERSION"),
        "engine": site.board.engine_name(),
        "example": site.example.map(|e| e.name),
        "limits": {
            "bytes": limits.bytes, "file_bytes": limits.file_bytes, "files": limits.files, "pixels": limits.pixels,
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

/// Takes the files of a new job, or the example.
fn post(site: &Site, request: &mut Request) -> Answer {
    let board = &site.board;
    let limits = *board.limits();
    // Headers of parts count, too.
    request.at_most(limits.bytes + (1 << 20))?;
    let kind = boundary(request.header("content-type"))?.to_owned();
    let arriving = board.arrive()?;
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
        (None, _) if upload.title.is_none() => {
            return Err(Refusal::new(422, "expected files of photos and cameras, found none"));
        }
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
    board.metrics.uploaded.fetch_add(upload.bytes, Relaxed);
    let title = upload.title.take().unwrap_or_default();
    let passed_over = std::mem::take(&mut upload.passed_over);
    let id = arriving.submit(title, scene, options, passed_over)?;
    Ok(Response::json(&board.get(&id)?).status(201))
}

fn sample(board: &Board, id: &str, name: &str) -> Answer {
    let (i, format) = name.split_once('.').map_or((name, None), |(i, f)| (i, Some(f)));
    let i = number(i, 64)?;
    let Some(format) = format else {
        return Ok(Response::new("application/octet-stream", Content::Bytes(board.rows(id, i)?)));
    };
    let format = Format::ALL.into_iter().find(|f| f.extension() == format).ok_or_else(missing)?;
    let (bytes, name) = board.result(id, i, format)?;
    let disposition = format!("attachment; filename=\"{name}\"");
    Ok(Response::new("application/octet-stream", Content::Bytes(bytes)).header("Content-Disposition", disposition))
}

fn picture(path: &Path) -> Answer {
    let file = File::open(path).map_err(|_| missing())?;
    let length = file.metadata().map_err(Refusal::own)?.len();
    Ok(Response::new("image/png", Content::File(file, length)))
}

/// Server-sent events: the job's status, whenever it changes, until it is gone or the client is.
fn events(site: &Site, id: &str) -> Answer {
    let (board, id) = (site.board.clone(), id.to_owned());
    board.folder(&id)?;
    let write = move |stream: &mut TcpStream| -> io::Result<()> {
        let mut version = 0;
        stream.write_all(b"retry: 1000\n\n")?;
        loop {
            match board.wait(&id, version, HEARTBEAT) {
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
