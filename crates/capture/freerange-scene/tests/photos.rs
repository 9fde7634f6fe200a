//! From files to views: what images and masks become, and what is refused.

use freerange_scene::camera::{Camera, Lens};
use freerange_scene::{
    LoadConfig, MaskKind, MaskSource, SceneError, load,
    read::{Cameras, Turntable, cameras},
    write_masks,
};
use glam::{DMat4, DVec3, DVec4};
use image::{DynamicImage, GrayImage, ImageBuffer, Luma, Rgb, RgbImage, Rgba, RgbaImage};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

const W: u32 = 48;
const H: u32 = 32;

fn disc(x: u32, y: u32) -> bool {
    (x as i32 - 20).pow(2) + (y as i32 - 14).pow(2) < 64
}

/// A red disc before a pattern that no plain color could be cut from.
fn photo(w: u32, h: u32) -> RgbImage {
    RgbImage::from_fn(w, h, |x, y| match disc(x, y) {
        true => Rgb([200, 30, 20]),
        false => Rgb([(x * 37 % 200) as u8, (y * 91 % 200) as u8, 90]),
    })
}

fn mask(w: u32, h: u32) -> GrayImage {
    GrayImage::from_fn(w, h, |x, y| Luma([if disc(x, y) { 255 } else { 0 }]))
}

struct Files(TempDir);

impl Files {
    fn new() -> Self {
        let files = Self(tempfile::tempdir().unwrap());
        std::fs::create_dir(files.path("images")).unwrap();
        files
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Three frames, with further fields of the file.
    fn describe(&self, names: [&str; 3], fields: Value) -> Cameras {
        let frames: Vec<Value> = (0..3)
            .map(|i| {
                let a = f64::from(i) * 1.9;
                let eye = DVec3::new(2.0 * a.cos(), 2.0 * a.sin(), 0.7);
                let camera = Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.8, W, H);
                let m = camera.world_to_camera.inverse() * DMat4::from_diagonal(DVec4::new(1.0, -1.0, -1.0, 1.0));
                let rows: Vec<[f64; 4]> = (0..4).map(|i| m.row(i).to_array()).collect();
                json!({"file_path": format!("images/{}", names[i as usize]), "transform_matrix": rows})
            })
            .collect();
        let mut root = json!({"camera_angle_x": 0.8, "frames": frames});
        root.as_object_mut().unwrap().extend(fields.as_object().unwrap().clone());
        std::fs::write(self.path("transforms.json"), root.to_string()).unwrap();
        cameras(self.0.path(), None, None).unwrap()
    }
}

fn config(masks: MaskSource) -> LoadConfig {
    LoadConfig { masks, ..LoadConfig::default() }
}

#[track_caller]
fn says<T>(result: Result<T, SceneError>, words: &[&str]) {
    let text = result.err().expect("an error").to_string();
    words.iter().for_each(|w| assert!(text.contains(w), "expected {w:?} in: {text}"));
}

fn assert_cut(image: &RgbaImage) {
    for (x, y, p) in image.enumerate_pixels() {
        let expected = if disc(x, y) { Rgba([200, 30, 20, 255]) } else { Rgba([0; 4]) };
        assert_eq!(*p, expected, "at {x}, {y}");
    }
}

#[test]
fn images_of_many_kinds_are_read() {
    let files = Files::new();
    let cut = RgbaImage::from_fn(W, H, |x, y| if disc(x, y) { Rgba([200, 30, 20, 255]) } else { Rgba([0; 4]) });
    cut.save(files.path("images/a.png")).unwrap();
    cut.save(files.path("images/b.webp")).unwrap();
    // 16 bits per channel.
    let deep: ImageBuffer<Rgba<u16>, Vec<u16>> =
        ImageBuffer::from_fn(W, H, |x, y| Rgba(cut.get_pixel(x, y).0.map(|v| u16::from(v) * 257)));
    DynamicImage::ImageRgba16(deep).save(files.path("images/c.png")).unwrap();
    let found = files.describe(["a.png", "b", "c.png"], json!({}));
    let loaded = load(&found, &LoadConfig::default()).unwrap();
    assert_eq!((loaded.masks, loaded.views.len()), (MaskKind::Alpha, 3));
    loaded.views.iter().for_each(|v| assert_cut(&v.image));
    assert_eq!(loaded.views.iter().map(|v| v.name.as_str()).collect::<Vec<_>>(), ["a", "b", "c"]);
}

