//! Files by other programs' writers (`vectors.mjs` and its neighbors in tools/formats): the same Gaussians, within what
//! each format can hold.

mod common;

use common::difference;
use freerange_gaussians::Splats;
use freerange_gaussians::formats::{Frame, Loaded, read};
use glam::{DQuat, DVec3};

fn golden(name: &str, frame: Frame) -> Loaded {
    read(&freerange_vectors::path("formats").join(name), frame).unwrap()
}

/// In the order of the source: writers sort.
fn like_source(found: &Splats) -> (Splats, Splats) {
    let source = golden("source.ply", Frame::Z_UP).splats;
    assert_eq!(source.cloud.len(), 270);
    let nearest = |i: usize| {
        let distance = |j: usize| (found.cloud.mean(j) - source.cloud.mean(i)).length_squared();
        (0..found.cloud.len()).min_by(|&a, &b| distance(a).total_cmp(&distance(b))).unwrap()
    };
    let order: Vec<usize> = (0..source.cloud.len()).map(nearest).collect();
    let mut seen = order.clone();
    seen.sort_unstable();
    seen.dedup();
    assert_eq!((found.cloud.len(), seen.len()), (source.cloud.len(), source.cloud.len()), "each Gaussian once");
    let found = found.select(&order);
    (source, found)
}

/// Harmonics of degree 1, within `limit` of the source's.
fn assert_harmonics(source: &Splats, found: &Splats, limit: f32) {
    let apart = apart(source, found);
    assert!(apart.iter().all(|v| *v <= limit), "{:?}", apart.iter().copied().reduce(f32::max));
    let size = source.harmonics.rows().iter().map(|v| v.abs()).fold(0.0, f32::max);
    assert!(size > 5.0 * limit, "{size}: the comparison tells nothing");
}

fn apart(source: &Splats, found: &Splats) -> Vec<f32> {
    assert_eq!((source.harmonics.degree(), found.harmonics.degree()), (1, 1));
    source.harmonics.rows().iter().zip(found.harmonics.rows()).map(|(a, b)| (a - b).abs()).collect()
}

const HALF: f64 = 0.5 / 255.0 + 1e-6;

#[test]
fn standard_ply() {
    let loaded = golden("source.ply", Frame::Z_UP);
    assert_eq!((loaded.notes, loaded.splats.harmonics.degree()), (Vec::new(), 1));
}

#[test]
fn compressed_ply() {
    let loaded = golden("source.compressed.ply", Frame::Z_UP);
    assert!(loaded.notes.is_empty(), "{:?}", loaded.notes);
    let (source, found) = like_source(&loaded.splats);
    // 10 bits of a chunk's range (0.49 in space, 2 in log-scale, 1.5 in color), and of the smallest three.
    let difference = difference(&source.cloud, &found.cloud);
    difference.assert_within(0.49 / 2046.0, 2.0 / 2046.0, 0.005, HALF, 1.5 * HALF);
    // 256 steps from -4 to 4.
    assert_harmonics(&source, &found, 0.5 * 8.0 / 256.0 + 1e-6);
}

#[test]
fn spz_of_three_versions() {
    // The writer takes -y for up.
    for name in ["v2.spz", "v3.spz", "v4.spz"] {
        let loaded = golden(name, Frame::Y_DOWN);
        assert!(loaded.notes.len() == 1 && loaded.notes[0].contains("does not tell its axes"), "{:?}", loaded.notes);
        let (source, found) = like_source(&loaded.splats);
        // 12 bits of fraction; rotations of version 2 have 8 bits of x, y and z, and a w that may be small.
        let rotation = if name == "v2.spz" { 0.24 } else { 0.005 };
        let difference = difference(&source.cloud, &found.cloud);
        difference.assert_within(0.5 / 4096.0 + 1e-6, 1.0 / 32.0 + 1e-5, rotation, HALF, 0.0037);
        // 8 bits, then 5 of them.
        assert_harmonics(&source, &found, 4.5 / 128.0 + 1e-6);
    }
    let y_up = golden("v3.spz", Frame::Y_UP).splats.cloud;
    let y_down = golden("v3.spz", Frame::Y_DOWN).splats.cloud;
    assert!((0..270).all(|i| (y_up.mean(i) - y_down.mean(i) * DVec3::new(1.0, -1.0, -1.0)).length() < 1e-6));
}

