//! Bicubic resampling of a grid of vectors, the two ways in which position embeddings are published.

/// Which source cells make up one target cell, with their weights.
type Taps = Vec<(usize, f64)>;

/// Keys' cubic convolution kernel with parameter `a`.
fn cubic(x: f64, a: f64) -> f64 {
    let x = x.abs();
    if x <= 1.0 {
        ((a + 2.0) * x - (a + 3.0)) * x * x + 1.0
    } else if x < 2.0 {
        (((x - 5.0) * x + 8.0) * x - 4.0) * a
    } else {
        0.0
    }
}

/// Four taps, also when shrinking; cells beyond the edge repeat it (PyTorch's bicubic, a = -0.75).
fn plain_taps(from: usize, to: usize) -> Vec<Taps> {
    let scale = from as f64 / to as f64;
    (0..to)
        .map(|i| {
            let center = (i as f64 + 0.5) * scale - 0.5;
            let first = center.floor();
            (-1..=2)
                .map(|k| {
                    let cell = (first + f64::from(k)).clamp(0.0, from as f64 - 1.0);
                    (cell as usize, cubic(center - first - f64::from(k), -0.75))
                })
                .collect()
        })
        .collect()
}

/// The kernel stretched to the target's spacing when shrinking, cut at the edge and normalized (Pillow's, a = -0.5).
fn antialiased_taps(from: usize, to: usize) -> Vec<Taps> {
    let scale = from as f64 / to as f64;
    let stretch = scale.max(1.0);
    (0..to)
        .map(|i| {
            let center = (i as f64 + 0.5) * scale;
            let first = (center - 2.0 * stretch + 0.5).max(0.0) as usize;
            let last = ((center + 2.0 * stretch + 0.5) as usize).min(from);
            let mut taps: Taps = (first..last).map(|j| (j, cubic((j as f64 - center + 0.5) / stretch, -0.5))).collect();
            let sum: f64 = taps.iter().map(|t| t.1).sum();
            taps.iter_mut().for_each(|t| t.1 /= sum);
            taps
        })
        .collect()
}

/// Resamples `grid` `[side, side, width]` to `[rows, columns, width]`.
pub fn resample(grid: &[f32], side: usize, [rows, columns]: [usize; 2], width: usize, antialias: bool) -> Vec<f32> {
    let taps = if antialias { antialiased_taps } else { plain_taps };
    let (down, across) = (taps(side, rows), taps(side, columns));
    let mut wide = vec![0f64; side * columns * width]; // [side, columns, width]
    for (row, out) in wide.chunks_exact_mut(columns * width).enumerate() {
        for (taps, out) in across.iter().zip(out.chunks_exact_mut(width)) {
            for &(cell, weight) in taps {
                let source = &grid[(row * side + cell) * width..][..width];
                out.iter_mut().zip(source).for_each(|(o, &s)| *o += weight * f64::from(s));
            }
        }
    }
    let mut result = Vec::with_capacity(rows * columns * width);
    for taps in &down {
        let mut line = vec![0f64; columns * width];
        for &(cell, weight) in taps {
            let source = &wide[cell * columns * width..][..columns * width];
            line.iter_mut().zip(source).for_each(|(o, &s)| *o += weight * s);
        }
        result.extend(line.into_iter().map(|x| x as f32));
    }
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_size_changes_nothing_and_constants_stay() {
        let grid: Vec<f32> = (0..5 * 5 * 2).map(|i| (i as f32).sin()).collect();
        for antialias in [false, true] {
            let same = resample(&grid, 5, [5, 5], 2, antialias);
            assert!(same.iter().zip(&grid).all(|(a, b)| (a - b).abs() < 1e-6));
            let flat = resample(&[0.75; 49], 7, [3, 11], 1, antialias);
            assert!(flat.len() == 33 && flat.iter().all(|x| (x - 0.75).abs() < 1e-6));
        }
    }
}
