//! What holds the documents: links lead somewhere, commands run, the language is plain, references are those of the code.

#[path = "documents/config.rs"]
mod config;
#[path = "documents/pages.rs"]
mod pages;

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use proc_macro2::{TokenStream, TokenTree};

use pages::{Page, files, pages, retired, root, sentences, words};

/// The anchors of a page, as GitHub makes them of headings.
fn anchors(page: &Page) -> BTreeSet<String> {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    let mut found = BTreeSet::new();
    for (_, line) in page.lines() {
        if let Some(heading) = line.strip_prefix('#') {
            let text = heading.trim_start_matches('#').trim().replace('`', "");
            let text = pages::plain(&text).to_lowercase();
            let kept = text.chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c));
            let slug: String = kept.map(|c| if c == ' ' { '-' } else { c }).collect();
            let count = counts.entry(slug.clone()).or_default();
            found.insert(if *count == 0 { slug } else { format!("{slug}-{count}") });
            *count += 1;
        }
        for mark in ["id=\"", "name=\""] {
            found.extend(line.split(mark).skip(1).filter_map(|rest| Some(rest.split_once('"')?.0.to_owned())));
        }
    }
    found
}

/// Targets of links and images in a line, code spans left out.
fn targets(line: &str) -> Vec<String> {
    let text: String = line.split('`').step_by(2).collect::<Vec<_>>().join("code");
    let within = |mark: &str, end: char| -> Vec<String> {
        text.split(mark).skip(1).filter_map(|rest| Some(rest.split_once(end)?.0.trim().to_owned())).collect()
    };
    let mut found = within("](", ')');
    found.extend(within("href=\"", '"').into_iter().chain(within("src=\"", '"')));
    let definition = text.trim_start().strip_prefix('[').and_then(|rest| Some(rest.split_once("]: ")?.1.to_owned()));
    found.extend(definition);
    found
}

