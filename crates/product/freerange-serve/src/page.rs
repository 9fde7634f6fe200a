//! The page, which is part of the program.

use std::sync::LazyLock;

use freerange_gaussians::formats::viewer;

const SCRIPT: &str = "text/javascript; charset=utf-8";
const STYLE: (&str, &str, &str) = ("/style.css", "text/css; charset=utf-8", include_str!("page/style.css"));

/// What draws, without what only the page needs that Gaussians are exported to.
const VIEWER: &str = before(viewer::SCRIPT, "\n// The page:");

/// `text` before `mark`.
const fn before(text: &'static str, mark: &str) -> &'static str {
    let (all, mark) = (text.as_bytes(), mark.as_bytes());
    let mut at = 0;
    while at + mark.len() <= all.len() {
        let mut same = 0;
        while same < mark.len() && all[at + same] == mark[same] {
            same += 1;
        }
        if same == mark.len() {
            return text.split_at(at).0;
        }
        at += 1;
    }
    panic!("the mark is not in the text")
}

/// Its files: address, kind, content. The drawing is that of the page that Gaussians are exported to; the other scripts are modules of one
/// thing each.
pub const FILES: [(&str, &str, &str); 17] = [
    ("/", "text/html; charset=utf-8", include_str!("page/index.html")),
    STYLE,
    ("/viewer.js", SCRIPT, VIEWER),
    ("/main.js", SCRIPT, include_str!("page/main.js")),
    ("/jobs.js", SCRIPT, include_str!("page/jobs.js")),
    ("/job.js", SCRIPT, include_str!("page/job.js")),
    ("/gaussians.js", SCRIPT, include_str!("page/gaussians.js")),
    ("/panes.js", SCRIPT, include_str!("page/panes.js")),
    ("/brush.js", SCRIPT, include_str!("page/brush.js")),
    ("/zoom.js", SCRIPT, include_str!("page/zoom.js")),
    ("/edit.js", SCRIPT, include_str!("page/edit.js")),
    ("/send.js", SCRIPT, include_str!("page/send.js")),
    ("/record.js", SCRIPT, include_str!("page/record.js")),
    ("/remove.js", SCRIPT, include_str!("page/remove.js")),
    ("/gif.js", SCRIPT, include_str!("page/gif.js")),
    ("/dom.js", SCRIPT, include_str!("page/dom.js")),
    ("/state.js", SCRIPT, include_str!("page/state.js")),
];

/// What those may have who do not know the token.
pub const OPEN: [(&str, &str, &str); 2] = [STYLE, ("/enter.js", SCRIPT, include_str!("page/enter.js"))];

/// Asks for the token; the same after a wrong one; and goes on to the page by itself.
pub const LOGIN: &str = include_str!("page/login.html");
pub static REFUSED: LazyLock<String> = LazyLock::new(|| LOGIN.replace(NOTHING_WRONG, WRONG));
/// What the form says, and what it says after a wrong token.
const NOTHING_WRONG: &str = r#"role="alert"></p>"#;
const WRONG: &str = r#"role="alert">That is not the token of this server.</p>"#;
pub const ENTER: &str = include_str!("page/enter.html");

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_is_small_and_names_nothing_outside() {
        let size: usize = FILES.iter().map(|(_, _, text)| text.len()).sum();
        assert!(size < 120_000, "{size} bytes");
        assert!(VIEWER.contains("class Viewer") && VIEWER.trim_end().ends_with('}'));
        assert!(REFUSED.contains(WRONG));
        let others = [LOGIN, &REFUSED, ENTER].map(|text| ("before the token", "", text));
        for (name, _, text) in FILES.into_iter().chain(OPEN).chain(others) {
            for odd in [
                "https://",
                "http://",
                "//cdn",
                "innerHTML",
                "outerHTML",
                "insertAdjacentHTML",
                "document.write",
                "eval(",
                "style=\"",
                " onclick",
            ] {
                assert!(!text.contains(odd), "{name}: {odd}");
            }
        }
    }
}
