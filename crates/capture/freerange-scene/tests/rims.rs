//! Rims of nothing that undistorting leaves around photos are no outlines of the object, and outlines are no rims.

mod capture;
mod tabletop;

use capture::{Capture, H, NAMES, W, WHITE, assert_right, busy, camera, hit, ring, shot, tells, wrong};
use freerange_scene::camera::Camera;
use freerange_scene::{LoadConfig, Loaded, MaskKind, MaskSource, NoteKind, SceneError, load};
use glam::{DMat4, DVec3};
use image::{Rgba, RgbaImage};
use serde_json::json;

const CLEAR: [u8; 4] = [0; 4];
const BLACK: [u8; 4] = [0, 0, 0, 255];

/// Empties what lies outside of a barrel about `middle`, in shares of the image. 0.0625 reaches its sides.
fn rim(image: &mut RgbaImage, reach: f64, middle: [f64; 2], color: [u8; 4]) {
    let (w, h) = image.dimensions();
    for (x, y, p) in image.enumerate_pixels_mut() {
        let (dx, dy) = ((f64::from(x) + 0.5) / f64::from(w), (f64::from(y) + 0.5) / f64::from(h));
        if (dx - middle[0]).powi(4) + (dy - middle[1]).powi(4) > reach {
            *p = Rgba(color);
        }
    }
}

/// Camera `i` of `n` on its side.
fn high(i: usize, n: usize) -> Camera {
    let c = camera(i, n);
    Camera::look_at(c.center(), DVec3::ZERO, DVec3::Z, 0.62, H, W)
}

/// Six cameras and the rim of each: how far it reaches, its middle.
type Rimmed = [(Camera, f64, [f64; 2]); 6];

fn names() -> Vec<String> {
    (0..6).map(|i| format!("images/{i}.png")).collect()
}

/// Photos before backgrounds of many colors, with these rims.
fn capture(photos: &Rimmed, color: [u8; 4]) -> Capture {
    let capture = Capture::new();
    let names = names();
    for (i, ((c, reach, middle), name)) in photos.iter().zip(&names).enumerate() {
        let mut image = shot(c, busy(i));
        rim(&mut image, *reach, *middle, color);
        image.save(capture.at(name)).unwrap();
    }
    let frames: Vec<(&str, Camera)> = names.iter().map(String::as_str).zip(photos.iter().map(|p| p.0)).collect();
    capture.describe(&frames, json!({}));
    capture
}

/// Masks are looked for in the photos' colors, which need not suffice at this size.
#[track_caller]
fn no_outline(loaded: Result<Loaded, SceneError>, words: &[&str]) {
    match loaded {
        Ok(loaded) => {
            assert_eq!(loaded.masks, MaskKind::Estimate);
            tells(&loaded.notes, NoteKind::Assumed, words);
        }
        Err(e) => assert!(matches!(e, SceneError::NotCutOut { .. }), "{e}"),
    }
}

const MIDDLE: [f64; 2] = [0.5, 0.5];

#[test]
fn rims_that_differ_are_no_outlines() {
    let (wide, tall) = (|i| camera(i, 6), |i| high(i, 6));
    // Portrait and landscape of one lens; two lenses of one size; one photo on its side; two lenses, one on its side.
    let alternate = |reach: [f64; 2], tall_too: bool| -> Rimmed {
        std::array::from_fn(|i| (if tall_too && i % 2 == 1 { tall(i) } else { wide(i) }, reach[i % 2], MIDDLE))
    };
    let one: Rimmed = std::array::from_fn(|i| (if i == 4 { tall(i) } else { wide(i) }, 0.05, MIDDLE));
    let off: Rimmed = std::array::from_fn(|i| match i % 2 {
        0 => (wide(i), 0.05, [0.51, 0.5]),
        _ => (tall(i), 0.045, [0.5, 0.49]),
    });
    let lenses = alternate([0.05, 0.04], false);
    for color in [CLEAR, BLACK] {
        for photos in &[alternate([0.05; 2], true), lenses, one, off] {
            // Masks have to be found in the photos' colors: that takes more memory than there is.
            let found = load(&capture(photos, color).read(), &LoadConfig { memory: 4 << 20, ..LoadConfig::default() });
            assert!(matches!(found, Err(SceneError::Memory { .. })), "{:?}", found.map(|l| (l.masks, l.notes)));
        }
    }
    // Whoever says that it is the object is believed.
    let photos = lenses;
    let alpha = LoadConfig { masks: MaskSource::Alpha, memory: 4 << 20, ..LoadConfig::default() };
    assert_eq!(load(&capture(&photos, CLEAR).read(), &alpha).unwrap().masks, MaskKind::Alpha);
    let plain = LoadConfig { masks: MaskSource::Plain, memory: 4 << 20, ..LoadConfig::default() };
    assert_eq!(load(&capture(&photos, BLACK).read(), &plain).unwrap().masks, MaskKind::Plain);
}

