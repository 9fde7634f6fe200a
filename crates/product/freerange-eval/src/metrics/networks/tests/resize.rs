//! Resizing against Pillow's and Hugging Face's.

use super::{Vectors, close, golden, image};
use crate::metrics::networks::{dino, resize::Image8};

#[test]
fn bicubic_is_pillows() {
    let v = Vectors::open(&golden("networks/resize.safetensors"));
    for name in ["down", "up", "wide"] {
        let expected = image(&v, &format!("out/{name}"));
        let found = image(&v, &format!("in/{name}")).bicubic(expected.width, expected.height);
        assert_eq!(found, expected, "{name}");
    }
}

#[test]
fn bicubic_keeps_what_it_should() {
    let image = Image8 { width: 5, height: 3, values: (0..45).map(|i| (i * 5) as u8).collect() };
    assert_eq!(image.bicubic(5, 3), image);
    let gray = Image8 { width: 9, height: 7, values: vec![77; 9 * 7 * 3] };
    assert!(gray.bicubic(20, 2).values.iter().all(|&v| v == 77));
    let one = Image8 { width: 1, height: 1, values: vec![1, 2, 3] };
    assert_eq!(one.bicubic(2, 1).values, [1, 2, 3, 1, 2, 3]);
}

#[test]
fn quantized_rounds_and_clamps() {
    let image = Image8::quantized(&[-1.0, 0.0, 0.5 / 255.0, 1.0, 2.0, 100.4 / 255.0], 2, 1);
    assert_eq!(image.values, [0, 0, 1, 255, 255, 100]);
}

#[test]
#[ignore = "needs FREERANGE_SHARED"]
fn dino_preparation_is_hugging_faces() {
    let shared = std::env::var("FREERANGE_SHARED").unwrap();
    for name in ["prep_a", "prep_b"] {
        let v = Vectors::open(&std::path::Path::new(&shared).join(format!("golden/dev/dino/{name}.safetensors")));
        let mut found = Vec::new();
        let image_u8 = image(&v, "in/image_u8");
        dino::prepare(&image_u8, &mut found);
        close(&found, v.floats("out/hf_hfirst_pixel_values"), 0.02);
        // That reference has weights of full precision; Pillow's have 22 bits.
        let (found, expected) = (image_u8.bicubic(224, 224), image(&v, "out/resize_hfirst_224_u8"));
        let differences = found.values.iter().zip(&expected.values).map(|(a, b)| a.abs_diff(*b));
        assert!(differences.clone().all(|d| d <= 1));
        assert!(differences.filter(|d| *d > 0).count() * 50 <= found.values.len());
    }
}
