//! Captures as users have them: for each kind of fault that other programs' files had, files with it, and what they must come to.

mod capture;

use capture::{
    BALL, Capture, H, NAMES, W, WHITE, assert_right, busy, camera, hit, outline, ring, says, shot, tells, wide, wrong,
};
use freerange_scene::camera::{Camera, Lens, View, canonical_from_user};
use freerange_scene::{
    LoadConfig, MaskKind, MaskSource, Note, NoteKind, Scene, SceneConfig, SceneError,
    estimate::Hints,
    load,
    read::{Format, cameras},
};
use glam::{DMat3, DMat4, DQuat, DVec3};
use image::{GrayImage, ImageEncoder, Luma, Rgb, RgbImage, Rgba, RgbaImage};
use serde_json::{Value, json};
use std::{collections::HashMap, path::Path};

#[test]
fn rims_of_undistorted_photos_are_no_backdrop_and_no_object() {
    // A lens that leaves an empty rim when it is undone; for inputs and for views compared with.
    let capture = Capture::new();
    let lens = Lens::brown([0.08, 0.0, 0.0, 0.0], [0.0; 2]);
    for (i, (name, c)) in ring().iter().enumerate() {
        let image = RgbaImage::from_fn(W, H, |x, y| {
            let (u, v) = ((f64::from(x) + 0.5 - c.cx) / c.fx, (f64::from(y) + 0.5 - c.cy) / c.fy);
            let (u, v) = lens.invert(u, v).unwrap();
            Rgba(if hit(c, u * c.fx + c.cx, v * c.fy + c.cy) { [200, 30, 20, 255] } else { WHITE })
        });
        image.save(capture.at(name)).unwrap();
        assert!(i < 4);
    }
    let fields = json!({"camera_model": "OPENCV", "k1": 0.08, "train_filenames": &NAMES[..3]});
    capture.describe(&ring(), fields);
    let loaded = capture.load().unwrap();
    assert_eq!((loaded.masks, loaded.further.len()), (MaskKind::Plain, 1));
    assert_right(&loaded, 3);
    // The same rim, left by the user's own program: empty or black.
    for rim in [[0, 0, 0, 0], [0, 0, 0, 255]] {
        let capture = Capture::new();
        for (name, c) in ring() {
            let mut image = shot(&c, |_, _| WHITE);
            for (x, y, p) in image.enumerate_pixels_mut() {
                let (dx, dy) = (f64::from(x) / f64::from(W) - 0.5, f64::from(y) / f64::from(H) - 0.5);
                if dx.abs().powi(4) + dy.abs().powi(4) > 0.055 {
                    *p = Rgba(rim);
                }
            }
            image.save(capture.at(name)).unwrap();
        }
        capture.describe(&ring(), json!({"train_filenames": &NAMES[..3]}));
        let loaded = capture.load().unwrap();
        assert_eq!((loaded.masks, loaded.further.len()), (MaskKind::Plain, 1));
        assert_right(&loaded, 3);
        if rim[3] == 0 {
            tells(&loaded.notes, NoteKind::Assumed, &["rim of 3 photos (a) is what undistorting them left"]);
            tells(&loaded.notes, NoteKind::Assumed, &["rim of 1 photos to compare with (d) is what"]);
        }
    }
}

#[test]
fn transparency_that_is_no_outline_is_not_taken_for_one() {
    // One clear pixel; and a rim before a background of many colors, for which masks have to be found.
    let capture = Capture::new();
    for (name, c) in ring() {
        let mut image = shot(&c, |_, _| WHITE);
        image.put_pixel(40, 3, Rgba([252, 252, 252, 0]));
        image.save(capture.at(name)).unwrap();
    }
    capture.describe(&ring(), json!({}));
    let loaded = capture.load().unwrap();
    assert_eq!(loaded.masks, MaskKind::Plain);
    assert_right(&loaded, 4);
    let capture = Capture::new();
    for (i, (name, c)) in ring().iter().enumerate() {
        let mut image = shot(c, busy(i));
        image.enumerate_pixels_mut().filter(|(x, y, _)| *x < 2 || *y < 2).for_each(|(.., p)| p[3] = 0);
        image.save(capture.at(name)).unwrap();
    }
    capture.describe(&ring(), json!({}));
    // Not the whole photos as one object: what is found is judged, or refused.
    match capture.load() {
        Ok(loaded) => assert_eq!(loaded.masks, MaskKind::Estimate),
        Err(e) => assert!(matches!(e, SceneError::NotCutOut { .. }), "{e}"),
    }
    // Outlines stay outlines.
    let capture = Capture::new();
    for (name, c) in ring() {
        shot(&c, |_, _| [0; 4]).save(capture.at(name)).unwrap();
    }
    capture.describe(&ring(), json!({}));
    let loaded = capture.load().unwrap();
    assert_eq!(loaded.masks, MaskKind::Alpha);
    tells(&loaded.notes, NoteKind::Understood, &["masks are the alpha of 4 photos"]);
    assert_right(&loaded, 4);
}

