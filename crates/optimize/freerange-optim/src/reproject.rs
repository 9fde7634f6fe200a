//! Colors that photos have for other views: reprojected onto the surface that sets of Gaussians show.
//!
//! In: Gaussians of one object, photos, cameras. Out: for each pixel of each camera a color and how far it can be relied
//! on ([`reprojected`]). Each point has one color in all views, that of the photos that look at it most directly, where
//! the Gaussians alone show it a little elsewhere from everywhere (docs/research/surface.md).

use crate::{FitError, views::Targets};
use freerange_gaussians::Gaussians;
use freerange_raster::{RasterConfig, surface_depth, surface_normals};
use freerange_scene::camera::Camera;
use glam::{DMat3, DVec3};
use image::RgbaImage;
use rayon::prelude::*;

/// Photos that are asked, spread evenly over all.
const MOST_PHOTOS: usize = 48;
/// How far a point may lie from the surface that a photo sees to be what it sees. World units; the object's sphere has radius 0.5.
const TOLERANCE: f64 = 0.015;
/// Standard deviation of the sets' depths at which a color counts a third.
const DEVIATION: f64 = 0.02;
/// Power of the cosine between normal and line of sight by which photos are weighted.
const POWER: i32 = 4;
/// Cosines at which a color begins to count, and counts in full.
const COSINES: [f64; 2] = [0.2, 0.5];
/// Cosine from which a photo sees a point.
const GRAZING: f64 = 0.05;
/// Alpha of pixels of the object, and how many pixels from any other one they are.
const SOLID: u8 = 250;
const EDGE: u32 = 2;

/// What photos have for one view, `[height, width]`.
pub(crate) struct Reprojected {
    /// Straight RGB; without meaning where `trust` is 0.
    pub color: Vec<[f32; 3]>,
    /// 0 to 1.
    pub trust: Vec<f32>,
}

/// What `photos` show of the views of `cameras`, by the mean surface of `sets`.
pub(crate) fn reprojected(
    cameras: &[Camera],
    raster: &RasterConfig,
    sets: &[Gaussians],
    photos: &Targets,
) -> Result<Vec<Reprojected>, FitError> {
    let mut seen = cameras.iter().map(|camera| Points::new(camera, raster, sets)).collect::<Result<Vec<_>, _>>()?;
    let asked = if cameras.is_empty() { 0 } else { photos.views.min(MOST_PHOTOS) };
    for i in (0..asked).map(|k| k * photos.views / asked) {
        let photo = Photo::new(photos, i, sets)?;
        seen.par_iter_mut().for_each(|points| points.look(&photo));
    }
    Ok(seen.into_iter().map(Points::colors).collect())
}

/// Camera z of the surface, `[height, width]`, as the mean of the sets; infinite where no more than half of them have one. And
/// the standard deviation.
fn depths(camera: &Camera, raster: &RasterConfig, sets: &[Gaussians]) -> Result<Vec<(f64, f64)>, FitError> {
    let all = sets.iter().map(|set| surface_depth(set.rows(), camera, raster)).collect::<Result<Vec<_>, _>>()?;
    let of_pixel = |i: usize| {
        let found = || all.iter().map(|depth| f64::from(depth[i])).filter(|z| z.is_finite());
        let count = found().count();
        if 2 * count <= sets.len() {
            return (f64::INFINITY, 0.0);
        }
        let mean = found().sum::<f64>() / count as f64;
        (mean, (found().map(|z| (z - mean).powi(2)).sum::<f64>() / count as f64).sqrt())
    };
    Ok((0..all[0].len()).into_par_iter().map(of_pixel).collect())
}

/// A photo, and the surface as it sees it.
struct Photo<'a> {
    camera: Camera,
    image: &'a RgbaImage,
    weight: f64,
    depth: Vec<(f64, f64)>,
    /// Pixels of the object alone.
    solid: Vec<bool>,
}

impl<'a> Photo<'a> {
    fn new(photos: &'a Targets, i: usize, sets: &[Gaussians]) -> Result<Self, FitError> {
        let (camera, image) = (photos.cameras[i], &*photos.images[i]);
        let (w, h) = image.dimensions();
        let solid = |i: u32| {
            let (x, y) = (i % w, i / w);
            let rows = y.saturating_sub(EDGE)..(y + EDGE + 1).min(h);
            let columns = x.saturating_sub(EDGE)..(x + EDGE + 1).min(w);
            rows.into_iter().all(|y| columns.clone().all(|x| image.get_pixel(x, y).0[3] >= SOLID))
        };
        Ok(Self {
            camera,
            image,
            weight: photos.weights[i],
            depth: depths(&camera, &photos.rasters[i], sets)?,
            solid: (0..w * h).into_par_iter().map(solid).collect(),
        })
    }

