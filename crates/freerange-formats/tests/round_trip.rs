//! What is written comes back, within what the format can hold.

mod common;

use std::path::Path;

use common::{difference, object};
use freerange_formats::{Format, FormatError, Frame, Loaded, SpzVersion, WriteOptions, encode, parse, read, write};
use freerange_splat::{Cloud, channel};
use glam::DVec3;

fn again(cloud: &Cloud, format: Format, options: &WriteOptions) -> Loaded {
    let encoded = encode(cloud, format, options).unwrap();
    assert_eq!(encoded, encode(cloud, format, options).unwrap(), "the same Gaussians give the same bytes");
    parse(format, &encoded.bytes, Path::new("test"), options.frame).unwrap()
}

/// As [`again`], in the order of the original: `.splat` sorts.
fn unsorted(cloud: &Cloud, loaded: &Cloud) -> Cloud {
    let nearest = |i: usize| {
        let distance = |j: usize| (loaded.mean(j) - cloud.mean(i)).length_squared();
        (0..loaded.len()).min_by(|&a, &b| distance(a).total_cmp(&distance(b))).unwrap()
    };
    loaded.select((0..cloud.len()).map(nearest).collect::<Vec<_>>())
}

#[test]
fn lossless_formats_keep_all_bits() {
    let cloud = object(300);
    for format in [Format::Ply, Format::Html] {
        let found = again(&cloud, format, &WriteOptions::default()).cloud;
        difference(&cloud, &found).assert_within(0.0, 0.0, 1e-7, 0.0, 1.2e-7);
    }
    assert_eq!(again(&cloud, Format::Html, &WriteOptions::default()).cloud, cloud);
}

#[test]
fn lossy_formats_keep_what_their_bits_allow() {
    let cloud = object(700);
    let options = WriteOptions::default();
    let half = 0.5 / 255.0 + 1e-9;
    // 16 bits of the folded range; 8 of the smallest three; codebooks.
    let sog = again(&cloud, Format::Sog, &options).cloud;
    difference(&cloud, &sog).assert_within(0.5 / 65535.0 * 0.57 + 1e-7, 0.01, 0.017, half, 0.005);
    // Seven bits of each component of the rotation.
    let splat = again(&cloud, Format::Splat, &options).cloud;
    difference(&cloud, &unsorted(&cloud, &splat)).assert_within(0.0, 1e-6, 0.017, half, half);
    // Steps of a 2^17th of the object, sixteenths of log-scale, 9 bits and sign of the smallest three.
    for spz_version in [SpzVersion::V3, SpzVersion::V4] {
        let spz = again(&cloud, Format::Spz, &WriteOptions { spz_version, ..options }).cloud;
        let color = 0.5 / 255.0 / 0.15 * 0.2821 + 1e-6;
        difference(&cloud, &spz).assert_within(0.5 / 131072.0, 1.0 / 32.0 + 1e-5, 0.005, half, color);
    }
    let glb = again(&cloud, Format::Glb, &options).cloud;
    difference(&cloud, &glb).assert_within(1e-7, 1e-6, 1e-6, 1e-6, 1e-6);
}

#[test]
fn splat_files_begin_with_what_shows_most() {
    let loaded = again(&object(50), Format::Splat, &WriteOptions::default()).cloud;
    let weight: Vec<f64> = (0..50).map(|i| loaded.scale(i).element_product() * loaded.opacity(i)).collect();
    // Opacities are rounded to bytes.
    assert!(weight.windows(2).all(|w| w[1] <= w[0] * 1.02));
}

