//! What objects are made of: seeds of the generator, or mesh files.

use std::collections::HashSet;
use std::io::Read;
use std::path::{Path, PathBuf};

use crate::{DataError, Input, Split};
use freerange_util::{IoError, hex, sha256};
use sha2::{Digest, Sha256};

use crate::build::object::generated_id;

/// Endings of mesh files that are looked for in a folder.
const ENDINGS: [&str; 4] = ["glb", "gltf", "obj", "ply"];
/// Longest name of an object.
const MAX_ID: usize = 64;
/// Largest list, in bytes.
const MAX_LIST: u64 = 1 << 30;

/// What one object is made of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Item {
    /// What the object is called: 1 to 64 of `A-Z a-z 0-9 - _`.
    pub id: String,
    /// The mesh; `None` for an object that is generated.
    pub file: Option<PathBuf>,
    /// Where it comes from, in words for people; goes into the object's metadata.
    pub source: String,
    /// License, as an SPDX identifier.
    pub license: String,
    /// The part of the data that it belongs to; `None`: decided by its id.
    pub split: Option<Split>,
    /// Seed of all that is drawn for it; `None`: follows from its id and the seed of the configuration.
    pub seed: Option<u64>,
}

/// All that objects are made of, in a fixed order.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Items {
    kind: Kind,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Kind {
    Generated { objects: u64, seed: u64 },
    Files(Vec<Item>),
}

/// One line of a list of meshes.
#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    path: PathBuf,
    id: Option<String>,
    source: Option<String>,
    license: Option<String>,
    split: Option<Split>,
}

impl Items {
    /// `objects` generated objects, the first one of `seed`.
    pub fn generated(objects: u64, seed: u64) -> Self {
        Self { kind: Kind::Generated { objects, seed } }
    }

    /// The mesh files (`.glb`, `.gltf`, `.obj`, `.ply`) below a folder in the order of their names, or one file. Ids are
    /// made of the paths.
    ///
    /// # Errors
    /// [`DataError::Io`]; [`DataError::File`] where there is none.
    pub fn find(path: &Path, source: &str, license: &str) -> Result<Self, DataError> {
        let mut files = Vec::new();
        if path.is_dir() {
            for entry in walkdir::WalkDir::new(path).sort_by_file_name() {
                let entry = entry.map_err(|e| {
                    let at = e.path().unwrap_or(path).to_path_buf();
                    DataError::from(IoError::at(&at)(e.into()))
                })?;
                if entry.file_type().is_file() && is_mesh(entry.path()) {
                    files.push(entry.into_path());
                }
            }
        } else {
            std::fs::metadata(path).map_err(IoError::at(path))?;
            files.push(path.into());
        }
        if files.is_empty() {
            let problem = format!("expected mesh files ({}), found none", ENDINGS.join(", "));
            return Err(DataError::File { path: path.into(), problem });
        }
        let root = if path.is_dir() { path } else { path.parent().unwrap_or(path) };
        let mut ids = Ids::default();
        let items = files.into_iter().map(|file| {
            let relative = file.strip_prefix(root).unwrap_or(&file).to_string_lossy().replace('\\', "/");
            let id = ids.name(&relative);
            let (source, license) = (format!("{source}{relative}"), license.to_owned());
            Item { id, file: Some(file), source, license, split: None, seed: None }
        });
        Ok(Self { kind: Kind::Files(items.collect()) })
    }

