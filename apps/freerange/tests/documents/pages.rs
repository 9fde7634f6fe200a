//! The repository's Markdown: its pages, what they are made of, and how their language is measured.

use std::{
    fs,
    path::{Path, PathBuf},
};

/// The folder of the repository.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().unwrap()
}

/// A Markdown file.
pub struct Page {
    /// Its path within the repository, with `/`.
    pub name: String,
    /// What it says.
    pub text: String,
}

/// A fenced block.
pub struct Block {
    /// The words after the fence.
    pub info: String,
    /// Number of its first line, from 1.
    pub line: usize,
    /// What stands between the fences.
    pub text: String,
}

/// Files with one of these extensions, but for what git and builds leave: path within the repository, and text.
pub fn files(extensions: &[&str]) -> Vec<Page> {
    let (root, mut found) = (root(), Vec::new());
    let mut folders = vec![root.clone()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            let left =
                name.starts_with('.') && name != ".github" && name != ".ci" || name == "node_modules" || name == "venv";
            if left {
                continue;
            }
            if path.is_dir() {
                // A folder of builds: Cargo's own mark. `target` may also be a link to one.
                if name != "target" && !path.join("CACHEDIR.TAG").exists() {
                    folders.push(path);
                }
            } else if path.extension().is_some_and(|e| extensions.iter().any(|x| e == *x)) {
                let name = path.strip_prefix(&root).unwrap().to_string_lossy().replace('\\', "/");
                found.push(Page { name, text: fs::read_to_string(&path).unwrap() });
            }
        }
    }
    found.sort_by(|a, b| a.name.cmp(&b.name));
    found
}

/// Every page.
pub fn pages() -> Vec<Page> {
    files(&["md"])
}

/// Pages that are generated: their text is that of the code.
pub const GENERATED: [&str; 2] = ["docs/reference/cli.md", "docs/reference/config.md"];

impl Page {
    /// Pages whose language is held to the rules of CONTRIBUTING.md: the current ones that people write, but for the plan,
    /// which changes every day.
    pub fn is_plain(&self) -> bool {
        self.is_current() && self.name != "docs/status.md" && !GENERATED.contains(&self.name.as_str())
    }

    /// Pages about today's program: all but reports, research notes and the history.
    pub fn is_current(&self) -> bool {
        let past = ["docs/research/", "docs/evaluation/", "docs/results/", "CHANGELOG.md"];
        !past.iter().any(|p| self.name.starts_with(p))
    }

    /// Its lines outside of fenced blocks, with their numbers from 1.
    pub fn lines(&self) -> Vec<(usize, &str)> {
        let mut fenced = false;
        let mut found = Vec::new();
        for (i, line) in self.text.lines().enumerate() {
            let fence = line.trim_start().starts_with("```");
            fenced ^= fence;
            if !fenced && !fence {
                found.push((i + 1, line));
            }
        }
        found
    }

    /// Its fenced blocks.
    pub fn blocks(&self) -> Vec<Block> {
        let mut found: Vec<Block> = Vec::new();
        let mut fenced = false;
        for (i, line) in self.text.lines().enumerate() {
            match line.trim_start().strip_prefix("```") {
                Some(info) if !fenced => {
                    found.push(Block { info: info.trim().into(), line: i + 2, text: String::new() })
                }
                Some(_) => {}
                None if fenced => found.last_mut().unwrap().text += &format!("{line}\n"),
                None => {}
            }
            fenced ^= line.trim_start().starts_with("```");
        }
        assert!(!fenced, "{}: expected a fence at the end of the last block, found none", self.name);
        found
    }

    /// Paragraphs and items of lists: number of the first line, and text in one line. Neither headings nor tables nor HTML.
    pub fn paragraphs(&self) -> Vec<(usize, String)> {
        let mut found: Vec<(usize, String)> = Vec::new();
        let mut last = None;
        for (number, line) in self.lines() {
            let text = line.trim();
            if text.is_empty() || ["#", "|", "<", "!["].iter().any(|p| text.starts_with(p)) {
                last = None;
                continue;
            }
            let item = item_text(text);
            match found.last_mut() {
                Some((_, paragraph)) if item.is_none() && last == Some(number - 1) => {
                    paragraph.push(' ');
                    paragraph.push_str(text);
                }
                _ => found.push((number, item.unwrap_or(text).into())),
            }
            last = Some(number);
        }
        found
    }
}

/// The text of an item of a list.
fn item_text(line: &str) -> Option<&str> {
    let digits = line.trim_start_matches(|c: char| c.is_ascii_digit());
    let numbered = digits.strip_prefix(". ").filter(|_| digits.len() < line.len());
    [Some("- "), Some("* "), Some("> ")].into_iter().flatten().find_map(|mark| line.strip_prefix(mark)).or(numbered)
}

/// The text of links instead of their Markdown, and of code spans nothing but a word.
pub fn plain(text: &str) -> String {
    let mut out = String::new();
    for (i, part) in text.split('`').enumerate() {
        out += if i % 2 == 0 { part } else { "code" };
    }
    without_targets(&out)
}

/// `[text](target)` becomes `text`.
fn without_targets(text: &str) -> String {
    let mut out = String::new();
    let mut rest = text;
    while let Some(at) = rest.find("](") {
        out += &rest[..at];
        let Some(end) = rest[at..].find(')') else { break };
        rest = &rest[at + end + 1..];
    }
    out += rest;
    out.replace(['[', ']'], "")
}

