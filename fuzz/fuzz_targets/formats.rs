//! A letter (of the format), then the file. Must end in an error or in finite Gaussians that can be written again.
#![no_main]

use std::path::Path;

use freerange_gaussians::formats::{Format, Frame, WriteOptions, encode, parse};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let Some((letter, file)) = data.split_first() else { return };
    let format = match letter {
        b'p' => Format::Ply,
        b't' => Format::Splat,
        b'z' => Format::Spz,
        b's' => Format::Sog,
        b'g' => Format::Glb,
        b'u' => Format::Usda,
        b'h' => Format::Html,
        _ => return,
    };
    if let Ok(loaded) = parse(format, file, Path::new("fuzzed"), Frame::Z_UP) {
        assert!(loaded.splats.cloud.check_finite().is_ok());
        if !loaded.splats.cloud.is_empty() && loaded.splats.cloud.len() < 1000 {
            for other in Format::ALL {
                let bytes = encode(&loaded.splats, other, &WriteOptions::default()).expect("finite Gaussians").bytes;
                let again = parse(other, &bytes, Path::new("written"), Frame::Z_UP);
                // Far beyond what 32 bits hold, sums and turns overflow: an error, but no panic.
                let _ = again.map(|a| assert_eq!(a.splats.cloud.len(), loaded.splats.cloud.len()));
            }
        }
    }
});
