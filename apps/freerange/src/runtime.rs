//! The device to compute on, and what a run cost.

use burn::tensor::Device;

use crate::error::CliError;

/// Where to compute.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum DeviceName {
    /// The best device of this build: the CPU.
    Auto,
    /// The CPU: all cores, SIMD; needs nothing installed.
    Cpu,
}

impl DeviceName {
    /// The device, without differentiation.
    pub fn open(self) -> Device {
        Device::flex()
    }
}

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
