//! What is written comes back, within what the format can hold.

mod common;

use std::path::Path;

use common::{difference, object};
use freerange_gaussians::formats::{
    Format, FormatError, Frame, Frames, Loaded, SpzVersion, WriteOptions, encode, parse, read, write,
};
use freerange_gaussians::{Gaussians, Harmonics, RenderMode, Splats, channel, coefficients};
use glam::{DMat3, DQuat, DVec3};

/// [`encode`] of Gaussians without more.
fn encode_cloud(cloud: &Gaussians, format: Format, options: &WriteOptions) -> freerange_gaussians::formats::Encoded {
    encode(&cloud.clone().into(), format, options).unwrap()
}

fn again(cloud: &Gaussians, format: Format, options: &WriteOptions) -> Loaded {
    let encoded = encode_cloud(cloud, format, options);
    assert_eq!(encoded, encode_cloud(cloud, format, options), "the same Gaussians give the same bytes");
    parse(format, &encoded.bytes, Path::new("test"), options.frame).unwrap()
}

/// Which Gaussian of `loaded` each of `cloud` is: `.splat` and `.sog` sort.
fn order(cloud: &Gaussians, loaded: &Gaussians) -> Vec<usize> {
    let nearest = |i: usize| {
        let distance = |j: usize| (loaded.mean(j) - cloud.mean(i)).length_squared();
        (0..loaded.len()).min_by(|&a, &b| distance(a).total_cmp(&distance(b))).unwrap()
    };
    (0..cloud.len()).map(nearest).collect()
}

/// In the order of the original.
fn unsorted(cloud: &Gaussians, loaded: &Gaussians) -> Gaussians {
    loaded.select(order(cloud, loaded))
}

#[test]
fn lossless_formats_keep_all_bits() {
    let cloud = object(300);
    for format in [Format::Ply, Format::Html] {
        let found = again(&cloud, format, &WriteOptions::default()).splats.cloud;
        difference(&cloud, &found).assert_within(0.0, 0.0, 1e-7, 0.0, 1.2e-7);
    }
    assert_eq!(again(&cloud, Format::Html, &WriteOptions::default()).splats.cloud, cloud);
}

#[test]
fn lossy_formats_keep_what_their_bits_allow() {
    let cloud = object(700);
    let options = WriteOptions::default();
    let half = 0.5 / 255.0 + 1e-9;
    // 16 bits of the folded range; 8 of the smallest three; codebooks.
    let sog = again(&cloud, Format::Sog, &options).splats.cloud;
    difference(&cloud, &unsorted(&cloud, &sog)).assert_within(0.5 / 65535.0 * 0.57 + 1e-7, 0.01, 0.017, half, 0.005);
    // Seven bits of each component of the rotation.
    let splat = again(&cloud, Format::Splat, &options).splats.cloud;
    difference(&cloud, &unsorted(&cloud, &splat)).assert_within(0.0, 1e-6, 0.017, half, half);
    // Steps of a 2^17th of the object, sixteenths of log-scale, 9 bits and sign of the smallest three.
    for (spz_version, rotation) in [(SpzVersion::V2, 0.18), (SpzVersion::V3, 0.005), (SpzVersion::V4, 0.005)] {
        let spz = again(&cloud, Format::Spz, &WriteOptions { spz_version, ..options }).splats.cloud;
        let color = 0.5 / 255.0 / 0.15 * 0.2821 + 1e-6;
        difference(&cloud, &spz).assert_within(0.5 / 131072.0, 1.0 / 32.0 + 1e-5, rotation, half, color);
    }
    for format in [Format::Glb, Format::Usda, Format::Usdz] {
        let found = again(&cloud, format, &options).splats.cloud;
        difference(&cloud, &found).assert_within(1e-7, 1e-6, 1e-6, 1e-6, 1e-6);
    }
}

