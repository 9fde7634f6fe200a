//! One layer of flat Gaussians on the surface that photos see, in the photos' colors.
//!
//! In: Gaussians, and photos of the same object. Out: these Gaussians with a layer in place of those that photos see there
//! ([`layered`]). Gaussians that few photos judge show print at several depths, each right along one ray; from elsewhere
//! it is a smear. In one layer it has one place (docs/research/surface.md).

use crate::{FitError, views::Targets};
use freerange_gaussians::{Gaussians, channel};
use freerange_raster::surface_depth;
use freerange_scene::camera::{Camera, pixel_of};
use glam::{DMat3, DQuat, DVec3};
use image::RgbaImage;
use rayon::prelude::*;

/// Photos that place Gaussians, spread evenly over all: each is compared with each.
const MOST_PHOTOS: usize = 48;
/// Distance in pixels between the Gaussians that a photo places, at least.
const SPACING: f64 = 3.0;
/// Standard deviations of a Gaussian along the surface and across it, in distances between two.
const ALONG: f64 = 0.6;
const ACROSS: f64 = 0.15;
const OPACITY: f64 = 0.95;
/// Cosine between normal and line of sight from which a photo places Gaussians.
const DIRECT: f64 = 0.5;
/// Power of that cosine by which the photos' colors are weighted.
const POWER: i32 = 8;
/// Pixels from the outline, or from a step of the depth, in which nothing is placed.
const EDGE: usize = 3;
/// Difference of depth that is a step. World units, as below; the object's sphere has radius 0.5.
const STEP: f64 = 0.05;
/// How far apart two photos may see a point.
const TOLERANCE: f64 = 0.015;
/// How far behind the layer Gaussians still give way to it.
const BEHIND: f64 = 0.01;
/// The tangent plane is that of the depths around a pixel: standard deviations in pixels, and of the depth.
const AROUND: f64 = 3.0;
const RANGE: f64 = 0.01;
/// Half of the depths within so many pixels have to lie so near to that plane.
const FLAT_AROUND: usize = 4;
const FLAT: f64 = 0.003;
/// Alpha of pixels of the object.
const SOLID: u8 = 250;

/// `set` with flat Gaussians on the surface that it shows to `photos`, in their colors. Where they are, those of `set` are left
/// out that lie before the surface or just behind it. There are at most `most` in all; `set` itself, if it does not fit.
///
/// Each photo places Gaussians in a grid of its pixels where no other photo looks more directly at the surface. The grid is
/// made coarser until there are few enough. Nothing is placed at outlines, at grazing angles and where the depths are rough.
pub(crate) fn layered(set: &Gaussians, photos: &Targets, most: usize) -> Result<Gaussians, FitError> {
    let asked = photos.photos.min(MOST_PHOTOS);
    let chosen = (0..asked).map(|k| k * photos.photos / asked);
    let seen = chosen.map(|i| Photo::new(set, photos, i)).collect::<Result<Vec<_>, _>>()?;
    let longest = seen.iter().map(|photo| photo.camera.width.max(photo.camera.height)).max().unwrap_or(0);
    let mut spacing = SPACING;
    while spacing <= f64::from(longest) {
        let grids: Vec<Grid> = seen.par_iter().map(|photo| Grid::new(photo, spacing)).collect();
        let layer: Vec<[f32; channel::COUNT]> = (0..seen.len()).flat_map(|i| placed(&seen, &grids, i)).collect();
        let hidden = |row: &&[f32; channel::COUNT]| {
            let center = DVec3::from_array([0, 1, 2].map(|k| f64::from(row[channel::MEAN][k])));
            seen.iter().zip(&grids).any(|(photo, grid)| grid.hides(photo, center))
        };
        let kept: Vec<_> = set.rows().as_chunks().0.par_iter().filter(|row| !hidden(row)).collect();
        if layer.len() + kept.len() <= most {
            return Ok(Gaussians::from_rows(layer.iter().chain(kept).flatten().copied().collect()));
        }
        // As many fewer as there have to be, and a little more.
        let fewer = most.saturating_sub(kept.len()).max(1) as f64 / layer.len().max(1) as f64;
        spacing *= (1.0 / fewer).sqrt().max(1.02);
    }
    Ok(set.clone())
}

