//! Tables, and their two ways of writing: Markdown and HTML. Names come from files of others and are escaped in both.

use std::fmt::Display;

/// One cell.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Cell {
    /// What it says.
    pub text: String,
    /// Where it leads, relative to the report; made by this program.
    pub link: Option<String>,
    /// Whether it stands out.
    pub strong: bool,
}

impl Cell {
    /// Plain text.
    pub fn text(text: impl Display) -> Self {
        Self { text: text.to_string(), ..Self::default() }
    }

    /// Text that leads to a file of the report's folder.
    pub fn link(text: impl Display, link: Option<String>) -> Self {
        Self { text: text.to_string(), link, strong: false }
    }

    /// The same, standing out.
    pub fn strong(self) -> Self {
        Self { strong: true, ..self }
    }
}

/// Rows under a head.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Table {
    /// What the table shows.
    pub caption: String,
    /// Names of the columns.
    pub head: Vec<String>,
    /// Cells, row by row.
    pub rows: Vec<Vec<Cell>>,
}

impl Table {
    /// A table without rows.
    pub fn new(caption: impl Into<String>, head: &[&str]) -> Self {
        Self { caption: caption.into(), head: head.iter().map(|h| h.to_string()).collect(), rows: Vec::new() }
    }

    /// As GitHub's Markdown.
    pub fn markdown(&self) -> String {
        let mut out = format!("**{}**\n\n", escape_markdown(&self.caption));
        let head: Vec<String> = self.head.iter().map(|h| escape_markdown(h)).collect();
        out += &format!("| {} |\n|{}\n", head.join(" | "), "---|".repeat(self.head.len()));
        for row in &self.rows {
            let cell = |c: &Cell| {
                let text = escape_markdown(&c.text);
                let text = if c.strong && !text.is_empty() { format!("**{text}**") } else { text };
                c.link.as_ref().map_or(text.clone(), |link| format!("[{text}]({})", escape_markdown(link)))
            };
            out += &format!("| {} |\n", row.iter().map(cell).collect::<Vec<_>>().join(" | "));
        }
        out
    }

    /// As HTML.
    pub fn html(&self) -> String {
        let mut out = format!("<table>\n<caption>{}</caption>\n<tr>", escape_html(&self.caption));
        self.head.iter().for_each(|h| out += &format!("<th>{}</th>", escape_html(h)));
        out += "</tr>\n";
        for row in &self.rows {
            out += "<tr>";
            for c in row {
                let text = escape_html(&c.text);
                let text = if c.strong { format!("<b>{text}</b>") } else { text };
                out += &match &c.link {
                    Some(link) => format!("<td><a href=\"{}\">{text}</a></td>", escape_html(link)),
                    None => format!("<td>{text}</td>"),
                };
            }
            out += "</tr>\n";
        }
        out + "</table>\n"
    }
}

/// Text that cannot leave its place in HTML, be it content or a quoted attribute.
pub fn escape_html(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out += "&amp;",
            '<' => out += "&lt;",
            '>' => out += "&gt;",
            '"' => out += "&quot;",
            '\'' => out += "&#39;",
            c if c.is_control() => out.push(' '),
            c => out.push(c),
        }
    }
    out
}

/// Text that cannot leave its cell or become markup in Markdown, which lets HTML through.
pub fn escape_markdown(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out += "&amp;",
            '<' => out += "&lt;",
            '>' => out += "&gt;",
            '\\' | '`' | '*' | '[' | ']' | '|' | '!' | '~' | '$' => {
                out.push('\\');
                out.push(c);
            }
            c if c.is_control() => out.push(' '),
            c => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hostile_names_stay_text() {
        let hostile = "\"><script>alert('x')</script>&|[a](javascript:b)\n| `c` | ![d](http://e)";
        let mut table = Table::new(hostile, &[hostile]);
        table.rows.push(vec![Cell::link(hostile, Some(hostile.into())).strong()]);
        let html = table.html();
        for bad in ["<script", "\"><s", "'x'", "</script"] {
            assert!(!html.contains(bad), "{bad} in {html}");
        }
        // As many of our own tags as there are without the name, and no more.
        assert_eq!(html.matches('<').count(), 2 + 2 + 4 + 8);
        let markdown = table.markdown();
        assert!(!markdown.contains('<') && !markdown.contains("\n| `c`"), "{markdown}");
        assert_eq!(markdown.lines().count(), 5);
        for line in markdown.lines().skip(2) {
            let bars = line.as_bytes().windows(2).filter(|w| w[1] == b'|' && w[0] != b'\\').count();
            assert!(bars <= 1, "{line}");
        }
        assert!(!markdown.replace("\\[", "").replace("\\]", "").contains("![d]"));
    }

    #[test]
    fn plain_tables_look_plain() {
        let mut table = Table::new("c", &["a_b", "n"]);
        table.rows.push(vec![Cell::link("x_y", Some("objects/x_y.jpg".into())), Cell::text(1).strong()]);
        assert_eq!(table.markdown(), "**c**\n\n| a_b | n |\n|---|---|\n| [x_y](objects/x_y.jpg) | **1** |\n");
        assert_eq!(
            table.html(),
            "<table>\n<caption>c</caption>\n<tr><th>a_b</th><th>n</th></tr>\n\
             <tr><td><a href=\"objects/x_y.jpg\">x_y</a></td><td><b>1</b></td></tr>\n</table>\n"
        );
    }
}
