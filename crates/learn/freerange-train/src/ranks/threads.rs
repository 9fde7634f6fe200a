//! Ranks that are threads of one process, for tests.

use std::{
    fmt,
    rc::Rc,
    sync::{Arc, Condvar, Mutex},
    thread,
    time::Duration,
};

use burn::tensor::{Tensor, TensorData};

use half::bf16;

use super::{AllReduceDtype, Ranks};
use crate::TrainError;

/// Longer than any sum of a test takes to come together; a rank that has panicked never comes.
const PATIENCE: Duration = Duration::from_secs(120);

#[derive(Default)]
struct Table {
    brought: Vec<Option<Vec<f32>>>, // by rank
    sum: Arc<Vec<f32>>,
    sums: u64,
}

/// One of them.
struct Threads {
    rank: usize,
    world: usize,
    table: Arc<(Mutex<Table>, Condvar)>,
}

impl Ranks for Threads {
    fn rank(&self) -> usize {
        self.rank
    }

    fn world(&self) -> usize {
        self.world
    }

    fn sum(&self, flat: Tensor<1>, dtype: AllReduceDtype) -> Result<Tensor<1>, TrainError> {
        let device = flat.device();
        let round = |x: f32| if dtype == AllReduceDtype::Bf16 { bf16::from_f32(x).to_f32() } else { x };
        let mut own = flat.into_data().try_to_vec::<f32>().expect("f32");
        own.iter_mut().for_each(|x| *x = round(*x));
        let (table, changed) = &*self.table;
        let mut table = table.lock().expect("no rank panics here");
        let number = table.sums;
        assert!(table.brought[self.rank].replace(own).is_none(), "one vector for each sum");
        if table.brought.iter().all(Option::is_some) {
            let all: Vec<Vec<f32>> = table.brought.iter_mut().filter_map(Option::take).collect();
            assert!(all.iter().all(|v| v.len() == all[0].len()), "vectors of different lengths");
            let sum = |i: usize| round(all.iter().map(|v| v[i]).sum::<f32>());
            table.sum = Arc::new((0..all[0].len()).map(sum).collect());
            table.sums += 1;
            changed.notify_all();
        } else {
            let waited = changed.wait_timeout_while(table, PATIENCE, |table| table.sums == number);
            let (woken, late) = waited.expect("no rank panics here");
            assert!(!late.timed_out(), "a rank is missing");
            table = woken;
        }
        // Nobody can begin the sum after the next one before this rank has brought its vector to the next.
        let sum = table.sum.to_vec();
        let len = sum.len();
        Ok(Tensor::from_data(TensorData::new(sum, [len]), &device))
    }

    fn abort(&self, _: u8, why: &dyn fmt::Display) -> ! {
        panic!("{why}")
    }
}

/// What `work` gives on each of `world` ranks.
pub(crate) fn among<T: Send>(world: usize, work: impl Fn(Rc<dyn Ranks>) -> T + Sync) -> Vec<T> {
    let brought = (0..world).map(|_| None).collect();
    let table = Arc::new((Mutex::new(Table { brought, ..Table::default() }), Condvar::new()));
    thread::scope(|scope| {
        let of = |rank: usize| {
            let (table, work) = (table.clone(), &work);
            scope.spawn(move || work(Rc::new(Threads { rank, world, table })))
        };
        let handles: Vec<_> = (0..world).map(of).collect();
        handles.into_iter().map(|handle| handle.join().expect("a rank")).collect()
    })
}
