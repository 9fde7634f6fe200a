//! The rasterizer again, as plainly as possible: f64, one pixel after the other, every Gaussian at every pixel, and
//! derivatives of the projection by forward-mode differentiation. It is what the fast paths are tested against.

use crate::{CHANNELS, RasterConfig};
use freerange_scene::camera::Camera;
use std::ops::{Add, Div, Mul, Neg, Sub};

/// One rendered view, row-major.
#[derive(Clone, Debug)]
pub struct Image {
    /// `[height, width, 3]`
    pub rgb: Vec<f64>,
    /// `[height, width]`
    pub alpha: Vec<f64>,
    /// Sum of blending weight times camera z, `[height, width]`.
    pub depth: Vec<f64>,
}

/// d loss / d image, in the layout of [`Image`].
pub type ImageGrad = Image;

/// Renders `gaussians` (`[n, 14]`) from one camera. Inputs must be finite; see [`crate::render`] for the others.
pub fn render(gaussians: &[f32], camera: &Camera, background: [f32; 3], config: &RasterConfig) -> Image {
    let splats = project_all(gaussians, camera, config);
    let mut image = Image { rgb: vec![], alpha: vec![], depth: vec![] };
    for_each_pixel(camera, |_, x, y| {
        let (drawn, t) = blend(&splats, x, y);
        let sum =
            |value: &dyn Fn(&Splat) -> f64| -> f64 { drawn.iter().map(|d| d.weight * value(&splats[d.splat])).sum() };
        for c in 0..3 {
            image.rgb.push(sum(&|s| s.color[c].value) + t * f64::from(background[c]));
        }
        image.alpha.push(1.0 - t);
        image.depth.push(sum(&|s| s.depth.value));
    });
    image
}

/// d loss / d Gaussians (`[n, 14]`) and d loss / d background, given d loss / d image.
pub fn render_backward(
    gaussians: &[f32],
    camera: &Camera,
    background: [f32; 3],
    config: &RasterConfig,
    grad: &ImageGrad,
) -> (Vec<f64>, [f64; 3]) {
    let splats = project_all(gaussians, camera, config);
    let mut d_gaussians = vec![0.0; gaussians.len()];
    let mut d_background = [0.0; 3];
    for_each_pixel(camera, |pixel, x, y| {
        let (drawn, t) = blend(&splats, x, y);
        let d_rgb = &grad.rgb[3 * pixel..3 * pixel + 3];
        // What is seen behind the splat at hand, times d loss / d pixel.
        let mut behind = -grad.alpha[pixel];
        for c in 0..3 {
            d_background[c] += t * d_rgb[c];
            behind += d_rgb[c] * f64::from(background[c]);
        }
        for d in drawn.iter().rev() {
            let s = &splats[d.splat];
            let own = (0..3).map(|c| d_rgb[c] * s.color[c].value).sum::<f64>() + grad.depth[pixel] * s.depth.value;
            let d_alpha = d.weight / d.alpha.value * (own - behind);
            behind += d.alpha.value * (own - behind);
            for k in 0..CHANNELS {
                let d_color: f64 = (0..3).map(|c| d_rgb[c] * s.color[c].d[k]).sum();
                d_gaussians[s.index * CHANNELS + k] +=
                    d_alpha * d.alpha.d[k] + d.weight * (d_color + grad.depth[pixel] * s.depth.d[k]);
            }
        }
    });
    (d_gaussians, d_background)
}

/// How many (Gaussian, pixel) pairs have an opacity of at least 1/255, occluded or not: the unit of work in benchmarks.
pub fn count_pairs(gaussians: &[f32], camera: &Camera, config: &RasterConfig) -> usize {
    let mut count = 0;
    for s in project_all(gaussians, camera, config) {
        let ([a, b, c], [x, y]) = (s.conic.map(|v| v.value), s.mean.map(|v| v.value));
        let reach = 2.0 * (255.0 * s.opacity.value).ln(); // the largest dx' conic dx
        if reach <= 0.0 {
            continue;
        }
        let det = a * c - b * b;
        let half_height = (reach * a / det).sqrt();
        let rows =
            (y - half_height - 0.5).ceil().max(0.0)..(y + half_height + 0.5).min(f64::from(camera.height)).floor();
        for row in rows.start as i64..rows.end as i64 {
            let dy = row as f64 + 0.5 - y;
            // a dx^2 + 2 b dx dy + c dy^2 = reach
            let half_width = ((b * b - a * c) * dy * dy + a * reach).max(0.0).sqrt() / a;
            let middle = x - b / a * dy;
            let first = (middle - half_width - 0.5).ceil().max(0.0);
            let last = (middle + half_width - 0.5).floor().min(f64::from(camera.width) - 1.0);
            count += (last - first + 1.0).max(0.0) as usize;
        }
    }
    count
}

