//! The photometric loss between renders of Gaussians and images, and its gradient.

use burn::tensor::{Device, Tensor};
use freerange_gaussians::{Normalization, channel};
use freerange_model::{ModelKind, OBSERVATION};
use freerange_raster::{RasterConfig, rasterize};

use crate::{FlowError, place::place, targets::Targets};

/// Renders Gaussians given in the network's normalized parameter space, differentiably.
#[derive(Clone, Debug)]
pub struct Photometric {
    mean: Tensor<3>, // [1, 1, 14]
    std: Tensor<3>,  // [1, 1, 14]
}

/// Longest side of an image, in pixels, at which the rasterizer's screen-space blur means what it does in a viewer.
const VIEWER_SIZE: f32 = 512.0;

impl Photometric {
    /// For Gaussians normalized by `normalization`, on `device`.
    pub fn new(normalization: &Normalization, device: &Device) -> Self {
        let row = |x: &[f32; 14]| Tensor::<1>::from_floats(*x, device).reshape([1, 1, 14]);
        Self { mean: row(&normalization.mean), std: row(&normalization.std) }
    }

    /// Raw channels from normalized ones. `[b, n, 14]`
    pub fn denormalize(&self, normalized: Tensor<3>) -> Tensor<3> {
        normalized * self.std.clone() + self.mean.clone()
    }

    /// Raw channels of what a model of this kind predicts in one pass. `[b, n, 14]`
    pub fn raw(&self, kind: ModelKind, predicted: Tensor<3>) -> Tensor<3> {
        match kind {
            ModelKind::PixelAligned | ModelKind::VoxelAligned => predicted,
            ModelKind::FlowMatching | ModelKind::LatentTokens => self.denormalize(predicted),
        }
    }

    /// L1 between the renders of `normalized` (`[b, n, 14]`) and the targets: see [`l1_raw`](Self::l1_raw). Returns `[b]`.
    pub fn l1(&self, normalized: Tensor<3>, targets: &Targets) -> Result<Tensor<1>, FlowError> {
        self.l1_raw(self.denormalize(normalized), targets)
    }

    /// L1 between the renders of Gaussians that are not normalized (`[b, n, 14]`) and the targets: the mean over views,
    /// pixels and channels for each object. Returns `[b]`.
    pub fn l1_raw(&self, gaussians: Tensor<3>, targets: &Targets) -> Result<Tensor<1>, FlowError> {
        let [_, _, h, w, _] = targets.images.dims();
        let raster = RasterConfig::default().shrunk(h.max(w) as f32 / VIEWER_SIZE);
        let render = rasterize(gaussians, &targets.cameras, &targets.backgrounds, &raster)?; // [b, v, h, w, 4]
        let [b, v, h, w, _] = render.dims();
        let difference = render.narrow(4, 0, 3) - targets.images.clone();
        Ok(difference.abs().reshape([b, v * h * w * 3]).mean_dim(1).reshape([b]))
    }

    /// The gradient of each object's L1 with respect to its normalized Gaussians, cut off from any graph. `[b, n, 14]`
    pub fn gradient(&self, normalized: Tensor<3>, targets: &Targets) -> Result<Tensor<3>, FlowError> {
        let leaf = normalized.inner().autodiff().require_grad();
        // Each object's loss depends on its own Gaussians alone: the gradient of the sum is every gradient at once.
        let mut gradients = self.l1(leaf.clone(), targets)?.sum().backward();
        leaf.grad_remove(&mut gradients).ok_or(FlowError::NoGradient)
    }

