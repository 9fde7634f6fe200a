//! From Gaussians to splats: the projection of `cpu::project`, and its derivative, one thread per Gaussian.
//!
//! Formulas and limits are those of the CPU path; see there. Comparisons are written so that NaN fails them, and what is
//! not finite is replaced before it is computed with: on a GPU, arithmetic on such values may give anything.

use super::math::*;
use crate::CHANNELS;
use cubecl::prelude::*;
use freerange_scene::camera::Camera;

/// Floats per camera in the buffer that kernels read.
pub const CAMERA: usize = 24;
/// [`F4`]s per splat: `(x, y, l11, l21)`, `(l22, ln opacity, red, green)`, `(blue, -, -, -)`.
///
/// With `(dx, dy)` = pixel center - mean, `u = l11 dx + l21 dy` and `v = l22 dy`, the opacity at the pixel is
/// `exp(ln opacity - u^2 - v^2)`.
pub const RECORD: usize = 3;
/// Sort key of a splat that is not drawn. Keys of others are the bits of their depth, which order as the floats do.
pub const CULLED: u32 = u32::MAX;
/// ln(255): a splat whose logarithm of the opacity is below minus this is invisible.
pub const LN_255: f32 = 5.541_263_5;
/// Sums over the pixels of one image, for one Gaussian: with `g` = d loss / d ln(alpha), these are `g`, `g dx`, `g dy`,
/// `g dx^2`, `g dx dy`, `g dy^2`, d loss / d color (3).
pub const SUMS: usize = 9;

const MAX_COVARIANCE: f32 = 1e12;
const MAX_COORDINATE: f32 = 1e7;
const MAX_COLOR: f32 = 1e6;

/// What kernels read of a camera: rotation (rows), translation, focal lengths, principal point, the range of x/z and y/z
/// where the projection is linearized (low x, low y, high x, high y), background, one unused.
pub fn camera_floats(camera: &Camera, background: [f32; 3]) -> [f32; CAMERA] {
    let pinhole = crate::cpu::project::Pinhole::new(camera);
    let mut out = [0.0; CAMERA];
    let parts: [&[f32]; 8] = [
        pinhole.rotation.as_flattened(),
        &pinhole.translation,
        &pinhole.focal,
        &pinhole.center,
        &pinhole.low,
        &pinhole.high,
        &background,
        &[],
    ];
    out[..CAMERA - 1].copy_from_slice(&parts.concat());
    out
}

#[derive(CubeType)]
struct Pinhole {
    r0: V3,
    r1: V3,
    r2: V3,
    translation: V3,
    fx: f32,
    fy: f32,
    cx: f32,
    cy: f32,
    low_x: f32,
    low_y: f32,
    high_x: f32,
    high_y: f32,
}

#[cube]
fn load_camera(cameras: &[f32], image: usize) -> Pinhole {
    let c = image * CAMERA;
    Pinhole {
        r0: vec3(cameras[c], cameras[c + 1], cameras[c + 2]),
        r1: vec3(cameras[c + 3], cameras[c + 4], cameras[c + 5]),
        r2: vec3(cameras[c + 6], cameras[c + 7], cameras[c + 8]),
        translation: vec3(cameras[c + 9], cameras[c + 10], cameras[c + 11]),
        fx: cameras[c + 12],
        fy: cameras[c + 13],
        cx: cameras[c + 14],
        cy: cameras[c + 15],
        low_x: cameras[c + 16],
        low_y: cameras[c + 17],
        high_x: cameras[c + 18],
        high_y: cameras[c + 19],
    }
}

/// A Gaussian whose geometry is finite.
#[derive(CubeType)]
struct Gaussian {
    mean: V3,
    scale: V3,
    /// Rows of the rotation matrix.
    r0: V3,
    r1: V3,
    r2: V3,
    /// Unit quaternion.
    w: f32,
    q: V3,
    inverse_norm: f32,
    /// The limits on its channels hold. If not, the above stands for nothing.
    ok: bool,
}

