//! Where a fit starts when it is given no cloud: random Gaussians inside what all views see as the object.

use crate::{FitConfig, views::Targets};
use freerange_gaussians::{Gaussians, channel};
use glam::DVec3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

/// Points tried for each one needed.
const CANDIDATES: usize = 64;
/// But at most so many in all, unless more are needed.
const MAX_CANDIDATES: usize = 1 << 22;
/// Alpha from which a pixel counts as the object's.
const OPAQUE: u8 = 128;

/// `config.initial` Gaussians at random points of the sphere of radius `config.radius` about the origin, those first
/// that the fewest views see as transparent (the visual hull, where the masks agree on one).
pub(crate) fn random_cloud(targets: &Targets, config: &FitConfig, rng: &mut ChaCha8Rng) -> Gaussians {
    let count = config.initial;
    let opaque = targets.images.iter().all(|image| image.pixels().all(|p| p[3] >= OPAQUE));
    let tried = if opaque { count } else { (CANDIDATES * count).min(MAX_CANDIDATES).max(count) };
    let points: Vec<DVec3> = (0..tried).map(|_| config.radius * in_unit_ball(rng)).collect();
    let mut seen: Vec<(usize, [f32; 3], DVec3)> = points
        .into_par_iter()
        .map(|point| {
            let (outside, color) = judge(targets, point);
            (outside, color, point)
        })
        .collect();
    // Stable: equally good points stay in the order they were drawn in.
    seen.sort_by_key(|(outside, ..)| *outside);
    seen.truncate(count);

    let points: Vec<DVec3> = seen.iter().map(|(.., point)| *point).collect();
    let logit = (config.initial_opacity / (1.0 - config.initial_opacity)).ln() as f32;
    let mut cloud = Gaussians::default();
    for ((_, color, point), distance) in seen.iter().zip(neighbor_distances(&points)) {
        // One point alone has no neighbors: it stands for all of the sphere.
        let size = if distance.is_finite() { distance.max(1e-6 * config.radius) } else { config.radius };
        let mut row = [0.0; channel::COUNT];
        row[channel::MEAN].copy_from_slice(&point.as_vec3().to_array());
        row[channel::LOG_SCALE].fill((config.initial_scale * size).ln() as f32);
        row[channel::ROTATION.start] = 1.0;
        row[channel::LOGIT_OPACITY] = logit;
        row[channel::COLOR].copy_from_slice(color);
        cloud.push(&row);
    }
    cloud
}

fn in_unit_ball(rng: &mut ChaCha8Rng) -> DVec3 {
    loop {
        let point = DVec3::from_array(std::array::from_fn(|_| rng.random_range(-1.0..=1.0)));
        if point.length_squared() <= 1.0 {
            return point;
        }
    }
}

/// How many views see `point` as transparent, and the mean color of the others; gray where there is none.
fn judge(targets: &Targets, point: DVec3) -> (usize, [f32; 3]) {
    let (mut outside, mut inside, mut sum) = (0, 0u32, [0u32; 3]);
    for (i, pixel) in (0..targets.cameras.len()).filter_map(|i| Some((i, targets.pixel(i, point)?))) {
        if pixel[3] < OPAQUE {
            outside += 1;
        } else if i < targets.views {
            inside += 1;
            (0..3).for_each(|c| sum[c] += u32::from(pixel[c]));
        }
    }
    let color = if inside == 0 { [0.5; 3] } else { sum.map(|s| s as f32 / (255 * inside) as f32) };
    (outside, color)
}

/// The root mean square distance of each point to its three nearest others (fewer where there are fewer); infinite for
/// a point alone. Points are walked through in the order of their x, from each one outwards until x alone is too far.
fn neighbor_distances(points: &[DVec3]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.sort_by(|&a, &b| points[a].x.total_cmp(&points[b].x));
    let sorted: Vec<DVec3> = order.iter().map(|&i| points[i]).collect();
    let found: Vec<f64> = (0..sorted.len())
        .into_par_iter()
        .map(|i| {
            let mut nearest = [f64::INFINITY; 3]; // squared, ascending
            let mut visit = |other: &DVec3| {
                let gap = other.x - sorted[i].x;
                if gap * gap >= nearest[2] {
                    return false;
                }
                let d = sorted[i].distance_squared(*other);
                if d < nearest[2] {
                    nearest[2] = d;
                    nearest.sort_by(f64::total_cmp);
                }
                true
            };
            sorted[i + 1..].iter().all(&mut visit);
            sorted[..i].iter().rev().all(&mut visit);
            let known: Vec<f64> = nearest.into_iter().filter(|d| d.is_finite()).collect();
            if known.is_empty() { f64::INFINITY } else { (known.iter().sum::<f64>() / known.len() as f64).sqrt() }
        })
        .collect();
    let mut out = vec![0.0; points.len()];
    order.iter().zip(found).for_each(|(&i, d)| out[i] = d);
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::{ball, ring};
    use rand_chacha::rand_core::SeedableRng;

    #[test]
    fn neighbors_match_brute_force() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for n in [1, 2, 3, 4, 300] {
            let points: Vec<DVec3> = (0..n).map(|_| in_unit_ball(&mut rng)).collect();
            for (i, found) in neighbor_distances(&points).into_iter().enumerate() {
                let mut all: Vec<f64> =
                    (0..n).filter(|&j| j != i).map(|j| points[i].distance_squared(points[j])).collect();
                all.sort_by(f64::total_cmp);
                all.truncate(3);
                let expected =
                    if all.is_empty() { f64::INFINITY } else { (all.iter().sum::<f64>() / all.len() as f64).sqrt() };
                assert!(found == expected || (found - expected).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn starts_inside_the_masks() {
        let targets = Targets::new(&ring(6, 32, &ball(80, 1)), None).unwrap();
        let config = FitConfig { initial: 200, ..Default::default() };
        let cloud = random_cloud(&targets, &config, &mut ChaCha8Rng::seed_from_u64(1));
        assert_eq!(cloud.len(), 200);
        for i in 0..200 {
            assert_eq!(judge(&targets, cloud.mean(i)).0, 0);
            assert!(cloud.mean(i).length() <= config.radius + 1e-6);
            assert!((cloud.opacity(i) - config.initial_opacity).abs() < 1e-6);
        }
        assert!(cloud.check_finite().is_ok());
    }

    #[test]
    fn empty_masks_and_opaque_views_still_give_a_start() {
        let config = FitConfig { initial: 50, ..Default::default() };
        for alpha in [0, 255] {
            let mut views = ring(2, 16, &ball(10, 1));
            views.iter_mut().flat_map(|v| v.image.pixels_mut()).for_each(|p| p[3] = alpha);
            let targets = Targets::new(&views, None).unwrap();
            let cloud = random_cloud(&targets, &config, &mut ChaCha8Rng::seed_from_u64(1));
            assert_eq!(cloud.len(), 50);
            assert!(cloud.check_finite().is_ok());
        }
    }
}