/// The format's own numbers, read at their places in the file: a Gaussian far along one axis is where the format's
/// frame has that axis.
#[test]
fn frames_are_as_documented() {
    let mut row = [0f32; channel::COUNT];
    row[channel::MEAN].copy_from_slice(&[0.1, 0.2, 0.4]);
    row[channel::ROTATION].copy_from_slice(&[1.0, 0.0, 0.0, 0.0]);
    let cloud = Cloud::from_rows(row.to_vec());
    for (frame, expected) in
        [(Frame::Z_UP, [0.1, 0.4, -0.2]), (Frame::Y_DOWN, [0.1, -0.2, -0.4]), (Frame::Y_UP, [0.1, 0.2, 0.4])]
    {
        let options = WriteOptions { frame, ..WriteOptions::default() };
        let spz = encode(&cloud, Format::Spz, &options).unwrap().bytes;
        let mut raw = Vec::new();
        std::io::Read::read_to_end(&mut flate2::read::GzDecoder::new(&spz[..]), &mut raw).unwrap();
        let unit = f64::from(1u32 << raw[13]);
        for k in 0..3 {
            let at = 16 + 3 * k;
            let fixed = i32::from_le_bytes([0, raw[at], raw[at + 1], raw[at + 2]]) >> 8;
            assert!((f64::from(fixed) / unit - expected[k]).abs() < 1e-5, "{k}");
        }
        let glb = encode(&cloud, Format::Glb, &options).unwrap().bytes;
        let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
        let json: serde_json::Value = serde_json::from_slice(&glb[20..20 + length]).unwrap();
        let rotation: [f64; 4] = serde_json::from_value(json["nodes"][0]["rotation"].clone()).unwrap();
        let stored = [0, 1, 2].map(|k| f32::from_le_bytes(glb[28 + length + 4 * k..][..4].try_into().unwrap()).into());
        assert_eq!(stored.map(|v: f64| v as f32), [0.1, 0.2, 0.4], "attributes are in the user's frame");
        let placed = glam::DQuat::from_array(rotation) * DVec3::from_array(stored);
        assert!(placed.abs_diff_eq(DVec3::from_array(expected), 1e-7), "{placed}");
        for format in [Format::Spz, Format::Glb] {
            let bytes = encode(&cloud, format, &options).unwrap().bytes;
            // In the frame of the file, and back in the user's.
            let y_up = parse(format, &bytes, Path::new("a"), Frame::Y_UP).unwrap().cloud;
            assert!(y_up.mean(0).abs_diff_eq(DVec3::from_array(expected), 1e-5));
            let back = parse(format, &bytes, Path::new("a"), frame).unwrap().cloud;
            assert!(back.mean(0).abs_diff_eq(cloud.mean(0), 1e-5));
        }
        for format in [Format::Ply, Format::Splat, Format::Sog, Format::Html] {
            let bytes = encode(&cloud, format, &options).unwrap().bytes;
            let found = parse(format, &bytes, Path::new("a"), Frame::Y_UP).unwrap().cloud;
            assert!(found.mean(0).abs_diff_eq(cloud.mean(0), 1e-6), "{format} does not turn");
        }
    }
}

#[test]
fn small_and_far_objects_keep_their_shape_in_spz() {
    for (size, shift) in [(1e-3, 0.0), (1.0, 300.0), (200.0, 0.0)] {
        let mut cloud = object(100);
        cloud.transform(size, glam::DQuat::IDENTITY, DVec3::new(shift, 0.0, -shift));
        let loaded = again(&cloud, Format::Spz, &WriteOptions::default()).cloud;
        // 24 bits with the sign hold 2^-23 of the farthest, in 24 bits of fraction at most.
        let step = (size / 131072.0).max(shift / 4e6).max(0.5f64.powi(24));
        assert!(difference(&cloud, &loaded).mean <= step, "{size} {shift}");
    }
}

#[test]
fn what_does_not_fit_is_clipped_and_said() {
    let mut cloud = object(10);
    cloud.iter_mut().next().unwrap()[channel::LOG_SCALE].fill(-14.0);
    cloud.iter_mut().nth(1).unwrap()[channel::COLOR].fill(3.0);
    let options = WriteOptions::default();
    let notes = encode(&cloud, Format::Spz, &options).unwrap().notes;
    assert!(
        notes[0].contains("1 Gaussians have standard deviations") && notes[1].contains("1 Gaussians have colours"),
        "{notes:?}"
    );
    let spz = again(&cloud, Format::Spz, &options).cloud;
    assert_eq!(spz.row(0)[channel::LOG_SCALE], [-10.0; 3]);
    let notes = encode(&cloud, Format::Splat, &options).unwrap().notes;
    assert!(notes.len() == 1 && notes[0].contains("1 Gaussians have colours"), "{notes:?}");
    assert!(encode(&object(10), Format::Spz, &options).unwrap().notes.is_empty());
}

#[test]
fn files_are_whole_or_not_there() {
    let folder = tempfile::tempdir().unwrap();
    let cloud = object(20);
    for format in Format::ALL {
        let path = folder.path().join(format!("object.{}", format.extension().to_uppercase()));
        write(&cloud, &path, &WriteOptions::default()).unwrap();
        assert_eq!(read(&path, Frame::Z_UP).unwrap().cloud.len(), 20);
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), Format::ALL.len());
    let before = std::fs::read(folder.path().join("object.SPZ")).unwrap();
    let mut broken = cloud.clone();
    broken.rows_mut()[3] = f32::NAN;
    for format in Format::ALL {
        let path = folder.path().join(format!("object.{}", format.extension().to_uppercase()));
        let error = write(&broken, &path, &WriteOptions::default()).unwrap_err().to_string();
        assert!(error.contains("log-scale 0"), "{error}");
        if format != Format::Ply {
            let error = encode(&Cloud::default(), format, &WriteOptions::default()).unwrap_err().to_string();
            assert!(error.contains("at least one Gaussian"), "{error}");
        }
    }
    assert_eq!(before, std::fs::read(folder.path().join("object.SPZ")).unwrap());
    let error = write(&cloud, &folder.path().join("object.usdz"), &WriteOptions::default()).unwrap_err();
    assert!(matches!(error, FormatError::Unknown { .. }));
    assert!(
        error.to_string().ends_with("expected one of .ply, .splat, .spz, .sog, .glb, .html, found .usdz"),
        "{error}"
    );
    let error = read(&folder.path().join("object"), Frame::Z_UP).unwrap_err().to_string();
    assert!(error.ends_with("found none"), "{error}");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), Format::ALL.len());
}
