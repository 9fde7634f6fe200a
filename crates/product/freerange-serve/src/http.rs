//! As much of HTTP/1.1 as the page needs: one request per connection, bodies of a told length, everything bounded in bytes and time.

use std::{
    fs::File,
    io::{self, Read, Write},
    net::{Shutdown, TcpStream},
    time::{Duration, Instant},
};

use crate::Refusal;

/// Most bytes of a request's head.
const HEAD: usize = 16 << 10;
/// Most headers of a request.
const HEADERS: usize = 64;
/// A client that reads nothing for so long is let go, however long the whole answer may take.
const WRITE_TIMEOUT: Duration = Duration::from_secs(20);
/// Longest wait for a client that goes on sending after it was answered.
const LINGER: Duration = Duration::from_secs(3);

/// How long a client may take.
#[derive(Clone, Copy, Debug)]
pub struct Patience {
    /// For the head.
    pub head: Duration,
    /// For the whole request.
    pub whole: Duration,
}

/// A request whose body may still be on its way.
pub struct Request {
    pub method: String,
    /// Without the query; as sent, since nothing that we serve needs escapes.
    pub path: String,
    pub query: String,
    headers: Vec<(String, String)>,
    /// The length that the body was told to have.
    pub length: u64,
    left: u64,
    early: Vec<u8>, // bytes of the body that came with the head
    stream: TcpStream,
    expects: bool,
    deadline: Instant,
}

fn closed() -> Refusal {
    Refusal::new(400, "the connection ended early")
}

/// Reads once, waiting no longer than until `deadline`.
fn read_until(stream: &TcpStream, out: &mut [u8], deadline: Instant) -> Result<usize, Refusal> {
    let late = || Refusal::new(408, "the request took too long");
    let left = deadline.checked_duration_since(Instant::now()).filter(|d| !d.is_zero()).ok_or_else(late)?;
    stream.set_read_timeout(Some(left)).map_err(|_| closed())?;
    loop {
        match (&mut &*stream).read(out) {
            Ok(n) => return Ok(n),
            Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
            Err(e) if matches!(e.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) => return Err(late()),
            Err(_) => return Err(closed()),
        }
    }
}

impl Request {
    /// Reads a head. None where the client left without a word.
    pub fn read(stream: TcpStream, patience: Patience) -> Result<Option<Self>, (TcpStream, Refusal)> {
        match Self::parse(&stream, patience) {
            Ok(None) => Ok(None),
            Ok(Some(parsed)) => {
                let Head { method, target, headers, length, early } = parsed;
                let (path, query) = target.split_once('?').unwrap_or((&target, ""));
                let (path, query) = (path.to_owned(), query.to_owned());
                let expects = headers.iter().any(|(k, v)| k == "expect" && v.eq_ignore_ascii_case("100-continue"));
                let deadline = Instant::now() + patience.whole;
                Ok(Some(Self { method, path, query, headers, length, left: length, early, stream, expects, deadline }))
            }
            Err(refusal) => Err((stream, refusal)),
        }
    }

