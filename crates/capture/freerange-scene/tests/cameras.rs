//! Readers of cameras against files and numbers of other programs (`tools/camera_vectors.py`, `opf_vectors.py`, `nerfstudio_vectors.py`), and
//! against broken files.

use freerange_scene::camera::{Camera, Lens};
use freerange_scene::{
    Note, NoteKind, SceneError,
    read::{Format, Intrinsics, Photo, Turntable, cameras, colmap, metashape, opf, polycam, realitycapture},
};
use glam::{DMat3, DVec2, DVec3};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

fn golden(name: &str) -> PathBuf {
    freerange_vectors::path("cameras").join(name)
}

fn expected() -> Value {
    freerange_vectors::json("cameras/expected.json")
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect()
}

/// A folder with COLMAP's files of `model` (with this extension) and black images.
fn colmap_scene(model: &str, extension: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let sparse = folder.path().join("sparse/0");
    std::fs::create_dir_all(&sparse).unwrap();
    std::fs::create_dir(folder.path().join("images")).unwrap();
    for stem in ["cameras", "images"] {
        let name = format!("{stem}.{extension}");
        std::fs::copy(golden(model).join(&name), sparse.join(&name)).unwrap();
    }
    for i in 0..3 {
        let image = folder.path().join(format!("images/camera000001_frame{i:06}.png"));
        image::RgbImage::new(640, 480).save(image).unwrap();
    }
    folder
}

/// Where a point in the camera's own axes appears, in pixels.
fn shown(camera: &Camera, lens: &Lens, point: DVec3) -> Option<DVec2> {
    let p = lens.project(point)?;
    Some(DVec2::new(p.x * camera.fx + camera.cx, p.y * camera.fy + camera.cy))
}

fn message(error: &SceneError) -> String {
    let mut text = error.to_string();
    let mut cause = std::error::Error::source(error);
    while let Some(c) = cause {
        text += &format!(": {c}");
        cause = c.source();
    }
    text
}

#[track_caller]
fn says<T>(result: Result<T, SceneError>, words: &[&str]) {
    let text = message(&result.err().expect("an error"));
    words.iter().for_each(|w| assert!(text.contains(w), "expected {w:?} in: {text}"));
}

#[test]
fn colmap_models_project_as_pycolmap_does() {
    let expected = expected();
    let models = expected["models"].as_object().unwrap();
    assert_eq!(models.len(), 18);
    for (model, truth) in models {
        for extension in ["bin", "txt"] {
            let folder = colmap_scene(model, extension);
            let found = cameras(folder.path(), None, None).unwrap();
            assert_eq!((found.format, found.photos.len()), (Format::Colmap, 3));
            for photo in &found.photos {
                let Intrinsics::Pixels(camera) = photo.intrinsics else { panic!("sizes are known") };
                assert_eq!((camera.width, camera.height), (640, 480));
                let pixels = truth["images"][&photo.name].as_array().unwrap();
                for (point, pixel) in truth["points"].as_array().unwrap().iter().zip(pixels) {
                    let point = DVec3::from_slice(&numbers(point));
                    let ours = shown(&camera, &photo.lens, camera.world_to_camera.transform_point3(point)).unwrap();
                    let theirs = DVec2::from_slice(&numbers(pixel));
                    assert!(ours.distance(theirs) < 1e-7, "{model}.{extension}: {ours} {theirs}");
                }
            }
        }
    }
}

#[test]
fn lenses_show_rays_where_pycolmap_does_and_lead_back() {
    let expected = expected();
    assert_eq!(expected["pycolmap"], "4.2.1");
    for (model, rays) in expected["rays"].as_object().unwrap() {
        let photo = cameras(colmap_scene(model, "bin").path(), None, None).unwrap().photos.remove(0);
        let camera = photo.camera((640, 480)).unwrap();
        let mut compared = 0;
        for pair in rays.as_array().unwrap() {
            let ray = DVec3::from_slice(&numbers(&pair[0]));
            let ours = shown(&camera, &photo.lens, ray);
            // COLMAP's projections but that of all around show nothing from a right angle on.
            if pair[1].is_null() {
                assert!(ray.z < 0.0, "{model}: {ray}");
                continue;
            }
            let (ours, theirs) = (ours.unwrap(), DVec2::from_slice(&numbers(&pair[1])));
            assert!(ours.distance(theirs) < 1e-7, "{model}: {ray} at {ours}, not {theirs}");
            let back = photo.lens.ray((theirs.x - camera.cx) / camera.fx, (theirs.y - camera.cy) / camera.fy);
            let back = back.unwrap_or_else(|| panic!("{model}: no ray at {theirs}, expected {ray}"));
            assert!(back.distance(ray) < 1e-8, "{model}: {ray} comes back as {back}");
            compared += 1;
        }
        assert!(compared >= 20, "{model}: {compared}");
    }
}