#[cube]
fn load_gaussian(gaussians: &[f32], row: usize) -> Gaussian {
    let c = row * CHANNELS;
    let mut ok = true;
    #[unroll]
    for k in 0..CHANNELS {
        ok = ok && finite(gaussians[c + k]);
    }
    #[unroll]
    for k in 11..CHANNELS {
        ok = ok && gaussians[c + k].abs() <= MAX_COLOR;
    }
    let norm2 = gaussians[c + 6] * gaussians[c + 6]
        + gaussians[c + 7] * gaussians[c + 7]
        + gaussians[c + 8] * gaussians[c + 8]
        + gaussians[c + 9] * gaussians[c + 9];
    ok = ok && finite(norm2) && norm2 > 1e-24f32 && norm2 < 1e37f32;
    let inverse_norm = 1.0f32 / select(ok, norm2, 1.0f32).sqrt();
    let w = select(ok, gaussians[c + 6] * inverse_norm, 1.0f32);
    let x = select(ok, gaussians[c + 7] * inverse_norm, 0.0f32);
    let y = select(ok, gaussians[c + 8] * inverse_norm, 0.0f32);
    let z = select(ok, gaussians[c + 9] * inverse_norm, 0.0f32);
    Gaussian {
        mean: vec3(
            select(ok, gaussians[c], 0.0f32),
            select(ok, gaussians[c + 1], 0.0f32),
            select(ok, gaussians[c + 2], 0.0f32),
        ),
        scale: vec3(
            bounded_exp(select(ok, gaussians[c + 3], 0.0f32)),
            bounded_exp(select(ok, gaussians[c + 4], 0.0f32)),
            bounded_exp(select(ok, gaussians[c + 5], 0.0f32)),
        ),
        r0: vec3(1.0f32 - 2.0f32 * (y * y + z * z), 2.0f32 * (x * y - w * z), 2.0f32 * (x * z + w * y)),
        r1: vec3(2.0f32 * (x * y + w * z), 1.0f32 - 2.0f32 * (x * x + z * z), 2.0f32 * (y * z - w * x)),
        r2: vec3(2.0f32 * (x * z - w * y), 2.0f32 * (y * z + w * x), 1.0f32 - 2.0f32 * (x * x + y * y)),
        w,
        q: vec3(x, y, z),
        inverse_norm,
        ok,
    }
}

/// A Gaussian in a camera; `cpu::project::Projected`.
#[derive(CubeType)]
struct Projected {
    p: V3,
    iz: f32,
    clamped_x: bool,
    clamped_y: bool,
    /// Rows of the rotation times scale.
    m0: V3,
    m1: V3,
    m2: V3,
    /// Jacobian of the projection times the camera's rotation.
    tx: V3,
    ty: V3,
    /// t x m: the covariance in the image is b b' + blur.
    bx: V3,
    by: V3,
    xx: f32,
    xy: f32,
    yy: f32,
    minor: V3,
    inverse_det: f32,
    mean_x: f32,
    mean_y: f32,
    ok: bool,
}

