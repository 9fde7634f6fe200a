//! Pieces of work side by side, told of in one place.

use std::{
    ops::ControlFlow,
    sync::{
        atomic::{AtomicBool, Ordering},
        mpsc::{TryRecvError, channel},
    },
};

/// Does all `jobs` at once, on rayon's threads, and returns what they give, in order. Each may send messages, which `told` hears on the calling
/// thread, with the number of the job, in the order in which they come. Once it breaks, it hears no more, and every job is answered `Break`.
/// Messages that are not heard yet are kept: a job may be done before its first is heard. A caller that is a thread of a pool itself may do a job in between, and hears of it afterwards.
///
/// Small pieces of work that follow one another leave threads idle between them; several rows of them fill each other's gaps.
///
/// # Panics
/// If a job or `told` does.
pub fn side_by_side<J, M, T>(jobs: Vec<J>, mut told: impl FnMut(usize, M) -> ControlFlow<()>) -> Vec<T>
where
    J: FnOnce(&mut dyn FnMut(M) -> ControlFlow<()>) -> T + Send,
    M: Send,
    T: Send,
{
    let (sender, receiver) = channel();
    let ended = &AtomicBool::new(false);
    let mut results: Vec<Option<T>> = jobs.iter().map(|_| None).collect();
    rayon::in_place_scope(|scope| {
        for (number, (job, result)) in jobs.into_iter().zip(&mut results).enumerate() {
            let sender = sender.clone();
            scope.spawn(move |_| {
                let mut tell = |message| {
                    if ended.load(Ordering::Relaxed) {
                        return ControlFlow::Break(());
                    }
                    sender.send((number, message)).expect("the receiver outlives the scope");
                    ControlFlow::Continue(())
                };
                *result = Some(job(&mut tell));
            });
        }
        drop(sender);
        // The scope waits for all jobs, even where `told` panics.
        let _end = End(ended);
        // A thread of the pool must not wait for the others: it may be the only one.
        let pooled = rayon::current_thread_index().is_some();
        loop {
            let next =
                if pooled { receiver.try_recv() } else { receiver.recv().map_err(|_| TryRecvError::Disconnected) };
            match next {
                Ok((number, message)) if !ended.load(Ordering::Relaxed) => {
                    ended.store(told(number, message).is_break(), Ordering::Relaxed);
                }
                Ok(_) => {}
                Err(TryRecvError::Empty) => {
                    rayon::yield_now();
                }
                Err(TryRecvError::Disconnected) => break,
            }
        }
    });
    results.into_iter().map(|result| result.expect("every job ends before the scope does")).collect()
}

/// Ends the jobs when it goes.
struct End<'a>(&'a AtomicBool);

impl Drop for End<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Job = Box<dyn FnOnce(&mut dyn FnMut(u32) -> ControlFlow<()>) -> u32 + Send>;

    /// Each tells 0, 1, 2, ... until it is ended or has told `count`, and gives how many it told.
    fn jobs(counts: &[u32]) -> Vec<Job> {
        let job = |count: u32| -> Job {
            Box::new(move |tell| (0..count).take_while(|&i| tell(i).is_continue()).count() as u32)
        };
        counts.iter().map(|&count| job(count)).collect()
    }

    fn all_is_told_in_order() {
        let mut told = vec![Vec::new(); 4];
        let caller = std::thread::current().id();
        let counts = [100, 0, 300, 7];
        let given = side_by_side(jobs(&counts), |number, message| {
            assert_eq!(std::thread::current().id(), caller);
            told[number].push(message);
            ControlFlow::Continue(())
        });
        assert_eq!(given, counts);
        for (told, count) in told.iter().zip(counts) {
            assert!(told.iter().copied().eq(0..count), "{told:?}");
        }
    }

    #[test]
    fn from_outside_and_within_pools_of_any_size() {
        all_is_told_in_order();
        for threads in [1, 3] {
            rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(all_is_told_in_order);
        }
        assert!(side_by_side(jobs(&[]), |_, _| ControlFlow::Continue(())).is_empty());
    }

    #[test]
    fn once_ended_nothing_is_heard_and_all_end() {
        let mut heard = 0;
        let given = side_by_side(jobs(&[u32::MAX, u32::MAX, u32::MAX]), |_, _| {
            heard += 1;
            if heard == 10 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        assert!(heard == 10 && given.len() == 3);
    }

    #[test]
    #[should_panic(expected = "as told")]
    fn a_panic_of_a_job_is_the_callers() {
        let job = |_: &mut dyn FnMut(()) -> ControlFlow<()>| panic!("as told");
        side_by_side(vec![job], |_, ()| ControlFlow::Continue(()));
    }

    #[test]
    #[should_panic(expected = "had enough")]
    fn a_panic_of_the_listener_ends_the_jobs() {
        side_by_side(jobs(&[u32::MAX, u32::MAX]), |_, _| panic!("had enough"));
    }
}