#[test]
fn cameras_far_from_the_origin_are_moved_to_one_that_is_written_down() {
    for (place, units) in [
        (DVec3::new(320_000.0, 740_000.0, 120.0), 1.0),
        (DVec3::new(448_000.0, 5_411_000.0, 300.0), 1.0),
        (DVec3::new(-2.7e6, -4.3e6, 3.9e6), 1.0),
        (DVec3::new(5.0, 0.0, 0.0), 1e-3),
    ] {
        for colmap in [false, true] {
            let capture = Capture::new();
            let mut frames = ring();
            for (name, c) in &mut frames {
                shot(c, |_, _| [0; 4]).save(capture.at(name)).unwrap();
                let r = DMat3::from_mat4(c.world_to_camera);
                c.world_to_camera.w_axis = (-(r * (place + units * c.center()))).extend(1.0);
            }
            match colmap {
                true => {
                    capture.colmap("sparse/0", &frames.iter().map(|(n, c)| (&n[7..], *c)).collect::<Vec<_>>(), "\n")
                }
                false => capture.describe(&frames, json!({})),
            }
            let found = capture.read();
            tells(&found.notes, NoteKind::Changed, &["far from the origin"]);
            assert!((found.origin - place).length() <= 3.0 * units, "{}", found.origin);
            let loaded = load(&found, &LoadConfig { hints: Hints::default(), ..LoadConfig::default() }).unwrap();
            for (i, view) in loaded.views.iter().enumerate() {
                let (center, truth) = (view.camera.center() + (found.origin - place), units * camera(i, 4).center());
                assert!(center.distance(truth) < 1e-6 * units + 2e-9, "{center} {truth}");
            }
            // Views that are compared with go to the same origin.
            let mut other = capture.read();
            other.subtract(place);
            assert_eq!(other.origin, place);
        }
    }
    // Near to it nothing is moved; beyond all maps it is an error.
    let capture = Capture::new();
    for (name, c) in ring() {
        shot(&c, |_, _| [0; 4]).save(capture.at(name)).unwrap();
    }
    capture.describe(&ring(), json!({}));
    assert_eq!(capture.read().origin, DVec3::ZERO);
    let mut frames = ring();
    frames[0].1.world_to_camera.w_axis.x = 1e11;
    capture.describe(&frames, json!({}));
    says(cameras(capture.0.path(), None, None), &["frame 0", "from the origin"]);
}

/// A JPEG file with EXIF's orientation.
fn jpeg(image: &RgbaImage, orientation: u8, to: &Path) {
    let mut bytes = Vec::new();
    let rgb = image::DynamicImage::ImageRgba8(image.clone()).into_rgb8();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 97).encode_image(&rgb).unwrap();
    let mut exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".to_vec();
    exif.extend([orientation, 0, 0, 0, 0, 0, 0, 0]);
    let length = (exif.len() as u16 + 2).to_be_bytes();
    std::fs::write(to, [&bytes[..2], &[0xff, 0xe1], &length, &exif, &bytes[2..]].concat()).unwrap();
}

/// RealityCapture's rows, as the documentation of its columns has them, with a principal point off the middle.
fn realitycapture(frames: &[(&str, Camera)], px: [f64; 2]) -> String {
    let mut csv = "#cameras 4\n#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n".to_owned();
    for (name, c) in frames {
        let axes = DMat3::from_mat4(c.world_to_camera).transpose();
        let gl = DMat3::from_cols(axes.x_axis, -axes.y_axis, -axes.z_axis);
        let pitch = gl.y_axis.z.asin().to_degrees();
        let heading = -(-gl.y_axis.x).atan2(gl.y_axis.y).to_degrees();
        let roll = (-gl.x_axis.z).atan2(gl.z_axis.z).to_degrees();
        let (o, f) = (c.center(), 36.0 * c.fx / f64::from(c.width.max(c.height)));
        let [px, py] = px;
        csv += &format!("{name},{},{},{},{heading},{pitch},{roll},{f},{px},{py},0,0,0,0,0,0\n", o.x, o.y, o.z);
    }
    csv
}

#[test]
fn realitycapture_keeps_stored_pixels_and_its_principal_point() {
    // The pixels are the camera's own, whatever the file says of turning it; points off the middle
    // by parts of the longer side.
    for (orientation, x, y) in [(1, 0.05, -0.04), (3, -0.07, 0.02), (6, 0.0, 0.06)] {
        let capture = Capture::new();
        let mut frames = ring();
        for (name, c) in &mut frames {
            (c.cx, c.cy) = (c.cx + x * f64::from(W), c.cy + y * f64::from(W));
            jpeg(&shot(c, |_, _| WHITE), orientation, &capture.at(&name.replace("png", "jpg")));
        }
        let named: Vec<(&str, Camera)> =
            ["a.jpg", "b.jpg", "c.jpg", "d.jpg"].into_iter().zip(frames).map(|(n, f)| (n, f.1)).collect();
        std::fs::write(capture.at("cameras.csv"), realitycapture(&named, [x, y])).unwrap();
        let loaded = capture.load().unwrap();
        assert_right(&loaded, 4);
        let c = loaded.views[0].camera;
        assert!((c.cx - (0.5 + x) * f64::from(W)).abs() < 1e-9);
        assert!((c.cy - 0.5 * f64::from(H) - y * f64::from(W)).abs() < 1e-9);
    }
}

#[test]
fn one_file_is_one_photo() {
    // One name in two folders, and only one of the files.
    let capture = Capture::new();
    for (i, name) in ["images/0001.png", "images/0002.png", "images/0003.png"].iter().enumerate() {
        shot(&camera(i, 4), |_, _| WHITE).save(capture.at(name)).unwrap();
    }
    let frames: Vec<(&str, Camera)> = ["cam0/0001.png", "cam1/0001.png", "cam0/0002.png", "cam0/0003.png"]
        .into_iter()
        .enumerate()
        .map(|(i, n)| (n, camera(i, 4)))
        .collect();
    capture.colmap("sparse/0", &frames, "\n");
    says(cameras(capture.0.path(), None, None), &["0001.png", "cam0/0001.png and cam1/0001.png", "different poses"]);
    // RealityCapture's names without folders.
    let capture = Capture::new();
    for i in 0..3 {
        shot(&camera(i, 4), |_, _| WHITE).save(capture.at(&format!("images/{i}.png"))).unwrap();
    }
    let frames: Vec<(&str, Camera)> =
        ["0.png", "1.png", "2.png", "0.png"].into_iter().enumerate().map(|(i, n)| (n, camera(i, 4))).collect();
    std::fs::write(capture.at("cameras.csv"), realitycapture(&frames, [0.0; 2])).unwrap();
    says(cameras(capture.0.path(), None, None), &["0.png", "different poses"]);
    // Twice under one pose: once.
    let frames: Vec<(&str, Camera)> =
        ["0.png", "1.png", "2.png", "0.png"].into_iter().enumerate().map(|(i, n)| (n, camera(i % 3, 4))).collect();
    std::fs::write(capture.at("cameras.csv"), realitycapture(&frames, [0.0; 2])).unwrap();
    let found = capture.read();
    assert_eq!(found.photos.len(), 3);
    tells(&found.notes, NoteKind::Dropped, &["1 photos", "twice"]);
    // And a mask is one photo's.
    let capture = Capture::new();
    let frames: Vec<(&str, Camera)> = ["images/l/1.png", "images/r/1.png", "images/l/2.png"]
        .into_iter()
        .enumerate()
        .map(|(i, n)| (n, camera(i, 4)))
        .collect();
    for (i, (name, c)) in frames.iter().enumerate() {
        shot(c, busy(i)).save(capture.at(name)).unwrap();
    }
    capture.describe(&frames, json!({}));
    outline(&camera(0, 4)).save(capture.at("masks/1.png")).unwrap();
    outline(&camera(2, 4)).save(capture.at("masks/2.png")).unwrap();
    says(capture.load(), &["masks/1.png", "the mask of one photo", "l/1.png and", "r/1.png"]);
    std::fs::remove_file(capture.at("masks/1.png")).unwrap();
    for (i, (name, _)) in frames.iter().enumerate() {
        outline(&camera(i, 4)).save(capture.at(&name.replace("images", "masks"))).unwrap();
    }
    assert_right(&capture.load().unwrap(), 3);
}

