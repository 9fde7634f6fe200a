//! Fewer triangles: edges collapse in the order of their quadric errors (Garland and Heckbert 1997).

use std::{cmp::Reverse, collections::BinaryHeap, ops::AddAssign};

use glam::{DMat3, DVec3, Vec3};

use crate::meshing::Shape;

/// The weight of a point's squared distance from the middle of its edge, beside the planes' one of 1. It decides where
/// the surface is flat.
const MIDDLE: f64 = 1e-5;
/// Smallest cosine between the normals of a triangle before and after a collapse.
const TURN: f64 = 0.2;

/// The sum of squared distances from planes, weighted by area: `x A x - 2 b x + c`.
#[derive(Clone, Copy)]
struct Quadric {
    a: DMat3,
    b: DVec3,
    c: f64,
}

impl AddAssign for Quadric {
    fn add_assign(&mut self, other: Self) {
        self.a += other.a;
        self.b += other.b;
        self.c += other.c;
    }
}

impl Quadric {
    const ZERO: Self = Self { a: DMat3::ZERO, b: DVec3::ZERO, c: 0.0 };

    fn of_triangle([a, b, c]: [DVec3; 3]) -> Self {
        let cross = (b - a).cross(c - a);
        let (normal, area) = (cross.normalize_or_zero(), 0.5 * cross.length());
        let offset = normal.dot(a);
        let outer = DMat3::from_cols(normal.x * normal, normal.y * normal, normal.z * normal);
        Self { a: area * outer, b: area * offset * normal, c: area * offset * offset }
    }

    /// The point of the least error, drawn to the middle of an edge, and that error.
    fn least(&self, from: DVec3, to: DVec3) -> (DVec3, f64) {
        let middle = 0.5 * (from + to);
        let weight = MIDDLE * (self.a.x_axis.x + self.a.y_axis.y + self.a.z_axis.z).max(f64::MIN_POSITIVE);
        let drawn = self.a + DMat3::from_diagonal(DVec3::splat(weight));
        let point = drawn.inverse() * (self.b + weight * middle);
        let point = if point.is_finite() { point } else { middle };
        let planes = point.dot(self.a * point) - 2.0 * self.b.dot(point) + self.c;
        // The length keeps triangles of flat regions alike.
        (point, planes.max(0.0) + weight * (point.distance_squared(middle) + 0.25 * from.distance_squared(to)))
    }
}

/// An edge that may collapse: the cheapest first, and among equals always the same.
#[derive(PartialEq, Eq, PartialOrd, Ord)]
struct Candidate {
    cost: u64, // the bits of a number that is not negative are in its order
    ends: [u32; 2],
    versions: [u32; 2],
}

struct Surface {
    positions: Vec<DVec3>,
    quadrics: Vec<Quadric>,
    /// How often a vertex has changed.
    versions: Vec<u32>,
    /// `None` for those that are gone.
    triangles: Vec<Option<[u32; 3]>>,
    /// Numbers of each vertex's triangles, all of them there.
    around: Vec<Vec<u32>>,
    heap: BinaryHeap<Reverse<Candidate>>,
}

/// A mesh with at most `triangles` triangles, or as few as can be without a change of what is connected with what: a
/// closed manifold stays one. Normals are those of the new triangles; colors are left out.
pub(crate) fn decimate(shape: &Shape, triangles: usize) -> Shape {
    let mut surface = Surface::of(shape);
    let (mut left, mut before) = (shape.triangles.len(), usize::MAX);
    let mut refused: Vec<[u32; 2]> = Vec::new();
    while left > triangles {
        let Some(Reverse(next)) = surface.heap.pop() else {
            if left == before {
                break;
            }
            // What could not collapse may do so among other neighbors.
            before = left;
            std::mem::take(&mut refused).into_iter().for_each(|[a, b]| surface.offer(a, b));
            continue;
        };
        let [keep, gone] = next.ends;
        // Others have been offered since.
        if next.versions != next.ends.map(|v| surface.versions[v as usize]) {
            continue;
        }
        let (point, _) = surface.place(keep, gone);
        if surface.may_collapse(keep, gone, point) {
            left -= surface.collapse(keep, gone, point);
        } else {
            refused.push(next.ends);
        }
    }
    surface.into_shape(shape.origin)
}

