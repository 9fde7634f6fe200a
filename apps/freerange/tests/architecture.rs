//! What `docs/architecture.md` says of the sources, held: crates in layers, no circle of files, headers, lengths, words.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
};

/// The layers, bottom to top, and the crates of each. A crate uses those listed before it.
const LAYERS: &[(&str, &[&str])] = &[
    ("base", &["freerange-util", "freerange-gaussians"]),
    ("capture", &["freerange-scene"]),
    ("render", &["freerange-raster", "freerange-assets"]),
    ("optimize", &["freerange-optim"]),
    ("learn", &["freerange-model", "freerange-diffusion", "freerange-data", "freerange-train", "freerange-ranks"]),
    ("product", &["freerange", "freerange-eval", "freerange-serve"]),
];

/// What a crate must not use although it lies below, each with the reason that its header gives.
const KEPT_APART: &[(&str, &[&str])] = &[
    ("freerange-scene", &["freerange-gaussians"]),
    ("freerange-assets", &["freerange-gaussians", "freerange-raster"]),
    ("freerange-optim", &["freerange-assets"]),
    ("freerange-model", &["freerange-scene", "freerange-raster", "freerange-assets", "freerange-optim"]),
    ("freerange-diffusion", &["freerange-assets", "freerange-data"]),
    ("freerange-train", &["freerange-assets"]),
    ("freerange", &["freerange-assets", "freerange-data", "freerange-train", "freerange-ranks"]),
    ("freerange-eval", &["freerange-diffusion", "freerange-data", "freerange-train", "freerange-ranks", "freerange"]),
    (
        "freerange-serve",
        &["freerange-model", "freerange-diffusion", "freerange-data", "freerange-train", "freerange", "freerange-eval"],
    ),
];

/// Most crates under `crates/`.
const MOST_CRATES: usize = 14;
/// Most lines of a source file.
const MOST_LINES: usize = 500;
/// Most lines of a function outside of kernels.
const MOST_OF_A_FUNCTION: usize = 80;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn within(folder: &Path) -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    found.sort();
    found
}

/// Folders of all crates with sources of ours, but those of tests.
fn crates() -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> = within(&root().join("crates")).iter().flat_map(|layer| within(layer)).collect();
    found.push(root().join("apps/freerange"));
    found.push(root().join("python"));
    found
}

