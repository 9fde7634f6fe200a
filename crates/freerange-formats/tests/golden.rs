//! Files by other programs' writers (tools/formats/vectors.mjs): the same Gaussians, within what each format can hold.

mod common;

use common::difference;
use freerange_formats::{Frame, Loaded, read};
use freerange_splat::Cloud;
use glam::{DQuat, DVec3};

fn golden(name: &str, frame: Frame) -> Loaded {
    read(&freerange_vectors::path("formats").join(name), frame).unwrap()
}

/// In the order of the source: writers sort.
fn like_source(found: &Cloud) -> (Cloud, Cloud) {
    let source = golden("source.ply", Frame::Z_UP).cloud;
    assert_eq!(source.len(), 270);
    let nearest = |i: usize| {
        let distance = |j: usize| (found.mean(j) - source.mean(i)).length_squared();
        (0..found.len()).min_by(|&a, &b| distance(a).total_cmp(&distance(b))).unwrap()
    };
    let order: Vec<usize> = (0..source.len()).map(nearest).collect();
    let mut seen = order.clone();
    seen.sort_unstable();
    seen.dedup();
    assert_eq!((found.len(), seen.len()), (source.len(), source.len()), "each Gaussian once");
    let found = found.select(order);
    (source, found)
}

const HALF: f64 = 0.5 / 255.0 + 1e-6;

#[test]
fn standard_ply() {
    let loaded = golden("source.ply", Frame::Z_UP);
    assert_eq!(loaded.notes.len(), 1);
    assert!(loaded.notes[0].starts_with("9 properties f_rest_*"), "{:?}", loaded.notes);
}

#[test]
fn compressed_ply() {
    let loaded = golden("source.compressed.ply", Frame::Z_UP);
    assert!(loaded.notes[0].starts_with("9 properties f_rest_*"), "{:?}", loaded.notes);
    let (source, found) = like_source(&loaded.cloud);
    // 10 bits of a chunk's range (0.49 in space, 2 in log-scale, 1.5 in colour), and of the smallest three.
    difference(&source, &found).assert_within(0.49 / 2046.0, 2.0 / 2046.0, 0.005, HALF, 1.5 * HALF);
}

#[test]
fn spz_of_three_versions() {
    // The writer takes -y for up.
    for name in ["v2.spz", "v3.spz", "v4.spz"] {
        let loaded = golden(name, Frame::Y_DOWN);
        assert!(loaded.notes.len() == 1 && loaded.notes[0].starts_with("9 coefficients"), "{:?}", loaded.notes);
        let (source, found) = like_source(&loaded.cloud);
        // 12 bits of fraction; rotations of version 2 have 8 bits of x, y and z, and a w that may be small.
        let rotation = if name == "v2.spz" { 0.24 } else { 0.005 };
        difference(&source, &found).assert_within(0.5 / 4096.0 + 1e-6, 1.0 / 32.0 + 1e-5, rotation, HALF, 0.0037);
    }
    let y_up = golden("v3.spz", Frame::Y_UP).cloud;
    let y_down = golden("v3.spz", Frame::Y_DOWN).cloud;
    assert!((0..270).all(|i| (y_up.mean(i) - y_down.mean(i) * DVec3::new(1.0, -1.0, -1.0)).length() < 1e-6));
}

#[test]
fn sog() {
    let loaded = golden("source.sog", Frame::Z_UP);
    assert!(loaded.notes.len() == 1 && loaded.notes[0].starts_with("shN"), "{:?}", loaded.notes);
    let (source, found) = like_source(&loaded.cloud);
    // The writer cuts off instead of rounding: a whole step.
    difference(&source, &found).assert_within(1e-5, 0.01, 0.033, 2.0 * HALF, 0.005);
}

#[test]
fn glb() {
    let loaded = golden("source.glb", Frame::Y_UP);
    assert!(loaded.notes.len() == 1 && loaded.notes[0].starts_with("SH_DEGREE_1"), "{:?}", loaded.notes);
    // The writer turns half about z.
    let mut cloud = loaded.cloud;
    cloud.transform(1.0, DQuat::from_xyzw(0.0, 0.0, 1.0, 0.0), DVec3::ZERO);
    let (source, found) = like_source(&cloud);
    difference(&source, &found).assert_within(1e-6, 1e-5, 1e-3, 1e-5, 1e-5);
}
