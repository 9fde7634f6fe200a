//! Where the object is, as a quick fit tells it: better than masks alone, above all where no view is from behind.

use freerange_gaussians::{Gaussians, channel};
use freerange_raster::{CHANNELS, render, render_backward};
use freerange_scene::camera::{CANONICAL_RADIUS, Similarity, View, outline_radius};
use glam::{DQuat, DVec3};

use crate::{FitError, views::Targets};

/// Longest side, in pixels, of the renders that tell which Gaussians are seen.
const SIZE: u32 = 128;
/// Part of all that is seen that may lie beyond each face of the box. Of 0.25 to 2 %, the best for centers on generated
/// objects: less believes strays, more cuts handles off.
const BEYOND: f64 = 0.005;
/// The object's radius by that of its silhouettes: few views seldom have its farthest point on one. Of 1, 1.01 and 1.02
/// the best on generated objects.
const HIDDEN: f64 = 1.01;
/// Corrections beyond this factor on lengths mean that something else is wrong.
const MOST: f64 = 2.0;

/// The correction from a roughly canonical frame, in which both `cloud` and `views` lie, to one as training objects have
/// it: the box along the axes centerd, the farthest point at 0.5. Turns nothing.
///
/// The center is that of the box around what the views see of the cloud, each Gaussian counting by its blending
/// weights: where nothing is seen, a fit leaves Gaussians anywhere in the visual hull. The size is that of the masks'
/// silhouettes about this center: that of a box of Gaussians depends on how much of them is cut off. The identity where
/// there are fewer than two masks, or the cloud is empty, not finite, not seen, or nowhere near.
///
/// # Errors
/// For views that a fit would refuse.
pub fn frame_of(cloud: &Gaussians, views: &[View]) -> Result<Similarity, FitError> {
    let targets = Targets::new(views, Some(SIZE))?;
    if cloud.check_finite().is_err() {
        return Ok(Similarity::IDENTITY);
    }
    let seen = seen(cloud, &targets)?;
    let correction = box_center(cloud, &seen).and_then(|center| {
        // The rough frame's sphere holds the object: no other needs to exceed it by more than the way between them. A
        // speck in one mask may say so.
        let by_silhouette = outline_radius(views, center)?.min(CANONICAL_RADIUS + center.length());
        let scale = CANONICAL_RADIUS / (HIDDEN * by_silhouette);
        let near = center.length() < CANONICAL_RADIUS && (1.0 / MOST..=MOST).contains(&scale);
        near.then_some(Similarity { scale, rotation: DQuat::IDENTITY, translation: -scale * center })
    });
    Ok(correction.unwrap_or(Similarity::IDENTITY))
}

/// The sum of each Gaussian's blending weights over the pixels of all views: the derivative of the sum of one color's
/// pixels by that color of the Gaussian. `[n]`
fn seen(cloud: &Gaussians, targets: &Targets) -> Result<Vec<f64>, FitError> {
    let all: Vec<usize> = (0..targets.cameras.len()).collect();
    let mut seen = vec![0.0; cloud.len()];
    for (group, raster) in targets.groups(&all) {
        let cameras: Vec<_> = group.iter().map(|&i| targets.cameras[i]).collect();
        let output = render(cloud.rows(), &cameras, &vec![[0.0; 3]; group.len()], raster)?;
        let red: Vec<f32> = [1.0, 0.0, 0.0].into_iter().cycle().take(output.rgb.len()).collect();
        let gradients = render_backward(cloud.rows(), &output, &red, &[], &[])?.gaussians;
        let weights = gradients.as_chunks::<CHANNELS>().0.iter().map(|g| f64::from(g[channel::COLOR.start]).max(0.0));
        seen.iter_mut().zip(weights).for_each(|(sum, weight)| *sum += weight);
    }
    Ok(seen)
}

