//! What many crates need and none of them owns: errors that name the field or the file, files that are whole or not
//! there, hashes, shares of work, what lies behind an object, and small operations on pictures.

mod background;
mod error;
mod file;
mod hash;
pub mod image_ops;
mod share;

pub use background::Background;
pub use error::{Invalid, IoError, check};
pub use file::{beside, persist, sync_folder, sync_tree, write_atomically};
pub use hash::{hex, sha256, sha256_of};
pub use share::Share;
