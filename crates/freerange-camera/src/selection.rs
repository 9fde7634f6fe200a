//! Which of an object's views are shown to the model and which only score it (METHOD.md, section 10).
//!
//! K-means on the camera centres; "full observation" shows one view of each cluster, "partial observation" only
//! views of one cluster, and one fixed, broad set of other views scores both.

use crate::CameraError;
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

/// k-means++ (Arthur and Vassilvitskii 2007): each next centre is drawn by its squared distance to those before it.
fn plus_plus(points: &[DVec3], k: usize, rng: &mut impl Rng) -> Vec<DVec3> {
    let mut centres = vec![points[rng.random_range(0..points.len())]];
    let mut nearest = vec![f64::INFINITY; points.len()];
    while centres.len() < k {
        let last = centres[centres.len() - 1];
        for (d, p) in nearest.iter_mut().zip(points) {
            *d = d.min(p.distance_squared(last));
        }
        let mut left = rng.random::<f64>() * nearest.iter().sum::<f64>();
        let chosen = nearest.iter().position(|d| {
            left -= d;
            left < 0.0
        });
        centres.push(points[chosen.unwrap_or(points.len() - 1)]);
    }
    centres
}

fn lloyd(points: &[DVec3], mut centres: Vec<DVec3>) -> (Vec<usize>, f64) {
    let mut labels = vec![usize::MAX; points.len()];
    for _ in 0..1000 {
        let next: Vec<usize> = points
            .iter()
            .map(|p| {
                let distance = |c: &usize| p.distance_squared(centres[*c]);
                (0..centres.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or(0)
            })
            .collect();
        let settled = next == labels;
        labels = next;
        for (c, centre) in centres.iter_mut().enumerate() {
            let own = points.iter().zip(&labels).filter(|(_, l)| **l == c).map(|(p, _)| *p);
            let (sum, count) = own.fold((DVec3::ZERO, 0), |(s, n), p| (s + p, n + 1));
            if count > 0 {
                *centre = sum / f64::from(count);
            }
        }
        if settled {
            break;
        }
    }
    let inertia = points.iter().zip(&labels).map(|(p, &l)| p.distance_squared(centres[l])).sum();
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
        return refuse("finite camera centres away from the object".into(), format!("camera {i} at {}", centers[i]));
    }
    if n < 2 * k {
        return refuse(format!("at least {} cameras for {k} inputs", 2 * k), format!("{n}"));
    }
    let mut rng = ChaCha8Rng::seed_from_u64(config.seed);
    let (labels, _) = k_means(centers, k, config.restarts, &mut rng);
    let members: Vec<Vec<usize>> = (0..k).map(|c| (0..n).filter(|&i| labels[i] == c).collect()).collect();
    if members.iter().any(Vec::is_empty) {
        return refuse(format!("at least {k} distinct camera centres"), "fewer".into());
    }

    let full: Vec<usize> = members
        .iter()
        .map(|own| {
            let mean = own.iter().map(|&i| centers[i]).sum::<DVec3>() / own.len() as f64;
            let distance = |i: &usize| centers[*i].distance_squared(mean);
            own.iter().copied().min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or(own[0])
        })
        .collect();
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
