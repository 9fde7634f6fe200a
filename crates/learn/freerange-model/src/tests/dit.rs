//! The diffusion transformer against golden values.

use burn::{
    module::{Module, ModuleVisitor, Param},
    tensor::{Device, Gradients, Tensor, TensorData},
};

use super::{Golden, devices, half_devices, numbers, path};
use crate::{
    Compute, Dit, EncoderConfig, Feedback, FreeRange, ModelConfig, OBSERVATION, PLACE, PatchConfig,
    dit::{Parts, time_embedding},
    layers::Builder,
    weights::TensorFile,
};

fn golden_dit(name: &str, image_channels: usize, device: &Device) -> Dit {
    let config = ModelConfig {
        hidden: 32,
        blocks: 2,
        heads: 2,
        ffn: Some(128),
        registers: 2,
        gaussians_per_token: 2,
        time_features: 16,
        ..ModelConfig::default()
    };
    let path = path(&format!("dit/{name}.weights.safetensors"));
    let bytes = std::fs::read(&path).unwrap();
    let mut source = TensorFile::parse(&path, "golden file", &bytes).unwrap();
    let dit = Dit::build(&config, image_channels, "", &mut Builder { source: &mut source, device }).unwrap();
    source.check_all_used().unwrap();
    dit
}

/// Holds the gradient of every weight to its golden vector, by name.
struct GradientCheck<'a> {
    path: Vec<String>,
    golden: &'a Golden,
    gradients: &'a Gradients,
    checked: usize,
}

impl ModuleVisitor for GradientCheck<'_> {
    fn enter_module(&mut self, name: &str, _: &str) {
        self.path.push(name.to_owned());
    }

    fn exit_module(&mut self, _: &str, _: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let name = format!("dit.{}", self.path.join("."));
        let parts: Vec<String> = name.split('.').map(str::to_owned).collect();
        let name = crate::model::torch_name(&parts);
        let gradient = param.val().grad(self.gradients).unwrap_or_else(|| panic!("{name} has no gradient"));
        self.golden.check(&format!("grad/w/{}", &name[4..]), gradient, 1e-3);
        self.checked += 1;
    }
}

fn whole(name: &str, device: &Device, recompute: bool) {
    let device = device.clone().autodiff();
    let golden = Golden::read(&format!("dit/{name}.safetensors"));
    let input = |part: &str| golden.tensor::<3>(&format!("in/{part}"), &device).require_grad();
    let (z, gradient, images) = (input("z"), input("grad_channels"), input("img"));
    let t = golden.tensor::<1>("in/t", &device).require_grad();
    let mut dit = golden_dit(name, images.dims()[2], &device);
    dit.set_recompute(recompute);

    golden.check("out/cond", dit.condition(t.clone()), 1e-4);
    let tokens = dit.tokens(z.clone(), Some(gradient.clone()).into(), images.clone());
    golden.check("out/tokens_0", tokens.clone(), 1e-4);
    golden.check("out/tokens_1", dit.first_block(tokens, t.clone()), 1e-4);
    let unconditional = dit.forward(z.clone(), Some(gradient.clone()), images.zeros_like(), t.clone());
    golden.check("out/zhat1_img_zeroed", unconditional, 1e-4);

    let out = dit.forward(z.clone(), Some(gradient.clone()), images.clone(), t.clone());
    golden.check("out/zhat1", out.clone(), 1e-4);
    let gradients = (out * golden.tensor("loss/w", &device)).sum().backward();
    golden.check("grad/z", z.grad(&gradients).unwrap(), 1e-3);
    golden.check("grad/grad_channels", gradient.grad(&gradients).unwrap(), 1e-3);
    golden.check("grad/img", images.grad(&gradients).unwrap(), 1e-3);
    golden.check("grad/t", t.grad(&gradients).unwrap(), 1e-3);
    let mut check = GradientCheck { path: Vec::new(), golden: &golden, gradients: &gradients, checked: 0 };
    dit.visit(&mut check);
    assert_eq!(check.checked, golden.names().filter(|name| name.starts_with("grad/w/")).count());
}

#[test]
fn matches_the_reference() {
    for device in devices() {
        for recompute in [false, true] {
            whole("dit_adaln_final", &device, recompute);
        }
    }
}

