//! What the metrics say about equal images and about known changes.
//!
//! With random weights a network's distance is still a distance: zero for equal images only. That a stronger change
//! of the same kind is further away is no theorem, but holds here for the convolutional metrics by a wide margin
//! (their features are nearly linear in small changes).

use burn::tensor::{Tensor, TensorData};

use super::{Random, device, golden};
use freerange_raster::metrics::{ImageError, psnr, ssim_3dgs};

use crate::metrics::{
    Evaluator, EvaluatorConfig, FeatureStatistics, Metric, MetricsError, Pair, frechet_distance,
    networks::{Inception, Lpips, LpipsNet, cosine_similarity, host, inception_features, resize::Image8},
    weights::Weights,
};

const SIDE: usize = 64;

/// A picture with an edge, a gradient and texture. `phase` shifts its pattern.
fn picture(phase: f32) -> Vec<f32> {
    let mut out = Vec::new();
    for y in 0..SIDE {
        for x in 0..SIDE {
            let (u, v) = (x as f32 / SIDE as f32, y as f32 / SIDE as f32);
            let inside = (u - 0.5).powi(2) + (v - 0.5).powi(2) < 0.1;
            for c in 0..3 {
                let wave = 0.5 + 0.3 * (25.0 * u + 17.0 * v * (c as f32 + 1.0) + phase).sin();
                out.push(if inside { 0.2 + 0.25 * c as f32 } else { wave });
            }
        }
    }
    out
}

fn color_shift(image: &[f32], by: f32) -> Vec<f32> {
    image.iter().map(|v| (v + by).clamp(0.0, 1.0)).collect()
}

fn pixel_shift(image: &[f32], by: usize) -> Vec<f32> {
    let mut out = Vec::new();
    for row in image.chunks_exact(SIDE * 3) {
        out.extend(&row[by * 3..]);
        (0..by).for_each(|_| out.extend(&row[row.len() - 3..]));
    }
    out
}

/// Repeated means over 3 x 3 pixels.
fn blur(image: &[f32], times: usize) -> Vec<f32> {
    let mut image = image.to_vec();
    for _ in 0..times {
        let at = |y: i64, x: i64, c: usize| {
            let inside = |v: i64| v.clamp(0, SIDE as i64 - 1) as usize;
            image[(inside(y) * SIDE + inside(x)) * 3 + c]
        };
        let mean = |i: usize| {
            let (y, x, c) = ((i / 3 / SIDE) as i64, (i / 3 % SIDE) as i64, i % 3);
            (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (dy, dx))).map(|(dy, dx)| at(y + dy, x + dx, c)).sum::<f32>()
                / 9.0
        };
        image = (0..image.len()).map(mean).collect();
    }
    image
}