#[test]
fn photos_are_found_under_other_spellings_and_may_be_missing() {
    let frames: Vec<(&str, Camera)> = ["IMG_1.jpg", "IMG_2.JPG", "img_3.png", "IMG_4.jpg", "gone.jpg"]
        .into_iter()
        .enumerate()
        .map(|(i, n)| (n, camera(i, 5)))
        .collect();
    for format in [Format::Colmap, Format::Transforms, Format::Realitycapture] {
        let capture = Capture::new();
        for (i, file) in ["IMG_1.png", "IMG_2.jpg", "IMG_3.PNG", "img_4.webp"].iter().enumerate() {
            let image = shot(&camera(i, 5), |_, _| WHITE);
            match file.ends_with("jpg") {
                true => jpeg(&image, 1, &capture.at(&format!("images/{file}"))),
                false => image.save(capture.at(&format!("images/{file}"))).unwrap(),
            }
        }
        match format {
            Format::Colmap => capture.colmap("sparse/0", &frames, "\n"),
            Format::Realitycapture => std::fs::write(capture.at("c.csv"), realitycapture(&frames, [0.0; 2])).unwrap(),
            _ => {
                let names: Vec<String> = frames.iter().map(|(n, _)| format!("images/{n}")).collect();
                let frames: Vec<(&str, Camera)> =
                    names.iter().map(String::as_str).zip(frames.iter().map(|f| f.1)).collect();
                capture.describe(&frames, json!({}));
            }
        }
        let found = capture.read();
        tells(&found.notes, NoteKind::Warning, &["1 of 5 photos", "gone.jpg"]);
        tells(&found.notes, NoteKind::Assumed, &["4 photos", "IMG_1.png for"]);
        assert_right(&load(&found, &LoadConfig::default()).unwrap(), 4);
        // Two files that it could be.
        shot(&camera(0, 5), |_, _| WHITE).save(capture.at("images/IMG_1.webp")).unwrap();
        says(cameras(capture.0.path(), None, None), &["IMG_1.jpg", "IMG_1.png", "IMG_1.webp"]);
    }
}

#[test]
fn photos_of_other_sizes_than_their_cameras_and_crops_are_read() {
    // Reduced or enlarged, some more than others, beside cameras of one size.
    let capture = Capture::new();
    for ((name, c), (w, h)) in ring().into_iter().zip([(48, 36), (192, 144), (96, 72), (144, 108)]) {
        shot(&c.resized(w, h), |_, _| WHITE).save(capture.at(name)).unwrap();
    }
    let named: Vec<(&str, Camera)> = ring().into_iter().map(|(name, c)| (&name[7..], c)).collect();
    capture.colmap("sparse/0", &named, "\n");
    let loaded = capture.load().unwrap();
    assert_eq!((loaded.views[0].camera.width, loaded.views[1].camera.width), (48, 192));
    assert_right(&loaded, 4);
    // Cropped, each with a principal point of its own.
    let capture = Capture::new();
    let mut frames = ring();
    let parts = [(0, 10, 80, 60), (12, 0, 84, 72), (5, 4, 90, 64), (20, 8, 70, 60)];
    for ((name, c), (x, y, w, h)) in frames.iter_mut().zip(parts) {
        let whole = shot(c, |_, _| WHITE);
        image::imageops::crop_imm(&whole, x, y, w, h).to_image().save(capture.at(name)).unwrap();
        (c.width, c.height) = (w, h);
        (c.cx, c.cy) = (c.cx - f64::from(x), c.cy - f64::from(y));
    }
    capture.describe(&frames, json!({}));
    let loaded = capture.load().unwrap();
    assert_eq!(loaded.views[3].camera.cx, 28.0);
    assert_right(&loaded, 4);
}

