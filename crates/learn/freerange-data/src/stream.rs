//! Objects in order, made ahead of time by other threads.

use std::{fmt::Debug, sync::Arc, thread};

use crossbeam_channel::{Receiver, bounded};
use freerange_gaussians::Statistics;
use serde::{Serialize, de::DeserializeOwned};

use crate::{DataError, Object};

/// Something that has an object for every number.
pub trait ObjectSource: Send + Sync {
    /// Object number `index`; the same one each time.
    fn object(&self, index: u64) -> Result<Object, DataError>;

    /// Statistics over all its slices at `depth`, where they are known.
    fn statistics(&self, _depth: u32) -> Option<Statistics> {
        None
    }
}

/// How objects are made that are in no shard, as a configuration says it. Whoever trains says who makes them.
pub trait Making: Clone + Debug + Default + PartialEq + Serialize + DeserializeOwned {
    /// The fields of a configuration's `[data]` that say it; all others are training's.
    const FIELDS: &[&str];

    /// Refuses impossible values.
    ///
    /// # Errors
    /// Names the field. `seed` and `depths` are those of training.
    fn check(&self, seed: u64, depths: &[u32]) -> Result<(), DataError>;

    /// Views of each object.
    fn views(&self) -> usize;

    /// Quick fits of each object.
    fn input_fits(&self) -> usize;

    /// Objects with slices at `depths`, the first one of `seed`.
    fn source(&self, depths: Vec<u32>, seed: u64) -> Arc<dyn ObjectSource>;
}

/// Objects `first`, `first + 1`, ... of a source, in order, or every so many of them, made by threads that stay a little ahead.
///
/// Objects that cannot be read are left out, as long as they are few.
#[derive(Debug)]
pub struct Stream {
    queues: Vec<Receiver<Result<Object, DataError>>>,
    first: u64,
    stride: u64,
    next: u64, // counted from `first`, in strides
    broken: Vec<u64>,
}

impl Stream {
    /// Objects that each thread makes ahead.
    const AHEAD: usize = 4;
    /// Unreadable objects that are no reason to stop: so many, and one more for every [`READ_PER_BROKEN`](Self::READ_PER_BROKEN).
    const BROKEN: u64 = 3;
    /// One unreadable object in so many is too few to stop for.
    const READ_PER_BROKEN: u64 = 100;

    /// Starts `workers` threads. They end when the stream is dropped.
    pub fn start(source: Arc<dyn ObjectSource>, first: u64, workers: usize) -> Self {
        Self::one_of(1, source, first, 1, workers)
    }

    /// One of `streams` that share memory and `workers` threads, of which each has one at least: it has objects `first`,
    /// `first + stride`, and so on.
    pub fn one_of(streams: usize, source: Arc<dyn ObjectSource>, first: u64, stride: u64, workers: usize) -> Self {
        let workers = (workers / streams).max(1);
        let ahead = (Self::AHEAD / streams).max(1);
        let queues = (0..workers as u64).map(|worker| {
            let (sender, receiver) = bounded(ahead);
            let source = source.clone();
            thread::spawn(move || {
                // Thread k makes every `workers`-th object, so that the order does not depend on who is faster.
                for index in (first + stride * worker..).step_by(stride as usize * workers) {
                    if sender.send(source.object(index)).is_err() {
                        return; // nobody listens any more
                    }
                }
            });
            receiver
        });
        Self { queues: queues.collect(), first, stride, next: 0, broken: Vec::new() }
    }

    /// The next object that can be read, and its number. Waits for it if need be.
    ///
    /// # Errors
    /// [`DataError::TooManyBroken`]; [`DataError::Worker`] where a thread has died.
    pub fn take_next(&mut self) -> Result<(u64, Object), DataError> {
        loop {
            let index = self.first + self.stride * self.next;
            let queue = &self.queues[(self.next % self.queues.len() as u64) as usize];
            self.next += 1;
            let problem = match queue.recv() {
                Ok(Ok(object)) => return Ok((index, object)),
                Ok(Err(problem)) => problem,
                Err(_) => return Err(DataError::Worker { index }),
            };
            tracing::warn!("object {index} is left out: {problem}");
            self.broken.push(index);
            let broken = self.broken.len() as u64;
            if broken > Self::BROKEN + self.next / Self::READ_PER_BROKEN {
                return Err(DataError::TooManyBroken { broken, read: self.next, last: Box::new(problem) });
            }
        }
    }

    /// Numbers of the objects that could not be read so far, in order.
    pub fn broken(&self) -> &[u64] {
        &self.broken
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every object whose number `broken` accepts cannot be read.
    struct Some(fn(u64) -> bool);

    impl ObjectSource for Some {
        fn object(&self, index: u64) -> Result<Object, DataError> {
            match self.0(index) {
                true => Err(DataError::File { path: "shard".into(), problem: format!("no object {index}") }),
                false => Ok(Object {
                    id: index.to_string(),
                    slices: Default::default(),
                    views: Vec::new(),
                    input_fits: Vec::new(),
                }),
            }
        }
    }

    #[test]
    fn a_few_unreadable_objects_are_left_out_in_order() {
        for workers in [1, 3] {
            let mut stream = Stream::start(Arc::new(Some(|i| i == 5 || i == 6 || i == 9)), 4, workers);
            let taken: Vec<(u64, String)> =
                (0..4).map(|_| stream.take_next().map(|(i, object)| (i, object.id)).unwrap()).collect();
            assert_eq!(taken, [4, 7, 8, 10].map(|i: u64| (i, i.to_string())));
            assert_eq!(stream.broken(), [5, 6, 9]);
        }
    }

    #[test]
    fn virtual_ranks_together_have_every_object() {
        let mut ranks =
            [0, 1, 2].map(|rank| Stream::one_of(3, Arc::new(Some(|i| i == 7)), 3 + rank, 3, 1 + 3 * rank as usize));
        let mut taken: Vec<u64> = ranks.iter_mut().flat_map(|s| [(); 4].map(|()| s.take_next().unwrap().0)).collect();
        assert_eq!(taken[4..8], [4, 10, 13, 16]);
        assert_eq!(ranks[1].broken(), [7]);
        taken.sort();
        assert_eq!(taken, [3, 4, 5, 6, 8, 9, 10, 11, 12, 13, 14, 16]);
    }

    #[test]
    fn many_unreadable_objects_end_it() {
        let mut stream = Stream::start(Arc::new(Some(|i| i % 2 == 1)), 0, 2);
        let error = (0..10).find_map(|_| stream.take_next().err()).unwrap();
        let DataError::TooManyBroken { broken, read, .. } = &error else { panic!("{error}") };
        assert_eq!((*broken, *read), (4, 8));
        assert!(error.to_string().contains("no object 7"), "{error}");
    }
}
