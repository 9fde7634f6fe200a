//! Surfaces of which the truth is a formula.

use super::{Field, Point, discs, layered, look, smooth, surface_of};
use crate::{RefineConfig, psnr_over_white, refine, refine_on_surface, tests::go};
use freerange_camera::{Camera, View};
use freerange_raster::{RasterConfig, render};
use freerange_splat::{Cloud, channel};
use glam::{DVec2, DVec3};
use image::{Rgba, RgbaImage};

type Shape = fn(DVec3) -> f64;

fn sphere(p: DVec3) -> f64 {
    p.length() - 0.4
}

fn block(p: DVec3) -> f64 {
    let q = p.abs() - DVec3::new(0.3, 0.2, 0.25);
    q.max(DVec3::ZERO).length() + q.max_element().min(0.0)
}

fn torus(p: DVec3) -> f64 {
    DVec2::new(p.truncate().length() - 0.3, p.z).length() - 0.1
}

/// A thick-walled cup, open at the top.
fn cup(p: DVec3) -> f64 {
    let cylinder = |radius: f64, low: f64, high: f64| {
        let q = DVec2::new(p.truncate().length() - radius, (p.z - 0.5 * (low + high)).abs() - 0.5 * (high - low));
        q.max(DVec2::ZERO).length() + q.max_element().min(0.0)
    };
    cylinder(0.3, -0.3, 0.3).max(-cylinder(0.24, -0.24, 0.6))
}

const SHAPES: [(&str, Shape); 4] = [("sphere", sphere), ("box", block), ("torus", torus), ("cup", cup)];

fn gradient(shape: Shape, p: DVec3) -> DVec3 {
    let along = |axis: DVec3| shape(p + 1e-5 * axis) - shape(p - 1e-5 * axis);
    DVec3::new(along(DVec3::X), along(DVec3::Y), along(DVec3::Z)).normalize_or_zero()
}

/// Of the points' distances to a shape: the signed median and the 90 % quantile; and the median cosine between normals.
fn errors(points: &[Point], shape: Shape) -> [f64; 3] {
    let sorted = |mut values: Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values
    };
    let signed = sorted(points.iter().map(|p| shape(p.place)).collect());
    let plain = sorted(points.iter().map(|p| shape(p.place).abs()).collect());
    let cosines = sorted(points.iter().map(|p| gradient(shape, p.place).dot(p.normal)).collect());
    [signed[signed.len() / 2], plain[plain.len() * 9 / 10], cosines[cosines.len() / 2]]
}

#[test]
fn points_of_a_field_are_on_its_surface_and_as_many_as_asked() {
    for (name, shape) in SHAPES {
        let (points, spacing) = Field::new(0.5, 96, shape).points(8000);
        assert!((7000..9000).contains(&points.len()), "{name}: {}", points.len());
        assert!((0.005..0.03).contains(&spacing), "{name}: {spacing}");
        let smoothed = smooth(&smooth(&points, 2.0 * spacing), 2.0 * spacing);
        for (what, points) in [("as found", &points), ("smoothed", &smoothed)] {
            let [signed, most, cosine] = errors(points, shape);
            assert!(signed.abs() < 5e-4 && most < 2e-3, "{name} {what}: {signed} {most}");
            assert!(cosine > 0.998, "{name} {what}: {cosine}");
        }
    }
}

/// Smoothing takes noise away.
#[test]
fn smoothing_a_noisy_sphere_leaves_a_sphere() {
    let (mut points, spacing) = Field::new(0.5, 96, sphere).points(8000);
    for (i, p) in points.iter_mut().enumerate() {
        p.place += 0.006 * (1e4 * (i as f64).sin()).fract() * p.normal;
    }
    let before = errors(&points, sphere);
    let after = errors(&smooth(&points, 2.0 * spacing), sphere);
    assert!(before[1] > 0.004 && after[1] < 0.4 * before[1], "{before:?} {after:?}");
    assert!((after[0] - before[0]).abs() < 1e-3, "{before:?} {after:?}");
}