/// The changes, weak and strong.
fn changes(image: &[f32]) -> [(&'static str, Vec<f32>, Vec<f32>); 3] {
    [
        ("color", color_shift(image, 0.02), color_shift(image, 0.1)),
        ("shift", pixel_shift(image, 1), pixel_shift(image, 4)),
        ("blur", blur(image, 1), blur(image, 6)),
    ]
}

#[test]
fn lpips_grows_with_the_change() {
    for net in [LpipsNet::Alex, LpipsNet::Vgg] {
        let lpips = Lpips::build(net, &mut Random, &mut Random, &device()).unwrap();
        let planes = |image: &[f32]| -> Tensor<4> {
            let values: Vec<f32> = (0..3).flat_map(|c| image[c..].iter().step_by(3).copied()).collect();
            Tensor::from_data(TensorData::new(values, [1, 3, SIDE, SIDE]), &device())
        };
        let truth = picture(0.0);
        let distance = |image: &[f32]| host(lpips.distance(planes(image), planes(&truth)))[0];
        assert_eq!(distance(&truth), 0.0);
        for (name, weak, strong) in changes(&truth) {
            let (weak, strong) = (distance(&weak), distance(&strong));
            assert!(0.0 < weak && weak < strong, "{net:?} {name}: {weak}, {strong}");
        }
    }
}

#[test]
fn pixel_metrics_fall_with_the_change() {
    let truth = picture(0.0);
    let value = |image: &[f32]| (psnr(image, &truth).unwrap(), ssim_3dgs(image, &truth, SIDE, SIDE).unwrap());
    assert_eq!(value(&truth).0, f64::INFINITY);
    assert!((value(&truth).1 - 1.0).abs() < 1e-6);
    for (name, weak, strong) in changes(&truth) {
        let (weak, strong) = (value(&weak), value(&strong));
        assert!(weak.0 > strong.0 && 1.0 > weak.1 && weak.1 > strong.1, "{name}: {weak:?}, {strong:?}");
    }
}

#[test]
fn fid_grows_with_the_change() {
    let network = Inception::build(&mut Random, &device()).unwrap();
    let truths: Vec<Vec<f32>> = (0..4).map(|i| picture(i as f32)).collect();
    let statistics = |images: &[Vec<f32>]| {
        let images: Vec<Image8> = images.iter().map(|v| Image8::quantized(v, SIDE, SIDE)).collect();
        let mut out = FeatureStatistics::new(Inception::WIDTH);
        inception_features(&network, &images, &device()).iter().for_each(|f| out.add(f).unwrap());
        out
    };
    let reference = statistics(&truths);
    let distance = |images: &[Vec<f32>]| frechet_distance(&statistics(images), &reference).unwrap();
    let scale: f64 = reference.mean().iter().map(|m| m * m).sum();
    assert!(distance(&truths).abs() < 1e-9 * scale, "{}", distance(&truths));
    let both: Vec<_> = truths.iter().map(|truth| changes(truth)).collect();
    for kind in 0..3 {
        let weak: Vec<Vec<f32>> = both.iter().map(|c| c[kind].1.clone()).collect();
        let strong: Vec<Vec<f32>> = both.iter().map(|c| c[kind].2.clone()).collect();
        let (weak, strong) = (distance(&weak), distance(&strong));
        assert!(0.0 < weak && weak < strong, "{}: {weak}, {strong}", both[0][kind].0);
    }
}

#[test]
fn dreamsim_grows_with_the_change() {
    let folder = golden("networks");
    for (label, branches) in [("dino", 1), ("ensemble", 3)] {
        let network = super::dreamsim::load(&folder, &folder.join(format!("{label}_lora")), branches).unwrap();
        let truth = picture(0.0);
        let embed = |image: &[f32]| network.embed(&[Image8::quantized(image, SIDE, SIDE)]).remove(0);
        let distance = |image: &[f32]| 1.0 - cosine_similarity(&embed(image), &embed(&truth));
        assert!(distance(&truth).abs() < 1e-10, "{label}: {}", distance(&truth));
        for (name, weak, strong) in changes(&truth) {
            let (weak, strong) = (distance(&weak), distance(&strong));
            assert!(0.0 < weak && weak < strong, "{label} {name}: {weak}, {strong}");
        }
    }
}

#[test]
fn evaluator_computes_what_it_can_and_says_what_it_cannot() {
    let folder = tempfile::tempdir().unwrap();
    let weights = Weights::new([folder.path().to_owned()]);
    let (evaluator, missing) = Evaluator::open(&EvaluatorConfig::default(), &weights, &device()).unwrap();
    assert_eq!(evaluator.metrics(), [Metric::Psnr, Metric::Ssim, Metric::SsimCropped, Metric::SsimSample]);
    assert!(evaluator.used_files().is_empty());
    let reasons: Vec<&str> = missing.iter().map(|m| m.reason.as_str()).collect();
    assert_eq!(missing.len(), 7, "{missing:?}");
    assert!(
        reasons[0].contains("alexnet-owt-7be5be79.pth") && reasons[0].contains("freerange weights fetch lpips-alex")
    );

    let (truth, render) = (picture(0.0), picture(0.2));
    let pairs = [Pair { render: &render, truth: &truth }, Pair { render: &truth, truth: &truth }];
    let scores = evaluator.score(&pairs, SIDE, SIDE).unwrap();
    assert_eq!(scores[0].values[0], (Metric::Psnr, psnr(&render, &truth).unwrap()));
    assert_eq!(scores[1].values[0], (Metric::Psnr, 100.0));
    assert!(scores[1].inception.is_none());

    let mut broken = render.clone();
    broken[7] = f32::NAN;
    let error = evaluator.score(&[Pair { render: &broken, truth: &truth }], SIDE, SIDE).unwrap_err();
    assert!(
        matches!(error, MetricsError::Images(ImageError::NotFinite { image: "first image", index: 7, .. })),
        "{error}"
    );
    let error = evaluator.score(&[Pair { render: &render[3..], truth: &truth }], SIDE, SIDE).unwrap_err();
    assert!(matches!(error, MetricsError::Images(ImageError::Length { .. })), "{error}");
    let tiny = [0.5; 8 * 8 * 3];
    let error = evaluator.score(&[Pair { render: &tiny, truth: &tiny }], 8, 8).unwrap_err();
    assert_eq!(error, MetricsError::Images(ImageError::TooSmall { needed: 11, height: 8, width: 8 }));

    std::fs::create_dir_all(folder.path().join("lpips/v0.1")).unwrap();
    std::fs::write(folder.path().join("alexnet-owt-7be5be79.pth"), b"not it").unwrap();
    std::fs::write(folder.path().join("lpips/v0.1/alex.pth"), b"nor this").unwrap();
    let config = EvaluatorConfig { metrics: vec![Metric::LpipsAlex], ..Default::default() };
    let error = Evaluator::open(&config, &weights, &device()).err().unwrap();
    assert!(matches!(error, MetricsError::Checksum { .. }), "a damaged file is no missing one: {error}");
    let config = EvaluatorConfig { dino: "dinov9".to_owned(), metrics: vec![Metric::Dino], ..Default::default() };
    let error = Evaluator::open(&config, &weights, &device()).err().unwrap();
    assert!(matches!(error, MetricsError::UnknownWeights { .. }), "{error}");
}

#[test]
fn dino_similarity_of_a_whole_evaluation() {
    // A tiny DINOv2 takes the place of the published one.
    let folder = tempfile::tempdir().unwrap();
    let target = folder.path().join("dinov2-small");
    std::fs::create_dir(&target).unwrap();
    for name in ["config.json", "model.safetensors"] {
        std::fs::copy(golden("../dino/mlp_img56").join(name), target.join(name)).unwrap();
    }
    let weights = Weights::new([folder.path().to_owned()]);
    let config = EvaluatorConfig {
        metrics: vec![Metric::Dino, Metric::Psnr, Metric::Dino],
        dino: "dinov2-small".to_owned(),
        batch: 2,
    };
    let (evaluator, missing) = Evaluator::open(&config, &weights, &device()).unwrap();
    assert!(missing.is_empty());
    assert_eq!(evaluator.metrics(), [Metric::Dino, Metric::Psnr]);
    let used: Vec<&str> = evaluator.used_files().iter().map(|f| f.file.as_str()).collect();
    assert_eq!(used, ["dinov2-small/model.safetensors", "dinov2-small/config.json"]);
    assert!(evaluator.used_files().iter().all(|f| f.sha256.len() == 64));

    let truth = picture(0.0);
    let mut images = vec![truth.clone()];
    for (_, weak, strong) in changes(&truth) {
        images.extend([weak, strong]);
    }
    let pairs: Vec<Pair<'_>> = images.iter().map(|render| Pair { render, truth: &truth }).collect();
    let scores = evaluator.score(&pairs, SIDE, SIDE).unwrap();
    let dino: Vec<f64> = scores.iter().map(|s| s.values[0].1).collect();
    assert!((dino[0] - 1.0).abs() < 1e-6, "equal images: {}", dino[0]);
    assert!(dino[1..].iter().all(|&d| d < dino[0] && d > -1.0), "{dino:?}");
}
