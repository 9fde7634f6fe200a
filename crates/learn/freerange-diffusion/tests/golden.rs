//! The path, the loss, the schedule and the solver against independent reference vectors.

use std::path::PathBuf;

use burn::tensor::{Device, Tensor, TensorData};
use freerange_diffusion::{
    path::{cosine_time, flow_loss, interpolate, render_weight},
    sample::{classifier_free, integrate},
    settings::Settings,
};
use freerange_gaussians::{Gaussians, Normalization};
use freerange_vectors::{Vectors, assert_close, json};

fn load(name: &str) -> Vectors {
    Vectors::read(&format!("flow/{name}"))
}

fn tensor<const D: usize>(vectors: &Vectors, name: &str, device: &Device) -> Tensor<D> {
    Tensor::from_data(TensorData::new(vectors.floats(name).to_vec(), vectors.shape(name).to_vec()), device)
}

fn values<const D: usize>(t: Tensor<D>) -> Vec<f32> {
    t.into_data().try_to_vec().unwrap()
}

#[test]
fn path_loss_and_its_gradient() {
    let device = Device::flex();
    let v = load("fm.safetensors");
    let t = tensor::<1>(&v, "in/t", &device);
    let (z1, eps) = (tensor::<3>(&v, "in/z1", &device), tensor::<3>(&v, "in/eps", &device));
    assert_close("z_t", &values(interpolate(eps, z1.clone(), t.clone())), v.floats("out/zt"), 1e-6);

    let weights: Vec<f32> = v.floats("in/t").iter().map(|&t| render_weight(t)).collect();
    assert_close("w(t)", &weights, v.floats("out/w"), 1e-6);

    // The reference has no bound on 1 - t.
    let estimate = tensor::<3>(&v, "in/zhat1", &device).autodiff().require_grad();
    let loss = flow_loss(estimate.clone(), z1, t, 0.0);
    let expected = v.floats("out/fm_per_sample_mean");
    for (i, (found, expected)) in values(loss.clone().inner()).iter().zip(expected).enumerate() {
        assert!((found - expected).abs() <= 1e-4 * expected, "sample {i}: {found}, expected {expected}");
    }
    let gradients = loss.mean().backward();
    let gradient = values(estimate.grad(&gradients).unwrap());
    assert_close("gradient of the flow loss", &gradient, v.floats("grad/zhat1_of_fm_mean"), 1e-4);
}

#[test]
fn the_bound_on_the_denominator_only_acts_near_the_data() {
    let device = Device::flex();
    let one = |t: f32, min: f32| {
        let (a, b) = (Tensor::<3>::ones([1, 2, 14], &device), Tensor::<3>::zeros([1, 2, 14], &device));
        flow_loss(a, b, Tensor::from_floats([t], &device), min).into_scalar::<f32>()
    };
    assert!((one(0.5, 0.05) - 4.0).abs() < 1e-5);
    assert!((one(0.99, 0.05) - 400.0).abs() < 1e-2);
}

#[test]
fn normalization() {
    let v = load("fm.safetensors");
    let row = |name: &str| v.floats(name).to_vec().try_into().unwrap();
    let normalization = Normalization::new(row("in/mean"), row("in/std")).unwrap();
    let z1 = v.floats("in/z1");
    let found = normalization.normalize(&Gaussians::from_rows(z1.to_vec()));
    assert_close("normalized", &found, v.floats("out/z1_normalised"), 1e-5);
    assert_close("denormalized", normalization.denormalize(z1).rows(), v.floats("out/z1_denormalised"), 1e-5);
}

#[test]
fn cosine_schedule_is_the_snr_matched_one() {
    let v = load("cosine_schedule.safetensors");
    let u = v.floats("in/u");
    // The reference draws u from clean (0) to noise (1); ours rises with t.
    let found: Vec<f32> = u.iter().map(|&u| cosine_time(1.0 - u)).collect();
    assert_close("t", &found, v.floats("out/t_A0_cosmap"), 1e-5);
    assert_eq!(cosine_time(0.0), 0.0);
    assert!((cosine_time(1.0) - 1.0).abs() < 1e-6);
}

#[test]
fn euler_with_both_guidances_on_the_toy_model() {
    for (name, steps, scale, lambda, kappa) in toy_cases() {
        let device = Device::flex();
        let v = load(&name);
        let (m1, m0) = (tensor::<2>(&v, "in/M1", &device), tensor::<2>(&v, "in/M0", &device));
        let b = tensor::<1>(&v, "in/b", &device).reshape([1, 1, -1]);
        let target: Tensor<3> = tensor::<2>(&v, "in/target", &device).unsqueeze();
        let mut trajectory = values(tensor::<2>(&v, "in/z0", &device));
        let noise: Tensor<3> = tensor::<2>(&v, "in/z0", &device).unsqueeze();
        let mut estimates = Vec::new();
        let last = integrate(
            noise,
            steps,
            |step| {
                if step.index > 0 {
                    trajectory.extend(values(step.z.clone()));
                }
                let conditional = step.z.clone().matmul(m1.clone().unsqueeze())
                    + b.clone().mul_scalar(step.t)
                    + target.clone().mul_scalar(0.5);
                let unconditional = step.z.clone().matmul(m0.clone().unsqueeze());
                let guided = classifier_free(conditional, unconditional, scale);
                estimates.extend(values(guided.clone()));
                Ok(guided)
            },
            // The reference's result is the last estimate, without a push.
            |_, estimate| Ok(Some((estimate.clone() - target.clone()).mul_scalar(kappa * lambda))),
        )
        .unwrap();
        let expected = v.floats("out/trajectory");
        assert_close(&format!("{name}: trajectory"), &trajectory, &expected[..trajectory.len()], 1e-4);
        assert_close(&format!("{name}: estimates"), &estimates, v.floats("out/zhat_guided"), 1e-4);
        let rows = values(last).len();
        assert_close(
            "last",
            &estimates[estimates.len() - rows..],
            &v.floats("out/zhat_guided")[estimates.len() - rows..],
            1e-4,
        );
    }
}

/// File, steps, guidance scale, lambda, kappa, as the sidecar files say.
fn toy_cases() -> Vec<(String, usize, f32, f32, f32)> {
    (0..2)
        .map(|i| {
            let meta = json(&format!("flow/sampler{i}.json"))["meta"].clone();
            let number = |name: &str| meta[name].as_f64().unwrap() as f32;
            (format!("sampler{i}.safetensors"), number("steps") as usize, number("s"), number("lam"), number("kappa"))
        })
        .collect()
}

/// It was written under schema 1.
#[test]
fn the_shipped_checkpoints_settings_are_understood() {
    let path = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../checkpoints/tiny.safetensors"));
    let bytes = std::fs::read(path).unwrap();
    let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).unwrap();
    let provenance = &header.metadata().as_ref().unwrap()["provenance"];
    let provenance: serde_json::Value = serde_json::from_str(provenance).unwrap();
    assert!(provenance.get("settings_schema").is_none());
    let Settings { network_views, sample, refiner } = Settings::of(&provenance).unwrap();
    let refiner = refiner.expect("it refines initial fits");
    assert_eq!((network_views, refiner.passes, refiner.retokenize_every, refiner.lod_depth), (6, 12, 4, Some(11)));
    assert_eq!((sample.steps, sample.cfg_scale, sample.gradient_size), (50, 1.0, 128));
}