fn view(eye: DVec3, size: u32) -> Camera {
    Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.8, size, size)
}

fn photo(cloud: &Cloud, camera: Camera) -> View {
    let out = render(cloud.rows(), &[camera], &[[0.0; 3]], &RasterConfig::default()).unwrap();
    let mut image = RgbaImage::new(camera.width, camera.height);
    for ((pixel, rgb), alpha) in image.pixels_mut().zip(out.rgb.as_chunks::<3>().0).zip(out.alpha) {
        let byte = |v: f32| (255.0 * v.clamp(0.0, 1.0)).round() as u8;
        let [r, g, b] = rgb.map(|v| byte(v / alpha.max(1e-3)));
        *pixel = Rgba([r, g, b, byte(alpha)]);
    }
    View { name: "photo".into(), camera, image }
}

/// From Gaussians back to the shape, inside of the cup included, with and without photos' outlines.
#[test]
fn the_surface_of_gaussians_is_that_of_their_shape() {
    for (name, shape) in SHAPES {
        let (points, spacing) = Field::new(0.5, 96, shape).points(8000);
        let cloud = discs(&points, spacing);
        let photos =
            [photo(&cloud, view(DVec3::new(1.4, 0.2, 0.6), 128)), photo(&cloud, view(DVec3::new(-1.2, 0.8, 0.5), 128))];
        for photos in [&photos[..], &[]] {
            let (points, _) = surface_of(std::slice::from_ref(&cloud), photos, 0.5).unwrap().points(6000);
            let [signed, most, cosine] = errors(&points, shape);
            assert!(signed.abs() < 3e-3 && most < 8e-3 && cosine > 0.98, "{name}: {signed} {most} {cosine}");
        }
    }
}

#[test]
fn photos_see_what_faces_them_and_is_not_hidden() {
    let (points, spacing) = Field::new(0.5, 96, cup).points(8000);
    let mut cloud = discs(&points, spacing);
    // One side red, the other green.
    cloud.iter_mut().for_each(|row| {
        let color = if row[0] > 0.0 { [0.8, 0.2, 0.2] } else { [0.2, 0.8, 0.2] };
        row[channel::COLOR].copy_from_slice(&color);
    });
    let photos = [DVec3::new(1.5, 0.0, 0.3), DVec3::new(-1.5, 0.0, 0.3)].map(|eye| photo(&cloud, view(eye, 256)));
    let seen = look(&points, spacing, &photos).unwrap();
    let (mut outer, mut inner) = (0, 0);
    for s in &seen {
        let p = s.point.place;
        let around = p.truncate().length();
        if p.z.abs() < 0.2 && around < 0.27 {
            // Inside, below the rim: no photo looks in there so deep.
            inner += usize::from(p.z < 0.0 && !s.photos.is_empty());
        } else if p.z.abs() < 0.2 && p.x.abs() > 0.15 {
            outer += 1;
            let expected = usize::from(p.x < 0.0);
            assert!(s.photos.len() == 1 && s.photos[0].0 == expected, "{p}: {:?}", s.photos);
            assert!(s.color[expected] > 0.7 && s.color[1 - expected] < 0.3, "{p}: {:?}", s.color);
        }
    }
    assert!(outer > 1000 && inner == 0, "{outer} {inner}");
}

/// Whether print is at a place of a plane: an E beside an H, again and again.
fn printed(u: f64, v: f64) -> bool {
    let (u, v) = (u.rem_euclid(0.16) / 0.02, v.rem_euclid(0.12) / 0.02);
    let (column, row) = (u as usize, v as usize);
    let letters = ["       ", "EEE H H", "E   H H", "EE  HHH", "E   H H", "EEE H H"];
    letters[row].as_bytes().get(column).is_some_and(|c| *c != b' ')
}

fn print(u: f64, v: f64) -> [f32; 3] {
    if printed(u, v) { [0.1, 0.1, 0.3] } else { [0.9, 0.8, 0.7] }
}