#[test]
fn masks_are_found_by_every_naming() {
    let files = Files::new();
    for name in ["a.png", "b.png", "c.png"] {
        photo(W, H).save(files.path("images").join(name)).unwrap();
    }
    let found = files.describe(["a.png", "b.png", "c.png"], json!({}));
    let folder = files.path("masks");
    std::fs::create_dir(&folder).unwrap();
    // COLMAP's naming, the same name, another extension and twice the size.
    mask(W, H).save(folder.join("a.png.png")).unwrap();
    mask(W, H).save(folder.join("b.png")).unwrap();
    let large = GrayImage::from_fn(2 * W, 2 * H, |x, y| Luma([if disc(x / 2, y / 2) { 255 } else { 0 }]));
    large.save(folder.join("c.webp")).unwrap();
    let loaded = load(&found, &LoadConfig::default()).unwrap();
    assert_eq!(loaded.masks, MaskKind::Files);
    loaded.views.iter().for_each(|v| assert_cut(&v.image));
    assert_eq!(loaded.whole.get(0).unwrap().get_pixel(0, 0).0, [0, 0, 90, 255], "the whole photo is kept");

    // Written by one, read by the other, black for white.
    let mut inverted = mask(W, H);
    inverted.pixels_mut().for_each(|p| p[0] = 255 - p[0]);
    let other = files.path("black");
    std::fs::create_dir(&other).unwrap();
    for name in ["a", "b", "c"] {
        inverted.save(other.join(format!("{name}.png"))).unwrap();
    }
    let config = LoadConfig { invert_masks: true, ..config(MaskSource::Files(other.clone())) };
    load(&found, &config).unwrap().views.iter().for_each(|v| assert_cut(&v.image));

    // What does not fit is refused.
    std::fs::remove_file(other.join("b.png")).unwrap();
    says(load(&found, &config), &["b", "a mask for every photo", "2 masks for 3 photos"]);
    mask(H, W).save(other.join("b.png")).unwrap();
    says(load(&found, &config), &["b.png", "48 x 32", "32 x 48", "its photo's"]);
    GrayImage::from_pixel(W, H, Luma([255])).save(other.join("b.png")).unwrap();
    says(load(&found, &config), &["b", "shows the object", "empty"]);
    std::fs::write(other.join("b.png"), b"\x89PNG\r\n\x1a\nbroken").unwrap();
    says(load(&found, &config), &["b.png", "cannot decode"]);
    says(load(&found, &self::config(MaskSource::Files(files.path("none")))), &["cannot read", "none"]);
    says(load(&found, &self::config(MaskSource::Alpha)), &["a", "alpha channel", "opaque"]);
    says(load(&found, &self::config(MaskSource::Plain)), &["a", "plain color"]);

    // And masks that the cameras' file names.
    let mut root: Value = serde_json::from_slice(&std::fs::read(files.path("transforms.json")).unwrap()).unwrap();
    for (i, name) in ["masks/a.png.png", "masks/b.png", "masks/c.webp"].iter().enumerate() {
        root["frames"][i]["mask_path"] = json!(name);
    }
    std::fs::rename(&other, files.path("elsewhere")).unwrap();
    std::fs::write(files.path("transforms.json"), root.to_string()).unwrap();
    let named = cameras(files.0.path(), None, None).unwrap();
    load(&named, &LoadConfig::default()).unwrap().views.iter().for_each(|v| assert_cut(&v.image));
}

