//! What the other views make of a view, on the bowl.

use std::path::Path;

use freerange::{Scene, View, internal::leave_one_out};
use freerange_util::Stop;
use image::Rgba;

fn bowl() -> Vec<View> {
    Scene::open(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../examples/bowl"))).unwrap().loaded.views
}

#[test]
fn the_others_know_what_a_mask_lacks_and_what_it_has_too_much() {
    let views = bowl();
    let mut wrong = views.clone();
    let (w, h) = wrong[0].image.dimensions();
    let (hole, blot) = ((w / 2 - 20, h / 2 - 20), (10, 10));
    for (x, y) in (0..40).flat_map(|y| (0..40).map(move |x| (x, y))) {
        let (x0, y0) = hole;
        assert_eq!(views[0].image.get_pixel(x0 + x, y0 + y)[3], 255, "the bowl is in the middle");
        wrong[0].image.put_pixel(x0 + x, y0 + y, Rgba([0; 4]));
        wrong[0].image.put_pixel(blot.0 + x, blot.1 + y, Rgba([0, 255, 0, 255]));
    }
    let shown = leave_one_out(wrong, &Stop::default()).unwrap();
    assert_eq!(shown.len(), views.len());
    let mean = |(x0, y0): (u32, u32), f: &dyn Fn(u32, u32) -> f64| {
        (0..1600).map(|i| f(x0 + i % 40, y0 + i / 40)).sum::<f64>() / 1600.0
    };
    let alpha = |x: u32, y: u32| f64::from(shown[0].get_pixel(x, y)[3]) / 255.0;
    assert!(mean(hole, &alpha) > 0.9, "{}", mean(hole, &alpha));
    assert!(mean(blot, &alpha) < 0.01, "{}", mean(blot, &alpha));
    // In the bowl's own color.
    let off = |x: u32, y: u32| {
        let (a, b) = (shown[0].get_pixel(x, y), views[0].image.get_pixel(x, y));
        (0..3).map(|c| f64::from(a[c].abs_diff(b[c]))).sum::<f64>() / 3.0
    };
    assert!(mean(hole, &off) < 25.0, "{}", mean(hole, &off));
    for (shown, view) in shown.iter().zip(&views) {
        assert_eq!(shown.dimensions(), view.image.dimensions());
    }
}

#[test]
fn a_view_alone_has_no_others() {
    let reason = leave_one_out(bowl()[..1].to_vec(), &Stop::default()).map(|shown| shown.len()).unwrap_err();
    assert!(reason.contains("view"), "{reason}");
}
