//! Steps against Burn's AdamW, and states that go on.

use burn::{
    optim::{AdamWConfig, GradientsParams},
    tensor::Gradients,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;

#[derive(Module, Debug)]
struct Toy {
    matrix: Param<Tensor<2>>,
    vector: Param<Tensor<1>>,
    unused: Param<Tensor<1>>,
}

fn random<const D: usize>(shape: [usize; D], rng: &mut ChaCha8Rng) -> Tensor<D> {
    let values: Vec<f32> = (0..shape.iter().product()).map(|_| rng.random_range(-1.0..1.0)).collect();
    Tensor::from_data(TensorData::new(values, shape), &Device::flex())
}

fn toy() -> Toy {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    Toy {
        matrix: Param::from_tensor(random([190, 150], &mut rng).autodiff()),
        vector: Param::from_tensor(random([37], &mut rng).autodiff()),
        unused: Param::from_tensor(random([5], &mut rng).autodiff()),
    }
}

/// Of a loss whose gradient differs from step to step.
fn gradients(toy: &Toy, step: u64) -> Gradients {
    let mut rng = ChaCha8Rng::seed_from_u64(100 + step);
    let (a, b) = (random([190, 150], &mut rng).autodiff(), random([37], &mut rng).autodiff());
    ((toy.matrix.val() * a).sum() + (toy.vector.val().square() * b).sum()).backward()
}

fn values(toy: &Toy) -> [Vec<f32>; 3] {
    let weights = Weights::of(toy).0;
    std::array::from_fn(|i| weights[i].to_data().try_to_vec().unwrap())
}

fn close(a: &[f32], b: &[f32]) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(x, y)| (x - y).abs() < 2e-6)
}

fn config(decay: Decay) -> OptimizerConfig {
    OptimizerConfig { betas: (0.9, 0.95), weight_decay: 0.3, decay, ..OptimizerConfig::default() }
}

fn step(time: u64, clip: f32) -> Step {
    Step { time, rate: 1e-2 * time as f64, clip, ema: 0.7 }
}

#[test]
fn steps_and_averages_are_those_of_burn() {
    let reference = AdamWConfig::new().with_weight_decay(0.3).with_beta_1(0.9).with_beta_2(0.95).with_epsilon(EPSILON);
    let (mut reference, mut theirs) = (reference.init(), toy());
    let (mut optimizer, mut ours) = (AdamW::new(3), toy());
    let mut average = Weights::of(&ours);
    let mut expected_average = values(&ours);
    for time in 1..=6 {
        let clip = if time == 3 { 0.25 } else { 1.0 };
        let mut flat = Flat::of(&mut gradients(&ours, time), &ours);
        let norm = flat.norm(&Device::flex()).into_scalar::<f32>();
        let squares = |g: Option<Vec<f32>>| g.unwrap().iter().map(|x| f64::from(*x).powi(2)).sum::<f64>();
        let given = gradients(&theirs, time);
        let matrix = theirs.matrix.val().grad(&given).unwrap();
        let vector = theirs.vector.val().grad(&given).unwrap();
        let truth = (squares(matrix.to_data().try_to_vec().ok()) + squares(vector.to_data().try_to_vec().ok())).sqrt();
        assert!((f64::from(norm) / truth - 1.0).abs() < 1e-6, "{norm} {truth}");
        ours = optimizer.step(ours, flat, &mut average, &config(Decay::All), step(time, clip));
        let mut clipped = GradientsParams::new();
        clipped.register(theirs.matrix.id, matrix * clip);
        clipped.register(theirs.vector.id, vector * clip);
        theirs = reference.step(1e-2 * time as f64, theirs, clipped);
        let (found, expected) = (values(&ours), values(&theirs));
        for i in 0..3 {
            assert!(close(&found[i], &expected[i]), "step {time}, parameter {i}");
            for (average, x) in expected_average[i].iter_mut().zip(&expected[i]) {
                *average = 0.7 * *average + 0.3 * x;
            }
            let found: Vec<f32> = average.0[i].to_data().try_to_vec().unwrap();
            assert!(close(&found, &expected_average[i]), "average after step {time}, parameter {i}");
        }
    }
}