#[cube]
fn project_one(g: &Gaussian, cam: &Pinhole, near: f32, far: f32, blur: f32) -> Projected {
    let px = dot(&cam.r0, &g.mean) + cam.translation.x;
    let py = dot(&cam.r1, &g.mean) + cam.translation.y;
    let pz = dot(&cam.r2, &g.mean) + cam.translation.z;
    let mut ok = g.ok && finite(px) && finite(py) && finite(pz) && pz >= near && pz <= far;
    let p = vec3(select(ok, px, 0.0f32), select(ok, py, 0.0f32), select(ok, pz, 1.0f32));
    let iz = 1.0f32 / p.z;
    let ux = p.x * iz;
    let uy = p.y * iz;
    let mean_x = cam.fx * ux + cam.cx;
    let mean_y = cam.fy * uy + cam.cy;
    ok = ok && finite(mean_x) && finite(mean_y) && mean_x.abs() <= MAX_COORDINATE && mean_y.abs() <= MAX_COORDINATE;
    let slope_x = min(max(ux, cam.low_x), cam.high_x);
    let slope_y = min(max(uy, cam.low_y), cam.high_y);
    let fx = cam.fx * iz;
    let fy = cam.fy * iz;
    let tx = mix(&cam.r0, fx, &cam.r2, -slope_x * fx);
    let ty = mix(&cam.r1, fy, &cam.r2, -slope_y * fy);
    let m0 = times(&g.r0, &g.scale);
    let m1 = times(&g.r1, &g.scale);
    let m2 = times(&g.r2, &g.scale);
    let bx = vec3(
        tx.x * m0.x + tx.y * m1.x + tx.z * m2.x,
        tx.x * m0.y + tx.y * m1.y + tx.z * m2.y,
        tx.x * m0.z + tx.y * m1.z + tx.z * m2.z,
    );
    let by = vec3(
        ty.x * m0.x + ty.y * m1.x + ty.z * m2.x,
        ty.x * m0.y + ty.y * m1.y + ty.z * m2.y,
        ty.x * m0.z + ty.y * m1.z + ty.z * m2.z,
    );
    let xx = dot(&bx, &bx);
    let xy = dot(&bx, &by);
    let yy = dot(&by, &by);
    // det(b b' + blur 1) by Cauchy-Binet, a sum of squares: no cancellation for needles.
    let minor = cross(&bx, &by);
    let det = dot(&minor, &minor) + blur * (xx + yy + blur);
    ok = ok
        && finite(xx)
        && finite(yy)
        && finite(det)
        && xx + blur <= MAX_COVARIANCE
        && yy + blur <= MAX_COVARIANCE
        && det > 0.0f32;
    let inverse_det = 1.0f32 / select(ok, det, 1.0f32);
    ok = ok && finite(inverse_det) && inverse_det > 0.0f32;
    Projected {
        p,
        iz,
        clamped_x: ux < cam.low_x || ux > cam.high_x,
        clamped_y: uy < cam.low_y || uy > cam.high_y,
        m0,
        m1,
        m2,
        tx,
        ty,
        bx,
        by,
        xx: xx + blur,
        xy,
        yy: yy + blur,
        minor,
        inverse_det,
        mean_x,
        mean_y,
        ok,
    }
}

/// Writes splats and sort keys, `[images, n]`, and clears the mask, for which no Gaussian has a bit yet.
#[cube(launch_unchecked)]
pub fn project(
    gaussians: &[f32],  // [objects, n, 14]
    cameras: &[f32],    // [all images, 24]
    records: &mut [F4], // [images, n, RECORD]
    keys: &mut [u32],   // [images, n]
    mask: &mut [u32],   // [images, tiles, words]
    frame: Frame,
) {
    let id = CUBE_POS * CUBE_DIM as usize + UNIT_POS as usize;
    let count = frame.images as usize * frame.n as usize;
    let bits = frame.images as usize * frame.tiles as usize * frame.words as usize;
    let mut at = id;
    while at < bits {
        mask[at] = 0u32;
        at += count;
    }
    if id < count {
        let image = frame.first as usize + id / frame.n as usize;
        let row = image / frame.views as usize * frame.n as usize + id % frame.n as usize;
        let g = load_gaussian(gaussians, row);
        let cam = load_camera(cameras, image);
        let v = project_one(&g, &cam, frame.near, frame.far, frame.blur);
        let logit = select(g.ok, gaussians[row * CHANNELS + 10], 0.0f32);
        let ln_opacity = -(1.0f32 + bounded_exp(-logit)).ln();
        let xx = select(v.ok, v.xx, 1.0f32);
        let yy = select(v.ok, v.yy, 1.0f32);
        let isy = 1.0f32 / yy.sqrt();
        let isd = v.inverse_det.sqrt();
        // Where it is at least 1/255 opaque.
        let reach = (2.0f32 * max(ln_opacity + LN_255, 0.0f32)).sqrt();
        let half_x = reach * xx.sqrt();
        let half_y = reach * yy.sqrt();
        let seen = v.ok
            && ln_opacity >= -LN_255
            && v.mean_x + half_x > 0.0f32
            && v.mean_x - half_x < f32::cast_from(frame.width)
            && v.mean_y + half_y > 0.0f32
            && v.mean_y - half_y < f32::cast_from(frame.height);
        keys[id] = select(seen, v.p.z.to_bits(), CULLED);
        if seen {
            // Chosen so that exp(-sigma) = exp(-u^2 - v^2).
            let unit = 0.707_106_77f32;
            let color = row * CHANNELS + 11;
            let at = id * RECORD;
            records[at] = pack(v.mean_x, v.mean_y, unit * yy * isy * isd, -unit * v.xy * isy * isd);
            records[at + 1] = pack(unit * isy, ln_opacity, gaussians[color], gaussians[color + 1]);
            records[at + 2] = pack(gaussians[color + 2], 0.0f32, 0.0f32, 0.0f32);
        }
    }
}