#[test]
fn rims_of_some_photos_are_no_outlines() {
    // One lens left a rim, the other none.
    let capture = Capture::new();
    for (i, (name, c)) in ring().iter().enumerate() {
        let mut image = shot(c, busy(i));
        if i < 2 {
            rim(&mut image, 0.05, MIDDLE, CLEAR);
        }
        image.save(capture.at(name)).unwrap();
    }
    capture.describe(&ring(), json!({}));
    no_outline(capture.load(), &["rim of 2 photos"]);
    // One photo to compare with, with the rim of the others, before a background that nothing is cut from.
    let capture = Capture::new();
    for (i, (name, c)) in ring().iter().enumerate() {
        let mut image = if i < 3 { shot(c, |_, _| WHITE) } else { shot(c, busy(i)) };
        rim(&mut image, 0.05, MIDDLE, CLEAR);
        image.save(capture.at(name)).unwrap();
    }
    capture.describe(&ring(), json!({"train_filenames": &NAMES[..3]}));
    let loaded = capture.load().unwrap();
    assert_eq!((loaded.masks, loaded.further.len()), (MaskKind::Plain, 0));
    tells(&loaded.notes, NoteKind::Assumed, &["rim of 1 photos to compare with"]);
    tells(&loaded.notes, NoteKind::Dropped, &["1 photos to compare with have no mask"]);
}

#[test]
fn outlines_that_all_fill_their_photos_are_said() {
    // Each lens its own, if these are rims: nothing shows it, so that they are believed, with a warning.
    let reach = [0.058, 0.054, 0.05, 0.046, 0.042, 0.038];
    let photos: Rimmed = std::array::from_fn(|i| (camera(i, 6), reach[i], MIDDLE));
    for (color, kind, words) in [(CLEAR, MaskKind::Alpha, "transparent"), (BLACK, MaskKind::Plain, "black")] {
        let loaded = capture(&photos, color).load().unwrap();
        assert_eq!(loaded.masks, kind);
        tells(&loaded.notes, NoteKind::Warning, &[words, "6 photos (0)", "--masks estimate"]);
    }
    // So are crops that an object fills: these stay right.
    let capture = Capture::new();
    let mut frames = ring();
    for (i, (name, c)) in frames.iter_mut().enumerate() {
        c.world_to_camera *= DMat4::from_translation(DVec3::new(0.3, 0.1 * i as f64, 0.1));
        let moved = c.world_to_camera.transform_point3(DVec3::ZERO);
        let (x, y) = (c.fx * moved.x / moved.z + c.cx, c.fy * moved.y / moved.z + c.cy);
        let r = c.fx * 0.34 / moved.z;
        let cut = |v: f64| v.round().max(0.0) as u32;
        let (left, top, right, bottom) = (cut(x - r), cut(y - r), cut(x + r).min(W), cut(y + r).min(H));
        (c.cx, c.cy) = (c.cx - f64::from(left), c.cy - f64::from(top));
        (c.width, c.height) = (right - left, bottom - top);
        let image = RgbaImage::from_fn(c.width, c.height, |px, py| {
            let ray = c.ray_direction(f64::from(px) + 0.5, f64::from(py) + 0.5);
            Rgba(if c.center().cross(ray).length() < 0.35 { [200, 30, (9 * py) as u8, 255] } else { CLEAR })
        });
        image.save(capture.at(name)).unwrap();
    }
    capture.describe(&frames, json!({}));
    let loaded = capture.load().unwrap();
    assert_eq!(loaded.masks, MaskKind::Alpha);
    tells(&loaded.notes, NoteKind::Warning, &["4 photos (a)"]);
    assert_right(&loaded, 4);
}

