//! Other objects that an object of the training data makes as well: turned by quarters about the upright axis, mirrored,
//! its colors exchanged. Gaussians, photos and what was fitted to them change together, and exactly: a fit of the
//! mirrored photos is the mirrored fit.

use freerange_gaussians::{Gaussians, channel};
use freerange_scene::camera::{Camera, View};
use glam::{DMat3, DMat4, DVec3};
use image::{RgbaImage, imageops::flip_horizontal_in_place};
use rand::{Rng, seq::SliceRandom};

use crate::config::Symmetries;
use freerange_diffusion::coupling::separating_axis;

/// One way to look at an object: an element of the group.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Symmetry {
    /// New axis i is the old axis `axes[i]`; z stays.
    axes: [usize; 3],
    /// Whether new axis i points against the old one.
    flipped: [bool; 3],
    /// New color channel i is the old channel `colors[i]`.
    colors: [usize; 3],
}

impl Symmetry {
    /// The object as it is.
    pub const IDENTITY: Self = Self { axes: [0, 1, 2], flipped: [false; 3], colors: [0, 1, 2] };

    /// One of those that are `allowed`, each as likely as any. Draws nothing where none is.
    pub fn draw(allowed: Symmetries, rng: &mut impl Rng) -> Self {
        let mut drawn = Self::IDENTITY;
        if allowed.space {
            drawn.axes[..2].shuffle(rng);
            drawn.flipped = [rng.random(), rng.random(), false];
        }
        if allowed.color {
            drawn.colors.shuffle(rng);
        }
        drawn
    }

    /// New coordinates from old ones: a signed permutation.
    fn matrix(self) -> DMat3 {
        let row = |i: usize| DVec3::AXES[self.axes[i]] * if self.flipped[i] { -1.0 } else { 1.0 };
        DMat3::from_cols(row(0), row(1), row(2)).transpose()
    }

    fn mirrors(self) -> bool {
        self.matrix().determinant() < 0.0
    }

    /// The Gaussians so changed, one by one.
    pub fn gaussians(self, cloud: &Gaussians) -> Gaussians {
        let mut cloud = cloud.clone();
        if self == Self::IDENTITY {
            return cloud;
        }
        let handed = if self.mirrors() { -1.0 } else { 1.0 };
        let sign = self.flipped.map(|f| if f { -1.0f32 } else { 1.0 });
        for row in cloud.iter_mut() {
            let old = *row;
            for i in 0..3 {
                let from = self.axes[i];
                row[channel::MEAN.start + i] = sign[i] * old[channel::MEAN.start + from];
                // R' = G R G^T and S' = G S G^T: axes keep the names that are closest to the world's.
                row[channel::LOG_SCALE.start + i] = old[channel::LOG_SCALE.start + from];
                row[channel::ROTATION.start + 1 + i] = handed * sign[i] * old[channel::ROTATION.start + 1 + from];
                row[channel::COLOR.start + i] = old[channel::COLOR.start + self.colors[i]];
            }
        }
        cloud
    }

    /// In which order Gaussians (a power of two, in that of their tree) are in tree order afterwards: of two halves the one
    /// with the smaller coordinate stays first.
    pub fn order(self, cloud: &Gaussians) -> Vec<usize> {
        let turned_round: [bool; 3] =
            std::array::from_fn(|old| (0..3).any(|new| self.axes[new] == old && self.flipped[new]));
        let mut order: Vec<usize> = (0..cloud.len()).collect();
        if turned_round == [false; 3] {
            return order;
        }
        // Bottom up, so that a node's halves are already as they will be when they change places.
        let mut count = 2;
        while count <= order.len() {
            for (k, node) in order.chunks_exact_mut(count).enumerate() {
                if turned_round[separating_axis(cloud.rows(), k * count, count)] {
                    node.rotate_left(count / 2);
                }
            }
            count *= 2;
        }
        order
    }

