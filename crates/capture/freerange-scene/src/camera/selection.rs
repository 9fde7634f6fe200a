//! Which of an object's views are shown to the model and which only score it.
//!
//! K-means on the camera centers; "full observation" shows one view of each cluster, "partial observation" only
//! views of one cluster, and one fixed, broad set of other views scores both.

use crate::camera::CameraError;
use glam::DVec3;
use rand::{Rng, SeedableRng, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;

/// How views are chosen.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(default)]
pub struct SelectionConfig {
    /// Number of clusters, and of input views. The paper's is 4.
    pub inputs: usize,
    /// Number of validation views, at most; fewer where the object has too few views.
    pub validation: usize,
    /// Restarts of k-means; the best is kept.
    pub restarts: usize,
    /// Seed of everything drawn here.
    pub seed: u64,
}

impl Default for SelectionConfig {
    fn default() -> Self {
        Self { inputs: 4, validation: 12, restarts: 10, seed: 0 }
    }
}

/// The chosen views, as indices into the cameras.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct ViewSets {
    /// The cluster of every camera.
    pub labels: Vec<usize>,
    /// Inputs that see the object from all around: one of each cluster.
    pub full: Vec<usize>,
    /// Inputs from one side: all of one cluster.
    pub partial: Vec<usize>,
    /// Views all around, none of them an input.
    pub validation: Vec<usize>,
}

/// Clusters points by Lloyd's iterations from k-means++ starts, the best of `restarts`: `(label of each point, sum of
/// squared distances to the own cluster's mean)`. Every label occurs where the points hold `k` distinct positions.
pub fn k_means(points: &[DVec3], k: usize, restarts: usize, rng: &mut impl Rng) -> (Vec<usize>, f64) {
    let mut best = (vec![0; points.len()], f64::INFINITY);
    for _ in 0..restarts.max(1) {
        let run = lloyd(points, plus_plus(points, k, rng));
        if run.1 < best.1 {
            best = run;
        }
    }
    best
}

/// k-means++ (Arthur and Vassilvitskii 2007): each next center is drawn by its squared distance to those before it.
fn plus_plus(points: &[DVec3], k: usize, rng: &mut impl Rng) -> Vec<DVec3> {
    let mut centers = vec![points[rng.random_range(0..points.len())]];
    let mut nearest = vec![f64::INFINITY; points.len()];
    while centers.len() < k {
        let last = centers[centers.len() - 1];
        for (d, p) in nearest.iter_mut().zip(points) {
            *d = d.min(p.distance_squared(last));
        }
        let mut left = rng.random::<f64>() * nearest.iter().sum::<f64>();
        let chosen = nearest.iter().position(|d| {
            left -= d;
            left < 0.0
        });
        centers.push(points[chosen.unwrap_or(points.len() - 1)]);
    }
    centers
}