/// A photo of the plane itself. Of Gaussians on it will not do: the nearer one covers the edge of the next, and print seems to lie behind it.
fn photo_of_print(camera: Camera) -> View {
    const PARTS: u32 = 4;
    let image = RgbaImage::from_fn(camera.width, camera.height, |x, y| {
        let mut sum = [0.0; 4];
        for k in 0..PARTS * PARTS {
            let part = |k: u32| (f64::from(k) + 0.5) / f64::from(PARTS);
            let ray = camera.ray_direction(f64::from(x) + part(k % PARTS), f64::from(y) + part(k / PARTS));
            let at = camera.center() - ray * (camera.center().x / ray.x);
            if at.y.abs() < 0.33 && at.z.abs() < 0.33 {
                let [r, g, b] = print(at.y, at.z);
                [r, g, b, 1.0].iter().zip(&mut sum).for_each(|(v, sum)| *sum += v);
            }
        }
        let parts = f32::max(sum[3], 1.0);
        let byte = |v: f32| (255.0 * v).round() as u8;
        Rgba([byte(sum[0] / parts), byte(sum[1] / parts), byte(sum[2] / parts), byte(sum[3] / (PARTS * PARTS) as f32)])
    });
    View { name: "print".into(), camera, image }
}

/// Two guesses have the print before and behind its plane, as photos that are looked at alone would. It comes out as one layer between them.
#[test]
fn print_that_two_photos_see_comes_out_as_one_layer_at_its_depth() {
    const OFF: f64 = 0.01;
    // A slab that the plane is the front of.
    let slab = |off: f64| {
        let distance = |p: DVec3| {
            let q = (p - DVec3::X * (off - 0.1)).abs() - DVec3::new(0.1, 0.33, 0.33);
            q.max(DVec3::ZERO).length() + q.max_element().min(0.0)
        };
        let (points, spacing) = Field::new(0.5, 96, distance).points(20_000);
        let mut cloud = discs(&points, spacing);
        cloud.iter_mut().for_each(|row| {
            let color = print(row[1].into(), row[2].into());
            row[channel::COLOR].copy_from_slice(&color);
        });
        cloud
    };
    let photos = [DVec3::new(1.3, 0.5, 0.2), DVec3::new(1.3, -0.5, 0.1)].map(|eye| photo_of_print(view(eye, 384)));
    let guesses = [slab(OFF), slab(-OFF)];
    let both = Cloud::from_rows(guesses.iter().flat_map(Cloud::rows).copied().collect());
    let field = surface_of(&guesses, &photos, 0.5).unwrap();
    let layer = layered(&both, &field, &photos, 40_000).unwrap();
    // All but what is at the plane's rim.
    let inside = |p: &DVec3| p.y.abs() < 0.28 && p.z.abs() < 0.28 && p.x > -0.05;
    let mut off: Vec<f64> = (0..layer.len()).map(|i| layer.mean(i)).filter(inside).map(|p| p.x.abs()).collect();
    off.sort_by(f64::total_cmp);
    let (median, most) = (off[off.len() / 2], off[off.len() * 9 / 10]);
    assert!(off.len() > 5000 && median < 0.2 * OFF && most < 0.3 * OFF, "{}: {median} {most}", off.len());
    // From a place between the photos it shows the print better than both guesses together do.
    let between = view(DVec3::new(1.4, 0.0, 0.15), 256);
    let truth = photo_of_print(between);
    let wrong = |cloud: &Cloud| {
        let found = photo(cloud, between);
        found.image.pixels().zip(truth.image.pixels()).filter(|(a, b)| a[0].abs_diff(b[0]) > 100).count()
    };
    assert!(5 * wrong(&layer) < 3 * wrong(&both), "{} {}", wrong(&layer), wrong(&both));
}