#[test]
fn photos_that_are_not_read_are_named_with_what_to_do() {
    for (file, kind) in [
        ("a.HEIC", "HEIC"),
        ("a.avif", "AVIF"),
        ("a.tif", "TIFF"),
        ("a.exr", "OpenEXR"),
        ("a.jxl", "JPEG XL"),
        ("a.dng", "raw"),
        ("a.CR2", "raw"),
    ] {
        let capture = Capture::new();
        for (name, c) in &ring()[1..] {
            shot(c, |_, _| WHITE).save(capture.at(name)).unwrap();
        }
        std::fs::write(capture.at(&format!("images/{file}")), b"not looked at").unwrap();
        capture.describe(&ring(), json!({}));
        says(cameras(capture.0.path(), None, None), &[file, kind, "convert it to JPEG or PNG"]);
        says(cameras(&capture.at("images"), None, None), &[file, kind, "convert it to JPEG or PNG"]);
        // Of photos in even steps none may be missing.
        let turntable = "20,50".parse().unwrap();
        says(cameras(capture.0.path(), None, Some(&turntable)), &[file, kind, "convert it to JPEG or PNG"]);
        // Beside a photo of its name it is the same one, as cameras store both.
        std::fs::rename(capture.at(&format!("images/{file}")), capture.at(&format!("images/B{}", &file[1..]))).unwrap();
        assert_eq!(cameras(capture.0.path(), None, Some(&turntable)).unwrap().photos.len(), 3);
    }
    // By content: messengers rename files.
    for (bytes, kind) in [
        (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic".as_slice(), "HEIC"),
        (b"\0\0\0\x18ftypavif\0\0\0\0avif", "AVIF"),
        (b"II*\0\x08\0\0\0\0\0\0\0\0\0\0\0\0\0", "TIFF"),
    ] {
        let capture = Capture::new();
        for (name, c) in ring() {
            shot(&c, |_, _| WHITE).save(capture.at(name)).unwrap();
        }
        capture.describe(&ring(), json!({}));
        std::fs::write(capture.at("images/c.png"), bytes).unwrap();
        says(capture.load(), &["c.png", kind, "convert it to JPEG or PNG"]);
    }
}

#[test]
fn colors_of_wide_gamut_photos_are_converted() {
    // The red of Display P3 that sRGB calls (200, 30, 20) is less in its own numbers.
    let p3 = moxcms::ColorProfile::new_display_p3();
    let layout = moxcms::Layout::Rgba;
    let into = moxcms::ColorProfile::new_srgb().create_transform_8bit(
        layout,
        &p3,
        layout,
        moxcms::TransformOptions::default(),
    );
    let into = into.unwrap();
    for (profile, converted, jpeg) in [
        (p3.encode().unwrap(), true, false),
        (p3.encode().unwrap(), true, true),
        (moxcms::ColorProfile::new_srgb().encode().unwrap(), false, false),
        (moxcms::ColorProfile::new_srgb().encode().unwrap(), false, true),
        (b"no profile".to_vec(), false, false),
    ] {
        let capture = Capture::new();
        for (name, c) in ring() {
            let srgb = shot(&c, |_, _| WHITE);
            let mut own = srgb.clone();
            if converted {
                into.transform(&srgb, &mut own).unwrap();
            }
            if jpeg {
                let file = std::fs::File::create(capture.at(&name.replace("png", "jpg"))).unwrap();
                let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(file, 98);
                encoder.set_icc_profile(profile.clone()).unwrap();
                let rgb = image::DynamicImage::ImageRgba8(own).into_rgb8();
                encoder.write_image(&rgb, W, H, image::ExtendedColorType::Rgb8).unwrap();
            } else {
                let file = std::fs::File::create(capture.at(name)).unwrap();
                let mut encoder = image::codecs::png::PngEncoder::new(file);
                encoder.set_icc_profile(profile.clone()).unwrap();
                encoder.write_image(&own, W, H, image::ExtendedColorType::Rgba8).unwrap();
            }
        }
        capture.describe(&ring(), json!({}));
        let loaded = capture.load().unwrap();
        assert_right(&loaded, 4);
        let p = loaded.views[0].image.get_pixel(W / 2, H / 2);
        let most = if jpeg { 6 } else { 3 };
        assert!(p.0.iter().zip([200, 30, 20]).all(|(a, b)| a.abs_diff(b) <= most), "{p:?}");
        assert_eq!(loaded.notes.iter().any(|n| n.kind == NoteKind::Changed && n.contains("sRGB")), converted);
    }
}

#[test]
fn masks_are_looked_at_before_they_are_believed() {
    let capture = |masks: &dyn Fn(usize, &Camera) -> (String, GrayImage)| {
        let capture = Capture::new();
        for (i, (name, c)) in ring().iter().enumerate() {
            shot(c, busy(i)).save(capture.at(name)).unwrap();
            let (name, mask) = masks(i, c);
            mask.save(capture.at(&name)).unwrap();
        }
        capture.describe(&ring(), json!({}));
        capture
    };
    let stem = |i: usize| ["a", "b", "c", "d"][i];
    // RealityScan's names, and others.
    for form in [
        "masks/{}.png.mask.png",
        "masks/{}.mask.png",
        "mask/{}_mask.png",
        "image_masks/{}.png.png",
        "images/masks/{}.PNG",
    ] {
        let c = capture(&|i, c| (form.replace("{}", stem(i)), outline(c)));
        let loaded = c.load().unwrap();
        assert_eq!(loaded.masks, MaskKind::Files);
        tells(&loaded.notes, NoteKind::Understood, &["masks are read from files", form.rsplit_once('/').unwrap().0]);
        assert_right(&loaded, 4);
    }
    // Labels.
    for label in [1, 7] {
        let c = capture(&|i, c| {
            let mut mask = outline(c);
            mask.pixels_mut().for_each(|p| p[0] = p[0].min(label));
            (format!("masks/{}.png", stem(i)), mask)
        });
        assert_right(&c.load().unwrap(), 4);
    }
    // The negative: refused by name, and right with the option that the message names.
    for form in ["masks/{}.png", "mask/{}.mask.png"] {
        let (folder, _) = form.split_once('/').unwrap();
        let c = capture(&|i, c| {
            let mut mask = outline(c);
            image::imageops::invert(&mut mask);
            (form.replace("{}", stem(i)), mask)
        });
        says(c.load(), &[&format!("the folder {folder}"), "look inverted", "--invert-masks"]);
        let given = LoadConfig { masks: MaskSource::Files(c.at(folder)), ..LoadConfig::default() };
        says(load(&c.read(), &given), &["look inverted", "--invert-masks"]);
        assert_right(&load(&c.read(), &LoadConfig { invert_masks: true, ..LoadConfig::default() }).unwrap(), 4);
    }
}

#[test]
fn masks_whose_names_fit_no_photo_are_not_used_and_said() {
    for form in ["masks/other_{}.png", "image_masks/{}.jpg.png", "masks/frame_0000{}.mask.png"] {
        let capture = Capture::new();
        for (i, (name, c)) in ring().iter().enumerate() {
            shot(c, |_, _| WHITE).save(capture.at(name)).unwrap();
            outline(c).save(capture.at(&form.replace("{}", &i.to_string()))).unwrap();
        }
        capture.describe(&ring(), json!({}));
        let loaded = capture.load().unwrap();
        assert_eq!(loaded.masks, MaskKind::Plain);
        let (folder, _) = form.split_once('/').unwrap();
        tells(&loaded.notes, NoteKind::Warning, &[folder, "none of its 4 images has a photo's name"]);
        assert_right(&loaded, 4);
        // Where nothing else shows the object, the refusal says it, too.
        for (i, (name, c)) in ring().iter().enumerate() {
            shot(c, busy(i)).save(capture.at(name)).unwrap();
        }
        match capture.load() {
            Ok(loaded) => tells(&loaded.notes, NoteKind::Warning, &[folder, "none of its 4 images"]),
            Err(error) => {
                assert!(matches!(error, SceneError::NotCutOut { .. }), "{error}");
                assert!(error.to_string().contains(&format!("{folder}: none of its 4 images")), "{error}");
            }
        }
    }
}

#[test]
fn photos_without_a_camera_are_named() {
    for format in [Format::Transforms, Format::Colmap, Format::Realitycapture] {
        let capture = Capture::new();
        for (name, c) in ring() {
            shot(&c, |_, _| WHITE).save(capture.at(name)).unwrap();
        }
        // What goes with a photo is no other one.
        for more in ["e.png", "a.png.png", "b.mask.png", "c_depth_0001.png"] {
            shot(&camera(0, 4), |_, _| WHITE).save(capture.at(&format!("images/{more}"))).unwrap();
        }
        let named: Vec<(&str, Camera)> = ring().into_iter().map(|(name, c)| (&name[7..], c)).collect();
        match format {
            Format::Colmap => capture.colmap("sparse/0", &named, "\n"),
            Format::Realitycapture => std::fs::write(capture.at("c.csv"), realitycapture(&named, [0.0; 2])).unwrap(),
            _ => capture.describe(&ring(), json!({})),
        }
        let found = capture.read();
        assert_eq!((found.format, found.photos.len()), (format, 4));
        let left: Vec<&Note> = found.notes.iter().filter(|n| n.contains("no camera")).collect();
        assert!(left.len() == 1 && left[0].kind == NoteKind::Dropped, "{:?}", found.notes);
        assert!(left[0].ends_with("1 photos have no camera and are left out: e.png"), "{:?}", left[0]);
        if format == Format::Transforms {
            // A description that is named itself may be one of several.
            let found = cameras(&capture.at("transforms.json"), None, None).unwrap();
            assert!(found.notes.iter().all(|n| !n.contains("no camera")), "{:?}", found.notes);
        }
    }
}

#[test]
fn masks_of_usable_pixels_are_not_the_object() {
    // A stand at the photos' lower border is masked away; and masks that hide nothing.
    for whole in [false, true] {
        for named in [false, true] {
            let capture = Capture::new();
            for (name, c) in ring() {
                let stand = |x: u32, y: u32| !whole && y > 60 && x.abs_diff(48) < 12;
                shot(&c, |x, y| if stand(x, y) { [20, 160, 40, 255] } else { WHITE }).save(capture.at(name)).unwrap();
                let mask = GrayImage::from_fn(W, H, |x, y| Luma([if stand(x, y) { 0 } else { 255 }]));
                mask.save(capture.at(&name.replace("images", if named { "use" } else { "masks" }))).unwrap();
            }
            capture.describe(&ring(), json!({}));
            if named {
                let file = capture.at("transforms.json");
                let mut root: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
                for frame in root["frames"].as_array_mut().unwrap() {
                    frame["mask_path"] = json!(frame["file_path"].as_str().unwrap().replace("images", "use"));
                }
                std::fs::write(file, root.to_string()).unwrap();
            }
            let loaded = capture.load().unwrap();
            assert_eq!(loaded.masks, MaskKind::Plain);
            tells(&loaded.notes, NoteKind::Warning, &["which pixels may be used", "--masks FOLDER"]);
            assert_right(&loaded, 4);
        }
    }
}

#[test]
fn nothing_outside_of_the_scene_is_taken() {
    // Folders beside and above the scene that have other captures' photos and masks of the same names.
    let capture = Capture::new();
    for (name, c) in ring() {
        shot(&c, |_, _| WHITE).save(capture.at(&format!("all/scene/{name}"))).unwrap();
        let strange = GrayImage::from_fn(W, H, |x, _| Luma([if x < 20 { 255 } else { 0 }]));
        for folder in ["masks", "all/masks"] {
            strange.save(capture.at(&name.replace("images", folder))).unwrap();
        }
        RgbImage::from_pixel(W, H, Rgb([1, 2, 3])).save(capture.at(&format!("all/{name}"))).unwrap();
    }
    let frames: Vec<(&str, Camera)> = ring().into_iter().map(|(n, c)| (n.trim_start_matches("images/"), c)).collect();
    capture.colmap("all/scene/sparse/0", &frames, "\n");
    for named in ["all/scene", "all/scene/sparse", "all/scene/sparse/0"] {
        let loaded = load(&cameras(&capture.at(named), None, None).unwrap(), &LoadConfig::default()).unwrap();
        assert_eq!(loaded.masks, MaskKind::Plain);
        assert_right(&loaded, 4);
    }
    // A model that lies in the scene itself has no business in folders above.
    std::fs::rename(capture.at("all/scene/sparse/0/cameras.txt"), capture.at("all/scene/model/cameras.txt")).unwrap();
    std::fs::rename(capture.at("all/scene/sparse/0/images.txt"), capture.at("all/scene/model/images.txt")).unwrap();
    says(cameras(&capture.at("all/scene/model"), None, None), &["none of its images", "a.png"]);
}

#[test]
fn second_lines_of_images_may_be_missing() {
    for between in ["", "\n", "# next\n", "\n# next\n\n", "1.5 2 -1 3 4 17\n", "1.5 2 -1\n# next\n", "1.5 2 -1\r\n"] {
        let capture = Capture::new();
        // One photo is called by a number.
        let frames: Vec<(&str, Camera)> =
            [("1", 0), ("b c.png", 1), ("c.png", 2), ("d.png", 3)].map(|(n, i)| (n, camera(i, 4))).to_vec();
        for (name, c) in &frames {
            let file = if *name == "1" { "1.png" } else { name };
            shot(c, |_, _| WHITE).save(capture.at(&format!("images/{file}"))).unwrap();
        }
        capture.colmap("sparse/0", &frames, between);
        let found = capture.read();
        assert_eq!(found.photos.len(), 4, "{between:?}");
        assert_right(&load(&found, &LoadConfig::default()).unwrap(), 4);
    }
}

#[test]
fn up_of_nerfstudios_colmap_scenes_is_not_z() {
    let up = |fields: Value| {
        let capture = Capture::new();
        for (name, c) in ring() {
            shot(&c, |_, _| WHITE).save(capture.at(name)).unwrap();
        }
        capture.describe(&ring(), fields);
        capture.read().any_up
    };
    let applied = json!([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]);
    assert!(up(json!({"applied_transform": applied})));
    assert!(up(json!({"applied_transform": applied, "orientation_override": "up"})));
    assert!(!up(json!({"applied_transform": applied, "orientation_override": "none"})));
    assert!(!up(json!({})));
    // And it is found, however COLMAP's world lies: here by the cameras, as nothing else shows it.
    for turn in [DMat3::from_rotation_x(0.7), DMat3::from_rotation_y(-2.0) * DMat3::from_rotation_x(1.1)] {
        let capture = Capture::new();
        let mut frames = ring();
        for (name, c) in &mut frames {
            shot(c, |_, _| [0; 4]).save(capture.at(name)).unwrap();
            c.world_to_camera *= DMat4::from_mat3(turn.transpose());
        }
        capture.describe(&frames, json!({"applied_transform": applied}));
        let scene = Scene::load(capture.read(), &SceneConfig::default()).unwrap();
        tells(&scene.notes, NoteKind::Assumed, &["up is taken from", "--up"]);
        let frame = canonical_from_user(&scene.loaded.views, &scene.frame).unwrap();
        let up = frame.canonical_from_user.rotation.inverse() * DVec3::Z;
        assert!(up.angle_between(turn * DVec3::Z) < 0.02, "{up}");
    }
}

/// A camera as Metashape's XML has it.
fn transform(c: &Camera) -> String {
    let m = c.world_to_camera.inverse().transpose().to_cols_array();
    m.map(|v| format!("{v:e}")).join(" ")
}

fn metashape(capture: &Capture, sensors: &str, components: &str, list: &str) {
    let xml = format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?><document version=\"2.0.0\"><chunk label=\"C\" enabled=\"true\"><sensors>{sensors}</sensors>\
         <components>{components}</components><cameras>{list}</cameras></chunk></document>"
    );
    std::fs::write(capture.at("cameras.xml"), xml).unwrap();
}

