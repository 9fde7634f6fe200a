//! What many crates need and none of them owns: errors that name the field or the file, hashes, shares of work, and
//! what lies behind an object.

mod background;
mod error;
mod hash;
mod share;

pub use background::Background;
pub use error::{Invalid, IoError, check};
pub use hash::{hex, sha256, sha256_of};
pub use share::Share;
