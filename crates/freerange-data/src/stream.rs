//! Objects in order, made ahead of time by other threads.

use std::{sync::Arc, thread};

use crossbeam_channel::{Receiver, bounded};
use freerange_splat::Statistics;

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

/// Objects `first`, `first + 1`, ... of a source, in order, made by `workers` threads that stay a little ahead.
///
/// Objects that cannot be read are left out, as long as they are few.
#[derive(Debug)]
pub struct Stream {
    queues: Vec<Receiver<Result<Object, DataError>>>,
    first: u64,
    next: u64, // counted from `first`
    broken: Vec<u64>,
}

impl Stream {
    /// Objects that each thread makes ahead.
    const AHEAD: usize = 4;
    /// Unreadable objects that are no reason to stop: so many, and one more for every [`READ_PER_BROKEN`](Self::READ_PER_BROKEN).
    const BROKEN: u64 = 3;
    /// One unreadable object in so many is too few to stop for.
    const READ_PER_BROKEN: u64 = 100;

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
        Self { queues: queues.collect(), first, next: 0, broken: Vec::new() }
    }

    /// The next object that can be read, and its number. Waits for it if need be.
    ///
    /// # Errors
    /// [`DataError::TooManyBroken`]; [`DataError::Worker`] where a thread has died.
    pub fn take_next(&mut self) -> Result<(u64, Object), DataError> {
        loop {
            let index = self.first + self.next;
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
    fn many_unreadable_objects_end_it() {
        let mut stream = Stream::start(Arc::new(Some(|i| i % 2 == 1)), 0, 2);
        let error = (0..10).find_map(|_| stream.take_next().err()).unwrap();
        let DataError::TooManyBroken { broken, read, .. } = &error else { panic!("{error}") };
        assert_eq!((*broken, *read), (4, 8));
        assert!(error.to_string().contains("no object 7"), "{error}");
    }
}