fn lloyd(points: &[DVec3], mut centers: Vec<DVec3>) -> (Vec<usize>, f64) {
    let mut labels = vec![usize::MAX; points.len()];
    for _ in 0..1000 {
        let next: Vec<usize> = points
            .iter()
            .map(|p| {
                let distance = |c: &usize| p.distance_squared(centers[*c]);
                (0..centers.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or(0)
            })
            .collect();
        let settled = next == labels;
        labels = next;
        for (c, center) in centers.iter_mut().enumerate() {
            let own = points.iter().zip(&labels).filter(|(_, l)| **l == c).map(|(p, _)| *p);
            let (sum, count) = own.fold((DVec3::ZERO, 0), |(s, n), p| (s + p, n + 1));
            if count > 0 {
                *center = sum / f64::from(count);
            }
        }
        if settled {
            break;
        }
    }
    let inertia = points.iter().zip(&labels).map(|(p, &l)| p.distance_squared(centers[l])).sum();
    (labels, inertia)
}

/// Chooses inputs and validation views among cameras at `centers`, for an object at `target`.
///
/// The validation views are spread by farthest-point sampling of the viewing directions, after the inputs are set
/// aside; each cluster's input is the camera nearest to its mean, and the partial set is drawn from a cluster drawn
/// among those that have enough cameras.
pub fn select_views(centers: &[DVec3], target: DVec3, config: &SelectionConfig) -> Result<ViewSets, CameraError> {
    let (n, k) = (centers.len(), config.inputs);
    let refuse = |expected: String, found: String| Err(CameraError::Selection { expected, found });
    if k < 2 || config.validation == 0 {
        return refuse("at least 2 inputs and 1 validation view".into(), format!("{k} and {}", config.validation));
    }
    if let Some(i) = centers.iter().position(|c| !c.is_finite() || *c == target) {
        return refuse("finite camera centers away from the object".into(), format!("camera {i} at {}", centers[i]));
    }
    if n < 2 * k {
        return refuse(format!("at least {} cameras for {k} inputs", 2 * k), format!("{n}"));
    }
    let mut rng = ChaCha8Rng::seed_from_u64(config.seed);
    let (labels, _) = k_means(centers, k, config.restarts, &mut rng);
    let members: Vec<Vec<usize>> = (0..k).map(|c| (0..n).filter(|&i| labels[i] == c).collect()).collect();
    if members.iter().any(Vec::is_empty) {
        return refuse(format!("at least {k} distinct camera centers"), "fewer".into());
    }

    let full: Vec<usize> = members.iter().map(|own| nearest_to_mean(centers, own)).collect();
    let large: Vec<&Vec<usize>> = members.iter().filter(|own| own.len() >= k).collect();
    if large.is_empty() {
        return refuse(format!("a cluster of at least {k} cameras"), "only smaller clusters".into());
    }
    let mut drawn = large[rng.random_range(0..large.len())].clone();
    drawn.shuffle(&mut rng);
    let mut partial = drawn[..k].to_vec();
    partial.sort_unstable();

    let directions: Vec<DVec3> = centers.iter().map(|c| (*c - target).normalize()).collect();
    let free: Vec<usize> = (0..n).filter(|i| !full.contains(i) && !partial.contains(i)).collect();
    let validation = farthest(&directions, &free, config.validation);
    if validation.is_empty() {
        return refuse("a camera that is no input, for validation".into(), format!("{n} cameras, all inputs"));
    }
    Ok(ViewSets { labels, full, partial, validation })
}

/// The member that is nearest to the mean of the members' centers. `members` is not empty.
fn nearest_to_mean(centers: &[DVec3], members: &[usize]) -> usize {
    let mean = members.iter().map(|&i| centers[i]).sum::<DVec3>() / members.len() as f64;
    let distance = |i: &usize| centers[*i].distance_squared(mean);
    members.iter().copied().min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or(members[0])
}

/// `count` inputs among `candidates` that see the object from all around: the candidates' centers in `count` clusters by
/// [`k_means`], and of each the camera nearest to its mean. Sorted.
///
/// # Errors
/// [`CameraError::Selection`] where the candidates have fewer than `count` distinct centers.
pub fn inputs_around(
    centers: &[DVec3],
    candidates: &[usize],
    count: usize,
    restarts: usize,
    seed: u64,
) -> Result<Vec<usize>, CameraError> {
    let refuse = |found: String| {
        Err(CameraError::Selection {
            expected: format!("at least {count} input views that are no validation views"),
            found,
        })
    };
    if count == 0 || candidates.len() < count {
        return refuse(candidates.len().to_string());
    }
    let points: Vec<DVec3> = candidates.iter().map(|&i| centers[i]).collect();
    if let Some(at) = points.iter().position(|c| !c.is_finite()) {
        return refuse(format!("camera {} at {}", candidates[at], points[at]));
    }
    let (labels, _) = k_means(&points, count, restarts, &mut ChaCha8Rng::seed_from_u64(seed));
    let mut chosen = Vec::with_capacity(count);
    for cluster in 0..count {
        let own: Vec<usize> = candidates.iter().zip(&labels).filter(|(_, l)| **l == cluster).map(|(&i, _)| i).collect();
        if own.is_empty() {
            return refuse("some with the same center".into());
        }
        chosen.push(nearest_to_mean(centers, &own));
    }
    chosen.sort_unstable();
    Ok(chosen)
}

/// `count` inputs among `candidates` from the side that the views `side` see: the cameras nearest to the mean of the
/// centers of `side`, none of them farther from it than the farthest of `side`. Sorted; for fewer inputs, a part of those for
/// more.
///
/// # Errors
/// [`CameraError::Selection`] where fewer than `count` candidates are on that side.
pub fn inputs_beside(
    centers: &[DVec3],
    candidates: &[usize],
    side: &[usize],
    count: usize,
) -> Result<Vec<usize>, CameraError> {
    let mean = side.iter().map(|&i| centers[i]).sum::<DVec3>() / side.len().max(1) as f64;
    let distance = |i: usize| centers[i].distance(mean);
    let reach = side.iter().map(|&i| distance(i)).fold(0.0, f64::max) * (1.0 + 1e-9);
    let mut near: Vec<usize> = candidates.iter().copied().filter(|&i| distance(i) <= reach).collect();
    if count == 0 || near.len() < count {
        let expected = format!("at least {count} input views on the side of the partial set");
        return Err(CameraError::Selection { expected, found: near.len().to_string() });
    }
    near.sort_by(|&a, &b| distance(a).total_cmp(&distance(b)).then(a.cmp(&b)));
    near.truncate(count);
    near.sort_unstable();
    Ok(near)
}

/// Up to `count` of the candidates, each next one as far from those before it as can be; sorted.
fn farthest(directions: &[DVec3], candidates: &[usize], count: usize) -> Vec<usize> {
    let mut chosen: Vec<usize> = candidates.first().copied().into_iter().collect();
    while chosen.len() < count.min(candidates.len()) {
        let gap = |i: &usize| {
            chosen.iter().map(|&c| directions[*i].distance_squared(directions[c])).fold(f64::INFINITY, f64::min)
        };
        let next = candidates.iter().copied().filter(|i| !chosen.contains(i));
        chosen.extend(next.max_by(|a, b| gap(a).total_cmp(&gap(b)).then(b.cmp(a))));
    }
    chosen.sort_unstable();
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cameras on a circle of radius 2, a degree apart from each other within groups of five at 0, 90, 180, 270 degrees.
    fn groups() -> Vec<DVec3> {
        let place = |i: usize| f64::from((i / 5 * 90 + i % 5) as u32).to_radians();
        (0..20).map(|i| 2.0 * DVec3::new(place(i).cos(), place(i).sin(), 0.1)).collect()
    }

    #[test]
    fn inputs_around_are_the_middles_of_the_groups_and_never_anything_but_candidates() {
        let centers = groups();
        let all: Vec<usize> = (0..20).collect();
        assert_eq!(inputs_around(&centers, &all, 4, 10, 0).unwrap(), [2, 7, 12, 17]);
        let some = [0, 1, 5, 10, 11, 15];
        for count in 1..=6 {
            let chosen = inputs_around(&centers, &some, count, 10, 1).unwrap();
            assert_eq!(chosen.len(), count);
            assert!(chosen.iter().all(|i| some.contains(i)) && chosen.is_sorted());
            assert_eq!(chosen, inputs_around(&centers, &some, count, 10, 1).unwrap());
        }
        // As many as there are groups: one of each.
        let quarters: Vec<usize> = inputs_around(&centers, &some, 4, 10, 2).unwrap().iter().map(|i| i / 5).collect();
        assert_eq!(quarters, [0, 1, 2, 3]);
    }

    #[test]
    fn too_few_or_coinciding_candidates_are_refused() {
        let centers = groups();
        let refused = |r: Result<Vec<usize>, CameraError>| matches!(r, Err(CameraError::Selection { .. }));
        assert!(refused(inputs_around(&centers, &[0, 1, 2], 4, 10, 0)));
        assert!(refused(inputs_around(&centers, &[], 1, 10, 0)));
        assert!(refused(inputs_around(&centers, &[0, 1], 0, 10, 0)));
        assert!(refused(inputs_around(&[DVec3::X; 4], &[0, 1, 2, 3], 2, 10, 0)));
        assert!(refused(inputs_around(&[DVec3::X, DVec3::NAN, DVec3::Y], &[0, 1, 2], 2, 10, 0)));
    }

    #[test]
    fn inputs_beside_stay_on_the_side_and_grow_by_addition() {
        let centers = groups();
        let all: Vec<usize> = (0..20).collect();
        let side = [5, 6, 8, 9];
        let mut before = Vec::new();
        for count in 1..=5 {
            let chosen = inputs_beside(&centers, &all, &side, count).unwrap();
            assert!(
                chosen.iter().all(|i| (5..10).contains(i)) && before.iter().all(|i| chosen.contains(i)),
                "{chosen:?}"
            );
            before = chosen;
        }
        assert_eq!(before, [5, 6, 7, 8, 9]);
        let refused = inputs_beside(&centers, &all, &side, 6);
        assert!(matches!(refused, Err(CameraError::Selection { ref found, .. }) if found == "5"), "{refused:?}");
        assert!(inputs_beside(&centers, &all, &[], 1).is_err());
    }
}
