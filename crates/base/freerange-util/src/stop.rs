//! A request to end early, checked by whoever takes long.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering::Relaxed},
    },
    time::Instant,
};

/// When work has to end before it is done: when a flag is set, or at a deadline. The default never stops.
#[derive(Clone, Debug, Default)]
pub struct Stop {
    flag: Option<Arc<AtomicBool>>,
    deadline: Option<Instant>,
}

/// Why work ended before it was done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Stopped {
    /// The flag was set.
    #[error("cancelled")]
    Cancelled,
    /// The deadline has passed.
    #[error("it took too long")]
    Late,
}

impl Stop {
    /// Stops once `flag` is set, or `deadline` has passed.
    pub fn on(flag: Arc<AtomicBool>, deadline: Option<Instant>) -> Self {
        Self { flag: Some(flag), deadline }
    }

    /// Cheap enough to be called for every picture.
    ///
    /// # Errors
    /// Once work has to end, with the reason.
    pub fn check(&self) -> Result<(), Stopped> {
        if self.flag.as_ref().is_some_and(|flag| flag.load(Relaxed)) {
            return Err(Stopped::Cancelled);
        }
        match self.deadline {
            Some(deadline) if Instant::now() >= deadline => Err(Stopped::Late),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_stops_by_flag_or_deadline() {
        assert_eq!(Stop::default().check(), Ok(()));
        let flag = Arc::<AtomicBool>::default();
        let stop = Stop::on(flag.clone(), None);
        assert_eq!(stop.check(), Ok(()));
        flag.store(true, Relaxed);
        assert_eq!(stop.clone().check(), Err(Stopped::Cancelled));
        assert_eq!(Stop::on(Arc::default(), Some(Instant::now())).check(), Err(Stopped::Late));
    }
}
