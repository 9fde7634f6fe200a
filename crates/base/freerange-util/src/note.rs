//! What is told to the user beside a result, by kind.

use std::{fmt, ops::Deref};

/// What a [`Note`] is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NoteKind {
    /// Something that was read or found.
    Understood,
    /// Something that no file says, and that was taken to be so.
    Assumed,
    /// Something that was converted on the way in.
    Changed,
    /// Something that is there and is not used.
    Dropped,
    /// Something that may make the result wrong.
    Warning,
}

/// A sentence for the user, and its kind. Reads as its text.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Note {
    /// What it is about.
    pub kind: NoteKind,
    /// The sentence.
    pub text: String,
}

impl Note {
    /// A note of [`NoteKind::Understood`].
    pub fn understood(text: impl Into<String>) -> Self {
        Self { kind: NoteKind::Understood, text: text.into() }
    }

    /// A note of [`NoteKind::Assumed`].
    pub fn assumed(text: impl Into<String>) -> Self {
        Self { kind: NoteKind::Assumed, text: text.into() }
    }

    /// A note of [`NoteKind::Changed`].
    pub fn changed(text: impl Into<String>) -> Self {
        Self { kind: NoteKind::Changed, text: text.into() }
    }

    /// A note of [`NoteKind::Dropped`].
    pub fn dropped(text: impl Into<String>) -> Self {
        Self { kind: NoteKind::Dropped, text: text.into() }
    }

    /// A note of [`NoteKind::Warning`].
    pub fn warning(text: impl Into<String>) -> Self {
        Self { kind: NoteKind::Warning, text: text.into() }
    }
}

impl Deref for Note {
    type Target = str;

    fn deref(&self) -> &str {
        &self.text
    }
}

impl fmt::Display for Note {
    /// `warning: TEXT`, or `note: TEXT`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = if self.kind == NoteKind::Warning { "warning" } else { "note" };
        write!(f, "{word}: {}", self.text)
    }
}
