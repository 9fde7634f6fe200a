//! How the flow is integrated.

use burn::tensor::Tensor;

use crate::FlowError;

/// How the flow is integrated. All take uniform steps in time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Solver {
    /// First order, the paper's.
    #[default]
    Euler,
    /// Second order: a step with the mean of the velocities at both its ends. Two evaluations of the network per step.
    Heun,
    /// Second order from the estimates of this step and the one before, as DPM-Solver++(2M) (Lu et al. 2022), but linear in
    /// time instead of in the log of the signal-to-noise ratio, whose steps do not shrink near the data. One evaluation
    /// per step.
    Multistep,
    /// Not at all: the sample stays where it starts, and only the estimate is fed back, from step to step. Each estimate is then
    /// the mean of what is likely rather than a draw from it. For models that were trained so from fits
    /// ([`StartLoss::hold`](crate::config::StartLoss)).
    Hold,
}

/// The state that [`integrate`] hands to its callbacks.
#[derive(Clone, Debug)]
pub struct Step {
    /// Number of the step, from 0.
    pub index: usize,
    /// Time of `z`.
    pub t: f32,
    /// The sample at that time. `[b, n, 14]`
    pub z: Tensor<3>,
}

/// Integrates the flow `dz/dt = (z1_hat - z) / (1 - t)` from `z` at time `start` in `steps` uniform steps; after each,
/// `z <- z - displacement`.
///
/// `estimate` gives the guided estimate z1_hat of the clean sample, `guide` the displacement, the photometric step `lambda grad` taken at the
/// first estimate of each step (or nothing; [`Solver::Hold`] leaves it to the callbacks, which share the estimate). Returns the
/// last estimate less its displacement; the paper's, which is what it denormalises, has none.
pub fn integrate(
    mut z: Tensor<3>,
    start: f32,
    steps: usize,
    solver: Solver,
    mut estimate: impl FnMut(&Step) -> Result<Tensor<3>, FlowError>,
    mut guide: impl FnMut(&Step, &Tensor<3>) -> Result<Option<Tensor<3>>, FlowError>,
) -> Result<Tensor<3>, FlowError> {
    let time = |i: usize| start + (1.0 - start) * i as f32 / steps as f32;
    let mut last = z.clone();
    for index in 0..steps {
        if solver == Solver::Hold {
            let step = Step { index, t: start, z: z.clone() };
            last = estimate(&step)?;
            match guide(&step, &last)? {
                Some(displacement) if index + 1 == steps => return Ok(last - displacement),
                _ => continue,
            }
        }
        let (t, next) = (time(index), time(index + 1));
        let share = 1.0 / (steps - index) as f32; // of the way from z to the estimate
        let step = Step { index, t, z: z.clone() };
        let before = std::mem::replace(&mut last, estimate(&step)?);
        // Where a straight line to `goal` is at the end of this step.
        let towards = |goal: Tensor<3>| z.clone() + (goal - z.clone()).mul_scalar(share);
        let moved = match solver {
            // The velocity at the end of the last step would be one divided by zero.
            Solver::Heun if index + 1 < steps => {
                let end = Step { index, t: next, z: towards(last.clone()) };
                let velocity = (last.clone() - z.clone()).mul_scalar(1.0 / (1.0 - t));
                let at_end = (estimate(&end)? - end.z).mul_scalar(1.0 / (1.0 - next));
                z + (velocity + at_end).mul_scalar((next - t) / 2.0)
            }
            // The flow is solved exactly for an estimate that goes on changing as it did since the step before.
            Solver::Multistep if index > 0 => {
                let (left, rest) = ((steps - index) as f32, (steps - index - 1) as f32); // 1 - t before and after, in steps
                let logarithm = if rest > 0.0 { rest * (left / rest).ln() } else { 0.0 };
                towards(last.clone()) + (last.clone() - before).mul_scalar(1.0 - logarithm)
            }
            _ => towards(last.clone()),
        };
        z = match guide(&step, &last)? {
            Some(displacement) if index + 1 == steps => return Ok(last - displacement),
            Some(displacement) => moved - displacement,
            None => moved,
        };
    }
    Ok(last)
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;

    /// Data drawn from a normal distribution of mean `M` and deviation `S`: the best estimate, and the whole flow, are
    /// known.
    const M: f32 = 0.7;
    const S: f32 = 0.4;

    fn error(solver: Solver, steps: usize) -> f32 {
        let device = Device::flex();
        let noise = Tensor::<3>::from_data([[[-1.5f32, -0.3, 0.4, 2.0]]], &device);
        let mut calls = 0;
        let estimate = |s: &Step| {
            calls += 1;
            let (t, rest) = (s.t, 1.0 - s.t);
            Ok((s.z.clone() - t * M).mul_scalar(t * S * S / (t * t * S * S + rest * rest)) + M)
        };
        let found = integrate(noise.clone(), 0.0, steps, solver, estimate, |_, _| Ok(None)).unwrap();
        assert_eq!(calls, if solver == Solver::Heun { 2 * steps - 1 } else { steps });
        let expected = noise.mul_scalar(S) + M;
        (found - expected).abs().max().into_scalar()
    }

    #[test]
    fn second_order_solvers_are_of_second_order() {
        // Twice the steps: half the error, or a quarter. (The multistep solver begins with a step of first order, which
        // takes long to be outweighed.)
        for (solver, fall) in [(Solver::Euler, 1.9), (Solver::Heun, 3.7), (Solver::Multistep, 2.7)] {
            let [coarse, fine] = [80, 160].map(|n| error(solver, n));
            assert!(coarse / fine > fall && coarse > 1e-5, "{solver:?}: {coarse} {fine}");
            assert!(solver == Solver::Euler || fine < 0.05 * error(Solver::Euler, 160), "{solver:?} {fine}");
        }
        assert_eq!(error(Solver::Multistep, 1), error(Solver::Euler, 1));
    }
}