/// A photo, and the surface as it sees it.
struct Photo<'a> {
    camera: Camera,
    image: &'a RgbaImage,
    /// Camera z, `[height, width]`; infinite where no surface is.
    depth: Vec<f32>,
}

impl<'a> Photo<'a> {
    fn new(set: &Gaussians, photos: &'a Targets, i: usize) -> Result<Self, FitError> {
        let camera = photos.cameras[i];
        let depth = surface_depth(set.rows(), &camera, &photos.rasters[i])?;
        Ok(Self { camera, image: &photos.images[i], depth })
    }

    fn depth(&self, x: usize, y: usize) -> f64 {
        f64::from(self.depth[y * self.camera.width as usize + x])
    }

    /// The pixels within `radius` of one that the image has.
    fn around(&self, x: usize, y: usize, radius: usize) -> impl Iterator<Item = (usize, usize)> + Clone {
        let columns = x.saturating_sub(radius)..(x + radius + 1).min(self.camera.width as usize);
        let rows = y.saturating_sub(radius)..(y + radius + 1).min(self.camera.height as usize);
        rows.flat_map(move |y| columns.clone().map(move |x| (x, y)))
    }

    /// Whether the object and its surface go on all around a pixel.
    fn inside(&self, x: usize, y: usize) -> bool {
        let [width, height] = [self.camera.width as usize, self.camera.height as usize];
        let within = x >= EDGE && y >= EDGE && x + EDGE < width && y + EDGE < height;
        let z = self.depth(x, y);
        let solid =
            |(a, b)| self.image.get_pixel(a as u32, b as u32).0[3] >= SOLID && (self.depth(a, b) - z).abs() < STEP;
        within && z.is_finite() && self.around(x, y, EDGE).all(solid)
    }

    /// The surface at a pixel: none at its edges, where it is rough, or at grazing angles.
    ///
    /// The inverse depth of a plane is linear over the image. It is fitted to the depths around.
    fn tangent(&self, x: usize, y: usize) -> Option<Tangent> {
        if !self.inside(x, y) {
            return None;
        }
        let mut z = self.depth(x, y);
        let mut plane = DVec3::ZERO;
        for _ in 0..2 {
            let (mut normal_matrix, mut right) = (DMat3::ZERO, DVec3::ZERO);
            for (a, b) in self.around(x, y, 2 * AROUND as usize) {
                let depth = self.depth(a, b);
                let off = (depth - z) / RANGE;
                if off.abs() < 3.0 {
                    let (dx, dy) = (a as f64 - x as f64, b as f64 - y as f64);
                    let weight = (-0.5 * ((dx * dx + dy * dy) / (AROUND * AROUND) + off * off)).exp();
                    let v = DVec3::new(dx, dy, 1.0);
                    normal_matrix += DMat3::from_cols(weight * dx * v, weight * dy * v, weight * v);
                    right += weight / depth * v;
                }
            }
            plane = normal_matrix.inverse() * right;
            z = 1.0 / plane.z;
            if !(plane.is_finite() && (z - self.depth(x, y)).abs() < STEP) {
                return None;
            }
        }
        let near = |(a, b): &(usize, usize)| {
            let there = 1.0 / plane.dot(DVec3::new(*a as f64 - x as f64, *b as f64 - y as f64, 1.0));
            (self.depth(*a, *b) - there).abs() < FLAT
        };
        let around = self.around(x, y, FLAT_AROUND);
        if 2 * around.clone().filter(near).count() <= around.count() {
            return None;
        }
        let c = &self.camera;
        let (u, v) = (x as f64 + 0.5 - c.cx, y as f64 + 0.5 - c.cy);
        let to_world = DMat3::from_mat4(c.world_to_camera).transpose();
        let away = DVec3::new(plane.x * c.fx, plane.y * c.fy, plane.z - plane.x * u - plane.y * v);
        let normal = -(to_world * away.try_normalize()?);
        let point = c.center() + to_world * (z * DVec3::new(u / c.fx, v / c.fy, 1.0));
        let cosine = normal.dot((c.center() - point).normalize());
        (cosine >= DIRECT).then_some(Tangent { point, normal, z, cosine })
    }

