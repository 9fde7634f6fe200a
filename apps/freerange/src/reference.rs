//! The command line's reference, written from its definition, and the commands in documents, parsed by it.

#[path = "../tests/documents/pages.rs"]
#[expect(dead_code, reason = "tests/documents.rs uses the rest")]
mod pages;

use std::collections::{BTreeMap, BTreeSet};

use clap::{Arg, Command, CommandFactory, Parser, error::ErrorKind};

use crate::Cli;
use pages::{cell, check_generated, retired, sentences, words, wrap};

/// Every command with its full name, depth first.
fn commands(command: &Command, name: &str, found: &mut Vec<(String, Command)>) {
    found.push((name.into(), command.clone()));
    for sub in command.get_subcommands().filter(|s| !s.is_hide_set() && s.get_name() != "help") {
        commands(sub, &format!("{name} {}", sub.get_name()), found);
    }
}

fn all() -> Vec<(String, Command)> {
    let mut root = Cli::command();
    root.build();
    let mut found = Vec::new();
    commands(&root, "freerange", &mut found);
    found
}

/// The arguments of a command, without those that all have.
fn arguments(command: &Command) -> impl Iterator<Item = &Arg> {
    command.get_arguments().filter(|a| !matches!(a.get_id().as_str(), "help" | "version" | "verbose"))
}

/// The whole help of an argument, and what it says of the default.
fn help(arg: &Arg) -> (String, Option<String>) {
    let text = arg.get_long_help().or(arg.get_help()).map(ToString::to_string).unwrap_or_default();
    // One paragraph loses its last point to clap.
    let points = |paragraph: &str| match paragraph.trim_end() {
        done if done.is_empty() || done.ends_with(['.', ')', ']', ':', '!']) => done.to_owned(),
        open => format!("{open}."),
    };
    let text = text.split("\n\n").map(points).collect::<Vec<_>>().join(" ");
    let text = text.split_whitespace().collect::<Vec<_>>().join(" ");
    match text.split_once("[default: ").and_then(|(before, rest)| Some((before, rest.split_once(']')?))) {
        Some((before, (default, after))) => (format!("{}{after}", before.trim_end()), Some(default.into())),
        None => (text, None),
    }
}

/// `-o, --output <OUTPUT>`
fn spelled(arg: &Arg) -> String {
    let values =
        arg.get_value_names().unwrap_or_default().iter().map(|v| format!("<{v}>")).collect::<Vec<_>>().join(" ");
    let takes = arg.get_action().takes_values();
    match (arg.get_short(), arg.get_long()) {
        (_, None) => values,
        (short, Some(long)) => {
            let short = short.map_or(String::new(), |s| format!("-{s}, "));
            format!("{short}--{long}{}", if takes { format!(" {values}") } else { String::new() })
        }
    }
}

fn row(arg: &Arg) -> String {
    let (mut text, told) = help(arg);
    let takes = arg.get_action().takes_values();
    let values = arg.get_possible_values();
    let values: Vec<String> = values
        .iter()
        .filter(|v| takes && !v.is_hide_set())
        .map(|v| match v.get_help() {
            Some(help) => format!("`{}`: {help}", v.get_name()),
            None => format!("`{}`", v.get_name()),
        })
        .collect();
    if !values.is_empty() {
        text += &format!(" Values: {}.", values.iter().map(|v| v.trim_end_matches('.')).collect::<Vec<_>>().join("; "));
    }
    if arg.is_hide_short_help_set() {
        text += " *In `--help` only.*";
    }
    let shown = takes && !arg.is_hide_default_value_set();
    let given: Vec<String> =
        arg.get_default_values().iter().filter(|_| shown).map(|v| v.to_string_lossy().into_owned()).collect();
    let default = match (told, given.is_empty()) {
        (Some(told), _) => told,
        (None, false) => format!("`{}`", given.join(",")),
        (None, true) if arg.is_required_set() => "required".into(),
        (None, true) => String::new(),
    };
    format!("| `{}` | {} | {} |\n", cell(&spelled(arg)), cell(&text), cell(&default))
}