/// Pulls the sums over pixels of all views back to the channels of the Gaussians, and writes their gradient, or adds it
/// if `keep` is not 0. Views in order, so that the result does not depend on chance.
#[cube(launch_unchecked)]
pub fn project_backward(
    gaussians: &[f32], // [objects, n, 14]
    cameras: &[f32],   // [all images, 24]
    sums: &[f32],      // [images, n, SUMS]
    out: &mut [f32],   // [objects, n, 14]
    frame: Frame,
    first_object: u32,
    objects: u32,
    keep: u32,
) {
    let id = CUBE_POS * CUBE_DIM as usize + UNIT_POS as usize;
    let n = frame.n as usize;
    if id < objects as usize * n {
        let object = first_object as usize + id / n;
        let row = object * n + id % n;
        let g = load_gaussian(gaussians, row);
        let mut d_mean = vec3(0.0f32, 0.0f32, 0.0f32);
        let mut d_scale = vec3(0.0f32, 0.0f32, 0.0f32);
        let mut d_color = vec3(0.0f32, 0.0f32, 0.0f32);
        // d loss / d (rotation times scale), rows
        let mut d0 = vec3(0.0f32, 0.0f32, 0.0f32);
        let mut d1 = vec3(0.0f32, 0.0f32, 0.0f32);
        let mut d2 = vec3(0.0f32, 0.0f32, 0.0f32);
        let mut d_ln_opacity = 0.0f32;
        let mut touched = false;
        // This object's images that are in the group.
        let views = frame.views as usize;
        let start = max(object * views, frame.first as usize);
        let end = min((object + 1) * views, (frame.first + frame.images) as usize);
        for image in start..end {
            let s = ((image - frame.first as usize) * n + id % n) * SUMS;
            let mut drawn = false;
            #[unroll]
            for k in 0..SUMS {
                drawn = drawn || sums[s + k] != 0.0f32;
            }
            // Where nothing was drawn, the projection may be anything, also not a number.
            if drawn {
                touched = true;
                let cam = load_camera(cameras, image);
                let v = project_one(&g, &cam, frame.near, frame.far, frame.blur);
                let ka = v.yy * v.inverse_det;
                let kb = -v.xy * v.inverse_det;
                let kc = v.xx * v.inverse_det;
                let d_x = ka * sums[s + 1] + kb * sums[s + 2];
                let d_y = kb * sums[s + 1] + kc * sums[s + 2];
                // d loss / d b = K (sum g d d') K b, with K b by the minors of b: K times b would cancel for needles.
                let towards_x = cross(&v.by, &v.minor);
                let towards_y = cross(&v.minor, &v.bx);
                let kbx = mix(&towards_x, v.inverse_det, &v.bx, frame.blur * v.inverse_det);
                let kby = mix(&towards_y, v.inverse_det, &v.by, frame.blur * v.inverse_det);
                let along_x = mix(&kbx, sums[s + 3], &kby, sums[s + 4]);
                let along_y = mix(&kbx, sums[s + 4], &kby, sums[s + 5]);
                let d_bx = mix(&along_x, ka, &along_y, kb);
                let d_by = mix(&along_x, kb, &along_y, kc);
                d_scale = add3(&d_scale, &times(&kbx, &along_x), &times(&kby, &along_y));
                d0 = add3(&d0, &scaled(&d_bx, v.tx.x), &scaled(&d_by, v.ty.x));
                d1 = add3(&d1, &scaled(&d_bx, v.tx.y), &scaled(&d_by, v.ty.y));
                d2 = add3(&d2, &scaled(&d_bx, v.tx.z), &scaled(&d_by, v.ty.z));
                let d_tx = vec3(dot(&d_bx, &v.m0), dot(&d_bx, &v.m1), dot(&d_bx, &v.m2));
                let d_ty = vec3(dot(&d_by, &v.m0), dot(&d_by, &v.m1), dot(&d_by, &v.m2));
                // t_i = f_i iz (w_i - slope_i w_2), mean2d_i = f_i p_i iz + c_i
                let d_slope_x = select(v.clamped_x, 0.0f32, -cam.fx * v.iz * dot(&d_tx, &cam.r2));
                let d_slope_y = select(v.clamped_y, 0.0f32, -cam.fy * v.iz * dot(&d_ty, &cam.r2));
                let d_ux = d_slope_x + d_x * cam.fx;
                let d_uy = d_slope_y + d_y * cam.fy;
                let d_z = -v.iz * (d_ux * v.p.x * v.iz + d_uy * v.p.y * v.iz + dot(&d_tx, &v.tx) + dot(&d_ty, &v.ty));
                let d_xy = mix(&cam.r0, d_ux * v.iz, &cam.r1, d_uy * v.iz);
                d_mean = add3(&d_mean, &d_xy, &scaled(&cam.r2, d_z));
                d_color = add(&d_color, &vec3(sums[s + 6], sums[s + 7], sums[s + 8]));
                d_ln_opacity += sums[s];
            }
        }
        // m = r diag(s)
        let g0 = times(&d0, &g.scale);
        let g1 = times(&d1, &g.scale);
        let g2 = times(&d2, &g.scale);
        let w = g.w;
        let q = vec3(g.q.x, g.q.y, g.q.z);
        let dw = 2.0f32 * (q.x * (g2.y - g1.z) + q.y * (g0.z - g2.x) + q.z * (g1.x - g0.y));
        let dq = vec3(
            2.0f32 * (q.y * (g0.y + g1.x) + q.z * (g0.z + g2.x) - 2.0f32 * q.x * (g1.y + g2.z) + w * (g2.y - g1.z)),
            2.0f32 * (q.x * (g0.y + g1.x) + q.z * (g1.z + g2.y) - 2.0f32 * q.y * (g0.x + g2.z) + w * (g0.z - g2.x)),
            2.0f32 * (q.x * (g0.z + g2.x) + q.y * (g1.z + g2.y) - 2.0f32 * q.z * (g0.x + g1.y) + w * (g1.x - g0.y)),
        );
        // q = raw / |raw|
        let along = dw * w + dot(&dq, &q);
        // 1 - opacity, without cancellation where the opacity is near 1.
        let e = bounded_exp(-select(g.ok, gaussians[row * CHANNELS + 10], 0.0f32));
        let o = row * CHANNELS;
        let keep = keep != 0u32;
        put(out, o, d_mean.x, keep, touched);
        put(out, o + 1, d_mean.y, keep, touched);
        put(out, o + 2, d_mean.z, keep, touched);
        put(out, o + 3, d_scale.x, keep, touched);
        put(out, o + 4, d_scale.y, keep, touched);
        put(out, o + 5, d_scale.z, keep, touched);
        put(out, o + 6, (dw - along * w) * g.inverse_norm, keep, touched);
        put(out, o + 7, (dq.x - along * q.x) * g.inverse_norm, keep, touched);
        put(out, o + 8, (dq.y - along * q.y) * g.inverse_norm, keep, touched);
        put(out, o + 9, (dq.z - along * q.z) * g.inverse_norm, keep, touched);
        put(out, o + 10, d_ln_opacity * (e / (1.0f32 + e)), keep, touched);
        put(out, o + 11, d_color.x, keep, touched);
        put(out, o + 12, d_color.y, keep, touched);
        put(out, o + 13, d_color.z, keep, touched);
    }
}

#[cube]
fn add3(a: &V3, b: &V3, c: &V3) -> V3 {
    V3 { x: a.x + b.x + c.x, y: a.y + b.y + c.y, z: a.z + b.z + c.z }
}

/// Sets or increases `out[at]`. Gaussians that touch no pixel get exactly zero.
#[cube]
fn put(out: &mut [f32], at: usize, value: f32, keep: bool, touched: bool) {
    let new = select(touched, value, 0.0f32);
    if keep {
        out[at] += new;
    } else {
        out[at] = new;
    }
}
