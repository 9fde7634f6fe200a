//! Loading scenes, good and broken.

use freerange_scene::camera::{Camera, CameraError, Scene, load_cameras, transforms_json};
use glam::{DMat4, DVec3};
use image::{DynamicImage, ImageBuffer, Rgb, RgbImage, Rgba, RgbaImage};
use proptest::prelude::*;
use serde_json::{Value, json};
use std::path::Path;
use tempfile::TempDir;

const SIDE: u32 = 32;

fn disc(x: u32, y: u32) -> bool {
    (x as i32 - 15).pow(2) + (y as i32 - 16).pow(2) < 81
}

/// A red disc before nothing.
fn cut_out_image() -> RgbaImage {
    RgbaImage::from_fn(SIDE, SIDE, |x, y| if disc(x, y) { Rgba([200, 30, 20, 255]) } else { Rgba([0; 4]) })
}

/// A red disc before light gray, with a little noise.
fn plain_image() -> RgbImage {
    RgbImage::from_fn(SIDE, SIDE, |x, y| {
        let noise = ((x * 7 + y * 13) % 5) as u8;
        if disc(x, y) { Rgb([200, 30, 20]) } else { Rgb([230 + noise, 230, 232 - noise]) }
    })
}

/// OpenGL camera-to-world, row by row, of a camera that looks at the origin.
fn pose(eye: DVec3) -> Value {
    let camera = Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.8, SIDE, SIDE);
    let flip = DMat4::from_diagonal(glam::DVec4::new(1.0, -1.0, -1.0, 1.0));
    let m = camera.world_to_camera.inverse() * flip;
    json!((0..4).map(|i| m.row(i).to_array()).collect::<Vec<_>>())
}

fn eye(i: usize) -> DVec3 {
    let a = i as f64 * 1.5;
    DVec3::new(1.5 * a.cos(), 1.5 * a.sin(), 0.6)
}

/// Four views with alpha.
fn description() -> Value {
    let frames: Vec<Value> =
        (0..4).map(|i| json!({"file_path": format!("./images/{i:03}"), "transform_matrix": pose(eye(i))})).collect();
    json!({"camera_angle_x": 0.8, "frames": frames})
}

struct Files(TempDir);

impl Files {
    fn new() -> Self {
        let files = Self(tempfile::tempdir().unwrap());
        std::fs::create_dir(files.path("images")).unwrap();
        for i in 0..4 {
            cut_out_image().save(files.path(&format!("images/{i:03}.png"))).unwrap();
        }
        files
    }

    fn path(&self, name: &str) -> std::path::PathBuf {
        self.0.path().join(name)
    }

    fn load(&self, description: &Value) -> Result<Scene, CameraError> {
        std::fs::write(self.path("transforms.json"), description.to_string()).unwrap();
        Scene::load(self.0.path())
    }

    /// The message of the error that a description gives, with the causes behind it.
    fn refusal(&self, description: &Value) -> String {
        message(self.load(description).unwrap_err())
    }
}

fn message(error: CameraError) -> String {
    let mut text = error.to_string();
    let mut cause = std::error::Error::source(&error);
    while let Some(c) = cause {
        text += &format!(": {c}");
        cause = c.source();
    }
    text
}

#[track_caller]
fn assert_says(text: &str, words: &[&str]) {
    for word in words {
        assert!(text.contains(word), "expected {word:?} in: {text}");
    }
}