#[test]
fn splat_files_begin_with_what_shows_most() {
    let loaded = again(&object(50), Format::Splat, &WriteOptions::default()).splats.cloud;
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
    let cloud = Gaussians::from_rows(row.to_vec());
    for (frame, expected) in
        [(Frame::Z_UP, [0.1, 0.4, -0.2]), (Frame::Y_DOWN, [0.1, -0.2, -0.4]), (Frame::Y_UP, [0.1, 0.2, 0.4])]
    {
        let options = WriteOptions { frame, ..WriteOptions::default() };
        let spz = encode_cloud(&cloud, Format::Spz, &options).bytes;
        let mut raw = Vec::new();
        std::io::Read::read_to_end(&mut flate2::read::GzDecoder::new(&spz[..]), &mut raw).unwrap();
        let unit = f64::from(1u32 << raw[13]);
        for k in 0..3 {
            let at = 16 + 3 * k;
            let fixed = i32::from_le_bytes([0, raw[at], raw[at + 1], raw[at + 2]]) >> 8;
            assert!((f64::from(fixed) / unit - expected[k]).abs() < 1e-5, "{k}");
        }
        let glb = encode_cloud(&cloud, Format::Glb, &options).bytes;
        let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
        let json: serde_json::Value = serde_json::from_slice(&glb[20..20 + length]).unwrap();
        let rotation: [f64; 4] = serde_json::from_value(json["nodes"][0]["rotation"].clone()).unwrap();
        let stored = [0, 1, 2].map(|k| f32::from_le_bytes(glb[28 + length + 4 * k..][..4].try_into().unwrap()).into());
        assert_eq!(stored.map(|v: f64| v as f32), [0.1, 0.2, 0.4], "attributes are in the user's frame");
        let placed = glam::DQuat::from_array(rotation) * DVec3::from_array(stored);
        assert!(placed.abs_diff_eq(DVec3::from_array(expected), 1e-7), "{placed}");
        for format in [Format::Spz, Format::Glb] {
            let bytes = encode_cloud(&cloud, format, &options).bytes;
            // In the frame of the file, and back in the user's.
            let y_up = parse(format, &bytes, Path::new("a"), Frame::Y_UP).unwrap().splats.cloud;
            assert!(y_up.mean(0).abs_diff_eq(DVec3::from_array(expected), 1e-5));
            let back = parse(format, &bytes, Path::new("a"), frame).unwrap().splats.cloud;
            assert!(back.mean(0).abs_diff_eq(cloud.mean(0), 1e-5));
        }
        for format in [Format::Ply, Format::Splat, Format::Sog, Format::Html] {
            let bytes = encode_cloud(&cloud, format, &options).bytes;
            let found = parse(format, &bytes, Path::new("a"), Frame::Y_UP).unwrap().splats.cloud;
            assert!(found.mean(0).abs_diff_eq(cloud.mean(0), 1e-6), "{format} does not turn");
        }
    }
}