    fn parse(stream: &TcpStream, patience: Patience) -> Result<Option<Head>, Refusal> {
        let deadline = Instant::now() + patience.head;
        let large = || Refusal::new(431, format!("the head is larger than {HEAD} bytes"));
        let mut bytes = Vec::new();
        let mut chunk = [0; 4096];
        let end = loop {
            let n = read_until(stream, &mut chunk, deadline)?;
            if n == 0 {
                return if bytes.is_empty() { Ok(None) } else { Err(closed()) };
            }
            let from = bytes.len().saturating_sub(3);
            bytes.extend_from_slice(&chunk[..n]);
            if let Some(at) = bytes[from..].windows(4).position(|w| w == b"\r\n\r\n") {
                break from + at + 4;
            }
            if bytes.len() > HEAD {
                return Err(large());
            }
        };
        if end > HEAD {
            return Err(large());
        }
        let mut slots = [httparse::EMPTY_HEADER; HEADERS];
        let mut parsed = httparse::Request::new(&mut slots);
        let malformed = |e: &dyn std::fmt::Display| Refusal::new(400, format!("malformed request: {e}"));
        match parsed.parse(&bytes[..end]) {
            Ok(httparse::Status::Complete(_)) => {}
            Ok(httparse::Status::Partial) => return Err(malformed(&"it ends early")),
            Err(httparse::Error::TooManyHeaders) => {
                return Err(Refusal::new(431, format!("more than {HEADERS} headers")));
            }
            Err(e) => return Err(malformed(&e)),
        }
        let (method, target) = (parsed.method.unwrap_or_default().to_owned(), parsed.path.unwrap_or_default());
        let mut headers: Vec<(String, String)> = Vec::new();
        for header in parsed.headers.iter() {
            let name = header.name.to_ascii_lowercase();
            let value =
                std::str::from_utf8(header.value).map_err(|_| malformed(&format!("header {name} is not text")))?;
            let single = ["host", "content-length", "origin", "authorization", "content-type", "cookie"];
            if single.contains(&name.as_str()) && headers.iter().any(|(k, _)| *k == name) {
                return Err(malformed(&format!("header {name} comes twice")));
            }
            headers.push((name, value.trim().to_owned()));
        }
        let get = |name: &str| headers.iter().find(|(k, _)| k == name).map(|(_, v)| v.as_str());
        // Two readings of one message are how requests are smuggled.
        if get("transfer-encoding").is_some() {
            return Err(Refusal::new(501, "Transfer-Encoding is not taken: send a Content-Length"));
        }
        if get("content-encoding").is_some_and(|v| !v.eq_ignore_ascii_case("identity")) {
            return Err(Refusal::new(415, "compressed requests are not taken"));
        }
        let length = match get("content-length") {
            None => 0,
            Some(text) if !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit()) => {
                text.parse().map_err(|e| malformed(&format!("Content-Length: {e}")))?
            }
            Some(_) => return Err(malformed(&"Content-Length is no number")),
        };
        let target = target.to_owned();
        Ok(Some(Head { method, target, headers, length, early: bytes.split_off(end) }))
    }

    /// The header `name`, in small letters.
    pub fn header(&self, name: &str) -> Option<&str> {
        self.headers.iter().find(|(k, _)| k == name).map(|(_, v)| v.as_str())
    }

    /// The whole body, if it has no more than `most` bytes.
    pub fn body(&mut self, most: u64) -> Result<Vec<u8>, Refusal> {
        self.at_most(most)?;
        let mut body = Vec::new(); // grows with what really comes
        let mut chunk = [0; 16 << 10];
        loop {
            match self.read_body(&mut chunk)? {
                0 => return Ok(body),
                n => body.extend_from_slice(&chunk[..n]),
            }
        }
    }

    /// Refuses bodies of more than `most` bytes.
    pub fn at_most(&self, most: u64) -> Result<(), Refusal> {
        if self.length > most {
            let found = self.length;
            return Err(Refusal::new(413, format!("expected at most {most} bytes, found {found}")));
        }
        Ok(())
    }

    /// Reads some of the body; 0 at its end.
    pub fn read_body(&mut self, out: &mut [u8]) -> Result<usize, Refusal> {
        let most = out.len().min(usize::try_from(self.left).unwrap_or(usize::MAX));
        if most == 0 {
            return Ok(0);
        }
        if std::mem::take(&mut self.expects) && self.early.is_empty() {
            (&self.stream).write_all(b"HTTP/1.1 100 Continue\r\n\r\n").map_err(|_| closed())?;
        }
        let n = if self.early.is_empty() {
            read_until(&self.stream, &mut out[..most], self.deadline)?
        } else {
            let n = most.min(self.early.len());
            out[..n].copy_from_slice(&self.early[..n]);
            self.early.drain(..n);
            n
        };
        if n == 0 {
            return Err(closed());
        }
        self.left -= n as u64;
        Ok(n)
    }

    /// The connection, to answer on.
    pub fn into_stream(self) -> TcpStream {
        self.stream
    }
}

struct Head {
    method: String,
    target: String,
    headers: Vec<(String, String)>,
    length: u64,
    early: Vec<u8>,
}

/// A connection that is written to until a deadline.
pub struct Until {
    stream: TcpStream,
    deadline: Instant,
}

impl Until {
    /// Whether the deadline has passed.
    pub fn is_over(&self) -> bool {
        Instant::now() >= self.deadline
    }
}

impl Write for Until {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let left = self.deadline.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(io::ErrorKind::TimedOut.into());
        }
        self.stream.set_write_timeout(Some(left.min(WRITE_TIMEOUT)))?;
        self.stream.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.stream.flush()
    }
}

/// What writes to a client as long as it wants to.
type Writes = dyn FnOnce(&mut Until) -> io::Result<()> + Send;

/// What an answer holds.
pub enum Content {
    Bytes(Vec<u8>),
    Text(&'static str),
    File(File, u64),
    /// Written as it comes, until it ends or the client has gone.
    Stream(Box<Writes>),
}

/// An answer.
pub struct Response {
    pub status: u16,
    pub kind: &'static str,
    pub content: Content,
    pub headers: Vec<(&'static str, String)>,
    /// What is let go once it is sent.
    held: Option<Box<dyn Send>>,
}

impl Response {
    pub fn new(kind: &'static str, content: Content) -> Self {
        Self { status: 200, kind, content, headers: Vec::new(), held: None }
    }

    pub fn json(value: &impl serde::Serialize) -> Self {
        let bytes = serde_json::to_vec(value).expect("our own values have names for keys");
        Self::new("application/json", Content::Bytes(bytes))
    }

