//! Where each Gaussian lies with respect to what views show: their outlines, the surface that is rendered, colors that agree.
//!
//! Computed on the host, on all its threads, from pictures that are small: on a GPU every estimate waits for it.

use burn::tensor::{Tensor, TensorData};
use freerange_gaussians::channel;
use freerange_model::PLACE;
use freerange_raster::{RasterConfig, rasterize};
use freerange_scene::camera::Camera;
use glam::DVec3;
use rayon::prelude::*;

use crate::{FlowError, targets::Targets};

/// One unit of distances; the object's sphere has radius 0.5.
const UNIT: f32 = 0.1;
/// One unit of the way to the outlines.
const WAY: f32 = 0.05;
/// Where along the ray from the view that sees a Gaussian best its color is looked for in the others.
const SWEEP: [f32; 6] = [-0.04, -0.02, -0.01, 0.01, 0.02, 0.04];

/// The last channels of [`observe`](crate::photometric::Photometric::observe), in its order, for raw `gaussians` `[b, n, 14]`: `[b, n, 23]`.
/// `unit` is that of colors.
pub(crate) fn place(
    gaussians: Tensor<3>,
    unit: [f32; 3],
    targets: &Targets,
    raster: &RasterConfig,
) -> Result<Tensor<3>, FlowError> {
    let device = gaussians.device();
    let [b, n, _] = gaussians.dims();
    let [_, v, h, w, _] = targets.object.dims();
    let rows = floats(gaussians);
    let rows = rows.as_chunks::<{ channel::COUNT }>().0;
    let photos = floats(targets.object.clone());
    let depths = floats(depths(rows, n, targets, raster, &device)?);
    let views: Vec<Seen> = (0..b * v)
        .into_par_iter()
        .map(|view| {
            let [photo, depth] =
                [&photos, &depths].map(|all| &all.as_chunks::<4>().0[view * h * w..(view + 1) * h * w]);
            Seen {
                camera: targets.cameras[view / v][view % v],
                size: [w, h],
                photo,
                depth,
                outline: outline(photo, w, h),
            }
        })
        .collect();
    let places = rows.par_iter().enumerate().flat_map_iter(|(i, row)| place_of(row, unit, &views[i / n * v..][..v]));
    Ok(Tensor::from_data(TensorData::new(places.collect::<Vec<f32>>(), [b, n, PLACE]), &device))
}

fn floats<const D: usize>(x: Tensor<D>) -> Vec<f32> {
    x.into_data().convert::<f32>().try_to_vec().expect("floats")
}

/// Depth times alpha, three times, and alpha. `[b v, 1, h, w, 4]`
fn depths(
    rows: &[[f32; channel::COUNT]],
    n: usize,
    targets: &Targets,
    raster: &RasterConfig,
    device: &burn::tensor::Device,
) -> Result<Tensor<5>, FlowError> {
    let mut colored = Vec::new();
    for (object, cameras) in rows.chunks_exact(n).zip(&targets.cameras) {
        for camera in cameras {
            for mut row in object.iter().copied() {
                let depth = point(camera, center(&row)).z as f32;
                row[channel::COLOR].fill(depth);
                colored.extend(row);
            }
        }
    }
    let cameras: Vec<_> = targets.cameras.iter().flatten().map(|&camera| vec![camera]).collect();
    let shape = [cameras.len(), n, channel::COUNT];
    let colored = Tensor::<3>::from_data(TensorData::new(colored, shape), device);
    Ok(rasterize(colored, &cameras, &vec![vec![[0.0; 3]]; cameras.len()], raster)?)
}

/// What a view and a render from its place show.
struct Seen<'a> {
    camera: Camera,
    size: [usize; 2],
    photo: &'a [[f32; 4]],
    depth: &'a [[f32; 4]],
    /// Distance to the outline in pixels, positive within.
    outline: Vec<f32>,
}