#[test]
fn rigs_are_read_and_compared_with_images() {
    let expected = expected();
    for extension in ["bin", "txt"] {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::create_dir_all(at("images")).unwrap();
        for name in ["cameras", "images", "rigs", "frames"] {
            let name = format!("{name}.{extension}");
            std::fs::copy(golden("rig").join(&name), at(&name)).unwrap();
        }
        let centers = expected["rig"].as_object().unwrap();
        for name in centers.keys() {
            image::RgbImage::new(640, 480).save(at("images").join(name)).unwrap();
        }
        let found = cameras(folder.path(), None, None).unwrap();
        assert_eq!((found.photos.len(), found.notes.len()), (4, 0), "{:?}", found.notes);
        for photo in &found.photos {
            let center = photo.camera((640, 480)).unwrap().center();
            assert!(center.distance(DVec3::from_slice(&numbers(&centers[&photo.name]))) < 1e-9);
        }
        // Frames that a script has moved, and broken ones.
        let mut frames = std::fs::read(at(&format!("frames.{extension}"))).unwrap();
        match extension {
            "bin" => {
                let z = 8 + 8 + 48;
                frames[z..z + 8].copy_from_slice(&15f64.to_le_bytes());
            }
            _ => frames = String::from_utf8(frames).unwrap().replacen(" 0 5 2 ", " 0 15 2 ", 1).into_bytes(),
        }
        std::fs::write(at(&format!("frames.{extension}")), &frames).unwrap();
        let notes = cameras(folder.path(), None, None).unwrap().notes;
        assert!(notes.iter().any(|n| n.kind == NoteKind::Warning && n.contains("2 of 4 images")), "{notes:?}");
        std::fs::write(at(&format!("frames.{extension}")), &frames[..frames.len() - 9]).unwrap();
        says(cameras(folder.path(), None, None), &[&format!("frames.{extension}")]);
    }
}

#[test]
fn lenses_agree_with_opencv_and_can_be_inverted() {
    let truth = &expected()["lenses"];
    let b = numbers(&truth["brown"]);
    let brown = Lens::Brown { k: [b[0], b[1], b[4], 0.0], d: [b[5], b[6], b[7]], p: [b[2], b[3]] };
    let fisheye = Lens::Fisheye { k: numbers(&truth["fisheye"]).try_into().unwrap() };
    let points: Vec<Vec<f64>> = truth["points"].as_array().unwrap().iter().map(numbers).collect();
    for (lens, shown) in [(brown, "brown_shown"), (fisheye, "fisheye_shown")] {
        for (p, shown) in points.iter().zip(truth[shown].as_array().unwrap()) {
            let (ours, theirs) = (lens.apply(p[0], p[1]), numbers(shown));
            assert!((ours.0 - theirs[0]).hypot(ours.1 - theirs[1]) < 1e-9, "{lens:?}");
            let (x, y) = lens.invert(ours.0, ours.1).unwrap();
            assert!((x - p[0]).hypot(y - p[1]) < 1e-9, "{lens:?}");
        }
    }
    // Beyond the fold, and behind a fisheye, there is nothing.
    assert_eq!(Lens::brown([-0.3, 0.0, 0.0, 0.0], [0.0; 2]).invert(0.9, 0.0), None);
    assert_eq!(Lens::Fisheye { k: [0.0; 4] }.invert(1.6, 0.0), None);
}

#[test]
fn a_file_that_is_none_of_cameras_is_named() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["notes.txt", "camera.bin"] {
        let path = folder.path().join(name);
        std::fs::write(&path, "bread and milk").unwrap();
        says(cameras(&path, None, None), &[name, "a folder"]);
    }
}