#[test]
fn small_and_far_objects_keep_their_shape_in_spz() {
    for (size, shift) in [(1e-3, 0.0), (1.0, 300.0), (200.0, 0.0)] {
        let mut cloud = object(100);
        cloud.transform(size, glam::DQuat::IDENTITY, DVec3::new(shift, 0.0, -shift));
        let loaded = again(&cloud, Format::Spz, &WriteOptions::default()).splats.cloud;
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
    let notes = encode_cloud(&cloud, Format::Spz, &options).notes;
    assert!(
        notes[0].contains("1 Gaussians have standard deviations") && notes[1].contains("1 Gaussians have colors"),
        "{notes:?}"
    );
    let spz = again(&cloud, Format::Spz, &options).splats.cloud;
    assert_eq!(spz.row(0)[channel::LOG_SCALE], [-10.0; 3]);
    let notes = encode_cloud(&cloud, Format::Splat, &options).notes;
    assert!(notes.len() == 1 && notes[0].contains("1 Gaussians have colors"), "{notes:?}");
    assert!(encode_cloud(&object(10), Format::Spz, &options).notes.is_empty());
}

#[test]
fn files_are_whole_or_not_there() {
    let folder = tempfile::tempdir().unwrap();
    let cloud = object(20);
    for format in Format::ALL {
        let path = folder.path().join(format!("object.{}", format.extension().to_uppercase()));
        write(&cloud.clone().into(), &path, &WriteOptions::default()).unwrap();
        assert_eq!(read(&path, Frame::Z_UP).unwrap().splats.cloud.len(), 20);
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), Format::ALL.len());
    let before = std::fs::read(folder.path().join("object.SPZ")).unwrap();
    let mut broken = cloud.clone();
    broken.rows_mut()[3] = f32::NAN;
    for format in Format::ALL {
        let path = folder.path().join(format!("object.{}", format.extension().to_uppercase()));
        let error = write(&broken.clone().into(), &path, &WriteOptions::default()).unwrap_err().to_string();
        assert!(error.contains("log-scale 0"), "{error}");
        if format != Format::Ply {
            let error = encode(&Splats::default(), format, &WriteOptions::default()).unwrap_err().to_string();
            assert!(error.contains("at least one Gaussian"), "{error}");
        }
    }
    assert_eq!(before, std::fs::read(folder.path().join("object.SPZ")).unwrap());
    let error = write(&cloud.clone().into(), &folder.path().join("object.fbx"), &WriteOptions::default()).unwrap_err();
    assert!(matches!(error, FormatError::Unknown { .. }));
    assert!(
        error.to_string().ends_with("expected one of .ply, .splat, .spz, .sog, .glb, .usda, .usdz, .html, found .fbx"),
        "{error}"
    );
    let error = read(&folder.path().join("object"), Frame::Z_UP).unwrap_err().to_string();
    assert!(error.ends_with("found none"), "{error}");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), Format::ALL.len());
}

/// Harmonics of degree `degree` for `n` Gaussians, -0.5 to 0.5.
fn harmonics(degree: usize, n: usize) -> Harmonics {
    let value = |v: usize| 0.5 * (v as f32 * 0.7 + (v * v % 17) as f32).sin();
    Harmonics::from_rows(degree, (0..n * 3 * coefficients(degree)).map(value).collect())
}

fn apart(a: &Harmonics, b: &Harmonics) -> f64 {
    assert_eq!((a.degree(), a.rows().len()), (b.degree(), b.rows().len()));
    a.rows().iter().zip(b.rows()).map(|(a, b)| f64::from((a - b).abs())).fold(0.0, f64::max)
}

#[test]
fn harmonics_survive_in_every_format_that_has_them() {
    for degree in 1..=3 {
        let splats = Splats { harmonics: harmonics(degree, 300), ..object(300).into() };
        for (format, spz_version, within) in [
            (Format::Ply, SpzVersion::V3, 0.0),
            (Format::Glb, SpzVersion::V3, 0.0),
            (Format::Usda, SpzVersion::V3, 0.0),
            (Format::Usdz, SpzVersion::V3, 0.0),
            (Format::Spz, SpzVersion::V2, 0.5 / 128.0 + 1e-6),
            (Format::Spz, SpzVersion::V3, 0.5 / 128.0 + 1e-6),
            (Format::Spz, SpzVersion::V4, 0.5 / 128.0 + 1e-6),
            (Format::Sog, SpzVersion::V3, 0.006),
        ] {
            // In a frame that is not turned; and turned there and back.
            for frame in [Frame::Y_UP, Frame::Z_UP] {
                let options = WriteOptions { frame, spz_version };
                let encoded = encode(&splats, format, &options).unwrap();
                assert!(encoded.notes.is_empty(), "{:?}", encoded.notes);
                let mut found = parse(format, &encoded.bytes, Path::new("a"), frame).unwrap().splats;
                let mut y_up = parse(format, &encoded.bytes, Path::new("a"), Frame::Y_UP).unwrap().splats;
                if format == Format::Sog {
                    let order = order(&splats.cloud, &found.cloud);
                    (found, y_up) = (found.select(&order), y_up.select(&order));
                }
                let turns = frame == Frame::Z_UP && matches!(format, Format::Spz | Format::Glb);
                let within = if turns { 2.5 * within } else { within };
                let off = apart(&splats.harmonics, &found.harmonics);
                assert!(off <= within + 1e-6, "{format}, degree {degree}: {off}");
                // The file's own frame: what is seen from the same side.
                let eye = DVec3::new(3.0, -2.0, 1.0);
                let from = if turns || frame == Frame::Z_UP && matches!(format, Format::Usda | Format::Usdz) {
                    Frame::Z_UP.to(Frame::Y_UP) * eye
                } else {
                    eye
                };
                let (before, after) = (splats.seen_from(eye), y_up.seen_from(from));
                let most = (0..300).map(|i| (before.color(i) - after.color(i)).abs().max_element()).fold(0.0, f64::max);
                assert!(most < 0.01 + 10.0 * within, "{format}, degree {degree}: {most}");
            }
        }
        for format in [Format::Splat, Format::Html] {
            let notes = encode(&splats, format, &WriteOptions::default()).unwrap().notes;
            let said = notes.iter().any(|n| n.contains("viewing direction") && n.contains(&format!("degree {degree}")));
            assert!(said, "{notes:?}");
        }
    }
}

