//! Choice among the 24 ways to name the axes of one Gaussian.
//!
//! Permuting the local axes and flipping two of them leaves a Gaussian as it is, but changes its quaternion and the
//! order of its scales. A generative model wants these channels to be alike where the Gaussians are.

use glam::{DMat3, DVec3};

/// How a tree names the axes of its Gaussians. Scales are permuted along.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Alignment {
    /// As close to the parent's axes as possible, from the root down (Kerbl et al. 2024); the root as close to the
    /// world's axes.
    Parent,
    /// As close to the world's axes as possible, every Gaussian on its own.
    #[default]
    Identity,
    /// Leaves as they came; merged Gaussians with ascending scales.
    None,
}

/// Of the 24 proper labelings of `axes` the one with the largest `sum_j axes_j . reference_j`, and `scale` in its order.
pub(crate) fn relabel(axes: DMat3, scale: DVec3, reference: DMat3) -> (DMat3, DVec3) {
    // dots.col(j)[p]: how well axis p agrees with the reference's axis j.
    let dots = axes.transpose() * reference;
    let mut best = (f64::NEG_INFINITY, [0, 1, 2], DVec3::ONE);
    const ORDERS: [([usize; 3], f64); 6] =
        [([0, 1, 2], 1.0), ([0, 2, 1], -1.0), ([1, 0, 2], -1.0), ([1, 2, 0], 1.0), ([2, 0, 1], 1.0), ([2, 1, 0], -1.0)];
    for (order, parity) in ORDERS {
        let dot = DVec3::from_array([0, 1, 2].map(|j| dots.col(j)[order[j]]));
        let mut sign = DVec3::ONE.copysign(dot);
        if sign.element_product() != parity {
            // Flipping the axis that agrees least costs least.
            let least = dot.abs().min_position();
            sign[least] = -sign[least];
        }
        let score = sign.dot(dot);
        if score > best.0 {
            best = (score, order, sign);
        }
    }
    let (_, order, sign) = best;
    let column = |j: usize| axes.col(order[j]) * sign[j];
    (DMat3::from_cols(column(0), column(1), column(2)), DVec3::from_array(order.map(|p| scale[p])))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gaussians::covariance;
    use glam::DQuat;
    use proptest::prelude::*;

    /// Every signed permutation, tried.
    fn best_score(axes: DMat3, reference: DMat3) -> f64 {
        let mut best = f64::NEG_INFINITY;
        for code in 0..27 * 8 {
            let order = [code % 3, code / 3 % 3, code / 9 % 3];
            let column = |j: usize| axes.col(order[j]) * if ((code / 27) >> j) & 1 == 1 { -1.0 } else { 1.0 };
            let candidate = DMat3::from_cols(column(0), column(1), column(2));
            if candidate.determinant() > 0.5 {
                best = f64::max(best, (0..3).map(|j| candidate.col(j).dot(reference.col(j))).sum());
            }
        }
        best
    }

    proptest! {
        #[test]
        fn finds_the_best_of_24(a in prop::array::uniform4(-1.0f64..1.0), b in prop::array::uniform4(-1.0f64..1.0)) {
            let (a, b) = (DQuat::from_array(a), DQuat::from_array(b));
            prop_assume!(a.length() > 0.1 && b.length() > 0.1);
            let (axes, reference) = (DMat3::from_quat(a.normalize()), DMat3::from_quat(b.normalize()));
            let scale = DVec3::new(1.0, 2.0, 3.0);
            let (found, permuted) = relabel(axes, scale, reference);
            prop_assert!((found.determinant() - 1.0).abs() < 1e-12);
            prop_assert!(covariance(found, permuted).abs_diff_eq(covariance(axes, scale), 1e-12));
            let score: f64 = (0..3).map(|j| found.col(j).dot(reference.col(j))).sum();
            prop_assert!((score - best_score(axes, reference)).abs() < 1e-12);
        }
    }
}
