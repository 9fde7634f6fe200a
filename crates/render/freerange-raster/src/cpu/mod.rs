//! The fast rasterizer for processors: no tensors, plain slices.
//!
//! Every view is prepared (projection, depth order), then drawn in bands of rows, then in blocks of 4 x 4 pixels, one
//! vector lane per pixel; views and bands run in parallel on rayon's pool. Sums over pixels always run in the same
//! order, so the same input gives the same bytes, whatever the threads do.

mod bin;
mod math;
mod normals;
pub(crate) mod project;
mod sums;
mod surface;
mod tile;

pub use normals::surface_normals;
pub use surface::surface_depth;

use crate::{CHANNELS, RasterConfig, RasterError};
use bin::{BAND, Lists};
use freerange_scene::camera::Camera;
use math::LANES;
use multiversion::{multiversion, target::target_cfg_f};
use project::{Pinhole, SUMS, Splat};
use rayon::prelude::*;
use std::cell::RefCell;
use tile::{Band, RowGrads, Rows};

/// What [`render`] returns. All arrays are row-major.
#[derive(Debug)]
pub struct RenderOutput {
    /// Color over the background, `[views, height, width, 3]`; not clamped.
    pub rgb: Vec<f32>,
    /// 1 - transmittance, `[views, height, width]`.
    pub alpha: Vec<f32>,
    /// Sum of blending weight times camera z, `[views, height, width]`; divide by alpha for the expected depth.
    /// Empty unless [`RasterConfig::depth`] is set.
    pub depth: Vec<f32>,
    state: State,
}

/// What [`render_backward`] returns.
#[derive(Clone, Debug, PartialEq)]
pub struct Gradients {
    /// d loss / d Gaussians, `[n, 14]`. Zero for Gaussians that touch no pixel.
    pub gaussians: Vec<f32>,
    /// d loss / d background, one per view.
    pub backgrounds: Vec<[f32; 3]>,
}

/// Renders `gaussians` (row-major `[n, 14]`, channels as in [`crate`]) from every one of `cameras`, which share one image
/// size, in front of one background color per view.
///
/// Gaussians are culled where any channel is not finite, the quaternion is shorter than 1e-12, the camera z is outside
/// [`RasterConfig::near`]..=[`RasterConfig::far`], the standard deviation in the image exceeds 10^6 pixels, the
/// center is more than 10^7 pixels away, or a color channel exceeds 10^6. The result is finite.
///
/// The output also holds what [`render_backward`] needs: about 64 bytes per Gaussian and view, two bytes per Gaussian and
/// block of 4 x 4 pixels that it reaches, and eight per pixel.
///
/// # Errors
/// If a length does not fit, a camera or background is not finite, or the image size is zero, above 16384, or
/// different between cameras.
pub fn render(
    gaussians: &[f32],
    cameras: &[Camera],
    backgrounds: &[[f32; 3]],
    config: &RasterConfig,
) -> Result<RenderOutput, RasterError> {
    let [width, height] = check(gaussians, cameras, backgrounds, config)?;
    let pixels = cameras.len() * width * height;
    let mut rgb = vec![0.0; 3 * pixels];
    let mut alpha = vec![0.0; pixels];
    let mut depth = vec![0.0; if config.depth { pixels } else { 0 }];
    let state = forward(gaussians, 1, cameras, backgrounds, config, &mut rgb, 3, &mut alpha, &mut depth);
    Ok(RenderOutput { rgb, alpha, depth, state })
}

/// The gradient of a loss with respect to the `gaussians` and backgrounds of the call of [`render`] that returned `output`.
///
/// `d_rgb` (`[views, height, width, 3]`), `d_alpha` and `d_depth` (`[views, height, width]`) are d loss / d output. The
/// latter two may be empty, which means zero.
///
/// # Errors
/// If a length does not fit; in particular `d_depth` needs an output that was rendered with [`RasterConfig::depth`].
pub fn render_backward(
    gaussians: &[f32],
    output: &RenderOutput,
    d_rgb: &[f32],
    d_alpha: &[f32],
    d_depth: &[f32],
) -> Result<Gradients, RasterError> {
    let expect = |field, found: usize, expected: usize| {
        if found == expected { Ok(()) } else { Err(RasterError::Length { field, expected, found }) }
    };
    expect("gaussians", gaussians.len(), output.state.gaussians * CHANNELS)?;
    expect("d_rgb", d_rgb.len(), output.rgb.len())?;
    if !d_alpha.is_empty() {
        expect("d_alpha", d_alpha.len(), output.alpha.len())?;
    }
    if !d_depth.is_empty() {
        expect("d_depth", d_depth.len(), output.depth.len())?;
    }
    Ok(backward(gaussians, &output.state, d_rgb, 3, d_alpha, d_depth))
}

