//! How a folder of shards is laid out, for whoever writes one: names of files, limits, the entries of an object.

pub use crate::manifest::{MAX_OBJECTS, PLAN, record_name, shard_name, to_json};
pub use crate::sample::{MAX_DEPTH, MAX_FITS, MAX_SIDE, MAX_VIEWS, encode, is_key};
pub use crate::shard::{END, ObjectBytes, object_bytes, tar_bytes};
