//! Files of clients: which names they may have, how large they may be, and what pictures say of themselves before anyone decodes them.

mod json;

use std::{
    fs::{self, File},
    io::{BufWriter, Write},
    path::{Path, PathBuf},
};

use image::{ImageFormat, ImageReader};

use crate::{Limits, Refusal, disk::is_full};

/// Longest part of a name, in bytes.
const NAME: usize = 120;
/// Most folders in folders.
const DEPTH: usize = 6;
const PICTURES: [&str; 4] = ["png", "jpg", "jpeg", "webp"];
const CAMERAS: [&str; 5] = ["json", "bin", "txt", "xml", "csv"];
const SPLATS: [&str; 8] = ["ply", "splat", "spz", "sog", "glb", "usda", "usdz", "html"];
const ARCHIVES: [&str; 9] = ["zip", "gz", "tgz", "tar", "7z", "rar", "xz", "zst", "bz2"];
/// Most bytes of a JSON file: its reader holds it whole.
const JSON: u64 = 8 << 20;

/// The files of one job on their way to its folder. Clients' names only decide on names below that folder, after they were taken apart.
pub struct Upload<'a> {
    folder: &'a Path,
    limits: &'a Limits,
    files: usize,
    photos: usize,
    /// Files of Gaussians, and the clients' names of them.
    splats: Vec<(PathBuf, String)>,
    pixels: u64,
    /// Bytes that were written.
    pub bytes: u64,
    /// Files that are of no use here.
    pub passed_over: Vec<String>,
    /// The first folder of all names, or the first file: its whole name if that is one of Gaussians.
    pub title: Option<String>,
}

/// What is done with a file of this name.
enum Kind {
    Picture,
    Cameras,
    Splats,
    Other,
}

/// `name` as it is shown.
fn shown(name: &str) -> String {
    name.chars().filter(|c| !c.is_control()).take(NAME).collect()
}

/// The parts of a client's name: plain file names, one below the other.
fn parts(name: &str) -> Result<Vec<&str>, Refusal> {
    let odd = |what: &str| Refusal::new(422, format!("file name `{}`: {what}", shown(name)));
    if name.starts_with(['/', '\\']) {
        return Err(odd("expected one below the folder that was dropped, found an absolute one"));
    }
    let parts: Vec<&str> = name.split(['/', '\\']).filter(|p| *p != ".").collect();
    for part in &parts {
        let bad = part.chars().any(|c| c.is_control() || "<>:\"|?*".contains(c));
        if part.is_empty() || *part == ".." || part.len() > NAME || bad || part.ends_with(['.', ' ']) {
            return Err(odd("expected plain names of files and folders"));
        }
    }
    if parts.is_empty() || parts.len() > DEPTH {
        return Err(odd(&format!("expected at most {DEPTH} folders")));
    }
    Ok(parts)
}

fn kind(parts: &[&str]) -> Result<Kind, Refusal> {
    let name = parts.last().copied().unwrap_or_default();
    let extension = name.rsplit_once('.').map_or(String::new(), |(_, e)| e.to_ascii_lowercase());
    let extension = extension.as_str();
    if ARCHIVES.contains(&extension) {
        let text = format!("file `{}`: archives are not unpacked here; give the folder itself", shown(name));
        return Err(Refusal::new(415, text));
    }
    Ok(match () {
        () if parts.iter().any(|p| p.starts_with('.')) => Kind::Other,
        () if PICTURES.contains(&extension) => Kind::Picture,
        () if CAMERAS.contains(&extension) => Kind::Cameras,
        () if SPLATS.contains(&extension) => Kind::Splats,
        () => Kind::Other,
    })
}

impl<'a> Upload<'a> {
    /// Files will go to `folder`, which is there and empty.
    pub fn new(folder: &'a Path, limits: &'a Limits) -> Self {
        Self {
            folder,
            limits,
            files: 0,
            photos: 0,
            splats: Vec::new(),
            pixels: 0,
            bytes: 0,
            passed_over: Vec::new(),
            title: None,
        }
    }

