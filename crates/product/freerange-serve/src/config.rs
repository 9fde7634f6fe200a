//! Limits and places of the server.

use std::{net::IpAddr, path::PathBuf, time::Duration};

use freerange_util::Invalid;

use crate::ServeError;

/// How a server is set up.
#[derive(Clone, Debug)]
pub struct ServeConfig {
    /// Where it listens; beyond loopback a token is needed.
    pub host: IpAddr,
    /// 0 takes a free one.
    pub port: u16,
    /// What clients have to know: see [`draw_token`](crate::draw_token). Without one, whoever has an account on this machine may use the
    /// page, see its photos and remove its jobs.
    pub token: Option<String>,
    /// Names, beside addresses, under which browsers may reach it.
    pub names: Vec<String>,
    /// Where jobs are kept; a temporary folder where it is left out.
    pub keep: Option<PathBuf>,
    /// A scene for those who have none at hand.
    pub example: Option<Example>,
    /// What clients may ask for.
    pub limits: Limits,
}

/// Files of a scene that is part of the program.
#[derive(Clone, Copy, Debug)]
pub struct Example {
    /// What it is called.
    pub name: &'static str,
    /// Names and bytes of its files.
    pub files: &'static [(&'static str, &'static [u8])],
}

/// What clients may ask for at most.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Bytes of all files of a job.
    pub bytes: u64,
    /// Bytes of one file; a file of Gaussians may have as many as a job.
    pub file_bytes: u64,
    /// Files of a job.
    pub files: usize,
    /// Pixels of one picture.
    pub pixels: u64,
    /// Pixels of all pictures of a job.
    pub job_pixels: u64,
    /// Longer side of the photos in use; larger ones are made smaller.
    pub side: u32,
    /// Bytes of memory that the photos of one job take while they are read, at the size used, with their masks.
    pub memory: u64,
    /// Jobs whose photos are read at the same time.
    pub readers: usize,
    /// Bytes on disk of all jobs together.
    pub disk: u64,
    /// Jobs that are read, looked at, wait or compute.
    pub open_jobs: usize,
    /// Finished jobs. Beyond that, new ones are refused where jobs are kept, else the oldest is forgotten.
    pub finished_jobs: usize,
    /// A job whose photos are read for longer is ended.
    pub read_time: Duration,
    /// A search for the cameras of photos that takes longer is ended.
    pub search_time: Duration,
    /// Bytes of memory that a program may take which searches for cameras; beyond, it is ended.
    pub search_memory: u64,
    /// A job that computes longer is ended.
    pub job_time: Duration,
    /// A job that waits longer for someone to press go makes way where there is no room for new ones.
    pub idle_time: Duration,
    /// A request that takes longer is ended.
    pub request_time: Duration,
    /// A head of a request that takes longer is ended.
    pub head_time: Duration,
    /// An answer that a client takes longer to read is ended.
    pub answer_time: Duration,
    /// A stream of events ends after this time; the page opens a new one.
    pub stream_time: Duration,
    /// Connections at a time; two thirds of them may be streams of events. Some more are kept for `/health` and `/metrics`.
    pub connections: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            bytes: 512 << 20,
            file_bytes: 64 << 20,
            files: 1000,
            pixels: 50_000_000,
            job_pixels: 1_000_000_000,
            side: 1024,
            memory: 1 << 30,
            readers: 2,
            disk: 16 << 30,
            read_time: Duration::from_secs(300),
            search_time: Duration::from_secs(1800),
            search_memory: 4 << 30,
            open_jobs: 32,
            finished_jobs: 200,
            job_time: Duration::from_secs(900),
            idle_time: Duration::from_secs(600),
            request_time: Duration::from_secs(300),
            head_time: Duration::from_secs(10),
            answer_time: Duration::from_secs(300),
            stream_time: Duration::from_secs(300),
            connections: 96,
        }
    }
}

/// Shortest token.
const TOKEN: usize = 16;

impl Default for ServeConfig {
    fn default() -> Self {
        Self {
            host: IpAddr::from([127, 0, 0, 1]),
            port: 0,
            token: None,
            names: Vec::new(),
            keep: None,
            example: None,
            limits: Limits::default(),
        }
    }
}

impl ServeConfig {
    /// Refuses what would not be safe.
    ///
    /// # Errors
    /// Names the option.
    pub fn check(&self) -> Result<(), ServeError> {
        let refuse = |option: &str, expected: String, found: String| Err(Invalid::new(option, expected, found).into());
        match &self.token {
            None if !self.host.is_loopback() => {
                refuse("token", format!("one, to listen at {}", self.host), "none (--no-token)".into())
            }
            Some(token)
                if token.len() < TOKEN || !token.bytes().all(|b| b.is_ascii_alphanumeric() || b"-._~".contains(&b)) =>
            {
                // Secrets do not belong into messages.
                let found = match token.chars().count() {
                    few if few < TOKEN => format!("{few} characters"),
                    _ => "other characters among them".into(),
                };
                refuse("token", format!("{TOKEN} or more letters, digits or - . _ ~"), found)
            }
            _ => Ok(()),
        }?;
        let odd = self
            .names
            .iter()
            .find(|n| n.is_empty() || !n.bytes().all(|b| b.is_ascii_alphanumeric() || b"-.".contains(&b)));
        match odd {
            Some(name) => refuse("--name", "a host's name, without a port".into(), name.clone()),
            None => Ok(()),
        }
    }
}