    /// A list of meshes as JSON lines: `{"path": "chair.glb"}`, relative to the list's folder; further fields are `id`,
    /// `source`, `license` (SPDX), `split` (`train`, `validation` or `test`).
    ///
    /// # Errors
    /// [`DataError::Io`]; [`DataError::File`] with the line that is wrong, or where an id occurs twice.
    pub fn list(path: &Path, source: &str, license: &str) -> Result<Self, DataError> {
        let problem = |problem: String| DataError::File { path: path.into(), problem };
        let mut text = String::new();
        let file = std::fs::File::open(path).map_err(IoError::at(path))?;
        file.take(MAX_LIST + 1).read_to_string(&mut text).map_err(IoError::at(path))?;
        if text.len() as u64 > MAX_LIST {
            return Err(problem(format!("expected at most {MAX_LIST} bytes")));
        }
        let root = path.parent().unwrap_or(Path::new(""));
        let mut ids = Ids::default();
        let mut items = Vec::new();
        for (number, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
            let at = |what: String| problem(format!("line {}: {what}", number + 1));
            let line: Line = serde_json::from_str(line).map_err(|e| at(e.to_string()))?;
            let relative = line.path.to_string_lossy().replace('\\', "/");
            let id = match line.id {
                None => ids.name(&relative),
                Some(id) if !crate::layout::is_key(&id) => {
                    return Err(at(format!("id: expected 1 to {MAX_ID} of A-Z a-z 0-9 - _, found {id:?}")));
                }
                Some(id) if !ids.0.insert(id.clone()) => {
                    return Err(at(format!("id: expected ids that occur once, found {id:?} again")));
                }
                Some(id) => id,
            };
            items.push(Item {
                id,
                file: Some(root.join(&line.path)),
                source: line.source.unwrap_or_else(|| format!("{source}{relative}")),
                license: line.license.unwrap_or_else(|| license.to_owned()),
                split: line.split,
                seed: None,
            });
        }
        if items.is_empty() {
            return Err(problem("expected meshes, found none".into()));
        }
        Ok(Self { kind: Kind::Files(items) })
    }

    /// Number of items.
    pub fn len(&self) -> u64 {
        match &self.kind {
            Kind::Generated { objects, .. } => *objects,
            Kind::Files(items) => items.len() as u64,
        }
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Item number `index`, if there is one.
    pub fn get(&self, index: u64) -> Option<Item> {
        match &self.kind {
            Kind::Files(items) => items.get(usize::try_from(index).ok()?).cloned(),
            Kind::Generated { objects, seed } => (index < *objects).then(|| {
                let seed = seed.wrapping_add(index);
                Item {
                    id: generated_id(seed),
                    file: None,
                    source: "generated".into(),
                    license: "CC0-1.0".into(),
                    split: None,
                    seed: Some(seed),
                }
            }),
        }
    }

    /// At most `count` of them, evenly spread.
    pub fn spread(&self, count: u64) -> Self {
        let count = count.min(self.len());
        match &self.kind {
            Kind::Files(items) if count == items.len() as u64 => self.clone(),
            Kind::Generated { seed, .. } => Self::generated(count, *seed),
            Kind::Files(items) => {
                let at =
                    |i: u64| items.get((u128::from(i) * items.len() as u128 / u128::from(count)) as usize).cloned();
                Self { kind: Kind::Files((0..count).filter_map(at).collect()) }
            }
        }
    }

    /// What a manifest says of them.
    pub fn describe(&self) -> Input {
        match &self.kind {
            Kind::Generated { objects, seed } => Input::Generated { objects: *objects, seed: *seed },
            Kind::Files(items) => {
                let mut hash = Sha256::new();
                for item in items {
                    // Paths are not part of it: the same files may lie elsewhere on another machine.
                    for field in [&item.id, &item.source, &item.license, &format!("{:?}", item.split)] {
                        hash.update((field.len() as u64).to_le_bytes());
                        hash.update(field);
                    }
                }
                Input::Files { objects: items.len() as u64, sha256: hex(&hash.finalize()) }
            }
        }
    }
}

fn is_mesh(path: &Path) -> bool {
    let ending = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
    ending.is_some_and(|e| ENDINGS.contains(&e.as_str()))
}

/// Names given so far.
#[derive(Default)]
struct Ids(HashSet<String>);

impl Ids {
    /// A name for `path` that no other has: the path without ending, or, where that would be too long or is taken, with a
    /// hash of it.
    fn name(&mut self, path: &str) -> String {
        let stem = path.rsplit_once('.').map_or(path, |(stem, _)| stem);
        let plain: String =
            stem.chars().map(|c| if c.is_ascii_alphanumeric() || c == '_' || c == '-' { c } else { '-' }).collect();
        let plain = plain.trim_matches('-');
        let mut id = plain.to_owned();
        if id.is_empty() || id.len() > MAX_ID || self.0.contains(&id) {
            let digest = sha256(path.as_bytes());
            id = format!("{}-{}", &plain[..plain.len().min(MAX_ID - 17)], &digest[..16]);
        }
        self.0.insert(id.clone());
        id
    }
}

/// The part of the data an object belongs to, and the seed of what is drawn for it: both follow from its id.
pub(crate) fn draw(id: &str, seed: u64, what: &str) -> u64 {
    let digest = Sha256::new().chain_update(seed.to_le_bytes()).chain_update(what).chain_update(":").chain_update(id);
    let digest = digest.finalize();
    digest.iter().take(8).fold(0, |sum, &b| sum << 8 | u64::from(b))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_walked_in_order_and_names_are_unique() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        std::fs::create_dir_all(root.join("b/c")).unwrap();
        let long = format!("{}.obj", "x".repeat(90));
        for name in ["b/c/mug.GLB", "b-c-mug.ply", "a.txt", "b/ä.gltf", long.as_str()] {
            std::fs::write(root.join(name), b"").unwrap();
        }
        let items = Items::find(root, "shop: ", "CC-BY-4.0").unwrap();
        let all: Vec<Item> = (0..items.len()).map(|i| items.get(i).unwrap()).collect();
        assert_eq!(all.len(), 4);
        assert_eq!(all[0].id, "b-c-mug");
        assert_eq!((all[0].source.as_str(), all[0].license.as_str()), ("shop: b/c/mug.GLB", "CC-BY-4.0"));
        assert!(all.iter().all(|i| crate::layout::is_key(&i.id)), "{all:?}");
        assert_eq!(all.iter().map(|i| &i.id).collect::<HashSet<_>>().len(), 4);
        assert_eq!(Items::find(root, "shop: ", "CC-BY-4.0").unwrap(), items);
        assert_eq!(items.get(4), None);
        let one = Items::find(&root.join("b-c-mug.ply"), "", "").unwrap();
        assert_eq!(one.get(0).unwrap().id, "b-c-mug");
        let empty = tempfile::tempdir().unwrap();
        assert!(Items::find(empty.path(), "", "").unwrap_err().to_string().contains("glb"));
        assert!(matches!(Items::find(&root.join("none"), "", ""), Err(DataError::Io(_))));
    }

