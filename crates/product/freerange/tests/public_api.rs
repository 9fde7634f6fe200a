//! The public API names no crate beneath this one: neither their errors, nor tensors, nor types that are not re-exported.
//!
//! A check of the source: signatures of public functions, public fields, variants, and headers of trait implementations are
//! looked through for names that come from elsewhere.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
};

fn beneath(root: &str) -> bool {
    root.starts_with("freerange_") || ["burn", "cubecl"].contains(&root)
}

/// Without comments, texts and test modules.
fn code(text: &str) -> String {
    let text = text.split("#[cfg(test)]").next().unwrap();
    let mut out = String::new();
    for line in text.lines() {
        let line = line.split("//").next().unwrap();
        // Texts hold no names.
        let outside = line.split('"').step_by(2).collect::<Vec<_>>().join("\"\"");
        out += &outside;
        out.push('\n');
    }
    out
}

/// Names and paths within a piece of code, but those of parameters and fields: `a::b`, `C`.
fn paths(code: &str) -> Vec<String> {
    let mut found = Vec::new();
    let mut path = String::new();
    let chars: Vec<char> = code.chars().collect();
    let mut i = 0;
    while i <= chars.len() {
        let c = chars.get(i).copied().unwrap_or(' ');
        if c.is_alphanumeric() || c == '_' {
            path.push(c);
        } else if c == ':' && chars.get(i + 1) == Some(&':') {
            path += "::";
            i += 1;
        } else if c == ':' {
            path.clear();
        } else if !path.is_empty() {
            found.push(std::mem::take(&mut path));
        }
        i += 1;
    }
    found
}

/// What `use` declarations bring: name to path.
fn imports(code: &str) -> BTreeMap<String, String> {
    fn tree(text: &str, prefix: &str, found: &mut BTreeMap<String, String>) {
        let mut depth = 0;
        let mut begin = 0;
        let mut parts = Vec::new();
        for (i, c) in text.char_indices() {
            match c {
                '{' => depth += 1,
                '}' => depth -= 1,
                ',' if depth == 0 => {
                    parts.push(&text[begin..i]);
                    begin = i + 1;
                }
                _ => {}
            }
        }
        parts.push(&text[begin..]);
        for part in parts.into_iter().map(str::trim).filter(|p| !p.is_empty()) {
            if let Some((head, rest)) = part.split_once('{') {
                tree(rest.trim_end().trim_end_matches('}'), &format!("{prefix}{head}"), found);
                continue;
            }
            let (path, name) = part.split_once(" as ").unwrap_or((part, part.rsplit("::").next().unwrap()));
            let path = format!("{prefix}{path}");
            let own = if name == "self" { path.rsplit("::").nth(1).unwrap() } else { name };
            found.insert(own.trim().to_owned(), path);
        }
    }
    let mut found = BTreeMap::new();
    for at in code.match_indices("use ").map(|(i, _)| i) {
        let alone = at == 0 || code[..at].ends_with(['\n', ' ', ')']) && !code[..at].ends_with("::");
        if let Some(end) = code[at..].find(';').filter(|_| alone) {
            tree(&code[at + 4..at + end].replace('\n', " "), "", &mut found);
        }
    }
    found
}

/// Up to the body or the end of an item.
fn header(code: &str) -> &str {
    let mut depth = 0i32;
    let end = code.char_indices().find(|(_, c)| {
        match c {
            '(' | '[' => depth += 1,
            ')' | ']' => depth -= 1,
            _ => {}
        }
        depth == 0 && matches!(c, '{' | ';')
    });
    &code[..end.map_or(code.len(), |e| e.0)]
}

/// The body in braces that follows.
fn body(code: &str) -> &str {
    let Some(begin) = code.find('{') else { return "" };
    let mut depth = 0;
    for (i, c) in code[begin..].char_indices() {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            _ => {}
        }
        if depth == 0 {
            return &code[begin + 1..begin + i];
        }
    }
    ""
}

/// The first name in a piece of code.
fn name(code: &str) -> &str {
    code.trim_start().split(|c: char| !c.is_alphanumeric() && c != '_').next().unwrap()
}

/// Pieces of a file that users see, where they see items of these names: what they are, and the code that names types.
fn public(code: &str, visible: &dyn Fn(&str) -> bool) -> Vec<(String, String)> {
    let (mut found, mut at) = (Vec::new(), 0);
    // Whether the methods that follow are of a type that users see.
    let mut methods = false;
    for line in code.split_inclusive('\n') {
        let (rest, word) = (&code[at..], line.trim_start());
        at += line.len();
        let top = !line.starts_with([' ', '}']);
        if top && line.starts_with("impl") {
            let head = header(rest);
            let of = head.rsplit(" for ").next().unwrap();
            methods = visible(name(of.trim_start_matches("impl")));
            if methods && head.contains(" for ") {
                found.push((head.to_owned(), head.to_owned()));
            }
        }
        for kind in ["fn", "const", "static", "type", "trait"] {
            let Some(after) = word.strip_prefix(&format!("pub {kind} ")) else { continue };
            if if top { visible(name(after)) } else { methods } {
                let head = header(&rest[rest.find("pub ").unwrap()..]);
                found.push((head.lines().next().unwrap().to_owned(), head.to_owned()));
            }
        }
        let kind = ["pub struct ", "pub enum "].into_iter().find_map(|kind| word.strip_prefix(kind));
        if kind.is_some_and(|after| visible(name(after))) {
            let head = header(rest);
            let fields = if head.contains('(') { head } else { body(rest) };
            let whole = word.starts_with("pub enum ");
            // Of a struct the public fields only.
            let pieces = fields.split(['\n', '(']).filter(|f| whole || f.trim_start().starts_with("pub "));
            found.push((word.trim().to_owned(), pieces.collect::<Vec<_>>().join("\n")));
        }
    }
    found
}

