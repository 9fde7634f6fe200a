//! From Gaussians to splats: projection by one camera (EWA, first order), and its derivative.
//!
//! Both work on [`LANES`] Gaussians at a time, every quantity in its own array over lanes.

use super::math::{LANES, dot, exp, floor_index, fma, log2, max, min};
use crate::{CHANNELS, RasterConfig};
use freerange_scene::camera::Camera;

/// A Gaussian seen by one camera, ready to be drawn.
///
/// With `(dx, dy)` = pixel center - mean, `u = l11 dx + l21 dy` and `v = l22 dy`, its opacity at the pixel is
/// `2^(log2_opacity - u^2 - v^2)`: the `l` are the Cholesky factor of the inverse covariance, in units that save a
/// multiplication. A sum of squares cannot turn negative by rounding, unlike `a dx^2 + 2 b dx dy + c dy^2`.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(64))]
pub struct Splat {
    /// Mean in the image, in pixels.
    pub x: f32,
    pub y: f32,
    pub l11: f32,
    pub l21: f32,
    pub l22: f32,
    pub log2_opacity: f32,
    pub color: [f32; 3],
    /// Camera z.
    pub depth: f32,
    /// Where the ellipse `opacity >= 1/255` lies: `x = mean + slope dy +- half_width sqrt(1 - (dy / half_height)^2)`.
    pub slope: f32,
    pub half_width: f32,
    pub half_height: f32,
    /// dy of its rightmost point.
    pub dy_right: f32,
    /// First and last row of pixel centers within it.
    pub rows: [u16; 2],
    /// Index of the Gaussian.
    pub index: u32,
}

/// What the projection needs of a camera, as f32.
#[derive(Clone, Copy, Debug)]
pub struct Pinhole {
    pub rotation: [[f32; 3]; 3], // rows: world to camera
    pub translation: [f32; 3],
    pub focal: [f32; 2],
    pub center: [f32; 2],
    /// Range of x/z and y/z within which the projection is linearized where the Gaussian is; beyond, at the end.
    pub low: [f32; 2],
    pub high: [f32; 2],
}

impl Pinhole {
    pub fn new(camera: &Camera) -> Self {
        let m = camera.world_to_camera;
        let columns = [m.x_axis, m.y_axis, m.z_axis];
        let (focal, center) = ([camera.fx, camera.fy], [camera.cx, camera.cy]);
        let size = [f64::from(camera.width), f64::from(camera.height)];
        Self {
            rotation: std::array::from_fn(|r| std::array::from_fn(|c| columns[c][r] as f32)),
            translation: std::array::from_fn(|r| m.w_axis[r] as f32),
            focal: focal.map(|v| v as f32),
            center: center.map(|v| v as f32),
            low: std::array::from_fn(|i| (-(center[i] + 0.15 * size[i]) / focal[i]) as f32),
            high: std::array::from_fn(|i| ((size[i] - center[i] + 0.15 * size[i]) / focal[i]) as f32),
        }
    }
}

/// Gaussians whose standard deviation in the image exceeds a million pixels are culled: f32 cannot place them.
const MAX_COVARIANCE: f32 = 1e12;
/// So are those whose mean lies ten million pixels away.
const MAX_COORDINATE: f32 = 1e7;
/// And those with a color beyond a million: their neighbors' gradients would overflow.
const MAX_COLOR: f32 = 1e6;
/// log2(255): a splat of this many halvings below full opacity is invisible.
pub const LOG2_255: f32 = 7.994_353_3;

/// Channels over lanes.
type Lanes<const C: usize> = [[f32; LANES]; C];

/// Loads up to [`LANES`] Gaussians, channel by channel; lanes beyond the end get NaN, which culls them.
#[inline(always)]
fn load(rows: &[f32]) -> Lanes<CHANNELS> {
    let mut out = [[f32::NAN; LANES]; CHANNELS];
    for (lane, row) in rows.as_chunks::<CHANNELS>().0.iter().enumerate().take(LANES) {
        for c in 0..CHANNELS {
            out[c][lane] = row[c];
        }
    }
    out
}

/// One lane's rotation matrix times scale, and what its derivative needs.
struct Shape {
    m: [[f32; 3]; 3], // rotation x diag(scale)
    s: [f32; 3],
    q: [f32; 4], // unit
    inverse_norm: f32,
    ok: bool,
}

