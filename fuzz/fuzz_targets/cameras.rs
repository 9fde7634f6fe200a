//! A letter (`c`, `i`, `f`, `g` COLMAP's cameras, images, frames and rigs, binary; capitals as text; `m` Metashape, `o`, `l`, `j` OPF's
//! calibrated cameras, list of cameras and project, `p` Polycam, `r` RealityCapture), then the file.
//! Must end in an error or in cameras with finite numbers.
#![no_main]

use std::path::{Component, Path};

use freerange_scene::read::{Intrinsics, colmap, colmap_frames, metashape, opf, polycam, realitycapture};
use libfuzzer_sys::fuzz_target;

/// A ray that is so far to the right.
fn r_of(x: f64) -> glam::DVec3 {
    glam::DVec3::new(x, -0.2, 1.0)
}

fuzz_target!(|data: &[u8]| {
    let Some((&kind, bytes)) = data.split_first() else { return };
    let file = Path::new("file");
    match kind {
        b'c' | b'C' => {
            let read = if kind == b'c' { colmap::cameras_binary } else { colmap::cameras_text };
            for camera in read(file, bytes).into_iter().flat_map(|cameras| cameras.into_values()) {
                let lens = camera.lens;
                assert!(lens.ray(0.3, -0.2).is_none_or(|r| r.is_finite()) && lens.project(r_of(0.3)).is_none_or(|p| p.is_finite()));
            }
        }
        b'f' | b'F' => drop(colmap_frames::frames(file, bytes, kind == b'f')),
        b'g' | b'G' => drop(colmap_frames::rigs(file, bytes, kind == b'g')),
        b'i' | b'I' => {
            let read = if kind == b'i' { colmap::images_binary } else { colmap::images_text };
            for image in read(file, bytes).into_iter().flatten() {
                assert!(!image.name.is_empty() && image.rotation.is_normalized());
            }
        }
        b'm' => {
            for photo in metashape::parse(file, bytes).into_iter().flat_map(|export| export.photos) {
                assert!(photo.camera.world_to_camera.is_finite() && photo.camera.fx > 0.0);
            }
        }
        b'p' => {
            if let Ok(camera) = polycam::camera(file, bytes, Some((640, 480))) {
                assert!(camera.world_to_camera.is_finite() && camera.fx > 0.0);
            }
        }
        b'o' => {
            for camera in opf::calibrated(file, bytes).into_iter().flatten() {
                assert!(camera.focal > 0.0 && camera.axes.is_finite());
            }
        }
        b'l' => drop(opf::uris(file, bytes)),
        b'j' => {
            // What it names lies in its folder.
            for path in opf::project(file, bytes).into_iter().flatten() {
                assert!(path.components().all(|c| matches!(c, Component::Normal(_) | Component::CurDir)));
            }
        }
        b'r' => {
            for (_, intrinsics, lens) in realitycapture::parse(file, bytes).into_iter().flatten() {
                let Intrinsics::Relative { world_to_camera, focal, .. } = intrinsics else { panic!("no sizes there") };
                assert!(world_to_camera.is_finite() && focal > 0.0);
                let _ = (lens.invert(0.1, 0.2), lens.apply(0.1, 0.2));
            }
        }
        _ => {}
    }
});
