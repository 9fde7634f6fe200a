//! What a run cost in memory.

/// Largest memory that this process has held, in bytes; none where the system does not tell.
pub fn peak_memory() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib * 1024)
}

/// Starts the measurement of [`peak_memory`] anew from what is held now; whether the system can.
pub fn reset_peak_memory() -> bool {
    // "5" resets the high-water mark of the resident set (Linux, Documentation/filesystems/proc.rst).
    std::fs::write("/proc/self/clear_refs", "5").is_ok()
}
