//! One opaque layer of flat Gaussians where photos look, beside what is there elsewhere.

use super::{Seen, look::disc, smooth::Cubes};
use crate::LayerConfig;
use freerange_splat::{Cloud, channel};
use glam::DVec3;

/// Other Gaussians whose centers are nearer to the layer go, in spacings of the layer.
const CLEAR: f64 = 2.0;

/// The first Gaussians of a cloud, which lie on a surface and stay there.
#[derive(Debug, Default)]
pub(crate) struct Layer {
    /// Unit normals of the surface, one for each of them.
    normals: Vec<DVec3>,
    along: f64,
    across: f64,
    free: bool,
}

impl Layer {
    /// Gaussians on the points that photos see, before those of `cloud` that are elsewhere.
    pub fn on(cloud: &Cloud, seen: &[Seen], spacing: f64, config: &LayerConfig) -> (Cloud, Self) {
        let points: Vec<&Seen> = seen.iter().filter(|s| !s.photos.is_empty()).collect();
        let cubes = Cubes::new(points.iter().map(|s| s.point.place), CLEAR * spacing);
        let mut all = Cloud::default();
        points.iter().for_each(|s| all.push(&disc(&s.point, spacing, s.color)));
        let elsewhere = (0..cloud.len()).filter(|&i| cubes.near(cloud.mean(i)).next().is_none());
        elsewhere.for_each(|i| all.push(cloud.row(i)));
        let normals = points.iter().map(|s| s.point.normal).collect();
        (all, Self { normals, along: config.along, across: config.across, free: config.free })
    }

    /// How many they are.
    pub fn len(&self) -> usize {
        self.normals.len()
    }

    /// The rows that a step may not change as it likes, to be kept over it: those of the layer, and others unless these are free.
    pub fn rows(&self, cloud: &Cloud) -> Vec<[f32; channel::COUNT]> {
        let all = self.len() > 0 && !self.free;
        cloud.iter().take(if all { usize::MAX } else { self.len() }).copied().collect()
    }

    /// Undoes what a step did to them but for colors, as much of the layer's moves as is allowed, and the others' opacities.
    pub fn keep(&self, cloud: &mut Cloud, before: &[[f32; channel::COUNT]]) {
        let place = |row: &[f32; channel::COUNT]| DVec3::from_array(std::array::from_fn(|i| f64::from(row[i])));
        for ((row, before), normal) in cloud.iter_mut().zip(before).zip(&self.normals) {
            let moved = place(row) - place(before);
            let along = normal.dot(moved) * *normal;
            let at = place(before) + self.along * along + self.across * (moved - along);
            let color: [f32; 3] = std::array::from_fn(|i| row[channel::COLOR.start + i]);
            *row = *before;
            row[channel::MEAN].copy_from_slice(&at.as_vec3().to_array());
            row[channel::COLOR].copy_from_slice(&color);
        }
        for (row, before) in cloud.iter_mut().zip(before).skip(self.len()) {
            row[..channel::LOGIT_OPACITY].copy_from_slice(&before[..channel::LOGIT_OPACITY]);
        }
    }
}