#[test]
fn sog() {
    let loaded = golden("source.sog", Frame::Z_UP);
    assert!(loaded.notes.is_empty(), "{:?}", loaded.notes);
    let (source, found) = like_source(&loaded.splats);
    // The writer cuts off instead of rounding: a whole step.
    difference(&source.cloud, &found.cloud).assert_within(1e-5, 0.01, 0.033, 2.0 * HALF, 0.005);
    // A palette of 256 for 270 Gaussians: most are as they were.
    let apart = apart(&source, &found);
    let exact = apart.iter().filter(|v| **v < 0.01).count();
    assert!(exact > apart.len() * 8 / 10, "{exact} of {}", apart.len());
}

#[test]
fn glb() {
    for name in ["source.glb", "transform.glb"] {
        let mut loaded = golden(name, Frame::Y_UP);
        assert!(loaded.notes.is_empty(), "{:?}", loaded.notes);
        // The writer turns half about z.
        loaded.splats.transform(1.0, DQuat::from_xyzw(0.0, 0.0, 1.0, 0.0), DVec3::ZERO);
        let (source, found) = like_source(&loaded.splats);
        difference(&source.cloud, &found.cloud).assert_within(1e-6, 1e-5, 1e-3, 1e-5, 1e-5);
        assert_harmonics(&source, &found, 1e-5);
    }
}

#[test]
fn usd_by_its_own_writer() {
    // tools/formats/usd_vectors.py: two prims move the Gaussians, a turn by 90 degrees about x, a scale of 2, a step.
    let mut loaded = golden("placed.usdz", Frame::Y_UP);
    assert!(loaded.notes.is_empty(), "{:?}", loaded.notes);
    let turn = DQuat::from_rotation_x(-std::f64::consts::FRAC_PI_2);
    loaded.splats.transform(0.5, turn, turn * DVec3::new(-0.5, -1.0, -1.5));
    let (source, found) = like_source(&loaded.splats);
    difference(&source.cloud, &found.cloud).assert_within(1e-6, 1e-5, 1e-3, 1e-5, 1e-5);
    assert_harmonics(&source, &found, 1e-5);

    // 16 bits, no harmonics, +z up as nothing else here.
    let loaded = golden("half.usda", Frame::Z_UP);
    assert!(loaded.notes.is_empty() && loaded.splats.harmonics.degree() == 0, "{:?}", loaded.notes);
    let (source, found) = like_source(&loaded.splats);
    difference(&source.cloud, &found.cloud).assert_within(2e-4, 1e-3, 2e-3, 5e-4, 1e-3);
}

/// The newest writers of November 2026: splat-transform 3.7.0 (`transform`), gsply 0.4.6, gaussforge 0.6.0.
#[test]
fn newest_writers() {
    // Position, log-scale, rotation in radians, opacity, color; harmonics, where the file has them exactly enough. All of
    // them copy the numbers of the .ply into .spz.
    let spz = (0.5 / 4096.0 + 1e-6, 1.0 / 32.0 + 1e-5, 0.005, HALF, 0.0037, Some(4.5 / 128.0 + 1e-6));
    let chunks = (0.49 / 2046.0, 2.0 / 2046.0, 0.005, HALF, 1.5 * HALF, Some(0.5 * 8.0 / 256.0 + 1e-6));
    for (name, frame, limits) in [
        ("transform.compressed.ply", Frame::Z_UP, chunks),
        // Some harmonics are wrong in the file: splat-transform reads the same.
        ("gaussforge.compressed.ply", Frame::Z_UP, (chunks.0, chunks.1, chunks.2, chunks.3, chunks.4, None)),
        ("transform-v3.spz", Frame::Y_UP, spz),
        ("transform-v4.spz", Frame::Y_UP, spz),
        ("gsply-v3.spz", Frame::Y_UP, spz),
        ("gsply-v4.spz", Frame::Y_UP, spz),
        ("gaussforge.spz", Frame::Y_UP, spz),
        ("gaussforge.splat", Frame::Z_UP, (1e-6, 1e-5, 0.03, 2.0 * HALF, 2.0 * HALF, None)),
        ("transform.sog", Frame::Z_UP, (1e-5, 0.01, 0.033, 2.0 * HALF, 0.005, None)),
        ("gaussforge.sog", Frame::Z_UP, (1e-5, 0.01, 0.033, 2.0 * HALF, 0.005, None)),
    ] {
        let (position, scale, rotation, opacity, color, harmonics) = limits;
        let (source, found) = like_source(&golden(name, frame).splats);
        eprintln!("{name}"); // for a failure's sake
        difference(&source.cloud, &found.cloud).assert_within(position, scale, rotation, opacity, color);
        if let Some(limit) = harmonics {
            assert_harmonics(&source, &found, limit);
        }
    }
}
