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

/// The objects of a lane that this rank works on.
pub(super) struct Lane {
    pub(super) number: usize,
    pub(super) stream: Stream,
    pub(super) window: VecDeque<(u64, Arc<Object>)>, // with their numbers
}

impl Lane {
    pub(super) fn first(&self) -> u64 {
        self.window.front().map_or(0, |(number, _)| *number)
    }
}

/// The lanes of a rank, their windows filled.
pub(super) fn lanes(
    data: &DataConfig,
    positions: &[u64],
    [rank, world]: [usize; 2],
    source: &Arc<dyn ObjectSource>,
) -> Result<Vec<Lane>, TrainError> {
    let own = (rank..data.lanes).step_by(world);
    let count = own.len();
    // All of them begin to make objects before the first one is waited for.
    let streams: Vec<(usize, Stream)> = own
        .map(|lane| (lane, Stream::one_of(count, source.clone(), positions[lane], data.lanes as u64, data.workers)))
        .collect();
    let filled = streams.into_iter().map(|(number, mut stream)| {
        let window = (0..data.window / data.lanes).map(|_| stream.take_next().map(|(i, object)| (i, Arc::new(object))));
        let window = window.collect::<Result<VecDeque<_>, _>>()?;
        Ok(Lane { number, stream, window })
    });
    filled.collect()
}

impl Trainer {
    /// The parts of a step's batch that this rank computes: those of its lanes, one lane after the other.
    pub(super) fn own_parts(&self, stage: &Stage) -> Vec<usize> {
        let count = stage.parts_per_lane(self.config.data.lanes);
        self.lanes.iter().flat_map(|lane| lane.number * count..(lane.number + 1) * count).collect()
    }

    /// Part `part` of the batch of step `index`, which must be this rank's first or follow the one before.
    pub(super) fn draw(&mut self, index: u64, part: usize) -> Result<Batch, TrainError> {
        let (stage, data) = (self.config.stage(index), &self.config.data);
        let per_lane = stage.parts_per_lane(data.lanes);
        let (lane, chunk) = (part / per_lane, part % per_lane);
        let lane = self.lanes.iter_mut().find(|l| l.number == lane).expect("a lane of this rank");
        // Which objects the lane takes is drawn where its first part draws the rest.
        let mut rng = part_rng(step_rng(self.config.seed, index), part - chunk);
        let (count, batch) = (lane.window.len(), stage.batch / data.lanes);
        let chosen: Vec<Arc<Object>> = match batch <= count {
            true => sample_indices(&mut rng, count, batch).into_iter().map(|i| lane.window[i].1.clone()).collect(),
            false => (0..batch).map(|i| lane.window[i % count].1.clone()).collect(),
        };
        let chosen = chosen.chunks(stage.at_a_time()).nth(chunk).expect("a part of the batch");
        let model_config = ModelConfig { image_size: stage.image_size, ..self.config.model.clone() };
        let loss = &self.config.loss;
        let mut rng = if chunk > 0 { part_rng(rng, part) } else { rng };
        let batch =
            Batch::draw(chosen, stage, &model_config, loss, &self.progress.normalization, &mut rng, &self.device)?;
        if chunk + 1 == per_lane {
            for _ in 0..data.fresh / data.lanes {
                let (i, object) = lane.stream.take_next()?;
                lane.window.push_back((i, Arc::new(object)));
                lane.window.pop_front();
            }
        }
        Ok(batch)
    }

    /// Objects of this rank's lanes that could not be read: before `positions`, and in all.
    pub(super) fn unreadable(&self, positions: &[(usize, u64)]) -> [u64; 2] {
        let behind = |lane: &Lane| {
            let first = positions.iter().find(|(number, _)| *number == lane.number).map(|(_, first)| *first);
            lane.stream.broken().iter().filter(|&&number| Some(number) < first).count() as u64
        };
        let all = |lane: &Lane| lane.stream.broken().len() as u64;
        [self.lanes.iter().map(behind).sum(), self.lanes.iter().map(all).sum()]
    }
}