    /// Its color of a point, and the cosine between the normal there and its line of sight; none if it does not see it.
    fn sees(&self, point: DVec3, normal: DVec3) -> Option<(DVec3, f64)> {
        let c = &self.camera;
        let cosine = normal.dot((c.center() - point).normalize());
        let p = c.world_to_camera.transform_point3(point);
        let (x, y) = (p.x / p.z * c.fx + c.cx - 0.5, p.y / p.z * c.fy + c.cy - 0.5);
        let inside = |x: f64, side: u32| x >= 0.0 && x < f64::from(side - 1);
        if cosine < GRAZING || p.z <= 0.0 || !inside(x, c.width) || !inside(y, c.height) {
            return None;
        }
        let at = y.round() as usize * c.width as usize + x.round() as usize;
        if !self.solid[at] || (self.depth[at].0 - p.z).abs() > TOLERANCE {
            return None;
        }
        let (column, row) = (x as u32, y as u32);
        let (u, v) = (x.fract(), y.fract());
        let pixel = |dx: u32, dy: u32| {
            let [r, g, b, _] = self.image.get_pixel(column + dx, row + dy).0.map(f64::from);
            DVec3::new(r, g, b) / 255.0
        };
        Some((pixel(0, 0).lerp(pixel(1, 0), u).lerp(pixel(0, 1).lerp(pixel(1, 1), u), v), cosine))
    }
}

/// The surface behind one pixel, and what photos have of it so far.
struct Point {
    place: DVec3,
    normal: DVec3,
    deviation: f64,
    color: DVec3,
    weight: f64,
    /// Largest cosine.
    cosine: f64,
}

/// What a camera sees of the surface, `[height, width]`.
struct Points(Vec<Option<Point>>);

impl Points {
    fn new(camera: &Camera, raster: &RasterConfig, sets: &[Gaussians]) -> Result<Self, FitError> {
        let depth = depths(camera, raster, sets)?;
        let flat: Vec<f32> = depth.iter().map(|(z, _)| *z as f32).collect();
        let to_world = DMat3::from_mat4(camera.world_to_camera).transpose();
        let pixels = depth.iter().zip(surface_normals(&flat, camera)).enumerate();
        let point = |(i, (&(z, deviation), normal)): (usize, (&(f64, f64), [f32; 3]))| {
            let (x, y) = (i % camera.width as usize, i / camera.width as usize);
            let [x, y] = [(x, camera.cx, camera.fx), (y, camera.cy, camera.fy)]
                .map(|(pixel, middle, focal)| (pixel as f64 + 0.5 - middle) / focal);
            z.is_finite().then(|| Point {
                place: camera.center() + to_world * (z * DVec3::new(x, y, 1.0)),
                normal: to_world * DVec3::from_array(normal.map(f64::from)),
                deviation,
                color: DVec3::ZERO,
                weight: 0.0,
                cosine: 0.0,
            })
        };
        Ok(Self(pixels.map(point).collect()))
    }

    fn look(&mut self, photo: &Photo<'_>) {
        for point in self.0.iter_mut().flatten() {
            if let Some((color, cosine)) = photo.sees(point.place, point.normal) {
                let weight = photo.weight * cosine.powi(POWER);
                point.color += weight * color;
                point.weight += weight;
                point.cosine = point.cosine.max(cosine);
            }
        }
    }

    fn colors(self) -> Reprojected {
        let of_point = |point: &Point| {
            let direct = ((point.cosine - COSINES[0]) / (COSINES[1] - COSINES[0])).clamp(0.0, 1.0);
            let agreed = (-(point.deviation / DEVIATION).powi(2)).exp();
            ((point.color / point.weight).as_vec3().to_array(), (direct * agreed) as f32)
        };
        let seen =
            |point: &Option<Point>| point.as_ref().filter(|point| point.weight > 0.0).map_or(([0.0; 3], 0.0), of_point);
        let (color, trust) = self.0.iter().map(seen).unzip();
        Reprojected { color, trust }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use freerange_scene::camera::View;

    const SIDE: u32 = 96;

    /// Flat opaque Gaussians on the square |x|, |z| <= `half` of the plane y = `y`.
    fn square(y: f32, half: f32) -> Gaussians {
        let steps = (half / 0.01) as i32;
        let along = move || (-steps..=steps).map(|i| i as f32 * 0.01);
        let row = |(x, z)| [x, y, z, -4.4, -8.0, -4.4, 1.0, 0.0, 0.0, 0.0, 6.0, 0.0, 0.0, 0.0];
        let rows = along().flat_map(|x| along().map(move |z| (x, z))).flat_map(row);
        Gaussians::from_rows(rows.collect())
    }

    fn camera(eye: DVec3) -> Camera {
        Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.6, SIDE, SIDE)
    }