impl Seen<'_> {
    /// The pixel that shows a point, or the one nearest to that.
    fn pixel(&self, [x, y]: [f64; 2]) -> usize {
        let within = |x: f64, most: usize| (x.max(0.0) as usize).min(most - 1);
        within(y, self.size[1]) * self.size[0] + within(x, self.size[0])
    }

    /// Bilinear; color times alpha, and alpha.
    fn sample(&self, p: DVec3) -> [f32; 4] {
        let [w, h] = self.size;
        let [x, y] = projected(&self.camera, p).map(|x| x as f32 - 0.5);
        let (x, y) = (x.clamp(0.0, w as f32 - 1.0), y.clamp(0.0, h as f32 - 1.0));
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        let at = |x: usize, y: usize, k: usize| self.photo[y * w + x][k];
        let row = |y: usize, k: usize| at(x0, y, k) * (1.0 - fx) + at(x1, y, k) * fx;
        [0, 1, 2, 3].map(|k| row(y0, k) * (1.0 - fy) + row(y1, k) * fy)
    }

    /// From a point beside the outline the way to it, square to the ray.
    fn way(&self, pixel: usize, size: f32) -> DVec3 {
        let ([w, h], out) = (self.size, -self.outline[pixel]);
        let (x, y) = (pixel % w, pixel / w);
        let at = |x: usize, y: usize| self.outline[y.min(h - 1) * w + x.min(w - 1)];
        let slope = [at(x + 1, y) - at(x.saturating_sub(1), y), at(x, y + 1) - at(x, y.saturating_sub(1))];
        let steep = slope[0].hypot(slope[1]);
        if out <= 0.0 || steep <= 1e-3 {
            return DVec3::ZERO;
        }
        let m = self.camera.world_to_camera;
        let way = f64::from(slope[0]) * m.row(0).truncate() + f64::from(slope[1]) * m.row(1).truncate();
        f64::from((out * size).min(2.0 * UNIT) / steep) * way
    }
}

fn center(row: &[f32; channel::COUNT]) -> DVec3 {
    DVec3::from_array([0, 1, 2].map(|k| f64::from(row[channel::MEAN.start + k])))
}

/// In the camera's frame, in front of it.
fn point(camera: &Camera, p: DVec3) -> DVec3 {
    let p = camera.world_to_camera.transform_point3(p);
    DVec3 { z: p.z.max(0.05), ..p }
}

fn projected(camera: &Camera, p: DVec3) -> [f64; 2] {
    let p = point(camera, p);
    [camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy]
}

fn place_of(row: &[f32; channel::COUNT], unit: [f32; 3], views: &[Seen]) -> [f32; PLACE] {
    let center = center(row);
    let ([mut inside, mut behind], mut way) = ([(f32::MAX, 0.0f32); 2], DVec3::ZERO);
    let (mut sum, mut square, mut shown) = ([0.0f32; 3], [0.0f32; 3], 0.0f32);
    let mut best: Option<(f32, usize)> = None;
    for (i, view) in views.iter().enumerate() {
        let depth = point(&view.camera, center).z as f32;
        let (pixel, size) = (view.pixel(projected(&view.camera, center)), depth / view.camera.fx as f32);
        way += view.way(pixel, size);
        let d = (view.outline[pixel] * size / UNIT).clamp(-2.0, 2.0);
        inside = (inside.0.min(d), inside.1 + d);
        let ([far, .., solid], photo) = (view.depth[pixel], view.photo[pixel]);
        let d = if solid > 0.5 { ((depth - far / solid) / UNIT).clamp(-2.0, 3.0) } else { -2.0 };
        behind = (behind.0.min(d), behind.1 + d);
        if photo[3] <= 0.5 {
            continue;
        }
        if solid > 0.5 && d < 0.5 && best.is_none_or(|(least, _)| d < least) {
            best = Some((d, i));
        }
        shown += 1.0;
        for k in 0..3 {
            let color = photo[k] / photo[3];
            sum[k] += color;
            square[k] += color * color;
        }
    }
    let count = views.len() as f32;
    let mut out = [0.0; PLACE];
    out[..4].copy_from_slice(&[inside.0, inside.1 / count, behind.0, behind.1 / count]);
    if shown > 0.0 {
        for k in 0..3 {
            let mean = sum[k] / shown;
            out[4 + k] = (mean - row[channel::COLOR.start + k]) / unit[k];
            out[7 + k] = (square[k] / shown - mean * mean).max(0.0).sqrt() / unit[k];
        }
    }
    out[10..13].copy_from_slice(&(way / f64::from(count * WAY)).as_vec3().to_array());
    if let Some((_, best)) = best {
        let away = (center - views[best].camera.center()).normalize_or_zero();
        let own = views[best].sample(center);
        let others = views.iter().enumerate().filter(|(i, _)| *i != best);
        let unlike = |s: f32| {
            let p = center + f64::from(s) * away;
            let each = others.clone().map(|(_, view)| {
                let there = view.sample(p);
                let color = (0..3).map(|k| (there[k] - own[k]).abs()).sum::<f32>() / 3.0;
                (color + 0.5 * (1.0 - there[3])).min(0.5)
            });
            each.sum::<f32>() / (count - 1.0).max(1.0)
        };
        let here = unlike(0.0);
        out[13..19].copy_from_slice(&SWEEP.map(|s| 5.0 * (unlike(s) - here)));
        out[19] = 2.0 * here;
        out[20..].copy_from_slice(&away.as_vec3().to_array());
    }
    out
}

