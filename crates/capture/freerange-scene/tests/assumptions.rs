//! What no file says and is taken to be so, and what is there and not used: each is said once, with an example.

mod capture;

use capture::{
    Capture, NAMES, WHITE, assert_right, busy, camera, outline, ring, says, shot, tells, wide, wide_from, wrong,
};
use freerange_scene::camera::Lens;
use freerange_scene::{LoadConfig, Loaded, MaskKind, MaskSource, Note, NoteKind, load, read::cameras};
use glam::{DMat3, DMat4, DQuat, DVec3};
use image::{ImageEncoder, RgbaImage};
use serde_json::{Value, json};

/// The one note that has these words.
#[track_caller]
fn once(notes: &[Note], kind: NoteKind, words: &[&str]) {
    tells(notes, kind, words);
    assert_eq!(notes.iter().filter(|n| n.kind == kind && words.iter().all(|w| n.contains(w))).count(), 1, "{notes:?}");
}

fn says_nothing_of(notes: &[Note], words: &str) {
    assert!(notes.iter().all(|n| !n.contains(words)), "{notes:?}");
}

/// As pyopf 1.4.1 writes it for the project in `tests/golden/opf`; of three captures the first.
const INPUT: &str = r#"{"format": "application/opf-input-cameras+json", "version": "1.0", "captures":
[{"cameras": [{"id": 10,
"image_orientation": 1, "model_source": "generic", "pixel_range": {"max": 255.0, "min": 0.0}, "pixel_type":
"uint8", "sensor_id": 7}], "id": 20, "reference_camera_id": 10, "rig_model_source": "not_applicable", "time":
"2026-01-01T00:00:00"}], "sensors": [{"bands": [{"name": "Red", "weight": 0.3}, {"name": "Green", "weight":
0.4}, {"name": "Blue", "weight": 0.3}], "id": 7, "image_size_px": [640, 480], "internals": {"focal_length_px":
500.0, "principal_point_px": [321.5, 238.0], "radial_distortion": [-0.08, 0.02, 0.001], "tangential_distortion":
[0.003, -0.004], "type": "perspective"}, "name": "s", "pixel_size_um": 1.5, "shutter_type": "global"}]}"#;

#[test]
fn opf_photos_of_another_size_than_their_sensors_are_read() {
    let golden = freerange_vectors::path("opf");
    let project: Value = serde_json::from_slice(&std::fs::read(golden.join("project.opf")).unwrap()).unwrap();
    for (width, listed, there) in
        [(320, true, true), (640, true, true), (1280, true, true), (320, true, false), (320, false, false)]
    {
        let capture = Capture::new();
        for name in ["calibrated_cameras.json", "camera_list.json"] {
            std::fs::copy(golden.join(name), capture.at(name)).unwrap();
        }
        let mut project = project.clone();
        if listed {
            project["items"].as_array_mut().unwrap().push(json!({
                "id": "00000000-0000-0000-0000-000000000012", "type": "input_cameras", "sources": [],
                "resources": [{"format": "application/opf-input-cameras+json", "uri": "input/input_cameras.json"}]
            }));
        }
        if there {
            std::fs::write(capture.at("input/input_cameras.json"), INPUT).unwrap();
        }
        std::fs::write(capture.at("project.opf"), project.to_string()).unwrap();
        for i in 0..3 {
            image::RgbImage::new(width, 3 * width / 4).save(capture.at(&format!("images/{i}.jpg"))).unwrap();
        }
        let found = capture.read();
        let camera = found.photos[1].camera((width, 3 * width / 4)).unwrap();
        if there {
            let scale = f64::from(width) / 640.0;
            let expected = (500.0 * scale, 321.5 * scale, 238.0 * scale);
            assert_eq!((camera.fx, camera.cx, camera.cy), expected);
            assert_eq!(found.files.len(), 4);
            says_nothing_of(&found.notes, "no file says");
            // A shape that the sensor has not.
            assert!(found.photos[1].camera((400, 400)).is_err());
        } else {
            assert_eq!((camera.fx, found.files.len()), (500.0, 3));
            once(&found.notes, NoteKind::Assumed, &["no file says", "3 photos", "images/0.jpg: 320 x 240"]);
        }
        if there {
            for (from, to) in [("[640, 480]", "[640]"), ("[640, 480]", "[640, 0]"), ("\"id\": 7", "\"id\": -7")] {
                let text = INPUT.replace('\n', " ").replace("image_size_px\": [", "image_size_px\":[");
                let text = text.replace("\":[640", "\": [640");
                assert!(text.contains(from), "{from}");
                std::fs::write(capture.at("input/input_cameras.json"), text.replacen(from, to, 9)).unwrap();
                says(cameras(&capture.at("project.opf"), None, None), &["input_cameras.json", "sensor 0"]);
            }
        }
    }
}

