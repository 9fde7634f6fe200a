//! A letter (`c`, `i` COLMAP's cameras and images, binary; `C`, `I` as text; `m` Metashape, `p` Polycam, `r` RealityCapture), then the file.
//! Must end in an error or in cameras with finite numbers.
#![no_main]

use std::path::Path;

use freerange_scene::read::{Intrinsics, colmap, metashape, polycam, realitycapture};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let Some((&kind, bytes)) = data.split_first() else { return };
    let file = Path::new("file");
    match kind {
        b'c' => drop(colmap::cameras_binary(file, bytes)),
        b'C' => drop(colmap::cameras_text(file, bytes)),
        b'i' | b'I' => {
            let read = if kind == b'i' { colmap::images_binary } else { colmap::images_text };
            for image in read(file, bytes).into_iter().flatten() {
                assert!(!image.name.is_empty() && image.rotation.is_normalized());
            }
        }
        b'm' => {
            for photo in metashape::parse(file, bytes).into_iter().flat_map(|(photos, _)| photos) {
                assert!(photo.camera.world_to_camera.is_finite() && photo.camera.fx > 0.0);
            }
        }
        b'p' => {
            if let Ok(camera) = polycam::camera(file, bytes) {
                assert!(camera.world_to_camera.is_finite() && camera.fx > 0.0);
            }
        }
        b'r' => {
            for (_, intrinsics, lens) in realitycapture::parse(file, bytes).into_iter().flatten() {
                let Intrinsics::Relative { world_to_camera, focal, .. } = intrinsics else { panic!("no sizes there") };
                assert!(world_to_camera.is_finite() && focal > 0.0);
                let _ = lens.invert(0.1, 0.2);
            }
        }
        _ => {}
    }
});
