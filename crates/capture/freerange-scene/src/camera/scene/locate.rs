//! Which files are images, and which of them a name means.

use std::{
    collections::HashMap,
    path::{Path, PathBuf},
};

/// Largest image side accepted, in pixels.
pub(super) const LARGEST_SIDE: u32 = 16384;
/// Image files that are read, by their extensions in small letters.
pub const IMAGE_EXTENSIONS: [&str; 4] = ["png", "jpg", "jpeg", "webp"];

/// Images that cameras write and that are not read, and what they are called.
const UNREADABLE: [(&str, &str); 11] = [
    ("heic", "HEIC"),
    ("heif", "HEIC"),
    ("avif", "AVIF"),
    ("tif", "TIFF"),
    ("tiff", "TIFF"),
    ("exr", "OpenEXR"),
    ("jxl", "JPEG XL"),
    ("dng", "raw"),
    ("cr2", "raw"),
    ("nef", "raw"),
    ("arw", "raw"),
];

/// Where an image is, whose name a file of cameras gives.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Located {
    /// There, or with an extension added.
    There(PathBuf),
    /// The only file of that name with other capitals or another image extension.
    Renamed(PathBuf),
    /// Two files of that name with other extensions.
    Several(PathBuf, PathBuf),
    /// A file of that name of a kind that is not read, and what that is called.
    Unreadable(PathBuf, &'static str),
    /// Nowhere.
    Missing,
}

/// Looks for images; remembers what folders hold.
#[derive(Default)]
pub struct ImageFiles {
    /// Of each folder, its files by their names without extension, all in small letters.
    folders: HashMap<PathBuf, HashMap<String, Vec<PathBuf>>>,
}

impl ImageFiles {
    /// Entries of a folder that are looked at, at most.
    const MOST: usize = 100_000;

    /// What lies at `path`, up to capitals and the extension.
    pub fn locate(&mut self, path: &Path) -> Located {
        if path.is_file() {
            let kind = extension(path).and_then(|e| UNREADABLE.iter().find(|(known, _)| *known == e));
            return kind.map_or(Located::There(path.into()), |(_, kind)| Located::Unreadable(path.into(), kind));
        }
        let (Some(folder), Some(name)) = (path.parent(), path.file_name()) else { return Located::Missing };
        let name = name.to_string_lossy().to_lowercase();
        let files = self.folders.entry(folder.into()).or_insert_with(|| listed(folder));
        let none = Vec::new();
        let of = |stem: &str| files.get(stem).unwrap_or(&none).iter();
        let readable = |p: &&PathBuf| extension(p).is_some_and(|e| IMAGE_EXTENSIONS.contains(&e.as_str()));
        // An extension added, in the order in which they are tried.
        let added = |e: &&str| of(&name).find(|p| extension(p).is_some_and(|own| own == **e));
        if let Some(found) = IMAGE_EXTENSIONS.iter().find_map(added) {
            return Located::There(found.clone());
        }
        let stem = name.rsplit_once('.').map_or(name.as_str(), |(stem, _)| stem);
        let same = |p: &&PathBuf| p.file_name().is_some_and(|n| n.to_string_lossy().to_lowercase() == name);
        let capitals: Vec<&PathBuf> = of(stem).filter(same).filter(readable).collect();
        let others: Vec<&PathBuf> = of(stem).filter(readable).collect();
        for candidates in [capitals, others] {
            match candidates.as_slice() {
                [] => {}
                [one] => return Located::Renamed((*one).clone()),
                [first, second, ..] => return Located::Several((*first).clone(), (*second).clone()),
            }
        }
        let of_kind = |p: &PathBuf| {
            let own = extension(p)?;
            UNREADABLE.iter().find(|(known, _)| *known == own).map(|(_, kind)| Located::Unreadable(p.clone(), kind))
        };
        of(&name).chain(of(stem)).find_map(of_kind).unwrap_or(Located::Missing)
    }
}

fn extension(path: &Path) -> Option<String> {
    path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase())
}

fn listed(folder: &Path) -> HashMap<String, Vec<PathBuf>> {
    let mut files: HashMap<String, Vec<PathBuf>> = HashMap::new();
    let entries = std::fs::read_dir(folder).into_iter().flatten().take(ImageFiles::MOST).flatten();
    let mut paths: Vec<PathBuf> = entries.map(|e| e.path()).collect();
    paths.sort();
    for path in paths {
        let stem = path.file_stem().map(|s| s.to_string_lossy().to_lowercase()).unwrap_or_default();
        files.entry(stem).or_default().push(path);
    }
    files
}

/// The kind of image that a file's name promises, where it is one that is not read.
pub fn unreadable_kind(path: &Path) -> Option<&'static str> {
    let own = extension(path)?;
    UNREADABLE.iter().find(|(known, _)| *known == own).map(|(_, kind)| *kind)
}

/// The file name without an image's extension: `r_0.5` keeps its dot.
pub(super) fn name_of(path: &Path) -> String {
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    match name.rsplit_once('.') {
        Some((stem, end)) if IMAGE_EXTENSIONS.contains(&end.to_ascii_lowercase().as_str()) => stem.to_owned(),
        _ => name,
    }
}

/// What to do about an image of a kind that is not read.
pub const CONVERT: &str =
    "convert it to JPEG or PNG (`magick mogrify -format jpg *.heic`, or `sips -s format jpeg` on a Mac)";