#[test]
fn a_nerf_scene_loads() {
    let files = Files::new();
    let scene = files.load(&description()).unwrap();
    assert_eq!(scene.inputs.iter().map(|v| v.name.as_str()).collect::<Vec<_>>(), ["000", "001", "002", "003"]);
    assert!(scene.further.is_empty() && scene.notes.is_empty());
    for (i, view) in scene.inputs.iter().enumerate() {
        let expected = Camera::look_at(eye(i), DVec3::ZERO, DVec3::Z, 0.8, SIDE, SIDE);
        let (a, b) = (view.camera.world_to_camera.to_cols_array(), expected.world_to_camera.to_cols_array());
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12));
        assert!((view.camera.fx - expected.fx).abs() < 1e-12 && view.camera.fy == view.camera.fx);
        assert_eq!((view.camera.cx, view.camera.cy), (16.0, 16.0));
        assert_eq!(view.image, cut_out_image());
    }
    // A file can be named itself, and the cameras read alone.
    assert_eq!(Scene::load(&files.path("transforms.json")).unwrap().inputs.len(), 4);
    let cameras = load_cameras(files.0.path()).unwrap();
    assert!(cameras.iter().zip(&scene.inputs).all(|((n, c), v)| *n == v.name && *c == v.camera));
}

#[test]
fn train_and_test_files_are_inputs_and_further_views() {
    let files = Files::new();
    std::fs::write(files.path("transforms_train.json"), description().to_string()).unwrap();
    let mut test = description();
    test["frames"].as_array_mut().unwrap().truncate(1);
    std::fs::write(files.path("transforms_test.json"), test.to_string()).unwrap();
    let scene = Scene::load(files.0.path()).unwrap();
    assert_eq!((scene.inputs.len(), scene.further.len(), scene.files.len()), (4, 1, 2));
    // transforms.json goes first, and that is said.
    let scene = files.load(&description()).unwrap();
    assert!(scene.further.is_empty());
    assert_says(&scene.notes[0], &["transforms_train.json"]);
}

#[test]
fn a_nerfstudio_scene_loads() {
    let files = Files::new();
    let mut d = description();
    d.as_object_mut().unwrap().remove("camera_angle_x");
    for (name, value) in
        [("fl_x", 40.0), ("fl_y", 41.0), ("cx", 15.0), ("cy", 17.0), ("w", 32.0), ("h", 32.0), ("k1", 0.0)]
    {
        d[name] = json!(value);
    }
    d["camera_model"] = json!("OPENCV");
    d["applied_transform"] = json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]);
    d["train_filenames"] = json!(["./images/000", "./images/001", "./images/002"]);
    d["frames"][1]["fl_x"] = json!(44.0);
    d["frames"][2]["transform_matrix"].as_array_mut().unwrap().pop();
    let scene = files.load(&d).unwrap();
    assert_eq!((scene.inputs.len(), scene.further.len()), (3, 1));
    let camera = scene.inputs[0].camera;
    assert_eq!((camera.fx, camera.fy, camera.cx, camera.cy), (40.0, 41.0, 15.0, 17.0));
    assert_eq!(scene.inputs[1].camera.fx, 44.0);
    assert_says(&scene.notes.join("\n"), &["applied_transform"]);
}

#[test]
fn cameras_need_no_images_where_the_size_is_given() {
    let files = Files::new();
    let mut d = description();
    std::fs::remove_dir_all(files.path("images")).unwrap();
    std::fs::write(files.path("transforms.json"), d.to_string()).unwrap();
    assert_says(&message(load_cameras(files.0.path()).unwrap_err()), &["frame 0", "no image"]);
    (d["w"], d["h"]) = (json!(64), json!(48));
    std::fs::write(files.path("transforms.json"), d.to_string()).unwrap();
    let cameras = load_cameras(&files.path("transforms.json")).unwrap();
    assert_eq!((cameras.len(), cameras[0].1.width, cameras[0].1.height), (4, 64, 48));
}

#[test]
fn cameras_are_read_whatever_masks_their_file_names() {
    // Of one frame, and of all; whether the file is there or not.
    for (frame, all) in
        [(Some("masks/000.png"), None), (None, Some("gone\\mask.png")), (Some("./m.png"), Some("n.png"))]
    {
        let files = Files::new();
        let mut d = description();
        (d["w"], d["h"]) = (json!(SIDE), json!(SIDE));
        (d["frames"][0]["mask_path"], d["mask_path"]) = (json!(frame), json!(all));
        std::fs::write(files.path("transforms.json"), d.to_string()).unwrap();
        let cameras = load_cameras(files.0.path()).unwrap();
        assert_eq!((cameras.len(), cameras[3].0.as_str(), cameras[3].1.width), (4, "003", SIDE));
    }
}