#[test]
fn half_precision_stays_near() {
    for (device, compute) in half_devices().into_iter().chain([(Device::flex(), Compute::Bf16)]) {
        let golden = Golden::read("dit/dit_adaln_final.safetensors");
        let input = |part: &str| golden.tensor::<3>(&format!("in/{part}"), &device);
        let images = input("img");
        let mut dit = golden_dit("dit_adaln_final", images.dims()[2], &device);
        dit.set_compute(compute);
        let out = dit.forward(input("z"), Some(input("grad_channels")), images, golden.tensor("in/t", &device));
        golden.check("out/zhat1", out, 2e-2);
    }
}

#[test]
fn the_time_embedding_matches() {
    let device = Device::flex();
    let golden = Golden::read("dit/pieces.safetensors");
    for features in [16, 256] {
        let found = time_embedding(golden.tensor("in/t", &device), features);
        golden.check(&format!("out/timestep_embedding_{features}"), found, 1e-4);
    }
}

#[test]
fn pieces_match_the_reference() {
    pieces(&Parts::readable(), &Device::flex());
    for device in devices() {
        pieces(&Parts::fused(), &device);
    }
}

fn pieces(ops: &Parts, device: &Device) {
    let device = device.clone().autodiff();
    let golden = Golden::read("dit/pieces.safetensors");
    let x = golden.tensor::<3>("in/x", &device).require_grad();
    let c = golden.tensor::<2>("in/c", &device).require_grad();
    let weight = |name: &str| golden.tensor::<2>(&format!("w/{name}"), &device).require_grad();
    let vector = |name: &str| golden.tensor::<1>(&format!("w/{name}"), &device).require_grad();
    let backward = |out: Tensor<3>| (out * golden.tensor("loss/w", &device)).sum().backward();
    let zeros = Tensor::<2>::zeros([2, 24], &device);

    let w = vector("rms_norm.weight");
    let out = crate::ops::reference::rms_norm(x.clone(), w.clone());
    golden.check("out/rmsnorm", out.clone(), 1e-4);
    let gradients = backward(out);
    golden.check("grad/rmsnorm/x", x.grad(&gradients).unwrap(), 1e-3);
    golden.check("grad/rmsnorm/weight", w.grad(&gradients).unwrap(), 1e-3);

    let out = (ops.norm)(x.clone(), zeros.clone(), zeros.clone());
    golden.check("out/layernorm", out.clone(), 1e-4);
    golden.check("grad/layernorm/x", x.grad(&backward(out)).unwrap(), 1e-3);

    let (w, b) = (weight("m.weight"), vector("m.bias"));
    let m = (ops.linear)(burn::tensor::activation::silu(c.clone()).unsqueeze_dim(1), w.clone(), b.clone());
    let m = m.reshape([2, 72]);
    let part = |i: usize| m.clone().narrow(1, 24 * i, 24);
    let out = (ops.gated)(x.clone(), part(2), (ops.norm)(x.clone(), part(0), part(1)));
    golden.check("out/adaln_gated", out.clone(), 1e-4);
    let gradients = backward(out);
    golden.check("grad/adaln_gated/x", x.grad(&gradients).unwrap(), 1e-3);
    golden.check("grad/adaln_gated/c", c.grad(&gradients).unwrap(), 1e-3);
    golden.check("grad/adaln_gated/m.weight", w.grad(&gradients).unwrap(), 1e-3);
    golden.check("grad/adaln_gated/m.bias", b.grad(&gradients).unwrap(), 1e-3);

    let names = ["f.proj_in.weight", "f.proj_out.weight", "f.proj_in.bias", "f.proj_out.bias"];
    let (w, b) = ([weight(names[0]), weight(names[1])], [vector(names[2]), vector(names[3])]);
    let hidden = (ops.geglu)((ops.linear)(x.clone(), w[0].clone(), b[0].clone()));
    let out = (ops.linear)(hidden, w[1].clone(), b[1].clone());
    golden.check("out/geglu", out.clone(), 1e-4);
    let gradients = backward(out);
    golden.check("grad/geglu/x", x.grad(&gradients).unwrap(), 1e-3);
    for i in 0..2 {
        golden.check(&format!("grad/geglu/{}", names[i]), w[i].grad(&gradients).unwrap(), 1e-3);
        golden.check(&format!("grad/geglu/{}", names[2 + i]), b[i].grad(&gradients).unwrap(), 1e-3);
    }

    let names = ["a.qkv.weight", "a.out.weight", "a.qkv.bias", "a.out.bias", "a.q_norm.weight", "a.k_norm.weight"];
    let w = [weight(names[0]), weight(names[1])];
    let v = [vector(names[2]), vector(names[3]), vector(names[4]), vector(names[5])];
    let qkv = (ops.linear)(x.clone(), w[0].clone(), v[0].clone());
    let out = (ops.attention)(qkv, v[2].clone(), v[3].clone(), 3, 7);
    let out = (ops.linear)(out, w[1].clone(), v[1].clone());
    golden.check("out/attention", out.clone(), 1e-4);
    let gradients = backward(out);
    golden.check("grad/attention/x", x.grad(&gradients).unwrap(), 1e-3);
    for i in 0..2 {
        golden.check(&format!("grad/attention/{}", names[i]), w[i].grad(&gradients).unwrap(), 1e-3);
    }
    for i in 0..4 {
        golden.check(&format!("grad/attention/{}", names[2 + i]), v[i].grad(&gradients).unwrap(), 1e-3);
    }
}

