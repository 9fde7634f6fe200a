//! A command that a launcher (`mpirun`, `srun`) has started several times over: who they are, where they compute, and how
//! they end together.

use std::{collections::BTreeMap, env, rc::Rc};

use freerange::{Device, DeviceName};
use freerange_train::{
    TrainError,
    ranks::{Ranks, Single, gather},
};

use crate::error::CliError;

/// The processes of a command, and the place of this one.
pub struct Job {
    pub ranks: Rc<dyn Ranks>,
    /// Number of this process on its machine, and how many there are.
    local: [usize; 2],
}

/// How tensors of gradients are summed over ranks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Sums {
    /// Through host memory and MPI, on any device.
    #[default]
    Host,
    /// From card to card by NCCL. Experimental: no card has run it. Needs a build with `--features nccl`.
    Nccl,
}

/// What a rank tells the others of its machine.
#[derive(serde::Serialize, serde::Deserialize)]
struct Place {
    host: String,
    /// Processors that it may run on.
    processors: Vec<usize>,
}

/// How a command ended on one rank.
#[derive(serde::Serialize, serde::Deserialize)]
struct End {
    code: u8,
    text: String,
    /// Whether it only ended because another one did.
    elsewhere: bool,
}

impl Job {
    /// This process alone, whoever else was started: for work that is not shared, or has been by the user.
    pub fn alone() -> Self {
        Self { ranks: Rc::new(Single), local: [0, 1] }
    }

    /// As [`start`](Self::start), or [`alone`](Self::alone).
    ///
    /// # Errors
    /// As [`start`](Self::start).
    pub fn start_if(shared: bool) -> Result<Self, CliError> {
        if shared { Self::start() } else { Ok(Self::alone()) }
    }

    /// Joins the other processes that were started with this one; without a launcher there are none.
    ///
    /// # Errors
    /// A launcher that started several processes, where they cannot find each other.
    pub fn start() -> Result<Self, CliError> {
        let Some(launched) = launched(|name| env::var(name).ok()) else { return Ok(Self::alone()) };
        let Some(ranks) = connect(&launched)? else { return Ok(Self::alone()) };
        let job = Self { ranks, local: [0, 1] };
        match job.find_place() {
            Ok(local) => Ok(Self { local, ..job }),
            Err(e) => job.ranks.abort(e.exit_code(), &e),
        }
    }

    /// Whether this is rank 0, which speaks and writes for all.
    pub fn first(&self) -> bool {
        self.ranks.rank() == 0
    }

    /// Number of processes.
    pub fn world(&self) -> usize {
        self.ranks.world()
    }

    /// The share of numbered work that this process does: its number, and of how many.
    pub fn share(&self) -> (usize, usize) {
        (self.ranks.rank(), self.world())
    }

    /// The device of this process. Where processes of one machine are to find one themselves, each takes another GPU.
    ///
    /// # Errors
    /// As [`DeviceName::open_telling`]; GPUs that cannot be opened are told of.
    pub fn open(&self, device: DeviceName) -> Result<Device, CliError> {
        let [local, _] = self.local;
        Ok(device.open_telling(local, &mut |note| eprintln!("{note}"))?)
    }

    /// The ranks, with sums of what is on `device` made in this way. All ranks have to call it.
    ///
    /// # Errors
    /// Where NCCL is asked for and cannot be used, on any rank.
    pub fn sums(&self, how: Sums, device: &burn::tensor::Device) -> Result<Rc<dyn Ranks>, CliError> {
        match how {
            Sums::Host => Ok(self.ranks.clone()),
            #[cfg(feature = "nccl")]
            Sums::Nccl => self.together(
                freerange_ranks::Nccl::join(self.ranks.clone(), device)
                    .map(|nccl| Rc::new(nccl) as Rc<dyn Ranks>)
                    .map_err(|e| match e {
                        TrainError::Ranks { problem } => CliError::input(problem),
                        other => other.into(),
                    }),
            ),
            #[cfg(not(feature = "nccl"))]
            Sums::Nccl => {
                let _ = device;
                let text = "--sums nccl: expected a program built with `--features nccl`, found one built without";
                self.together(Err(CliError::input(text)))
            }
        }
    }

    /// Lets all ranks go on, or none. Rank 0 then says why, whoever it was.
    ///
    /// # Errors
    /// On every rank, where one of them has one.
    pub fn together<T>(&self, own: Result<T, CliError>) -> Result<T, CliError> {
        if self.world() == 1 {
            return own;
        }
        let end =
            own.as_ref().err().map(|e| End { code: e.exit_code(), text: e.to_string(), elsewhere: e.is_elsewhere() });
        let bytes = end.as_ref().map_or(Vec::new(), |end| serde_json::to_vec(end).expect("plain text"));
        let all = gather(&*self.ranks, &bytes)?;
        let ends: Vec<(usize, End)> = all
            .iter()
            .enumerate()
            .filter(|(_, bytes)| !bytes.is_empty())
            .map(|(rank, bytes)| Ok((rank, serde_json::from_slice(bytes).map_err(CliError::failure)?)))
            .collect::<Result<_, CliError>>()?;
        let Some((rank, end)) = ends.iter().find(|(_, end)| !end.elsewhere).or(ends.first()) else { return own };
        // What all of them find alike is said once, without a name.
        let alike = ends.len() == self.world() && ends.iter().all(|(_, other)| other.text == end.text);
        let text = if alike { end.text.clone() } else { format!("rank {rank} of {}: {}", self.world(), end.text) };
        Err(CliError::agreed(if self.first() { text } else { String::new() }, end.code))
    }