impl Surface {
    fn of(shape: &Shape) -> Self {
        let positions: Vec<DVec3> = shape.positions.iter().map(|p| p.as_dvec3()).collect();
        let n = positions.len();
        let mut surface = Self {
            quadrics: vec![Quadric::ZERO; n],
            versions: vec![0; n],
            triangles: shape.triangles.iter().copied().map(Some).collect(),
            around: vec![Vec::new(); n],
            heap: BinaryHeap::new(),
            positions,
        };
        for (i, t) in (0..).zip(&shape.triangles) {
            let quadric = Quadric::of_triangle(t.map(|v| surface.positions[v as usize]));
            for v in t.map(|v| v as usize) {
                surface.quadrics[v] += quadric;
                surface.around[v].push(i);
            }
        }
        for [a, b, c] in &shape.triangles {
            // Of both triangles at an edge one has it in this direction.
            [(*a, *b), (*b, *c), (*c, *a)].into_iter().filter(|(a, b)| a < b).for_each(|(a, b)| surface.offer(a, b));
        }
        surface
    }

    fn place(&self, a: u32, b: u32) -> (DVec3, f64) {
        let mut quadric = self.quadrics[a as usize];
        quadric += self.quadrics[b as usize];
        quadric.least(self.positions[a as usize], self.positions[b as usize])
    }

    fn offer(&mut self, a: u32, b: u32) {
        let ends = [a.min(b), a.max(b)];
        let cost = self.place(ends[0], ends[1]).1.to_bits();
        self.heap.push(Reverse(Candidate { cost, ends, versions: ends.map(|v| self.versions[v as usize]) }));
    }

    fn triangles_of(&self, v: u32) -> impl Iterator<Item = [u32; 3]> {
        self.around[v as usize].iter().filter_map(|&i| self.triangles[i as usize])
    }

    /// The vertices that share an edge with one, in order.
    fn neighbors(&self, v: u32) -> Vec<u32> {
        let mut all: Vec<u32> = self.triangles_of(v).flatten().filter(|&u| u != v).collect();
        all.sort_unstable();
        all.dedup();
        all
    }

    /// Whether the ends of an edge can become one at `point`: they have no neighbors in common but those across the edge,
    /// and no triangle turns over.
    fn may_collapse(&self, a: u32, b: u32, point: DVec3) -> bool {
        let (of_a, of_b) = (self.neighbors(a), self.neighbors(b));
        let common = of_a.iter().filter(|v| of_b.binary_search(v).is_ok()).count();
        let shared = self.triangles_of(a).filter(|t| t.contains(&b)).count();
        // A tetrahedron is the smallest closed surface.
        if shared == 0 || common != shared || of_a.len() + of_b.len() - common <= 4 {
            return false;
        }
        let normal = |t: [u32; 3], moved: bool| {
            let [p, q, r] = t.map(|v| if moved && (v == a || v == b) { point } else { self.positions[v as usize] });
            (q - p).cross(r - p)
        };
        let others = self.triangles_of(a).chain(self.triangles_of(b)).filter(|t| !(t.contains(&a) && t.contains(&b)));
        others.into_iter().all(|t| {
            let (before, after) = (normal(t, false), normal(t, true));
            // One without area faces nowhere.
            before == DVec3::ZERO || before.dot(after) > TURN * before.length() * after.length()
        })
    }

    /// Makes two vertices one; how many triangles are gone.
    fn collapse(&mut self, keep: u32, gone: u32, point: DVec3) -> usize {
        let before = self.around[gone as usize].len() + self.around[keep as usize].len();
        let moved = std::mem::take(&mut self.around[gone as usize]);
        for &i in &moved {
            let triangle = &mut self.triangles[i as usize];
            match triangle {
                Some(t) if t.contains(&keep) => *triangle = None,
                Some(t) => t.iter_mut().filter(|v| **v == gone).for_each(|v| *v = keep),
                None => {}
            }
        }
        // Those across the edge lose a triangle as well.
        let mut touched = self.neighbors(keep);
        touched.push(keep);
        self.around[keep as usize].extend(moved);
        touched.extend(self.neighbors(keep));
        touched.sort_unstable();
        touched.dedup();
        for v in &touched {
            let triangles = &self.triangles;
            self.around[*v as usize].retain(|&i| triangles[i as usize].is_some());
        }
        let quadric = self.quadrics[gone as usize];
        self.quadrics[keep as usize] += quadric;
        self.positions[keep as usize] = point;
        self.versions[keep as usize] += 1;
        self.versions[gone as usize] += 1;
        self.neighbors(keep).into_iter().for_each(|v| self.offer(keep, v));
        // Each that is gone was counted at both ends.
        (before - self.around[keep as usize].len()) / 2
    }

