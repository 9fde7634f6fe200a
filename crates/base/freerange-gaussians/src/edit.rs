//! Parts of a scene: what lies in a box or a sphere, and what hangs in the air.

use std::collections::HashMap;

use glam::{DVec3, IVec3};

use crate::Splats;

/// A component with less than this share of the largest one's area is a floater.
const FLOATER: f64 = 0.01;
/// Gaussians fainter than this connect nothing.
const FAINT: f64 = 0.1;
/// Width of a cell, in medians of the Gaussians' largest standard deviations.
const CELL: f64 = 4.0;
/// Most cells that a Gaussian connects along an axis, to either side of its center.
const REACH: i32 = 4;

impl Splats {
    /// The numbers of Gaussians whose centers lie between two corners, which may be any two that are opposite.
    pub fn within_box(&self, a: DVec3, b: DVec3) -> Vec<usize> {
        let (low, high) = (a.min(b), a.max(b));
        let inside = |p: DVec3| p.cmpge(low).all() && p.cmple(high).all();
        (0..self.cloud.len()).filter(|i| inside(self.position(*i))).collect()
    }

    /// The numbers of Gaussians whose centers lie in a sphere.
    pub fn within_sphere(&self, center: DVec3, radius: f64) -> Vec<usize> {
        (0..self.cloud.len()).filter(|i| self.position(*i).distance(center) <= radius).collect()
    }

    /// The numbers of Gaussians that are no floaters: those of the largest connected component, and of others with at
    /// least a hundredth of its area. Gaussians are connected where the cells of a grid that they cover (to two
    /// standard deviations) are neighbors.
    pub fn without_floaters(&self) -> Vec<usize> {
        let cloud = &self.cloud;
        let n = cloud.len();
        let largest = |i: usize| cloud.scale(i).max_element();
        let mut sizes: Vec<f64> = (0..n).map(largest).collect();
        if n == 0 {
            return Vec::new();
        }
        let median = *sizes.select_nth_unstable_by(n / 2, f64::total_cmp).1;
        let (low, high) = cloud.bounds().unwrap_or_default();
        // Cells are numbered in 32 bits.
        let cell = (CELL * median).max((high - low).max_element() * 1e-6).max(f64::MIN_POSITIVE);
        let cell_of = |p: DVec3| ((p - low) / cell).floor().as_ivec3();

        let mut cells = Cells::default();
        for i in (0..n).filter(|i| cloud.opacity(*i) >= FAINT) {
            let first = cells.number(cell_of(cloud.mean(i)));
            for point in cover(self, i, cell) {
                let other = cells.number(cell_of(point));
                cells.join(first, other);
            }
        }
        cells.join_neighbors();
        let mut area: HashMap<usize, f64> = HashMap::new();
        for i in 0..n {
            let s = cloud.scale(i);
            let weight = cloud.opacity(i) * s.element_product() / s.min_element();
            if let Some(root) = cells.root_at(cell_of(cloud.mean(i))) {
                *area.entry(root).or_default() += weight;
            }
        }
        let most = area.values().copied().fold(0.0, f64::max);
        let kept = |i: &usize| {
            let root = cells.root_at(cell_of(cloud.mean(*i)));
            root.and_then(|r| area.get(&r)).is_some_and(|a| *a >= FLOATER * most)
        };
        (0..n).filter(kept).collect()
    }
}

/// Points of Gaussian `i`, about a cell apart, in the plane of its two longest axes, to two standard deviations.
fn cover(splats: &Splats, i: usize, cell: f64) -> Vec<DVec3> {
    let (mean, scale, rotation) = (splats.cloud.mean(i), splats.cloud.scale(i), splats.cloud.rotation(i));
    let mut axes: Vec<DVec3> = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| rotation * (axis * scale)).to_vec();
    axes.sort_by(|a, b| b.length_squared().total_cmp(&a.length_squared()));
    let steps = |axis: DVec3| ((2.0 * axis.length() / cell).ceil() as i32).clamp(1, REACH);
    let (a, b) = (steps(axes[0]), steps(axes[1]));
    let at = |u: i32, v: i32| {
        let (u, v) = (2.0 * f64::from(u) / f64::from(a), 2.0 * f64::from(v) / f64::from(b));
        (u * u + v * v <= 4.0).then_some(mean + u * axes[0] + v * axes[1])
    };
    (-a..=a).flat_map(|u| (-b..=b).filter_map(move |v| at(u, v))).collect()
}

/// Cells of a grid in which something is, and which of them are connected (disjoint sets).
#[derive(Default)]
struct Cells {
    numbers: HashMap<IVec3, usize>,
    parents: Vec<usize>,
}

