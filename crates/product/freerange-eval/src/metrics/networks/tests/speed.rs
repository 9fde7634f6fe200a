//! How long the networks take at their published sizes:
//! `cargo test --release -p freerange-eval --features networks speed -- --ignored --nocapture`

use std::time::Instant;

use burn::tensor::{Tensor, TensorData};

use super::{Random, device, uniform};
use crate::metrics::networks::{
    Inception, Lpips, LpipsNet,
    dreamsim::{CLIP_B16, DINO_B16, OPEN_CLIP_B16},
    host,
    vit::Vit,
};

fn timed(name: &str, unit: &str, mut f: impl FnMut()) {
    f();
    let start = Instant::now();
    let mut runs = 0;
    while start.elapsed().as_secs_f64() < 3.0 {
        f();
        runs += 1;
    }
    let seconds = start.elapsed().as_secs_f64() / f64::from(runs);
    println!("{name}: {:.0} ms, {:.2} {unit}/s", 1e3 * seconds, 1.0 / seconds);
    assert!(seconds.is_finite());
}

#[test]
#[ignore = "a measurement"]
fn speed() {
    let noise = |side: usize, batch: usize| -> Tensor<4> {
        let values = uniform(side as u64, batch * 3 * side * side, 0.0, 1.0);
        Tensor::from_data(TensorData::new(values, [batch, 3, side, side]), &device())
    };
    for net in [LpipsNet::Alex, LpipsNet::Vgg] {
        let lpips = Lpips::build(net, &mut Random, &mut Random, &device()).unwrap();
        for side in [256, 512] {
            let (a, b) = (noise(side, 1), noise(side, 1).flip([3]));
            timed(&format!("LPIPS {net:?} {side}"), "pairs", || drop(host(lpips.distance(a.clone(), b.clone()))));
        }
    }
    let inception = Inception::build(&mut Random, &device()).unwrap();
    for batch in [1, 2] {
        let x = noise(Inception::SIDE, batch);
        timed(&format!("Inception, batch {batch}"), "batches", || drop(host(inception.features(x.clone()))));
    }
    drop(inception);
    for (name, config) in [("DINO", DINO_B16), ("CLIP", CLIP_B16), ("OpenCLIP", OPEN_CLIP_B16)] {
        let vit = Vit::build(&mut Random, config, &device()).unwrap();
        for batch in [1, 2] {
            let x = noise(224, batch);
            timed(&format!("{name} ViT-B/16, batch {batch}"), "batches", || drop(host(vit.forward(x.clone()))));
        }
    }
}
