//! Errors of `.ply` files, with what was expected and what was found.

use crate::{SplatError, ply_header::Element};
use std::path::Path;

/// What is found where rows are missing.
pub(crate) const END: &str = "the end of the file: cut off or incomplete";

/// The first few of `names`; headers may hold thousands.
pub(crate) fn listed(names: &[&str]) -> String {
    let shown = names.iter().take(8).map(|n| n.chars().take(40).collect()).collect::<Vec<String>>().join(", ");
    if names.len() > 8 { format!("{shown} and {} more", names.len() - 8) } else { shown }
}

pub(crate) fn property_error(file: &Path, property: &str, expected: &str, found: &str) -> SplatError {
    SplatError::PlyProperty {
        file: file.into(),
        property: property.into(),
        expected: expected.into(),
        found: found.into(),
    }
}

pub(crate) fn value_error(
    file: &Path,
    element: &Element,
    row: u64,
    property: &str,
    expected: &str,
    found: &str,
) -> SplatError {
    SplatError::PlyValue {
        file: file.into(),
        element: element.name.as_str().into(),
        row,
        property: property.into(),
        expected: expected.into(),
        found: found.into(),
    }
}