fn small(p: usize, gradient_channels: bool) -> ModelConfig {
    ModelConfig {
        image_size: 8,
        encoder: EncoderConfig::Patch(PatchConfig { patch_size: 4, channels: 3 }),
        hidden: 16,
        blocks: 2,
        heads: 2,
        registers: 0,
        gaussians_per_token: p,
        time_features: 8,
        gradient_channels,
        ..ModelConfig::default()
    }
}

#[test]
fn every_token_size_runs_and_starts_at_zero() {
    let device = Device::flex();
    for p in [1, 2, 4, 8] {
        for gradient_channels in [false, true] {
            let config = small(p, gradient_channels);
            let mut rng = <rand_chacha::ChaCha8Rng as rand::SeedableRng>::seed_from_u64(3);
            let model = FreeRange::new(&config, &mut rng, &device).unwrap();
            let images = Tensor::<5>::ones([2, 3, 8, 8, 3], &device);
            let tokens = model.encode(images, Tensor::ones([2, 3, 2, 2, 6], &device));
            assert_eq!(tokens.dims(), [2, 12, config.image_token_width()]);
            let z = Tensor::<3>::ones([2, 16, 14], &device);
            let gradient = gradient_channels.then(|| z.clone());
            let t = Tensor::from_floats([0.1, 0.9], &device);
            let out = model.denoise(z, gradient, tokens, t);
            assert_eq!(out.dims(), [2, 16, 14]);
            assert!(numbers(out).iter().all(|&x| x == 0.0), "adaLN-zero: the first prediction is zero");
        }
    }
}

#[test]
fn what_is_known_is_corrected() {
    let device = Device::flex();
    let config = ModelConfig { estimate_channels: true, preconditioning: Some([0.5; 14]), ..small(2, true) };
    assert_eq!(config.gaussian_channels(), 2 * 3 * 14);
    let mut rng = <rand_chacha::ChaCha8Rng as rand::SeedableRng>::seed_from_u64(3);
    let model = FreeRange::new(&config, &mut rng, &device).unwrap();
    let images = Tensor::<3>::ones([3, 4, config.image_token_width()], &device);
    let z = Tensor::<3>::ones([3, 8, 14], &device);
    let t = || Tensor::from_floats([0.0, 0.4, 1.0], &device);
    let feedback = Feedback { gradient: Some(z.clone()), estimate: Some(z.clone().mul_scalar(0.7)), observation: None };
    // The last layer starts at zero. At the start only the estimate counts, at the end only the sample; in between they
    // are weighed by their variances: the sample's, told by z / t, is ((1 - t) / t)^2, the estimate's 0.5^2.
    let first = numbers(model.denoise(z.clone(), feedback.clone(), images.clone(), t()));
    let (told, variance) = (1.0 / 0.4, (0.6f32 / 0.4).powi(2));
    let between = (told / variance + 0.7 / 0.25) / (1.0 / variance + 1.0 / 0.25);
    for (i, x) in first.iter().enumerate() {
        let expected = [0.7, between, 1.0][i / (8 * 14)];
        assert!((x - expected).abs() < 1e-5, "{i}: {x}, expected {expected}");
    }
    let sizes = model.parameters().into_iter().map(|p| p.values.len());
    let values: Vec<Vec<f32>> =
        sizes.map(|n| (0..n).map(|_| rand::Rng::random_range(&mut rng, -0.3..0.3)).collect()).collect();
    let model = model.set_parameters(&values).unwrap();
    let without = Feedback { estimate: None, ..feedback.clone() };
    let run = |f: Feedback| numbers(model.denoise(z.clone(), f, images.clone(), t()));
    let [with, without] = [feedback, without].map(run);
    // Without an estimate, as much is left to tell as normalized Gaussians vary.
    assert!((0..8 * 14).any(|i| ((with[i] - 0.7) / 0.5 - without[i]).abs() > 1e-3), "the network sees it");
    assert_eq!(with[2 * 8 * 14..], without[2 * 8 * 14..], "at the end nothing is left to correct");
}

