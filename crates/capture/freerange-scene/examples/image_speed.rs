//! Times the image helpers on a 512 x 512 image: `cargo run --release -p freerange-scene --example image_speed`.

use freerange_scene::camera::image_ops::{composite, resize_area, to_f32_rgba};
use image::{Rgba, RgbaImage};

fn time<T>(name: &str, f: impl Fn() -> T) {
    let mut best = f64::MAX;
    for _ in 0..20 {
        let start = std::time::Instant::now();
        std::hint::black_box(f());
        best = best.min(start.elapsed().as_secs_f64());
    }
    println!("{name}: {:.2} ms", 1e3 * best);
}

fn main() {
    let image = RgbaImage::from_fn(512, 512, |x, y| Rgba([x as u8, y as u8, (x ^ y) as u8, (x + y) as u8]));
    time("composite", || composite(&image, [1.0; 3]));
    time("to_f32_rgba", || to_f32_rgba(&image));
    for side in [64, 224, 256, 1024] {
        time(&format!("resize_area to {side} x {side}"), || resize_area(&image, side, side));
    }
}
