//! The statements that OBJ and MTL files consist of.

use std::borrow::Cow;

/// The statements of a file: lines, joined where one ends in a backslash.
pub fn statements(text: &str) -> impl Iterator<Item = Cow<'_, str>> {
    let mut lines = text.lines();
    std::iter::from_fn(move || {
        let mut line = Cow::Borrowed(lines.next()?.trim());
        while line.ends_with('\\') && !line.starts_with('#') {
            let line = line.to_mut();
            line.pop();
            line.push(' ');
            line.push_str(lines.next().unwrap_or_default().trim());
        }
        Some(line)
    })
}

/// A statement's key word and the rest; of statements that cannot contain names, without a comment at the end.
pub fn split(statement: &str) -> (&str, &str) {
    let (key, rest) = statement.split_once(char::is_whitespace).unwrap_or((statement, ""));
    let rest = if matches!(key, "v" | "vt" | "vn" | "f") { rest.split('#').next().unwrap_or_default() } else { rest };
    (key, rest.trim())
}
