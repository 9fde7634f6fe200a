//! What every bench prints first: where it ran, and what. Benches take it in by `#[path]`.

/// Processor, threads and commit.
pub fn machine(threads: usize) -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let cpu =
        info.lines().find_map(|l| l.strip_prefix("model name")?.split(": ").nth(1)).unwrap_or("unknown processor");
    let git = std::process::Command::new("git").args(["describe", "--always", "--dirty"]).output();
    let commit = git.ok().filter(|o| o.status.success()).map(|o| String::from_utf8_lossy(&o.stdout).trim().to_string());
    format!("{cpu}, {threads} threads, commit {}", commit.as_deref().unwrap_or("unknown"))
}
