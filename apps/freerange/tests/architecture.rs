//! What `docs/architecture.md` says of the sources, held: crates in layers, no circle of files, headers, lengths.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
};

/// The layers in order, and the crates of each. A crate uses those listed before it.
const LAYERS: &[(&str, &[&str])] = &[
    ("base", &["freerange-util", "freerange-gaussians"]),
    ("capture", &["freerange-scene"]),
    ("render", &["freerange-raster", "freerange-assets"]),
    ("optimize", &["freerange-optim"]),
    ("learn", &["freerange-model", "freerange-data", "freerange-diffusion", "freerange-train", "freerange-ranks"]),
    ("product", &["freerange", "freerange-eval", "freerange-serve"]),
];

/// What a crate must not use although it lies below: the invariants that the crates' headers state.
const KEPT_APART: &[(&str, &[&str])] = &[
    ("freerange-scene", &["freerange-gaussians"]),
    ("freerange-assets", &["freerange-gaussians", "freerange-raster"]),
    ("freerange-optim", &["freerange-assets"]),
    ("freerange-model", &["freerange-scene", "freerange-raster", "freerange-assets", "freerange-optim"]),
    ("freerange-data", &["freerange-model"]),
    ("freerange-diffusion", &["freerange-assets", "freerange-data"]),
    ("freerange-train", &["freerange-assets"]),
    ("freerange-ranks", &["freerange-gaussians", "freerange-model", "freerange-data", "freerange-diffusion"]),
    ("freerange", &["freerange-assets", "freerange-data", "freerange-train", "freerange-ranks"]),
    ("freerange-eval", &["freerange-diffusion", "freerange-data", "freerange-train", "freerange-ranks", "freerange"]),
    (
        "freerange-serve",
        &[
            "freerange-model",
            "freerange-data",
            "freerange-diffusion",
            "freerange-train",
            "freerange-ranks",
            "freerange",
            "freerange-eval",
        ],
    ),
];

/// Crates that may use tensors, and those of them that are built without, too.
const WITH_TENSORS: &[&str] =
    &["freerange-raster", "freerange-model", "freerange-diffusion", "freerange-train", "freerange-ranks", "freerange"];
const TENSORS_OPTIONAL: &[&str] = &["freerange-raster", "freerange-eval"];

/// Most crates under `crates/`.
const MOST_CRATES: usize = 14;
/// Most lines of a source file.
const MOST_LINES: usize = 500;
/// Most lines of a function outside of kernels.
const MOST_OF_A_FUNCTION: usize = 80;
/// Folders of kernels, whose innermost loops are in one piece.
const KERNELS: [&str; 4] = ["gpu", "cpu", "cube", "kernels"];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn within(folder: &Path) -> Vec<PathBuf> {
    let listed = fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
    let mut found: Vec<PathBuf> = listed.map(|entry| entry.unwrap().path()).collect();
    found.sort();
    found
}