#[test]
fn many_harmonics_share_a_palette() {
    let n = 9000;
    // Few kinds with a little noise each: what a palette can hold.
    let kinds = harmonics(2, 40);
    let noise = harmonics(2, n);
    let row = |i: usize| kinds.row(i * 7 % 40).iter().zip(noise.row(i)).map(|(k, v)| k + 0.01 * v).collect::<Vec<_>>();
    let splats = Splats { harmonics: Harmonics::from_rows(2, (0..n).flat_map(row).collect()), ..object(n).into() };
    let bytes = encode(&splats, Format::Sog, &WriteOptions::default()).unwrap().bytes;
    let found = parse(Format::Sog, &bytes, Path::new("a"), Frame::Z_UP).unwrap().splats;
    let found = found.select(&order(&splats.cloud, &found.cloud));
    let squares = splats.harmonics.rows().iter().zip(found.harmonics.rows()).map(|(a, b)| f64::from((a - b).powi(2)));
    let rms = (squares.sum::<f64>() / splats.harmonics.rows().len() as f64).sqrt();
    assert!(rms < 0.005, "{rms}");
}

#[test]
fn how_to_draw_survives_or_is_said() {
    for mode in [RenderMode::Default, RenderMode::Mip, RenderMode::Flat] {
        let splats = Splats { mode, ..object(20).into() };
        for format in Format::ALL {
            let encoded = encode(&splats, format, &WriteOptions::default()).unwrap();
            let found = parse(format, &encoded.bytes, Path::new("a"), Frame::Z_UP).unwrap().splats.mode;
            assert!(found == mode || encoded.notes.iter().any(|n| n.contains("cannot say so")), "{format} {mode:?}");
            assert!(found == mode || !matches!(format, Format::Ply | Format::Sog), "{format} {mode:?}");
        }
    }
}

#[test]
fn far_objects_keep_their_shape() {
    let near: Splats = object(100).into();
    let mut far = near.clone();
    far.origin = DVec3::new(-3_959_505.0, 3_699_979.0, 3_350_245.0);
    for format in Format::ALL {
        for frame in [Frame::Z_UP, Frame::Y_UP] {
            let encoded = encode(&far, format, &WriteOptions { frame, ..WriteOptions::default() }).unwrap();
            let found = parse(format, &encoded.bytes, Path::new("a"), frame).unwrap().splats;
            let found = if format == Format::Splat {
                Splats { cloud: unsorted(&near.cloud, &found.cloud), ..found }
            } else {
                found
            };
            let off = (0..100).map(|i| (found.cloud.mean(i) + found.origin - far.origin - near.cloud.mean(i)).length());
            let told = encoded.notes.iter().any(|n| n.contains("3350245"));
            if matches!(format, Format::Ply | Format::Glb | Format::Usda | Format::Usdz) {
                assert!(off.fold(0.0, f64::max) < 1e-6 && !told, "{format}");
            } else {
                assert!(told && found.origin == DVec3::ZERO, "{format}: {:?}", encoded.notes);
            }
        }
    }
}