    /// Its color of a point, and the cosine between the normal there and its line of sight; none if it does not see it.
    fn sees(&self, point: DVec3, normal: DVec3) -> Option<(DVec3, f64)> {
        let c = &self.camera;
        let cosine = normal.dot((c.center() - point).normalize());
        let p = c.world_to_camera.transform_point3(point);
        let (x, y) = (p.x / p.z * c.fx + c.cx - 0.5, p.y / p.z * c.fy + c.cy - 0.5);
        let inside = |x: f64, side: u32| x >= 0.0 && x < f64::from(side - 1);
        if cosine <= 0.0 || p.z <= 0.0 || !inside(x, c.width) || !inside(y, c.height) {
            return None;
        }
        let (column, row) = (x.round() as usize, y.round() as usize);
        if (self.depth(column, row) - p.z).abs() > TOLERANCE || !self.inside(column, row) {
            return None;
        }
        let pixel = |dx: u32, dy: u32| {
            let [r, g, b, _] = self.image.get_pixel(x as u32 + dx, y as u32 + dy).0.map(f64::from);
            DVec3::new(r, g, b) / 255.0
        };
        let (u, v) = (x.fract(), y.fract());
        Some((pixel(0, 0).lerp(pixel(1, 0), u).lerp(pixel(0, 1).lerp(pixel(1, 1), u), v), cosine))
    }
}

/// The surface about a pixel.
struct Tangent {
    point: DVec3,
    /// Toward the photo.
    normal: DVec3,
    /// Camera z of the point.
    z: f64,
    /// Between normal and line of sight.
    cosine: f64,
}

/// The surface at every so many pixels of a photo.
struct Grid {
    spacing: f64,
    across: usize,
    cells: Vec<Option<Tangent>>,
}

impl Grid {
    fn new(photo: &Photo<'_>, spacing: f64) -> Self {
        let [across, down] = [photo.camera.width, photo.camera.height].map(|side| (f64::from(side) / spacing) as usize);
        let middle = |i: usize| ((i as f64 + 0.5) * spacing) as usize;
        let cell = |i| photo.tangent(middle(i % across), middle(i / across));
        Self { spacing, across, cells: (0..across * down).into_par_iter().map(cell).collect() }
    }

    /// The surface in the cell of a pixel.
    fn at(&self, x: usize, y: usize) -> Option<&Tangent> {
        let [column, row] = [x, y].map(|pixel| ((pixel as f64 + 0.5) / self.spacing) as usize);
        if column >= self.across { None } else { self.cells.get(row * self.across + column)?.as_ref() }
    }

    /// Whether a point lies before the surface as `photo` sees it, or just behind it.
    fn hides(&self, photo: &Photo<'_>, point: DVec3) -> bool {
        let width = photo.camera.width as usize;
        let seen = pixel_of(&photo.camera, point).and_then(|(i, z)| Some((self.at(i % width, i / width)?.z, z)));
        seen.is_some_and(|(surface, z)| z < surface + BEHIND)
    }

    /// Whether it has a Gaussian about a point of the surface.
    fn places(&self, photo: &Photo<'_>, point: DVec3) -> bool {
        let width = photo.camera.width as usize;
        pixel_of(&photo.camera, point).is_some_and(|(i, _)| self.at(i % width, i / width).is_some())
    }
}