#[test]
fn outlines_that_fill_some_photos_stay() {
    // Seen from near by in one photo, beyond its border; in one photo of another size; and nearly so in another.
    let near = |i: usize, eye: f64, w: u32, h: u32| {
        let c = camera(i, 4);
        Camera::look_at(eye * c.center(), DVec3::ZERO, DVec3::Z, 0.8, w, h)
    };
    for (eye, size) in [(0.388, (W, H)), (0.388, (H, W)), (0.45, (W, H))] {
        let capture = Capture::new();
        let mut frames = ring();
        frames[2].1 = near(2, eye, size.0, size.1);
        for (name, c) in &frames {
            // Of one color all along its outline: no backdrop of what is printed on it.
            let printed = |x: f64, y: f64| {
                let middle = DVec3::new(0.0, 0.0, 1.0);
                DMat4::transform_vector3(&c.world_to_camera, c.ray_direction(x, y)).normalize().dot(middle) > 0.995
            };
            let image = RgbaImage::from_fn(c.width, c.height, |x, y| {
                let (x, y) = (f64::from(x) + 0.5, f64::from(y) + 0.5);
                Rgba(match (hit(c, x, y), printed(x, y)) {
                    (true, true) => [20, 30, 200, 255],
                    (true, false) => [230, 230, 226, 255],
                    _ => CLEAR,
                })
            });
            image.save(capture.at(name)).unwrap();
        }
        capture.describe(&frames, json!({}));
        let loaded = capture.load().unwrap();
        assert_eq!(loaded.masks, MaskKind::Alpha);
        assert_right(&loaded, 4);
        let said = loaded.notes.iter().any(|n| n.contains("rim") || n.kind == NoteKind::Warning);
        assert!(!said, "{eye}: {:?}", loaded.notes);
    }
    // One photo cut out by hand, the others before something plain; it is half filled.
    let capture = Capture::new();
    for (i, (name, c)) in ring().iter().enumerate() {
        shot(c, |_, _| if i == 1 { CLEAR } else { WHITE }).save(capture.at(name)).unwrap();
    }
    capture.describe(&ring(), json!({}));
    let loaded = capture.load().unwrap();
    assert_eq!(loaded.masks, MaskKind::Alpha);
    assert_right(&loaded, 4);
    // Before black, from near by.
    let capture = Capture::new();
    let mut frames = ring();
    frames[1].1 = near(1, 0.43, H, H);
    for (name, c) in &frames {
        shot(c, |_, _| BLACK).save(capture.at(name)).unwrap();
    }
    capture.describe(&frames, json!({}));
    let loaded = capture.load().unwrap();
    assert_eq!(loaded.masks, MaskKind::Plain);
    assert!(loaded.views.iter().all(|v| wrong(v) < 0.02));
}

/// A carton on a table, photographed on its side as well: its masks are found within the rims.
#[test]
fn masks_are_found_within_rims_that_differ() {
    let scene = tabletop::tabletop(302, 6, std::f64::consts::TAU, (240, 180));
    assert!(scene.views.iter().any(|v| v.camera.width < v.camera.height));
    for color in [CLEAR, BLACK] {
        let loaded = capture_of(&scene, color).load().unwrap();
        assert_eq!(loaded.masks, MaskKind::Estimate);
        tells(&loaded.notes, NoteKind::Assumed, &["rim of 6 photos"]);
        // Without rims it is 0.980.
        let shares = shares(&loaded, &scene);
        assert!(shares > 0.965, "{shares}");
    }
}

fn capture_of(scene: &tabletop::Tabletop, color: [u8; 4]) -> Capture {
    let capture = Capture::new();
    let names = names();
    for (view, name) in scene.views.iter().zip(&names) {
        let mut image = view.image.clone();
        let reach = if view.camera.width > view.camera.height { 0.055 } else { 0.05 };
        rim(&mut image, reach, MIDDLE, color);
        image.save(capture.at(name)).unwrap();
    }
    let frames: Vec<(&str, Camera)> =
        names.iter().map(String::as_str).zip(scene.views.iter().map(|v| v.camera)).collect();
    capture.describe(&frames, json!({}));
    capture
}

/// Intersection over union of masks and truth, in the mean.
fn shares(loaded: &Loaded, scene: &tabletop::Tabletop) -> f64 {
    let one = |(view, alone): (&freerange_scene::camera::View, &RgbaImage)| {
        let (both, either) = view.image.pixels().zip(alone.pixels()).fold((0, 0), |(both, either), (a, b)| {
            let (a, b) = (a[3] >= 128, b[3] >= 128);
            (both + u32::from(a && b), either + u32::from(a || b))
        });
        f64::from(both) / f64::from(either)
    };
    loaded.views.iter().zip(&scene.alone).map(one).sum::<f64>() / loaded.views.len() as f64
}
