//! Times the training loss on a 512 x 512 image: `cargo run --release -p freerange-raster --example ssim_speed`.
//! `RAYON_NUM_THREADS=1` gives the time on one core.

fn main() {
    let (w, h) = (512, 512);
    let image = |k: usize| (0..3 * w * h).map(|i| ((i * k) % 251) as f32 / 251.0).collect::<Vec<f32>>();
    let (a, b) = (image(7), image(11));
    let mut best = f64::MAX;
    for _ in 0..20 {
        let start = std::time::Instant::now();
        let (loss, gradient) = freerange_raster::metrics::photometric_loss(&a, &b, w, h, 0.2).expect("equal sizes");
        best = best.min(start.elapsed().as_secs_f64());
        assert!(loss.is_finite() && gradient.len() == a.len());
    }
    println!("photometric_loss with gradient, 512 x 512 x 3: {:.1} ms", 1e3 * best);
}