fn sources() -> Vec<PathBuf> {
    fn all(folder: &Path, found: &mut Vec<PathBuf>) {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => all(&path, found),
                false if path.extension().is_some_and(|e| e == "rs") => found.push(path),
                false => {}
            }
        }
    }
    let mut found = Vec::new();
    all(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), &mut found);
    // For this workspace's own program alone, and hidden.
    found.retain(|path| path.file_name().unwrap() != "internal.rs");
    found
}

/// Names of crates beneath in public pieces, but those that are re-exported.
fn leaks(code: &str, pieces: &[(String, String)], exported: &BTreeSet<String>) -> Vec<String> {
    let imports = imports(code);
    let mut found = Vec::new();
    for (item, piece) in pieces {
        for path in paths(piece) {
            let first = path.split("::").next().unwrap();
            let whole = match imports.get(first) {
                Some(origin) => path.replacen(first, origin, 1),
                None => path.clone(),
            };
            let (root, last) = (whole.split("::").next().unwrap(), whole.rsplit("::").next().unwrap());
            if beneath(root) && !exported.contains(last) {
                found.push(format!("{item}: {whole}"));
            }
        }
    }
    found
}

#[test]
fn nothing_of_the_crates_beneath_is_public() {
    let lib = code(&fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("src/lib.rs")).unwrap());
    let uses = imports(&lib);
    let errors = |path: &str| ["Error", "Tensor", "Invalid"].iter().any(|e| path.ends_with(e));
    for path in uses.values().filter(|path| beneath(path.split("::").next().unwrap())) {
        assert!(!errors(path) && !path.starts_with("burn"), "{path} is re-exported");
    }
    let exported: BTreeSet<String> = uses.values().map(|p| p.rsplit("::").next().unwrap().to_owned()).collect();
    assert!(exported.contains("View") && exported.contains("RefinerConfig"), "{exported:?}");
    let (mut found, mut seen) = (Vec::new(), 0);
    for path in sources() {
        let code = code(&fs::read_to_string(&path).unwrap());
        let module = path.file_stem().unwrap().to_str().unwrap();
        let open = lib.contains(&format!("pub mod {module};"));
        let pieces = public(&code, &|name| exported.contains(name) || open);
        seen += pieces.len();
        found.extend(leaks(&code, &pieces, &exported).into_iter().map(|l| format!("{}: {l}", path.display())));
    }
    assert!(seen > 80, "{seen} public pieces");
    assert!(found.is_empty(), "the public API names crates beneath:\n{}", found.join("\n"));
}

/// The check itself: what it has to find, and what it has to pass over.
#[test]
fn leaks_are_found() {
    let exported = BTreeSet::from(["View", "A", "a"].map(str::to_owned));
    let uses = "use burn::tensor::{Device as D, Tensor};\nuse freerange_scene::camera::{CameraError, View};\n";
    let of = |text: &str| {
        let code = format!("{uses}{}", code(text));
        leaks(&code, &public(&code, &|name| exported.contains(name)), &exported).len()
    };
    assert_eq!(of("pub fn a(views: &[View]) -> Result<(), CameraError> {}\n"), 1);
    assert_eq!(of("pub struct A {\n    pub x: Tensor,\n    y: D,\n}\n"), 1);
    assert_eq!(of("pub struct A(pub(crate) D);\n"), 0);
    assert_eq!(of("pub struct A(pub D);\n"), 1);
    assert_eq!(of("pub enum A {\n    X(CameraError),\n    Y { d: D },\n}\n"), 2);
    assert_eq!(of("pub enum A {}\nimpl From<CameraError> for A {\n}\n"), 1);
    assert_eq!(of("impl A {\n    pub fn m(&self) -> D {}\n    pub(crate) fn n() -> D {}\n}\n"), 1);
    assert_eq!(of("impl Private {\n    pub fn m(&self) -> D {}\n}\n"), 0);
    assert_eq!(of("pub fn a() -> freerange_optim::FitError {}\n"), 1);
    assert_eq!(of("fn a() -> D {}\npub(crate) fn a() -> D {}\npub fn not_exported() -> D {}\n"), 0);
    assert_eq!(of("/// D\npub fn a() {} // D\nconst T: &str = \"D\";\n"), 0);
}

/// Examples are written as a user writes them: this crate is all that they name.
#[test]
fn examples_need_this_crate_alone() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples");
    let mut count = 0;
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let code = code(&fs::read_to_string(&path).unwrap());
        let root = |path: &String| path.split("::").next().unwrap().to_owned();
        for used in imports(&code).values() {
            assert!(["std", "freerange"].contains(&&*root(used)), "{}: {used}", path.display());
        }
        let (_, body) = code.split_once("fn main").expect("a program");
        for used in paths(body).iter().filter(|path| path.contains("::")) {
            assert!(!beneath(&root(used)) && !["glam", "image"].contains(&&*root(used)), "{}: {used}", path.display());
        }
        count += 1;
    }
    assert!(count >= 2, "{count}");
}