fn for_each_pixel(camera: &Camera, mut f: impl FnMut(usize, f64, f64)) {
    for y in 0..camera.height {
        for x in 0..camera.width {
            f((y * camera.width + x) as usize, f64::from(x) + 0.5, f64::from(y) + 0.5);
        }
    }
}

/// A number and its derivatives with respect to the 14 channels of its Gaussian.
#[derive(Clone, Copy)]
struct Dual {
    value: f64,
    d: [f64; CHANNELS],
}

impl Dual {
    fn constant(value: f64) -> Self {
        Self { value, d: [0.0; CHANNELS] }
    }

    /// A function of `self` with this value and this derivative.
    fn chain(self, value: f64, derivative: f64) -> Self {
        Self { value, d: self.d.map(|v| v * derivative) }
    }

    fn sqrt(self) -> Self {
        self.chain(self.value.sqrt(), 0.5 / self.value.sqrt())
    }

    fn exp(self) -> Self {
        self.chain(self.value.exp(), self.value.exp())
    }

    fn sigmoid(self) -> Self {
        let value = 1.0 / (1.0 + (-self.value).exp());
        self.chain(value, value * (1.0 - value))
    }

    fn clamp(self, low: f64, high: f64) -> Self {
        if (low..=high).contains(&self.value) { self } else { Self::constant(self.value.clamp(low, high)) }
    }
}

impl Add for Dual {
    type Output = Self;
    fn add(self, o: Self) -> Self {
        Self { value: self.value + o.value, d: std::array::from_fn(|k| self.d[k] + o.d[k]) }
    }
}

impl Sub for Dual {
    type Output = Self;
    fn sub(self, o: Self) -> Self {
        self + -o
    }
}

impl Neg for Dual {
    type Output = Self;
    fn neg(self) -> Self {
        self.chain(-self.value, -1.0)
    }
}

impl Mul for Dual {
    type Output = Self;
    #[allow(clippy::suspicious_arithmetic_impl)] // the product rule
    fn mul(self, o: Self) -> Self {
        let d = std::array::from_fn(|k| self.d[k] * o.value + self.value * o.d[k]);
        Self { value: self.value * o.value, d }
    }
}

impl Mul<f64> for Dual {
    type Output = Self;
    fn mul(self, o: f64) -> Self {
        self.chain(self.value * o, o)
    }
}

impl Div for Dual {
    type Output = Self;
    fn div(self, o: Self) -> Self {
        self * o.chain(1.0 / o.value, -1.0 / (o.value * o.value))
    }
}

struct Splat {
    index: usize,
    mean: [Dual; 2],
    conic: [Dual; 3], // inverse of the covariance: xx, xy, yy
    opacity: Dual,
    color: [Dual; 3],
    depth: Dual,
}

/// All Gaussians between the near and far planes, from near to far.
fn project_all(gaussians: &[f32], camera: &Camera, config: &RasterConfig) -> Vec<Splat> {
    let mut splats: Vec<Splat> = gaussians
        .as_chunks::<CHANNELS>()
        .0
        .iter()
        .enumerate()
        .map(|(index, row)| project(index, row, camera, f64::from(config.blur)))
        .filter(|s| (f64::from(config.near)..=f64::from(config.far)).contains(&s.depth.value))
        .collect();
    splats.sort_by(|a, b| a.depth.value.total_cmp(&b.depth.value)); // stable
    splats
}

