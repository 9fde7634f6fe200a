//! Our renders of the 21 test objects against those of Blender Cycles.

use std::path::PathBuf;

mod against;
use against::{Likeness, names, object, views};

#[test]
#[ignore = "needs FREERANGE_SHARED"]
fn pictures_agree_with_cycles() {
    let shared = PathBuf::from(std::env::var_os("FREERANGE_SHARED").expect("FREERANGE_SHARED names the shared folder"));
    let names = names(&shared);
    assert_eq!(names.len(), 21);
    let mut means = Vec::new();
    for name in &names {
        let pairs = views(&shared, name, object(&shared, name));
        assert_eq!(pairs.len(), 12, "{name}");
        let all: Vec<Likeness> = pairs.iter().map(|(a, b)| Likeness::new(a, b)).collect();
        for (i, l) in all.iter().enumerate() {
            assert!(l.iou >= 0.97, "{name}, view {i}: overlap {}", l.iou);
        }
        let mean = Likeness::mean(&all);
        // The least is a white box in a box: Cycles stopped after a few reflections.
        assert!(mean.psnr > 34.8, "{name}: {} dB", mean.psnr);
        means.push(mean);
    }
    let mean = Likeness::mean(&means);
    assert!(mean.iou >= 0.995, "overlap {}", mean.iou);
    assert!(mean.psnr > 43.0, "{} dB", mean.psnr);
    assert!(mean.correlation > 0.985, "correlation {}", mean.correlation);
    assert!(mean.bias.abs() < 0.7, "{} of 255", mean.bias);
}