#[test]
fn every_link_leads_somewhere() {
    let all = pages();
    let known: BTreeMap<PathBuf, BTreeSet<String>> =
        all.iter().map(|page| (root().join(&page.name), anchors(page))).collect();
    let mut wrong = Vec::new();
    for page in &all {
        for (number, line) in page.lines() {
            for target in targets(line) {
                if target.contains("://") || target.starts_with("mailto:") {
                    continue;
                }
                let (path, anchor) = target.split_once('#').map_or((target.as_str(), None), |(p, a)| (p, Some(a)));
                let here = root().join(&page.name);
                let full = if path.is_empty() { here } else { here.parent().unwrap().join(path) };
                let Ok(full) = full.canonicalize() else {
                    wrong.push(format!("{}:{number}: {target}: nothing is there", page.name));
                    continue;
                };
                let has = |anchor: &str| known.get(&full).is_none_or(|anchors| anchors.contains(anchor));
                if anchor.is_some_and(|anchor| !has(anchor)) {
                    wrong.push(format!("{}:{number}: {target}: no such heading", page.name));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "links that lead nowhere:\n{}", wrong.join("\n"));
}

/// Paths like `docs/limits.md` that the text has.
fn mentioned_pages(text: &str) -> BTreeSet<String> {
    let part = |c: char| c.is_alphanumeric() || "-_./".contains(c);
    let words = text.split(|c| !part(c)).map(|w| w.trim_end_matches('.'));
    words.filter(|w| w.starts_with("docs/") && w.ends_with(".md")).map(str::to_owned).collect()
}

/// Pages that a script writes in the course of time.
const LATER: [&str; 1] = ["docs/results/paper-tables/tables.md"];

#[test]
fn sources_name_pages_that_exist() {
    let sources = files(&["rs", "toml", "py", "sh", "mjs", "js", "yaml", "yml", "ipynb"]);
    let mut wrong = Vec::new();
    for source in sources.iter().filter(|s| s.name != "apps/freerange/tests/documents.rs") {
        let missing = mentioned_pages(&source.text)
            .into_iter()
            .filter(|page| !LATER.contains(&page.as_str()) && !root().join(page).exists());
        wrong.extend(missing.map(|page| format!("{}: {page}", source.name)));
    }
    assert!(wrong.is_empty(), "pages that sources name and that are not there:\n{}", wrong.join("\n"));
    let there = mentioned_pages("see docs/a/b.md, (docs/c.md). Not xdocs/d.md or docs/e.txt");
    assert_eq!(there.into_iter().collect::<Vec<_>>(), ["docs/a/b.md", "docs/c.md"]);
}

#[test]
fn paths_in_blocks_exist() {
    let folders = ["apps/", "checkpoints/", "configs/", "crates/", "docs/", "examples/", "python/", "tests/", "tools/"];
    let mut wrong = Vec::new();
    for page in pages().into_iter().filter(Page::is_current) {
        for block in page.blocks() {
            for word in block.text.split(|c: char| c.is_whitespace() || "\"'`(),;=".contains(c)) {
                let word = word.trim_start_matches("./");
                // Not those with variables, wildcards or names to be replaced.
                let plain = word.chars().all(|c| c.is_alphanumeric() || "-_./".contains(c));
                let ours = plain && folders.iter().any(|f| word.starts_with(f));
                let name = word.trim_end_matches(['.', '/']);
                if ours && !root().join(name).exists() && !name.contains("target/") {
                    wrong.push(format!("{}:{}: {word}", page.name, block.line));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "paths in blocks that are not there:\n{}", wrong.join("\n"));
}

/// Blocks that begin with ```sh run are run, in the order of their page and in one folder, which has `examples` and `configs`.
#[cfg(unix)]
#[test]
fn blocks_that_are_marked_run() {
    let program = Path::new(env!("CARGO_BIN_EXE_freerange")).parent().unwrap().to_owned();
    let path = std::env::var("PATH").unwrap_or_default();
    for page in pages().into_iter().filter(Page::is_current) {
        let run = |info: &str| info.split_whitespace().any(|word| word == "run");
        let script: String = page.blocks().into_iter().filter(|b| run(&b.info)).map(|b| b.text).collect();
        if script.is_empty() {
            continue;
        }
        let folder = tempfile::tempdir().unwrap();
        for name in ["examples", "configs"] {
            std::os::unix::fs::symlink(root().join(name), folder.path().join(name)).unwrap();
        }
        let result = Command::new("bash")
            .args(["-euo", "pipefail", "-c", &script])
            .current_dir(folder.path())
            .env("PATH", format!("{}:{path}", program.display()))
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&result.stderr);
        assert!(result.status.success(), "{}: its blocks failed:\n{script}\n{text}", page.name);
    }
}

/// What people see of a page without its code and its links' targets.
fn prose_words(page: &Page) -> usize {
    let visible = page.lines().into_iter().filter(|(_, line)| !line.trim_start().starts_with(['<', '!']));
    visible.map(|(_, line)| words(&pages::plain(line))).sum()
}

#[test]
fn the_readme_is_short() {
    let page = pages().into_iter().find(|p| p.name == "README.md").unwrap();
    let found = prose_words(&page);
    assert!(found <= 900, "README.md: expected at most 900 words without code, found {found}");
}

/// Shows the lengths with `cargo test -p freerange-cli --test documents sentences -- --nocapture`.
#[test]
fn sentences_are_short() {
    let mut wrong = Vec::new();
    println!("{:5} {:4} {:4}  page", "words", "mean", "max");
    for page in pages().into_iter().filter(|p| !pages::GENERATED.contains(&p.name.as_str())) {
        let all: Vec<(usize, String)> =
            page.paragraphs().iter().flat_map(|(n, p)| sentences(p).into_iter().map(|s| (*n, s))).collect();
        let lengths: Vec<usize> = all.iter().map(|(_, s)| words(s)).filter(|n| *n > 0).collect();
        let total: usize = lengths.iter().sum();
        let mean = total as f64 / lengths.len().max(1) as f64;
        let held = page.is_plain();
        let mark = if held { "" } else { " (not held)" };
        println!("{total:5} {mean:4.1} {:4}  {}{mark}", lengths.iter().max().unwrap_or(&0), page.name);
        if held && mean > 20.0 {
            let mut longest: Vec<_> = all.iter().map(|(n, s)| (words(s), n, s)).collect();
            longest.sort_by(|a, b| b.cmp(a));
            let shown = longest.iter().take(3).map(|(w, n, s)| format!("    line {n}, {w} words: {s}"));
            wrong.push(format!("{}: {mean:.1} words\n{}", page.name, shown.collect::<Vec<_>>().join("\n")));
        }
    }
    assert!(wrong.is_empty(), "expected sentences of at most 20 words in the mean:\n{}", wrong.join("\n"));
}

#[test]
fn lines_of_prose_are_at_most_100_columns() {
    let mut wrong = Vec::new();
    for page in pages().into_iter().filter(Page::is_plain) {
        for (number, line) in page.lines() {
            let text = line.trim();
            // Tables cannot be wrapped; neither can a single long link.
            let whole = ["|", "<", "![", "#"].iter().any(|p| text.starts_with(p)) || !text.contains(' ');
            let columns = line.chars().count();
            if columns > 100 && !whole {
                wrong.push(format!("{}:{number}: {columns} columns", page.name));
            }
        }
    }
    assert!(wrong.is_empty(), "lines of more than 100 columns:\n{}", wrong.join("\n"));
}

#[test]
fn pages_use_the_words_of_the_field() {
    let mut wrong = Vec::new();
    for page in pages().into_iter().filter(|p| p.is_plain() || pages::GENERATED.contains(&p.name.as_str())) {
        for (number, line) in page.lines() {
            wrong.extend(retired(&pages::plain(line)).into_iter().map(|w| format!("{}:{number}: {w}", page.name)));
        }
    }
    assert!(wrong.is_empty(), "words that this project no longer uses:\n{}", wrong.join("\n"));
}

/// String literals of a source, but for those of documentation.
fn literals(tokens: TokenStream, found: &mut Vec<String>) {
    for token in tokens {
        match token {
            TokenTree::Group(group) => {
                let doc = |t: &TokenTree| matches!(t, TokenTree::Ident(ident) if ident == "doc");
                if !group.stream().into_iter().next().is_some_and(|first| doc(&first)) {
                    literals(group.stream(), found);
                }
            }
            TokenTree::Literal(literal) if literal.to_string().starts_with('"') => found.push(literal.to_string()),
            _ => {}
        }
    }
}

/// Errors, notes and labels: texts of three words or more in the sources of program and crates.
#[test]
fn messages_use_the_words_of_the_field() {
    let mut wrong = Vec::new();
    let of_tests = |name: &str| name.ends_with("tests.rs") || name.contains("/tests/");
    let of_program = |name: &str| name.starts_with("crates/") && name.contains("/src/") && !of_tests(name);
    let sources =
        files(&["rs"]).into_iter().filter(|s| s.name.starts_with("apps/freerange/src/") || of_program(&s.name));
    for source in sources {
        let code = source.text.split("#[cfg(test)]\nmod tests").next().unwrap_or_default();
        let mut texts = Vec::new();
        literals(code.parse().unwrap(), &mut texts);
        for text in texts.iter().filter(|t| t.split_whitespace().count() >= 3) {
            // Names of variables are no words.
            let parts = text.split('{').map(|part| part.split_once('}').map_or(part, |(_, after)| after));
            let words = parts.collect::<Vec<_>>().join(" ");
            wrong.extend(retired(&words).into_iter().map(|w| format!("{}: {w} in {text}", source.name)));
        }
    }
    // The test's own list is no message.
    wrong.retain(|w| !w.starts_with("apps/freerange/src/reference.rs"));
    assert!(wrong.is_empty(), "words that this project no longer uses:\n{}", wrong.join("\n"));
}

/// Tables of inputs name the test of each row in their last column.
#[test]
fn tests_that_the_inputs_page_names_exist() {
    let text = fs::read_to_string(root().join("docs/reference/inputs.md")).unwrap();
    let mut tests = BTreeSet::new();
    for source in files(&["rs"]) {
        let mut lines = source.text.lines().peekable();
        while let Some(line) = lines.next() {
            let name = lines.peek().and_then(|l| l.trim().strip_prefix("fn ")?.split('(').next());
            tests.extend(name.filter(|_| line.trim() == "#[test]").map(str::to_owned));
        }
    }
    let (mut in_table, mut found) = (false, 0);
    for line in text.lines() {
        let cells: Vec<&str> = line.split('|').map(str::trim).collect();
        if !line.starts_with('|') {
            in_table = false;
        } else if cells[cells.len() - 2] == "test" {
            in_table = true;
        } else if in_table && !line.starts_with("|-") {
            let name = cells[cells.len() - 2];
            let known = name == "the same" || tests.contains(name.trim_matches('`'));
            assert!(known, "inputs.md: a test that does not exist in {line}");
            found += 1;
        }
    }
    assert!(found >= 30, "{found}");
}

#[test]
fn the_reference_of_the_configuration_is_current() {
    pages::check_generated("docs/reference/config.md", &config::page());
}

#[test]
fn what_the_checks_find() {
    let page = |text: &str| Page { name: "docs/x.md".into(), text: text.into() };
    let text = "# A `b` c\n## A b c\n\nOne two. Three\nfour, e.g. five!\n- six\n  seven\n\n```sh run\n# no heading\n```\n| not prose |\n";
    let p = page(text);
    assert_eq!(anchors(&p).into_iter().collect::<Vec<_>>(), ["a-b-c", "a-b-c-1"]);
    let paragraphs = p.paragraphs();
    assert_eq!(paragraphs, [(4, "One two. Three four, e.g. five!".to_owned()), (6, "six seven".to_owned())]);
    assert_eq!(sentences(&paragraphs[0].1), ["One two.", "Three four, e.g. five!"]);
    assert_eq!((p.blocks()[0].info.as_str(), p.blocks()[0].text.as_str()), ("sh run", "# no heading\n"));
    assert_eq!(targets("see [a](b.md#c), `[x](y)` and ![z](d.png)"), ["b.md#c", "d.png"]);
    assert_eq!(retired("It was Mended in the centre.").len(), 2);
    assert!(retired("recommend a center, `--polish`".replace("`--polish`", "code").as_str()).is_empty());
    assert!(retired("DreamSim's ensemble").is_empty() && retired("an ensemble").len() == 1);
    assert!(fs::metadata(root().join("README.md")).is_ok());
}