fn project(index: usize, row: &[f32; CHANNELS], camera: &Camera, blur: f64) -> Splat {
    let channel: [Dual; CHANNELS] = std::array::from_fn(|k| {
        let mut dual = Dual::constant(f64::from(row[k]));
        dual.d[k] = 1.0;
        dual
    });
    let one = Dual::constant(1.0);

    // Covariance: R diag(s^2) R'
    let raw: [Dual; 4] = std::array::from_fn(|k| channel[6 + k]);
    let norm = (raw[0] * raw[0] + raw[1] * raw[1] + raw[2] * raw[2] + raw[3] * raw[3]).sqrt();
    let [w, x, y, z] = raw.map(|v| v / norm);
    let rotation = [
        [one - (y * y + z * z) * 2.0, (x * y - w * z) * 2.0, (x * z + w * y) * 2.0],
        [(x * y + w * z) * 2.0, one - (x * x + z * z) * 2.0, (y * z - w * x) * 2.0],
        [(x * z - w * y) * 2.0, (y * z + w * x) * 2.0, one - (x * x + y * y) * 2.0],
    ];
    let scale: [Dual; 3] = std::array::from_fn(|k| channel[3 + k].exp());
    let covariance: [[Dual; 3]; 3] = std::array::from_fn(|i| {
        std::array::from_fn(|j| {
            let term = |k: usize| rotation[i][k] * rotation[j][k] * scale[k] * scale[k];
            term(0) + term(1) + term(2)
        })
    });

    // The mean in camera coordinates
    let matrix = camera.world_to_camera.transpose().to_cols_array_2d(); // rows of world to camera
    let [px, py, pz] = std::array::from_fn(|r| {
        channel[0] * matrix[r][0] + channel[1] * matrix[r][1] + channel[2] * matrix[r][2] + Dual::constant(matrix[r][3])
    });

    // The projection, linearized at the mean, but not further out than 15 % of the image size beyond its border
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    let slope = |v: Dual, focal: f64, center: f64, size: f64| {
        (v / pz).clamp(-(center + 0.15 * size) / focal, (size - center + 0.15 * size) / focal)
    };
    let (slope_x, slope_y) = (slope(px, camera.fx, camera.cx, width), slope(py, camera.fy, camera.cy, height));
    let jacobian = |focal: f64, axis: usize, slope: Dual| -> [Dual; 3] {
        let row = |k: usize| Dual::constant(matrix[axis][k]) - slope * matrix[2][k];
        std::array::from_fn(|k| row(k) * focal / pz)
    };
    let (jx, jy) = (jacobian(camera.fx, 0, slope_x), jacobian(camera.fy, 1, slope_y));
    let sandwich = |a: &[Dual; 3], b: &[Dual; 3]| {
        let mut sum = Dual::constant(0.0);
        for i in 0..3 {
            for j in 0..3 {
                sum = sum + a[i] * covariance[i][j] * b[j];
            }
        }
        sum
    };
    let blur = Dual::constant(blur);
    let (xx, xy, yy) = (sandwich(&jx, &jx) + blur, sandwich(&jx, &jy), sandwich(&jy, &jy) + blur);
    let det = xx * yy - xy * xy;
    Splat {
        index,
        mean: [px / pz * camera.fx + Dual::constant(camera.cx), py / pz * camera.fy + Dual::constant(camera.cy)],
        conic: [yy / det, -xy / det, xx / det],
        opacity: channel[10].sigmoid(),
        color: std::array::from_fn(|c| channel[11 + c]),
        depth: pz,
    }
}

/// A splat's part in a pixel.
struct Drawn {
    splat: usize,
    alpha: Dual,
    weight: f64,
}

/// What is drawn at the point (`x`, `y`), from near to far, and the transmittance behind all of it.
fn blend(splats: &[Splat], x: f64, y: f64) -> (Vec<Drawn>, f64) {
    // The limits are those of f32 arithmetic: two alphas of 0.99f leave less than 1e-4f.
    let (max_alpha, min_alpha, min_t) = (f64::from(0.99f32), f64::from(1.0f32 / 255.0), f64::from(1e-4f32));
    let mut t = 1.0;
    let mut drawn = Vec::new();
    for (i, s) in splats.iter().enumerate() {
        let (dx, dy) = (Dual::constant(x) - s.mean[0], Dual::constant(y) - s.mean[1]);
        let [a, b, c] = s.conic;
        let sigma = (a * dx * dx + c * dy * dy) * 0.5 + b * dx * dy;
        let alpha = (s.opacity * (-sigma).exp()).clamp(f64::NEG_INFINITY, max_alpha);
        if sigma.value < 0.0 || alpha.value < min_alpha {
            continue;
        }
        let next = t * (1.0 - alpha.value);
        if next <= min_t {
            break;
        }
        drawn.push(Drawn { splat: i, alpha, weight: t * alpha.value });
        t = next;
    }
    (drawn, t)
}