/// Rust sources below `folder`.
fn sources(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for path in within(folder) {
        if path.is_dir() {
            found.extend(sources(&path));
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.push(path);
        }
    }
    found
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

#[test]
fn crates_lie_in_layers() {
    let mut order: Vec<&str> = Vec::new();
    let overview = read(&root().join("docs/architecture.md"));
    let folders: Vec<String> = within(&root().join("crates")).iter().map(|p| name(p)).collect();
    let mut layers: Vec<&str> = LAYERS.iter().map(|(layer, _)| *layer).collect();
    layers.sort_unstable();
    assert_eq!(folders, layers, "folders under crates/ are the layers");
    for (layer, names) in LAYERS {
        let here: BTreeSet<String> = within(&root().join("crates").join(layer)).iter().map(|p| name(p)).collect();
        assert_eq!(here, names.iter().map(|n| n.to_string()).collect(), "crates/{layer}");
        for crate_ in *names {
            let folder = root().join("crates").join(layer).join(crate_);
            for used in uses(&folder.join("Cargo.toml")) {
                assert!(order.contains(&used.as_str()), "{crate_} is below {used}");
                let apart = KEPT_APART.iter().find(|(c, _)| c == crate_).map_or(&[][..], |(_, apart)| apart);
                assert!(!apart.contains(&used.as_str()), "{crate_} must not use {used}");
            }
            let header: String =
                read(&folder.join("src/lib.rs")).lines().take_while(|l| l.starts_with("//!")).collect();
            assert!(header.contains("Architecture invariant:"), "the header of {crate_} states its invariant");
            assert!(overview.contains(&format!("`{crate_}`")), "docs/architecture.md says what {crate_} is");
            order.push(crate_);
        }
    }
    assert!(order.len() <= MOST_CRATES, "{} crates, at most {MOST_CRATES}", order.len());
}

fn name(path: &Path) -> String {
    path.file_name().unwrap().to_str().unwrap().to_owned()
}

/// Crates of ours that a manifest depends on outside of tests.
fn uses(manifest: &Path) -> Vec<String> {
    let manifest: toml::Table = toml::from_str(&read(manifest)).unwrap();
    let tables = [manifest.get("dependencies"), manifest.get("build-dependencies")];
    let all = tables.into_iter().flatten().flat_map(|t| t.as_table().unwrap().keys().cloned());
    all.filter(|d| d.starts_with("freerange")).collect()
}

/// A file's place in its crate: `["load", "masks"]`.
type Module = Vec<String>;

#[test]
fn files_form_no_circle() {
    let mut circles = Vec::new();
    for folder in crates() {
        let graph = ModuleGraph::read(&folder.join("src"));
        circles.extend(graph.circles().into_iter().map(|c| format!("{}: {c}", name(&folder))));
    }
    assert!(circles.is_empty(), "files that use each other in a circle:\n{}", circles.join("\n"));
}

/// Which files of a crate use which, by the paths in their text. A file and those in the folder of its name count as one
/// where they are compared with their siblings; what a file uses of the one above it does not count.
struct ModuleGraph {
    texts: BTreeMap<Module, String>,
    /// Names that a file hands on from another one of the crate.
    exports: BTreeMap<Module, BTreeMap<String, Module>>,
}

impl ModuleGraph {
    fn read(src: &Path) -> Self {
        let mut texts = BTreeMap::new();
        for path in sources(src) {
            let place = path.strip_prefix(src).unwrap().with_extension("");
            let mut module: Module = place.iter().map(|p| p.to_str().unwrap().to_owned()).collect();
            if module.last().is_some_and(|m| ["mod", "lib", "main"].contains(&m.as_str())) {
                module.pop();
            }
            if !module.iter().any(|m| m == "tests" || m.ends_with("_tests")) {
                texts.insert(module, without_tests(&read(&path)));
            }
        }
        let mut graph = Self { texts, exports: BTreeMap::new() };
        let modules: Vec<Module> = graph.texts.keys().cloned().collect();
        for module in modules {
            for path in use_paths(&graph.texts[&module], true) {
                if let Some(to) = graph.resolve(&path, &module).filter(|to| *to != module) {
                    let exported = path.rsplit("::").next().unwrap().to_owned();
                    graph.exports.entry(module.clone()).or_default().insert(exported, to);
                }
            }
        }
        graph
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
            first => {
                let mut below = module.clone();
                below.push(first.to_owned());
                if !self.texts.contains_key(&below) {
                    return None;
                }
                module.clone()
            }
        };
        for part in parts {
            let mut below = at.clone();
            below.push(part.to_owned());
            if self.texts.contains_key(&below) {
                at = below;
            } else {
                return Some(self.exports.get(&at).and_then(|names| names.get(part)).cloned().unwrap_or(at));
            }
        }
        Some(at)
    }

    fn circles(&self) -> Vec<String> {
        // Of each folder, its entries and which of them use which.
        let mut levels: BTreeMap<&[String], BTreeMap<&str, BTreeSet<&str>>> = BTreeMap::new();
        let edges: Vec<(&Module, Module)> = self
            .texts
            .iter()
            .flat_map(|(module, text)| {
                let paths = use_paths(text, false).into_iter().chain(inline_paths(text));
                paths.filter_map(move |p| Some((module, self.resolve(&p, module)?)))
            })
            .collect();
        for (from, to) in &edges {
            let common = from.iter().zip(to).take_while(|(a, b)| a == b).count();
            if common < from.len() && common < to.len() {
                let level = levels.entry(&from[..common]).or_default();
                level.entry(&from[common]).or_default().insert(&to[common]);
            }
        }
        let mut found = Vec::new();
        for (folder, uses) in levels {
            for start in uses.keys() {
                let mut reached = BTreeSet::new();
                let mut next: Vec<&str> = uses[start].iter().copied().collect();
                while let Some(at) = next.pop() {
                    if reached.insert(at) {
                        next.extend(uses.get(at).into_iter().flatten());
                    }
                }
                let with: Vec<&str> = reached
                    .iter()
                    .copied()
                    .filter(|other| uses[start].contains(other) && (*other == *start || reaches(&uses, other, start)))
                    .collect();
                if reached.contains(start) {
                    found.push(format!(
                        "{} -> {}",
                        [folder, &[start.to_string()]].concat().join("::"),
                        with.join(", ")
                    ));
                }
            }
        }
        found
    }
}

fn reaches(uses: &BTreeMap<&str, BTreeSet<&str>>, from: &str, to: &str) -> bool {
    let mut reached = BTreeSet::new();
    let mut next = vec![from];
    while let Some(at) = next.pop() {
        for other in uses.get(at).into_iter().flatten() {
            if *other == to {
                return true;
            }
            if reached.insert(*other) {
                next.push(other);
            }
        }
    }
    false
}