fn name(path: &Path) -> String {
    path.file_name().unwrap().to_str().unwrap().to_owned()
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// Folders of sources: of each crate, the program and the Python package.
fn source_folders() -> Vec<PathBuf> {
    let crates = within(&root().join("crates")).into_iter().flat_map(|layer| within(&layer));
    let mut found: Vec<PathBuf> = crates.map(|folder| folder.join("src")).collect();
    found.extend([root().join("apps/freerange/src"), root().join("python/rust")]);
    found
}

/// Rust sources below `folder`.
fn sources(folder: &Path) -> Vec<PathBuf> {
    let (folders, files): (Vec<_>, Vec<_>) = within(folder).into_iter().partition(|path| path.is_dir());
    let here = files.into_iter().filter(|path| path.extension().is_some_and(|e| e == "rs"));
    here.chain(folders.iter().flat_map(|folder| sources(folder))).collect()
}

/// A path from the root of the repository on.
fn shown(path: &Path) -> String {
    path.strip_prefix(root()).unwrap_or(path).display().to_string()
}

#[test]
fn crates_lie_in_layers() {
    let crates = root().join("crates");
    let folders: BTreeSet<String> = within(&crates).iter().map(|p| name(p)).collect();
    assert_eq!(folders, LAYERS.iter().map(|(layer, _)| layer.to_string()).collect(), "folders under crates/");
    let mut below: Vec<&str> = Vec::new();
    for (layer, names) in LAYERS {
        let here: BTreeSet<String> = within(&crates.join(layer)).iter().map(|p| name(p)).collect();
        assert_eq!(here, names.iter().map(|n| n.to_string()).collect(), "crates/{layer}");
        for crate_ in *names {
            let apart = KEPT_APART.iter().find(|(c, _)| c == crate_).map_or(&[][..], |(_, apart)| apart);
            for (used, _) in dependencies(&crates.join(layer).join(crate_).join("Cargo.toml")) {
                if used.starts_with("freerange") {
                    assert!(below.contains(&used.as_str()), "{crate_} must not use {used}, which is not below it");
                    assert!(!apart.contains(&used.as_str()), "{crate_} must not use {used}");
                }
            }
            below.push(crate_);
        }
    }
    assert!(below.len() <= MOST_CRATES, "{} crates, at most {MOST_CRATES}", below.len());
}

#[test]
fn tensors_stay_where_they_belong() {
    for (crate_, folder) in crate_folders() {
        for (used, optional) in dependencies(&folder.join("Cargo.toml")) {
            if ["burn", "cubecl", "cubek"].iter().any(|tensors| used.starts_with(tensors)) {
                let fits = WITH_TENSORS.contains(&crate_) || TENSORS_OPTIONAL.contains(&crate_);
                assert!(fits, "{crate_} must not use {used}");
                assert!(optional || !TENSORS_OPTIONAL.contains(&crate_), "{used} of {crate_} is to be optional");
            }
        }
    }
}

#[test]
fn crates_say_what_they_are() {
    let overview = read(&root().join("docs/architecture.md"));
    for (crate_, folder) in crate_folders() {
        let header: String = read(&folder.join("src/lib.rs")).lines().take_while(|l| l.starts_with("//!")).collect();
        assert!(header.contains("Architecture invariant:"), "the header of {crate_} states its invariant");
        assert!(overview.contains(&format!("`{crate_}`")), "docs/architecture.md says what {crate_} is");
    }
}

fn crate_folders() -> impl Iterator<Item = (&'static str, PathBuf)> {
    let all = LAYERS.iter().flat_map(|(layer, names)| names.iter().map(move |crate_| (layer, *crate_)));
    all.map(|(layer, crate_)| (crate_, root().join("crates").join(layer).join(crate_)))
}

/// What a manifest depends on outside of tests, on any system, and whether only with a feature.
fn dependencies(manifest: &Path) -> Vec<(String, bool)> {
    let manifest: toml::Table = toml::from_str(&read(manifest)).unwrap();
    let targets = manifest.get("target").and_then(|t| t.as_table()).into_iter().flat_map(|t| t.values());
    let tables = targets.filter_map(|t| t.as_table()).chain([&manifest]);
    let lists = tables.flat_map(|t| [t.get("dependencies"), t.get("build-dependencies")]).flatten();
    let optional = |value: &toml::Value| value.get("optional").and_then(|o| o.as_bool()).unwrap_or(false);
    lists.flat_map(|t| t.as_table().unwrap()).map(|(used, value)| (used.clone(), optional(value))).collect()
}

#[test]
fn files_form_no_circle() {
    let circles: Vec<String> = source_folders().iter().flat_map(|folder| Files::read(folder).circles(folder)).collect();
    assert!(circles.is_empty(), "files that use each other in a circle:\n{}", circles.join("\n"));
}

/// A file's place in its crate: `["load", "masks"]`.
type Module = Vec<String>;

/// Which files of a crate use which, by the paths in their text.
///
/// A file and those in the folder of its name count as one where they are compared with their siblings; what a file uses of
/// the one above it does not count. Unit tests may use everything.
struct Files {
    texts: BTreeMap<Module, String>,
    /// Names that a file has from another one of the crate: its children may use them, and if it hands them on, all may.
    names: BTreeMap<Module, BTreeMap<String, Module>>,
}

impl Files {
    fn read(folder: &Path) -> Self {
        let mut files = Self { texts: BTreeMap::new(), names: BTreeMap::new() };
        for path in sources(folder).into_iter().filter(|path| !is_test(path)) {
            let place = path.strip_prefix(folder).unwrap().with_extension("");
            let mut module: Module = place.iter().map(|p| p.to_str().unwrap().to_owned()).collect();
            if ["mod", "lib", "main"].contains(&module.last().unwrap().as_str()) {
                module.pop();
            }
            files.texts.insert(module, without_tests(&read(&path)));
        }
        // Names come by way of other files' names.
        for _ in 0..3 {
            for (module, text) in &files.texts {
                for (path, name) in use_paths(text) {
                    if let Some(to) = files.resolve(&path, module).filter(|to| to != module) {
                        files.names.entry(module.clone()).or_default().insert(name, to);
                    }
                }
            }
        }
        files
    }

    /// The file that a path leads to from `module`; none outside of the crate.
    fn resolve(&self, path: &str, module: &Module) -> Option<Module> {
        let mut parts = path.split("::").peekable();
        let mut at = match *parts.peek()? {
            "crate" => {
                parts.next();
                Vec::new()
            }
            "self" => {
                parts.next();
                module.clone()
            }
            "super" => {
                let mut above = module.clone();
                while parts.next_if_eq(&"super").is_some() {
                    above.pop();
                }
                above
            }
            first if self.texts.contains_key(&[&module[..], &[first.to_owned()]].concat()) => module.clone(),
            _ => return None,
        };
        for part in parts {
            let below = [&at[..], &[part.to_owned()]].concat();
            if !self.texts.contains_key(&below) {
                return Some(self.names.get(&at).and_then(|names| names.get(part)).cloned().unwrap_or(at));
            }
            at = below;
        }
        Some(at)
    }

    /// Who uses whom in a circle.
    fn circles(&self, folder: &Path) -> Vec<String> {
        // Of each folder, its entries and which of them use which.
        let mut levels: BTreeMap<&[String], BTreeMap<&str, BTreeSet<String>>> = BTreeMap::new();
        for (from, text) in &self.texts {
            let paths = use_paths(text).into_iter().map(|(path, _)| path).chain(inline_paths(text));
            for to in paths.filter_map(|path| self.resolve(&path, from)) {
                let common = from.iter().zip(&to).take_while(|(a, b)| a == b).count();
                if common < from.len() && common < to.len() {
                    let uses = levels.entry(&from[..common]).or_default();
                    uses.entry(&from[common]).or_default().insert(to[common].clone());
                }
            }
        }
        let mut found = Vec::new();
        for (above, uses) in levels {
            for (from, to) in &uses {
                let circle: Vec<&str> = to.iter().map(String::as_str).filter(|to| leads(&uses, to, from)).collect();
                if !circle.is_empty() {
                    let place = above.iter().fold(folder.to_path_buf(), |at, part| at.join(part)).join(from);
                    found.push(format!("{} uses {}", shown(&place), circle.join(", ")));
                }
            }
        }
        found
    }
}

/// Whether `from` uses `to`, by way of others or itself.
fn leads(uses: &BTreeMap<&str, BTreeSet<String>>, from: &str, to: &str) -> bool {
    let (mut reached, mut next) = (BTreeSet::new(), vec![from]);
    while let Some(at) = next.pop() {
        if at == to {
            return true;
        }
        if reached.insert(at) {
            next.extend(uses.get(at).into_iter().flatten().map(String::as_str));
        }
    }
    false
}

/// The text without comments and unit tests.
fn without_tests(text: &str) -> String {
    let end = text.find("#[cfg(test)]\nmod tests {").unwrap_or(text.len());
    text[..end].lines().map(|l| l.split("//").next().unwrap()).collect::<Vec<_>>().join("\n")
}

/// The paths of all `use`, each with the name that it gives.
fn use_paths(text: &str) -> Vec<(String, String)> {
    let mut found = Vec::new();
    let mut rest = text;
    while let Some((before, after)) = rest.split_once("use ") {
        rest = after;
        let before = before.rsplit('\n').next().unwrap().trim();
        if before.is_empty() || before.starts_with("pub") && !before.contains(' ') {
            let tree = after.split(';').next().unwrap();
            expand(&tree.split_whitespace().collect::<Vec<_>>().join(" "), "", &mut found);
        }
    }
    found
}

/// `a::{b, c::d as e}` as `a::b` with the name `b`, and `a::c::d` with the name `e`.
fn expand(tree: &str, prefix: &str, found: &mut Vec<(String, String)>) {
    let tree = tree.trim();
    let Some((head, inside)) = tree.split_once('{') else {
        let (path, alias) = tree.split_once(" as ").unwrap_or((tree, ""));
        let path = format!("{prefix}{path}").trim_end_matches("::self").to_owned();
        let name = if alias.is_empty() { path.rsplit("::").next().unwrap() } else { alias }.to_owned();
        found.extend((!tree.is_empty()).then_some((path, name)));
        return;
    };
    let prefix = format!("{prefix}{head}");
    let inside = inside.strip_suffix('}').unwrap_or(inside);
    let (mut depth, mut start) = (0, 0);
    for (i, c) in inside.char_indices().chain([(inside.len(), ',')]) {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 0 => {
                expand(&inside[start..i], &prefix, found);
                start = i + 1;
            }
            _ => {}
        }
    }
}

