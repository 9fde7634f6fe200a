//! What is counted, as Prometheus reads it.

use std::{
    collections::BTreeMap,
    fmt::Write,
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
    time::Instant,
};

/// Counters of a server.
pub struct Metrics {
    begin: Instant,
    /// Answers by status.
    answers: Mutex<BTreeMap<u16, u64>>,
    /// Ended jobs by state.
    ended: Mutex<BTreeMap<&'static str, u64>>,
    pub connections: AtomicU64,
    pub turned_away: AtomicU64,
    pub streams: AtomicU64,
    pub uploaded: AtomicU64,
    pub estimates: AtomicU64,
    pub milliseconds: AtomicU64,
}

impl Metrics {
    pub fn new() -> Self {
        Self {
            begin: Instant::now(),
            answers: Mutex::default(),
            ended: Mutex::default(),
            connections: AtomicU64::new(0),
            turned_away: AtomicU64::new(0),
            streams: AtomicU64::new(0),
            uploaded: AtomicU64::new(0),
            estimates: AtomicU64::new(0),
            milliseconds: AtomicU64::new(0),
        }
    }

    pub fn answered(&self, status: u16) {
        *self.answers.lock().unwrap_or_else(PoisonError::into_inner).entry(status).or_default() += 1;
    }

    pub fn ended(&self, state: &'static str) {
        *self.ended.lock().unwrap_or_else(PoisonError::into_inner).entry(state).or_default() += 1;
    }

    /// The page of text. `jobs`: how many there are in each state.
    pub fn text(&self, jobs: &BTreeMap<&'static str, usize>, disk: u64) -> String {
        let mut text = String::new();
        let mut family = |name: &str, kind: &str, help: &str, rows: &[(String, f64)]| {
            let _ = writeln!(text, "# HELP freerange_{name} {help}\n# TYPE freerange_{name} {kind}");
            for (labels, value) in rows {
                let _ = writeln!(text, "freerange_{name}{labels} {value}");
            }
        };
        let plain = |value: f64| vec![(String::new(), value)];
        let count = |value: &AtomicU64| plain(value.load(Relaxed) as f64);
        let jobs: Vec<_> = jobs.iter().map(|(s, n)| (format!("{{state=\"{s}\"}}"), *n as f64)).collect();
        family("jobs", "gauge", "Jobs by state.", &jobs);
        let ended = self.ended.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let ended: Vec<_> = ended.iter().map(|(s, n)| (format!("{{state=\"{s}\"}}"), *n as f64)).collect();
        family("jobs_ended_total", "counter", "Jobs that came to an end, by how.", &ended);
        let answers = self.answers.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let answers: Vec<_> = answers.iter().map(|(s, n)| (format!("{{status=\"{s}\"}}"), *n as f64)).collect();
        family("answers_total", "counter", "Answers by status.", &answers);
        family("connections", "gauge", "Connections that are open.", &count(&self.connections));
        family("streams", "gauge", "Streams of events that are open.", &count(&self.streams));
        family("turned_away_total", "counter", "Connections beyond the limit.", &count(&self.turned_away));
        family("uploaded_bytes_total", "counter", "Bytes of files that were taken.", &count(&self.uploaded));
        family("estimates_total", "counter", "Estimates that were published.", &count(&self.estimates));
        let busy = self.milliseconds.load(Relaxed) as f64 / 1e3;
        family("computing_seconds_total", "counter", "Seconds in which a job was computed.", &plain(busy));
        family("up_seconds", "gauge", "Seconds since the start.", &plain(self.begin.elapsed().as_secs_f64()));
        family("disk_bytes", "gauge", "Files of all jobs.", &plain(disk as f64));
        if let Some(bytes) = resident() {
            family("resident_bytes", "gauge", "Memory of the process.", &plain(bytes as f64));
        }
        text
    }
}

/// Memory of this process, where the system tells.
pub fn resident() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmRSS:"))?;
    Some(line.trim().trim_end_matches(" kB").parse::<u64>().ok()? << 10)
}