    /// What the same camera, changed with the object, sees. A mirrored object is seen in a mirrored picture.
    pub fn view(self, view: &View) -> View {
        if self == Self::IDENTITY {
            return view.clone();
        }
        let mut image: RgbaImage = view.image.clone();
        let mut camera: Camera = view.camera;
        let mut before = DMat4::IDENTITY;
        if self.mirrors() {
            flip_horizontal_in_place(&mut image);
            before = DMat4::from_scale(DVec3::new(-1.0, 1.0, 1.0));
            camera.cx = f64::from(camera.width) - camera.cx;
        }
        camera.world_to_camera = before * camera.world_to_camera * DMat4::from_mat3(self.matrix().transpose());
        if self.colors != Self::IDENTITY.colors {
            for pixel in image.pixels_mut() {
                let old = pixel.0;
                for (i, &from) in self.colors.iter().enumerate() {
                    pixel.0[i] = old[from];
                }
            }
        }
        View { name: view.name.clone(), camera, image }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use freerange_diffusion::coupling::Coupling;
    use freerange_raster::{RasterConfig, reference};
    use freerange_scene::camera::image_ops::to_f32_rgba;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    /// Gaussians of all shapes, in tree order.
    fn example(n: usize) -> Gaussians {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut rows: Vec<f32> = (0..n)
            .flat_map(|_| {
                let mut row = [0f32; channel::COUNT];
                row[channel::MEAN].fill_with(|| rng.random_range(-0.4..0.4));
                row[channel::LOG_SCALE].fill_with(|| rng.random_range(-4.0..-2.0));
                row[channel::ROTATION].fill_with(|| rng.random_range(-1.0..1.0));
                row[channel::LOGIT_OPACITY] = rng.random_range(-1.0..3.0);
                row[channel::COLOR].fill_with(|| rng.random_range(0.0..1.0));
                row
            })
            .collect();
        Coupling::Tree.group(&mut rows);
        Gaussians::from_rows(rows)
    }

    fn all() -> Vec<Symmetry> {
        let mut found: Vec<Symmetry> = Vec::new();
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for _ in 0..2000 {
            let drawn = Symmetry::draw(Symmetries { space: true, color: true }, &mut rng);
            if !found.contains(&drawn) {
                found.push(drawn);
            }
        }
        found
    }

    #[test]
    fn pictures_and_gaussians_change_alike() {
        let cloud = example(32);
        let mut camera = Camera::look_at(DVec3::new(1.1, -0.9, 0.7), DVec3::ZERO, DVec3::Z, 0.9, 24, 20);
        camera.cx += 1.25;
        let photo = |cloud: &Gaussians, camera: Camera| {
            let drawn = reference::render(cloud.rows(), &camera, [0.0; 3], &RasterConfig::default());
            let pixels = drawn.rgb.chunks(3).zip(&drawn.alpha);
            let bytes = pixels.flat_map(|(c, a)| [c[0], c[1], c[2], *a].map(|v| (v * 255.0).round() as u8)).collect();
            View { name: "a".into(), camera, image: RgbaImage::from_raw(camera.width, camera.height, bytes).unwrap() }
        };
        let before = photo(&cloud, camera);
        let all = all();
        assert_eq!(all.len(), 48);
        for symmetry in all {
            let seen = symmetry.view(&before);
            let made = photo(&symmetry.gaussians(&cloud), seen.camera);
            let (seen, made) = (to_f32_rgba(&seen.image), to_f32_rgba(&made.image));
            let worst = seen.iter().zip(&made).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 1.5 / 255.0, "{symmetry:?}: {worst}");
            let rotation = DMat3::from_mat4(symmetry.view(&before).camera.world_to_camera);
            assert!((rotation.determinant() - 1.0).abs() < 1e-12, "{symmetry:?}: a camera is never mirrored");
        }
    }

    #[test]
    fn the_order_is_that_of_the_tree_again() {
        let cloud = example(64);
        for symmetry in all() {
            let order = symmetry.order(&cloud);
            let mut sorted = order.clone();
            sorted.sort_unstable();
            assert!(sorted.into_iter().eq(0..64), "{symmetry:?}");
            let changed = symmetry.gaussians(&cloud).select(order);
            let ascending = |count: usize, k: usize| {
                let a = separating_axis(changed.rows(), k * count, count);
                let half = |first: usize| {
                    (first..first + count / 2)
                        .map(|i| changed.mean(i)[a])
                        .fold((f64::MAX, f64::MIN), |(l, h), x| (l.min(x), h.max(x)))
                };
                half(k * count).1 <= half(k * count + count / 2).0
            };
            for count in [2, 4, 8, 16, 32, 64] {
                for k in 0..64 / count {
                    assert!(ascending(count, k), "{symmetry:?}: node {k} of {count}");
                }
            }
        }
    }

    #[test]
    fn what_is_not_allowed_is_not_drawn() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let untouched = rng.clone();
        assert_eq!(Symmetry::draw(Symmetries::default(), &mut rng), Symmetry::IDENTITY);
        assert_eq!(rng, untouched);
        for _ in 0..50 {
            let space = Symmetry::draw(Symmetries { space: true, color: false }, &mut rng);
            let color = Symmetry::draw(Symmetries { space: false, color: true }, &mut rng);
            assert_eq!(space.colors, [0, 1, 2]);
            assert_eq!((color.axes, color.flipped), ([0, 1, 2], [false; 3]));
        }
    }
}