/// A JPEG file with EXIF's orientation.
fn jpeg_with_orientation(image: &RgbImage, orientation: u8, to: &Path) {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image.write_to(&mut bytes, image::ImageFormat::Jpeg).unwrap();
    let bytes = bytes.into_inner();
    let mut exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".to_vec();
    exif.extend([orientation, 0, 0, 0, 0, 0, 0, 0]);
    let length = (exif.len() as u16 + 2).to_be_bytes();
    let out = [&bytes[..2], &[0xff, 0xe1], &length, &exif, &bytes[2..]].concat();
    std::fs::write(to, out).unwrap();
}

#[test]
fn exif_turns_only_where_the_camera_wants_it() {
    let files = Files::new();
    for name in ["a.jpg", "b.jpg", "c.jpg"] {
        // 6: turn clockwise by a right angle to see it upright.
        jpeg_with_orientation(&photo(W, H), 6, &files.path("images").join(name));
        mask(W, H).save(files.path("images").join(format!("{name}.png"))).unwrap();
    }
    let names = ["a.jpg", "b.jpg", "c.jpg"];
    let stored = files.path("images");
    // Cameras of the stored size: nothing is turned.
    let found = files.describe(names, json!({"w": W, "h": H}));
    let loaded = load(&found, &config(MaskSource::Files(stored.clone()))).unwrap();
    assert_eq!(loaded.views[0].image.dimensions(), (W, H));
    // Cameras of the turned size.
    let turned = files.path("turned");
    std::fs::create_dir(&turned).unwrap();
    for name in names {
        image::imageops::rotate90(&mask(W, H)).save(turned.join(format!("{name}.png"))).unwrap();
    }
    let found = files.describe(names, json!({"w": H, "h": W}));
    let loaded = load(&found, &config(MaskSource::Files(turned.clone()))).unwrap();
    assert_eq!(loaded.views[0].image.dimensions(), (H, W));
    assert!(loaded.notes.iter().any(|n| n.contains("3 photos were turned")), "{:?}", loaded.notes);
    let cut = &loaded.views[0].image;
    // (20, 14) comes to (H - 1 - 14, 20).
    assert!(cut.get_pixel(H - 15, 20)[0] > 150 && cut.get_pixel(H - 15, 20)[3] == 255);
    // And a camera of neither.
    let found = files.describe(names, json!({"w": 100, "h": 30}));
    says(load(&found, &config(MaskSource::Files(stored))), &["a.jpg", "100 x 30", "32 x 48", "its camera's"]);
    // Without cameras, what a viewer shows.
    let turntable: Turntable = "20,50".parse().unwrap();
    let found = cameras(files.0.path(), None, Some(&turntable));
    assert_eq!(found.unwrap().photos.len(), 6, "the masks lie there, too");
    names.iter().for_each(|n| std::fs::remove_file(files.path("images").join(format!("{n}.png"))).unwrap());
    let found = cameras(files.0.path(), None, Some(&turntable)).unwrap();
    let loaded = load(&found, &config(MaskSource::Files(turned))).unwrap();
    assert_eq!((loaded.views[0].camera.width, loaded.views[0].camera.height), (H, W));
}

