//! Sentences as clients may read them: without places of ours, and with what the page has instead of the command line's options.

use std::path::Path;

/// What other crates advise, and what the page says instead.
const WORDS: [(&str, &str); 27] = [
    ("; --invert-masks if black is the object", "; tick \u{201c}In mask files black is the object\u{201d} if it is"),
    (" (--masks FOLDER if they do)", ""),
    (" (--masks alpha if it is)", " (choose \u{201c}alpha\u{201d} under Masks if it is)"),
    (" (--masks plain if it is)", " (choose \u{201c}plain\u{201d} under Masks if it is)"),
    ("(--masks estimate if the ", "(choose \u{201c}from cameras and colors\u{201d} under Masks if the "),
    (" (masks or --center X,Y,Z do)", " (masks do)"),
    ("give them with --masks", "correct them with the brush"),
    (
        "; give masks (--masks FOLDER, white is the object)",
        "; add masks (`masks/NAME.png` for each photo, white is the object)",
    ),
    ("; --up says otherwise", "; choose another under Up if it is wrong"),
    (", or --center X,Y,Z, as", ", as"),
    (
        "(--uneven if photos are missing there, or not in order)",
        "(tick \u{201c}not at even steps\u{201d} if photos are missing there, or not in order)",
    ),
    ("(--uneven if they did)", "(tick \u{201c}not at even steps\u{201d} if they did)"),
    ("; if the poses are right, say where the object is (--center X,Y,Z)", ""),
    ("; say where the object is (--center X,Y,Z)", ""),
    (
        "; photos without cameras: `freerange poses PHOTOS -o SCENE` finds them with COLMAP",
        "; for photos without cameras send the photos alone",
    ),
    ("; on a turntable in even steps: --turntable ELEVATION,FOV", "; on a turntable in even steps: fill in Turntable"),
    ("turntables have --turntable ELEVATION,FOV", "turntables have the field Turntable"),
    ("; --images FOLDER says where else)", ")"),
    ("say which with --cameras ", "choose under Cameras "),
    (" or --cameras ", " or "),
    ("`--cameras`", "cameras"),
    ("`--images`", "images"),
    ("--cameras", "cameras"),
    ("--images", "images"),
    ("a smaller --max-resolution, or masks with them", "smaller ones, or masks with them"),
    ("a program built with --features mask-model, to run", "a program that can run"),
    ("--mask-model", "masks"),
];

/// `text`, about the files in `folder`, for clients.
pub fn sentence(text: &str, folder: &Path) -> String {
    let text = without_places(text, folder);
    WORDS.iter().fold(text, |text, (options, page)| text.replace(options, page))
}

/// `text` without `folder` and the folders that it lies in, however they are written: where we put files is nobody's business.
fn without_places(text: &str, folder: &Path) -> String {
    let written = [Some(folder.to_path_buf()), folder.canonicalize().ok(), std::path::absolute(folder).ok()];
    let mut places: Vec<String> =
        written.iter().flatten().flat_map(|f| f.ancestors().map(|a| a.display().to_string())).collect();
    places.retain(|p| p.len() > 1 && p.contains(['/', '\\']));
    places.sort_by_key(|p| (std::cmp::Reverse(p.len()), p.clone()));
    places.dedup();
    places.iter().fold(text.to_owned(), |text, place| without(&text, place))
}

/// `text` without `place`, where it is not a part of a longer name.
fn without(text: &str, place: &str) -> String {
    let of_name = |c: char| c.is_alphanumeric() || "._-/\\".contains(c);
    let (mut rest, mut out) = (text, String::new());
    while let Some(at) = rest.find(place) {
        let (before, after) = (&rest[..at], &rest[at + place.len()..]);
        out += before;
        let begins = !before.ends_with(of_name);
        let inside = after
            .strip_prefix(['/', '\\'])
            .filter(|name| name.starts_with(|c: char| c.is_alphanumeric() || "._-".contains(c)));
        rest = match inside {
            Some(name) if begins => name,
            _ => {
                let ends = !after.starts_with(|c: char| c.is_alphanumeric() || "_-".contains(c));
                out += if begins && ends { "the folder" } else { place };
                after
            }
        };
    }
    out + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_sentence_names_a_place_of_ours() {
        let at = Path::new("/srv/keep/ID/upload/0/0/0");
        for (from, to) in [
            ("/srv/keep/ID/upload/0/0/0/a/b.png: cannot decode", "a/b.png: cannot decode"),
            ("looked in /srv/keep/ID/upload/0/0/0, /srv/keep/ID/upload/0/0", "looked in the folder, the folder"),
            ("`/srv/keep/x` and /srv/keepsake and /other/srv/keep", "`x` and keepsake and /other/srv/keep"),
            ("nothing of it", "nothing of it"),
        ] {
            assert_eq!(without_places(from, at), to);
        }
    }

    /// The literals of a source file, lines that go on put together.
    fn literals(source: &str) -> Vec<String> {
        let code: Vec<&str> = source.lines().filter(|l| !l.trim_start().starts_with("//")).collect();
        let joined = code.join("\n");
        let mut parts = joined.split("\\\n");
        let first = parts.next().unwrap_or_default().to_owned();
        let text = parts.fold(first, |all, part| all + part.trim_start());
        text.split('"').skip(1).step_by(2).map(str::to_owned).collect()
    }

    #[test]
    fn no_sentence_names_an_option() {
        fn sources(folder: &Path, found: &mut Vec<String>) {
            for entry in std::fs::read_dir(folder).unwrap().map(Result::unwrap) {
                match entry.path().is_dir() {
                    true => sources(&entry.path(), found),
                    false => found.push(std::fs::read_to_string(entry.path()).unwrap()),
                }
            }
        }
        let mut found = Vec::new();
        sources(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../capture/freerange-scene/src")), &mut found);
        // What is said of cameras that were found.
        let judge = "/../../../apps/freerange/src/commands/poses/judge.rs";
        found.push(std::fs::read_to_string([env!("CARGO_MANIFEST_DIR"), judge].concat()).unwrap());
        let of_shells = |text: &str| text.contains("--") || text.contains("`freerange ");
        let with: Vec<String> = found.iter().flat_map(|s| literals(s)).filter(|l| of_shells(l)).collect();
        assert!(with.len() >= 15, "{with:?}");
        for literal in with {
            let shown = sentence(&literal, Path::new("x"));
            assert!(!of_shells(&shown), "{literal:?} is shown as {shown:?}: the page has no options and no commands");
        }
    }
}
