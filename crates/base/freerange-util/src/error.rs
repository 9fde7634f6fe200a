//! Errors that name a field or a file.

use std::error::Error;
use std::fmt::Debug;
use std::io;
use std::path::{Path, PathBuf};

/// A value that cannot be used: which one, what would do, and what was given.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field}: expected {expected}, found {found}")]
pub struct Invalid {
    /// The field, with those it lies in: `object.cameras.resolution`.
    pub field: String,
    /// What it may be.
    pub expected: String,
    /// What it is.
    pub found: String,
}

impl Invalid {
    /// As the fields say.
    pub fn new(field: impl Into<String>, expected: impl Into<String>, found: impl ToString) -> Self {
        Self { field: field.into(), expected: expected.into(), found: found.to_string() }
    }

    /// The same of a field that lies within another one.
    #[must_use]
    pub fn within(self, outer: &str) -> Self {
        Self { field: format!("{outer}.{}", self.field), ..self }
    }
}

/// Refuses with the field's name unless `ok`, which is written so that NaN fails it.
///
/// # Errors
/// [`Invalid`], with `found` as it is written in a program: strings in quotes.
pub fn check(ok: bool, field: &str, expected: &str, found: impl Debug) -> Result<(), Invalid> {
    if ok { Ok(()) } else { Err(Invalid::new(field, expected, format!("{found:?}"))) }
}

/// [`check`], with `found` as it is printed.
///
/// # Errors
/// [`Invalid`].
pub fn ensure(ok: bool, field: &str, expected: &str, found: impl ToString) -> Result<(), Invalid> {
    if ok { Ok(()) } else { Err(Invalid::new(field, expected, found)) }
}

/// A file or folder that cannot be read or written.
#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", path.display())]
pub struct IoError {
    /// Which one.
    pub path: PathBuf,
    /// The system's reason.
    pub source: io::Error,
}

impl IoError {
    /// Gives an error of the system its path: `fs::read(path).map_err(IoError::at(path))?`.
    pub fn at(path: &Path) -> impl FnOnce(io::Error) -> Self {
        let path = path.to_path_buf();
        move |source| Self { path, source }
    }
}

/// An error and its causes in one line, `between` two of them. Many an error names its cause itself: it is not repeated.
pub fn with_causes(error: &(dyn Error + 'static), between: &str) -> String {
    let mut text = error.to_string();
    let mut last = text.clone();
    let mut cause = error.source();
    while let Some(e) = cause {
        let next = e.to_string();
        if !last.contains(&next) {
            text += between;
            text += &next;
            last = next;
        }
        cause = e.source();
    }
    text
}

/// Whether the system failed below an error: a full disk, a lost connection. Not where another path, or another file there,
/// would help.
pub fn system_failed(error: &(dyn Error + 'static)) -> bool {
    let mut next = Some(error);
    while let Some(e) = next {
        let io = match e.downcast_ref::<image::ImageError>() {
            Some(image::ImageError::IoError(io)) => Some(io),
            _ => e.downcast_ref(),
        };
        if io.is_some_and(|io: &io::Error| !is_about_input(io.kind())) {
            return true;
        }
        next = e.source();
    }
    false
}

fn is_about_input(kind: io::ErrorKind) -> bool {
    use io::ErrorKind as K;
    matches!(
        kind,
        K::NotFound
            | K::PermissionDenied
            | K::AlreadyExists
            | K::IsADirectory
            | K::NotADirectory
            | K::DirectoryNotEmpty
            | K::ReadOnlyFilesystem
            | K::InvalidFilename
            | K::InvalidInput
            | K::InvalidData
            | K::UnexpectedEof
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("{text}")]
    struct Outer {
        text: String,
        source: IoError,
    }

    #[test]
    fn causes_are_named_once() {
        let error = std::fs::read("none/there").map_err(IoError::at(Path::new("none/there"))).unwrap_err();
        let inner = error.to_string();
        assert_eq!(with_causes(&error, " < "), inner, "it names its cause itself");
        let outer = Outer { text: "the photos".into(), source: error };
        assert_eq!(with_causes(&outer, " < "), format!("the photos < {inner}"));
        let names = Outer { text: format!("the photos: {inner}"), source: outer.source };
        assert_eq!(with_causes(&names, " < "), format!("the photos: {inner}"));
    }

    #[test]
    fn errors_name_field_and_file() {
        assert_eq!(check(true, "a", "b", 0), Ok(()));
        let rate = f64::NAN;
        let refused = check(rate > 0.0, "rates.mean", "above 0", rate).unwrap_err();
        assert_eq!(refused.to_string(), "rates.mean: expected above 0, found NaN");
        assert_eq!(ensure(false, "a", "b", "c"), Err(Invalid::new("a", "b", "c")));
        assert_eq!(check(false, "a", "b", "c"), Err(Invalid::new("a", "b", "\"c\"")));
        let path = Path::new("none/there");
        let error = std::fs::read(path).map_err(IoError::at(path)).unwrap_err();
        assert!(error.to_string().starts_with("none/there: "), "{error}");
        assert_eq!(error.source.kind(), io::ErrorKind::NotFound);
    }

    #[test]
    fn a_full_disk_is_nobodys_input() {
        let of = |kind: io::ErrorKind| IoError::at(Path::new("a"))(kind.into());
        assert!(!system_failed(&of(io::ErrorKind::NotFound)) && system_failed(&of(io::ErrorKind::StorageFull)));
        assert!(system_failed(&image::ImageError::IoError(io::ErrorKind::StorageFull.into())));
        assert!(!system_failed(&Invalid::new("a", "b", "c")));
    }
}
