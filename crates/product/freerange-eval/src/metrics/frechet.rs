//! The Frechet distance of two sets of features (Heusel et al. 2017), in double precision.

use faer::{Mat, MatRef, Side};

use crate::metrics::MetricsError;

/// Rows that are gathered before they enter the covariance, so that it costs one matrix product.
const BLOCK: usize = 64;

/// Mean and covariance of feature vectors that come one by one.
///
/// Holds `width * width` doubles (32 MiB for Inception's 2048) however many vectors there are.
#[derive(Clone, Debug)]
pub struct FeatureStatistics {
    width: usize,
    count: usize,
    /// The first vector. Deviations from it are summed, which keeps their squares small beside rounding.
    origin: Vec<f64>,
    /// Sum of deviations. `[width]`
    sum: Vec<f64>,
    /// Sum of outer products of deviations. `[width, width]`
    products: Mat<f64>,
    /// Deviations not yet in `products`, row by row.
    pending: Vec<f64>,
}

impl FeatureStatistics {
    /// Statistics of no vectors yet, of `width` values each.
    ///
    /// # Panics
    /// If `width` is 0.
    pub fn new(width: usize) -> Self {
        assert!(width > 0, "features have at least one value");
        Self {
            width,
            count: 0,
            origin: Vec::new(),
            sum: vec![0.0; width],
            products: Mat::zeros(width, width),
            pending: Vec::new(),
        }
    }

    /// Number of vectors so far.
    pub fn count(&self) -> usize {
        self.count
    }

    /// Adds one vector.
    ///
    /// # Errors
    /// If it has another length or a value is not finite.
    pub fn add(&mut self, features: &[f32]) -> Result<(), MetricsError> {
        let wrong = |what, expected: String, found: String| Err(MetricsError::Statistics { what, expected, found });
        if features.len() != self.width {
            return wrong("the number of values of a vector", self.width.to_string(), features.len().to_string());
        }
        if let Some(x) = features.iter().find(|x| !x.is_finite()) {
            return wrong("a feature", "finite".to_owned(), x.to_string());
        }
        if self.count == 0 {
            self.origin = features.iter().map(|&x| f64::from(x)).collect();
        }
        self.count += 1;
        for ((&x, origin), sum) in features.iter().zip(&self.origin).zip(&mut self.sum) {
            let deviation = f64::from(x) - origin;
            *sum += deviation;
            self.pending.push(deviation);
        }
        if self.pending.len() == BLOCK * self.width {
            add_products(&mut self.products, &self.pending);
            self.pending.clear();
        }
        Ok(())
    }

    /// Mean of the vectors; NaN if there are none. `[width]`
    pub fn mean(&self) -> Vec<f64> {
        if self.count == 0 {
            return vec![f64::NAN; self.width];
        }
        self.origin.iter().zip(&self.sum).map(|(origin, sum)| origin + sum / self.count as f64).collect()
    }

    /// Sample covariance (divided by `count - 1`), row by row; NaN for fewer than two vectors. `[width * width]`
    pub fn covariance(&self) -> Vec<f64> {
        let matrix = self.covariance_matrix();
        (0..self.width * self.width).map(|k| matrix[(k / self.width, k % self.width)]).collect()
    }

    fn covariance_matrix(&self) -> Mat<f64> {
        let mut products = self.products.clone();
        add_products(&mut products, &self.pending);
        let n = self.count as f64;
        let divisor = if self.count < 2 { f64::NAN } else { n - 1.0 };
        Mat::from_fn(self.width, self.width, |i, j| (products[(i, j)] - self.sum[i] * self.sum[j] / n) / divisor)
    }
}

/// `products += rows^T rows`.
fn add_products(products: &mut Mat<f64>, rows: &[f64]) {
    let width = products.ncols();
    let rows = MatRef::from_row_major_slice(rows, rows.len() / width, width);
    let parallel = faer::get_global_parallelism();
    faer::linalg::matmul::matmul(products.as_mut(), faer::Accum::Add, rows.transpose(), rows, 1.0, parallel);
}