#[test]
fn a_plain_background_becomes_transparent() {
    let files = Files::new();
    for i in 0..4 {
        plain_image().save(files.path(&format!("images/{i:03}.png"))).unwrap();
    }
    let scene = files.load(&description()).unwrap();
    assert_says(&scene.notes[0], &["4 images", "background"]);
    for (x, y, p) in scene.inputs[0].image.enumerate_pixels() {
        assert_eq!(p[3], if disc(x, y) { 255 } else { 0 }, "{x} {y}");
    }
}

#[test]
fn a_soft_edge_is_unmixed() {
    // A disc drawn with coverage, over a plain background.
    let coverage =
        |x: u32, y: u32| (10.5 - ((x as f32 - 15.0).powi(2) + (y as f32 - 16.0).powi(2)).sqrt()).clamp(0.0, 1.0);
    let (object, background) = ([180.0, 40.0, 60.0], [20.0, 200.0, 90.0]);
    let image = RgbaImage::from_fn(SIDE, SIDE, |x, y| {
        let a = coverage(x, y);
        let c = |i: usize| (a * object[i] + (1.0 - a) * background[i]).round() as u8;
        Rgba([c(0), c(1), c(2), 255])
    });
    let (cut, color) = freerange_scene::camera::scene::cut_out(&image).unwrap();
    assert_eq!(color, [20, 200, 90]);
    for (x, y, p) in cut.enumerate_pixels() {
        let expected = 255.0 * coverage(x, y);
        assert!((f32::from(p[3]) - expected).abs() <= 20.0, "{x} {y}: {} {expected}", p[3]);
        if p[3] > 60 {
            assert!((0..3).all(|c| (f32::from(p[c]) - object[c]).abs() < 8.0), "{x} {y}: {p:?}");
        }
    }
}

#[test]
fn other_pixel_formats_are_converted() {
    let files = Files::new();
    let deep = DynamicImage::from(cut_out_image()).into_rgba16();
    deep.save(files.path("images/000.png")).unwrap();
    let gray = ImageBuffer::from_fn(SIDE, SIDE, |x, y| image::Luma([if disc(x, y) { 40u8 } else { 250 }]));
    gray.save(files.path("images/001.png")).unwrap();
    std::fs::remove_file(files.path("images/002.png")).unwrap();
    plain_image().save(files.path("images/002.jpg")).unwrap();
    let scene = files.load(&description()).unwrap();
    assert_eq!(scene.inputs[0].image, cut_out_image());
    assert_eq!(scene.inputs[1].image.get_pixel(15, 16).0, [40, 40, 40, 255]);
    assert_eq!(scene.inputs[1].image.get_pixel(0, 0)[3], 0);
    let solid = scene.inputs[2].image.pixels().filter(|p| p[3] > 128).count() as i32;
    let expected = cut_out_image().pixels().filter(|p| p[3] > 0).count() as i32;
    // JPEG smears color over one ring of pixels.
    assert!((solid - expected).abs() < 70, "{solid} {expected}");
}

#[test]
fn images_that_do_not_serve_are_refused() {
    let files = Files::new();
    let d = description();
    let path = files.path("images/002.png");
    let bytes = std::fs::read(&path).unwrap();

    std::fs::remove_file(&path).unwrap();
    assert_says(&files.refusal(&d), &["transforms.json", "frame 2", "no image", "images/002"]);
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    assert_says(&files.refusal(&d), &["frame 2", "cannot decode", "002.png"]);
    std::fs::write(&path, b"no image at all").unwrap();
    assert_says(&files.refusal(&d), &["frame 2", "002.png"]);
    std::fs::write(&path, b"").unwrap();
    assert_says(&files.refusal(&d), &["frame 2", "002.png"]);
    RgbImage::from_fn(SIDE, SIDE, |x, y| Rgb([(x * 8) as u8, (y * 8) as u8, ((x ^ y) * 8) as u8])).save(&path).unwrap();
    assert_says(&files.refusal(&d), &["frame 2", "alpha channel", "border"]);
    RgbImage::from_pixel(SIDE, SIDE, Rgb([9; 3])).save(&path).unwrap();
    assert_says(&files.refusal(&d), &["frame 2", "nothing but the color"]);
    RgbaImage::new(SIDE, SIDE).save(&path).unwrap();
    assert_says(&files.refusal(&d), &["frame 2", "transparent everywhere"]);
    // A header that promises a huge image is refused before anything is allocated.
    let mut huge = bytes.clone();
    huge[16..24].copy_from_slice(&[0, 0, 0xff, 0xff, 0, 0, 0xff, 0xff]);
    std::fs::write(&path, &huge).unwrap();
    assert_says(&files.refusal(&d), &["frame 2", "cannot decode"]);
}