/// The center of the box along the axes around the Gaussians up to one standard deviation, weighted. None where nothing
/// weighs.
fn box_center(cloud: &Gaussians, weights: &[f64]) -> Option<DVec3> {
    let beyond = BEYOND * weights.iter().sum::<f64>();
    if beyond.is_nan() || beyond <= 0.0 {
        return None;
    }
    let deviations: Vec<DVec3> = (0..cloud.len())
        .map(|i| {
            let c = cloud.covariance(i);
            DVec3::new(c.x_axis.x, c.y_axis.y, c.z_axis.z).max(DVec3::ZERO).map(f64::sqrt)
        })
        .collect();
    // The place along `axis`, towards `sign`, that less than `beyond` lies beyond.
    let face = |axis: usize, sign: f64| {
        let place = |i: usize| sign * cloud.mean(i)[axis] + deviations[i][axis];
        let mut order: Vec<(f64, f64)> = (0..cloud.len()).map(|i| (place(i), weights[i])).collect();
        order.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut sum = 0.0;
        let found = order.iter().find(|(_, weight)| {
            sum += weight;
            sum >= beyond
        });
        found.map(|(place, _)| sign * place)
    };
    let middle = |axis: usize| Some(0.5 * (face(axis, 1.0)? + face(axis, -1.0)?));
    Some(DVec3::new(middle(0)?, middle(1)?, middle(2)?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::ring;

    /// Small opaque Gaussians on the surface of an ellipsoid.
    fn ellipsoid(center: DVec3, half: DVec3) -> Gaussians {
        let count = 2000;
        let mut cloud = Gaussians::default();
        for i in 0..count {
            let z = 1.0 - (2.0 * f64::from(i) + 1.0) / f64::from(count);
            let (angle, r) = (2.399_963 * f64::from(i), (1.0 - z * z).sqrt());
            let mut row = [0.0; channel::COUNT];
            let mean = center + half * DVec3::new(r * angle.cos(), r * angle.sin(), z);
            row[channel::MEAN].copy_from_slice(&mean.as_vec3().to_array());
            row[channel::LOG_SCALE].fill(-5.0);
            row[channel::ROTATION.start] = 1.0;
            row[channel::LOGIT_OPACITY] = 5.0;
            row[channel::COLOR].fill(0.5);
            cloud.push(&row);
        }
        cloud
    }

    #[test]
    fn a_known_box_is_found_and_stray_gaussians_do_not_matter() {
        let (center, half) = (DVec3::new(0.06, -0.04, 0.03), DVec3::new(0.4, 0.25, 0.2));
        let mut cloud = ellipsoid(center, half);
        let views = ring(8, 128, &cloud);
        let check = |cloud: &Gaussians| {
            let found = frame_of(cloud, &views).unwrap();
            assert_eq!(found.rotation, DQuat::IDENTITY);
            assert!((found.scale * HIDDEN * 0.4 / 0.5 - 1.0).abs() < 0.04, "{found:?}");
            assert!(found.apply(center).length() < 0.015, "{found:?}");
        };
        check(&cloud);
        // One far away, and many inside, where nothing sees them.
        let mut row = *cloud.row(0);
        row[channel::MEAN].copy_from_slice(&[0.7, 0.7, -0.2]);
        cloud.push(&row);
        row[channel::MEAN].copy_from_slice(&[0.2, 0.0, 0.05]);
        (0..500).for_each(|_| cloud.push(&row));
        check(&cloud);
    }

    #[test]
    fn a_moved_scene_ends_in_the_same_place() {
        let cloud = ellipsoid(DVec3::new(0.05, 0.02, -0.03), DVec3::new(0.2, 0.3, 0.35));
        let views = ring(5, 96, &cloud);
        let still = frame_of(&cloud, &views).unwrap();
        for (scale, x) in [(0.9, 0.05), (1.1, -0.1), (1.3, 0.0)] {
            let moved = Similarity { scale, rotation: DQuat::IDENTITY, translation: DVec3::new(x, -0.5 * x, 0.02) };
            let mut other = cloud.clone();
            other.transform(moved.scale, moved.rotation, moved.translation);
            let seen: Vec<View> =
                views.iter().map(|v| View { camera: v.camera.transformed(&moved), ..v.clone() }).collect();
            let total = frame_of(&other, &seen).unwrap().after(&moved);
            assert!((total.scale / still.scale - 1.0).abs() < 1e-3, "{total:?} {still:?}");
            assert!(total.translation.distance(still.translation) < 1e-3, "{total:?} {still:?}");
        }
    }

    #[test]
    fn what_tells_nothing_changes_nothing() {
        let cloud = ellipsoid(DVec3::ZERO, DVec3::splat(0.4));
        let views = ring(4, 48, &cloud);
        let same =
            |cloud: &Gaussians, views: &[View]| assert_eq!(frame_of(cloud, views).unwrap(), Similarity::IDENTITY);
        same(&Gaussians::default(), &views);
        same(&ellipsoid(DVec3::splat(50.0), DVec3::splat(0.4)), &views);
        let mut broken = cloud.clone();
        broken.rows_mut()[3] = f32::NAN;
        same(&broken, &views);
        let mut faint = cloud.clone();
        faint.iter_mut().for_each(|row| row[channel::LOGIT_OPACITY] = -20.0);
        same(&faint, &views);
        // No masks.
        let mut opaque = views.clone();
        opaque.iter_mut().flat_map(|v| v.image.pixels_mut()).for_each(|p| p[3] = 255);
        same(&cloud, &opaque);
        assert!(frame_of(&cloud, &[]).is_err());
    }
}