/// What is near the layer goes, what is elsewhere stays; there are no more than asked for, and without a surface nothing changes.
#[test]
fn a_layer_takes_the_place_of_what_is_near() {
    let field = Field::new(0.5, 64, sphere);
    let (points, spacing) = field.points(1500);
    let photos = [photo(&discs(&points, spacing), view(DVec3::new(1.5, 0.0, 0.0), 96))];
    let other = |x: f32| [x, 0.0, 0.0, -4.0, -4.0, -4.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.5, 0.5, 0.5];
    let cloud = Cloud::from_rows([other(0.39), other(-0.4)].concat());
    let layer = layered(&cloud, &field, &photos, 1500).unwrap();
    assert!((300..1000).contains(&layer.len()), "{}", layer.len());
    assert_eq!(layer.row(layer.len() - 1), &other(-0.4));
    let off = (0..layer.len() - 1).filter(|&i| sphere(layer.mean(i)).abs() > 0.002).count();
    assert!(20 * off < layer.len(), "{off} of {}", layer.len());
    // As many elsewhere as are asked for in all: the layer has to be a coarser one.
    let many = Cloud::from_rows((0..600).flat_map(|i| other(-0.4 + 1e-5 * i as f32)).collect());
    let layer = layered(&many, &field, &photos, 1000).unwrap();
    assert!((900..=1000).contains(&layer.len()), "{}", layer.len());
    let nothing = Field::new(0.5, 64, |_| 1.0);
    assert_eq!(layered(&cloud, &nothing, &photos, 1500).unwrap(), cloud);
}

/// The mean surface of guesses that are too large and too small; one fits between.
#[test]
fn the_surface_of_several_is_their_mean() {
    let guess = |radius: f64| {
        let (points, spacing) = Field::new(0.5, 96, |p| p.length() - radius).points(8000);
        discs(&points, spacing)
    };
    let (points, _) = surface_of(&[guess(0.39), guess(0.41)], &[], 0.5).unwrap().points(6000);
    let [signed, most, cosine] = errors(&points, sphere);
    assert!(signed.abs() < 3e-3 && most < 6e-3 && cosine > 0.99, "{signed} {most} {cosine}");
}

/// A layer on a known surface, from Gaussians that lie too deep: they come to lie on it, and show what the photos show.
#[test]
fn a_layer_on_a_known_surface_shows_what_photos_show() {
    let (points, spacing) = Field::new(0.5, 64, sphere).points(4000);
    let mut truth = discs(&points, spacing);
    truth.iter_mut().for_each(|row| {
        let color = [0.5 + row[0], 0.5 + row[1], 0.5 + row[2]];
        row[channel::COLOR].copy_from_slice(&color);
    });
    let eyes = [DVec3::X, DVec3::NEG_X, DVec3::Y, DVec3::NEG_Y];
    let photos = eyes.map(|eye| photo(&truth, view(1.5 * eye, 96)));
    let mut deep = truth.clone();
    deep.iter_mut().for_each(|row| row[channel::MEAN].iter_mut().for_each(|v| *v *= 0.95));
    let config = RefineConfig { steps: 20, gaussians: 4000, ..RefineConfig::default().detailed(2, 96) };
    let config = RefineConfig { layer: true, growth_rounds: 0, ..config };
    let found = refine_on_surface(&deep, sphere, &photos, &config, go).unwrap();
    let (before, after) = (psnr_over_white(&deep, &photos).unwrap(), psnr_over_white(&found, &photos).unwrap());
    assert!(after > before + 3.0 && after > 27.0, "{before} {after}");
    let off = |cloud: &Cloud| (0..cloud.len()).filter(|&i| sphere(cloud.mean(i)).abs() > 0.01).count();
    assert!(10 * off(&found) < found.len(), "{} of {}", off(&found), found.len());
    assert_eq!(refine_on_surface(&deep, sphere, &photos, &config, go).unwrap(), found);
    // On the surface that the Gaussians themselves have, they stay too deep.
    let own = refine(&deep, &[], &photos, &config, go).unwrap();
    assert!(2 * off(&own) > own.len(), "{} of {}", off(&own), own.len());
    // Without a layer none is put.
    let plain = refine(&deep, &[], &photos, &RefineConfig { layer: false, ..config }, go).unwrap();
    assert_eq!(plain.len(), deep.len());
}
