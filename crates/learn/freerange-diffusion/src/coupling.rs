//! Which noise vector starts towards which Gaussian.
//!
//! The paper pairs them at random. The network is blind to the order of the tokens, so any rearrangement of the noise
//! among the Gaussians of one object leaves the distribution of starting *sets* as it was, and is a valid coupling of
//! noise and data (equivariant optimal transport: Klein et al. 2023, Song et al. 2023). A coupling that sends each noise
//! vector to a Gaussian in about the same direction makes the paths shorter and nearly free of crossings, which a
//! small model learns far faster. [`Coupling::Tree`] finds one in O(N log N): it splits the noise at the median, level by
//! level, along the same axes as the object's own Gaussians were split by their level-of-detail tree.

use freerange_gaussians::channel;

/// How noise is paired with Gaussians in training, and grouped into tokens when sampling.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Coupling {
    /// Independent, as in the paper.
    #[default]
    Independent,
    /// Median splits of the noise that follow the order of the Gaussians in their tree.
    Tree,
}

impl Coupling {
    /// Rearranges `noise` (`[n, 14]`) in place for `data` (`[n, 14]`, normalized, in tree order; `n` a power of two).
    pub fn pair(self, noise: &mut [f32], data: &[f32]) {
        assert_eq!(noise.len(), data.len(), "noise and data have the same shape");
        if self == Self::Tree {
            reorder(noise, |first, range| separating_axis(data, first, range.len()));
        }
    }

    /// Rearranges `noise` (`[n, 14]`, `n` a power of two) in place for sampling, where no data is known: the tokens
    /// get neighboring noise vectors, as they do in training.
    pub fn group(self, noise: &mut [f32]) {
        if self == Self::Tree {
            let rows: Vec<Row> = noise.as_chunks().0.to_vec();
            reorder(noise, |_, range| longest_axis(&rows, range));
        }
    }
}

type Row = [f32; channel::COUNT];

/// Sorts rows into the order of a median-split tree; `axis(first, rows)` is the axis that splits that range of rows.
fn reorder(noise: &mut [f32], axis: impl Fn(usize, &[u32]) -> usize) {
    let rows: Vec<Row> = noise.as_chunks().0.to_vec();
    let n = rows.len();
    assert!(n.is_power_of_two(), "a slice of the tree has a power of two of Gaussians");
    let mut order: Vec<u32> = (0..n as u32).collect();
    let mut count = n;
    while count > 1 {
        for (k, range) in order.chunks_mut(count).enumerate() {
            let a = axis(k * count, range);
            let position = |i: u32| rows[i as usize][a];
            range.select_nth_unstable_by(count / 2, |&i, &j| position(i).total_cmp(&position(j)).then(i.cmp(&j)));
        }
        count /= 2;
    }
    for (row, &i) in noise.as_chunks_mut().0.iter_mut().zip(&order) {
        *row = rows[i as usize];
    }
}

/// The axis along which the chosen rows spread farthest.
fn longest_axis(rows: &[Row], chosen: &[u32]) -> usize {
    let extent = |a: usize| {
        let values = chosen.iter().map(|&i| rows[i as usize][a]);
        let (low, high) = values.fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
        high - low
    };
    (0..3).max_by(|&a, &b| extent(a).total_cmp(&extent(b))).unwrap_or(0)
}

/// The axis along which the two halves of a range of Gaussians lie farthest apart: the one the tree split them by.
pub fn separating_axis(data: &[f32], first: usize, count: usize) -> usize {
    let center = |first: usize, count: usize| {
        let mut sum = [0f32; 3];
        let rows: &[Row] = data.as_chunks().0;
        for row in &rows[first..first + count] {
            for (s, x) in sum.iter_mut().zip(&row[channel::MEAN]) {
                *s += x;
            }
        }
        sum
    };
    let (left, right) = (center(first, count / 2), center(first + count / 2, count / 2));
    let gap = |a: usize| right[a] - left[a];
    (0..3).max_by(|&a, &b| gap(a).total_cmp(&gap(b))).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    fn normal(n: usize, seed: u64) -> Vec<f32> {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        (0..n * channel::COUNT).map(|_| StandardNormal.sample(&mut rng)).collect()
    }

    fn transport_cost(noise: &[f32], data: &[f32]) -> f32 {
        let rows = noise.chunks(channel::COUNT).zip(data.chunks(channel::COUNT));
        rows.map(|(a, b)| (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f32>()).sum()
    }

    #[test]
    fn tree_coupling_permutes_rows_and_shortens_the_paths() {
        let mut data = normal(256, 1);
        Coupling::Tree.group(&mut data); // any tree order will do
        let noise = normal(256, 2);
        let mut paired = noise.clone();
        Coupling::Tree.pair(&mut paired, &data);
        let sorted = |x: &[f32]| {
            let mut rows: Vec<Vec<u32>> =
                x.chunks(channel::COUNT).map(|r| r.iter().map(|v| v.to_bits()).collect()).collect();
            rows.sort();
            rows
        };
        assert_eq!(sorted(&noise), sorted(&paired), "the rows are only rearranged");
        assert!(transport_cost(&paired, &data) < 0.25 * transport_cost(&noise, &data));
    }

    #[test]
    fn independent_coupling_changes_nothing() {
        let (data, noise) = (normal(8, 1), normal(8, 2));
        let mut paired = noise.clone();
        Coupling::Independent.pair(&mut paired, &data);
        assert_eq!(paired, noise);
    }
}