#[test]
fn broken_colmap_files_are_refused() {
    let file = Path::new("x.bin");
    let read = |name: &str| std::fs::read(golden("OPENCV").join(name)).unwrap();
    let (camera, image) = (read("cameras.bin"), read("images.bin"));
    // Every beginning of a file is an error, never a panic.
    for n in 0..camera.len() {
        says(colmap::cameras_binary(file, &camera[..n]), &["x.bin", "more bytes"]);
    }
    for n in 0..image.len() {
        assert!(colmap::images_binary(file, &image[..n]).is_err());
    }
    let change = |bytes: &[u8], at: usize, with: &[u8]| {
        let mut bytes = bytes.to_vec();
        bytes[at..at + with.len()].copy_from_slice(with);
        bytes
    };
    let huge = u64::MAX.to_le_bytes();
    // Counts that the file does not hold cost nothing.
    says(colmap::cameras_binary(file, &change(&camera, 0, &huge)), &["camera 1", "found 0"]);
    says(colmap::images_binary(file, &change(&image, 0, &huge)), &["image 3", "found 0"]);
    says(colmap::cameras_binary(file, &change(&camera, 12, &[99])), &["camera 0", "`model`", "99"]);
    says(colmap::cameras_binary(file, &change(&camera, 64, &1e9f64.to_le_bytes())), &["camera 0", "-100 and 100"]);
    says(colmap::cameras_binary(file, &[camera.clone(), vec![0]].concat()), &["1 bytes after"]);
    says(colmap::images_binary(file, &change(&image, 12, &7f64.to_le_bytes())), &["image 0", "unit quaternion"]);
    let name_end = image.iter().position(|b| *b == b'c').unwrap() + b"camera000001_frame000000.png".len();
    says(colmap::images_binary(file, &change(&image, name_end + 1, &huge)), &["image 0", "keypoints"]);

    let text = |bad: &str| colmap::cameras_text(Path::new("c.txt"), bad.as_bytes());
    says(text("1 PINHOLE 640 480 500 500 320"), &["line 1", "4 numbers for PINHOLE", "found 3"]);
    says(text("#\n\n1 PINHOLE 640 wide 500 500 320 240"), &["line 3", "`HEIGHT`", "wide"]);
    says(text("1 PINHALE 640 480 500"), &["`model`", "PINHALE"]);
    says(text("1 FOV 640 480 500 500 320 240 4"), &["line 1", "`omega`", "0 to pi", "4"]);
    says(text("1 EUCM 640 480 500 500 320 240 0.5 -1"), &["line 1", "`alpha, beta`"]);
    says(text("1 EUCM 640 480 500 500 320 240 0.5 nan"), &["line 1", "`distortion`"]);
    says(text("1 PINHOLE 640 480 500 500 320 240\n1 PINHOLE 640 480 500 500 320 240"), &["line 2", "CAMERA_ID"]);
    says(colmap::cameras_text(file, b"\xff\xfe"), &["not UTF-8"]);
    let text = |bad: &str| colmap::images_text(Path::new("i.txt"), bad.as_bytes());
    says(text("1 1 0 0 0 0 0 0"), &["line 1", "`CAMERA_ID`", "nothing"]);
    says(text("1 1 0 0 0 0 0 0 1"), &["`NAME`"]);
    assert_eq!(text("1 1 0 0 0 0 0 0 1 a b.png\n\n2 1 0 0 0 0 0 0 1 c.png\n").unwrap()[0].name, "a b.png");

    let scene = colmap_scene("PINHOLE", "txt");
    let sparse = scene.path().join("sparse/0");
    let good = std::fs::read_to_string(sparse.join("cameras.txt")).unwrap();
    for (from, to, words) in [
        ("640 480", "0 480", vec!["`width`", "16384", "found 0"]),
        ("640 480", "640 99999", vec!["`height`"]),
        (" 500 ", " -500 ", vec!["`focal length`", "camera 1"]),
        ("321.5", "99999", vec!["`cx`"]),
        ("\n1 PINHOLE", "\n2 PINHOLE", vec!["`CAMERA_ID`", "images.txt"]),
    ] {
        assert!(good.contains(from));
        std::fs::write(sparse.join("cameras.txt"), good.replace(from, to)).unwrap();
        says(cameras(scene.path(), None, None), &words);
    }
    std::fs::write(sparse.join("cameras.txt"), &good).unwrap();
    std::fs::remove_file(scene.path().join("images/camera000001_frame000001.png")).unwrap();
    let fewer = cameras(scene.path(), None, None).unwrap();
    assert_eq!(fewer.photos.len(), 2);
    let told = |n: &Note| n.kind == NoteKind::Warning && n.contains("1 of 3") && n.contains("frame000001.png");
    assert!(fewer.notes.iter().any(told), "{:?}", fewer.notes);
    // Names never lead out of the folder.
    let images = std::fs::read_to_string(sparse.join("images.txt")).unwrap();
    std::fs::write(scene.path().join("outside.png"), b"").unwrap();
    std::fs::write(sparse.join("images.txt"), images.replace("camera000001_frame000001.png", "../../x.png")).unwrap();
    assert!(cameras(scene.path(), None, None).unwrap().notes.iter().any(|n| n.contains("../../x.png")));
    // None at all.
    std::fs::remove_dir_all(scene.path().join("images")).unwrap();
    says(cameras(scene.path(), None, None), &["none of its images", "images.txt", "looked in"]);
}

