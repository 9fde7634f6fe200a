//! Color that depends on the viewing direction: real spherical harmonics above the constant.
//!
//! Basis and signs are those of 3D Gaussian splatting (with the Condon-Shortley phase): degree 1 is `-y`, `z`, `-x`
//! times a constant. A direction points from the camera to the Gaussian.

use glam::{DMat3, DVec3};

/// Highest degree that is kept.
pub const MAX_DEGREE: usize = 3;

/// Coefficients of a basis function of one channel each, of degree 1 to `degree`.
pub const fn coefficients(degree: usize) -> usize {
    (degree + 1) * (degree + 1) - 1
}

/// The spherical harmonics of many Gaussians, without the constant, which is their color.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Harmonics {
    degree: usize,
    data: Vec<f32>, // [n, coefficients(degree), 3]
}

impl Harmonics {
    /// Wraps `data`, row-major `[n, coefficients(degree), 3]`.
    ///
    /// # Panics
    /// If the degree is above [`MAX_DEGREE`], or the length is no multiple of what a Gaussian has: programming errors,
    /// as files are checked when they are read.
    pub fn from_rows(degree: usize, data: Vec<f32>) -> Self {
        assert!(degree <= MAX_DEGREE, "harmonics of degree {degree}");
        let each = 3 * coefficients(degree);
        assert!(if each == 0 { data.is_empty() } else { data.len().is_multiple_of(each) }, "whole rows");
        Self { degree, data }
    }

    /// The highest degree, 0 to [`MAX_DEGREE`]; 0 stands for none at all.
    pub fn degree(&self) -> usize {
        self.degree
    }

    /// Numbers per Gaussian: `coefficients(degree) * 3`.
    pub fn width(&self) -> usize {
        3 * coefficients(self.degree)
    }

    /// All coefficients, row-major `[n, coefficients(degree), 3]`.
    pub fn rows(&self) -> &[f32] {
        &self.data
    }

    /// The coefficients of Gaussian `i`: `[coefficients(degree), 3]`.
    pub fn row(&self, i: usize) -> &[f32] {
        &self.data[self.width() * i..][..self.width()]
    }

    /// The Gaussians at `indices`, in that order.
    pub fn select(&self, indices: impl IntoIterator<Item = usize>) -> Self {
        let data = indices.into_iter().flat_map(|i| self.row(i).iter().copied()).collect();
        Self { degree: self.degree, data }
    }

    /// The same of a degree no higher (coefficients left out) or no lower (zeros put in), for `n` Gaussians.
    pub fn with_degree(&self, degree: usize, n: usize) -> Self {
        let (from, to) = (self.width(), 3 * coefficients(degree));
        let mut data = vec![0.0; to * n];
        let common = from.min(to);
        if common > 0 {
            for (old, new) in self.data.chunks_exact(from).zip(data.chunks_exact_mut(to)) {
                new[..common].copy_from_slice(&old[..common]);
            }
        }
        Self::from_rows(degree, data)
    }

    /// Follows directions moved by `matrix`, a rotation or a mirror: what was seen in direction `d` is seen in
    /// `matrix * d`.
    pub fn turn(&mut self, matrix: DMat3) {
        if self.degree == 0 {
            return;
        }
        let bands = bands(matrix, self.degree);
        let width = self.width();
        for row in self.data.chunks_exact_mut(width) {
            for (l, band) in (1..).zip(&bands) {
                let start = coefficients(l - 1);
                let size = 2 * l + 1;
                let old: Vec<f32> = row[3 * start..3 * (start + size)].to_vec();
                for m in 0..size {
                    for channel in 0..3 {
                        let sum: f64 = (0..size).map(|k| band[m * size + k] * f64::from(old[3 * k + channel])).sum();
                        row[3 * (start + m) + channel] = sum as f32;
                    }
                }
            }
        }
    }

    /// What Gaussian `i` has besides its constant color when seen in the unit direction `d`: red, green, blue.
    pub fn color(&self, i: usize, d: DVec3) -> DVec3 {
        let basis = basis(d);
        let row = self.row(i).as_chunks::<3>().0;
        row.iter().zip(basis).map(|(c, b)| b * DVec3::new(c[0].into(), c[1].into(), c[2].into())).sum()
    }
}

