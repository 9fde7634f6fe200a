//! What many photos take of memory: each is decoded once, few at a time, and held once, at the size that is used. One test, since the
//! allocator counts for the whole process.

use std::{
    alloc::{GlobalAlloc, Layout, System},
    f64::consts::TAU,
    fs,
    path::Path,
    sync::atomic::{AtomicUsize, Ordering::Relaxed},
};

use freerange_scene::{
    LoadConfig, Loaded, MaskKind,
    camera::{Camera, transforms_json},
    estimate::{Hints, unjudged_keeping},
    load,
    read::{Cameras, cameras},
};
use glam::DVec3;
use image::{Rgb, RgbImage};

mod tabletop;

/// The system's allocator, which counts the bytes that are held, and the most of them.
struct Counting;

static HELD: AtomicUsize = AtomicUsize::new(0);
static MOST: AtomicUsize = AtomicUsize::new(0);

fn taken(bytes: usize) {
    MOST.fetch_max(HELD.fetch_add(bytes, Relaxed) + bytes, Relaxed);
}

// SAFETY: everything is done by the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        taken(layout.size());
        // SAFETY: as the caller's.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        taken(layout.size());
        // SAFETY: as the caller's.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        HELD.fetch_sub(layout.size(), Relaxed);
        // SAFETY: as the caller's.
        unsafe { System.dealloc(at, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// What `work` gives, and by how much memory rose meanwhile, at most and in the end.
fn measured<T>(work: impl FnOnce() -> T) -> (T, usize, usize) {
    let before = HELD.load(Relaxed);
    MOST.store(before, Relaxed);
    let made = work();
    (made, MOST.load(Relaxed) - before, HELD.load(Relaxed).saturating_sub(before))
}

const PHOTOS: usize = 48;
/// Of the files, and of what is used of them.
const FILE: (u32, u32) = (1280, 960);
const USED: (u32, u32) = (640, 480);
const MIB: usize = 1 << 20;

/// The same photo of a disc before something white, from all around, as JPEG.
fn scene(folder: &Path) -> Cameras {
    let photo = RgbImage::from_fn(FILE.0, FILE.1, |x, y| match x.abs_diff(640).pow(2) + y.abs_diff(480).pow(2) {
        0..90_000 => Rgb([180, (x % 256) as u8, (y % 256) as u8]),
        _ => Rgb([255; 3]),
    });
    photo.save(folder.join("0.jpg")).unwrap();
    let frame = |i: usize| {
        let name = format!("{i}.jpg");
        if i > 0 {
            fs::copy(folder.join("0.jpg"), folder.join(&name)).unwrap();
        }
        let angle = TAU * i as f64 / PHOTOS as f64;
        let eye = DVec3::new(1.7 * angle.cos(), 1.7 * angle.sin(), 0.4);
        (name, Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 0.8, FILE.0, FILE.1))
    };
    let frames: Vec<(String, Camera)> = (0..PHOTOS).map(frame).collect();
    fs::write(folder.join("transforms.json"), transforms_json(&frames)).unwrap();
    cameras(folder, None, None).unwrap()
}

#[test]
fn photos_are_held_once_at_the_size_that_is_used() {
    let folder = tempfile::tempdir().unwrap();
    let found = scene(folder.path());
    // Three files of 1.2 megapixels are decoded at once.
    let config = LoadConfig { max_side: USED.0, memory: 256 << 20, ..LoadConfig::default() };
    let pool = |threads: usize| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let (four, two) = (pool(4), pool(2));
    let (loaded, most, held) = measured(|| four.install(|| load(&found, &config).unwrap()));
    let Loaded { views, masks, whole, .. } = &loaded;
    assert_eq!((views.len(), *masks, views[0].image.dimensions()), (PHOTOS, MaskKind::Plain, USED));
    assert_eq!(whole.get(3).unwrap().dimensions(), (320, 240));
    let photos = PHOTOS * 4 * (USED.0 * USED.1) as usize;
    println!("{} MiB of photos: {} MiB held, {} MiB at most", photos / MIB, held / MIB, most / MIB);
    // Beside them small ones, a quarter of each; meanwhile a quarter for where the backdrops are, or three files.
    assert!(held < photos * 13 / 10 && most < photos * 19 / 10, "{most} and {held} bytes of {photos}");
    drop(loaded);

    // What can be made again of a view is not kept where there are many.
    let views = tabletop::tabletop(301, 10, TAU, (160, 120)).views;
    let of = |kept: usize| {
        let (found, most, _) = measured(|| two.install(|| unjudged_keeping(kept, &views, &Hints::default())));
        found.unwrap();
        most
    };
    let (few, many) = (of(10), of(9));
    println!("masks: {} KiB where all is kept, {} KiB where not", few >> 10, many >> 10);
    assert!(many < few * 17 / 20, "{many} of {few} bytes");
}