/// Distance to the outline in pixels, positive within; by chamfers, within a tenth.
fn outline(photo: &[[f32; 4]], w: usize, h: usize) -> Vec<f32> {
    const FAR: f32 = 1e4; // where there is nothing to be far from
    let stride = w + 2; // a frame of one pixel that is far from all, so that every pixel has neighbors
    let pixels = || (0..h).flat_map(|y| (0..w).map(move |x| (y + 1) * stride + x + 1));
    let to = |what: bool| {
        let mut d = vec![FAR; stride * (h + 2)];
        for (k, p) in pixels().zip(photo) {
            d[k] = if (p[3] > 0.5) == what { 0.0 } else { FAR };
        }
        let steps = [(1, 1.0), (stride, 1.0), (stride + 1, 1.414), (stride - 1, 1.414)];
        for k in pixels() {
            d[k] = steps.iter().fold(d[k], |least, &(back, step)| least.min(d[k - back] + step));
        }
        for k in pixels().rev() {
            d[k] = steps.iter().fold(d[k], |least, &(ahead, step)| least.min(d[k + ahead] + step));
        }
        d
    };
    let (out, within) = (to(false), to(true));
    pixels().map(|k| out[k] - within[k]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::targets::Images;
    use burn::tensor::Device;
    use freerange_scene::camera::View;
    use image::{Rgba, RgbaImage};

    const SIZE: u32 = 64;

    fn camera(eye: DVec3) -> Camera {
        Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.8, SIZE, SIZE)
    }

    /// What a camera sees of the plane y = 0 within a radius of 0.3, painted in stripes.
    fn disc(camera: &Camera) -> View {
        let back = camera.world_to_camera.inverse();
        let image = RgbaImage::from_fn(SIZE, SIZE, |x, y| {
            let [x, y] = [(f64::from(x) + 0.5 - camera.cx) / camera.fx, (f64::from(y) + 0.5 - camera.cy) / camera.fy];
            let (eye, ray) = (camera.center(), back.transform_vector3(DVec3::new(x, y, 1.0)));
            let p = eye - ray * (eye.y / ray.y);
            let stripe = |k: f64| (127.0 + 120.0 * (k * p.x).sin()) as u8;
            Rgba([stripe(25.0), stripe(11.0), stripe(40.0), if p.length() < 0.3 { 255 } else { 0 }])
        });
        View { name: String::new(), camera: *camera, image }
    }

    /// Gaussians on that plane, and one more.
    fn places(views: &[View], one: DVec3) -> [f32; PLACE] {
        let mut rows: Vec<[f32; channel::COUNT]> = Vec::new();
        let mut add = |p: DVec3, size: f32| {
            let [x, y, z] = p.as_vec3().to_array();
            rows.push([x, y, z, size, size, size, 1.0, 0.0, 0.0, 0.0, 6.0, 0.5, 0.5, 0.5]);
        };
        add(one, -9.0);
        for i in -6..=6 {
            for j in -6..=6 {
                let p = 0.045 * DVec3::new(f64::from(i), 0.0, f64::from(j));
                if p.length() < 0.3 {
                    add(p, -3.8);
                }
            }
        }
        let n = rows.len();
        let device = Device::flex();
        let targets = Images::new(&[views.iter().collect()], &device).unwrap().on(&[[0.0; 3]]);
        let gaussians = Tensor::from_data(TensorData::new(rows.concat(), [1, n, channel::COUNT]), &device);
        let raster = RasterConfig::default().shrunk(SIZE as f32 / 512.0);
        let found = place(gaussians, [0.5, 0.25, 0.2], &targets, &raster).unwrap();
        assert_eq!(found.dims(), [1, n, PLACE]);
        floats(found)[..PLACE].try_into().unwrap()
    }

    fn two() -> [View; 2] {
        [DVec3::new(0.2, -1.6, 0.1), DVec3::new(-0.6, -1.5, 0.2)].map(|eye| disc(&camera(eye)))
    }

    #[test]
    fn distances_to_an_outline_are_those_to_the_nearest_pixel_beyond_it() {
        let [view, _] = two();
        let photo: Vec<[f32; 4]> = view.image.pixels().map(|p| p.0.map(|v| f32::from(v) / 255.0)).collect();
        let (w, solid) = (SIZE as usize, |k: usize| photo[k][3] > 0.5);
        for (k, found) in outline(&photo, w, w).into_iter().enumerate() {
            let away = |j: usize| {
                (((j % w) as f32 - (k % w) as f32).powi(2) + ((j / w) as f32 - (k / w) as f32).powi(2)).sqrt()
            };
            let beyond = (0..w * w).filter(|&j| solid(j) != solid(k)).map(away).fold(f32::MAX, f32::min);
            let expected = if solid(k) { beyond } else { -beyond };
            assert!((found - expected).abs() <= 0.1 * beyond, "{k}: {found}, expected {expected}");
        }
        assert!(
            outline(&[[1.0; 4]; 6], 3, 2).iter().all(|&d| d > 1e3)
                && outline(&[[0.0; 4]; 6], 3, 2).iter().all(|&d| d < -1e3)
        );
    }

    #[test]
    fn what_lies_beside_an_outline_is_told_the_way_there() {
        let views = two();
        let found = places(&views, DVec3::new(0.4, 0.0, 0.0));
        assert!((-1.35..-0.8).contains(&found[0]) && found[0] <= found[1], "0.1 beside: {found:?}");
        // The mean over both views, each square to its ray: together nearly along the plane.
        let way = DVec3::new(found[10].into(), found[11].into(), found[12].into()) * f64::from(WAY);
        assert!((way.x + 0.1).abs() < 0.03 && way.y.abs() < 0.03 && way.z.abs() < 0.02, "{way}");
        assert_eq!(found[4..10], [0.0; 6], "nothing is shown there");
        let within = places(&views, DVec3::new(0.2, 0.0, 0.0));
        assert!((0.8..1.35).contains(&within[0]) && within[10..13] == [0.0; 3], "{within:?}");
    }

    #[test]
    fn depth_is_behind_what_is_rendered_and_colors_agree_on_the_surface() {
        let views = two();
        let at = |y: f64| places(&views, DVec3::new(0.03, y, 0.02));
        for (y, expected) in [(0.1, 1.0), (-0.1, -1.0)] {
            let found = at(y);
            assert!((found[2] - expected).abs() < 0.25 && (found[3] - expected).abs() < 0.25, "{y}: {found:?}");
        }
        assert_eq!(at(0.1)[13..], [0.0; 10], "no view sees it");
        // Before the surface by as much along the ray of the view that sees it best, the colors agree behind it.
        let (before, on) = (at(-0.02), at(0.0));
        let least = |found: &[f32; PLACE]| (13..19).min_by(|&a, &b| found[a].total_cmp(&found[b])).unwrap();
        assert_eq!(SWEEP[least(&before) - 13], 0.02, "{before:?}");
        assert!(before[17] < -0.2 && before[19] > 2.0 * on[19], "{before:?} {on:?}");
        assert!(on[13..19].iter().all(|&x| x > 0.0), "{on:?}");
        let ray = DVec3::new(on[20].into(), on[21].into(), on[22].into());
        assert!((ray.length() - 1.0).abs() < 1e-5 && ray.y > 0.9, "{ray}");
        // In units of the colors; their mean on the surface is that of the plane.
        let deviation = |found: &[f32; PLACE]| found[7] * 0.5;
        assert!(deviation(&on) < 0.06 && deviation(&at(-0.1)) > 2.0 * deviation(&on), "{on:?}");
        let plane = (0.5 + 120.0 / 255.0 * (25.0f32 * 0.03).sin() - 0.5) / 0.5;
        assert!((on[4] - plane).abs() < 0.15, "{} {plane}", on[4]);
    }
}
