//! The loss of a cloud against views, and its gradient.

use crate::{FitError, views::Targets};
use freerange_metrics::photometric_loss;
use freerange_raster::{render, render_backward};
use freerange_splat::{Cloud, channel};
use rayon::prelude::*;

/// A loss, and its gradient by the rows of the cloud.
pub(crate) struct Objective {
    pub loss: f64,
    pub gradients: Vec<f32>, // [n, 14]
}

impl Objective {
    /// Mean over the `chosen` views of `(1 - lambda) L1 + lambda (1 - SSIM)`, all over one `background`.
    pub fn photometric(
        cloud: &Cloud,
        targets: &Targets,
        chosen: &[usize],
        background: [f32; 3],
        lambda_ssim: f64,
    ) -> Result<Self, FitError> {
        let cameras: Vec<_> = chosen.iter().map(|&i| targets.cameras[i]).collect();
        let output = render(cloud.rows(), &cameras, &vec![background; chosen.len()], &targets.raster)?;
        let (width, height) = (targets.width, targets.height);
        let parts: Vec<(f64, Vec<f32>)> = output
            .rgb
            .par_chunks(width * height * 3)
            .zip(chosen)
            .map(|(image, &i)| {
                photometric_loss(image, &targets.composite(i, background), width, height, lambda_ssim as f32)
            })
            .collect::<Result<_, _>>()?;
        let share = 1.0 / chosen.len() as f32;
        let loss = parts.iter().map(|(loss, _)| loss).sum::<f64>() / chosen.len() as f64;
        let mut d_rgb: Vec<f32> = Vec::with_capacity(output.rgb.len()); // [views, h, w, 3]
        parts.iter().for_each(|(_, gradient)| d_rgb.extend(gradient.iter().map(|g| g * share)));
        let gradients = render_backward(cloud.rows(), &output, &d_rgb, &[], &[])?.gaussians;
        Ok(Self { loss, gradients })
    }

    /// Adds `weight` times the mean opacity.
    pub fn add_opacity(&mut self, cloud: &Cloud, weight: f64) {
        if weight == 0.0 {
            return;
        }
        let share = weight / cloud.len() as f64;
        for (row, gradient) in cloud.iter().zip(self.gradients.as_chunks_mut::<{ channel::COUNT }>().0) {
            let opacity = 1.0 / (1.0 + (-f64::from(row[channel::LOGIT_OPACITY])).exp());
            self.loss += share * opacity;
            gradient[channel::LOGIT_OPACITY] += (share * opacity * (1.0 - opacity)) as f32;
        }
    }

    /// Adds `weight` times the mean standard deviation.
    pub fn add_scale(&mut self, cloud: &Cloud, weight: f64) {
        if weight == 0.0 {
            return;
        }
        let share = weight / (3 * cloud.len()) as f64;
        for (row, gradient) in cloud.iter().zip(self.gradients.as_chunks_mut::<{ channel::COUNT }>().0) {
            for c in channel::LOG_SCALE {
                let term = share * f64::from(row[c]).exp();
                self.loss += term;
                gradient[c] += term as f32;
            }
        }
    }

    /// Adds the mean over the Gaussians of `sum_c weights_c (x_c - anchor_c)^2 / 2`. `weights` is `[n, 14]`.
    pub fn add_anchor(&mut self, cloud: &Cloud, anchor: &Cloud, weights: &[f32]) {
        let share = 1.0 / cloud.len() as f32;
        for (((g, x), a), w) in self.gradients.iter_mut().zip(cloud.rows()).zip(anchor.rows()).zip(weights) {
            let pull = share * w * (x - a);
            *g += pull;
            self.loss += f64::from(0.5 * pull * (x - a));
        }
    }

    /// Refuses to go on with what is not finite.
    pub fn check(&self, step: usize) -> Result<(), FitError> {
        let refuse = |what| Err(FitError::Diverged { step, what });
        if !self.loss.is_finite() {
            return refuse("the loss");
        }
        if !self.gradients.iter().all(|g| g.is_finite()) {
            return refuse("a gradient");
        }
        Ok(())
    }
}

/// Refuses to go on with a cloud that is not finite.
pub(crate) fn check_cloud(cloud: &Cloud, step: usize) -> Result<(), FitError> {
    let finite = cloud.rows().iter().all(|v| v.is_finite());
    if finite { Ok(()) } else { Err(FitError::Diverged { step, what: "a Gaussian" }) }
}

/// Gives every quaternion unit length, so that its learning rate means an angle.
pub(crate) fn normalize_rotations(cloud: &mut Cloud) {
    for row in cloud.iter_mut() {
        let q = &mut row[channel::ROTATION];
        let length = q.iter().map(|v| v * v).sum::<f32>().sqrt();
        if length > 0.0 {
            q.iter_mut().for_each(|v| *v /= length);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tests::{ball, ring};

    /// All terms together, against central differences.
    #[test]
    fn gradients_match_finite_differences() {
        let targets = Targets::new(&ring(3, 24, &ball(12, 1)), None).unwrap();
        let (anchor, mut cloud) = (ball(12, 2), ball(12, 3));
        let weights: Vec<f32> = (0..cloud.rows().len()).map(|i| 0.1 + 0.01 * (i % 7) as f32).collect();
        let value = |cloud: &Cloud| {
            let mut o = Objective::photometric(cloud, &targets, &[0, 2], [0.3, 0.6, 0.1], 0.2).unwrap();
            o.add_opacity(cloud, 0.3);
            o.add_scale(cloud, 0.7);
            o.add_anchor(cloud, &anchor, &weights);
            o
        };
        let gradients = value(&cloud).gradients;
        let largest = gradients.iter().fold(0.0f32, |m, g| m.max(g.abs()));
        assert!(largest > 0.0);
        let mut off = 0;
        for i in 0..cloud.rows().len() {
            let h = 2e-3;
            let x = cloud.rows()[i];
            cloud.rows_mut()[i] = x + h;
            let above = value(&cloud).loss;
            cloud.rows_mut()[i] = x - h;
            let below = value(&cloud).loss;
            cloud.rows_mut()[i] = x;
            let difference = ((above - below) / f64::from(2.0 * h)) as f32;
            off += usize::from((difference - gradients[i]).abs() > 0.03 * largest);
        }
        // L1 and the rasteriser's cut-offs have kinks; few differences straddle one.
        assert!(off * 20 < cloud.rows().len(), "{off} of {} gradients are off", cloud.rows().len());
    }
}