impl Cells {
    fn number(&mut self, cell: IVec3) -> usize {
        let next = self.parents.len();
        let number = *self.numbers.entry(cell).or_insert(next);
        if number == next {
            self.parents.push(next);
        }
        number
    }

    fn root(&self, mut cell: usize) -> usize {
        while self.parents[cell] != cell {
            cell = self.parents[cell];
        }
        cell
    }

    fn root_at(&self, cell: IVec3) -> Option<usize> {
        self.numbers.get(&cell).map(|n| self.root(*n))
    }

    fn join(&mut self, a: usize, b: usize) {
        let (low, high) = (self.root(a).min(self.root(b)), self.root(a).max(self.root(b)));
        // The lower number stays: the result does not depend on the order of the hash map. Paths are shortened on the way.
        self.parents[high] = low;
        self.parents[a] = low;
        self.parents[b] = low;
    }

    fn join_neighbors(&mut self) {
        let cells: Vec<(IVec3, usize)> = self.numbers.iter().map(|(c, n)| (*c, *n)).collect();
        let steps = (0..27).map(|k| IVec3::new(k % 3 - 1, k / 3 % 3 - 1, k / 9 - 1));
        for step in steps {
            for (cell, number) in &cells {
                if let Some(&other) = self.numbers.get(&(*cell + step)) {
                    self.join(*number, other);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Gaussians, channel};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Gaussians on a sphere about `center`.
    fn ball(n: usize, center: DVec3, radius: f64, scale: f64, seed: u64) -> Gaussians {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut cloud = Gaussians::default();
        for _ in 0..n {
            let d = DVec3::from_array(std::array::from_fn(|_| rng.random_range(-1.0..1.0)));
            let p = center + radius * d.normalize();
            let mut row = [0f32; channel::COUNT];
            row[channel::MEAN].copy_from_slice(&p.as_vec3().to_array());
            row[channel::LOG_SCALE].fill(scale.ln() as f32);
            row[channel::ROTATION.start] = 1.0;
            row[channel::LOGIT_OPACITY] = 2.0;
            cloud.push(&row);
        }
        cloud
    }

    #[test]
    fn floaters_go_and_the_object_stays() {
        let mut cloud = ball(2000, DVec3::ZERO, 0.5, 0.02, 1);
        // A lid that does not touch, a few specks, one large faint cloud between them.
        ball(300, DVec3::new(0.0, 0.0, 1.0), 0.2, 0.02, 2).iter().for_each(|r| cloud.push(r));
        ball(3, DVec3::new(1.5, 0.0, 0.0), 0.02, 0.02, 3).iter().for_each(|r| cloud.push(r));
        let mut veil = *ball(1, DVec3::new(1.0, 0.0, 0.0), 0.0, 0.5, 4).row(0);
        veil[channel::MEAN].copy_from_slice(&[1.0, 0.0, 0.0]);
        veil[channel::LOGIT_OPACITY] = -4.0;
        cloud.push(&veil);
        let kept = Splats::from(cloud).without_floaters();
        assert_eq!(kept, (0..2300).collect::<Vec<_>>());
        assert!(Splats::default().without_floaters().is_empty());
    }

    #[test]
    fn few_large_gaussians_hold_together() {
        // A plate of four large, flat Gaussians among many small ones on a ball that it touches.
        let mut cloud = ball(2000, DVec3::ZERO, 0.5, 0.01, 1);
        for k in 0..4 {
            let mut row = *ball(1, DVec3::ZERO, 0.0, 0.12, 4).row(0);
            row[channel::MEAN].copy_from_slice(&[0.6 + 0.25 * k as f32, 0.0, 0.0]);
            row[channel::LOG_SCALE.start + 1] = -6.0;
            cloud.push(&row);
        }
        assert_eq!(Splats::from(cloud).without_floaters().len(), 2004);
    }

    #[test]
    fn boxes_and_spheres_are_in_world_units() {
        let mut splats = Splats::from(ball(500, DVec3::ZERO, 1.0, 0.02, 5));
        splats.origin = DVec3::new(1e7, 0.0, 0.0);
        let upper = splats.within_box(DVec3::new(1e7 + 2.0, 2.0, 0.0), DVec3::new(1e7 - 2.0, -2.0, 2.0));
        assert!(!upper.is_empty() && upper.iter().all(|i| splats.position(*i).z >= 0.0));
        assert_eq!(upper.len(), (0..500).filter(|i| splats.position(*i).z >= 0.0).count());
        assert_eq!(splats.within_sphere(splats.origin, 1.001).len(), 500);
        assert!(splats.within_sphere(DVec3::ZERO, 1.001).is_empty());
    }
}
