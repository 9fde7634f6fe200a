//! What many crates need and none of them owns: errors that name the field or the file, files that are whole or not
//! there, hashes, shares of work, work side by side and how it is stopped, what lies behind an object, and small operations on pictures.
//!
//! Architecture invariant: knows no other crate of the workspace.

mod background;
mod error;
mod file;
mod hash;
pub mod image_ops;
mod note;
mod share;
mod side_by_side;
mod stop;

pub use background::Background;
pub use error::{Invalid, IoError, check, ensure, system_failed, with_causes};
pub use file::{beside, persist, sync_folder, sync_tree, write_atomically};
pub use hash::{hex, sha256, sha256_of};
pub use note::{Note, NoteKind};
pub use share::Share;
pub use side_by_side::side_by_side;
pub use stop::{Stop, Stopped};