/// Checks what comes from outside, and returns the image size.
pub(crate) fn check(
    gaussians: &[f32],
    cameras: &[Camera],
    backgrounds: &[[f32; 3]],
    config: &RasterConfig,
) -> Result<[usize; 2], RasterError> {
    const MAX_SIZE: u32 = 16384;
    if !gaussians.len().is_multiple_of(CHANNELS) || gaussians.len() / CHANNELS > u32::MAX as usize {
        let expected = gaussians.len() / CHANNELS * CHANNELS;
        return Err(RasterError::Length { field: "gaussians", expected, found: gaussians.len() });
    }
    if backgrounds.len() != cameras.len() {
        return Err(RasterError::Length { field: "backgrounds", expected: cameras.len(), found: backgrounds.len() });
    }
    if !(config.near > 0.0 && config.far >= config.near && config.blur >= 0.0 && config.blur.is_finite()) {
        return Err(RasterError::Config { near: config.near, far: config.far, blur: config.blur });
    }
    let Some(size) = cameras.first().map(|c| [c.width, c.height]) else { return Ok([0, 0]) };
    for (view, (camera, background)) in cameras.iter().zip(backgrounds).enumerate() {
        let found = [camera.width, camera.height];
        if found != size || size.iter().any(|v| !(1..=MAX_SIZE).contains(v)) {
            return Err(RasterError::ImageSize { view, expected: size, found, limit: MAX_SIZE });
        }
        let numbers = camera.world_to_camera.to_cols_array();
        let intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy];
        if !numbers.iter().chain(&intrinsics).all(|v| (*v as f32).is_finite()) || camera.fx <= 0.0 || camera.fy <= 0.0 {
            return Err(RasterError::Camera { view });
        }
        if !background.iter().all(|v| v.is_finite()) {
            return Err(RasterError::Background { view });
        }
    }
    Ok(size.map(|v| v as usize))
}

/// What the forward pass leaves for the backward pass.
#[derive(Debug)]
pub(crate) struct State {
    objects: usize,
    /// Per object.
    gaussians: usize,
    width: usize,
    height: usize,
    blur: f32,
    views: Vec<ViewState>, // [objects * views]
}

#[derive(Debug)]
struct ViewState {
    camera: Pinhole,
    background: [f32; 3],
    bands: Vec<Band>,
}

/// A slice's part for each view or band; empty slices have empty parts.
fn parts<T>(all: &mut [T], size: usize, count: usize) -> Vec<&mut [T]> {
    if all.is_empty() {
        (0..count).map(|_| Default::default()).collect()
    } else {
        all.chunks_mut(size.max(1)).collect()
    }
}

/// Renders `[objects, n, 14]` from `[objects, views]` checked cameras. `stride` floats per pixel go to `color`; if that
/// is 4, the fourth is alpha, and the slice `alpha` is not used.
pub(crate) fn forward(
    gaussians: &[f32],
    objects: usize,
    cameras: &[Camera],
    backgrounds: &[[f32; 3]],
    config: &RasterConfig,
    color: &mut [f32],
    stride: usize,
    alpha: &mut [f32],
    depth: &mut [f32],
) -> State {
    let [width, height] = cameras.first().map_or([0, 0], |c| [c.width as usize, c.height as usize]);
    let (per_object, views) = (gaussians.len() / objects.max(1), cameras.len() / objects.max(1));
    let pixels = width * height;
    let jobs: Vec<_> = parts(color, pixels * stride, cameras.len())
        .into_iter()
        .zip(parts(alpha, pixels, cameras.len()))
        .zip(parts(depth, pixels, cameras.len()))
        .collect();
    let views = jobs
        .into_par_iter()
        .enumerate()
        .map(|(i, ((color, alpha), depth))| {
            let object = i / views;
            let rows = &gaussians[object * per_object..(object + 1) * per_object];
            let camera = Pinhole::new(&cameras[i]);
            let background = backgrounds[i];
            let bands = prepare(rows, &camera, [width, height], config);
            let count = bands.len();
            let jobs: Vec<_> = bands
                .into_iter()
                .zip(parts(color, width * BAND * stride, count))
                .zip(parts(alpha, width * BAND, count))
                .zip(parts(depth, width * BAND, count))
                .collect();
            let bands = jobs
                .into_par_iter()
                .enumerate()
                .map(|(b, (((splats, color), alpha), depth))| {
                    let height = (height - b * BAND).min(BAND);
                    let mut rows = Rows { width, height, stride, color, alpha, depth };
                    draw(b * BAND, splats, background, &mut rows)
                })
                .collect();
            ViewState { camera, background, bands }
        })
        .collect();
    State { objects, gaussians: per_object / CHANNELS, width, height, blur: config.blur, views }
}

