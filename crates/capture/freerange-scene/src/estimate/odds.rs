//! Log odds of pixels for the object, and the cheapest cut for them.

use super::maxflow::Grid;
use super::mixture::Mixture;
use super::picture::{Picture, STEPS};
use super::plane::Table;
use super::shown::Shown;

/// What parting two like neighbors costs, in units of a pixel's log odds.
const SMOOTHNESS: f32 = 40.0;

/// No pixel's log odds count for more.
const MOST: f32 = 6.0;

/// Most that is believed of the table: something else may lie there. Less while masks are refined, where others have a say.
const TRUST: f32 = 0.99;

const TRUST_MENDING: f32 = 0.5;

/// Most that is believed of the color that the other views show.
const TRUST_OTHERS: f32 = 0.9;

/// Costs are whole numbers: this many to one.
const UNIT: f32 = 1024.0;

/// Log density of a color that nobody has seen before: even over Lab.
const NOVEL: f32 = -12.9;

/// How likely a color is that is so far from the one expected: a density in three dimensions that falls exponentially, its logarithm.
fn log_likely(off: f32, scale: f32) -> f32 {
    -2.0 * off / scale - (std::f32::consts::PI * scale.powi(3)).ln()
}

fn log_add(a: f32, b: f32) -> f32 {
    let most = a.max(b);
    most + ((a - most).exp() + (b - most).exp()).ln()
}

/// Log odds of each pixel for the object, at the pixels `wanted`; 0 elsewhere. `[h, w]`
pub(super) fn odds(
    picture: &Picture,
    object: &Mixture,
    behind: &Mixture,
    table: Option<&Table>,
    shown: Option<&Shown>,
    wanted: impl Fn(usize) -> bool,
) -> Vec<f32> {
    (0..picture.lab.len())
        .map(|k| {
            if !wanted(k) {
                return 0.0;
            }
            let color = picture.lab[k];
            let rest = log_add(behind.log_density(color) - 0.05, NOVEL - 3.0);
            // An object may have any color that the scene has, if seldom.
            let own = log_add(log_add(object.log_density(color) - 0.16, NOVEL - 2.3), rest - 3.0);
            let rest = match table {
                Some(table) if table.trust[k] > 0.0 => {
                    let most = if shown.is_some() { TRUST_MENDING } else { TRUST };
                    let (trust, scale) = (most * table.trust[k], table.scale[k]);
                    log_add(trust.ln() + log_likely(table.off[k], scale), (1.0 - trust).ln() + rest)
                }
                _ => rest,
            };
            let own = match shown {
                Some(shown) if shown.alpha[k] > 0.0 => {
                    let trust = TRUST_OTHERS * shown.alpha[k];
                    let off = picture.smooth[k].distance(shown.color[k]);
                    log_add(trust.ln() + log_likely(off, shown.scale), (1.0 - trust).ln() + own)
                }
                _ => own,
            };
            (own - rest).clamp(-MOST, MOST)
        })
        .collect()
}

/// The cheapest cut for these log odds. `bounds`: what is inside in any case, and outside of what nothing is.
pub(super) fn cut(picture: &Picture, odds: &[f32], bounds: Option<(&[bool], &[bool])>) -> Vec<bool> {
    let (w, h) = (picture.width(), picture.height());
    let mut grid = Grid::new(w, h);
    for k in 0..w * h {
        let (x, y) = (k % w, k / w);
        let odds = match bounds {
            Some((inner, _)) if inner[k] => 1e4,
            Some((_, outer)) if !outer[k] => -1e4,
            _ => odds[k],
        };
        grid.set_terminal(x, y, (odds * UNIT) as i32);
        for which in 0..STEPS.len() {
            grid.set_edge(x, y, which, (SMOOTHNESS * UNIT * picture.alike[k][which]) as i32);
        }
    }
    grid.cut()
}