#[inline(always)]
fn shape<const FMA: bool>(c: &Lanes<CHANNELS>, l: usize) -> Shape {
    let raw = [c[6][l], c[7][l], c[8][l], c[9][l]];
    let norm2 = raw[0] * raw[0] + raw[1] * raw[1] + raw[2] * raw[2] + raw[3] * raw[3];
    let inverse_norm = 1.0 / norm2.sqrt();
    let q = [raw[0] * inverse_norm, raw[1] * inverse_norm, raw[2] * inverse_norm, raw[3] * inverse_norm];
    let [w, x, y, z] = q;
    let r = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ];
    let s = [exp::<FMA>(c[3][l]), exp::<FMA>(c[4][l]), exp::<FMA>(c[5][l])];
    let m = [
        [r[0][0] * s[0], r[0][1] * s[1], r[0][2] * s[2]],
        [r[1][0] * s[0], r[1][1] * s[1], r[1][2] * s[2]],
        [r[2][0] * s[0], r[2][1] * s[1], r[2][2] * s[2]],
    ];
    // The reference takes the norm as at least 1e-12; what is shorter, or overflows, has no rotation at all.
    Shape { m, s, q, inverse_norm, ok: (norm2 > 1e-24) & (norm2 < 1e37) }
}

/// One lane's Gaussian in one camera.
struct Projected {
    p: [f32; 3], // camera coordinates of the mean
    iz: f32,
    clamped: [bool; 2], // whether x/z and y/z were
    t: [[f32; 3]; 2],   // Jacobian of the projection times the camera's rotation
    b: [[f32; 3]; 2],   // t x m: the covariance in the image is b b' + blur
    cov: [f32; 3],      // xx, xy, yy with blur
    minor: [f32; 3],    // of b: columns 12, 20, 01
    inverse_det: f32,
    mean: [f32; 2],
}

#[inline(always)]
fn project_lane<const FMA: bool>(mean: [f32; 3], m: &[[f32; 3]; 3], cam: &Pinhole, blur: f32) -> Projected {
    let w = &cam.rotation;
    let p = [
        dot::<FMA>(w[0], mean) + cam.translation[0],
        dot::<FMA>(w[1], mean) + cam.translation[1],
        dot::<FMA>(w[2], mean) + cam.translation[2],
    ];
    let iz = 1.0 / p[2];
    let (ux, uy) = (p[0] * iz, p[1] * iz);
    let slope = [min(max(ux, cam.low[0]), cam.high[0]), min(max(uy, cam.low[1]), cam.high[1])];
    let (f0, f1) = (cam.focal[0] * iz, cam.focal[1] * iz);
    let t = [
        [
            f0 * fma::<FMA>(-slope[0], w[2][0], w[0][0]),
            f0 * fma::<FMA>(-slope[0], w[2][1], w[0][1]),
            f0 * fma::<FMA>(-slope[0], w[2][2], w[0][2]),
        ],
        [
            f1 * fma::<FMA>(-slope[1], w[2][0], w[1][0]),
            f1 * fma::<FMA>(-slope[1], w[2][1], w[1][1]),
            f1 * fma::<FMA>(-slope[1], w[2][2], w[1][2]),
        ],
    ];
    let column = |k: usize| [m[0][k], m[1][k], m[2][k]];
    let b = [
        [dot::<FMA>(t[0], column(0)), dot::<FMA>(t[0], column(1)), dot::<FMA>(t[0], column(2))],
        [dot::<FMA>(t[1], column(0)), dot::<FMA>(t[1], column(1)), dot::<FMA>(t[1], column(2))],
    ];
    let (xx, xy, yy) = (dot::<FMA>(b[0], b[0]), dot::<FMA>(b[0], b[1]), dot::<FMA>(b[1], b[1]));
    // det(b b' + blur 1) by Cauchy-Binet, a sum of squares: no cancellation for needles.
    let minor = [
        b[0][1] * b[1][2] - b[0][2] * b[1][1],
        b[0][2] * b[1][0] - b[0][0] * b[1][2],
        b[0][0] * b[1][1] - b[0][1] * b[1][0],
    ];
    let det = dot::<FMA>(minor, minor) + blur * (xx + yy + blur);
    Projected {
        p,
        iz,
        clamped: [(ux < cam.low[0]) | (ux > cam.high[0]), (uy < cam.low[1]) | (uy > cam.high[1])],
        t,
        b,
        cov: [xx + blur, xy, yy + blur],
        minor,
        inverse_det: 1.0 / det,
        mean: [fma::<FMA>(cam.focal[0], ux, cam.center[0]), fma::<FMA>(cam.focal[1], uy, cam.center[1])],
    }
}