#[test]
fn image_sizes_must_fit_the_intrinsics() {
    let files = Files::new();
    let mut d = description();
    d.as_object_mut().unwrap().remove("camera_angle_x");
    (d["w"], d["h"], d["fl_x"], d["cx"]) = (json!(64), json!(64), json!(80.0), json!(30.0));
    let scene = files.load(&d).unwrap();
    assert_eq!((scene.inputs[0].camera.fx, scene.inputs[0].camera.cx, scene.inputs[0].camera.width), (40.0, 15.0, 32));
    assert_says(&scene.notes[0], &["4 images differ in size", "64 x 64"]);
    d["h"] = json!(48);
    assert_says(&files.refusal(&d), &["frame 0", "64 x 48", "32 x 32"]);
    d.as_object_mut().unwrap().remove("h");
    assert_says(&files.refusal(&d), &["`h`", "both"]);
}

type Change = fn(&mut Value);

#[test]
fn descriptions_that_make_no_sense_are_refused() {
    let files = Files::new();
    let cases: Vec<(Change, &[&str])> = vec![
        (|d| d["frames"] = json!([]), &["`frames`", "one or more"]),
        (|d| d["frames"] = json!("x"), &["`frames`", "found \"x\""]),
        (|d| *d = json!([1, 2]), &["whole file", "found [1, 2]"]),
        (|d| d["frames"][1] = json!(7), &["frame 1", "found 7"]),
        (|d| d["frames"].as_array_mut().unwrap().truncate(1), &["at least 2 input views", "found 1"]),
        (|d| d["frames"][1]["file_path"] = json!(3), &["frame 1", "`file_path`", "found 3"]),
        (|d| d["frames"][1]["file_path"] = json!(""), &["frame 1", "`file_path`"]),
        (|d| d["frames"][1]["file_path"] = json!(".."), &["frame 1", "`file_path`"]),
        (|d| d["frames"][1]["file_path"] = json!("a\0b"), &["frame 1", "no image"]),
        (|d| d["frames"][3]["file_path"] = json!("images/000.png"), &["frame 3", "`images_000`", "frame 0"]),
        (|d| d["camera_angle_x"] = json!(0.0), &["`camera_angle_x`", "radians", "found 0.0"]),
        (|d| d["camera_angle_x"] = json!(49.1), &["`camera_angle_x`", "radians", "found 49.1"]),
        (|d| d["camera_angle_x"] = json!(3.13), &["`fl_x`", "focal length"]),
        (|d| d["camera_angle_x"] = json!("0.8"), &["`camera_angle_x`", "finite number", "found \"0.8\""]),
        (|d| d["camera_angle_x"] = Value::Null, &["`fl_x` or `camera_angle_x`", "neither"]),
        (|d| d["fl_x"] = json!(0.0), &["`fl_x`", "positive", "found 0.0"]),
        (|d| d["fl_x"] = json!(-5), &["`fl_x`", "positive"]),
        (|d| d["cx"] = json!(1e5), &["`cx`", "found 100000"]),
        (|d| (d["w"], d["h"]) = (json!(0), json!(0)), &["`w`", "found 0"]),
        (|d| (d["w"], d["h"]) = (json!(1e12), json!(5)), &["`w`", "16384"]),
        (|d| (d["w"], d["h"]) = (json!(32.5), json!(32)), &["`w`", "whole number"]),
        (|d| d["frames"][2]["transform_matrix"] = Value::Null, &["frame 2", "`transform_matrix`"]),
        (|d| d["frames"][2]["transform_matrix"] = json!([[1, 0], [0, 1]]), &["frame 2", "3 or 4 rows"]),
        (|d| d["frames"][2]["transform_matrix"][1][1] = json!("NaN"), &["frame 2", "finite numbers", "\"NaN\""]),
        (|d| d["frames"][2]["transform_matrix"][1].as_array_mut().unwrap().truncate(2), &["frame 2", "rows of 4"]),
        (|d| d["frames"][2]["transform_matrix"][3][3] = json!(2), &["frame 2", "last row"]),
        (|d| d["frames"][2]["transform_matrix"][0][3] = json!(1e300), &["frame 2", "farther"]),
        (|d| d["camera_model"] = json!("THIN_PRISM_FISHEYE"), &["frame 0", "THIN_PRISM_FISHEYE", "not supported"]),
        (|d| d["camera_model"] = json!(3), &["`camera_model` 3"]),
        (|d| d["is_fisheye"] = json!(1), &["`is_fisheye`", "true or false"]),
        (|d| d["k5"] = json!(0.1), &["`k5`", "not supported"]),
        (|d| d["distortion_params"] = json!([0.1, 0, 0, 0]), &["distortion_params"]),
        (|d| (d["camera_model"], d["k1"]) = (json!("PINHOLE"), json!(0.1)), &["`camera_model`", "OPENCV"]),
        (|d| d["k1"] = json!(-40.0), &["frame 0", "one to one", "folds"]),
        (|d| d["k1"] = json!(1e200), &["`k1`"]),
        (|d| d["frames"][1]["mask_path"] = json!("m.png"), &["frame 1", "mask_path", "alpha channel"]),
        (|d| d["train_filenames"] = json!(["./images/000"]), &["at least 2 input views", "found 1"]),
        (|d| d["train_filenames"] = json!(["x.png"]), &["`train_filenames`", "none of them"]),
        (|d| d["train_filenames"] = json!(1), &["`train_filenames`", "found 1"]),
        (|d| d["val_filenames"] = json!("x"), &["`val_filenames`", "found \"x\""]),
    ];
    for (i, (change, words)) in cases.into_iter().enumerate() {
        let mut d = description();
        change(&mut d);
        println!("case {i}");
        assert_says(&files.refusal(&d), words);
    }
}