#[test]
fn cameras_without_sizes_are_said_to_be_for_the_photos() {
    // Polycam's, as in the test of its readers.
    for sized in [false, true] {
        let capture = Capture::new();
        for (i, c) in (0..4).map(|i| (i, camera(i, 4))) {
            let axes = DMat3::from_mat4(c.world_to_camera).transpose();
            let columns = [axes.x_axis, -axes.y_axis, -axes.z_axis, c.center()];
            let mut root = json!({"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy});
            if sized {
                (root["width"], root["height"]) = (json!(c.width), json!(c.height));
            }
            for (ours, theirs) in [(0, 2), (1, 0), (2, 1)] {
                columns.iter().enumerate().for_each(|(j, c)| root[format!("t_{theirs}{j}")] = json!(c[ours]));
            }
            std::fs::write(capture.at(&format!("keyframes/cameras/{i}.json")), root.to_string()).unwrap();
            shot(&c, |_, _| WHITE).save(capture.at(&format!("keyframes/images/{i}.png"))).unwrap();
        }
        let notes = capture.read().notes;
        match sized {
            true => says_nothing_of(&notes, "no file says"),
            false => once(&notes, NoteKind::Assumed, &["no file says", "4 photos", "(0: 96 x 72)"]),
        }
    }
    // Those of transforms.json in pixels; angles are for any size.
    for pixels in [true, false] {
        let capture = Capture::new();
        for (name, c) in ring() {
            shot(&c, |_, _| WHITE).save(capture.at(name)).unwrap();
        }
        capture.describe(&ring(), json!({}));
        let file = capture.at("transforms.json");
        let mut root: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
        for frame in root["frames"].as_array_mut().unwrap() {
            let frame = frame.as_object_mut().unwrap();
            ["w", "h"].iter().for_each(|name| drop(frame.remove(*name)));
            if !pixels {
                ["fl_x", "fl_y", "cx", "cy"].iter().for_each(|name| drop(frame.remove(*name)));
                frame.insert("camera_angle_x".into(), json!(0.8));
            }
        }
        std::fs::write(file, root.to_string()).unwrap();
        let found = capture.read();
        match pixels {
            true => once(&found.notes, NoteKind::Assumed, &["no file says", "4 photos", "(a: 96 x 72)"]),
            false => says_nothing_of(&found.notes, "no file says"),
        }
        assert_right(&load(&found, &LoadConfig::default()).unwrap(), 4);
    }
}

#[test]
fn intrinsics_that_are_scaled_are_said() {
    let sizes = [(96, 72), (192, 144), (48, 36), (144, 108)];
    for scaled in [true, false] {
        let capture = Capture::new();
        for ((name, c), (w, h)) in ring().into_iter().zip(sizes) {
            let c = if scaled { c.resized(w, h) } else { c };
            shot(&c, |_, _| WHITE).save(capture.at(name)).unwrap();
        }
        capture.describe(&ring(), json!({"train_filenames": &NAMES[..3]}));
        let loaded = capture.load().unwrap();
        assert_right(&loaded, 3);
        if scaled {
            let words = ["intrinsics were scaled", "2 photos", "(b: 192 x 144 instead of 96 x 72)"];
            once(&loaded.notes, NoteKind::Assumed, &words);
            let words = ["intrinsics were scaled", "1 photos to compare with", "(d: 144 x 108"];
            once(&loaded.notes, NoteKind::Assumed, &words);
        } else {
            says_nothing_of(&loaded.notes, "scaled");
        }
    }
}

#[test]
fn masks_that_are_stretched_or_resized_are_said() {
    for (label, size) in [(7, (96, 72)), (255, (192, 144)), (1, (48, 36)), (255, (96, 72))] {
        let capture = Capture::new();
        for (i, (name, c)) in ring().iter().enumerate() {
            shot(c, busy(i)).save(capture.at(name)).unwrap();
            let mut mask = outline(&c.resized(size.0, size.1));
            mask.pixels_mut().for_each(|p| p[0] = p[0].min(label));
            mask.save(capture.at(&name.replace("images", "masks"))).unwrap();
        }
        capture.describe(&ring(), json!({}));
        let loaded = capture.load().unwrap();
        assert_eq!(loaded.masks, MaskKind::Files);
        assert!(loaded.views.iter().all(|v| wrong(v) < 0.03));
        match label {
            255 => says_nothing_of(&loaded.notes, "without white"),
            _ => {
                let words = ["masks without white", "4 photos", &format!("(a: {label})")];
                once(&loaded.notes, NoteKind::Assumed, &words);
            }
        }
        match size {
            (96, 72) => says_nothing_of(&loaded.notes, "resized"),
            (w, h) => {
                let words = ["masks of 4 photos", &format!("(a: from {w} x {h})"), "resized"];
                once(&loaded.notes, NoteKind::Changed, &words);
            }
        }
    }
}

#[test]
fn alpha_that_mask_files_stand_in_for_is_said() {
    // Beside masks that are found, and those that are given; where masks are of something else, nobody speaks of alpha.
    let capture = Capture::new();
    for (i, (name, c)) in ring().iter().enumerate() {
        let behind = |x, y| if x > 60 && i < 3 { [0; 4] } else { busy(i)(x, y) };
        shot(c, behind).save(capture.at(name)).unwrap();
        outline(c).save(capture.at(&name.replace("images", "masks"))).unwrap();
    }
    capture.describe(&ring(), json!({}));
    let given = MaskSource::Files(capture.at("masks"));
    for masks in [MaskSource::Auto, given] {
        let loaded = load(&capture.read(), &LoadConfig { masks, ..LoadConfig::default() }).unwrap();
        assert_eq!(loaded.masks, MaskKind::Files);
        once(&loaded.notes, NoteKind::Dropped, &["transparency of 3 photos (a)", "mask files"]);
        assert_right(&loaded, 4);
    }
    for (i, (name, c)) in ring().iter().enumerate() {
        shot(c, busy(i)).save(capture.at(name)).unwrap();
    }
    says_nothing_of(&capture.load().unwrap().notes, "transparency");
}

#[test]
fn color_profiles_that_are_not_used_are_said() {
    let gray = moxcms::ColorProfile::new_gray_with_gamma(1.8).encode().unwrap();
    let mut cmyk = moxcms::ColorProfile::new_srgb().encode().unwrap();
    cmyk[16..20].copy_from_slice(b"CMYK");
    let srgb = moxcms::ColorProfile::new_srgb().encode().unwrap();
    for (profile, word) in [(gray, "gray"), (cmyk, "CMYK"), (b"no profile".to_vec(), "unreadable"), (srgb, "")] {
        let capture = Capture::new();
        for (i, (name, c)) in ring().iter().enumerate() {
            let file = std::fs::File::create(capture.at(name)).unwrap();
            let mut encoder = image::codecs::png::PngEncoder::new(file);
            if i > 0 {
                encoder.set_icc_profile(profile.clone()).unwrap();
            }
            let (image, gray) = (shot(c, |_, _| WHITE), word == "gray");
            let (w, h) = image.dimensions();
            match gray {
                true => {
                    let gray = image::DynamicImage::ImageRgba8(image).into_luma8();
                    encoder.write_image(&gray, w, h, image::ExtendedColorType::L8).unwrap();
                }
                false => encoder.write_image(&image, w, h, image::ExtendedColorType::Rgba8).unwrap(),
            }
        }
        capture.describe(&ring(), json!({}));
        let loaded = capture.load().unwrap();
        assert_right(&loaded, 4);
        match word {
            "" => says_nothing_of(&loaded.notes, "profile"),
            _ => {
                let words = ["color profile of 3 photos", &format!("(b: {word})"), "taken for sRGB"];
                once(&loaded.notes, NoteKind::Dropped, &words);
            }
        }
    }
}

#[test]
fn frames_that_are_only_compared_with_are_said() {
    let capture = Capture::new();
    for (name, c) in ring() {
        shot(&c, |_, _| WHITE).save(capture.at(name)).unwrap();
    }
    capture.describe(&ring(), json!({"train_filenames": &NAMES[..2]}));
    let found = capture.read();
    once(
        &found.notes,
        NoteKind::Understood,
        &["2 frames", "not in `train_filenames`", "compared with", "images/c.png"],
    );
    capture.describe(&ring(), json!({"train_filenames": NAMES}));
    says_nothing_of(&capture.read().notes, "train_filenames");
}

/// The least share of the photos' longer side that the ball takes, of all views.
fn least_extent(loaded: &Loaded) -> f64 {
    let extent = |image: &RgbaImage| {
        let shown = image.enumerate_pixels().filter(|(.., p)| p[3] >= 128).map(|(x, ..)| x);
        let (low, high) = shown.fold((u32::MAX, 0), |(low, high), x| (low.min(x), high.max(x)));
        f64::from(high.saturating_sub(low)) / f64::from(image.width())
    };
    loaded.views.iter().map(|v| extent(&v.image)).fold(1.0, f64::min)
}

#[test]
fn wide_lenses_look_where_axes_meet_until_the_object_is_known() {
    let lens = Lens::Fisheye { k: [0.01, 0.0, 0.0, 0.0] };
    let model = ("SIMPLE_RADIAL_FISHEYE", "105 200 200 0.01");
    let away = DMat4::from_rotation_y(1.0);
    // Axes that meet in the ball and do not show it whole along them; it is seen well: so it stays.
    let axis = DVec3::new(0.548, 0.135, 0.826).normalize();
    let meets = DMat4::from_quat(DQuat::from_rotation_arc(axis, DVec3::Z));
    let capture = wide_from(model.0, model.1, lens, meets, 0.45, WHITE);
    let loaded = capture.load().unwrap();
    assert_eq!(loaded.masks, MaskKind::Plain);
    once(&loaded.notes, NoteKind::Assumed, &["4 photos of wide lenses", "where the cameras' axes meet", "--center"]);
    says_nothing_of(&loaded.notes, "looks at the object");
    assert!(loaded.views.iter().all(|v| wrong(v) < 0.02));
    // Small there, or beside it and cut off: seen again, as soon as masks show where it is.
    for turn in [away, DMat4::from_rotation_x(0.6) * away] {
        let capture = wide_from(model.0, model.1, lens, turn, 1.0, WHITE);
        let loaded = capture.load().unwrap();
        once(&loaded.notes, NoteKind::Changed, &["4 photos of wide lenses", "looks at the object"]);
        says_nothing_of(&loaded.notes, "axes meet");
        assert!(
            loaded.views.iter().all(|v| wrong(v) < 0.03),
            "{:?}",
            loaded.views.iter().map(wrong).collect::<Vec<_>>()
        );
        assert!(least_extent(&loaded) > 0.6, "{}", least_extent(&loaded));
        for view in &loaded.views {
            let (w, h) = view.image.dimensions();
            let mut border =
                view.image.enumerate_pixels().filter(|(x, y, _)| *x == 0 || *y == 0 || *x == w - 1 || *y == h - 1);
            assert!(border.all(|(.., p)| p[3] < 128), "{turn}");
        }
    }
    // Masks say it from the beginning.
    let loaded = wide(model.0, model.1, lens, 60.0, [0; 4]).load().unwrap();
    once(&loaded.notes, NoteKind::Changed, &["looks at the object"]);
}