fn section(name: &str, command: &Command) -> String {
    let mut out = format!("\n## {name}\n\n");
    let about = command.get_long_about().or(command.get_about()).map(ToString::to_string).unwrap_or_default();
    for paragraph in about.split("\n\n") {
        out += &format!("{}\n\n", wrap(paragraph));
    }
    let usage = command.clone().render_usage().to_string();
    out += &format!(
        "```text\n{}\n```\n",
        usage.trim_start_matches("Usage: ").lines().map(str::trim).collect::<Vec<_>>().join("\n")
    );
    let mut groups: Vec<(String, String)> = Vec::new();
    for arg in arguments(command) {
        let plain = if arg.is_positional() { "Arguments" } else { "Options" };
        let heading = arg.get_help_heading().unwrap_or(plain).to_owned();
        match groups.iter_mut().find(|(name, _)| *name == heading) {
            Some((_, rows)) => rows.push_str(&row(arg)),
            None => groups.push((heading, row(arg))),
        }
    }
    for (heading, rows) in groups {
        out += &format!("\n**{heading}**\n\n| option | | default |\n|---|---|---|\n{rows}");
    }
    let subs: Vec<&Command> =
        command.get_subcommands().filter(|s| !s.is_hide_set() && s.get_name() != "help").collect();
    if !subs.is_empty() {
        out += "\n**Commands**\n\n| command | |\n|---|---|\n";
        for sub in subs {
            let full = format!("{name} {}", sub.get_name());
            let about = sub.get_about().map(ToString::to_string).unwrap_or_default();
            out += &format!("| [`{full}`](#{}) | {} |\n", full.replace(' ', "-"), cell(&about));
        }
    }
    if let Some(examples) = command.get_after_help() {
        out += &format!("\n```text\n{}\n```\n", examples.to_string().trim_end());
    }
    out
}

#[test]
fn the_reference_of_the_command_line_is_current() {
    let mut page = String::from(
        "<!-- Generated from the program: UPDATE=1 cargo test --release -p freerange-cli reference -->\n\n# Command line\n\n\
         Every command and option. `freerange COMMAND -h` shows the usual options, `--help` all of them.\n\
         `-v, --verbose` prints more messages on standard error. Exit codes: 0 done, 1 failed, 2 bad input.\n",
    );
    for (name, command) in all() {
        page += &section(&name, &command);
    }
    check_generated("docs/reference/cli.md", &page);
}

/// Option help: short sentences in the field's words.
#[test]
fn help_is_short_and_in_the_words_of_the_field() {
    let mut wrong = Vec::new();
    for (name, command) in all() {
        let mut texts: Vec<(String, String)> = [command.get_about(), command.get_long_about()]
            .into_iter()
            .flatten()
            .map(|t| (name.clone(), t.to_string()))
            .collect();
        for arg in arguments(&command) {
            let place = format!("{name} {}", spelled(arg));
            texts.push((place.clone(), help(arg).0));
            let values = arg.get_possible_values();
            texts.extend(values.iter().filter_map(|v| Some((place.clone(), v.get_help()?.to_string()))));
        }
        for (place, text) in texts {
            let long = text.split("\n\n").flat_map(sentences).filter(|s| words(s) > 20);
            wrong.extend(long.map(|s| format!("{place}: {} words: {s}", words(&s))));
            wrong.extend(retired(&text).into_iter().map(|w| format!("{place}: {w}")));
        }
    }
    wrong.sort();
    wrong.dedup();
    assert!(wrong.is_empty(), "help of at most 20 words per sentence, in the field's words:\n{}", wrong.join("\n"));
}

/// Words of a line of a shell, quotes taken off. Comments and redirections end it.
fn shell_words(line: &str) -> Vec<String> {
    let mut found: Vec<String> = Vec::new();
    let (mut quote, mut begun) = (None, false);
    for c in line.chars() {
        match (quote, c) {
            (Some(q), c) if c == q => quote = None,
            (None, '\'' | '"') => {
                quote = Some(c);
                if !begun {
                    found.push(String::new());
                    begun = true;
                }
            }
            (None, '#') if !begun => break,
            (None, '>' | '<') => break,
            (None, c) if c.is_whitespace() => begun = false,
            (_, c) => {
                if !begun {
                    found.push(String::new());
                    begun = true;
                }
                found.last_mut().unwrap().push(c);
            }
        }
    }
    found
}

/// What `freerange` is given in a line of a shell, for each time that it is called.
fn calls(line: &str) -> Vec<Vec<String>> {
    let mut found = Vec::new();
    for command in line.split(&[';', '|', '&'][..]).flat_map(|part| part.split("$(")) {
        let words = shell_words(command.trim().trim_start_matches("$ "));
        // A program that is called, not a package, an image or a folder of that name: what stands before starts it.
        let starters = ["mpirun", "srun", "time", "env", "nice"];
        let first = words.iter().position(|w| !w.contains('=')).unwrap_or(words.len());
        let ours = |w: &String| w == "freerange" || w.ends_with("/freerange");
        let program = match words.get(first) {
            Some(w) if ours(w) => Some(first),
            Some(w) if starters.contains(&w.as_str()) => words.iter().position(ours),
            _ => None,
        };
        // What a shell puts in place of variables is not known here.
        if let Some(at) = program.filter(|at| !words[*at..].iter().any(|w| w.contains('$'))) {
            found.push(words[at + 1..].iter().map(|w| w.trim_end_matches(')').to_owned()).collect());
        }
    }
    found
}