/// The text without comments and unit tests.
fn without_tests(text: &str) -> String {
    let end = text.find("#[cfg(test)]\nmod tests {").unwrap_or(text.len());
    text[..end].lines().map(|l| l.split("//").next().unwrap()).collect::<Vec<_>>().join("\n")
}

/// The paths of all `use`, or of those that hand names on.
fn use_paths(text: &str, exported: bool) -> Vec<String> {
    let mut paths = Vec::new();
    let mut rest = text;
    while let Some(at) = rest.find("use ") {
        let before = rest[..at].rsplit('\n').next().unwrap().trim();
        let starts = before.is_empty() || (before.starts_with("pub") && !before.contains(' '));
        let body = &rest[at + 4..];
        let Some(end) = body.find(';') else { break };
        if starts && (!exported || before.starts_with("pub")) {
            expand(&body[..end].split_whitespace().collect::<Vec<_>>().join(" "), "", &mut paths);
        }
        rest = if starts { &body[end..] } else { body };
    }
    paths
}

/// `a::{b, c::d as e}` as its paths.
fn expand(tree: &str, prefix: &str, paths: &mut Vec<String>) {
    let tree = tree.trim();
    let Some(open) = tree.find('{') else {
        if !tree.is_empty() {
            paths.push(format!("{prefix}{}", tree.split(" as ").next().unwrap().trim()));
        }
        return;
    };
    let prefix = format!("{prefix}{}", &tree[..open]);
    let inside = &tree[open + 1..tree.rfind('}').unwrap_or(tree.len())];
    let (mut depth, mut start) = (0, 0);
    for (i, c) in inside.char_indices().chain([(inside.len(), ',')]) {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 0 => {
                expand(&inside[start..i], &prefix, paths);
                start = i + 1;
            }
            _ => {}
        }
    }
}

/// Paths from `crate`, `super` or `self` outside of `use`.
fn inline_paths(text: &str) -> Vec<String> {
    let mut found = Vec::new();
    for line in text.lines() {
        for head in ["crate::", "super::", "self::"] {
            let mut from = 0;
            while let Some(at) = line[from..].find(head) {
                let start = from + at;
                let word = |c: char| c.is_alphanumeric() || c == '_' || c == ':';
                let inner = line[..start].ends_with(|c: char| c.is_alphanumeric() || c == '_' || c == ':');
                let end = line[start..].find(|c| !word(c)).map_or(line.len(), |e| start + e);
                if !inner && !line[end..].starts_with('{') {
                    found.push(line[start..end].trim_end_matches(':').to_owned());
                }
                from = start + head.len();
            }
        }
    }
    found
}

/// Kernels, whose innermost loops are in one piece.
fn is_kernel(path: &Path) -> bool {
    path.iter().any(|part| ["gpu", "cube", "cpu", "kernels"].iter().any(|k| part.to_str() == Some(k)))
}

#[test]
fn files_and_functions_are_short_and_have_headers() {
    let mut found = Vec::new();
    for folder in crates() {
        for path in sources(&folder.join("src")) {
            let text = read(&path);
            let shown = path.strip_prefix(root()).unwrap_or(&path).display().to_string();
            let lines: Vec<&str> = text.lines().collect();
            let is_test =
                path.iter().any(|p| p.to_str().is_some_and(|p| p.starts_with("tests") || p.ends_with("_tests.rs")));
            if lines.len() > MOST_LINES {
                found.push(format!("{shown}: {} lines, at most {MOST_LINES}", lines.len()));
            }
            if !is_test && !text.starts_with("//!") && !text.starts_with("// ") {
                found.push(format!("{shown}: no header (`//!`)"));
            }
            if is_kernel(&path) || is_test {
                continue;
            }
            for (start, line) in lines.iter().enumerate() {
                let indent = line.len() - line.trim_start().len();
                let is_function =
                    line.trim_start().split_whitespace().take_while(|w| !w.contains('(')).any(|w| w == "fn")
                        || line.trim_start().split_whitespace().any(|w| w == "fn")
                            && line.trim_start().starts_with("pub");
                if !is_function || line.trim_start().starts_with("//") || line.trim_end().ends_with(['}', ';']) {
                    continue;
                }
                let close = format!("{}}}", " ".repeat(indent));
                let end = lines[start..].iter().position(|l| *l == close).unwrap_or(0);
                if end + 1 > MOST_OF_A_FUNCTION {
                    found.push(format!("{shown}:{}: a function of {} lines", start + 1, end + 1));
                }
            }
        }
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
}