    /// Where the ray of a pixel meets the plane y = 0.
    fn met(camera: &Camera, x: u32, y: u32) -> DVec3 {
        let (eye, ray) = (camera.center(), camera.ray_direction(f64::from(x) + 0.5, f64::from(y) + 0.5));
        eye - ray * (eye.y / ray.y)
    }

    /// A photo of the plane y = 0, red where x < 0, blue elsewhere.
    fn photo(eye: DVec3) -> View {
        let camera = camera(eye);
        let image = RgbaImage::from_fn(SIDE, SIDE, |x, y| {
            image::Rgba(if met(&camera, x, y).x < 0.0 { [255, 0, 0, 255] } else { [0, 0, 255, 255] })
        });
        View { name: "photo".into(), camera, image }
    }

    fn seen(eye: DVec3, sets: &[Gaussians], photos: &[View]) -> (Camera, Reprojected) {
        let (camera, targets) = (camera(eye), Targets::new(photos, None).unwrap());
        let found = reprojected(&[camera], &RasterConfig::default(), sets, &targets).unwrap();
        (camera, found.into_iter().next().unwrap())
    }

    /// Calls `f` with the place on the plane, color and trust of each pixel that shows the inner part of the square.
    fn inner(camera: &Camera, found: &Reprojected, mut f: impl FnMut(DVec3, [f32; 3], f32)) {
        for i in 0..SIDE * SIDE {
            let at = met(camera, i % SIDE, i / SIDE);
            if at.x.abs() < 0.25 && at.z.abs() < 0.25 {
                f(at, found.color[i as usize], found.trust[i as usize]);
            }
        }
    }

    #[test]
    fn a_plane_has_the_photos_colors_from_aside() {
        let photos = [photo(DVec3::new(0.0, -2.0, 0.0))];
        let (camera, found) = seen(DVec3::new(1.2, -1.6, 0.0), &[square(0.0, 0.3)], &photos);
        let mut pixels = 0;
        inner(&camera, &found, |at, color, trust| {
            assert!(trust > 0.95, "{trust} at {at}");
            // Within a pixel of the border both mix.
            if at.x.abs() > 0.03 {
                let expected = if at.x < 0.0 { [1.0, 0.0, 0.0] } else { [0.0, 0.0, 1.0] };
                assert_eq!(color, expected, "at {at}");
                pixels += 1;
            }
        });
        assert!(pixels > 500, "{pixels}");
    }

    #[test]
    fn what_no_photo_sees_has_no_color() {
        // From behind the plane, and with a smaller square before it.
        let behind = [photo(DVec3::new(0.0, 2.0, 0.0))];
        let (camera, found) = seen(DVec3::new(0.0, -2.0, 0.0), &[square(0.0, 0.3)], &behind);
        inner(&camera, &found, |at, _, trust| assert_eq!(trust, 0.0, "at {at}"));

        let hidden = Gaussians::from_rows(
            [square(0.0, 0.3), square(-0.2, 0.1)].iter().flat_map(Gaussians::rows).copied().collect(),
        );
        let (camera, found) = seen(DVec3::new(1.2, -1.6, 0.0), &[hidden], &[photo(DVec3::new(0.0, -2.0, 0.0))]);
        let (mut lost, mut kept) = (0, 0);
        inner(&camera, &found, |at, _, trust| {
            // The small square's shadow from the photo's place, at 0.2 before the plane: 0.1 becomes 0.11. Where it covers the plane
            // from aside (x < 0), another point is seen.
            if at.x.abs() < 0.09 && at.x > 0.0 && at.z.abs() < 0.09 {
                assert_eq!(trust, 0.0, "at {at}");
                lost += 1;
            } else if at.x > 0.15 || at.z.abs() > 0.15 {
                assert!(trust > 0.5, "{trust} at {at}");
                kept += 1;
            }
        });
        assert!(lost > 20 && kept > 200, "{lost} {kept}");
    }

    #[test]
    fn sets_that_disagree_are_trusted_less() {
        let photos = [photo(DVec3::new(0.0, -2.0, 0.0))];
        let sets = [square(-0.02, 0.3), square(0.02, 0.3)];
        let (camera, found) = seen(DVec3::new(1.2, -1.6, 0.0), &sets, &photos);
        let expected = (-((0.02 * 2.0 / 1.6) / DEVIATION).powi(2)).exp() as f32;
        inner(&camera, &found, |at, _, trust| {
            assert!((trust - expected).abs() < 0.15, "{trust} at {at}, expected {expected}");
        });
    }
}