#[test]
fn spz_heeds_what_the_user_or_the_file_says_of_its_axes() {
    let cloud = object(50);
    let keep = WriteOptions { frame: Frame::Y_UP, spz_version: SpzVersion::V4 };
    let bytes = encode_cloud(&cloud, Format::Spz, &keep).bytes;
    // A record between header and table: its flag, the table's place.
    let record = [0xadbe_0003u32, 4, 4].map(u32::to_le_bytes).concat();
    assert_eq!((bytes[14] & 2, bytes[16], &bytes[32..44]), (2, 44, &record[..]));
    assert!(parse(Format::Spz, &bytes, Path::new("a"), Frame::Z_UP).unwrap().notes.is_empty());
    // 16 coordinate systems, of which half are mirrored.
    let at = 40;
    for system in 0..=16u8 {
        let mut bytes = bytes.clone();
        bytes[at] = system;
        let found = parse(Format::Spz, &bytes, Path::new("a"), Frame::Y_UP).unwrap().splats.cloud;
        let axes = reference_axes(system);
        for i in 0..50 {
            assert!(found.mean(i).abs_diff_eq(axes * cloud.mean(i), 1e-5), "{system}");
            assert!(found.covariance(i).abs_diff_eq(axes * cloud.covariance(i) * axes.transpose(), 2e-4), "{system}");
        }
    }
    let mut unknown = bytes.clone();
    unknown[at] = 17;
    let error = parse(Format::Spz, &unknown, Path::new("a"), Frame::Y_UP).unwrap_err().to_string();
    assert!(error.contains("coordinate system: expected 0 to 16, found 17"), "{error}");
    unknown[at - 8] = 9; // another extension
    let notes = parse(Format::Spz, &unknown, Path::new("a"), Frame::Y_UP).unwrap().notes;
    assert!(
        notes[0].contains("extension 0xadbe0009 (4 bytes) is left out") && notes[1].contains("--frame"),
        "{notes:?}"
    );

    // Versions 2 and 3 tell nothing: +y up, unless the user says otherwise. Our own are known by the time in the gzip header.
    for spz_version in [SpzVersion::V2, SpzVersion::V3] {
        for mode in [RenderMode::Default, RenderMode::Mip] {
            let splats = Splats { mode, ..cloud.clone().into() };
            let bytes = encode(&splats, Format::Spz, &WriteOptions { spz_version, ..keep }).unwrap().bytes;
            let found = parse(Format::Spz, &bytes, Path::new("a"), Frame::Y_UP).unwrap();
            assert!(found.notes.is_empty() && found.splats.mode == mode, "{:?}", found.notes);
        }
    }
    let mut bytes = encode_cloud(&cloud, Format::Spz, &WriteOptions { spz_version: SpzVersion::V3, ..keep }).bytes;
    bytes[4..8].fill(0);
    let notes = parse(Format::Spz, &bytes, Path::new("a"), Frame::Y_UP).unwrap().notes;
    assert!(notes.len() == 1 && notes[0].contains("--frame y-down:z-up"), "{notes:?}");
    let found = parse(Format::Spz, &bytes, Path::new("a"), "y-down:z-up".parse::<Frames>().unwrap()).unwrap();
    assert!(found.notes.is_empty(), "{:?}", found.notes);
    let turn = Frame::Y_DOWN.to(Frame::Z_UP);
    assert!((0..50).all(|i| found.splats.cloud.mean(i).abs_diff_eq(turn * cloud.mean(i), 1e-5)));
}

