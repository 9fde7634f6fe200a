//! `.splat`: 32 bytes per Gaussian, in the user's frame, those that show most first.
//!
//! Position `f32 x 3`, standard deviations `f32 x 3`, color and opacity `u8 x 4`, rotation `w x y z` as `u8 x 4`
//! around 128. The layout is that of the viewer by Kwok (github.com/antimatter15/splat), which has no other document.

use crate::{Gaussians, channel};
use freerange_util::Invalid;

use crate::formats::{
    Decoded, Encoded,
    error::{CUT_OFF, problem},
    quantize::{Row, byte, log_scale, logit_of_byte, set_rotation, unorm8},
};

const BYTES: usize = 32;

pub fn encode(cloud: &Gaussians) -> Encoded {
    // Viewers that stream show what comes first while the rest arrives.
    let weight: Vec<f64> = (0..cloud.len()).map(|i| cloud.scale(i).element_product() * cloud.opacity(i)).collect();
    let mut order: Vec<usize> = (0..cloud.len()).collect();
    order.sort_by(|&i, &j| weight[j].total_cmp(&weight[i]));
    let mut bytes = Vec::with_capacity(cloud.len() * BYTES);
    let mut clipped = 0usize;
    for i in order {
        let color = cloud.color(i).to_array();
        clipped += usize::from(color.iter().any(|c| !(-0.002..=1.002).contains(c)));
        let q = cloud.rotation(i);
        cloud.row(i)[channel::MEAN].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
        // A deviation that 32 bits cannot hold is as large as they can.
        let largest = f64::from(f32::MAX);
        cloud.scale(i).to_array().iter().for_each(|v| bytes.extend((v.min(largest) as f32).to_le_bytes()));
        bytes.extend(color.map(unorm8));
        bytes.push(unorm8(cloud.opacity(i)));
        bytes.extend([q.w, q.x, q.y, q.z].map(|v| byte(v * 128.0 + 128.0)));
    }
    Encoded { bytes, notes: clip_note(clipped, "colors beyond 0..1") }
}

pub fn decode(bytes: &[u8]) -> Result<Decoded, Invalid> {
    let (rows, rest) = bytes.as_chunks::<BYTES>();
    if !rest.is_empty() {
        let found = format!("{}: {CUT_OFF}, or no .splat", bytes.len());
        return Err(problem("length", "a multiple of 32 bytes", found));
    }
    let mut cloud = Vec::with_capacity(rows.len() * channel::COUNT);
    for (i, record) in rows.iter().enumerate() {
        let (floats, small) = record.split_at(24);
        let float = |k: usize| f32::from_le_bytes([0, 1, 2, 3].map(|b| floats[4 * k + b]));
        let mut row = Row::default();
        for k in 0..3 {
            row[k] = float(k);
            let scale = f64::from(float(3 + k));
            if scale < 0.0 {
                return Err(problem(format!("Gaussian {i}, scale {k}"), "a number, at least 0", scale));
            }
            row[channel::LOG_SCALE.start + k] = log_scale(scale);
            row[channel::COLOR.start + k] = (f64::from(small[k]) / 255.0) as f32;
        }
        row[channel::LOGIT_OPACITY] = logit_of_byte(small[3]);
        set_rotation(&mut row, [4, 5, 6, 7].map(|k| (f64::from(small[k]) - 128.0) / 128.0));
        cloud.extend(row);
    }
    Ok(Decoded { splats: Gaussians::from_rows(cloud).into(), ..Decoded::default() })
}

/// A sentence for the user if anything was clipped.
pub fn clip_note(count: usize, what: &str) -> Vec<String> {
    if count == 0 {
        Vec::new()
    } else {
        vec![format!("{count} Gaussians have {what}, which the format cannot hold: clipped")]
    }
}
