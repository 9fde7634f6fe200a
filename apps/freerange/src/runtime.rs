//! The machine, the checkpoint, and what a run cost.

use burn::tensor::Device;

use crate::error::CliError;

/// Largest memory that this process has held, in bytes; none where the system does not tell.
pub fn peak_memory() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib * 1024)
}

/// The checkpoint that the user names, or the shipped one.
pub fn checkpoint(path: Option<&std::path::Path>, device: &Device) -> Result<freerange_model::Checkpoint, CliError> {
    static SHIPPED: &[u8] = include_bytes!("../../../checkpoints/tiny.safetensors");
    Ok(match path {
        Some(path) => freerange_model::Checkpoint::load(path, device)?,
        None => freerange_model::Checkpoint::from_bytes(SHIPPED, "the shipped checkpoint", device)?,
    })
}

/// The processor's name.
pub fn processor() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = info.lines().find_map(|l| l.strip_prefix("model name")?.split(": ").nth(1));
    name.unwrap_or(std::env::consts::ARCH).trim().to_owned()
}

/// Bytes of main memory; none where the system does not tell.
pub fn memory() -> Option<u64> {
    let info = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = info.lines().find_map(|l| l.strip_prefix("MemTotal:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib * 1024)
}

/// The commit that this program was built from; `-dirty` if files had been changed.
pub fn commit() -> String {
    env!("FREERANGE_COMMIT").to_owned()
}