    #[test]
    fn lists_say_what_folders_cannot() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("list.jsonl");
        let write = |text: &str| std::fs::write(&path, text).unwrap();
        write(
            "{\"path\": \"m/a.glb\", \"license\": \"MIT\", \"split\": \"test\"}\n\n{\"path\":\"/b.ply\",\"id\":\"bee\"}\n",
        );
        let items = Items::list(&path, "", "unknown").unwrap();
        let (a, b) = (items.get(0).unwrap(), items.get(1).unwrap());
        assert_eq!((a.id.as_str(), a.license.as_str(), a.split), ("m-a", "MIT", Some(Split::Test)));
        assert_eq!(a.file.unwrap(), folder.path().join("m/a.glb"));
        assert_eq!(Ids::default().name("/a/b c.ply"), "a-b-c");
        assert_eq!((b.id.as_str(), b.license.as_str(), b.file.unwrap()), ("bee", "unknown", "/b.ply".into()));
        for (text, named) in [
            ("", "found none"),
            ("{\"path\": \"a.glb\"}\n{}", "line 2"),
            ("{\"path\": \"a.glb\", \"id\": \"../x\"}", "id"),
            ("{\"path\": \"a.glb\", \"id\": \"x\"}\n{\"path\": \"b.glb\", \"id\": \"x\"}", "again"),
            ("{\"path\": \"a.glb\", \"split\": \"dev\"}", "dev"),
        ] {
            write(text);
            let found = Items::list(&path, "", "").unwrap_err().to_string();
            assert!(found.contains(named) && found.contains("list.jsonl"), "{found}");
        }
    }

    #[test]
    fn the_description_tells_lists_apart_and_ignores_paths() {
        let item = |id: &str, license: &str| Item {
            id: id.into(),
            file: Some("x".into()),
            source: String::new(),
            license: license.into(),
            split: None,
            seed: None,
        };
        let of = |items: Vec<Item>| Items { kind: Kind::Files(items) }.describe();
        let one = of(vec![item("a", "b")]);
        assert_eq!(one, of(vec![Item { file: Some("y".into()), ..item("a", "b") }]));
        assert_ne!(one, of(vec![item("a", "c")]));
        assert_ne!(of(vec![item("ab", "")]), of(vec![item("a", "b")]));
        assert_eq!(one.objects(), 1);
        assert_ne!(draw("a", 0, "split"), draw("a", 0, "seed"));
        assert_ne!(draw("a", 0, "seed"), draw("a", 1, "seed"));
    }
}
