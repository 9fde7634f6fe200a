//! Values of COLMAP's files, binary and text, and the image that `images` and `frames` are both about.

use crate::{SceneError, error::In};
use glam::{DQuat, DVec3};
use std::path::Path;

/// A posed image.
#[derive(Clone, Debug, PartialEq)]
pub struct ColmapImage {
    /// Its number.
    pub id: u32,
    /// Unit quaternion of the rotation from world to camera.
    pub rotation: DQuat,
    /// Translation from world to camera.
    pub translation: DVec3,
    /// Number of its camera.
    pub camera: u32,
    /// Path of the image, relative to the folder of images.
    pub name: String,
}

/// What is left of a binary file.
pub(super) struct Bytes<'a> {
    file: &'a Path,
    all: &'a [u8],
    at: usize,
}

impl<'a> Bytes<'a> {
    pub fn new(file: &'a Path, all: &'a [u8]) -> Self {
        Self { file, all, at: 0 }
    }

    pub fn u8(&mut self, place: &str) -> Result<u8, SceneError> {
        Ok(self.array::<1>(place)?[0])
    }

    pub fn take(&mut self, count: u64, place: &str) -> Result<&'a [u8], SceneError> {
        let left = self.all.len() - self.at;
        if count > left as u64 {
            let what = format!("expected {count} more bytes at byte {}, found {left}", self.at);
            return Err(In(self.file).malformed(place, what));
        }
        let slice = &self.all[self.at..self.at + count as usize];
        self.at += count as usize;
        Ok(slice)
    }

    fn array<const N: usize>(&mut self, place: &str) -> Result<[u8; N], SceneError> {
        let mut out = [0; N];
        out.copy_from_slice(self.take(N as u64, place)?);
        Ok(out)
    }

    pub fn u32(&mut self, place: &str) -> Result<u32, SceneError> {
        Ok(u32::from_le_bytes(self.array(place)?))
    }

    pub fn u64(&mut self, place: &str) -> Result<u64, SceneError> {
        Ok(u64::from_le_bytes(self.array(place)?))
    }

    pub fn f64s<const N: usize>(&mut self, place: &str) -> Result<[f64; N], SceneError> {
        let mut out = [0.0; N];
        for v in &mut out {
            *v = f64::from_le_bytes(self.array(place)?);
        }
        Ok(out)
    }

    pub fn text(&mut self, place: &str) -> Result<String, SceneError> {
        let rest = &self.all[self.at..];
        let end = rest.iter().take(4096).position(|b| *b == 0);
        let end = end.ok_or_else(|| In(self.file).malformed(place, "a name without an end"))?;
        self.at += end + 1;
        let text = std::str::from_utf8(&rest[..end]);
        text.map(str::to_owned).map_err(|_| In(self.file).malformed(place, "a name that is not UTF-8"))
    }

    pub fn end(&self) -> Result<(), SceneError> {
        match self.all.len() - self.at {
            0 => Ok(()),
            left => Err(In(self.file).malformed("", format!("{left} bytes after the last entry"))),
        }
    }
}

pub(super) fn number<T: std::str::FromStr>(
    file: &Path,
    place: &str,
    field: &str,
    word: Option<&str>,
) -> Result<T, SceneError> {
    let found = word.unwrap_or("nothing");
    word.and_then(|w| w.parse().ok()).ok_or_else(|| In(file).field(place, field, "a number", found))
}