fn sensor(id: usize, more: &str, inner: &str) -> String {
    let c = camera(0, 4);
    format!(
        "<sensor id=\"{id}\" type=\"frame\"{more}><resolution width=\"{W}\" height=\"{H}\"/>{inner}<calibration type=\"frame\" \
         class=\"adjusted\"><resolution width=\"{W}\" height=\"{H}\"/><f>{}</f></calibration></sensor>",
        c.fx
    )
}

#[test]
fn metashape_rigs_and_components_are_put_together() {
    let capture = Capture::new();
    let cs: Vec<Camera> = (0..4).map(|i| camera(i, 4)).collect();
    for (name, c) in ring() {
        shot(&c, |_, _| WHITE).save(capture.at(name)).unwrap();
    }
    let line = |values: &[f64]| values.iter().map(|v| format!("{v:e}")).collect::<Vec<_>>().join(" ");
    // A rig of two: the second camera has no transform of its own.
    let slave = |id: usize, master: usize, own: usize| {
        let m = cs[master].world_to_camera * cs[own].world_to_camera.inverse();
        let r = DMat3::from_mat4(m).transpose().to_cols_array();
        let inner =
            format!("<rotation>{}</rotation><location>{}</location>", line(&r), line(&m.w_axis.truncate().to_array()));
        sensor(id, &format!(" master_id=\"{master}\""), &inner)
    };
    let posed = |i: usize, component: &str| {
        let name = NAMES[i].trim_start_matches("images/");
        format!(
            "<camera id=\"{i}\" sensor_id=\"0\" {component} label=\"{name}\"><transform>{}</transform></camera>",
            transform(&cs[i])
        )
    };
    let of_rig = |i: usize, sensor: usize, master: usize| {
        let name = NAMES[i].trim_start_matches("images/");
        format!("<camera id=\"{i}\" sensor_id=\"{sensor}\" master_id=\"{master}\" label=\"{name}\"/>")
    };
    let sensors = sensor(0, "", "") + &slave(1, 0, 1) + &slave(2, 2, 3);
    let list = posed(0, "component_id=\"0\"") + &of_rig(1, 1, 0) + &posed(2, "component_id=\"0\"") + &of_rig(3, 2, 2);
    metashape(&capture, &sensors, "", &list);
    assert_right(&capture.load().unwrap(), 4);
    // A sensor that does not say where it is in its rig.
    metashape(&capture, &(sensor(0, "", "") + &sensor(1, "", "")), "", &(posed(0, "") + &of_rig(1, 1, 0)));
    says(cameras(capture.0.path(), None, None), &["sensor \"1\"", "place in its rig"]);

    // Two components, each with its own frame and transform to a common one.
    let turn = DMat3::from_rotation_z(0.7);
    let shift = DVec3::new(3.0, -1.0, 0.5);
    let in_other = |i: usize| {
        let mut c = cs[i];
        let center = turn.transpose() * (c.center() - shift) / 2.0;
        let rotation = DMat3::from_mat4(c.world_to_camera) * turn;
        c.world_to_camera = DMat4::from_mat3(rotation);
        c.world_to_camera.w_axis = (-(rotation * center)).extend(1.0);
        let name = NAMES[i].trim_start_matches("images/");
        format!(
            "<camera id=\"{i}\" sensor_id=\"0\" component_id=\"1\" label=\"{name}\"><transform>{}</transform></camera>",
            transform(&c)
        )
    };
    let list = posed(0, "component_id=\"0\"") + &posed(1, "component_id=\"0\"") + &in_other(2) + &in_other(3);
    let moved = |id: usize, r: DMat3, t: DVec3, s: f64| {
        format!(
            "<component id=\"{id}\"><transform><rotation>{}</rotation><translation>{}</translation><scale>{s}</scale></transform></component>",
            line(&r.transpose().to_cols_array()),
            line(&t.to_array())
        )
    };
    let both = moved(0, DMat3::IDENTITY, DVec3::ZERO, 1.0) + &moved(1, turn, shift, 2.0);
    metashape(&capture, &sensor(0, "", ""), &both, &list);
    let found = capture.read();
    tells(&found.notes, NoteKind::Understood, &["2 of Metashape's components"]);
    assert_right(&load(&found, &LoadConfig::default()).unwrap(), 4);
    // Nothing that joins them: the larger one alone.
    let list = list
        + &posed(2, "component_id=\"0\"").replace("id=\"2\" sensor", "id=\"9\" sensor").replace("c.png", "gone.png");
    metashape(&capture, &sensor(0, "", ""), "<component id=\"0\"/><component id=\"1\"/>", &list);
    let found = capture.read();
    tells(&found.notes, NoteKind::Warning, &["2 photos that are not in component \"0\"", "left out"]);
    assert_eq!(found.photos.len(), 2);
}