#[test]
fn vectors_need_not_decay() {
    let run = |decay: Decay| {
        let toy = toy();
        let flat = Flat::of(&mut gradients(&toy, 1), &toy);
        let (mut average, mut optimizer) = (Weights::of(&toy), AdamW::new(3));
        values(&optimizer.step(toy, flat, &mut average, &config(decay), step(1, 1.0)))
    };
    let (all, matrices, before) = (run(Decay::All), run(Decay::Matrices), values(&toy()));
    assert_eq!(all[0], matrices[0]);
    let kept = 1.0 - 1e-2 * 0.3;
    let undecayed: Vec<f32> =
        all[1].iter().zip(&before[1]).map(|(after, before)| after + (1.0 - kept) * before).collect();
    assert!(close(&matrices[1], &undecayed) && !close(&all[1], &undecayed));
}

#[test]
fn other_devices_compute_the_same() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut given = || random([40_000], &mut rng);
    let (weights, m, v, e, g) = (given(), given(), given().square(), given(), given());
    let factors = Factors::new(&config(Decay::All), step(4, 0.5), 2);
    let [one, two] = [update_in_place, update].map(|update| {
        let (mut moments, mut average) = ([m.clone(), v.clone()], e.clone());
        let new = update(weights.clone(), &mut moments, &mut average, g.clone(), &factors);
        let [m, v] = moments;
        [new, m, v, average].map(|t| t.into_data().try_to_vec::<f32>().unwrap())
    });
    assert!(one.iter().zip(&two).all(|(a, b)| close(a, b)));
}

#[test]
fn weights_of_which_there_is_no_copy_stay_where_they_are() {
    let vector = vec![1f32; 1000];
    let place = vector.as_ptr().cast::<u8>();
    let tensor = Tensor::<1>::from_data(TensorData::new(vector, [1000]), &Device::flex());
    let mut toy = Toy { vector: Param::from_tensor(tensor.autodiff()), ..toy() };
    let mut optimizer = AdamW::new(3);
    let mut average = Weights([190 * 150, 1000, 5].map(|n| Tensor::zeros([n], &Device::flex())).to_vec());
    for time in 1..=2 {
        let loss = (toy.matrix.val().sum() + toy.vector.val().square().sum()) * time as f32;
        let flat = Flat::of(&mut loss.backward(), &toy);
        toy = optimizer.step(toy, flat, &mut average, &config(Decay::All), step(time, 1.0));
    }
    assert_eq!(toy.vector.into_value().inner().into_data().as_bytes().as_ptr(), place);
}

#[test]
fn a_saved_state_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("optimizer.safetensors");
    let (mut toy, mut optimizer) = (toy(), AdamW::new(3));
    let mut average = Weights::of(&toy);
    let mut next = |toy: Toy, optimizer: &mut AdamW, time: u64| {
        let flat = Flat::of(&mut gradients(&toy, time), &toy);
        optimizer.step(toy, flat, &mut average, &config(Decay::All), step(time, 1.0))
    };
    toy = next(toy, &mut optimizer, 1);
    optimizer.save(&path).unwrap();
    let weights = Weights::of(&toy);
    let mut other = AdamW::load(&path, &weights, &Device::flex()).unwrap();
    assert!(other.moments[2].is_none(), "a parameter without gradients has no state");
    let copy = toy.clone();
    assert_eq!(values(&next(toy, &mut optimizer, 2)), values(&next(copy, &mut other, 2)));

    let fewer = Weights(vec![Tensor::zeros([4], &Device::flex())]);
    let e = AdamW::load(&path, &fewer, &Device::flex()).err().expect("refused").to_string();
    assert!(e.contains("`0.0`: expected 4"), "{e}");
    std::fs::write(&path, b"nonsense").unwrap();
    assert!(matches!(AdamW::load(&path, &weights, &Device::flex()), Err(TrainError::State { .. })));
}
