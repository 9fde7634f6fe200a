//! Points that two photos see, moved to where these agree: a plane sweep along normals (Collins 1996).

use super::{Seen, look::sample, smooth::Cubes};
use freerange_camera::View;
use glam::DVec3;
use rayon::prelude::*;

/// Places that are tried on either side of each point.
const OFFSETS: i32 = 12;
/// Samples of a patch on either side of its middle, in both directions.
const PATCH: i32 = 2;
/// Costs are averaged over points so near, in spacings.
const SHARED: f64 = 3.0;
/// Costs that differ by less, as a variance of brightness, say nothing: noise of 8-bit photos.
const NOISE: f64 = 1e-4;

/// Each point that at least two photos see, moved along its normal by up to `reach` to where the print of the photos agrees best around it and its neighbors. Points that no two photos see, and those where all places are about as good, stay.
pub(crate) fn sweep(seen: &[Seen], spacing: f64, reach: f64, photos: &[View]) -> Vec<Seen> {
    let offset = |k: usize| (k as i32 - OFFSETS) as f64 / f64::from(OFFSETS) * reach;
    let tried = 2 * OFFSETS as usize + 1;
    let costs: Vec<Option<Vec<f64>>> = seen
        .par_iter()
        .map(|s| {
            let cost = |k| disagreement(s, s.point.place + offset(k) * s.point.normal, spacing, photos);
            (s.photos.len() > 1).then(|| (0..tried).map(cost).collect::<Option<Vec<f64>>>()).flatten()
        })
        .collect();
    let cubes = Cubes::new(seen.iter().map(|s| s.point.place), SHARED * spacing);
    let moved = |s: &Seen| {
        let mut s = s.clone();
        if s.photos.len() < 2 {
            return s;
        }
        let (mut sum, mut count) = (vec![0.0; tried], 0);
        for other in cubes.near(s.point.place).filter_map(|i| costs[i].as_ref()) {
            sum.iter_mut().zip(other).for_each(|(sum, cost)| *sum += cost);
            count += 1;
        }
        let best = (0..tried).min_by(|&a, &b| sum[a].total_cmp(&sum[b])).unwrap_or(OFFSETS as usize);
        let worst = sum.iter().copied().fold(0.0, f64::max);
        if worst - sum[best] <= NOISE * f64::from(count) {
            return s;
        }
        // The parabola through it and its neighbors; at the ends of the stretch nothing says that it is there.
        if best > 0 && best + 1 < tried {
            let (before, at, after) = (sum[best - 1], sum[best], sum[best + 1]);
            let bend = before - 2.0 * at + after;
            let part = if bend > 0.0 { 0.5 * (before - after) / bend } else { 0.0 };
            s.point.place += (offset(best) + part * reach / f64::from(OFFSETS)) * s.point.normal;
        }
        s
    };
    seen.par_iter().map(moved).collect()
}

/// The variance of the difference between the brightness of a patch in one photo and in another, mean over pairs of those that see it; `None`
/// outside of a photo.
fn disagreement(s: &Seen, place: DVec3, spacing: f64, photos: &[View]) -> Option<f64> {
    let side = s.point.normal.any_orthonormal_vector();
    let up = s.point.normal.cross(side);
    let patches = s.photos.iter().map(|&(i, _)| {
        let at = |k: i32| {
            let (u, v) = (k % (2 * PATCH + 1) - PATCH, k / (2 * PATCH + 1) - PATCH);
            let [r, g, b, _] = sample(&photos[i], place + 0.5 * spacing * (f64::from(u) * side + f64::from(v) * up))?;
            Some(f64::from(0.299 * r + 0.587 * g + 0.114 * b))
        };
        (0..(2 * PATCH + 1).pow(2)).map(at).collect::<Option<Vec<f64>>>()
    });
    let patches = patches.collect::<Option<Vec<_>>>()?;
    let variance = |a: &[f64], b: &[f64]| {
        let differences = || a.iter().zip(b).map(|(a, b)| a - b);
        let mean = differences().sum::<f64>() / a.len() as f64;
        differences().map(|d| (d - mean).powi(2)).sum::<f64>() / a.len() as f64
    };
    let pairs = patches.iter().enumerate().flat_map(|(i, a)| patches[..i].iter().map(move |b| (a, b)));
    let (sum, count) = pairs.fold((0.0, 0), |(sum, count), (a, b)| (sum + variance(a, b), count + 1));
    (count > 0).then(|| sum / f64::from(count))
}