#[test]
fn every_command_in_the_documents_parses() {
    let mut wrong = Vec::new();
    let mut count = 0;
    for page in pages::pages().into_iter().filter(|p| p.is_current()) {
        for block in page.blocks() {
            let language = block.info.split_whitespace().next().unwrap_or_default();
            if !["sh", "bash", "console", "shell"].contains(&language) {
                continue;
            }
            let text = block.text.replace("\\\n", " ");
            for call in text.lines().flat_map(calls) {
                count += 1;
                let parsed = Cli::try_parse_from(std::iter::once("freerange".to_owned()).chain(call.clone()));
                if let Err(e) = parsed.map(|_| ()).filter_help() {
                    let reason = e.to_string();
                    let reason = reason.lines().next().unwrap_or_default();
                    wrong.push(format!("{}:{}: freerange {}\n    {reason}", page.name, block.line, call.join(" ")));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "commands that the program refuses:\n{}", wrong.join("\n"));
    assert!(count > 40, "commands were found in the documents: {count}");
}

trait FilterHelp {
    fn filter_help(self) -> Result<(), clap::Error>;
}

impl FilterHelp for Result<(), clap::Error> {
    /// Help and version are no mistakes.
    fn filter_help(self) -> Self {
        self.or_else(|e| {
            if matches!(e.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayVersion) { Ok(()) } else { Err(e) }
        })
    }
}

/// Options of other programs that the documents name.
const OTHERS: &[&str] = &[
    // cargo
    "--release",
    "--features",
    "--no-default-features",
    "--config",
    "--workspace",
    "--locked",
    "--path",
    "--git",
    "--ignored",
    // git, docker, MPI, COLMAP, pip
    "--build-arg",
    "--depth",
    "--rm",
    "--gpus",
    "--bind-to",
    "--mpi",
    "--ntasks-per-node",
    "--array",
    "--upgrade",
];

#[test]
fn every_option_that_the_documents_name_exists() {
    let mut options: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for (name, command) in all() {
        for arg in command.get_arguments() {
            options.entry(format!("--{}", arg.get_long().unwrap_or_default())).or_default().insert(name.clone());
        }
    }
    let mut wrong = Vec::new();
    for page in pages::pages().into_iter().filter(pages::Page::is_current) {
        for (number, line) in page.lines() {
            for span in line.split('`').skip(1).step_by(2) {
                let ours = span.starts_with("--") || span.starts_with("freerange ");
                for word in span
                    .split(|c: char| c.is_whitespace() || "=,/[]".contains(c))
                    .filter(|w| ours && w.starts_with("--") && w.len() > 2)
                {
                    if !options.contains_key(word) && !OTHERS.contains(&word) {
                        wrong.push(format!("{}:{number}: {word}", page.name));
                    }
                }
            }
        }
    }
    assert!(wrong.is_empty(), "options that no command has:\n{}", wrong.join("\n"));
}

/// Options of the scripts that launch jobs: values come from variables, so that only names can be looked at.
#[test]
fn every_option_of_the_launch_scripts_exists() {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/launch");
    let (mut wrong, mut count) = (Vec::new(), 0);
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let text = std::fs::read_to_string(&path).unwrap().replace("\\\n", " ");
        for line in text.lines().filter(|line| !line.starts_with('#')) {
            let mut words = line.split_whitespace().skip_while(|word| *word != "freerange").skip(1);
            let Some(name) = words.next() else { continue };
            let name = format!("freerange {name}");
            let Some((_, command)) = all().into_iter().find(|(known, _)| *known == name) else { continue };
            for option in words.filter_map(|word| word.strip_prefix("--")) {
                count += 1;
                if !command.get_arguments().any(|arg| arg.get_long() == Some(option)) {
                    wrong.push(format!("{}: {name} --{option}", path.display()));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "options that no command has:\n{}", wrong.join("\n"));
    assert!(count > 1, "options were found in the scripts: {count}");
}

#[test]
fn lines_of_a_shell_are_understood() {
    assert_eq!(shell_words("a 'b c' \"d\" # e"), ["a", "b c", "d"]);
    assert_eq!(
        calls("mpirun -n 2 freerange train a.toml && freerange eval | head"),
        [vec!["train", "a.toml"], vec!["eval"]]
    );
    assert_eq!(calls("X=1 target/release/freerange devices > file"), [vec!["devices"]]);
    assert!(calls("docker run freerange reconstruct").is_empty() && calls("X=1 a.sh b/freerange c").is_empty());
    assert!(calls("freerange eval --shard $I/4").is_empty());
}
