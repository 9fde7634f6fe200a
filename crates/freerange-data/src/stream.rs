//! Objects in order, made ahead of time by other threads.

use std::{sync::Arc, thread};

use crossbeam_channel::{Receiver, bounded};
use freerange_splat::Statistics;

use crate::{DataError, Object, ObjectConfig};

/// Something that has an object for every number.
pub trait ObjectSource: Send + Sync {
    /// Object number `index`; the same one each time.
    fn object(&self, index: u64) -> Result<Object, DataError>;

    /// Statistics over all its slices at `depth`, where they are known.
    fn statistics(&self, _depth: u32) -> Option<Statistics> {
        None
    }
}

/// An endless source: object `index` is generated from seed `seed + index`.
#[derive(Clone, Debug)]
pub struct Generated {
    /// How objects are made.
    pub config: ObjectConfig,
    /// Depths of the slices.
    pub depths: Vec<u32>,
    /// Seed of object 0.
    pub seed: u64,
}

impl ObjectSource for Generated {
    fn object(&self, index: u64) -> Result<Object, DataError> {
        Object::generate(self.seed.wrapping_add(index), &self.config, &self.depths)
    }
}

/// Objects `first`, `first + 1`, ... of a source, in order, made by `workers` threads that stay a little ahead.
#[derive(Debug)]
pub struct Stream {
    queues: Vec<Receiver<Result<Object, DataError>>>,
    next: u64,
}

impl Stream {
    /// Objects that each thread makes ahead.
    const AHEAD: usize = 4;

    /// Starts the threads. They end when the stream is dropped.
    pub fn start(source: Arc<dyn ObjectSource>, first: u64, workers: usize) -> Self {
        let workers = workers.max(1);
        let queues = (0..workers as u64).map(|worker| {
            let (sender, receiver) = bounded(Self::AHEAD);
            let source = source.clone();
            thread::spawn(move || {
                // Thread k makes every `workers`-th object, so that the order does not depend on who is faster.
                for index in (first + worker..).step_by(workers) {
                    if sender.send(source.object(index)).is_err() {
                        return; // nobody listens any more
                    }
                }
            });
            receiver
        });
        Self { queues: queues.collect(), next: 0 }
    }

    /// The next object. Waits for it if need be.
    pub fn take_next(&mut self) -> Result<Object, DataError> {
        let queue = &self.queues[(self.next % self.queues.len() as u64) as usize];
        let index = self.next;
        self.next += 1;
        queue.recv().map_err(|_| DataError::Worker { index })?
    }
}
