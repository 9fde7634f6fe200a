//! Features against pytorch-fid's.

use super::{Random, Vectors, close, device, golden, image};
use crate::metrics::networks::{Inception, inception_features, resize::Image8};

#[test]
fn features_are_pytorch_fids() {
    let v = Vectors::open(&golden("networks/inception.safetensors"));
    let network = Inception::build(&mut Random, &device()).unwrap();
    let images = ["in/image0", "in/image1"].map(|name| image(&v, name));
    let features = inception_features(&network, &images, &device());
    // Repeated 5 times to the right and 7 times downwards, cut to 310 rows: shrunk where the others are enlarged.
    let small = &images[0];
    let row = small.width * 3;
    let repeated = |y: usize| small.values[y % small.height * row..][..row].repeat(5);
    let tiled = Image8 { width: 5 * small.width, height: 310, values: (0..310).flat_map(repeated).collect() };
    let tiled = inception_features(&network, &[tiled], &device());
    for (name, found) in [("image0", &features[0]), ("image1", &features[1]), ("tiled", &tiled[0])] {
        let expected = v.floats(&format!("out/{name}"));
        assert_eq!(expected.len(), Inception::WIDTH);
        let largest = expected.iter().fold(0.0f32, |m, x| m.max(x.abs()));
        close(found, expected, 2e-4 * largest);
    }
    assert_ne!(features[0], features[1]);
}
