//! Eigen decomposition of symmetric 3x3 matrices by cyclic Jacobi rotations (Golub and Van Loan, section 8.5).
//!
//! Only + - * / and square roots: the same bytes on every platform. Small eigenvalues of a positive matrix keep their
//! relative accuracy (Demmel and Veselic 1992), which flat Gaussians need.

use glam::{DMat3, DVec3};

/// Eigenvalues, ascending, and the eigenvectors as columns of a proper rotation. Reads one triangle of `matrix`.
pub(crate) fn symmetric_eigen(matrix: &DMat3) -> (DVec3, DMat3) {
    let mut a = matrix.to_cols_array_2d();
    let mut v = DMat3::IDENTITY.to_cols_array_2d(); // v[j] = j-th eigenvector
    // Convergence is quadratic, and takes four to six sweeps; the limit is for matrices that are not finite.
    for _ in 0..30 {
        let mut done = true;
        for (p, q, r) in [(0, 1, 2), (0, 2, 1), (1, 2, 0)] {
            let off = a[p][q];
            if off * off <= 1e-34 * (a[p][p] * a[q][q]).abs() {
                continue;
            }
            done = false;
            let theta = (a[q][q] - a[p][p]) / (2.0 * off);
            let t = 1f64.copysign(theta) / (theta.abs() + (theta * theta + 1.0).sqrt());
            let c = 1.0 / (t * t + 1.0).sqrt();
            let s = t * c;
            a[p][p] -= t * off;
            a[q][q] += t * off;
            let (rp, rq) = (a[r][p], a[r][q]);
            (a[p][q], a[q][p]) = (0.0, 0.0);
            a[r][p] = c * rp - s * rq;
            a[r][q] = s * rp + c * rq;
            (a[p][r], a[q][r]) = (a[r][p], a[r][q]);
            for k in 0..3 {
                let (vp, vq) = (v[p][k], v[q][k]);
                v[p][k] = c * vp - s * vq;
                v[q][k] = s * vp + c * vq;
            }
        }
        if done {
            break;
        }
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| a[i][i].total_cmp(&a[j][j]));
    let values = DVec3::from_array(order.map(|i| a[i][i]));
    let mut vectors = DMat3::from_cols_array_2d(&order.map(|i| v[i]));
    if vectors.determinant() < 0.0 {
        vectors.z_axis = -vectors.z_axis;
    }
    (values, vectors)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gaussians::covariance;
    use glam::DQuat;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn rebuilds_the_matrix(q in prop::array::uniform4(-1.0f64..1.0), log in prop::array::uniform3(-14.0f64..3.0)) {
            let q = DQuat::from_array(q);
            prop_assume!(q.length() > 0.1);
            let scale = DVec3::from_array(log).exp();
            let m = covariance(DMat3::from_quat(q.normalize()), scale);
            let (values, vectors) = symmetric_eigen(&m);
            prop_assert!((vectors.determinant() - 1.0).abs() < 1e-12);
            prop_assert!((vectors * vectors.transpose()).abs_diff_eq(DMat3::IDENTITY, 1e-12));
            let back = vectors * DMat3::from_diagonal(values) * vectors.transpose();
            let mut sorted = scale.to_array();
            sorted.sort_by(f64::total_cmp);
            prop_assert!(back.abs_diff_eq(m, 1e-13 * sorted[2] * sorted[2]));
            prop_assert!(values.x <= values.y && values.y <= values.z);
            prop_assert!((values.z.sqrt() / sorted[2] - 1.0).abs() < 1e-9);
        }
    }

    #[test]
    fn special_matrices() {
        for m in [DMat3::ZERO, DMat3::IDENTITY, DMat3::from_diagonal(DVec3::new(3.0, -1.0, 2.0))] {
            let (values, vectors) = symmetric_eigen(&m);
            assert!((vectors * DMat3::from_diagonal(values) * vectors.transpose()).abs_diff_eq(m, 1e-15));
            assert!((vectors.determinant() - 1.0).abs() < 1e-15);
        }
        // Not finite: any answer, but an answer.
        symmetric_eigen(&(DMat3::IDENTITY * f64::NAN));
    }
}