#[test]
fn what_a_model_was_not_told_yet_changes_nothing() {
    let device = Device::flex();
    let narrow = ModelConfig { estimate_channels: true, observation_channels: true, ..small(2, true) };
    let wide = ModelConfig { place_channels: true, ..narrow.clone() };
    wide.validate().unwrap();
    assert_eq!([narrow.observed(), wide.observed()], [OBSERVATION, OBSERVATION + PLACE]);
    let refused = ModelConfig { observation_channels: false, ..wide.clone() }.validate().unwrap_err();
    assert!(refused.to_string().contains("place_channels"), "{refused}");
    let mut rng = <rand_chacha::ChaCha8Rng as rand::SeedableRng>::seed_from_u64(5);
    let model = FreeRange::new(&narrow, &mut rng, &device).unwrap();
    let mut drawn = |n: usize| (0..n).map(|_| rand::Rng::random_range(&mut rng, -0.3..0.3)).collect::<Vec<f32>>();
    let values: Vec<Vec<f32>> = model.parameters().into_iter().map(|p| drawn(p.values.len())).collect();
    let model = model.set_parameters(&values).unwrap();
    let mut random = |c: usize| Tensor::<3>::from_data(TensorData::new(drawn(2 * 8 * c), [2, 8, c]), &device);
    let (z, seen, place) = (random(14), random(OBSERVATION), random(PLACE));
    let images = Tensor::<3>::ones([2, 4, narrow.image_token_width()], &device);
    let run = |model: &FreeRange, observation: Tensor<3>| {
        let feedback = Feedback { gradient: None, estimate: Some(z.clone()), observation: Some(observation) };
        numbers(model.denoise(z.clone(), feedback, images.clone(), Tensor::from_floats([0.0, 0.4], &device)))
    };
    let before = run(&model, seen.clone());
    let both = Tensor::cat(vec![seen, place], 2);
    let model = model.with_place_channels();
    super::assert_close("with place channels", &run(&model, both.clone()), &before, 1e-5);
    let shapes = |model: &FreeRange| model.parameters().into_iter().map(|p| (p.name, p.shape)).collect::<Vec<_>>();
    assert_eq!(shapes(&model), shapes(&FreeRange::new(&wide, &mut rng, &device).unwrap()));
}

#[test]
fn pairs_of_gaussians_may_be_reordered() {
    let device = Device::flex();
    let golden = Golden::read("dit/dit_adaln_final.safetensors");
    let input = |part: &str| golden.tensor::<3>(&format!("in/{part}"), &device);
    let (z, gradient, images) = (input("z"), input("grad_channels"), input("img"));
    let dit = golden_dit("dit_adaln_final", images.dims()[2], &device);
    let turn = |x: Tensor<3>| Tensor::cat(vec![x.clone().narrow(1, 4, 8), x.narrow(1, 0, 4)], 1);
    let t = golden.tensor::<1>("in/t", &device);
    let out = dit.forward(z.clone(), Some(gradient.clone()), images.clone(), t.clone());
    let turned = dit.forward(turn(z), Some(turn(gradient)), images, t);
    super::assert_close("reordered", &numbers(turned), &numbers(turn(out)), 1e-5);
}
