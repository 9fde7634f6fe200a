//! Scanned objects, where they are there.

use std::path::PathBuf;

use freerange_assets::mesh::{LoadLimits, Texture, load_mesh};

#[test]
#[ignore = "needs FREERANGE_SHARED"]
fn every_scanned_object_loads() {
    let folder = PathBuf::from(std::env::var("FREERANGE_SHARED").unwrap()).join("objects");
    let mut loaded = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|e| e != "glb") {
            continue;
        }
        let object = load_mesh(&path, &LoadLimits::default()).unwrap();
        let mesh = &object.mesh;
        assert!(!mesh.triangles.is_empty(), "{path:?}");
        assert!(matches!(&mesh.materials[0].texture, Texture::Image(map) if map.picture.width() > 1), "{path:?}");
        let radius = mesh.positions.iter().map(|p| p.length()).fold(0.0, f32::max);
        assert!((radius - 0.5).abs() < 1e-5, "{path:?}: {radius}");
        mesh.validate().unwrap();
        loaded += 1;
    }
    assert!(loaded >= 20, "{loaded}");
}
