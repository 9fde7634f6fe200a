//! Smoothly joined superquadrics, meshed from their distance field.

use glam::{IVec3, Quat, Vec2, Vec3};

use crate::generate::part::Part;

/// One superquadric: |x|^e + |y|^e + |z|^e <= 1 in units of its half axes.
#[derive(Clone, Copy, Debug)]
pub struct Blob {
    pub center: Vec3,
    pub half: Vec3,
    /// Exponent as a power of two: 1 is an ellipsoid, 2 and 3 are ever squarer.
    pub square: u32,
    pub turn: Quat,
    pub material: u16,
}

impl Blob {
    pub fn ball(center: Vec3, half: Vec3, material: u16) -> Self {
        Self { center, half, square: 1, turn: Quat::IDENTITY, material }
    }

    /// A long blob from `a` to `b`.
    pub fn limb(a: Vec3, b: Vec3, r: f32, material: u16) -> Self {
        let d = b - a;
        let turn = Quat::from_rotation_arc(Vec3::Z, d.normalize_or(Vec3::Z));
        Self { center: 0.5 * (a + b), half: Vec3::new(r, r, 0.5 * d.length() + 0.7 * r), square: 1, turn, material }
    }

    /// About the distance to the surface.
    fn distance(&self, p: Vec3) -> f32 {
        let q = self.turn.inverse() * (p - self.center) / self.half;
        let mut x = q * q;
        for _ in 1..self.square {
            x *= x;
        }
        let mut norm = (x.x + x.y + x.z).sqrt();
        for _ in 1..self.square {
            norm = norm.sqrt();
        }
        (norm - 1.0) * self.half.min_element()
    }
}

/// The surface of the blobs joined with fillets of about the size `soft`, on a grid of `cells` along the longest axis.
/// Faces take the material of the nearest blob. Empty without blobs.
pub fn blend(blobs: &[Blob], soft: f32, cells: usize) -> Part {
    let mut part = Part::default();
    let (mut lo, mut hi) = (Vec3::MAX, Vec3::MIN);
    for blob in blobs {
        let reach = Vec3::splat(blob.half.length());
        let tight = if blob.turn == Quat::IDENTITY { blob.half } else { reach };
        (lo, hi) = (lo.min(blob.center - tight - soft), hi.max(blob.center + tight + soft));
    }
    if blobs.is_empty() {
        return part;
    }
    let step = (hi - lo).max_element() / cells as f32;
    let lo = lo - 2.0 * step;
    let n = ((hi - lo) / step).ceil().as_ivec3() + 3;
    let index = |c: IVec3| ((c.z * n.y + c.y) * n.x + c.x) as usize;
    let field = |p: Vec3| {
        let mut sum = 0.0;
        for blob in blobs {
            sum += (-blob.distance(p) / soft).min(60.0).exp();
        }
        -soft * sum.max(1e-30).ln()
    };
    let at = |c: IVec3| lo + step * c.as_vec3();
    let mut values = vec![0.0f32; (n.x * n.y * n.z) as usize];
    for z in 0..n.z {
        for y in 0..n.y {
            for x in 0..n.x {
                let c = IVec3::new(x, y, z);
                // The border stays outside, so that the surface closes.
                let border = c.cmpeq(IVec3::ZERO).any() || c.cmpeq(n - 1).any();
                values[index(c)] = if border { 1.0 } else { field(at(c)) };
            }
        }
    }
    // One vertex per cell that the surface crosses: the mean of the crossings of its edges.
    let mut vertices = vec![u32::MAX; values.len()];
    for z in 0..n.z - 1 {
        for y in 0..n.y - 1 {
            for x in 0..n.x - 1 {
                let base = IVec3::new(x, y, z);
                let corners: [IVec3; 8] = std::array::from_fn(|k| {
                    base + IVec3::new((k & 1) as i32, (k >> 1 & 1) as i32, (k >> 2 & 1) as i32)
                });
                if let Some(p) = crossing(corners.map(|c| values[index(c)]), corners.map(at)) {
                    let uv = Vec2::new(p.y.atan2(p.x) / std::f32::consts::TAU + 0.5, (p.z - lo.z) / (hi.z - lo.z));
                    vertices[index(base)] = part.vertex(p, uv);
                }
            }
        }
    }
    let axes = [IVec3::X, IVec3::Y, IVec3::Z];
    for z in 1..n.z - 1 {
        for y in 1..n.y - 1 {
            for x in 1..n.x - 1 {
                let c = IVec3::new(x, y, z);
                let inside = values[index(c)] < 0.0;
                for k in 0..3 {
                    if inside == (values[index(c + axes[k])] < 0.0) {
                        continue;
                    }
                    let (u, v) = (axes[(k + 1) % 3], axes[(k + 2) % 3]);
                    let mut ring = [c - u - v, c - v, c, c - u].map(|c| vertices[index(c)]);
                    if !inside {
                        ring.reverse();
                    }
                    let p = at(c);
                    let nearest = blobs.iter().min_by(|a, b| a.distance(p).total_cmp(&b.distance(p)));
                    part.quad(ring, nearest.map_or(0, |b| b.material));
                }
            }
        }
    }
    part
}

/// The mean of where the edges of a cell cross the surface; none where none does. Corner k lies at k's bits.
fn crossing(values: [f32; 8], corners: [Vec3; 8]) -> Option<Vec3> {
    let (mut sum, mut count) = (Vec3::ZERO, 0);
    for k in 0..8 {
        let v = values[k];
        for axis in [1, 2, 4] {
            if k & axis == 0 {
                let w = values[k | axis];
                if (v < 0.0) != (w < 0.0) {
                    sum += corners[k].lerp(corners[k | axis], v / (v - w));
                    count += 1;
                }
            }
        }
    }
    (count > 0).then(|| sum / count as f32)
}