/// Projects the Gaussians `rows` (`[<= LANES, 14]`, the first has index `first`) and appends those that can touch a
/// pixel of a `size` = (width, height) image to `out`, in index order.
#[inline(always)]
pub fn project<const FMA: bool>(
    rows: &[f32],
    first: u32,
    cam: &Pinhole,
    size: [u32; 2],
    config: &RasterConfig,
    out: &mut Vec<Splat>,
) {
    let channels = load(rows);
    let mut o = [[0f32; LANES]; 13];
    let mut rows_of = [[0u32; LANES]; 2];
    let mut keep = [0u32; LANES];
    for l in 0..LANES {
        let shape = shape::<FMA>(&channels, l);
        let v = project_lane::<FMA>([channels[0][l], channels[1][l], channels[2][l]], &shape.m, cam, config.blur);
        let mut finite = 0.0; // NaN if any channel is NaN or infinite
        for c in 0..CHANNELS {
            finite += channels[c][l] * 0.0;
        }
        let opacity = 1.0 / (1.0 + exp::<FMA>(-channels[10][l]));
        let log2_opacity = log2::<FMA>(opacity);
        let [xx, xy, yy] = v.cov;
        // Chosen so that exp(-sigma) = 2^(-u^2 - v^2): sigma log2(e) = u^2 + v^2.
        const UNIT: f32 = 0.849_321_8; // sqrt(log2(e) / 2)
        let isy = 1.0 / yy.sqrt();
        let isd = v.inverse_det.sqrt();
        // u^2 + v^2 <= reach2 is where the splat is at least 1/255 opaque.
        let reach = (max(log2_opacity + LOG2_255, 0.0)).sqrt() / UNIT;
        o[0][l] = v.mean[0];
        o[1][l] = v.mean[1];
        o[2][l] = UNIT * yy * isy * isd;
        o[3][l] = -UNIT * xy * isy * isd;
        o[4][l] = UNIT * isy;
        o[5][l] = log2_opacity;
        o[6][l] = v.p[2];
        o[7][l] = xy / yy;
        o[8][l] = reach * isy / isd;
        o[9][l] = reach * yy * isy;
        let half_extent_x = reach * xx.sqrt();
        o[10][l] = half_extent_x * xy / xx;
        o[11][l] = v.mean[0] - half_extent_x;
        o[12][l] = v.mean[0] + half_extent_x;
        // Rows of pixel centers, with a hundredth of a pixel to spare, so that rounding cannot lose one: the kernel
        // tests every pixel anyway.
        let top = max(v.mean[1] - o[9][l] + 0.49, 0.0);
        let bottom = min(v.mean[1] + o[9][l] - 0.49, size[1] as f32 - 1.0);
        rows_of[0][l] = floor_index(min(top, size[1] as f32));
        rows_of[1][l] = floor_index(max(bottom, 0.0));
        let ok = shape.ok
            & (finite == 0.0)
            & (channels[11][l].abs() <= MAX_COLOR)
            & (channels[12][l].abs() <= MAX_COLOR)
            & (channels[13][l].abs() <= MAX_COLOR)
            & (v.p[2] >= config.near)
            & (v.p[2] <= config.far)
            & (log2_opacity >= -LOG2_255)
            & (xx <= MAX_COVARIANCE)
            & (yy <= MAX_COVARIANCE)
            & (v.inverse_det > 0.0)
            & (v.inverse_det < f32::INFINITY)
            & (v.mean[0].abs() <= MAX_COORDINATE)
            & (v.mean[1].abs() <= MAX_COORDINATE)
            & (o[12][l] > 0.0)
            & (o[11][l] < size[0] as f32)
            & (bottom >= 0.0)
            & (rows_of[0][l] <= rows_of[1][l]);
        keep[l] = u32::from(ok);
    }
    for l in 0..LANES {
        if keep[l] == 0 {
            continue;
        }
        out.push(Splat {
            x: o[0][l],
            y: o[1][l],
            l11: o[2][l],
            l21: o[3][l],
            l22: o[4][l],
            log2_opacity: o[5][l],
            color: [channels[11][l], channels[12][l], channels[13][l]],
            depth: o[6][l],
            slope: o[7][l],
            half_width: o[8][l],
            half_height: o[9][l],
            dy_right: o[10][l],
            rows: [rows_of[0][l] as u16, rows_of[1][l] as u16],
            index: first + l as u32,
        });
    }
}