    /// Rank 0 does it first, and then the others.
    ///
    /// # Errors
    /// As [`together`](Self::together).
    pub fn first_then_others<T>(&self, work: impl FnOnce() -> Result<T, CliError>) -> Result<T, CliError> {
        if self.first() {
            let done = self.together(work())?;
            self.together(Ok(done))
        } else {
            self.together(Ok(()))?;
            self.together(work())
        }
    }

    /// The end of the command: where this rank alone has failed, all are ended, since they would wait for it.
    pub fn end(self, result: Result<(), CliError>) -> Result<(), CliError> {
        match result {
            Err(e) if self.world() > 1 && !e.is_agreed() => self.ranks.abort(e.exit_code(), &e),
            result => result,
        }
    }

    /// Finds the others on this machine, and divides its processors where they are shared.
    fn find_place(&self) -> Result<[usize; 2], CliError> {
        let own = serde_json::to_vec(&Place { host: host(), processors: processors() }).map_err(CliError::failure)?;
        let all = gather(&*self.ranks, &own)?;
        let all = all.iter().map(|text| serde_json::from_slice::<Place>(text)).collect::<Result<Vec<_>, _>>();
        let all = all.map_err(CliError::failure)?;
        let (local, threads) = place(&all, self.ranks.rank());
        if self.world() > 1 && env::var_os("RAYON_NUM_THREADS").is_none() {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global();
            pool.map_err(CliError::failure)?;
        }
        Ok(local)
    }
}

/// Number among the ranks of the same machine and how many these are, and how many threads there are for each: processors
/// that several of them may use are divided.
fn place(all: &[Place], rank: usize) -> ([usize; 2], usize) {
    let own = &all[rank];
    let here: Vec<usize> = (0..all.len()).filter(|&i| all[i].host == own.host).collect();
    let mut users = BTreeMap::<usize, usize>::new();
    for &i in &here {
        all[i].processors.iter().for_each(|&processor| *users.entry(processor).or_default() += 1);
    }
    let threads: f64 = own.processors.iter().map(|processor| 1.0 / users[processor] as f64).sum();
    let local = here.iter().position(|&i| i == rank).unwrap_or(0);
    // Thirds may add up to a little less than one.
    ([local, here.len()], ((threads + 1e-6) as usize).max(1))
}

/// The name of this machine.
fn host() -> String {
    #[cfg(unix)]
    {
        let mut name = [0u8; 256];
        // SAFETY: the buffer is as long as it is said to be, less the zero at its end.
        if unsafe { libc::gethostname(name.as_mut_ptr().cast(), name.len() - 1) } == 0 {
            let end = name.iter().position(|&byte| byte == 0).unwrap_or(name.len());
            return String::from_utf8_lossy(&name[..end]).into_owned();
        }
    }
    String::new()
}

/// The processors that this process may run on; launchers may have bound it to some of them.
fn processors() -> Vec<usize> {
    #[cfg(target_os = "linux")]
    {
        // SAFETY: a set is plain bits, of which zeros are valid, and the call gets its size.
        let set = unsafe {
            let mut set: libc::cpu_set_t = std::mem::zeroed();
            (libc::sched_getaffinity(0, size_of::<libc::cpu_set_t>(), &mut set) == 0).then_some(set)
        };
        if let Some(set) = set {
            // SAFETY: the number is below that of the set's bits.
            let bound = (0..libc::CPU_SETSIZE as usize).filter(|&i| unsafe { libc::CPU_ISSET(i, &set) });
            let bound: Vec<usize> = bound.collect();
            // A container's share of time may be less than its processors; then it is as if it had the first of them.
            let allowed = std::thread::available_parallelism().map_or(bound.len(), usize::from);
            return bound.into_iter().take(allowed.max(1)).collect();
        }
    }
    (0..std::thread::available_parallelism().map_or(1, usize::from)).collect()
}

/// What a launcher says in the environment.
#[derive(Debug, PartialEq, Eq)]
struct Launched {
    by: &'static str,
    /// Processes that it started, where it says so.
    world: Option<usize>,
    /// Whether an MPI library can find the others by what it says.
    mpi: bool,
}

