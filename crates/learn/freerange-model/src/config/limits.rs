//! Bounds of sizes, refused with the field's name.

use crate::ModelError;

/// Refuses what is not between two bounds.
pub(super) fn within(field: &'static str, value: usize, low: usize, high: usize) -> Result<(), ModelError> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(ModelError::config(field, format!("a whole number between {low} and {high}"), value))
}

/// Refuses what does not divide a size.
pub(super) fn divides(field: &'static str, value: usize, of: &str, whole: usize) -> Result<(), ModelError> {
    if whole.is_multiple_of(value) {
        return Ok(());
    }
    Err(ModelError::config(field, format!("a divisor of {of} = {whole}"), value))
}