#[test]
fn lenses_are_undone_and_masks_written_with_them() {
    let files = Files::new();
    let (w, h) = (240, 160);
    let lens = Lens::brown([-0.15, 0.02, 0.0, 0.0], [0.002, -0.001]);
    let camera = Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, 0.8, w, h);
    let ideal = RgbaImage::from_fn(w, h, |x, y| {
        let inside = (x as i32 - 100).pow(2) + (y as i32 - 90).pow(2) < 3000;
        if inside { Rgba([200, 60, 20, 255]) } else { Rgba([0, 0, 0, 255]) }
    });
    let taken = lens.distort(&ideal, &camera);
    let masks = files.path("given");
    std::fs::create_dir(&masks).unwrap();
    for name in ["a", "b", "c"] {
        taken.save(files.path(&format!("images/{name}.png"))).unwrap();
        let mask = GrayImage::from_fn(w, h, |x, y| Luma([if taken.get_pixel(x, y)[0] > 100 { 255 } else { 0 }]));
        mask.save(masks.join(format!("{name}.png"))).unwrap();
    }
    let fields = json!({"camera_model": "OPENCV", "k1": -0.15, "k2": 0.02, "p1": 0.002, "p2": -0.001});
    let found = files.describe(["a.png", "b.png", "c.png"], fields);
    let loaded = load(&found, &config(MaskSource::Files(masks))).unwrap();
    let differ = |a: &RgbaImage, b: &RgbaImage| {
        let count = a.pixels().zip(b.pixels()).filter(|(a, b)| (a[3] >= 128) != (b[0] > 100)).count();
        count as f64 / 9424.0
    };
    assert!(differ(&loaded.views[0].image, &ideal) < 0.01);
    assert!(loaded.notes.iter().any(|n| n.contains("distortion was removed from 3")));

    // Written masks belong to the photos as they were taken, and come back as they were, from smaller views, too.
    let small = load(&found, &LoadConfig { max_side: 120, ..config(MaskSource::Files(files.path("given"))) }).unwrap();
    assert_eq!((small.views[0].camera.width, small.views[0].camera.height), (120, 80));
    for (loaded, most) in [(&loaded, 0.01), (&small, 0.03)] {
        let out = tempfile::tempdir().unwrap();
        let written = write_masks(out.path(), &found, loaded).unwrap();
        assert_eq!(written[1], out.path().join("b.png.png"));
        let read = image::open(&written[1]).unwrap().into_luma8();
        assert_eq!(read.dimensions(), (w, h));
        let wrong = read.pixels().zip(taken.pixels()).filter(|(m, t)| (m[0] >= 128) != (t[0] > 100)).count();
        assert!((wrong as f64) < most * 9424.0, "{wrong}");
        let again = load(&found, &config(MaskSource::Files(out.path().into()))).unwrap();
        assert!(differ(&again.views[1].image, &ideal) < 2.0 * most);
    }
    // A lens that folds the photo has no picture without it.
    let found = files.describe(["a.png", "b.png", "c.png"], json!({"camera_model": "OPENCV", "k1": -40.0}));
    says(load(&found, &config(MaskSource::Alpha)), &["distortion", "one to one", "one to one"]);
}

#[test]
fn scenes_that_cannot_serve_are_refused() {
    let files = Files::new();
    for name in ["a.png", "b.png", "c.png"] {
        photo(W, H).save(files.path("images").join(name)).unwrap();
    }
    let mut found = files.describe(["a.png", "b.png", "c.png"], json!({}));
    std::fs::write(files.path("images/b.png"), b"\x89PNG\r\n\x1a\n").unwrap();
    says(load(&found, &LoadConfig::default()), &["b.png", "cannot decode"]);
    photo(W, H).save(files.path("images/b.png")).unwrap();
    found.photos.truncate(1);
    says(load(&found, &LoadConfig::default()), &["at least 2 photos", "found 1"]);
    // Without masks, and too few to find them.
    let mut found = files.describe(["a.png", "b.png", "c.png"], json!({}));
    found.photos.truncate(2);
    says(load(&found, &LoadConfig::default()), &["could not be cut out", "at least 3 views", "--masks"]);
    // Some with alpha, others without.
    let cut = RgbaImage::from_fn(W, H, |x, y| if disc(x, y) { Rgba([200, 30, 20, 255]) } else { Rgba([0; 4]) });
    cut.save(files.path("images/a.png")).unwrap();
    let found = files.describe(["a.png", "b.png", "c.png"], json!({}));
    says(load(&found, &LoadConfig::default()), &["b", "alpha channel", "plain color"]);
}