/// Sentences of a paragraph.
pub fn sentences(paragraph: &str) -> Vec<String> {
    let text = plain(paragraph);
    let words: Vec<&str> = text.split_whitespace().collect();
    let mut found = Vec::new();
    let mut sentence: Vec<&str> = Vec::new();
    for (i, word) in words.iter().enumerate() {
        sentence.push(word);
        let bare = word.trim_end_matches(['*', '"', ')', '_']);
        let end = bare.ends_with(['.', '!', '?']) && !["e.g.", "i.e.", "vs.", "al.", "No."].contains(&bare);
        let next = words.get(i + 1).and_then(|w| w.trim_start_matches(['*', '"', '(', '_']).chars().next());
        if end && next.is_none_or(|c| !c.is_lowercase() || word.ends_with("**")) {
            found.push(std::mem::take(&mut sentence).join(" "));
        }
    }
    if !sentence.is_empty() {
        found.push(sentence.join(" "));
    }
    found
}

/// Words of a text: whatever has a letter or a digit.
pub fn words(text: &str) -> usize {
    text.split_whitespace().filter(|w| w.chars().any(char::is_alphanumeric)).count()
}

/// Words that this project no longer uses, and the field's word. Each stands for itself and what begins with it, if it
/// ends in `*`.
pub const RETIRED: &[(&str, &str)] = &[
    ("quick fit*", "initial fit"),
    ("own fit*", "initial fit"),
    ("plain fit*", "baseline fit"),
    ("mend*", "refine, correct"),
    ("polish*", "optimize"),
    ("held at", "anchored to"),
    ("regroup*", "rebuild the tree"),
    ("anew", "again"),
    ("in order anew", "rebuild the tree"),
    ("aimed at", "target"),
    ("by arithmetic", "estimated"),
    ("not looked into", "not measured"),
    ("turned outlines", "rotated silhouettes"),
    ("contradiction*", "symmetry residual"),
    ("ensemble*", "proposals"),
    ("told", "reported, given"),
    ("tells", "reports"),
    ("lanes", "virtual ranks"),
    ("on the wire", "all-reduce dtype"),
    ("so many", "N"),
    ("pictures", "images, renders"),
    ("licence*", "license"),
    ("colour*", "color"),
    ("centre*", "center"),
    ("grey*", "gray"),
    ("optimis*", "optimiz-"),
    ("normalis*", "normaliz-"),
    ("rasteris*", "rasteriz-"),
    ("regularis*", "regulariz-"),
    ("quantis*", "quantiz-"),
    ("neighbour*", "neighbor"),
    ("favour*", "favor"),
    ("behaviour*", "behavior"),
    ("modelled", "modeled"),
    ("labelled", "labeled"),
];

/// Where a retired word is right: what the text has to contain, the word, and why.
pub const ALLOWED: &[(&str, &str, &str)] = &[
    ("DreamSim", "ensemble*", "DreamSim's own word for its three networks"),
    ("\"licence\"", "licence*", "a key of files that exist"),
];

/// The retired words of a text, with the field's.
pub fn retired(text: &str) -> Vec<String> {
    let lower = text.to_lowercase();
    let letter = |c: Option<char>| c.is_some_and(char::is_alphanumeric);
    let stands = |word: &str| {
        let (stem, open) = (word.trim_end_matches('*'), word.ends_with('*'));
        lower.match_indices(stem).any(|(at, _)| {
            let (before, after) = (lower[..at].chars().next_back(), lower[at + stem.len()..].chars().next());
            !letter(before) && before != Some('-') && (open || !letter(after))
        })
    };
    let allowed = |word: &str| ALLOWED.iter().any(|(near, w, _)| *w == word && text.contains(near));
    let found = RETIRED.iter().filter(|(word, _)| stands(word) && !allowed(word));
    found.map(|(word, instead)| format!("{word:?} (instead: {instead})")).collect()
}

/// Compares a generated page with its file; writes it where UPDATE=1 is set.
pub fn check_generated(name: &str, expected: &str) {
    let path = root().join(name);
    if std::env::var_os("UPDATE").is_some_and(|v| v == "1") {
        return fs::write(path, expected).unwrap();
    }
    let found = fs::read_to_string(&path).unwrap_or_default();
    if found == expected {
        return;
    }
    let (old, new): (Vec<&str>, Vec<&str>) = (found.lines().collect(), expected.lines().collect());
    let same = old.iter().zip(&new).take_while(|(a, b)| a == b).count();
    let part = |sign: char, lines: &[&str]| -> String {
        lines.iter().skip(same).take(8).map(|line| format!("{sign} {line}\n")).collect()
    };
    panic!(
        "{name} is not what the program says, from line {} on:\n{}{}\nTo write it: UPDATE=1 cargo test --release -p freerange-cli reference",
        same + 1,
        part('-', &old),
        part('+', &new)
    );
}

/// Cells of tables hold one line, and no bare `|`.
pub fn cell(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ").replace('|', "\\|")
}

/// Wraps at 100 columns.
pub fn wrap(text: &str) -> String {
    let mut lines = vec![String::new()];
    for word in text.split_whitespace() {
        let line = lines.last_mut().unwrap();
        if !line.is_empty() && line.chars().count() + 1 + word.chars().count() > 100 {
            lines.push(word.into());
        } else {
            if !line.is_empty() {
                line.push(' ');
            }
            line.push_str(word);
        }
    }
    lines.join("\n")
}