    /// What the views show of each Gaussian of `normalized` (`[b, n, 14]`): `[b, n, channels]`, about one unit large; 9 channels, or 32 with
    /// where it lies.
    ///
    /// A Gaussian weighs in a pixel what blending gives it there. Summed over a view, these weights `w` say how much of it is
    /// seen, and the colors they lie on what it should look like. The channels are
    /// - 0: the logarithm of 1 + the sum of `w` over all views, in pixels, halved;
    /// - 1: how many views see it, `w / (w + 1)` summed over views, halved;
    /// - 2: how much of what is seen lies beside the object, 0 to 1;
    /// - 3 to 5: the object's color there, averaged over views, less the Gaussian's own, in normalized units;
    /// - 6 to 8: its standard deviation between views, in normalized units: large where views do not see the same surface.
    ///
    /// Where nothing is seen, these are 0.
    ///
    /// Where its center lies, by the pixel of each view that shows it (`model.place_channels`):
    /// - 9, 10: distance to the outline, positive within: least of all views, and mean, in tenths of a unit;
    /// - 11, 12: how far behind the rendered surface: least of all views, and mean, in tenths of a unit;
    /// - 13 to 15: the photos' colors there, averaged over views that show the object, less the Gaussian's own, in normalized units;
    /// - 16 to 18: their standard deviation between views, in normalized units;
    /// - 19 to 21: the way to the outlines of the views in which it lies beside them, mean over all views, in twentieths of a unit;
    /// - 22 to 28: of the view that sees it best, how unlike the colors are in which the others see points on its ray, 0.04, 0.02 and 0.01
    ///   before and 0.01, 0.02 and 0.04 behind the center, five times as much as at the center less; and twice that at the center;
    /// - 29 to 31: the direction of that ray. Where no view sees it, all from 22 on are 0.
    pub fn observe(&self, normalized: Tensor<3>, targets: &Targets, channels: usize) -> Result<Tensor<3>, FlowError> {
        let [b, n, c] = normalized.dims();
        let [_, v, h, w, _] = targets.object.dims();
        let gaussians = self.denormalize(normalized.inner());
        let own = gaussians.clone().narrow(2, channel::COLOR.start, 3);
        // Every view is an object of its own, so that sums are over its pixels alone. What blending is linear in, the colors,
        // has as its gradient the sums of weights times whatever the images of a linear loss hold.
        let each = gaussians.clone().unsqueeze_dim::<4>(1).repeat_dim(1, v).reshape([b * v, n, c]);
        let cameras: Vec<_> = targets.cameras.iter().flatten().map(|&camera| vec![camera]).collect();
        let raster = RasterConfig::default().shrunk(w.max(h) as f32 / VIEWER_SIZE);
        let weigh = |pixels: Tensor<5>| {
            let leaf = each.clone().autodiff().require_grad();
            let render = rasterize(leaf.clone(), &cameras, &vec![vec![[0.0; 3]]; b * v], &raster)?;
            let linear = render.narrow(4, 0, 3) * pixels.reshape([b * v, 1, h, w, 3]).autodiff();
            let gradient = leaf.grad_remove(&mut linear.sum().backward()).ok_or(FlowError::NoGradient)?;
            Ok::<_, FlowError>(gradient.narrow(2, channel::COLOR.start, 3).reshape([b, v, n, 3]))
        };
        let colors = weigh(targets.object.clone().narrow(4, 0, 3))?;
        let alpha = targets.object.clone().narrow(4, 3, 1);
        let sums = weigh(Tensor::cat(vec![alpha.ones_like(), alpha.clone(), alpha], 4))?;
        let (seen, covered) = (sums.clone().narrow(3, 0, 1), sums.narrow(3, 1, 1)); // [b, v, n, 1]

        let over_views = |x: Tensor<4>| x.sum_dim(1).squeeze_dim::<3>(1); // [b, n, ..]
        let (total, inside) = (over_views(seen.clone()), over_views(covered.clone()));
        let any = inside.clone().greater_elem(LEAST_SEEN).float();
        let divisor = inside.clone().clamp_min(LEAST_SEEN);
        let mean = over_views(colors.clone()) / divisor.clone(); // [b, n, 3]
        // Each view's own mean, weighed by how much of the Gaussian it sees.
        let of_view = colors / covered.clone().clamp_min(LEAST_SEEN);
        let apart = (of_view - mean.clone().unsqueeze_dim::<4>(1)).square() * covered;
        let deviation = (over_views(apart) / divisor).sqrt();
        let unit = self.std.clone().narrow(2, channel::COLOR.start, 3);
        let mut all = vec![
            (total.clone() + 1.0).log().mul_scalar(0.5),
            over_views(seen.clone() / (seen + 1.0)).mul_scalar(0.5),
            (total.clone() - inside) / total.clamp_min(LEAST_SEEN),
            (mean - own) / unit.clone() * any.clone(),
            deviation / unit.clone() * any,
        ];
        if channels > OBSERVATION {
            let unit = unit.into_data().convert::<f32>().try_to_vec::<f32>().expect("floats");
            all.push(place(gaussians, unit.try_into().expect("three"), targets, &raster)?);
        }
        Ok(Tensor::cat(all, 2))
    }
}

/// Weights that sum to less than this many pixels are nothing seen.
const LEAST_SEEN: f32 = 0.01;

#[cfg(test)]
mod tests {
    use burn::tensor::TensorData;
    use freerange_scene::camera::{Camera, View};
    use glam::DVec3;
    use image::{Rgba, RgbaImage};

    use super::*;
    use crate::targets::Images;