    pub fn text(text: String) -> Self {
        Self::new("text/plain; charset=utf-8", Content::Bytes(text.into_bytes()))
    }

    pub fn status(mut self, status: u16) -> Self {
        self.status = status;
        self
    }

    pub fn header(mut self, name: &'static str, value: impl Into<String>) -> Self {
        self.headers.push((name, value.into()));
        self
    }

    /// Holds something until it is sent, or the client has gone.
    pub fn holding(mut self, held: impl Send + 'static) -> Self {
        self.held = Some(Box::new(held));
        self
    }

    /// Sends it, without the content where only the head was asked for, and ends the connection; within `most`, whatever the client does.
    pub fn send(mut self, stream: TcpStream, head_only: bool, most: Duration) {
        let held = self.held.take();
        let mut until = Until { stream, deadline: Instant::now() + most };
        let sent = self.write(&mut until, head_only);
        drop(held);
        // A client that has gone is told nothing.
        if sent.is_ok() {
            linger(&until.stream);
        }
    }

    fn write(self, stream: &mut Until, head_only: bool) -> io::Result<()> {
        let mut head = format!("HTTP/1.1 {} {}\r\nContent-Type: {}\r\n", self.status, reason(self.status), self.kind);
        let length = match &self.content {
            Content::Bytes(bytes) => Some(bytes.len() as u64),
            Content::Text(text) => Some(text.len() as u64),
            Content::File(_, length) => Some(*length),
            Content::Stream(_) => None,
        };
        if let Some(length) = length {
            head += &format!("Content-Length: {length}\r\n");
        }
        head += "Connection: close\r\n";
        for (name, value) in COMMON.iter().map(|(n, v)| (*n, *v)).chain(self.headers.iter().map(|(n, v)| (*n, &v[..])))
        {
            debug_assert!(!value.contains(['\r', '\n']));
            head += &format!("{name}: {value}\r\n");
        }
        head += "\r\n";
        stream.write_all(head.as_bytes())?;
        if head_only {
            return Ok(());
        }
        match self.content {
            Content::Bytes(bytes) => stream.write_all(&bytes),
            Content::Text(text) => stream.write_all(text.as_bytes()),
            Content::File(file, length) => io::copy(&mut file.take(length), stream).map(drop),
            Content::Stream(write) => write(stream),
        }
    }
}

/// What every answer says: nothing from outside runs or loads, nobody else may show or read it, nothing is guessed or kept.
const COMMON: [(&str, &str); 7] = [
    (
        "Content-Security-Policy",
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; \
         base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
    ),
    ("X-Content-Type-Options", "nosniff"),
    ("X-Frame-Options", "DENY"),
    // Forms of this page tell their origin; others hear nothing.
    ("Referrer-Policy", "same-origin"),
    ("Cross-Origin-Opener-Policy", "same-origin"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("Cache-Control", "no-store"),
];

/// Lets a client that still sends read the answer: closing at once would take it back.
fn linger(stream: &TcpStream) {
    let _ = stream.shutdown(Shutdown::Write);
    let deadline = Instant::now() + LINGER;
    let mut nowhere = [0; 16 << 10];
    while matches!(read_until(stream, &mut nowhere, deadline), Ok(n) if n > 0) {}
}

fn reason(status: u16) -> &'static str {
    match status {
        200 => "OK",
        201 => "Created",
        303 => "See Other",
        400 => "Bad Request",
        401 => "Unauthorized",
        403 => "Forbidden",
        404 => "Not Found",
        405 => "Method Not Allowed",
        408 => "Request Timeout",
        409 => "Conflict",
        410 => "Gone",
        411 => "Length Required",
        413 => "Content Too Large",
        415 => "Unsupported Media Type",
        421 => "Misdirected Request",
        422 => "Unprocessable Content",
        429 => "Too Many Requests",
        431 => "Request Header Fields Too Large",
        501 => "Not Implemented",
        503 => "Service Unavailable",
        507 => "Insufficient Storage",
        _ => "Internal Server Error",
    }
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;

    /// V6.
    #[test]
    fn a_client_that_reads_slowly_is_let_go() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let mut client = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let (server, _) = listener.accept().unwrap();
        let reader = std::thread::spawn(move || {
            // Some bytes now and then: no single write waits for long.
            let mut few = [0; 4096];
            while matches!(client.read(&mut few), Ok(n) if n > 0) {
                std::thread::sleep(Duration::from_millis(2));
            }
        });
        let begin = Instant::now();
        let large = Response::new("text/plain", Content::Bytes(vec![0; 256 << 20]));
        large.send(server, false, Duration::from_millis(500));
        assert!(begin.elapsed() < Duration::from_secs(10), "{:?}", begin.elapsed());
        drop(reader);
    }
}