/// Sums over the pixels of one view, for one Gaussian, of `g` = d loss / d ln(alpha) and of the blending weights.
///
/// In this order: `g`, `g dx`, `g dy`, `g dx^2`, `g dx dy`, `g dy^2` with `(dx, dy)` = pixel center - mean;
/// d loss / d color (3); d loss / d depth; two zeros.
pub const SUMS: usize = 12;

/// Pulls the pixel sums of all `views` back to the channels of the Gaussians `rows` (`[<= LANES, 14]`, the first has
/// index `first`), and writes their gradient `out`, `[<= LANES, 14]`.
#[inline(always)]
pub fn project_backward<const FMA: bool>(
    rows: &[f32],
    first: usize,
    views: &[(Pinhole, &[[f32; SUMS]])],
    blur: f32,
    out: &mut [f32],
) {
    let count = rows.len() / CHANNELS;
    let channels = load(rows);
    let mut d_mean = [[0f32; LANES]; 3];
    let mut d_m = [[0f32; LANES]; 9];
    let mut d_log_scale = [[0f32; LANES]; 3];
    let mut d_color = [[0f32; LANES]; 3];
    let mut d_log_opacity = [0f32; LANES];
    let mut touched = [0f32; LANES];
    for (cam, sums) in views {
        let mut s = [[0f32; LANES]; SUMS];
        for (lane, row) in sums[first..first + count].iter().enumerate() {
            for c in 0..SUMS {
                s[c][lane] = row[c];
            }
        }
        for l in 0..LANES {
            let shape = shape::<FMA>(&channels, l);
            let v = project_lane::<FMA>([channels[0][l], channels[1][l], channels[2][l]], &shape.m, cam, blur);
            let (ka, kb, kc) = (v.cov[2] * v.inverse_det, -v.cov[1] * v.inverse_det, v.cov[0] * v.inverse_det);
            let (sxx, sxy, syy) = (s[3][l], s[4][l], s[5][l]);
            // d loss / d mean2d = K (sum g d)
            let d_x = ka * s[1][l] + kb * s[2][l];
            let d_y = kb * s[1][l] + kc * s[2][l];
            // d loss / d covariance = K (sum g d d') K / 2, hence d loss / d b = K (sum g d d') K b.
            // K b by the minors of b: the entries of K times b would cancel for needles.
            let ([bx, by], [m12, m20, m01]) = (v.b, v.minor);
            let kbx = [
                v.inverse_det * (by[1] * m01 - by[2] * m20 + blur * bx[0]),
                v.inverse_det * (by[2] * m12 - by[0] * m01 + blur * bx[1]),
                v.inverse_det * (by[0] * m20 - by[1] * m12 + blur * bx[2]),
            ];
            let kby = [
                v.inverse_det * (bx[2] * m20 - bx[1] * m01 + blur * by[0]),
                v.inverse_det * (bx[0] * m01 - bx[2] * m12 + blur * by[1]),
                v.inverse_det * (bx[1] * m12 - bx[0] * m20 + blur * by[2]),
            ];
            let mut d_b = [[0f32; 3]; 2];
            let mut d_scale = [0f32; 3];
            for k in 0..3 {
                let (px, py) = (sxx * kbx[k] + sxy * kby[k], sxy * kbx[k] + syy * kby[k]);
                d_scale[k] = kbx[k] * px + kby[k] * py; // b' d loss / d b
                d_b[0][k] = ka * px + kb * py;
                d_b[1][k] = kb * px + kc * py;
            }
            let m = &shape.m;
            let (mut d_t, w) = ([[0f32; 3]; 2], &cam.rotation);
            let mut d_matrix = [0f32; 9];
            for r in 0..3 {
                for k in 0..3 {
                    d_matrix[3 * r + k] = v.t[0][r] * d_b[0][k] + v.t[1][r] * d_b[1][k];
                }
                d_t[0][r] = dot::<FMA>(d_b[0], m[r]);
                d_t[1][r] = dot::<FMA>(d_b[1], m[r]);
            }
            // t_i = f_i iz (w_i - slope_i w_2), mean2d_i = f_i p_i iz + c_i
            let (fx, fy) = (cam.focal[0], cam.focal[1]);
            let d_slope_x = if v.clamped[0] { 0.0 } else { -fx * v.iz * dot::<FMA>(d_t[0], w[2]) };
            let d_slope_y = if v.clamped[1] { 0.0 } else { -fy * v.iz * dot::<FMA>(d_t[1], w[2]) };
            let d_ux = d_slope_x + d_x * fx; // with respect to x/z
            let d_uy = d_slope_y + d_y * fy;
            let d_z = -v.iz
                * (d_ux * v.p[0] * v.iz
                    + d_uy * v.p[1] * v.iz
                    + dot::<FMA>(d_t[0], v.t[0])
                    + dot::<FMA>(d_t[1], v.t[1]))
                + s[9][l];
            let d_p = [d_ux * v.iz, d_uy * v.iz, d_z];
            // Where nothing was drawn, the projection may be anything, also not a number.
            let mut drawn = 0.0;
            for c in 0..SUMS {
                drawn = if s[c][l] == 0.0 { drawn } else { 1.0 };
            }
            let pick = |value: f32| if drawn == 0.0 { 0.0 } else { value };
            touched[l] = if drawn == 0.0 { touched[l] } else { 1.0 };
            for k in 0..3 {
                d_mean[k][l] += pick(dot::<FMA>([w[0][k], w[1][k], w[2][k]], d_p));
                d_color[k][l] += s[6 + k][l];
                d_log_scale[k][l] += pick(d_scale[k]);
            }
            for k in 0..9 {
                d_m[k][l] += pick(d_matrix[k]);
            }
            d_log_opacity[l] += s[0][l];
        }
    }
    let mut d = [[0f32; LANES]; CHANNELS];
    for l in 0..LANES {
        let Shape { s, q: [w, x, y, z], inverse_norm, .. } = shape::<FMA>(&channels, l);
        // m = r diag(s)
        let mut g = [[0f32; 3]; 3]; // d loss / d r
        for i in 0..3 {
            for k in 0..3 {
                g[i][k] = d_m[3 * i + k][l] * s[k];
            }
        }
        let dq = [
            2.0 * (x * (g[2][1] - g[1][2]) + y * (g[0][2] - g[2][0]) + z * (g[1][0] - g[0][1])),
            2.0 * (y * (g[0][1] + g[1][0]) + z * (g[0][2] + g[2][0]) - 2.0 * x * (g[1][1] + g[2][2])
                + w * (g[2][1] - g[1][2])),
            2.0 * (x * (g[0][1] + g[1][0]) + z * (g[1][2] + g[2][1]) - 2.0 * y * (g[0][0] + g[2][2])
                + w * (g[0][2] - g[2][0])),
            2.0 * (x * (g[0][2] + g[2][0]) + y * (g[1][2] + g[2][1]) - 2.0 * z * (g[0][0] + g[1][1])
                + w * (g[1][0] - g[0][1])),
        ];
        // q = raw / |raw|
        let along = dq[0] * w + dq[1] * x + dq[2] * y + dq[3] * z;
        let q = [w, x, y, z];
        // 1 - opacity, without cancellation where the opacity is near 1.
        let e = exp::<FMA>(-channels[10][l]);
        let pick = |value: f32| if touched[l] == 0.0 { 0.0 } else { value };
        for k in 0..3 {
            d[k][l] = d_mean[k][l];
            d[3 + k][l] = d_log_scale[k][l];
            d[11 + k][l] = d_color[k][l];
        }
        for k in 0..4 {
            d[6 + k][l] = pick((dq[k] - along * q[k]) * inverse_norm);
        }
        d[10][l] = pick(d_log_opacity[l] * (e / (1.0 + e)));
    }
    for (lane, row) in out.as_chunks_mut::<CHANNELS>().0.iter_mut().enumerate().take(count) {
        for c in 0..CHANNELS {
            row[c] = d[c][lane];
        }
    }
}