#[test]
fn descriptions_of_other_systems_are_read() {
    let files = Files::new();
    // Windows' separators, capitals, and another extension than was written.
    let mut d = description();
    d["frames"][0]["file_path"] = json!("images\\000");
    d["frames"][1]["file_path"] = json!(".\\images\\001.PNG");
    d["frames"][2]["file_path"] = json!("images//002.jpg");
    d["train_filenames"] = json!(["images/000", ".\\images\\001.PNG", "./images/002.jpg"]);
    let scene = files.load(&d).unwrap();
    assert_eq!((scene.inputs.len(), scene.further.len()), (3, 1));
    // Lists of all but the inputs, by either name.
    d.as_object_mut().unwrap().remove("train_filenames");
    for list in ["val_filenames", "test_filenames"] {
        let mut d = d.clone();
        d[list] = json!(["images/001.PNG", "./images/003"]);
        let scene = files.load(&d).unwrap();
        let names: Vec<&str> = scene.further.iter().map(|v| v.name.as_str()).collect();
        assert_eq!((scene.inputs.len(), names), (2, vec!["001", "003"]));
        assert!(scene.notes.iter().any(|n| n.contains("only compared with")), "{:?}", scene.notes);
    }
    // A list that has more than the file; a mark of the byte order before it all.
    d["train_filenames"] = json!(["images/000", "images/001.PNG", "gone.png"]);
    assert!(files.load(&d).unwrap().notes.iter().any(|n| n.contains("gone.png")));
    let path = files.0.path().join("transforms.json");
    std::fs::write(&path, [b"\xef\xbb\xbf".as_slice(), description().to_string().as_bytes()].concat()).unwrap();
    assert_eq!(Scene::load(&path).unwrap().inputs.len(), 4);
    // One name in two folders.
    let mut d = description();
    std::fs::create_dir(files.0.path().join("left")).unwrap();
    std::fs::copy(files.0.path().join("images/001.png"), files.0.path().join("left/000.png")).unwrap();
    d["frames"][1]["file_path"] = json!("left/000.png");
    let names: Vec<String> = files.load(&d).unwrap().inputs.iter().map(|v| v.name.clone()).collect();
    assert_eq!(names[..2], ["images_000", "left_000"]);
    // A frame's own field of view counts for more than the file's focal length.
    let mut d = description();
    d.as_object_mut().unwrap().remove("camera_angle_x");
    d["fl_x"] = json!(40.0);
    d["frames"][1]["camera_angle_x"] = json!(0.8);
    let focal: Vec<f64> = files.load(&d).unwrap().inputs.iter().map(|v| v.camera.fx).collect();
    assert_eq!(focal[0], 40.0);
    assert!((focal[1] - 16.0 / 0.4f64.tan()).abs() < 1e-9);
    // An image that cannot be decoded is named with what to do.
    std::fs::rename(files.0.path().join("images/003.png"), files.0.path().join("images/003.HEIC")).unwrap();
    assert_says(&files.refusal(&description()), &["frame 3", "HEIC image", "003.HEIC", "convert it to JPEG"]);
}

