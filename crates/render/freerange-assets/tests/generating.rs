//! Properties of generated objects, lightings and cameras.

use std::collections::{BTreeMap, BTreeSet};

use freerange_assets::generate::{GeneratorConfig, Kind, generate, kind_of};
use freerange_assets::mesh::Texture;
use freerange_assets::render::{
    CameraConfig, Coverage, Lighting, LightingConfig, Scene, orbit_cameras, render, sample_surface,
};
use glam::{Vec2, Vec3};
use proptest::prelude::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

fn rng(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

/// Everything that training sees of a seed, as bytes.
fn read_out(seed: u64) -> (Vec<u8>, Vec<u32>) {
    let mut rng = rng(seed);
    let mesh = generate(seed, &GeneratorConfig::default()).unwrap();
    let scene = Scene::new(mesh, &LightingConfig::default().sample(&mut rng)).unwrap();
    let config = CameraConfig { resolution: 48, ..CameraConfig::default() };
    let pixels = orbit_cameras(2, &mut rng, &config).iter().flat_map(|c| render(&scene, c, 2).into_raw()).collect();
    let points = sample_surface(&scene, 200, &mut rng);
    (pixels, points.iter().flat_map(|p| [p.position, p.color].concat()).map(f32::to_bits).collect())
}

#[test]
fn a_seed_gives_the_same_bytes_again_and_another_seed_others() {
    for seed in 0..8 {
        assert_eq!(read_out(seed), read_out(seed));
        assert_ne!(read_out(seed).0, read_out(seed + 1).0);
    }
}

#[test]
fn every_family_appears_and_shows_only_its_outside() {
    for (kind, _) in GeneratorConfig::default().weights() {
        let config = GeneratorConfig::only(kind);
        let (mut seen, mut wrong) = (0, 0);
        for seed in 0..6 {
            assert_eq!(kind_of(seed, &config).unwrap(), kind);
            let mesh = generate(seed, &config).unwrap();
            let scene = Scene::new(mesh, &Lighting { rays: 1, ..Lighting::default() }).unwrap();
            let cameras = orbit_cameras(6, &mut rng(seed), &CameraConfig { resolution: 40, ..CameraConfig::default() });
            for camera in &cameras {
                let origin = camera.center().as_vec3();
                for i in 0..1600 {
                    let direction = camera.ray_direction(f64::from(i % 40) + 0.5, f64::from(i / 40) + 0.5).as_vec3();
                    if let Some(hit) = scene.intersect(origin, direction) {
                        let [a, b, c] = scene.mesh().corners(hit.triangle as usize);
                        seen += 1;
                        wrong += u32::from((b - a).cross(c - a).dot(direction) > 0.0);
                    }
                }
            }
        }
        assert!(seen > 1000, "{kind:?}: only {seen} hits");
        assert!(wrong * 200 <= seen, "{kind:?}: {wrong} of {seen} rays see the inside of a surface");
    }
}

#[test]
fn surfaces_of_every_family_are_closed_and_have_no_degenerate_triangles() {
    for (kind, _) in GeneratorConfig::default().weights() {
        let config = GeneratorConfig::only(kind);
        for seed in 0..25 {
            let mesh = generate(seed, &config).unwrap();
            // Every edge is passed as often in one direction as in the other. Vertices are told apart by position: the
            // same point before normalization is the same to the bit after it.
            let id = |v: u32| (mesh.positions[v as usize] + Vec3::ZERO).to_array().map(f32::to_bits);
            let mut edges: BTreeMap<_, i32> = BTreeMap::new();
            for (i, t) in mesh.triangles.iter().enumerate() {
                let longest = (0..3)
                    .map(|k| mesh.positions[t[k] as usize].distance(mesh.positions[t[(k + 1) % 3] as usize]))
                    .fold(0.0, f32::max);
                assert!(mesh.area(i) > 1e-7 * longest, "{kind:?} {seed}: triangle {i} of area {}", mesh.area(i));
                for k in 0..3 {
                    let (a, b) = (id(t[k]), id(t[(k + 1) % 3]));
                    *edges.entry((a.min(b), a.max(b))).or_default() += if a < b { 1 } else { -1 };
                }
            }
            let open = edges.values().filter(|&&n| n != 0).count();
            assert!(open == 0, "{kind:?} {seed}: {open} of {} edges are open", edges.len());
        }
    }
}

#[test]
fn families_follow_their_weights() {
    let config = GeneratorConfig::default();
    let total: f32 = config.weights().iter().map(|w| w.1).sum();
    // Unrelated primitives are a minority.
    assert!((config.composition + config.stack) / total <= 0.2);
    let n = 4000u16;
    let kinds: Vec<_> = (0..u64::from(n)).map(|seed| kind_of(seed, &config).unwrap()).collect();
    assert_eq!(kinds.iter().collect::<BTreeSet<_>>().len(), config.weights().len());
    for (kind, weight) in config.weights() {
        let share = kinds.iter().filter(|&&k| k == kind).count() as f32 / f32::from(n);
        assert!((share - weight / total).abs() < 0.03, "{kind:?}: {share} for {}", weight / total);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn objects_are_sound(seed: u64) {
        let mesh = generate(seed, &GeneratorConfig::default()).unwrap();
        prop_assert!(mesh.validate().is_ok());
        prop_assert!((100..60_000).contains(&mesh.triangles.len()), "{} triangles", mesh.triangles.len());
        let reach = mesh.positions.iter().map(|p| p.length()).fold(0.0, f32::max);
        prop_assert!((0.4999..=0.5).contains(&reach), "reach {reach}");
        let lo = mesh.positions.iter().copied().fold(Vec3::MAX, Vec3::min);
        let hi = mesh.positions.iter().copied().fold(Vec3::MIN, Vec3::max);
        prop_assert!((lo + hi).length() < 1e-5);
        for (t, &m) in mesh.triangles.iter().zip(&mesh.triangle_materials) {
            let v = t[0] as usize;
            prop_assert!((mesh.normals[v].length() - 1.0).abs() < 1e-4);
            let c = mesh.materials[usize::from(m)].albedo(mesh.rest[v], mesh.uvs[v]);
            prop_assert!(c.min_element() >= 0.0 && c.max_element() <= 1.0 + 1e-5, "albedo {c}");
        }
    }

    #[test]
    fn configurations_out_of_range_are_refused(share in prop_oneof![Just(f32::NAN), -5.0f32..-0.01, 1.01f32..9.0]) {
        let weight = if share > 1.0 { f32::INFINITY } else { share };
        let wrong = [
            GeneratorConfig { gloss_share: share, ..GeneratorConfig::default() },
            GeneratorConfig { upright_share: 0.7, lying_share: 0.7, ..GeneratorConfig::default() },
            GeneratorConfig { mug: weight, ..GeneratorConfig::default() },
        ];
        for config in &wrong {
            prop_assert!(generate(0, config).is_err(), "{:?}", config);
        }
        let lighting = LightingConfig { default_share: share, ..LightingConfig::default() };
        prop_assert!(lighting.validate().is_err());
        let cameras = CameraConfig { middle_share: f64::from(share), ..CameraConfig::default() };
        prop_assert!(cameras.validate().is_err());
    }
}

#[test]
fn defaults_are_valid_and_unknown_fields_are_refused() {
    assert!(GeneratorConfig::default().validate().is_ok());
    assert!(LightingConfig::default().validate().is_ok());
    assert!(CameraConfig::default().validate().is_ok());
    assert_eq!(serde_json::from_str::<GeneratorConfig>("{}").unwrap(), GeneratorConfig::default());
    assert!(serde_json::from_str::<GeneratorConfig>(r#"{"mugs": 1}"#).is_err());
    assert!(serde_json::from_str::<LightingConfig>(r#"{"moon": 1}"#).is_err());
    let config: CameraConfig = serde_json::from_str(r#"{"coverage": "one_side"}"#).unwrap();
    assert_eq!(config.coverage, Coverage::OneSide);
}

#[test]
fn cameras_frame_the_object_and_cover_what_they_should() {
    for seed in 0..20 {
        let config = CameraConfig::default();
        let around = orbit_cameras(12, &mut rng(seed), &config);
        for c in &around {
            let distance = c.center().length();
            assert!((1.5..=2.0).contains(&distance));
            // The object's center projects near the middle.
            let p = c.world_to_camera.transform_point3(glam::DVec3::ZERO);
            assert!(p.z > 1.4 && p.truncate().length() < 0.021);
        }
        // Stratified in azimuth: some pair of cameras sees opposite sides.
        let least = around
            .iter()
            .flat_map(|a| around.iter().map(move |b| a.center().normalize().dot(b.center().normalize())))
            .fold(1.0, f64::min);
        assert!(least < -0.3, "{least}");
        let side = CameraConfig { coverage: Coverage::OneSide, ..config };
        let side = orbit_cameras(8, &mut rng(seed), &side);
        for (a, b) in side.iter().flat_map(|a| side.iter().map(move |b| (a, b))) {
            assert!(a.center().angle_between(b.center()) < 70.1f64.to_radians());
        }
    }
}

#[test]
fn prints_show_marks_of_several_colors() {
    for kind in [Kind::Carton, Kind::Can, Kind::Pouch, Kind::Book] {
        let mut printed = 0;
        for seed in 0..10 {
            let mesh = generate(seed, &GeneratorConfig::only(kind)).unwrap();
            let rasters = mesh.materials.iter().filter_map(|m| match &m.texture {
                Texture::Print(raster) => Some(raster),
                _ => None,
            });
            for raster in rasters {
                assert!(raster.width() <= 640 && raster.height() <= 640);
                let samples = (0..4096).map(|i| raster.sample(Vec2::new((i % 64) as f32, (i / 64) as f32) / 64.0));
                let colors: BTreeSet<_> = samples.map(|c| (8.0 * c).as_ivec3().to_array()).collect();
                printed += usize::from(colors.len() >= 3);
            }
        }
        assert!(printed >= 10, "{kind:?}: {printed} prints with three colors");
    }
}

#[test]
fn without_prints_an_object_keeps_its_shape_and_the_mean_colors_of_its_prints() {
    let plain = GeneratorConfig { prints: false, ..GeneratorConfig::default() };
    let mut replaced = 0;
    for seed in 0..40 {
        let (with, without) = (generate(seed, &GeneratorConfig::default()).unwrap(), generate(seed, &plain).unwrap());
        assert_eq!(with.positions, without.positions);
        assert_eq!(with.materials.len(), without.materials.len());
        for (a, b) in with.materials.iter().zip(&without.materials) {
            let Texture::Print(raster) = &a.texture else { continue };
            let Texture::Flat(color) = b.texture else { panic!("seed {seed}: {:?}", b.texture) };
            // Half a pixel off the corners, a look-up is a pixel.
            let (w, h) = (raster.width(), raster.height());
            let pixels = (0..w * h).map(|i| Vec2::new((i % w) as f32 + 0.5, (i / w) as f32 + 0.5));
            let sum: Vec3 = pixels.map(|p| raster.sample(p / Vec2::new(w as f32, h as f32))).sum();
            assert!((sum / (w * h) as f32 - color).abs().max_element() < 1e-3, "seed {seed}: {color}");
            replaced += 1;
        }
    }
    assert!(replaced >= 20, "{replaced}");
}