/// `|m1 - m2|^2 + tr(S1 + S2 - 2 sqrt(S1 S2))`, what FID is for Inception's features.
///
/// The root's trace is the sum of the roots of the eigenvalues of `S1^(1/2) S2 S1^(1/2)`; directions in which `S1` is
/// zero within rounding are dropped first, so that few vectors in many dimensions (the usual case: there are 2048)
/// neither hurt the precision nor cost time. pytorch-fid takes the general root of `S1 S2` and, where that fails, adds
/// 1e-6 to the diagonal; the values agree where the problem is well posed.
///
/// # How many images?
/// The distance is biased upwards when there are few vectors, by an amount that depends on the model under test. Below
/// the width of the features (2048) the covariances do not even have full rank. Compare only values from
/// the same number of images, of the same objects and views; figures of papers with other data are no yardstick.
///
/// # Errors
/// If the widths differ or a set has fewer than two vectors.
pub fn frechet_distance(first: &FeatureStatistics, second: &FeatureStatistics) -> Result<f64, MetricsError> {
    let wrong = |what, expected: String, found: String| MetricsError::Statistics { what, expected, found };
    if first.width != second.width {
        return Err(wrong("the width of the second set", first.width.to_string(), second.width.to_string()));
    }
    let fewest = first.count.min(second.count);
    if fewest < 2 {
        return Err(wrong("the number of vectors", "at least 2".to_owned(), fewest.to_string()));
    }
    let mean_term: f64 = first.mean().iter().zip(second.mean()).map(|(a, b)| (a - b).powi(2)).sum();
    let (s1, s2) = (first.covariance_matrix(), second.covariance_matrix());
    let trace = |m: &Mat<f64>| (0..m.nrows()).map(|i| m[(i, i)]).sum::<f64>();
    let failed = |_| wrong("an eigenvalue problem", "solvable".to_owned(), "not converged".to_owned());

    let eigen = s1.self_adjoint_eigen(Side::Lower).map_err(failed)?;
    let values: Vec<f64> = eigen.S().column_vector().iter().copied().collect();
    let largest = values.iter().fold(0.0_f64, |m, &v| m.max(v));
    let kept: Vec<usize> = (0..values.len()).filter(|&i| values[i] > 1e-14 * largest).collect();
    if kept.is_empty() {
        return Ok(mean_term + trace(&s1) + trace(&s2));
    }
    let root = Mat::from_fn(first.width, kept.len(), |i, j| eigen.U()[(i, kept[j])] * values[kept[j]].sqrt());
    let product = root.transpose() * (&s2 * &root); // S1^(1/2) S2 S1^(1/2), in the eigenvectors of S1
    let product_values = product.self_adjoint_eigenvalues(Side::Lower).map_err(failed)?;
    let root_trace: f64 = product_values.iter().map(|v| v.max(0.0).sqrt()).sum();
    Ok(mean_term + trace(&s1) + trace(&s2) - 2.0 * root_trace)
}

/// [`frechet_distance`] of two sets with fewer vectors than values, much faster: the time grows with the vectors, not
/// with the values of each.
///
/// With deviations from the mean as rows of `A` and `B`, the root's trace is the sum of the singular values of
/// `A B^T / sqrt((n1 - 1) (n2 - 1))`.
///
/// # Errors
/// As [`frechet_distance`].
pub fn frechet_distance_of_few(first: &[&[f32]], second: &[&[f32]]) -> Result<f64, MetricsError> {
    let wrong = |what, expected: String, found: String| MetricsError::Statistics { what, expected, found };
    let fewest = first.len().min(second.len());
    if fewest < 2 {
        return Err(wrong("the number of vectors", "at least 2".to_owned(), fewest.to_string()));
    }
    let width = first[0].len();
    if let Some(other) = first.iter().chain(second).find(|v| v.len() != width) {
        return Err(wrong("the number of values of a vector", width.to_string(), other.len().to_string()));
    }
    if let Some(x) = first.iter().chain(second).flat_map(|v| *v).find(|x| !x.is_finite()) {
        return Err(wrong("a feature", "finite".to_owned(), x.to_string()));
    }
    let mean = |rows: &[&[f32]]| -> Vec<f64> {
        (0..width).map(|k| rows.iter().map(|row| f64::from(row[k])).sum::<f64>() / rows.len() as f64).collect()
    };
    let (m1, m2) = (mean(first), mean(second));
    let deviations = |rows: &[&[f32]], mean: &[f64]| {
        let scale = ((rows.len() - 1) as f64).sqrt().recip();
        Mat::from_fn(rows.len(), width, |i, k| (f64::from(rows[i][k]) - mean[k]) * scale)
    };
    let (a, b) = (deviations(first, &m1), deviations(second, &m2));
    let values = (&a * b.transpose()).singular_values();
    let values = values.map_err(|_| wrong("singular values", "solvable".to_owned(), "not converged".to_owned()))?;
    let mean_term: f64 = m1.iter().zip(&m2).map(|(a, b)| (a - b).powi(2)).sum();
    Ok(mean_term + a.squared_norm_l2() + b.squared_norm_l2() - 2.0 * values.iter().sum::<f64>())
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};

    use super::*;

    #[test]
    fn of_few_vectors_both_ways_agree() {
        let rng = &mut rand_chacha::ChaCha8Rng::seed_from_u64(8);
        for (width, counts) in [(64, [5, 9]), (64, [40, 40]), (12, [30, 20])] {
            let mut set = |n: usize, scale: f32| -> Vec<Vec<f32>> {
                (0..n).map(|_| (0..width).map(|k| scale * (rng.random::<f32>() + k as f32 * 0.1)).collect()).collect()
            };
            let sets = [set(counts[0], 1.0), set(counts[1], 1.5)];
            let few = sets.each_ref().map(|s| s.iter().map(Vec::as_slice).collect::<Vec<_>>());
            let all = few.each_ref().map(|rows| {
                let mut all = FeatureStatistics::new(width);
                rows.iter().for_each(|row| all.add(row).unwrap());
                all
            });
            let expected = frechet_distance(&all[0], &all[1]).unwrap();
            let found = frechet_distance_of_few(&few[0], &few[1]).unwrap();
            assert!((found / expected - 1.0).abs() < 1e-6, "{width} {counts:?}: {found} {expected}");
        }
    }

    #[test]
    fn few_vectors_that_do_not_fit_are_refused() {
        let [a, b, c] = [vec![0.0, 1.0], vec![1.0, 3.0], vec![f32::NAN, 0.0]];
        for (second, expected) in [
            (vec![a.as_slice()], "at least 2"),
            (vec![&a[..], &[1.0]], "number of values"),
            (vec![&a[..], &c[..]], "finite"),
        ] {
            let error = frechet_distance_of_few(&[&a, &b], &second).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }
}