#[test]
fn a_rim_of_nothing_is_no_backdrop() {
    let (w, h) = (120, 90);
    // A red disc before white, in a picture whose border is empty or black, all along or at the corners only.
    let disc = |x: i32, y: i32| (x - 60).pow(2) + (y - 45).pow(2) < 400;
    for (rim, empty) in [(0, true), (6, true), (0, false), (6, false)] {
        let hidden = |x: i32, y: i32| {
            let corner = (x - 60).abs() as f64 / 60.0 + (y - 45).abs() as f64 / 45.0 > 1.8;
            corner || x < rim || y < rim || x >= w - rim || y >= h - rim
        };
        let image = RgbaImage::from_fn(w as u32, h as u32, |x, y| match (x as i32, y as i32) {
            (x, y) if hidden(x, y) => Rgba([0, 0, 0, if empty { 0 } else { 255 }]),
            (x, y) if disc(x, y) => Rgba([200, 20, 10, 255]),
            _ => Rgba([250, 250, 248, 255]),
        });
        let (cut, color) = freerange_scene::camera::scene::cut_out(&image).unwrap();
        assert_eq!(color, [250, 250, 248]);
        let wrong = cut.enumerate_pixels().filter(|(x, y, p)| (p[3] > 128) != disc(*x as i32, *y as i32)).count();
        assert!(wrong < 20, "{wrong} pixels, rim {rim}, empty {empty}");
    }
    // A pale object before black is none of this.
    let image = RgbaImage::from_fn(w as u32, h as u32, |x, y| match disc(x as i32, y as i32) {
        true => Rgba([240, 240, 240, 255]),
        false => Rgba([3, 2, 4, 255]),
    });
    let (cut, color) = freerange_scene::camera::scene::cut_out(&image).unwrap();
    assert!(color[0] < 8 && cut.pixels().filter(|p| p[3] > 128).count() > 1000);
}