/// The launcher that started this process, if one did.
fn launched(variable: impl Fn(&str) -> Option<String>) -> Option<Launched> {
    let number = |name: &str| variable(name).and_then(|text| text.parse::<usize>().ok());
    let slurm = number("SLURM_STEP_NUM_TASKS");
    if let Some(world) = number("OMPI_COMM_WORLD_SIZE") {
        return Some(Launched { by: "Open MPI's mpirun", world: Some(world), mpi: true });
    }
    if let Some(world) = number("PMI_SIZE") {
        return Some(Launched { by: "a launcher that speaks PMI", world: Some(world), mpi: true });
    }
    if variable("PMIX_RANK").is_some() {
        return Some(Launched { by: "a launcher that speaks PMIx", world: slurm, mpi: true });
    }
    // A task of srun that has not been told of MPI.
    slurm.filter(|&n| n > 1).map(|n| Launched { by: "srun", world: Some(n), mpi: false })
}

/// The ranks that MPI finds; none where this process is alone.
#[cfg(feature = "mpi")]
fn connect(launched: &Launched) -> Result<Option<Rc<dyn Ranks>>, CliError> {
    use freerange_ranks::Mpi;
    if !launched.mpi {
        return Err(CliError::input(format!(
            "{} started {} processes without MPI: expected `srun --mpi=pmix` or `--mpi=pmi2`, as the MPI library was built \
             (`srun --mpi=list` lists them)",
            launched.by,
            launched.world.unwrap_or(0)
        )));
    }
    let mpi = Mpi::start()?;
    match launched.world {
        // Each would train alone, in the same folder.
        Some(expected) if expected != mpi.world() => Err(CliError::input(format!(
            "{} started {expected} processes, but the MPI library that this program was built with ({}) finds {}: \
             expected a launcher of the same library",
            launched.by,
            Mpi::library(),
            mpi.world()
        ))),
        _ => Ok(Some(Rc::new(mpi))),
    }
}

#[cfg(not(feature = "mpi"))]
fn connect(launched: &Launched) -> Result<Option<Rc<dyn Ranks>>, CliError> {
    match launched.world {
        Some(1) => Ok(None),
        // Each would do all of the work, in the same folder.
        world => Err(CliError::input(format!(
            "{} started {} processes: expected a program that can share their work, found one built without; build it with \
             `cargo build --release --features mpi`",
            launched.by,
            world.map_or("several".into(), |n| n.to_string())
        ))),
    }
}

impl CliError {
    /// Whether another rank has the reason.
    fn is_elsewhere(&self) -> bool {
        matches!(self.cause().downcast_ref(), Some(TrainError::Elsewhere { .. }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn launchers_are_known_by_what_they_say() {
        let by = |variables: &[(&str, &str)]| {
            let find = |name: &str| variables.iter().find(|(n, _)| *n == name).map(|(_, v)| v.to_string());
            launched(find).map(|l| (l.by, l.world, l.mpi))
        };
        assert_eq!(by(&[]), None);
        assert_eq!(
            by(&[("OMPI_COMM_WORLD_SIZE", "2"), ("PMIX_RANK", "1")]),
            Some(("Open MPI's mpirun", Some(2), true))
        );
        assert_eq!(by(&[("PMI_SIZE", "4")]).map(|l| (l.1, l.2)), Some((Some(4), true)));
        let pmix = [("PMIX_RANK", "0"), ("SLURM_STEP_NUM_TASKS", "8")];
        assert_eq!(by(&pmix).map(|l| (l.1, l.2)), Some((Some(8), true)));
        assert_eq!(by(&pmix[1..]), Some(("srun", Some(8), false)));
        assert_eq!(by(&[("SLURM_STEP_NUM_TASKS", "1")]), None);
    }

    #[test]
    fn processors_are_divided_where_they_are_shared() {
        let on = |host: &str, processors: std::ops::Range<usize>| Place {
            host: host.into(),
            processors: processors.collect(),
        };
        // Not bound, on two machines.
        let all = [on("a", 0..8), on("b", 0..4), on("a", 0..8), on("a", 0..8)];
        assert_eq!([0, 1, 2, 3].map(|i| place(&all, i)), [([0, 3], 2), ([0, 1], 4), ([1, 3], 2), ([2, 3], 2)]);
        // Bound: each to its own, or two to each half.
        let all = [on("a", 0..4), on("a", 4..8)];
        assert_eq!([0, 1].map(|i| place(&all, i)), [([0, 2], 4), ([1, 2], 4)]);
        let all = [on("a", 0..4), on("a", 0..4), on("a", 4..8), on("a", 4..8)];
        assert_eq!(place(&all, 3), ([3, 4], 2));
        // More processes than processors.
        assert_eq!(place(&[on("a", 0..2), on("a", 0..2), on("a", 0..2)], 1), ([1, 3], 1));
        assert_eq!(place(&[on("a", 0..3), on("a", 0..3), on("a", 0..3)], 1), ([1, 3], 1));
        assert_eq!(place(&[Place { host: processors().len().to_string(), processors: processors() }], 0).0, [0, 1]);
    }
}