/// The basis functions of degree 1 to 3 at the unit direction `d`.
fn basis(d: DVec3) -> [f64; 15] {
    let DVec3 { x, y, z } = d;
    let (xx, yy, zz) = (x * x, y * y, z * z);
    // sqrt(3 / 4 pi); sqrt(15 / 4 pi), sqrt(5 / 16 pi), sqrt(15 / 16 pi); sqrt(35 / 32 pi), sqrt(105 / 4 pi),
    // sqrt(21 / 32 pi), sqrt(7 / 16 pi), sqrt(105 / 16 pi)
    let over_pi = |v: f64| (v / std::f64::consts::PI).sqrt();
    let one = over_pi(3.0 / 4.0);
    let (mixed, axis, difference) = (over_pi(15.0 / 4.0), over_pi(5.0 / 16.0), over_pi(15.0 / 16.0));
    let (outer, product, inner) = (over_pi(35.0 / 32.0), over_pi(105.0 / 4.0), over_pi(21.0 / 32.0));
    let (pole, skew) = (over_pi(7.0 / 16.0), over_pi(105.0 / 16.0));
    [
        -one * y,
        one * z,
        -one * x,
        mixed * x * y,
        -mixed * y * z,
        axis * (3.0 * zz - 1.0),
        -mixed * x * z,
        difference * (xx - yy),
        -outer * y * (3.0 * xx - yy),
        product * x * y * z,
        -inner * y * (5.0 * zz - 1.0),
        pole * z * (5.0 * zz - 3.0),
        -inner * x * (5.0 * zz - 1.0),
        skew * z * (xx - yy),
        -outer * x * (xx - 3.0 * yy),
    ]
}

