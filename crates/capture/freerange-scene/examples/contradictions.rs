//! What tells right poses from wrong ones: prints the evidence of generated scenes, with the poses right and wrong in several ways.
//!
//! `cargo run --release -p freerange-scene --example contradictions -- FIRST_SEED SCENES [FOLDER [KINDS]]`: photos are written into
//! FOLDER; KINDS are some of right, mixed, shifted, swapped, turned30.

use std::f64::consts::TAU;

use freerange_scene::camera::View;
use freerange_scene::estimate::{Compared, Hints, contradictions, overlap, unjudged};
use glam::{DMat4, DQuat, DVec3};
use rand::{SeedableRng, seq::SliceRandom};
use rand_chacha::ChaCha8Rng;

#[path = "../tests/tabletop/mod.rs"]
mod tabletop;

/// The views under other poses.
fn under(views: &[View], order: &[usize]) -> Vec<View> {
    let mut out: Vec<View> = views.to_vec();
    for (i, j) in order.iter().enumerate() {
        // The image's own intrinsics: only the pose is another's.
        out[i].camera.world_to_camera = views[*j].camera.world_to_camera;
    }
    out
}

fn turned(views: &[View], which: usize, degrees: f64) -> Vec<View> {
    let mut out = views.to_vec();
    let turn = DMat4::from_quat(DQuat::from_axis_angle(DVec3::Z, degrees.to_radians()));
    out[which].camera.world_to_camera *= turn;
    out
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |i: usize| arguments[i].parse::<u64>().expect("a number");
    for seed in number(0)..number(0) + number(1) {
        let (count, turn) = [(8, TAU), (8, TAU), (5, TAU), (12, TAU), (8, 2.5), (6, 4.0)][(seed % 6) as usize];
        let scene = tabletop::tabletop(seed, count, turn, (320, 240));
        if let Some(folder) = arguments.get(2) {
            for v in scene.views.iter().take(2) {
                v.image.save(format!("{folder}/{seed}-{}.png", v.name)).expect("a folder");
            }
        }
        let mut order: Vec<usize> = (0..count).collect();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        while order.iter().enumerate().any(|(i, j)| i == *j) {
            order.shuffle(&mut rng);
        }
        let shifted: Vec<usize> = (0..count).map(|i| (i + 1) % count).collect();
        let mut swapped: Vec<usize> = (0..count).collect();
        swapped.swap(0, count / 2);
        let v = &scene.views;
        let all = [
            ("right", v.clone()),
            ("mixed", under(v, &order)),
            ("shifted", under(v, &shifted)),
            ("swapped", under(v, &swapped)),
            ("turned30", turned(v, 1, 30.0)),
        ];
        // True masks, and one of them in another's place.
        let cut = |order: &[usize]| -> Vec<View> {
            let same = |i: usize| v[i].image.dimensions() == v[order[i]].image.dimensions();
            (0..count)
                .map(|i| {
                    let mut view = v[i].clone();
                    let mask = &scene.alone[if same(i) { order[i] } else { i }];
                    view.image.pixels_mut().zip(mask.pixels()).for_each(|(p, m)| p[3] = m[3]);
                    view
                })
                .collect()
        };
        let own: Vec<usize> = (0..count).collect();
        let replaced: Vec<usize> = (0..count).map(|i| if i == 2 { (2 + count / 2) % count } else { i }).collect();
        let beside: Vec<usize> = (0..count).map(|i| if i == 2 { 3 } else { i }).collect();
        for (name, order) in
            [("masks right", &own), ("one replaced", &replaced), ("by the next", &beside), ("two swapped", &swapped)]
        {
            let found = contradictions(&cut(order), DVec3::ZERO, 0.75);
            let told: Vec<String> = found.iter().map(|c| format!("{c:.3}")).collect();
            println!("{seed}\t{name}\t{}", told.join(" "));
        }
        let wanted = |name: &str| arguments.get(3).is_none_or(|list| list.split(',').any(|n| n == name));
        for (name, views) in all.into_iter().filter(|(name, _)| wanted(name)) {
            let began = std::time::Instant::now();
            let found = match unjudged(&views, &Hints::default()) {
                Ok(found) => found,
                Err(e) => {
                    println!("{seed}\t{name}\tREFUSED\t{e}");
                    continue;
                }
            };
            let shares: Vec<f64> = (found.alpha.iter().zip(&scene.alone))
                .map(|(a, b)| {
                    let solid: Vec<bool> = a.iter().map(|a| *a >= 128).collect();
                    overlap(&solid, &b.pixels().map(|p| p[3] >= 128).collect::<Vec<_>>())
                })
                .collect();
            let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
            let least = |v: &[f64]| v.iter().copied().fold(1.0, f64::min);
            let e = &found.evidence;
            let show =
                |c: Option<Compared>| c.map_or("-".into(), |c| format!("{:.3} {:.3} {:.3}", c.own, c.others, c.least));
            println!(
                "{seed}\t{name}\tagree {:.3} {:.3}\tclear {:.3}\tsurface {}\ttable {}\toutline {}\tup {}\tIoU {:.3} {:.3}\t{:.1}s\t{}",
                mean(&found.agreement),
                least(&found.agreement),
                mean(&found.clearness),
                show(e.surface),
                show(e.table),
                show(e.outline),
                found.up.is_some(),
                mean(&shares),
                least(&shares),
                began.elapsed().as_secs_f64(),
                scene.what
            );
        }
    }
}