/// The splats of each band of one view, in depth order.
fn prepare(rows: &[f32], camera: &Pinhole, [width, height]: [usize; 2], config: &RasterConfig) -> Vec<Vec<Splat>> {
    /// Gaussians that one thread projects at a time.
    const TASK: usize = 4096;
    let size = [width as u32, height as u32];
    let splats = if rows.len() <= TASK * CHANNELS {
        project(rows, 0, camera, size, config)
    } else {
        let tasks: Vec<_> = rows
            .par_chunks(TASK * CHANNELS)
            .enumerate()
            .map(|(i, rows)| project(rows, (i * TASK) as u32, camera, size, config))
            .collect();
        tasks.concat()
    };
    let order = bin::depth_order(&splats);
    bin::bands(&splats, &order, height)
}

/// The derivative of [`forward`]; the layout of the gradients is that of its outputs.
pub(crate) fn backward(
    gaussians: &[f32],
    state: &State,
    d_color: &[f32],
    stride: usize,
    d_alpha: &[f32],
    d_depth: &[f32],
) -> Gradients {
    let State { objects, gaussians: n, width, height, blur, ref views } = *state;
    let pixels = width * height;
    fn part(all: &[f32], start: usize, len: usize) -> &[f32] {
        if all.is_empty() { all } else { &all[start..start + len] }
    }
    let pulled: Vec<(Vec<[f32; SUMS]>, [f32; 3])> = views
        .par_iter()
        .enumerate()
        .map(|(i, view)| {
            let bands: Vec<_> = view
                .bands
                .par_iter()
                .map(|band| {
                    let height = (height - band.top).min(BAND);
                    let (start, len) = (i * pixels + band.top * width, height * width);
                    let grads = RowGrads {
                        width,
                        height,
                        stride,
                        color: &d_color[start * stride..(start + len) * stride],
                        alpha: part(d_alpha, start, len),
                        depth: part(d_depth, start, len),
                    };
                    draw_backward(band, view.background, &grads)
                })
                .collect();
            let mut sums = vec![[0f32; SUMS]; n];
            let mut d_background = [0f32; 3];
            for (band, (band_sums, band_background)) in view.bands.iter().zip(bands) {
                for (splat, from) in band.splats.iter().zip(band_sums) {
                    let to = &mut sums[splat.index as usize];
                    for k in 0..SUMS {
                        to[k] += from[k];
                    }
                }
                for c in 0..3 {
                    d_background[c] += band_background[c];
                }
            }
            (sums, d_background)
        })
        .collect();

    const TASK: usize = 512;
    let mut out = vec![0f32; gaussians.len()];
    let per_object = views.len() / objects.max(1);
    out.par_chunks_mut(n.max(1) * CHANNELS).enumerate().for_each(|(object, out)| {
        let range = object * per_object..(object + 1) * per_object;
        let sources: Vec<_> = range.map(|i| (views[i].camera, pulled[i].0.as_slice())).collect();
        let rows = &gaussians[object * n * CHANNELS..(object + 1) * n * CHANNELS];
        out.par_chunks_mut(TASK * CHANNELS).enumerate().for_each(|(i, out)| {
            let rows = &rows[i * TASK * CHANNELS..][..out.len()];
            project_backward(rows, i * TASK, &sources, blur, out);
        });
    });
    Gradients { gaussians: out, backgrounds: pulled.iter().map(|(_, d)| *d).collect() }
}