    fn into_shape(self, origin: DVec3) -> Shape {
        let mut numbers = vec![u32::MAX; self.positions.len()];
        let mut shape = Shape { origin, ..Shape::default() };
        for triangle in self.triangles.into_iter().flatten() {
            let triangle = triangle.map(|v| {
                let number = &mut numbers[v as usize];
                if *number == u32::MAX {
                    *number = shape.positions.len() as u32;
                    shape.positions.push(self.positions[v as usize].as_vec3());
                }
                *number
            });
            shape.triangles.push(triangle);
        }
        shape.normals = normals(&shape);
        shape
    }
}

/// Normals at vertices: the mean of the triangles', each by its angle there.
fn normals(shape: &Shape) -> Vec<Vec3> {
    let mut sums = vec![DVec3::ZERO; shape.positions.len()];
    for t in &shape.triangles {
        let corners = t.map(|v| shape.positions[v as usize].as_dvec3());
        let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]).normalize_or_zero();
        for k in 0..3 {
            let (to, other) = (corners[(k + 1) % 3] - corners[k], corners[(k + 2) % 3] - corners[k]);
            sums[t[k] as usize] += to.angle_between(other) * normal;
        }
    }
    sums.into_iter().map(|n| n.as_vec3().normalize_or(Vec3::Z)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::meshing::iso_surface;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn field(n: usize, value: impl Fn(DVec3) -> f64) -> Shape {
        let step = 2.0 / (n - 1) as f64;
        let at = |i: usize| step * DVec3::new((i % n) as f64, (i / n % n) as f64, (i / n / n) as f64) - 1.0;
        let values: Vec<f32> = (0..n.pow(3)).map(|i| value(at(i)) as f32).collect();
        iso_surface(&values, [n; 3], DVec3::splat(-1.0), step).unwrap()
    }

    #[test]
    fn a_ball_stays_a_closed_ball() {
        let ball = field(41, |p| p.length() - 0.8);
        for triangles in [5000, 1000, 200] {
            let found = decimate(&ball, triangles);
            assert!((triangles - 2..=triangles).contains(&found.triangles.len()), "{}", found.triangles.len());
            assert!(found.is_closed_manifold());
            let lost = (found.volume() / ball.volume() - 1.0).abs();
            assert!(lost < 6.0 / triangles as f64, "{triangles}: {lost}");
            for (p, normal) in found.positions.iter().zip(&found.normals) {
                assert!((f64::from(p.length()) - 0.8).abs() < 6.0 / triangles as f64, "{triangles}: {}", p.length());
                assert!(f64::from(normal.dot(p.normalize())) > 1.0 - 8.0 / triangles as f64);
            }
        }
    }

    #[test]
    fn a_box_keeps_its_faces_and_is_the_same_each_time() {
        let block = field(33, |p| p.abs().max_element() - 0.501);
        let found = decimate(&block, 300);
        assert!(found.is_closed_manifold() && (found.volume() / block.volume() - 1.0).abs() < 1e-3);
        let off = |p: &Vec3| (p.abs().max_element() - 0.501).abs();
        assert!(
            found.positions.iter().all(|p| off(p) < 0.02),
            "{:?}",
            found.positions.iter().map(off).reduce(f32::max)
        );
        assert_eq!(found, decimate(&block, 300));
    }

    #[test]
    fn noise_stays_closed_and_manifold_and_small_parts_stay() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let values: Vec<f32> = (0..16usize.pow(3)).map(|_| rng.random_range(-1.0..1.0)).collect();
        let noise = iso_surface(&values, [16; 3], DVec3::ZERO, 1.0).unwrap();
        let found = decimate(&noise, noise.triangles.len() / 4);
        assert!(found.is_closed_manifold());
        assert!(
            found.triangles.len() < noise.triangles.len() / 2,
            "{} of {}",
            found.triangles.len(),
            noise.triangles.len()
        );
        // As few as can be: each of three balls is a tetrahedron at last.
        let balls = field(31, |p| {
            [-0.6, 0.0, 0.6].map(|x| p.distance(DVec3::new(x, 0.0, 0.0)) - 0.2).into_iter().fold(9.0, f64::min)
        });
        let least = decimate(&balls, 0);
        assert!(least.is_closed_manifold() && (12..60).contains(&least.triangles.len()), "{}", least.triangles.len());
    }
}