    /// Takes the file that the client calls `name`; `read` gives its bytes, and none at the end.
    pub fn file(
        &mut self,
        name: &str,
        mut read: impl FnMut(&mut [u8]) -> Result<usize, Refusal>,
    ) -> Result<(), Refusal> {
        self.files += 1;
        if self.files > self.limits.files {
            return Err(Refusal::new(413, format!("expected at most {} files", self.limits.files)));
        }
        let parts = parts(name)?;
        let kind = kind(&parts)?;
        let mut chunk = vec![0; 64 << 10];
        if matches!(kind, Kind::Other) {
            self.pass_over(shown(name));
            while read(&mut chunk)? > 0 {}
            return Ok(());
        }
        let stem = parts[0].rsplit_once('.').filter(|_| parts.len() == 1 && !matches!(kind, Kind::Splats));
        let title = || shown(stem.map_or(parts[0], |(stem, _)| stem));
        self.title.get_or_insert_with(title);
        let path = parts.iter().fold(self.folder.to_path_buf(), |path, part| path.join(part));
        fs::create_dir_all(path.parent().unwrap_or(self.folder)).map_err(Refusal::own)?;
        // Nothing is ever overwritten, whatever letters a file system takes for the same.
        let file = File::create_new(&path).map_err(|e| match is_full(&e.to_string()) {
            true => Refusal::own(e),
            false => Refusal::new(422, format!("file `{}` comes twice, or once as a folder", shown(name))),
        })?;
        let mut writer = BufWriter::new(file);
        let mut size = 0u64;
        let is_json = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("json"));
        let most = match kind {
            _ if is_json => JSON.min(self.limits.file_bytes),
            // It is the whole job.
            Kind::Splats => self.limits.bytes,
            _ => self.limits.file_bytes,
        };
        loop {
            let n = read(&mut chunk)?;
            if n == 0 {
                break;
            }
            size += n as u64;
            self.bytes += n as u64;
            if size > most {
                return Err(Refusal::new(413, format!("file `{}`: expected at most {most} bytes", shown(name))));
            }
            writer.write_all(&chunk[..n]).map_err(Refusal::own)?;
        }
        writer.flush().map_err(Refusal::own)?;
        drop(writer);
        match kind {
            Kind::Picture => {
                self.photos += 1;
                self.picture(&path, name)
            }
            Kind::Cameras if is_json => json(&path, name),
            Kind::Splats => {
                self.splats.push((path, shown(name)));
                Ok(())
            }
            _ => Ok(()),
        }
    }

    fn pass_over(&mut self, name: String) {
        if self.passed_over.len() < 20 {
            self.passed_over.push(name);
        }
    }

    /// Whether there is something to read: a photo, or Gaussians.
    pub fn is_of_use(&self) -> bool {
        self.photos > 0 || !self.splats.is_empty()
    }

    /// The file of Gaussians, where there are no photos. Beside photos such files are of no use, and go.
    pub fn only_splats(&mut self) -> Result<Option<PathBuf>, Refusal> {
        let mut splats = std::mem::take(&mut self.splats);
        if self.photos > 0 {
            for (path, name) in splats {
                fs::remove_file(path).map_err(Refusal::own)?;
                self.pass_over(name);
            }
            return Ok(None);
        }
        if splats.len() > 1 {
            let text =
                format!("expected photos with cameras, or one file of Gaussians, found {} of these", splats.len());
            return Err(Refusal::new(422, text));
        }
        Ok(splats.pop().map(|(path, _)| path))
    }

    /// Looks at a picture's head: its kind and size have to be usual before anything is decoded.
    fn picture(&mut self, path: &Path, name: &str) -> Result<(), Refusal> {
        let (width, height) =
            picture_size(path).map_err(|what| Refusal::new(422, format!("image `{}`: {what}", shown(name))))?;
        let pixels = u64::from(width) * u64::from(height);
        self.pixels += pixels;
        let (one, all) = (self.limits.pixels, self.limits.job_pixels);
        if pixels > one {
            let text = format!("image `{}`: expected at most {one} pixels, found {width} x {height}", shown(name));
            return Err(Refusal::new(413, text));
        }
        if self.pixels > all {
            return Err(Refusal::new(413, format!("expected images of at most {all} pixels together")));
        }
        Ok(())
    }
}

/// Width and height, from the head alone.
fn picture_size(path: &Path) -> Result<(u32, u32), String> {
    // By its bytes: a name proves nothing.
    let file = std::io::BufReader::new(File::open(path).map_err(|e| e.to_string())?);
    let reader = ImageReader::new(file).with_guessed_format().map_err(|e| e.to_string())?;
    match reader.format() {
        Some(ImageFormat::Png | ImageFormat::Jpeg | ImageFormat::WebP) => {}
        _ => return Err("expected the bytes of a PNG, JPEG or WebP, found others".into()),
    }
    let mut reader = reader;
    let mut limits = image::Limits::default();
    limits.max_alloc = Some(16 << 20);
    reader.limits(limits);
    reader.into_dimensions().map_err(|e| e.to_string())
}

/// Refuses JSON that names files outside of its own folder (readers of cameras follow such names), and what would take much memory as values.
fn json(path: &Path, name: &str) -> Result<(), Refusal> {
    let file = File::open(path).map_err(Refusal::own)?;
    match json::look(std::io::BufReader::new(file)) {
        Ok(()) => Ok(()),
        Err(json::Odd::Many(most)) => {
            let text = format!("file `{}`: expected at most {most} values, found more", shown(name));
            Err(Refusal::new(413, text))
        }
        Err(json::Odd::Outside(found)) => {
            let found = shown(&found);
            let text = format!("file `{}`: expected names of files beside it, found `{found}`", shown(name));
            Err(Refusal::new(422, text))
        }
    }
}

/// Refuses `paths` that do not lie in `folder`, links followed.
pub fn all_inside<'p>(folder: &Path, paths: impl IntoIterator<Item = &'p PathBuf>) -> Result<(), Refusal> {
    let folder = folder.canonicalize().map_err(Refusal::own)?;
    for path in paths {
        if let Ok(real) = path.canonicalize()
            && !real.starts_with(&folder)
        {
            return Err(Refusal::new(422, "the cameras name a file outside of the folder that was given"));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_stay_below_the_folder() {
        assert_eq!(parts("bowl/./train\\000.png").unwrap(), ["bowl", "train", "000.png"]);
        assert_eq!(parts("Schüssel ä.png").unwrap(), ["Schüssel ä.png"]);
        let long = "a".repeat(121);
        for odd in [
            "",
            "..",
            "../x.png",
            "a/../x.png",
            "a\\..\\x.png",
            "/etc/passwd",
            "\\\\host\\x",
            "C:\\x.png",
            "C:/x.png",
            "a//b.png",
            "a/",
            "x\0.png",
            "a\nb.png",
            "x.png.",
            "x ",
            "<b>.png",
            "a/b/c/d/e/f/g.png",
            &long,
        ] {
            assert!(parts(odd).is_err(), "{odd:?}");
        }
    }
}
