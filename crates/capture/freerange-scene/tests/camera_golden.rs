//! Plücker coordinates and view selection against committed vectors.

use freerange_scene::camera::{Camera, SelectionConfig, k_means, plucker, select_views};
use freerange_vectors::{Vectors, json};
use glam::{DMat4, DVec3};
use rand::SeedableRng;

#[test]
fn plucker_coordinates() {
    for case in 0..3 {
        let file = Vectors::read(&format!("flow/plucker{case}.safetensors"));
        let meta = &json(&format!("flow/plucker{case}.json"))["meta"];
        let number = |name: &str| meta[name].as_u64().unwrap();
        let (matrix, k) = (file.doubles("in/viewmat"), file.doubles("in/K"));
        let camera = Camera {
            width: number("W") as u32,
            height: number("H") as u32,
            fx: k[0],
            fy: k[4],
            cx: k[2],
            cy: k[5],
            world_to_camera: DMat4::from_cols_slice(&matrix).transpose(),
        };
        let expected = file.floats("out/plucker_scaled");
        let found = plucker(&camera, number("w") as usize, number("h") as usize);
        assert_eq!(found.len(), expected.len());
        for (f, e) in found.iter().zip(expected) {
            assert!((f - e).abs() < 2e-6, "{case}: {f} {e}");
        }
        for (f, e) in camera.center().to_array().iter().zip(file.floats("out/origin")) {
            assert!((f - f64::from(*e)).abs() < 2e-6);
        }
    }
}

fn centers(name: &str) -> Vec<DVec3> {
    let file = json(&format!("views/{name}.json"));
    let number = |v: &serde_json::Value| v.as_f64().unwrap();
    let point = |c: &serde_json::Value| DVec3::new(number(&c[0]), number(&c[1]), number(&c[2]));
    if let Some(list) = file["centres"].as_array() {
        return list.iter().map(point).collect();
    }
    let view = |m: &serde_json::Value| {
        let rows: Vec<f64> =
            m.as_array().unwrap().iter().flat_map(|r| r.as_array().unwrap().iter().map(number)).collect();
        let matrix = DMat4::from_cols_slice(&rows).transpose();
        matrix.inverse().w_axis.truncate()
    };
    file["viewmats"].as_array().unwrap().iter().map(view).collect()
}

/// The properties that the reference's view checker demands.
#[test]
fn selections_have_the_required_properties() {
    for name in ["cams24_ring", "cams40_jitter"] {
        let centers = centers(name);
        let n = centers.len();
        let mut spread = [0.0; 2];
        for seed in 0..8 {
            let config = SelectionConfig { seed, ..Default::default() };
            let sets = select_views(&centers, DVec3::ZERO, &config).unwrap();
            assert_eq!(
                sets,
                select_views(&centers, DVec3::ZERO, &config).unwrap(),
                "the same seed chooses the same views"
            );
            assert_eq!(sets.labels.len(), n);

            // A fixed point of Lloyd's iteration, and not a bad one.
            let mean = |c: usize| {
                let own: Vec<DVec3> = (0..n).filter(|&i| sets.labels[i] == c).map(|i| centers[i]).collect();
                assert!(!own.is_empty(), "cluster {c} is empty");
                own.iter().sum::<DVec3>() / own.len() as f64
            };
            let means: Vec<DVec3> = (0..4).map(mean).collect();
            let mut inertia = 0.0;
            for (c, &label) in centers.iter().zip(&sets.labels) {
                let own = c.distance_squared(means[label]);
                assert!(means.iter().all(|m| own <= c.distance_squared(*m) + 1e-6));
                inertia += own;
            }
            let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(99);
            assert!(inertia <= 1.6 * k_means(&centers, 4, 40, &mut rng).1);

            let mut clusters: Vec<usize> = sets.full.iter().map(|&i| sets.labels[i]).collect();
            clusters.sort_unstable();
            assert_eq!(clusters, [0, 1, 2, 3], "one view of each cluster");
            let distinct: std::collections::HashSet<usize> = sets.partial.iter().copied().collect();
            assert_eq!(distinct.len(), 4);
            assert!(sets.partial.iter().all(|&i| sets.labels[i] == sets.labels[sets.partial[0]]));

            assert!(!sets.validation.is_empty());
            assert!(sets.validation.iter().all(|i| !sets.full.contains(i) && !sets.partial.contains(i)));
            let seen: Vec<DVec3> = sets.validation.iter().map(|&i| centers[i].normalize()).collect();
            for c in &centers {
                let gap = seen.iter().map(|v| v.angle_between(*c)).fold(f64::INFINITY, f64::min);
                assert!(gap.to_degrees() <= 115.0);
            }
            assert!((seen.iter().sum::<DVec3>() / seen.len() as f64).length() <= 0.75);

            for (views, sum) in [&sets.full, &sets.partial].into_iter().zip(&mut spread) {
                let pairs = views.iter().flat_map(|&a| views.iter().map(move |&b| (a, b))).filter(|(a, b)| a < b);
                *sum += pairs.map(|(a, b)| centers[a].angle_between(centers[b])).fold(f64::INFINITY, f64::min);
            }
        }
        assert!(spread[0] > spread[1], "full views lie farther apart than partial ones");
    }
}

#[test]
fn selections_that_cannot_be_made_are_refused() {
    let ring: Vec<DVec3> = (0..24).map(|i| DVec3::new((i as f64).cos(), (i as f64).sin(), 0.2)).collect();
    let choose = |centers: &[DVec3], config: SelectionConfig| select_views(centers, DVec3::ZERO, &config);
    let default = SelectionConfig::default;
    assert!(choose(&ring, default()).is_ok());
    assert!(choose(&ring[..5], default()).is_err());
    assert!(choose(&ring, SelectionConfig { inputs: 1, ..default() }).is_err());
    assert!(choose(&ring, SelectionConfig { validation: 0, ..default() }).is_err());
    assert!(choose(&[DVec3::X; 24], default()).is_err());
    assert!(choose(&[], default()).is_err());
    let mut broken = ring.clone();
    broken[3] = DVec3::NAN;
    assert!(choose(&broken, default()).is_err());
    broken[3] = DVec3::ZERO;
    assert!(choose(&broken, default()).is_err());
}