#[test]
fn what_a_folder_is_is_found_out_and_said() {
    let scene = colmap_scene("PINHOLE", "bin");
    let at = |name: &str| scene.path().join(name);
    // The model's own folder, or one of its files, will do.
    for path in [at("sparse"), at("sparse/0"), at("sparse/0/cameras.bin")] {
        assert_eq!(cameras(&path, None, None).unwrap().photos.len(), 3, "{}", path.display());
    }
    // Text beside binary: binary, and that is said.
    for name in ["cameras.txt", "images.txt"] {
        std::fs::copy(golden("PINHOLE").join(name), at("sparse/0").join(name)).unwrap();
    }
    assert!(cameras(scene.path(), None, None).unwrap().notes[0].contains("binary"));
    // Two formats: an error that names both and the option.
    let frames: Vec<Value> = (0..3)
        .map(|i| {
            let x = f64::from(i);
            let matrix = json!([[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]);
            json!({"file_path": format!("images/camera000001_frame{i:06}.png"), "transform_matrix": matrix})
        })
        .collect();
    std::fs::write(at("transforms.json"), json!({"camera_angle_x": 0.8, "frames": frames}).to_string()).unwrap();
    let words = ["transforms", "colmap", "sparse/0", "--cameras transforms", "--cameras colmap"];
    says(cameras(scene.path(), None, None), &words);
    assert_eq!(cameras(scene.path(), Some(Format::Colmap), None).unwrap().format, Format::Colmap);
    let json = cameras(scene.path(), Some(Format::Transforms), None).unwrap();
    assert_eq!((json.format, json.photos.len()), (Format::Transforms, 3));
    // Two groups of photos.
    std::fs::remove_file(at("transforms.json")).unwrap();
    std::fs::create_dir(at("sparse/1")).unwrap();
    for name in ["cameras.txt", "images.txt"] {
        std::fs::copy(golden("PINHOLE").join(name), at("sparse/1").join(name)).unwrap();
    }
    says(cameras(scene.path(), None, None), &["sparse/0", "sparse/1", "name one of these folders"]);
    says(cameras(scene.path(), Some(Format::Polycam), None), &["--cameras", "polycam"]);
    says(cameras(&at("images"), None, None), &["expected cameras", "frame000000.png", "--turntable"]);
    says(cameras(&at("nowhere"), None, None), &["nowhere"]);
    let turntable: Turntable = "20,60".parse().unwrap();
    let turned = cameras(scene.path(), None, Some(&turntable)).unwrap();
    assert_eq!(turned.photos.len(), 3);
    let camera = turned.photos[1].camera((640, 480)).unwrap();
    assert!((camera.fx - 320.0 / 30f64.to_radians().tan()).abs() < 1e-9);
    let center = camera.center();
    let (azimuth, elevation) =
        (center.y.atan2(center.x).to_degrees(), (center.z / center.length()).asin().to_degrees());
    assert!((azimuth + 120.0).abs() < 1e-9 && (elevation - 20.0).abs() < 1e-9);
}

/// A camera in no special position: its axes in the world (right, down, forward), and its center.
fn odd_pose() -> (DMat3, DVec3) {
    let camera = Camera::look_at(DVec3::new(1.0, -2.0, 1.5), DVec3::new(0.1, 0.2, 0.3), DVec3::Z, 0.8, 640, 480);
    (DMat3::from_mat4(camera.world_to_camera).transpose(), camera.center())
}

#[test]
fn polycam_is_read_as_nerfstudio_reads_it() {
    // nerfstudio's matrix is camera to world with OpenGL's axes, rows 2, 0, 1 of Polycam's.
    let (axes, center) = odd_pose();
    let gl = [axes.x_axis, -axes.y_axis, -axes.z_axis, center];
    let mut root = json!({"fx": 500.0, "fy": 501.0, "cx": 320.0, "cy": 239.0, "width": 640, "height": 480});
    for (ours, theirs) in [(0, 2), (1, 0), (2, 1)] {
        for (j, column) in gl.iter().enumerate() {
            root[format!("t_{theirs}{j}")] = json!(column[ours]);
        }
    }
    let file = Path::new("1.json");
    let camera = polycam::camera(file, root.to_string().as_bytes(), None).unwrap();
    assert!(camera.center().distance(center) < 1e-12 && (camera.fx, camera.fy, camera.cy) == (500.0, 501.0, 239.0));
    assert!(camera.ray_direction(320.0, 239.0).distance(axes.z_axis) < 1e-12);

    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join("keyframes").join(name);
    for name in ["cameras", "images", "corrected_cameras", "corrected_images"] {
        std::fs::create_dir_all(at(name)).unwrap();
    }
    std::fs::write(at("corrected_cameras/17.json"), root.to_string()).unwrap();
    image::RgbImage::new(640, 480).save(at("corrected_images/17.jpg")).unwrap();
    let found = cameras(folder.path(), None, None).unwrap();
    assert_eq!((found.format, found.photos[0].name.as_str()), (Format::Polycam, "17"));
    assert!(found.notes.iter().any(|n| n.contains("corrected")));

    let bad = |name: &str, value: Value| {
        let mut root = root.clone();
        root[name] = value;
        polycam::camera(file, root.to_string().as_bytes(), None)
    };
    says(bad("t_12", json!("a")), &["1.json", "`t_12`", "a number"]);
    says(bad("t_12", json!(7)), &["rotation"]);
    says(bad("width", json!(640.5)), &["`width`", "640.5"]);
    says(bad("fx", json!(1e-9)), &["focal length"]);
    says(bad("t_03", json!(1e10)), &["position"]);
    says(polycam::camera(file, b"[]", None), &["an object"]);
    says(polycam::camera(file, b"{", None), &["not JSON"]);
}

#[test]
fn metashape_is_read() {
    let (axes, center) = odd_pose();
    let m: Vec<String> = (0..3)
        .flat_map(|i| [axes.x_axis[i], axes.y_axis[i], axes.z_axis[i], center[i]])
        .chain([0.0, 0.0, 0.0, 1.0])
        .map(|v| format!("{v:e}"))
        .collect();
    let xml = format!(
        r#"<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="Chunk 1" enabled="true">
        <sensors next_id="2"><sensor id="0" label="unknown" type="frame"><resolution width="640" height="480"/>
        <calibration type="frame" class="initial"><resolution width="640" height="480"/><f>1</f></calibration>
        <calibration type="frame" class="adjusted"><resolution width="640" height="480"/><f>500</f><cx>1.5</cx><cy>-2</cy><b1>3</b1>
        <k1>-0.1</k1><k2>0.02</k2><p1>0.004</p1><p2>-0.003</p2></calibration></sensor></sensors>
        <cameras next_id="3"><group id="0"><camera id="0" sensor_id="0" label="a.b.png"><transform>{}</transform></camera></group>
        <camera id="1" sensor_id="0" label="unaligned"/></cameras></chunk></document>"#,
        m.join(" ")
    );
    let file = Path::new("x.xml");
    let metashape::Export { photos, notes } = metashape::parse(file, xml.as_bytes()).unwrap();
    assert_eq!((photos.len(), photos[0].label.as_str()), (1, "a.b.png"));
    assert!(notes.iter().any(|n| n.kind == NoteKind::Dropped && n.contains("1 photos have no pose")), "{notes:?}");
    let c = photos[0].camera;
    assert_eq!((c.fx, c.fy, c.cx, c.cy), (503.0, 500.0, 321.5, 238.0));
    assert!(c.center().distance(center) < 1e-9 && c.ray_direction(c.cx, c.cy).distance(axes.z_axis) < 1e-9);
    // The manual's formula, written out.
    let (x, y) = (0.3, -0.2);
    let q: f64 = x * x + y * y;
    let s = 1.0 - 0.1 * q + 0.02 * q * q;
    let shown = (
        x * s + 0.004 * (q + 2.0 * x * x) + 2.0 * -0.003 * x * y,
        y * s - 0.003 * (q + 2.0 * y * y) + 2.0 * 0.004 * x * y,
    );
    let ours = photos[0].lens.apply(x, y);
    assert!((ours.0 - shown.0).hypot(ours.1 - shown.1) < 1e-12);

    let bad = |from: &str, to: &str| {
        assert!(xml.contains(from));
        metashape::parse(file, xml.replace(from, to).as_bytes())
    };
    says(bad("<b1>3</b1>", "<b2>1</b2>"), &["x.xml", "sensor \"0\"", "`b2`", "not supported"]);
    for kind in ["fisheye", "spherical"] {
        says(bad("type=\"frame\"><res", &format!("type=\"{kind}\"><res")), &[&format!("sensor type {kind}")]);
    }
    says(bad("<f>500</f>", "<f>wide</f>"), &["`f`", "wide"]);
    says(bad("sensor_id=\"0\"", "sensor_id=\"7\""), &["camera \"a.b.png\"", "`sensor_id`", "7"]);
    says(bad("</transform>", " 1</transform>"), &["16 numbers", "17"]);
    for name in ["p3", "p4"] {
        let text = format!("<{name}>1</{name}>");
        says(bad("<b1>3</b1>", &text), &["x.xml", "sensor \"0\"", &format!("`{name}`"), "not supported"]);
    }
    says(bad("<transform>", "<transform>x"), &["camera", "`transform`"]);
    says(bad("</document>", "</documen>"), &["not XML"]);
    says(bad("<chunk label", "<chunk/><chunk label"), &["one chunk", "2"]);
    says(metashape::parse(file, b"<!DOCTYPE a [<!ENTITY b \"c\">]><a>&b;</a>"), &["not XML"]);
}

/// The same camera and lens, where the world of the first has each point of the other's at `moved`.
#[track_caller]
fn assert_same(photo: &Photo, other: &Photo, moved: impl Fn(DVec3) -> DVec3) {
    let size = image::image_dimensions(&other.image).unwrap();
    let (theirs, ours) = (photo.camera(size).unwrap(), other.camera(size).unwrap());
    let numbers = |c: &Camera| [c.fx, c.fy, c.cx, c.cy];
    for (a, b) in numbers(&theirs).into_iter().zip(numbers(&ours)) {
        assert!((a - b).abs() < 1e-9, "{}: {a} {b}", other.name);
    }
    assert_eq!(photo.lens, other.lens, "{}", other.name);
    for p in [DVec3::ZERO, DVec3::new(0.5, -0.3, 0.2), DVec3::new(-7.0, 4.0, 6.0)] {
        let (a, b) = (theirs.world_to_camera.transform_point3(moved(p)), ours.world_to_camera.transform_point3(p));
        assert!(a.distance(b) < 1e-9, "{}: {p} at {a} and {b}", other.name);
    }
}

#[test]
fn scenes_that_nerfstudio_makes_of_colmaps_are_read() {
    let expected = expected();
    let mut compared = 0;
    for entry in std::fs::read_dir(freerange_vectors::path("nerfstudio/colmap")).unwrap() {
        let file = entry.unwrap().path();
        let folder = colmap_scene(file.file_stem().unwrap().to_str().unwrap(), "bin");
        for name in expected["rig"].as_object().unwrap().keys() {
            image::RgbImage::new(640, 480).save(folder.path().join("images").join(name)).unwrap();
        }
        std::fs::copy(&file, folder.path().join("transforms.json")).unwrap();
        let read = |format: Format| cameras(folder.path(), Some(format), None).unwrap();
        let (theirs, ours) = (read(Format::Transforms), read(Format::Colmap));
        assert_eq!((theirs.photos.len(), theirs.any_up), (ours.photos.len(), true), "{}", file.display());
        for photo in &theirs.photos {
            let other = ours.photos.iter().find(|p| p.image.file_name() == photo.image.file_name()).unwrap();
            // COLMAP's axes, exchanged.
            assert_same(photo, other, |p| DVec3::new(p.x, p.z, -p.y));
            compared += 1;
        }
    }
    // Eight models of one camera, and a rig of two.
    assert_eq!(compared, 8 * 3 + 4);
}

#[test]
fn exports_become_what_nerfstudio_makes_of_them() {
    type Moved = fn(DVec3) -> DVec3;
    let cases: [(Format, Moved); 3] = [
        (Format::Realitycapture, |p| p),
        (Format::Polycam, |p| p),
        // The axes z, x, y of Metashape's world.
        (Format::Metashape, |p| DVec3::new(p.z, p.x, p.y)),
    ];
    for (format, moved) in cases {
        let place = freerange_vectors::path("nerfstudio").join(format.name());
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| {
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            path
        };
        for i in 1..=3 {
            let (w, h) = if i == 3 && format != Format::Metashape { (480, 640) } else { (640, 480) };
            let black = image::RgbImage::new(w, h);
            if format == Format::Polycam {
                black.save(at(&format!("images/frame_{i:05}.png"))).unwrap();
                black.save(at(&format!("keyframes/images/{i}.png"))).unwrap();
                let file = format!("cameras/{i}.json");
                std::fs::copy(place.join(&file), at(&format!("keyframes/{file}"))).unwrap();
            } else {
                black.save(at(&format!("images/{i}.png"))).unwrap();
            }
        }
        for name in ["transforms.json", "cameras.csv", "cameras.xml"] {
            if place.join(name).is_file() {
                std::fs::copy(place.join(name), at(name)).unwrap();
            }
        }
        let read = |format: Format| cameras(folder.path(), Some(format), None).unwrap();
        let (theirs, ours) = (read(Format::Transforms), read(format));
        assert_eq!((theirs.photos.len(), ours.photos.len()), (3, 3), "{format:?}");
        assert_eq!((theirs.any_up, ours.any_up), (format == Format::Metashape, format == Format::Metashape));
        for (photo, other) in theirs.photos.iter().zip(&ours.photos) {
            assert_same(photo, other, moved);
        }
    }
}

#[test]
fn realitycapture_is_read() {
    let csv = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n\
               a.jpg,1,2,3,0,0,0,36,0.02,-0.01,-0.1,0,0,0,0,0\n\
               b.jpg,1,2,3,90,90,0,36,0,0,0,0,0,0,0,0\n";
    let file = Path::new("x.csv");
    let rows = realitycapture::parse(file, csv.as_bytes()).unwrap();
    let look = |i: usize| {
        let Intrinsics::Relative { world_to_camera: m, focal, offset, upright: false } = rows[i].1 else {
            panic!("no sizes")
        };
        let axes = DMat3::from_mat4(m).transpose();
        (axes.z_axis, -axes.y_axis, focal, offset)
    };
    // Straight down, the top to the north.
    let (forward, up, focal, offset) = look(0);
    assert!(forward.distance(-DVec3::Z) < 1e-12 && up.distance(DVec3::Y) < 1e-12);
    assert_eq!((focal, offset, rows[0].2), (1.0, [0.02, -0.01], Lens::brown([-0.1, 0.0, 0.0, 0.0], [0.0; 2])));
    // Lifted to the horizon and turned to the east.
    let (forward, up, ..) = look(1);
    assert!(forward.distance(DVec3::X) < 1e-12 && up.distance(DVec3::Z) < 1e-12, "{forward} {up}");
    // Columns in another order, the optional ones missing.
    let few = "#name,f,roll,pitch,heading,alt,y,x\n\"a, b.jpg\",24,0,0,0,3,2,1\n";
    assert_eq!(realitycapture::parse(file, few.as_bytes()).unwrap()[0].0, "a, b.jpg");
    let bad = |from: &str, to: &str| {
        assert!(csv.contains(from));
        realitycapture::parse(file, csv.replace(from, to).as_bytes())
    };
    says(bad("heading,", ""), &["x.csv", "`heading`", "a column"]);
    says(bad("a.jpg,1", "a.jpg,one"), &["line 2", "`x`", "one"]);
    says(bad("a.jpg", ""), &["line 2", "`name`"]);
    says(bad("90,90,0,36", "90,90,0,nan"), &["line 3", "`f`"]);
    says(bad(",0.02,", ",1.02,"), &["line 2", "`px`", "1.02"]);
    // Tangential coefficients are OpenCV's; a count may come first.
    let more = format!("#cameras 2\n{}", csv.replace("0,0,0,0,0,0\n", "0,0,0,0,0.1,0.2\n"));
    let rows = realitycapture::parse(file, more.as_bytes()).unwrap();
    assert_eq!(rows[1].2, Lens::brown([0.0; 4], [0.1, 0.2]));
    let broken = more.replace("a.jpg,1", "a.jpg,one");
    says(realitycapture::parse(file, broken.as_bytes()), &["line 3", "`x`", "one"]);
    says(realitycapture::parse(file, b"#name,x,y,alt,heading,pitch,roll,f\na.jpg,1\n"), &["line 2", "`y`", "nothing"]);
}

#[test]
fn opf_is_read_as_pyopf_writes_it() {
    let place = freerange_vectors::path("opf");
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::create_dir(at("images")).unwrap();
    for name in ["project.opf", "calibrated_cameras.json", "camera_list.json"] {
        std::fs::copy(place.join(name), at(name)).unwrap();
    }
    for i in 0..3 {
        image::RgbImage::new(640, 480).save(at(&format!("images/{i}.jpg"))).unwrap();
    }
    let truth: Vec<Value> = serde_json::from_slice(&std::fs::read(place.join("expected.json")).unwrap()).unwrap();
    for path in [folder.path(), &at("project.opf")] {
        let found = cameras(path, None, None).unwrap();
        assert_eq!((found.format, found.photos.len()), (Format::Opf, 3));
        for (photo, truth) in found.photos.iter().zip(&truth) {
            let camera = photo.camera((640, 480)).unwrap();
            assert!(camera.center().distance(DVec3::from_slice(&numbers(&truth["center"]))) < 1e-12);
            let axes = DMat3::from_mat4(camera.world_to_camera).transpose();
            for (ours, theirs) in [axes.x_axis, axes.y_axis, axes.z_axis].iter().zip(truth["axes"].as_array().unwrap())
            {
                assert!(ours.distance(DVec3::from_slice(&numbers(theirs))) < 1e-12);
            }
            assert_eq!((camera.fx, camera.cx, camera.cy), (500.0, 321.5, 238.0));
            assert_eq!(photo.lens, Lens::brown([-0.08, 0.02, 0.001, 0.0], [0.003, -0.004]));
        }
    }
    let text = std::fs::read_to_string(place.join("calibrated_cameras.json")).unwrap();
    let file = Path::new("c.json");
    for (from, to, words) in [
        ("\"perspective\"", "\"spherical\"", ["sensor type spherical", "not supported"]),
        ("\"perspective\"", "\"fisheye\"", ["sensor type fisheye", "not supported"]),
        ("500.0", "-1", ["`focal_length_px`", "above 0"]),
        ("\"sensor_id\": 7", "\"sensor_id\": 8", ["`sensor_id`", "8"]),
        ("35.0", "null", ["camera 1", "`orientation_deg`"]),
        ("\"cameras\"", "\"kameras\"", ["`cameras`", "a list"]),
    ] {
        assert!(text.contains(from), "{from}");
        says(opf::calibrated(file, text.replace(from, to).as_bytes()), &words);
    }
    // Names of files are URIs: with escapes, and from another machine's root on.
    let uris = std::fs::read_to_string(at("camera_list.json")).unwrap();
    for (uri, name) in [("images/photo%20%C3%A4.jpg", "photo \u{e4}.jpg"), ("file:///D:/job/100%.jpg", "100%.jpg")] {
        assert!(uris.contains("images/0.jpg"));
        std::fs::write(at("camera_list.json"), uris.replace("images/0.jpg", uri)).unwrap();
        image::RgbImage::new(640, 480).save(at(&format!("images/{name}"))).unwrap();
        let found = cameras(folder.path(), None, None).unwrap();
        assert_eq!((found.photos.len(), found.photos[0].image.file_name().unwrap().to_str()), (3, Some(name)));
    }
    let twice = uris.replace("\"id\": 11", "\"id\": 10");
    assert_ne!(twice, uris);
    says(opf::uris(file, twice.as_bytes()), &["camera 1", "`id`", "of its own", "10"]);
    says(opf::uris(file, b"{\"cameras\": [{\"id\": 1}]}"), &["camera 0", "`uri`", "null"]);
    std::fs::write(at("camera_list.json"), &uris).unwrap();
    let project = std::fs::read_to_string(at("project.opf")).unwrap();
    says(opf::project(file, b"{\"items\": []}"), &["`application/opf-calibrated-cameras+json`", "one resource"]);
    std::fs::write(at("project.opf"), project.replace("calibrated_cameras.json", "../c.json")).unwrap();
    says(cameras(folder.path(), None, None), &["`uri`", "../c.json"]);
}
