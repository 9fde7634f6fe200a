//! How long the level-of-detail tree takes: `cargo run --release -p freerange-gaussians --example tree_speed`.

use freerange_gaussians::{Alignment, Gaussians, LodTree};
use rand::{Rng, SeedableRng};
use std::time::Instant;

fn main() {
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
    for leaves in [2048, 4096, 8192, 16384] {
        let row =
            |rng: &mut rand_chacha::ChaCha8Rng| std::array::from_fn::<f32, 14, _>(|_| rng.random_range(-1.0..1.0));
        let cloud = Gaussians::from_rows((0..leaves).flat_map(|_| row(&mut rng)).collect());
        for alignment in [Alignment::None, Alignment::Identity, Alignment::Parent] {
            let mut best = [f64::INFINITY; 2];
            for _ in 0..20 {
                let start = Instant::now();
                let tree = LodTree::build(&cloud, alignment).expect("valid cloud");
                best[0] = best[0].min(start.elapsed().as_secs_f64());
                let start = Instant::now();
                std::hint::black_box(tree.slice(tree.depth_max() - 1).expect("a complete level"));
                best[1] = best[1].min(start.elapsed().as_secs_f64());
            }
            let [build, slice] = best.map(|s| s * 1e3);
            println!("{leaves} leaves, {alignment:?}: build {build:.2} ms, slice of half as many {slice:.2} ms");
        }
    }
}