    /// Over the pixels of a view, sums of what Gaussian `i` weighs in them: its weight, that on the object, that times the colors.
    fn sums_of(rows: &[[f32; 14]], i: usize, view: &View, raster: &RasterConfig) -> [f64; 5] {
        let one_hot: Vec<f32> = rows
            .iter()
            .enumerate()
            .flat_map(|(j, r)| r[..11].iter().copied().chain([f32::from(u8::from(i == j)); 3]).collect::<Vec<_>>())
            .collect();
        let one_hot = Tensor::<3>::from_data(TensorData::new(one_hot, [1, rows.len(), 14]), &Device::flex());
        let render = rasterize(one_hot, &[vec![view.camera]], &[vec![[0.0; 3]]], raster).unwrap();
        let render = render.into_data().try_to_vec::<f32>().unwrap();
        let mut sum = [0.0f64; 5];
        for (w, p) in render.chunks(4).zip(view.image.pixels()) {
            let (w, a) = (f64::from(w[0]), f64::from(p[3]) / 255.0);
            sum[0] += w;
            sum[1] += w * a;
            (0..3).for_each(|c| sum[2 + c] += w * a * f64::from(p[c]) / 255.0);
        }
        sum
    }

    /// Sums over pixels of one-hot renders, Gaussian by Gaussian, against the gradient of blending.
    #[test]
    fn what_views_show_of_a_gaussian_is_what_it_weighs_in_their_pixels() {
        let (n, size) = (5, 16u32);
        let camera = |x: f64| Camera::look_at(DVec3::new(x, -1.6, 0.4), DVec3::ZERO, DVec3::Z, 0.8, size, size);
        let view = |i: u32| View {
            name: String::new(),
            camera: camera(f64::from(i) - 0.7),
            image: RgbaImage::from_fn(size, size, |x, y| {
                let color = [x * 15, y * 15, (x + y + 7 * i) * 7].map(|v| v as u8);
                Rgba([color[0], color[1], color[2], if x + i > 5 { 255 } else { 40 }])
            }),
        };
        let views: Vec<View> = (0..3).map(view).collect();
        let targets = Images::new(&[views.iter().collect()], &Device::flex()).unwrap().on(&[[0.3; 3]]);
        // The last Gaussian is behind all cameras.
        let rows: Vec<[f32; 14]> = (0..n)
            .map(|i| {
                let i = i as f32;
                let y = if i == 4.0 { -9.0 } else { 0.1 * i };
                let s = -2.0 - 0.2 * i;
                [0.2 * i - 0.3, y, 0.1 - 0.05 * i, s, s + 0.3, s, 1.0, 0.2, 0.1 * i, 0.0, 0.5, 0.1 * i, 0.5, 0.9]
            })
            .collect();
        let normalization = Normalization { mean: [0.1; 14], std: std::array::from_fn(|i| 0.5 + 0.1 * i as f32) };
        let photometric = Photometric::new(&normalization, &Device::flex());
        let normalized: Vec<f32> =
            rows.iter().flat_map(|r| (0..14).map(|i| (r[i] - normalization.mean[i]) / normalization.std[i])).collect();
        let tensor = Tensor::<3>::from_data(TensorData::new(normalized, [1, n, 14]), &Device::flex());
        let found = photometric
            .observe(tensor.clone(), &targets, OBSERVATION)
            .unwrap()
            .into_data()
            .try_to_vec::<f32>()
            .unwrap();

        let raster = RasterConfig::default().shrunk(size as f32 / VIEWER_SIZE);
        for (i, row) in rows.iter().enumerate() {
            let sums: Vec<[f64; 5]> = views.iter().map(|view| sums_of(&rows, i, view, &raster)).collect();
            let total: f64 = sums.iter().map(|s| s[0]).sum();
            let inside: f64 = sums.iter().map(|s| s[1]).sum();
            let found = &found[9 * i..9 * i + 9];
            if i == 4 {
                assert!(total == 0.0 && found.iter().all(|&x| x == 0.0), "{total} {found:?}");
                continue;
            }
            assert!(inside > 0.5, "{i}: {inside}");
            let mut expected = vec![
                0.5 * (1.0 + total).ln(),
                sums.iter().map(|s| 0.5 * s[0] / (s[0] + 1.0)).sum(),
                (total - inside) / total,
            ];
            let mean: [f64; 3] = std::array::from_fn(|c| sums.iter().map(|s| s[2 + c]).sum::<f64>() / inside);
            let unit = |c: usize| f64::from(normalization.std[11 + c]);
            (0..3).for_each(|c| expected.push((mean[c] - f64::from(row[11 + c])) / unit(c)));
            for c in 0..3 {
                let apart: f64 =
                    sums.iter().filter(|s| s[1] > 0.0).map(|s| (s[2 + c] / s[1] - mean[c]).powi(2) * s[1]).sum();
                expected.push((apart / inside).sqrt() / unit(c));
            }
            for (k, (a, b)) in found.iter().zip(&expected).enumerate() {
                assert!((f64::from(*a) - b).abs() < 2e-3, "Gaussian {i} channel {k}: {a} {b}");
            }
        }
    }
}