// The four kernels, compiled for each instruction set, and chosen when first called.

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma"))]
fn project(rows: &[f32], first: u32, camera: &Pinhole, size: [u32; 2], config: &RasterConfig) -> Vec<Splat> {
    const FMA: bool = target_cfg_f!(any(target_feature = "fma", target_arch = "aarch64"));
    let mut out = Vec::with_capacity(rows.len() / CHANNELS);
    for (i, rows) in rows.chunks(LANES * CHANNELS).enumerate() {
        project::project::<FMA>(rows, first + (i * LANES) as u32, camera, size, config, &mut out);
    }
    out
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma"))]
fn draw(top: usize, splats: Vec<Splat>, background: [f32; 3], rows: &mut Rows) -> Band {
    const FMA: bool = target_cfg_f!(any(target_feature = "fma", target_arch = "aarch64"));
    thread_local!(static LISTS: RefCell<Lists> = Default::default());
    let mut lists = LISTS.take();
    let band = if rows.depth.is_empty() {
        tile::draw::<FMA, false>(top, splats, background, &mut lists, rows)
    } else {
        tile::draw::<FMA, true>(top, splats, background, &mut lists, rows)
    };
    LISTS.set(lists);
    band
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma"))]
fn draw_backward(band: &Band, background: [f32; 3], grads: &RowGrads) -> (Vec<[f32; SUMS]>, [f32; 3]) {
    const FMA: bool = target_cfg_f!(any(target_feature = "fma", target_arch = "aarch64"));
    const AVX2: bool = target_cfg_f!(all(target_arch = "x86_64", target_feature = "avx2", target_feature = "fma"));
    let mut sums = vec![[0f32; SUMS]; band.splats.len()];
    let d_background = if grads.depth.is_empty() {
        tile::backward::<FMA, AVX2, false>(band, background, grads, &mut sums)
    } else {
        tile::backward::<FMA, AVX2, true>(band, background, grads, &mut sums)
    };
    (sums, d_background)
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl+avx2+fma", "x86_64+avx2+fma"))]
fn project_backward(rows: &[f32], first: usize, views: &[(Pinhole, &[[f32; SUMS]])], blur: f32, out: &mut [f32]) {
    const FMA: bool = target_cfg_f!(any(target_feature = "fma", target_arch = "aarch64"));
    for (i, (rows, out)) in rows.chunks(LANES * CHANNELS).zip(out.chunks_mut(LANES * CHANNELS)).enumerate() {
        project::project_backward::<FMA>(rows, first + i * LANES, views, blur, out);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    /// Image and gradients of a few Gaussians, through the kernels with or without fused multiply-add.
    fn run<const FMA: bool>() -> (Vec<f32>, Vec<f32>) {
        let (width, height, config) = (30, 14, RasterConfig { depth: true, ..RasterConfig::default() });
        let eye = DVec3::new(1.2, -0.9, 0.4);
        let camera = Pinhole::new(&Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.9, width as u32, height as u32));
        let rows: Vec<f32> = (0..20)
            .flat_map(|i| {
                let wave = move |k: usize| (i as f32 * 1.3 + k as f32 * 2.1).sin();
                (0..CHANNELS).map(move |k| if (3..6).contains(&k) { -2.5 + wave(k) } else { 0.6 * wave(k) })
            })
            .collect();
        let mut splats = vec![];
        for (i, rows) in rows.chunks(LANES * CHANNELS).enumerate() {
            let size = [width as u32, height as u32];
            project::project::<FMA>(rows, (i * LANES) as u32, &camera, size, &config, &mut splats);
        }
        let band = bin::bands(&splats, &bin::depth_order(&splats), height).remove(0);
        let (mut color, mut alpha, mut depth) =
            (vec![0.0; width * height * 3], vec![0.0; width * height], vec![0.0; width * height]);
        let mut image = Rows { width, height, stride: 3, color: &mut color, alpha: &mut alpha, depth: &mut depth };
        let band = tile::draw::<FMA, true>(0, band, [0.5; 3], &mut Lists::default(), &mut image);
        let grads = RowGrads { width, height, stride: 3, color: &color, alpha: &alpha, depth: &depth };
        let mut sums = vec![[0.0; SUMS]; band.splats.len()];
        tile::backward::<FMA, false, true>(&band, [0.5; 3], &grads, &mut sums);
        let mut all = vec![[0.0; SUMS]; 20];
        band.splats.iter().zip(sums).for_each(|(splat, sum)| all[splat.index as usize] = sum);
        let mut out = vec![0.0; rows.len()];
        for (i, (rows, out)) in rows.chunks(LANES * CHANNELS).zip(out.chunks_mut(LANES * CHANNELS)).enumerate() {
            project::project_backward::<FMA>(rows, i * LANES, &[(camera, &all)], config.blur, out);
        }
        (color, out)
    }

    #[test]
    fn machines_without_fused_multiply_add_get_the_same() {
        let (with, without) = (run::<true>(), run::<false>());
        for (with, without) in [(with.0, without.0), (with.1, without.1)] {
            let largest = with.iter().fold(0.0, |m: f32, v| m.max(v.abs()));
            assert!(largest > 0.5);
            for (a, b) in with.iter().zip(&without) {
                assert!((a - b).abs() <= 2e-5 * largest, "{a} and {b}, of {largest}");
            }
        }
    }
}
