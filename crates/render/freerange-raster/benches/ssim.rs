//! How long the loss of a fit takes, with its gradient. `cargo bench -p freerange-raster --bench ssim`.

use freerange_raster::metrics::photometric_loss;
use std::time::{Duration, Instant};

#[path = "../../../../tools/machine.rs"]
mod machine;

/// Time of a call: the fastest tenth, since other programs may be running.
fn time(mut f: impl FnMut()) -> Duration {
    f();
    let (start, mut times) = (Instant::now(), vec![]);
    while times.len() < 5 || start.elapsed() < Duration::from_secs(1) {
        let t = Instant::now();
        f();
        times.push(t.elapsed());
    }
    times.sort();
    times[times.len() / 10]
}

fn image(size: usize, wave: usize) -> Vec<f32> {
    (0..3 * size * size).map(|i| 0.5 + 0.4 * ((i * wave + i) as f32 * 0.37).sin()).collect()
}

fn main() {
    println!("{}", machine::machine(rayon::current_num_threads()));
    println!("{:12} {:>9} {:>12}", "", "ms", "Mvalues/s");
    for size in [64, 128, 256, 350, 512] {
        let (image, target) = (image(size, 3), image(size, 5));
        let spent = time(|| drop(photometric_loss(&image, &target, size, size, 0.2).expect("two images of one size")));
        let rate = image.len() as f64 / spent.as_secs_f64() * 1e-6;
        println!("{:12} {:9.3} {rate:12.1}", format!("{size} x {size}"), spent.as_secs_f64() * 1e3);
    }
}
