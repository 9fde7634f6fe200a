//! The machine, the checkpoint, and what a run cost.

use burn::tensor::Device;
use sha2::{Digest, Sha256};

use crate::error::CliError;

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

static SHIPPED: &[u8] = include_bytes!("../../../checkpoints/tiny.safetensors");

/// SHA-256, hexadecimal, of the checkpoint that the user names, or of the shipped one.
pub fn checkpoint_sha256(path: Option<&std::path::Path>) -> Result<String, CliError> {
    let hash = match path {
        None => Sha256::digest(SHIPPED),
        Some(path) => {
            let mut hash = Sha256::new();
            let mut file = std::fs::File::open(path).map_err(|e| CliError::file(path, e))?;
            std::io::copy(&mut file, &mut hash).map_err(|e| CliError::file(path, e))?;
            hash.finalize()
        }
    };
    Ok(hash.iter().map(|byte| format!("{byte:02x}")).collect())
}

/// The checkpoint that the user names, or the shipped one.
pub fn checkpoint(path: Option<&std::path::Path>, device: &Device) -> Result<freerange_model::Checkpoint, CliError> {
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

/// Where `weights fetch` puts the weights of metrics: `freerange/weights` in the user's cache folder; none where no such
/// folder is known.
pub fn weights_folder() -> Option<std::path::PathBuf> {
    let absolute = |name: &str| std::env::var_os(name).map(std::path::PathBuf::from).filter(|p| p.is_absolute());
    let cache = if cfg!(target_os = "macos") {
        absolute("HOME").map(|h| h.join("Library/Caches"))
    } else if cfg!(windows) {
        absolute("LOCALAPPDATA")
    } else {
        absolute("XDG_CACHE_HOME").or_else(|| absolute("HOME").map(|h| h.join(".cache")))
    };
    cache.map(|c| c.join("freerange").join("weights"))
}
