//! Resizing and normalizing images as the networks' authors do, on plain slices.

use freerange_raster::metrics::CHANNELS;

/// An image of 8 bits per channel, `[height, width, 3]`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Image8 {
    pub width: usize,
    pub height: usize,
    pub values: Vec<u8>,
}

impl Image8 {
    /// What a lossless file of an image in 0..1 holds: nearest of 256 levels, clamped.
    pub fn quantized(values: &[f32], width: usize, height: usize) -> Self {
        Self { width, height, values: values.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect() }
    }

    /// Bicubic (A = -0.5) with antialiasing, as Pillow resizes: the horizontal pass first, fixed-point weights,
    /// rounded to 8 bits and clipped after each pass.
    pub fn bicubic(&self, width: usize, height: usize) -> Self {
        let mut current = self.clone();
        if width != self.width {
            let taps = taps(self.width, width);
            let mut values = vec![0u8; width * self.height * CHANNELS];
            for (row, out) in
                current.values.chunks_exact(self.width * CHANNELS).zip(values.chunks_exact_mut(width * CHANNELS))
            {
                for ((first, weights), pixel) in taps.iter().zip(out.chunks_exact_mut(CHANNELS)) {
                    for (channel, value) in pixel.iter_mut().enumerate() {
                        let from = row[first * CHANNELS + channel..].iter().step_by(CHANNELS);
                        *value = rounded(weights.iter().zip(from).map(|(&w, &v)| w * i64::from(v)).sum());
                    }
                }
            }
            current = Self { width, height: self.height, values };
        }
        if height != self.height {
            let stride = width * CHANNELS;
            let mut values = vec![0u8; height * stride];
            for ((first, weights), out) in taps(self.height, height).iter().zip(values.chunks_exact_mut(stride)) {
                for (k, value) in out.iter_mut().enumerate() {
                    let from = current.values[first * stride + k..].iter().step_by(stride);
                    *value = rounded(weights.iter().zip(from).map(|(&w, &v)| w * i64::from(v)).sum());
                }
            }
            current = Self { width, height, values };
        }
        current
    }

    /// The middle `width x height` pixels.
    ///
    /// # Panics
    /// If the image is smaller.
    pub fn center_crop(&self, width: usize, height: usize) -> Self {
        assert!(width <= self.width && height <= self.height, "the crop is larger than the image");
        let (left, top) = ((self.width - width) / 2, (self.height - height) / 2);
        let rows = self.values.chunks_exact(self.width * CHANNELS).skip(top).take(height);
        let values = rows.flat_map(|row| &row[left * CHANNELS..(left + width) * CHANNELS]).copied().collect();
        Self { width, height, values }
    }

    /// Planes of `(value / 255 - mean) / deviation`, appended. `[3, height, width]`
    pub fn append_normalized(&self, mean: [f32; 3], deviation: [f32; 3], out: &mut Vec<f32>) {
        for channel in 0..CHANNELS {
            let values = self.values[channel..].iter().step_by(CHANNELS);
            out.extend(values.map(|&v| (f32::from(v) / 255.0 - mean[channel]) / deviation[channel]));
        }
    }

    /// Planes of the image in -1..1, resized bilinearly without antialiasing (pixel centers at +0.5, border pixels
    /// repeated), as PyTorch's `interpolate` does, appended. `[3, height, width]`
    pub fn append_bilinear(&self, width: usize, height: usize, out: &mut Vec<f32>) {
        let (columns, rows) = (neighbors(self.width, width), neighbors(self.height, height));
        for channel in 0..CHANNELS {
            let at = |row: usize, column: usize| {
                f32::from(self.values[(row * self.width + column) * CHANNELS + channel]) / 255.0
            };
            for &(y0, y1, fy) in &rows {
                for &(x0, x1, fx) in &columns {
                    let above = at(y0, x0) * (1.0 - fx) + at(y0, x1) * fx;
                    let below = at(y1, x0) * (1.0 - fx) + at(y1, x1) * fx;
                    out.push(2.0 * (above * (1.0 - fy) + below * fy) - 1.0);
                }
            }
        }
    }
}

/// Fractional bits of the weights: 8 bits of pixel and 2 bits for overshoot fit beside them in 32.
const PRECISION: u32 = 22;

fn rounded(sum: i64) -> u8 {
    ((sum + (1 << (PRECISION - 1))) >> PRECISION).clamp(0, 255) as u8
}

fn cubic(x: f64) -> f64 {
    const A: f64 = -0.5;
    let x = x.abs();
    if x < 1.0 {
        ((A + 2.0) * x - (A + 3.0)) * x * x + 1.0
    } else if x < 2.0 {
        (((x - 5.0) * x + 8.0) * x - 4.0) * A
    } else {
        0.0
    }
}

/// For each output pixel the first input pixel and the fixed-point weights from there.
fn taps(from: usize, to: usize) -> Vec<(usize, Vec<i64>)> {
    let scale = from as f64 / to as f64;
    let stretch = scale.max(1.0); // antialiasing: the kernel covers all the pixels that become one
    let support = 2.0 * stretch;
    (0..to)
        .map(|i| {
            let center = (i as f64 + 0.5) * scale;
            let first = (center - support + 0.5).max(0.0) as usize;
            let end = ((center + support + 0.5) as usize).min(from);
            let weights: Vec<f64> = (first..end).map(|k| cubic((k as f64 - center + 0.5) / stretch)).collect();
            let total: f64 = weights.iter().sum();
            let fixed = |w: f64| (w / total * f64::from(1u32 << PRECISION)).round() as i64;
            (first, weights.into_iter().map(fixed).collect())
        })
        .collect()
}

/// For each output pixel the two input pixels around its center and the second's share.
fn neighbors(from: usize, to: usize) -> Vec<(usize, usize, f32)> {
    let scale = from as f32 / to as f32;
    (0..to)
        .map(|i| {
            let position = ((i as f32 + 0.5) * scale - 0.5).max(0.0);
            let first = (position as usize).min(from - 1);
            (first, (first + 1).min(from - 1), position - first as f32)
        })
        .collect()
}