/// The (Wigner) matrices of degree 1 to `degree`, row-major `[2l + 1, 2l + 1]`: what `matrix` makes of coefficients.
///
/// The basis is orthonormal, so an entry is the integral of `Y_m(d) Y_k(matrix^-1 d)` over the sphere: exact by
/// quadrature, as the integrand is a polynomial of degree 6 at most.
fn bands(matrix: DMat3, degree: usize) -> Vec<Vec<f64>> {
    // Gauss-Legendre in z (4 nodes are exact to degree 7), 8 equal steps about it.
    let half = |sign: f64| ((3.0 + sign * 2.0 * (1.2f64).sqrt()) / 7.0).sqrt();
    let weight = |sign: f64| (18.0 + sign * 30f64.sqrt()) / 36.0;
    let nodes = [(half(-1.0), weight(1.0)), (half(1.0), weight(-1.0))];
    let mut bands: Vec<Vec<f64>> = (1..=degree).map(|l| vec![0.0; (2 * l + 1).pow(2)]).collect();
    for (z, weight) in nodes.into_iter().flat_map(|(z, w)| [(z, w), (-z, w)]) {
        for step in 0..8 {
            let (sin, cos) = (std::f64::consts::FRAC_PI_4 * f64::from(step)).sin_cos();
            let r = (1.0 - z * z).sqrt();
            let d = DVec3::new(r * cos, r * sin, z);
            let (here, there) = (basis(d), basis(matrix.transpose() * d));
            for (l, band) in (1..).zip(&mut bands) {
                let (start, size) = (coefficients(l - 1), 2 * l + 1);
                for (at, entry) in band.iter_mut().enumerate() {
                    *entry += weight * std::f64::consts::FRAC_PI_4 * here[start + at / size] * there[start + at % size];
                }
            }
        }
    }
    bands
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn example(degree: usize, n: usize) -> Harmonics {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let data = (0..n * 3 * coefficients(degree)).map(|_| rng.random_range(-1.0..1.0)).collect();
        Harmonics::from_rows(degree, data)
    }

    fn directions(n: usize) -> Vec<DVec3> {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut one = || DVec3::from_array(std::array::from_fn(|_| rng.random_range(-1.0..1.0)));
        (0..n).map(|_| one().normalize()).collect()
    }

    #[test]
    fn the_basis_is_that_of_3d_gaussian_splatting() {
        // The constants as its programs have them, in the order of their sum.
        let d = DVec3::new(0.36, -0.48, 0.8);
        let DVec3 { x, y, z } = d;
        let expected = [
            -0.488_602_511_902_919_9 * y,
            0.488_602_511_902_919_9 * z,
            -0.488_602_511_902_919_9 * x,
            1.092_548_430_592_079_2 * x * y,
            -1.092_548_430_592_079_2 * y * z,
            0.315_391_565_252_520_05 * (2.0 * z * z - x * x - y * y),
            -1.092_548_430_592_079_2 * x * z,
            0.546_274_215_296_039_6 * (x * x - y * y),
            -0.590_043_589_926_643_5 * y * (3.0 * x * x - y * y),
            2.890_611_442_640_554 * x * y * z,
            -0.457_045_799_464_465_8 * y * (4.0 * z * z - x * x - y * y),
            0.373_176_332_590_115_4 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y),
            -0.457_045_799_464_465_8 * x * (4.0 * z * z - x * x - y * y),
            1.445_305_721_320_277 * z * (x * x - y * y),
            -0.590_043_589_926_643_5 * x * (x * x - 3.0 * y * y),
        ];
        basis(d).into_iter().zip(expected).for_each(|(a, b)| assert!((a - b).abs() < 1e-12, "{a} {b}"));
    }

    #[test]
    fn turned_harmonics_show_in_turned_directions_what_they_showed_before() {
        let turn = DMat3::from_quat(DQuat::from_axis_angle(DVec3::new(1.0, -2.0, 0.5).normalize(), 2.1));
        let quarter = DMat3::from_cols(DVec3::X, DVec3::Z, -DVec3::Y);
        let mirror = DMat3::from_diagonal(DVec3::new(-1.0, 1.0, 1.0)) * turn;
        for degree in 1..=3 {
            for matrix in [turn, quarter, mirror, DMat3::IDENTITY] {
                let before = example(degree, 5);
                let mut after = before.clone();
                after.turn(matrix);
                for (i, d) in (0..5).flat_map(|i| directions(40).into_iter().map(move |d| (i, d))) {
                    let (old, new) = (before.color(i, d), after.color(i, matrix * d));
                    assert!(old.abs_diff_eq(new, 2e-6), "degree {degree}: {old} {new}");
                }
            }
        }
    }

    #[test]
    fn wigner_matrices_are_orthogonal_and_compose() {
        let q = |a: f64| DQuat::from_axis_angle(DVec3::new(0.3, 0.4, -1.0).normalize(), a);
        let (first, second) = (DMat3::from_quat(q(0.7)), DMat3::from_quat(DQuat::from_rotation_x(1.9)));
        let product = |a: &[f64], b: &[f64], n: usize| -> Vec<f64> {
            (0..n * n).map(|at| (0..n).map(|k| a[at / n * n + k] * b[k * n + at % n]).sum()).collect()
        };
        let (a, b, both) = (bands(first, 3), bands(second, 3), bands(second * first, 3));
        let back = bands(first.transpose(), 3);
        for l in 1..=3 {
            let n = 2 * l + 1;
            let composed = product(&b[l - 1], &a[l - 1], n);
            assert!(composed.iter().zip(&both[l - 1]).all(|(x, y)| (x - y).abs() < 1e-12));
            let identity = product(&back[l - 1], &a[l - 1], n);
            let expected = |at: usize| f64::from(u8::from(at / n == at % n));
            assert!(identity.iter().enumerate().all(|(at, v)| (v - expected(at)).abs() < 1e-12));
        }
    }

    #[test]
    fn degrees_are_cut_and_filled_up() {
        let three = example(3, 4);
        let one = three.with_degree(1, 4);
        assert_eq!((one.degree(), one.row(2)), (1, &three.row(2)[..9]));
        let again = one.with_degree(2, 4);
        assert_eq!((&again.row(3)[..9], &again.row(3)[9..]), (one.row(3), &[0.0; 15][..]));
        assert_eq!(Harmonics::default().with_degree(1, 2).rows(), [0.0; 18]);
        assert_eq!(three.with_degree(0, 4), Harmonics::default());
        assert_eq!(three.select([3, 0]).row(0), three.row(3));
    }
}