#[test]
fn polycams_files_with_and_without_sizes_are_read() {
    // Sizes from the images, where the files have none; x, y, z are Polycam's z, x, y.
    for (folder, sized) in [("", false), ("corrected_", false), ("", true), ("corrected_", true)] {
        let capture = Capture::new();
        for (i, c) in (0..4).map(|i| (i, camera(i, 4))) {
            let axes = DMat3::from_mat4(c.world_to_camera).transpose();
            let columns = [axes.x_axis, -axes.y_axis, -axes.z_axis, c.center()];
            let mut root = json!({"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy});
            if sized {
                (root["width"], root["height"]) = (json!(W), json!(H));
            }
            for (ours, theirs) in [(0, 2), (1, 0), (2, 1)] {
                for (j, column) in columns.iter().enumerate() {
                    root[format!("t_{theirs}{j}")] = json!(column[ours]);
                }
            }
            std::fs::write(capture.at(&format!("keyframes/{folder}cameras/{i}.json")), root.to_string()).unwrap();
            shot(&c, |_, _| WHITE).save(capture.at(&format!("keyframes/{folder}images/{i}.png"))).unwrap();
        }
        assert_right(&capture.load().unwrap(), 4);
    }
}

#[test]
fn colmap_models_are_written_with_their_origin() {
    for origin in [DVec3::ZERO, DVec3::new(448_000.0, 5_411_000.0, 300.0)] {
        let capture = Capture::new();
        let views: Vec<View> = ring()
            .into_iter()
            .map(|(name, camera)| View {
                name: format!("{} photo", &name[7..8]),
                camera,
                image: shot(&camera, |_, _| [0; 4]),
            })
            .collect();
        let points = [(DVec3::new(0.1, 0.2, 0.3), [1, 2, 3]), (DVec3::ZERO, [255, 0, 9])];
        freerange_scene::write_colmap(capture.0.path(), &views, origin, &points).unwrap();
        let found = capture.read();
        assert_eq!((found.format, found.photos.len()), (Format::Colmap, 4));
        let loaded = load(&found, &LoadConfig::default()).unwrap();
        for (view, read) in views.iter().zip(&loaded.views) {
            assert_eq!((view.name.as_str(), view.camera.fx), (read.name.as_str(), read.camera.fx));
            let off = read.camera.center() + found.origin - origin - view.camera.center();
            assert!(off.length() < 1e-8, "{off}");
        }
        let bytes = std::fs::read(capture.at("sparse/0/points3D.bin")).unwrap();
        assert_eq!(bytes.len(), 8 + 2 * (8 + 24 + 3 + 8 + 8));
        assert_eq!(bytes[16..24], (origin.x + 0.1).to_le_bytes());
        assert_eq!(bytes[40..43], [1, 2, 3]);
    }
}

/// What is left of a file.
struct Rest<'a>(&'a [u8]);

impl Rest<'_> {
    fn bytes<const N: usize>(&mut self) -> [u8; N] {
        let (head, tail) = self.0.split_first_chunk::<N>().expect("more bytes");
        self.0 = tail;
        *head
    }

    fn i32(&mut self) -> i32 {
        i32::from_le_bytes(self.bytes())
    }

    fn u64(&mut self) -> u64 {
        u64::from_le_bytes(self.bytes())
    }

    fn f64s<const N: usize>(&mut self) -> [f64; N] {
        std::array::from_fn(|_| f64::from_le_bytes(self.bytes()))
    }

    fn text(&mut self) -> String {
        let end = self.0.iter().position(|b| *b == 0).expect("an end of the name");
        let text = std::str::from_utf8(&self.0[..end]).unwrap().to_owned();
        self.0 = &self.0[end + 1..];
        text
    }
}

