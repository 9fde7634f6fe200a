//! Patches: p neighbouring Gaussians of a slice, side by side, make one token.
//!
//! In a slice of the tree neighbouring rows are siblings (p = 2), share a grandparent (p = 4), and so on. As clouds
//! are row-major, `[n, c]` to `[n / p, p * c]` moves no value: only the shape changes.

use crate::SplatError;

/// Shape `[tokens, values per token]` of `gaussians` rows of `channels` values in patches of `patch`.
///
/// # Errors
/// [`SplatError::Patch`] if `patch` is zero or does not divide `gaussians`.
pub fn shape(gaussians: usize, channels: usize, patch: usize) -> Result<[usize; 2], SplatError> {
    if patch == 0 || !gaussians.is_multiple_of(patch) {
        return Err(SplatError::Patch { patch, gaussians });
    }
    Ok([gaussians / patch, patch * channels])
}

/// The tokens of `rows` (row-major `[gaussians, channels]`), each the `patch * channels` values of its Gaussians.
///
/// # Errors
/// [`SplatError::Patch`] if `patch` is zero or does not divide the number of Gaussians.
///
/// # Panics
/// If `channels` is zero or does not divide the length of `rows`.
pub fn patchify(rows: &[f32], channels: usize, patch: usize) -> Result<std::slice::ChunksExact<'_, f32>, SplatError> {
    assert!(channels > 0 && rows.len().is_multiple_of(channels), "rows of {channels} channels");
    let [_, width] = shape(rows.len() / channels, channels, patch)?;
    Ok(rows.chunks_exact(width))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_share_a_token() {
        let rows: Vec<f32> = (0..8 * 3).map(|v| v as f32).collect();
        let tokens: Vec<_> = patchify(&rows, 3, 4).unwrap().collect();
        assert_eq!(tokens.len(), 2);
        assert_eq!(tokens[1], &rows[12..24]);
        assert_eq!(shape(8, 14, 2).unwrap(), [4, 28]);
        assert_eq!(shape(0, 14, 8).unwrap(), [0, 112]);
    }

    #[test]
    fn patches_that_do_not_divide_are_refused() {
        assert!(matches!(shape(6, 14, 4), Err(SplatError::Patch { patch: 4, gaussians: 6 })));
        assert!(shape(6, 14, 0).is_err());
    }
}
