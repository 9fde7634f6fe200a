//! The objects that a rank works on, and the batches drawn from them.

use std::{collections::VecDeque, sync::Arc};

use freerange_data::{Object, ObjectSource, Stream};
use freerange_model::ModelConfig;
use rand::seq::index::sample as sample_indices;

use super::Trainer;
use crate::{
    TrainError,
    batch::Batch,
    batch::part_rng,
    batch::step_rng,
    config::{DataConfig, Stage},
};

/// The objects of a virtual rank that this rank works on.
pub(super) struct VirtualRank {
    pub(super) number: usize,
    pub(super) stream: Stream,
    pub(super) window: VecDeque<(u64, Arc<Object>)>, // with their numbers
}

impl VirtualRank {
    pub(super) fn first(&self) -> u64 {
        self.window.front().map_or(0, |(number, _)| *number)
    }
}

/// The virtual ranks of a rank, their windows filled.
pub(super) fn virtual_ranks(
    data: &DataConfig,
    positions: &[u64],
    [rank, world]: [usize; 2],
    source: &Arc<dyn ObjectSource>,
) -> Result<Vec<VirtualRank>, TrainError> {
    let own = (rank..data.virtual_ranks).step_by(world);
    let count = own.len();
    // All of them begin to make objects before the first one is waited for.
    let streams: Vec<(usize, Stream)> = own
        .map(|virtual_rank| {
            (
                virtual_rank,
                Stream::one_of(count, source.clone(), positions[virtual_rank], data.virtual_ranks as u64, data.workers),
            )
        })
        .collect();
    let filled = streams.into_iter().map(|(number, mut stream)| {
        let window =
            (0..data.window / data.virtual_ranks).map(|_| stream.take_next().map(|(i, object)| (i, Arc::new(object))));
        let window = window.collect::<Result<VecDeque<_>, _>>()?;
        Ok(VirtualRank { number, stream, window })
    });
    filled.collect()
}

impl Trainer {
    /// The parts of a step's batch that this rank computes: those of its virtual ranks, one virtual rank after the other.
    pub(super) fn own_parts(&self, stage: &Stage) -> Vec<usize> {
        let count = stage.parts_per_virtual_rank(self.config.data.virtual_ranks);
        self.virtual_ranks
            .iter()
            .flat_map(|virtual_rank| virtual_rank.number * count..(virtual_rank.number + 1) * count)
            .collect()
    }

    /// Part `part` of the batch of step `index`, which must be this rank's first or follow the one before.
    pub(super) fn draw(&mut self, index: u64, part: usize) -> Result<Batch, TrainError> {
        let (stage, data) = (self.config.stage(index), &self.config.data);
        let per_virtual_rank = stage.parts_per_virtual_rank(data.virtual_ranks);
        let (virtual_rank, chunk) = (part / per_virtual_rank, part % per_virtual_rank);
        let virtual_rank =
            self.virtual_ranks.iter_mut().find(|l| l.number == virtual_rank).expect("a virtual rank of this rank");
        // Which objects the virtual rank takes is drawn where its first part draws the rest.
        let mut rng = part_rng(step_rng(self.config.seed, index), part - chunk);
        let (count, batch) = (virtual_rank.window.len(), stage.batch / data.virtual_ranks);
        let chosen: Vec<Arc<Object>> = match batch <= count {
            true => {
                sample_indices(&mut rng, count, batch).into_iter().map(|i| virtual_rank.window[i].1.clone()).collect()
            }
            false => (0..batch).map(|i| virtual_rank.window[i % count].1.clone()).collect(),
        };
        let chosen = chosen.chunks(stage.at_a_time()).nth(chunk).expect("a part of the batch");
        let model_config = ModelConfig { image_size: stage.image_size, ..self.config.model.clone() };
        let loss = &self.config.loss;
        let mut rng = if chunk > 0 { part_rng(rng, part) } else { rng };
        let batch =
            Batch::draw(chosen, stage, &model_config, loss, &self.progress.normalization, &mut rng, &self.device)?;
        if chunk + 1 == per_virtual_rank {
            for _ in 0..data.fresh / data.virtual_ranks {
                let (i, object) = virtual_rank.stream.take_next()?;
                virtual_rank.window.push_back((i, Arc::new(object)));
                virtual_rank.window.pop_front();
            }
        }
        Ok(batch)
    }

    /// Objects of this rank's virtual ranks that could not be read: before `positions`, and in all.
    pub(super) fn unreadable(&self, positions: &[(usize, u64)]) -> [u64; 2] {
        let behind = |virtual_rank: &VirtualRank| {
            let first = positions.iter().find(|(number, _)| *number == virtual_rank.number).map(|(_, first)| *first);
            virtual_rank.stream.broken().iter().filter(|&&number| Some(number) < first).count() as u64
        };
        let all = |virtual_rank: &VirtualRank| virtual_rank.stream.broken().len() as u64;
        [self.virtual_ranks.iter().map(behind).sum(), self.virtual_ranks.iter().map(all).sum()]
    }
}
