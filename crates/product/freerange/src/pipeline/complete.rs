//! What a user's file of Gaussians lacks. In: the file and an initial fit, both in the canonical frame. Out: the file, and those
//! Gaussians of the fit that lie where the file has none.
//!
//! A fit that others made of few photos, or a part of an object, is a poor proposal by itself: the network corrects what is
//! there, and does not fill what is missing (docs/research/experiments/initial-fits.md).

use freerange_gaussians::{Gaussians, channel};
use glam::DVec3;

/// Cells along each side of the cube in which places are compared, and half of that side: the object has a radius of 0.5.
const CELLS: usize = 40;
const HALF: f64 = 0.6;
/// Fainter Gaussians fill no place.
const FAINT: f32 = 0.1;

/// `own`, and after it the Gaussians of `fit` whose place is empty: no Gaussian of `own` lies in the same cell or in one beside
/// it. Cells are 0.03 wide.
pub(super) fn completed(own: Gaussians, fit: &Gaussians) -> Gaussians {
    let mut filled = vec![false; CELLS.pow(3)];
    let faint = (FAINT / (1.0 - FAINT)).ln();
    for (i, row) in own.iter().enumerate() {
        let Some([x, y, z]) = cell(own.mean(i)).filter(|_| row[channel::LOGIT_OPACITY] > faint) else { continue };
        let beside = |at: usize| at.saturating_sub(1)..(at + 2).min(CELLS);
        for x in beside(x) {
            for y in beside(y) {
                beside(z).for_each(|z| filled[(x * CELLS + y) * CELLS + z] = true);
            }
        }
    }
    let empty = |i: &usize| cell(fit.mean(*i)).is_some_and(|[x, y, z]| !filled[(x * CELLS + y) * CELLS + z]);
    let added = fit.select((0..fit.len()).filter(empty));
    Gaussians::from_rows(own.rows().iter().chain(added.rows()).copied().collect())
}

/// The cell of a point; none outside of the cube.
fn cell(point: DVec3) -> Option<[usize; 3]> {
    let at = (point / HALF + 1.0) * (0.5 * CELLS as f64);
    let within = at.min_element() >= 0.0 && at.max_element() < CELLS as f64;
    within.then(|| at.to_array().map(|v| v as usize))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(points: &[[f32; 3]], logit: f32) -> Gaussians {
        let mut all = Gaussians::default();
        for point in points {
            let mut row = [0.0; channel::COUNT];
            row[channel::MEAN].copy_from_slice(point);
            row[channel::ROTATION.start] = 1.0;
            row[channel::LOGIT_OPACITY] = logit;
            all.push(&row);
        }
        all
    }

    #[test]
    fn a_fit_is_added_where_the_file_has_none() {
        let fit = at(&[[0.2, 0.0, 0.0], [0.22, 0.01, 0.0], [-0.2, 0.0, 0.0], [0.9, 0.0, 0.0]], 1.0);
        let own = at(&[[0.21, 0.0, 0.0]], 3.0);
        let all = completed(own.clone(), &fit);
        assert_eq!(all.len(), 2);
        assert_eq!((all.mean(0), all.mean(1)), (own.mean(0), fit.mean(2)), "the file first; nothing far outside");
        // What nobody sees fills nothing.
        assert_eq!(completed(at(&[[0.21, 0.0, 0.0]], -5.0), &fit).len(), 4);
        assert_eq!(completed(own.clone(), &at(&[], 0.0)), own);
        // At the cube's rim there are fewer cells beside.
        assert_eq!(completed(at(&[[-0.599, 0.599, 0.0]], 1.0), &fit).len(), 4);
    }
}
