//! The page, which is part of the program.

use freerange_gaussians::formats::viewer;

/// Its files: address, kind, content. The drawing is that of the page that Gaussians are exported to.
pub const FILES: [(&str, &str, &str); 4] = [
    ("/", "text/html; charset=utf-8", include_str!("page/index.html")),
    ("/style.css", "text/css; charset=utf-8", include_str!("page/style.css")),
    ("/viewer.js", "text/javascript; charset=utf-8", viewer::SCRIPT),
    ("/page.js", "text/javascript; charset=utf-8", include_str!("page/page.js")),
];

/// Asks for the token.
pub const LOGIN: &str = include_str!("page/login.html");

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_is_small_and_names_nothing_outside() {
        let size: usize = FILES.iter().map(|(_, _, text)| text.len()).sum();
        assert!(size < 100_000, "{size} bytes");
        for (name, _, text) in FILES {
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
