//! How fast training objects stream from shards. `cargo bench -p freerange-data --bench stream -- [FOLDER or URL]`.
//!
//! Without FOLDER, 64 generated objects of the size that `configs/tiny.toml` trains on (8 views of 96 x 96 pixels, depths 8 and
//! 10) are built in a temporary one, as WebP and as PNG. A local folder is in the system's cache after the first pass.

use std::sync::Arc;
use std::time::Instant;

use freerange_assets::render::CameraConfig;
use freerange_data::build::{BuildConfig, BuildOptions, Items, ObjectConfig, ShardConfig, build};
use freerange_data::{ImageFormat, ObjectSource, Shards, Store, Stream};

#[path = "../../../../tools/machine.rs"]
mod machine;

/// Objects that `tiny` training takes per second at its fastest: 2 per step, 2.35 steps/s (docs/benchmarks.md).
const TINY: f64 = 4.7;

fn main() {
    println!("{}", machine::machine(rayon::current_num_threads()));
    println!("{:24} {:>8} {:>8} {:>11} {:>9} {:>8}", "", "MB/object", "threads", "objects/s", "MB/s", "x tiny");
    let given = std::env::args().skip(1).find(|a| a != "--bench");
    if let Some(place) = given {
        let store = Store::open(&place).expect("a folder or URL of shards");
        measure(&place, &store);
        return;
    }
    for images in [ImageFormat::Webp, ImageFormat::Png] {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let store = Store::local(folder.path());
        let config = BuildConfig {
            depths: vec![8, 10],
            shard: ShardConfig { images, held_out: 0, validation: 0.0, test: 0.0, ..ShardConfig::default() },
            object: ObjectConfig {
                views: 8,
                cameras: CameraConfig { resolution: 96, ..CameraConfig::default() },
                ..ObjectConfig::default()
            },
            ..BuildConfig::default()
        };
        build(&config, &Items::generated(64, 0), &store, &BuildOptions::default(), |_| ()).expect("shards");
        measure(images.ending(), &store);
    }
}

fn measure(name: &str, store: &Store) {
    let depths = shards(store, &[]).manifest().plan.config.depths().to_vec();
    for threads in [1, 2] {
        let source = shards(store, &depths);
        let bytes: u64 = (0..source.len() as u64).map(|i| source.object_size(i)).sum();
        let per_object = bytes as f64 / source.len() as f64 / 1e6;
        (0..source.len() as u64).for_each(|i| drop(source.object(i).expect("an object")));
        let mut stream = Stream::start(Arc::new(source), 0, threads);
        let (start, mut count) = (Instant::now(), 0);
        while start.elapsed().as_secs_f64() < 3.0 {
            stream.take_next().expect("an object");
            count += 1;
        }
        let rate = f64::from(count) / start.elapsed().as_secs_f64();
        println!(
            "{name:24} {per_object:>8.3} {threads:>8} {rate:>11.1} {:>9.1} {:>8.0}",
            rate * per_object,
            rate / TINY
        );
    }
}

fn shards(store: &Store, depths: &[u32]) -> Shards {
    Shards::open(store, depths, None).expect("shards of these depths")
}
