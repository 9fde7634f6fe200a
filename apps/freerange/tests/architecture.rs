//! `docs/architecture.md` says what a crate must not know. Its manifest is where it would learn of it.

use std::{collections::BTreeMap, fs, path::Path};

/// Each crate, and which of the others it may use. They stand in the road's order: nobody uses what comes later.
const ROOMS: &[(&str, &[&str])] = &[
    ("freerange-core", &[]),
    // Of tests alone: it is nobody's dependency.
    ("freerange-vectors", &[]),
    ("freerange-splat", &["freerange-core"]),
    ("freerange-camera", &["freerange-core"]),
    ("freerange-scene", &["freerange-core", "freerange-camera"]),
    ("freerange-formats", &["freerange-core", "freerange-splat"]),
    (
        "freerange-serve",
        &["freerange-core", "freerange-splat", "freerange-camera", "freerange-scene", "freerange-formats"],
    ),
    ("freerange-hub", &["freerange-core"]),
    ("freerange-raster", &["freerange-camera"]),
    ("freerange-model", &["freerange-core", "freerange-splat"]),
    ("freerange-metrics", &["freerange-core", "freerange-model"]),
    ("freerange-mesh", &["freerange-core"]),
    ("freerange-render", &["freerange-core", "freerange-camera", "freerange-mesh"]),
    ("freerange-generate", &["freerange-core", "freerange-mesh"]),
    ("freerange-surface", &["freerange-core", "freerange-splat", "freerange-camera", "freerange-raster"]),
    (
        "freerange-fit",
        &["freerange-core", "freerange-splat", "freerange-camera", "freerange-raster", "freerange-metrics"],
    ),
    ("freerange-data", &["freerange-core", "freerange-splat", "freerange-camera"]),
    (
        "freerange-build",
        &[
            "freerange-core",
            "freerange-splat",
            "freerange-camera",
            "freerange-raster",
            "freerange-metrics",
            "freerange-mesh",
            "freerange-render",
            "freerange-generate",
            "freerange-fit",
            "freerange-data",
        ],
    ),
    (
        "freerange-flow",
        &[
            "freerange-core",
            "freerange-splat",
            "freerange-camera",
            "freerange-raster",
            "freerange-model",
            "freerange-fit",
            "freerange-data",
        ],
    ),
    // Apart from the training it serves, so that an MPI library can be changed without compiling that again.
    ("freerange-mpi", &["freerange-flow"]),
    ("freerange-nccl", &["freerange-flow"]),
    (
        "freerange",
        &[
            "freerange-core",
            "freerange-splat",
            "freerange-formats",
            "freerange-camera",
            "freerange-scene",
            "freerange-raster",
            "freerange-model",
            "freerange-metrics",
            "freerange-fit",
            "freerange-flow",
        ],
    ),
    (
        "freerange-eval",
        &[
            "freerange-core",
            "freerange-splat",
            "freerange-camera",
            "freerange-raster",
            "freerange-metrics",
            "freerange-mesh",    // the true surface
            "freerange-surface", // the result's
        ],
    ),
    ("freerange-cli", &["*"]),
    (
        "freerange-python",
        &[
            "freerange-camera",
            "freerange-raster",
            "freerange-hub",
            "freerange",
            // For their features alone.
            "freerange-data",
            "freerange-metrics",
        ],
    ),
];

/// Fixes features of shared dependencies; holds no code.
const FEATURES: &str = "workspace-features";

#[test]
fn no_room_knows_what_it_must_not() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let mut found = BTreeMap::new();
    let within = |folder: &str| fs::read_dir(root.join(folder)).unwrap().map(|entry| entry.unwrap().path());
    for folder in within("crates").chain(within("apps")).chain([root.join("python")]) {
        let Ok(text) = fs::read_to_string(folder.join("Cargo.toml")) else { continue };
        let manifest: toml::Table = toml::from_str(&text).unwrap();
        let name = manifest["package"]["name"].as_str().unwrap().to_owned();
        let tables = [manifest.get("dependencies"), manifest.get("build-dependencies")];
        let own = tables.into_iter().flatten().flat_map(|t| t.as_table().unwrap().keys().cloned());
        found.insert(name, own.filter(|d| d.starts_with("freerange")).collect::<Vec<_>>());
    }
    found.remove(FEATURES);
    let names: Vec<&str> = ROOMS.iter().map(|(name, _)| *name).collect();
    let mut listed: Vec<&str> = names.clone();
    listed.sort_unstable();
    assert_eq!(found.keys().map(String::as_str).collect::<Vec<_>>(), listed, "every crate has its place on the road");
    for (place, (name, allowed)) in ROOMS.iter().enumerate() {
        for used in &found[*name] {
            assert!(allowed.contains(&"*") || allowed.contains(&used.as_str()), "{name} must not know {used}");
            assert!(names[..place].contains(&used.as_str()), "{name} comes before {used}");
        }
    }
    let text = fs::read_to_string(root.join("docs/architecture.md")).unwrap();
    for name in names {
        assert!(text.contains(&format!("`{name}`")), "docs/architecture.md says what {name} is");
    }
}