/// Paths from `crate`, `super` or `self` outside of `use`.
fn inline_paths(text: &str) -> Vec<String> {
    let words = text.split(|c: char| !(c.is_alphanumeric() || c == '_' || c == ':'));
    let inside = words.filter(|w| ["crate::", "super::", "self::"].iter().any(|head| w.starts_with(head)));
    inside.map(|path| path.trim_end_matches(':').to_owned()).collect()
}

/// Whether a file holds tests alone.
fn is_test(path: &Path) -> bool {
    let here = path.strip_prefix(root()).unwrap_or(path);
    here.iter().any(|p| p == "tests" || p == "tests.rs" || p.to_str().is_some_and(|p| p.ends_with("_tests.rs")))
}

#[test]
fn files_have_headers_and_are_short() {
    let mut found = Vec::new();
    for path in source_folders().iter().flat_map(|folder| sources(folder)) {
        let text = read(&path);
        if !text.starts_with("//! ") {
            found.push(format!("{}: no header (`//!`)", shown(&path)));
        }
        let lines = text.lines().count();
        if lines > MOST_LINES && !is_test(&path) {
            found.push(format!("{}: {lines} lines, at most {MOST_LINES}", shown(&path)));
        }
    }
    assert!(found.is_empty(), "\n{}", found.join("\n"));
}