#[test]
fn transforms_that_are_not_rigid_are_refused() {
    let files = Files::new();
    let changed = |edit: &dyn Fn(usize, usize, f64) -> f64| {
        let mut d = description();
        for i in 0..3 {
            for j in 0..3 {
                let v = d["frames"][1]["transform_matrix"][i][j].as_f64().unwrap();
                d["frames"][1]["transform_matrix"][i][j] = json!(edit(i, j, v));
            }
        }
        files.refusal(&d)
    };
    assert_says(&changed(&|_, _, v| 2.5 * v), &["frame 1", "uniform scale of 2.5"]);
    assert_says(&changed(&|_, j, v| if j == 0 { -v } else { v }), &["frame 1", "mirrored"]);
    assert_says(&changed(&|_, j, v| if j == 0 { 1.1 * v } else { v }), &["frame 1", "shear or unequal scale"]);
    assert_says(&changed(&|_, _, _| 0.0), &["frame 1", "zero matrix"]);

    // Rounded files load, and their rotations are cleaned.
    let mut d = description();
    for frame in d["frames"].as_array_mut().unwrap() {
        for v in frame["transform_matrix"].as_array_mut().unwrap().iter_mut().flat_map(|r| r.as_array_mut().unwrap()) {
            *v = json!((v.as_f64().unwrap() * 1e4).round() / 1e4);
        }
    }
    for view in files.load(&d).unwrap().inputs {
        let r = glam::DMat3::from_mat4(view.camera.world_to_camera);
        let error = r.transpose() * r - glam::DMat3::IDENTITY;
        assert!(error.to_cols_array().iter().all(|v| v.abs() < 1e-13));
    }
}

#[test]
fn cameras_at_one_point_are_refused() {
    let files = Files::new();
    let mut d = description();
    for i in 0..4 {
        for row in 0..3 {
            d["frames"][i]["transform_matrix"][row][3] = json!(0.5);
        }
    }
    assert_says(&files.refusal(&d), &["all 4 cameras stand at one point"]);
}

