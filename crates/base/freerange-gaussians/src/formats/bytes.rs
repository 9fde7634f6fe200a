//! Taking bytes apart without believing what they claim.

use std::{
    fs::File,
    io::Read,
    path::{Component, Path, PathBuf},
};

use freerange_util::Invalid;

use crate::formats::error::{ended, problem};

/// Decoded bytes per byte of a file, at most. Real files stay far below; hostile ones blow up a thousandfold.
const MAX_EXPANSION: usize = 256;

/// Refuses what would take more than [`MAX_EXPANSION`] times the memory of the file it comes from.
pub fn check_expansion(field: &str, count: u64, bytes_each: usize, file: usize) -> Result<usize, Invalid> {
    let limit = (file as u64).saturating_mul(MAX_EXPANSION as u64) / bytes_each as u64;
    match usize::try_from(count) {
        Ok(count) if count as u64 <= limit => Ok(count),
        _ => Err(problem(field, format!("at most {limit} in a file of {file} bytes"), count)),
    }
}

/// The next bytes of a file.
pub struct Cursor<'a> {
    pub left: &'a [u8],
}

impl<'a> Cursor<'a> {
    pub fn take(&mut self, field: &str, count: usize) -> Result<&'a [u8], Invalid> {
        let Some((taken, left)) = self.left.split_at_checked(count) else {
            return Err(problem(field, format!("{count} bytes"), ended(self.left.len())));
        };
        self.left = left;
        Ok(taken)
    }

    pub fn u8(&mut self, field: &str) -> Result<u8, Invalid> {
        Ok(self.take(field, 1)?[0])
    }

    pub fn u32(&mut self, field: &str) -> Result<u32, Invalid> {
        Ok(u32::from_le_bytes(self.take(field, 4)?.try_into().expect("four bytes")))
    }

    pub fn u64(&mut self, field: &str) -> Result<u64, Invalid> {
        Ok(u64::from_le_bytes(self.take(field, 8)?.try_into().expect("eight bytes")))
    }
}

/// Where files lie that another one names.
pub enum Beside {
    /// Nowhere: the file came without a folder.
    Nothing,
    /// In this folder.
    Folder(PathBuf),
}

impl Beside {
    /// The file `name`, a relative path that does not leave the folder, of at most `limit` bytes.
    pub fn file(&self, name: &str, limit: u64) -> Result<Vec<u8>, Invalid> {
        let shown: String = name.chars().take(60).collect();
        let Self::Folder(folder) = self else {
            return Err(problem(&*shown, "all data in the file itself", "the name of another file"));
        };
        let within = |c: Component| matches!(c, Component::Normal(_) | Component::CurDir);
        if name.is_empty() || !Path::new(name).components().all(within) {
            return Err(problem(&*shown, "the name of a file in the same folder", "another path"));
        }
        let mut bytes = Vec::new();
        let opened = File::open(folder.join(name)).and_then(|f| f.take(limit + 1).read_to_end(&mut bytes));
        opened.map_err(|e| problem(&*shown, "a file in the same folder", e))?;
        if bytes.len() as u64 > limit {
            return Err(problem(&*shown, format!("at most {limit} bytes"), "more"));
        }
        Ok(bytes)
    }
}