/// The Gaussians that photo `i` places: where no other one looks more directly at the surface.
fn placed(photos: &[Photo<'_>], grids: &[Grid], i: usize) -> Vec<[f32; channel::COUNT]> {
    let of_cell = |tangent: &Tangent| {
        let Tangent { point, normal, z, cosine } = *tangent;
        let (mut color, mut weights) = (DVec3::ZERO, 0.0);
        for (j, photo) in photos.iter().enumerate() {
            let Some((seen, other)) = photo.sees(point, normal) else { continue };
            let more_direct = (other, i) > (cosine, j);
            if j != i && more_direct && grids[j].places(photo, point) {
                return None;
            }
            let weight = other.powi(POWER);
            color += weight * seen;
            weights += weight;
        }
        let size = grids[i].spacing * z / photos[i].camera.fx;
        let eye = (photos[i].camera.center() - point).normalize();
        (weights > 0.0).then(|| disc(tangent, eye, size, color / weights))
    };
    grids[i].cells.par_iter().flatten().filter_map(of_cell).collect()
}

/// A flat Gaussian that covers a square of `size` as seen from the direction `eye`: longer where the surface is slanted.
fn disc(tangent: &Tangent, eye: DVec3, size: f64, color: DVec3) -> [f32; channel::COUNT] {
    let Tangent { point, normal, cosine, .. } = *tangent;
    let slant = (eye - normal * normal.dot(eye)).try_normalize().unwrap_or(normal.any_orthonormal_vector());
    let turn = DQuat::from_mat3(&DMat3::from_cols(slant, normal.cross(slant), normal));
    let mut row = [0.0; channel::COUNT];
    row[channel::MEAN].copy_from_slice(&point.as_vec3().to_array());
    let scales = [ALONG * size / cosine, ALONG * size, ACROSS * ALONG * size];
    row[channel::LOG_SCALE].copy_from_slice(&scales.map(|scale| scale.ln() as f32));
    row[channel::ROTATION].copy_from_slice(&[turn.w, turn.x, turn.y, turn.z].map(|v| v as f32));
    row[channel::LOGIT_OPACITY] = (OPACITY / (1.0 - OPACITY)).ln() as f32;
    row[channel::COLOR].copy_from_slice(&color.as_vec3().to_array());
    row
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Evidence, tests::photograph};
    use freerange_scene::camera::View;

    const SIDE: u32 = 128;

    fn camera(eye: DVec3) -> Camera {
        Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.6, SIDE, SIDE)
    }

    /// A solid of Gaussians on a lattice within `inside`, gray, with its surface a little outside of their centers.
    fn solid(inside: impl Fn(DVec3) -> bool) -> Gaussians {
        let along = || (-16..=16).map(|i| f64::from(i) * 0.025);
        let points = along().flat_map(|x| along().flat_map(move |y| along().map(move |z| DVec3::new(x, y, z))));
        let row = |p: DVec3| {
            let [x, y, z] = p.as_vec3().to_array();
            [x, y, z, -4.2, -4.2, -4.2, 1.0, 0.0, 0.0, 0.0, 5.0, 0.5, 0.5, 0.5]
        };
        Gaussians::from_rows(points.filter(|p| inside(*p)).flat_map(row).collect())
    }

    /// A photo of `set`'s outline, painted by the place at which the line of sight meets a surface.
    fn photo(set: &Gaussians, eye: DVec3, paint: impl Fn(DVec3, DVec3) -> [u8; 3]) -> View {
        let camera = camera(eye);
        let mut view = photograph(set, &camera);
        for (x, y, pixel) in view.image.enumerate_pixels_mut() {
            let ray = camera.ray_direction(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let [r, g, b] = paint(camera.center(), ray);
            pixel.0 = [r, g, b, if pixel[3] > 128 { 255 } else { 0 }];
        }
        view
    }

    fn with(set: &Gaussians, photos: &[View], most: usize) -> Gaussians {
        layered(set, &Targets::new(photos, None).unwrap(), most).unwrap()
    }

    /// The Gaussians of the layer: none of the solids has flat ones.
    fn flat(set: &Gaussians) -> impl Iterator<Item = usize> {
        (0..set.len()).filter(|&i| set.row(i)[channel::LOG_SCALE][2] < set.row(i)[channel::LOG_SCALE][1] - 1.0)
    }

    #[test]
    fn a_ball_gets_a_layer_on_its_surface_in_the_photos_colors() {
        let ball = solid(|p| p.length() < 0.3);
        let halves = |eye: DVec3, ray: DVec3| {
            if (eye - ray * eye.dot(ray) / ray.length_squared()).z > 0.0 { [255, 0, 0] } else { [0, 0, 255] }
        };
        let photos = [photo(&ball, DVec3::new(0.0, -2.0, 0.0), halves)];
        let found = with(&ball, &photos, usize::MAX);
        let mut count = 0;
        for i in flat(&found) {
            let (at, normal) = (found.mean(i), found.rotation(i) * DVec3::Z);
            let out = at.normalize();
            assert!((at.length() - 0.3).abs() < 0.02, "{at} is at {}", at.length());
            assert!(normal.dot(out) > 0.97, "{normal} at {at}");
            // The ball's rim turns away from the photo.
            assert!(normal.dot(DVec3::NEG_Y) > 0.4, "{at}");
            let color = found.color(i);
            if at.z.abs() > 0.03 {
                let expected = if at.z > 0.0 { DVec3::X } else { DVec3::Z };
                assert!(color.distance(expected) < 1e-6, "{color} at {at}");
            }
            count += 1;
        }
        assert!(count > 100, "{count}");
        // A veil before the layer gives way to it. Behind the object nothing changes.
        let veil = |y: f32| vec![0.0, y, 0.0, -4.2, -4.2, -4.2, 1.0, 0.0, 0.0, 0.0, -2.0, 0.5, 0.5, 0.5];
        let veiled = Gaussians::from_rows([ball.rows(), &veil(-0.4), &veil(0.4)].concat());
        let found = with(&veiled, &photos, usize::MAX);
        let rows: Vec<_> = found.iter().map(|row| row.to_vec()).collect();
        assert!(!rows.contains(&veil(-0.4)) && rows.contains(&veil(0.4)));
        assert!(ball.iter().filter(|row| row[1] > -0.1).all(|row| rows.contains(&row.to_vec())));
    }

    /// Print that two photos see from aside lies in one place, at its depth.
    #[test]
    fn a_printed_plane_seen_by_two_photos_is_one_layer() {
        let slab = solid(|p| p.y.abs() < 0.06 && p.x.abs() < 0.3 && p.z.abs() < 0.3);
        // Stripes on its front, where half of the light is left.
        let depth = f64::from(
            surface_depth(slab.rows(), &camera(DVec3::new(0.0, -2.0, 0.0)), &freerange_raster::RasterConfig::default())
                .unwrap()[(SIDE * SIDE / 2 + SIDE / 2) as usize],
        );
        let front = depth - 2.0;
        let stripes = |eye: DVec3, ray: DVec3| {
            let x = (eye + ray * ((front - eye.y) / ray.y)).x;
            if (x / 0.08).floor() as i64 % 2 == 0 { [255, 255, 255] } else { [0, 0, 0] }
        };
        let photos = [-0.8, 0.8].map(|x| photo(&slab, DVec3::new(x, -1.8, 0.1), stripes));
        let found = with(&slab, &photos, usize::MAX);
        let (mut right, mut all) = (0, 0);
        for i in flat(&found).filter(|&i| found.mean(i).x.abs() < 0.25 && found.mean(i).z.abs() < 0.25) {
            let at = found.mean(i);
            assert!((at.y - front).abs() < 0.012, "{at}");
            let part = (at.x / 0.08).rem_euclid(2.0);
            // Apart from the stripes' borders.
            if (part.fract() - 0.5).abs() < 0.25 {
                let expected = if part < 1.0 { 1.0 } else { 0.0 };
                right += usize::from((found.color(i).x - expected).abs() < 0.3);
                all += 1;
            }
        }
        assert!(all > 100 && right as f64 > 0.95 * all as f64, "{right} of {all}");
    }

    #[test]
    fn there_are_no_more_than_asked_for_and_mirrored_photos_place_none() {
        let ball = solid(|p| p.length() < 0.3);
        let photos =
            [DVec3::new(0.0, -2.0, 0.0), DVec3::new(0.0, 2.0, 0.0)].map(|eye| photo(&ball, eye, |_, _| [9; 3]));
        let count = |set: &Gaussians| flat(set).count();
        let all = count(&with(&ball, &photos, usize::MAX));
        let most = ball.len() + all / 2;
        let fewer = with(&ball, &photos, most);
        assert!(fewer.len() <= most && count(&fewer) > all / 8, "{} of {all}", count(&fewer));
        assert_eq!(with(&ball, &photos, 10), ball);
        let one = Evidence { photos: 1, ..(&photos).into() };
        let one = layered(&ball, &Targets::new(one, None).unwrap(), usize::MAX).unwrap();
        assert!(flat(&one).all(|i| one.mean(i).y < 0.0) && count(&one) > all / 3);
    }

    #[test]
    fn without_a_surface_nothing_changes() {
        let faint =
            Gaussians::from_rows(vec![0.0, 0.0, 0.0, -3.0, -3.0, -3.0, 1.0, 0.0, 0.0, 0.0, -6.0, 0.5, 0.5, 0.5]);
        let photos = [photo(&solid(|p| p.length() < 0.3), DVec3::new(0.0, -2.0, 0.0), |_, _| [9; 3])];
        assert_eq!(with(&faint, &photos, 1000), faint);
    }
}
