//! Where a run's objects come from, and the statistics of them.

use std::sync::Arc;

use freerange_data::{Making, ObjectSource, Shards, Split, Store};
use freerange_gaussians::{Normalization, Statistics};
use freerange_util::sha256;

use super::Initial;
use crate::{TrainError, config::TrainConfig, validation::Validation};

/// What a new run normalizes Gaussians by.
pub(super) fn normalization(
    config: &TrainConfig,
    initial: Option<Initial>,
    source: &dyn ObjectSource,
    progress: &mut impl FnMut(&str),
) -> Result<Normalization, TrainError> {
    if let Some(Initial { checkpoint, remeasure: false }) = initial {
        return Ok(checkpoint.normalization.clone());
    }
    let count = config.data.statistics_objects as u64;
    let depth = config.stages.last().map_or(0, |s| s.depth);
    match source.statistics(depth) {
        Some(known) => Ok(known.normalization().map_err(freerange_data::DataError::from)?),
        None => {
            progress(&format!("measuring the statistics of {count} objects"));
            measure(source, count, depth)
        }
    }
}

/// The part `split` of the shards at `place`.
fn shards<M>(config: &TrainConfig<M>, place: &str, split: Split) -> Result<Shards, TrainError> {
    let open = if config.data.allow_incomplete { Shards::open_finished } else { Shards::open };
    Ok(open(&Store::open(place)?, &config.depths(), Some(split))?)
}

/// The objects, and a checksum of their description where one is wanted.
pub(super) fn training_objects<M: Making>(
    config: &TrainConfig<M>,
    checksum: bool,
) -> Result<(Arc<dyn ObjectSource>, String), TrainError> {
    Ok(match &config.data.shards {
        Some(place) => {
            let shards = shards(config, place, Split::Train)?.shuffled_by(config.seed);
            let text = || sha256(&serde_json::to_vec(shards.manifest()).expect("read from such a text"));
            let manifest = if checksum { text() } else { String::new() };
            (Arc::new(shards), manifest)
        }
        None => (made(config, 0), "generated".into()),
    })
}

/// Those of a rank to measure on, if anything is to be measured.
pub(super) fn validation_objects<M: Making>(
    config: &TrainConfig<M>,
    share: [usize; 2],
) -> Result<Option<Validation>, TrainError> {
    let count = config.validation.objects;
    Ok(match (config.validation.every, &config.data.shards) {
        (0, _) => None,
        (_, Some(place)) => {
            let shards = shards(config, place, Split::Validation)?;
            Some(Validation::new(&shards, shards.len() as u64, count, config.seed, share)?)
        }
        // Farther than training comes.
        (_, None) => Some(Validation::new(&*made(config, 1 << 31), u64::MAX, count, config.seed, share)?),
    })
}

/// Objects made on the fly, from the run's seeds on or so many farther.
fn made<M: Making>(config: &TrainConfig<M>, farther: u64) -> Arc<dyn ObjectSource> {
    let seed = config.seed.wrapping_mul(1 << 32).wrapping_add(farther);
    config.data.making.source(config.depths(), seed)
}

/// Normalization statistics over the first `count` objects at `depth`.
fn measure(source: &dyn ObjectSource, count: u64, depth: u32) -> Result<Normalization, TrainError> {
    use rayon::prelude::*;
    // Partial statistics are merged in the order of the objects, so that the result does not depend on threads.
    let parts = (0..count)
        .into_par_iter()
        .map(|i| {
            let mut statistics = Statistics::default();
            statistics.add(source.object(i)?.slice(depth)?).map_err(freerange_data::DataError::from)?;
            Ok(statistics)
        })
        .collect::<Result<Vec<_>, TrainError>>()?;
    let mut all = Statistics::default();
    parts.iter().for_each(|p| all.merge(p));
    Ok(all.normalization().map_err(freerange_data::DataError::from)?)
}