/// As `colmap_parsing_utils.py` and the parser of COLMAP's scenes of nerfstudio 1.1.5 read them: numbers of models, sizes of entries, an image
/// of its camera's size for each name under images/, one camera model for all, points in a file of their own.
#[test]
fn written_models_follow_the_rules_of_nerfstudios_reader() {
    for origin in [DVec3::ZERO, DVec3::new(448_000.0, 5_411_000.0, 300.0)] {
        let capture = Capture::new();
        let view = |(i, (name, camera)): (usize, (&str, Camera))| View {
            name: format!("{} photo {i}", &name[7..8]),
            camera,
            image: shot(&camera, |_, _| [0; 4]),
        };
        let views: Vec<View> = ring().into_iter().enumerate().map(view).collect();
        let points = [(DVec3::new(0.1, 0.2, 0.3), [1, 2, 3]), (DVec3::ZERO, [255, 0, 9])];
        freerange_scene::write_colmap(capture.0.path(), &views, origin, &points).unwrap();
        let file = |name: &str| std::fs::read(capture.at(&format!("sparse/0/{name}.bin"))).unwrap();
        let (cameras, images, cloud) = (file("cameras"), file("images"), file("points3D"));
        let mut rest = Rest(&cameras);
        let mut lenses = HashMap::new();
        for _ in 0..rest.u64() {
            // Model 1 is PINHOLE, with four parameters.
            let (id, model, size) = (rest.i32(), rest.i32(), (rest.u64(), rest.u64()));
            assert_eq!(model, 1);
            lenses.insert(id, (size, rest.f64s::<4>()));
        }
        assert!(rest.0.is_empty() && lenses.len() == 4);
        let mut rest = Rest(&images);
        assert_eq!(rest.u64(), 4);
        for view in &views {
            let (_, [w, x, y, z], t, camera) = (rest.i32(), rest.f64s::<4>(), rest.f64s::<3>(), rest.i32());
            let (name, keypoints) = (rest.text(), rest.u64());
            assert_eq!((name.as_str(), keypoints), (format!("{}.png", view.name).as_str(), 0));
            let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w));
            let center = -(rotation.transpose() * DVec3::from_array(t));
            assert!(center.distance(view.camera.center() + origin) < 1e-8, "{center}");
            assert!((rotation.row(2) - view.camera.world_to_camera.row(2).truncate()).length() < 1e-12);
            let ((width, height), [fx, fy, cx, cy]) = lenses[&camera];
            let c = &view.camera;
            assert_eq!((fx, fy, cx, cy), (c.fx, c.fy, c.cx, c.cy));
            let (w, h) = image::image_dimensions(capture.at("images").join(&name)).unwrap();
            assert_eq!((u64::from(w), u64::from(h)), (width, height));
        }
        assert!(rest.0.is_empty());
        let mut rest = Rest(&cloud);
        assert_eq!(rest.u64(), 2);
        for (id, (place, color)) in (1u64..).zip(&points) {
            assert_eq!(rest.u64(), id);
            assert!(DVec3::from_array(rest.f64s()).distance(*place + origin) < 1e-8);
            let (found, error, track) = (rest.bytes::<3>(), rest.f64s::<1>(), rest.u64());
            assert_eq!((found, error, track), (*color, [0.0], 0));
        }
        assert!(rest.0.is_empty());
    }
}