#[test]
fn functions_are_short() {
    let mut found = Vec::new();
    for path in source_folders().iter().flat_map(|folder| sources(folder)) {
        if is_test(&path) || path.iter().any(|part| KERNELS.iter().any(|k| part == *k)) {
            continue;
        }
        for (line, length) in functions(&read(&path)) {
            if length > MOST_OF_A_FUNCTION {
                found.push(format!("{}:{line}: {length} lines, at most {MOST_OF_A_FUNCTION}", shown(&path)));
            }
        }
    }
    assert!(found.is_empty(), "\n{}", found.join("\n"));
}

/// Where functions begin, and how many lines they have; as `rustfmt` sets them.
fn functions(text: &str) -> Vec<(usize, usize)> {
    let lines: Vec<&str> = text.lines().collect();
    let mut found = Vec::new();
    for (start, line) in lines.iter().enumerate() {
        let mut head = line.trim_start();
        let indent = &line[..line.len() - head.len()];
        for qualifier in ["pub ", "pub(crate) ", "pub(super) ", "const ", "async ", "unsafe ", "extern \"C\" "] {
            head = head.strip_prefix(qualifier).unwrap_or(head);
        }
        if head.starts_with("fn ") && !line.ends_with(['}', ';']) {
            let after = lines[start + 1..].iter().map(|l| l.strip_prefix(indent).unwrap_or_default());
            // With a body, or without one in a trait.
            let end = after.clone().position(|l| l == "}" || l.starts_with(')') && l.ends_with(';'));
            found.extend(end.map(|end| (start + 1, end + 2)));
        }
    }
    found
}