/// What the reference library does to get from a coordinate system to right, up, back (its tables, by their numbers).
fn reference_axes(system: u8) -> DMat3 {
    let letters = [
        "RUB", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LBD", "RBD", "LBU", "RBU", "LFD", "RFD", "LFU",
        "RFU",
    ][usize::from(system)];
    let direction = |c: char| match c {
        'R' => DVec3::X,
        'L' => -DVec3::X,
        'U' => DVec3::Y,
        'D' => -DVec3::Y,
        'B' => DVec3::Z,
        _ => -DVec3::Z,
    };
    let columns: Vec<DVec3> = letters.chars().map(direction).collect();
    let meant = DMat3::from_cols(columns[0], columns[1], columns[2]);
    let half_turn = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    if ["LFD", "RFD", "LBU", "RBU"].contains(&letters) { half_turn * meant } else { meant }
}

#[test]
fn a_ply_tells_which_way_is_up() {
    let splats: Splats = object(10).into();
    let options = WriteOptions { frame: Frame::Y_DOWN, ..WriteOptions::default() };
    let ply = encode(&splats, Format::Ply, &options).unwrap().bytes;
    // Nobody says otherwise: it is in its own frame, which is known.
    let loaded = parse(Format::Ply, &ply, Path::new("a"), Frames::default()).unwrap();
    assert!(loaded.frame.up().abs_diff_eq(-DVec3::Y, 1e-12));
    difference(&splats.cloud, &loaded.splats.cloud).assert_within(0.0, 0.0, 1e-7, 0.0, 1.2e-7);
    // The user does.
    let loaded = parse(Format::Ply, &ply, Path::new("a"), Frame::Z_UP).unwrap();
    assert!(loaded.frame == Frame::Z_UP);
    difference(&splats.cloud, &loaded.splats.cloud).assert_within(0.0, 0.0, 1e-7, 0.0, 1.2e-7);
    let loaded = parse(Format::Ply, &ply, Path::new("a"), "y-down:y-up".parse::<Frames>().unwrap()).unwrap();
    let half_turn = DQuat::from_rotation_x(std::f64::consts::PI);
    assert!((0..10).all(|i| loaded.splats.cloud.mean(i).abs_diff_eq(half_turn * splats.cloud.mean(i), 1e-6)));
}

#[test]
fn stages_say_where_they_are_and_how_large() {
    let splats: Splats = object(30).into();
    for (frame, up) in [(Frame::Z_UP, "Z"), (Frame::Y_UP, "Y"), (Frame::Y_DOWN, "Y")] {
        let options = WriteOptions { frame, ..WriteOptions::default() };
        let text = String::from_utf8(encode(&splats, Format::Usda, &options).unwrap().bytes).unwrap();
        assert!(text.contains(&format!("upAxis = \"{up}\"")) && text.contains("sphericalHarmonicsDegree = 0"));
        let found = parse(Format::Usda, text.as_bytes(), Path::new("a"), frame).unwrap().splats.cloud;
        difference(&splats.cloud, &found).assert_within(1e-6, 1e-6, 1e-6, 1e-6, 1e-6);
        // Three deviations of every Gaussian.
        let line = text.lines().find_map(|l| l.trim().strip_prefix("float3[] extent = [(")).unwrap();
        let corners: Vec<f64> =
            line.trim_end_matches(")]").replace("), (", ", ").split(", ").map(|v| v.parse().unwrap()).collect();
        let turned =
            parse(Format::Usda, text.as_bytes(), Path::new("a"), if up == "Z" { Frame::Z_UP } else { Frame::Y_UP });
        let cloud = turned.unwrap().splats.cloud;
        let least =
            (0..30).map(|i| cloud.mean(i).x - 3.0 * cloud.covariance(i).x_axis.x.sqrt()).fold(f64::INFINITY, f64::min);
        assert!(corners.len() == 6 && (corners[0] - least).abs() < 1e-5 && corners[3] > corners[0]);
    }
    let archive = encode(&splats, Format::Usdz, &WriteOptions::default()).unwrap().bytes;
    let start = archive.windows(9).position(|w| w == b"#usda 1.0").unwrap();
    assert_eq!(start % 64, 0, "data are aligned, and stored as they are");
}
