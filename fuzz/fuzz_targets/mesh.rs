//! Any bytes as a mesh file: an error, or a mesh that is valid and within its limits.
#![no_main]

use freerange_assets::mesh::{LoadLimits, MeshFormat, load_mesh_bytes};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let Some((&format, file)) = data.split_first() else { return };
    let format = match format {
        b'g' => MeshFormat::Gltf,
        b'o' => MeshFormat::Obj,
        b'p' => MeshFormat::Ply,
        _ => return,
    };
    let limits = LoadLimits {
        max_file_bytes: 1 << 20,
        max_json_items: 10_000,
        max_vertices: 20_000,
        max_triangles: 10_000,
        max_texture_side: 256,
        max_texture_pixels: 1 << 16,
        up: None,
    };
    if let Ok(loaded) = load_mesh_bytes(format, file, &limits) {
        let mesh = &loaded.mesh;
        mesh.validate().expect("a valid mesh");
        assert!(mesh.triangles.len() <= limits.max_triangles);
        assert!(mesh.positions.iter().all(|p| p.length() <= 0.5));
        assert!(mesh.normals.iter().all(|n| (n.length() - 1.0).abs() < 1e-3));
        assert!(loaded.canonical_from_file.is_finite());
    }
});