#[test]
fn wide_lenses_are_seen_by_a_pinhole_that_looks_at_the_object() {
    let fisheye = Lens::Fisheye { k: [0.01, 0.0, 0.0, 0.0] };
    let eucm = Lens::Eucm { alpha: 0.6, beta: 1.1 };
    for (model, params, lens) in [
        ("SIMPLE_RADIAL_FISHEYE", "105 200 200 0.01", fisheye),
        ("EUCM", "105 105 200 200 0.6 1.1", eucm),
        ("EQUIRECTANGULAR", "400 400", Lens::Equirectangular),
    ] {
        for away in [0.0, 40.0, 75.0, 160.0] {
            if away > 90.0 && lens != Lens::Equirectangular {
                continue;
            }
            let capture = wide(model, params, lens, away, [0; 4]);
            let loaded = capture.load().unwrap();
            assert_eq!(loaded.masks, MaskKind::Alpha);
            for view in &loaded.views {
                let seen = view.image.pixels().filter(|p| p[3] >= 128).count();
                assert!(wrong(view) < 0.02 && seen > 250, "{model}, {away}: {:.3} {seen}", wrong(view));
                // Nothing of it is cut off.
                let (w, h) = view.image.dimensions();
                let border =
                    view.image.enumerate_pixels().filter(|(x, y, _)| *x == 0 || *y == 0 || *x == w - 1 || *y == h - 1);
                assert!(border.into_iter().all(|(.., p)| p[3] < 128), "{model}, {away}");
            }
            // Masks go back to the photos' own pixels.
            let out = tempfile::tempdir().unwrap();
            let written = freerange_scene::write_masks(out.path(), &capture.read(), &loaded).unwrap();
            let truth = image::open(capture.at("images/0.png")).unwrap().into_rgba8();
            let mask = image::open(&written[0]).unwrap().into_luma8();
            let (both, either) = mask.pixels().zip(truth.pixels()).fold((0, 0), |(both, either), (m, t)| {
                let (m, t) = (m[0] >= 128, t[3] >= 128);
                (both + u32::from(m && t), either + u32::from(m || t))
            });
            assert!(f64::from(both) > 0.85 * f64::from(either), "{model}, {away}: {both} of {either}");
        }
    }
    // Before a plain background, from where all of it is known.
    let capture = wide("SIMPLE_RADIAL_FISHEYE", "105 200 200 0.01", fisheye, 60.0, WHITE);
    let hints = Hints { center: Some(DVec3::ZERO), radius: Some(BALL), others: None };
    let loaded = load(&capture.read(), &LoadConfig { hints, ..LoadConfig::default() }).unwrap();
    tells(&loaded.notes, NoteKind::Changed, &["4 photos of wide lenses", "looks at the object"]);
    assert!(loaded.views.iter().all(|v| wrong(v) < 0.02));
    // All around, and nothing says where the object is.
    let capture = wide("EQUIRECTANGULAR", "400 400", Lens::Equirectangular, 0.0, WHITE);
    says(capture.load(), &["camera model", "--center X,Y,Z", "all around"]);
}
