//! A `transforms.json`. Must end in an error or in frames whose cameras are finite.
#![no_main]

use std::path::Path;

use freerange_scene::camera::scene::Description;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let Ok(description) = Description::parse(Path::new("folder/transforms.json"), data) else { return };
    let (inputs, further) = description.split();
    assert_eq!(inputs.len() + further.len(), description.frames.len());
    for frame in &description.frames {
        assert!(!frame.name.is_empty());
        if let Ok(camera) = frame.camera(frame.size.unwrap_or((640, 480))) {
            assert!(camera.world_to_camera.is_finite() && camera.fx > 0.0 && camera.fx.is_finite());
        }
    }
});