#[test]
fn files_that_are_no_description_are_refused() {
    let files = Files::new();
    let load = |text: &[u8]| {
        std::fs::write(files.path("transforms.json"), text).unwrap();
        message(Scene::load(files.0.path()).unwrap_err())
    };
    assert_says(&load(b"{"), &["not valid JSON", "EOF"]);
    assert_says(&load(b""), &["not valid JSON"]);
    assert_says(&load(b"\xff\xfe\x00"), &["not valid JSON"]);
    assert_says(&load(br#"{"camera_angle_x": NaN, "frames": []}"#), &["not valid JSON", "finite"]);
    assert_says(&load(br#"{"camera_angle_x": 1e999, "frames": []}"#), &["not valid JSON", "out of range"]);
    assert_says(&load("[".repeat(100_000).as_bytes()), &["not valid JSON", "recursion"]);
    assert_says(&load(&vec![b' '; (16 << 20) + 1]), &["at most 16777216 bytes"]);

    let empty = tempfile::tempdir().unwrap();
    let at = |path: &Path| message(Scene::load(path).unwrap_err());
    assert_says(&at(empty.path()), &["transforms_train.json", "no .json file"]);
    std::fs::write(empty.path().join("transforms_full.json"), "{}").unwrap();
    assert_says(&at(empty.path()), &["transforms_full.json (a file can be named"]);
    assert_says(&at(&empty.path().join("none")), &["cannot read"]);
}

/// What a lens does to a smooth pattern is undone, wherever the lens saw it.
#[test]
fn distortion_is_removed() {
    const W: u32 = 96;
    const H: u32 = 80;
    let camera = Camera { cx: 50.0, cy: 38.0, fy: 90.0, ..Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, 1.0, W, H) };
    let lens = freerange_scene::camera::Lens::brown([0.12, -0.05, 0.01, 0.004], [0.01, -0.02]);
    let pattern = |x: f64, y: f64, c: usize| 128.0 + 90.0 * (6.0 * x + 0.5 * c as f64).sin() * (5.0 * y + 1.0).cos();
    let ideal =
        |j: u32, i: u32| ((f64::from(j) + 0.5 - camera.cx) / camera.fx, (f64::from(i) + 0.5 - camera.cy) / camera.fy);
    // What the lens shows at a pixel lies where the fixed-point iteration for the inverse ends.
    let taken = RgbaImage::from_fn(W, H, |j, i| {
        let target = ideal(j, i);
        let (mut x, mut y) = target;
        for _ in 0..60 {
            let (dx, dy) = lens.apply(x, y);
            (x, y) = (x + target.0 - dx, y + target.1 - dy);
        }
        Rgba([pattern(x, y, 0) as u8, pattern(x, y, 1) as u8, pattern(x, y, 2) as u8, 255])
    });
    let (mut worst, mut moved, mut seen) = (0.0f64, 0.0f64, 0);
    for (j, i, p) in lens.undistort(&taken, &camera).enumerate_pixels() {
        let (x, y) = ideal(j, i);
        if p[3] == 255 {
            seen += 1;
            for c in 0..3 {
                worst = worst.max((f64::from(p[c]) - pattern(x, y, c)).abs());
                moved = moved.max((f64::from(taken.get_pixel(j, i)[c]) - pattern(x, y, c)).abs());
            }
        }
    }
    assert!(worst < 4.0 && moved > 15.0, "off by {worst} (before: {moved})");
    assert!(seen > W * H * 8 / 10);

    // Without distortion nothing changes; a scene with it says what was done.
    assert_eq!(freerange_scene::camera::Lens::default().undistort(&taken, &camera), taken);
    let files = Files::new();
    let mut d = description();
    (d["camera_model"], d["k1"], d["p1"]) = (json!("OPENCV"), json!(0.1), json!(0.01));
    let scene = files.load(&d).unwrap();
    assert_says(&scene.notes[0], &["distortion was removed from 4 images"]);
    assert_ne!(scene.inputs[0].image, cut_out_image());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    /// Whatever a file holds, loading ends with a scene or an error.
    #[test]
    fn damaged_descriptions_never_panic(at in 0usize..2500, byte in any::<u8>(), cut in 0usize..4000) {
        let files = Files::new();
        let mut text = description().to_string().into_bytes();
        let n = text.len();
        text[at % n] = byte;
        text.truncate(cut.max(1));
        std::fs::write(files.path("transforms.json"), &text).unwrap();
        match Scene::load(files.0.path()) {
            Ok(scene) => prop_assert!(scene.inputs.len() >= 2),
            Err(error) => prop_assert!(!error.to_string().is_empty()),
        }
    }

    #[test]
    fn damaged_images_never_panic(at in 0usize..400, byte in any::<u8>()) {
        let files = Files::new();
        let path = files.path("images/001.png");
        let mut bytes = std::fs::read(&path).unwrap();
        let n = bytes.len();
        bytes[at % n] = byte;
        std::fs::write(&path, &bytes).unwrap();
        if let Err(error) = files.load(&description()) {
            prop_assert!(error.to_string().contains("frame 1"), "{}", error);
        }
    }
}

#[test]
fn written_cameras_are_read_back() {
    let folder = tempfile::tempdir().unwrap();
    let camera = |i: usize| {
        let c = Camera::look_at(eye(i), DVec3::new(0.1, 0.0, -0.1), DVec3::Z, 0.7 + 0.1 * i as f64, 40, 30);
        Camera { cx: 18.5, cy: 16.25, fy: c.fx * 1.1, ..c }
    };
    let frames: Vec<(String, Camera)> = (0..3).map(|i| (format!("images/{i:03}.png"), camera(i))).collect();
    let path = folder.path().join("transforms.json");
    std::fs::write(&path, transforms_json(&frames)).unwrap();
    let found = load_cameras(&path).unwrap();
    assert_eq!(found.len(), 3);
    for ((name, found), (path, expected)) in found.iter().zip(&frames) {
        assert!(path.contains(name.as_str()), "{name}");
        let numbers = |c: &Camera| [c.fx, c.fy, c.cx, c.cy];
        for (a, b) in numbers(found).iter().zip(numbers(expected)) {
            assert!((a - b).abs() < 1e-9, "{a} {b}");
        }
        assert_eq!((found.width, found.height), (40, 30));
        assert!(found.world_to_camera.abs_diff_eq(expected.world_to_camera, 1e-9));
    }
}
