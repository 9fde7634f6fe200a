//! What programs that find cameras may take: time and memory.

use std::{
    io::{BufRead, BufReader},
    process::{Child, Command, ExitStatus},
    sync::mpsc,
    thread,
    time::Duration,
};

use freerange_scene::SceneError;
use freerange_util::Stop;

use crate::error::CliError;

/// Time between two looks at a process.
const EVERY: Duration = Duration::from_millis(50);
/// Looks at a process from one measurement of its memory to the next.
const MEASURE: usize = 5;
/// Bytes that a thread takes that looks for features in a large photo.
const THREAD: u64 = 2 << 30;

/// Limits of a search; the default has none.
#[derive(Clone, Debug, Default)]
pub struct Bounds {
    /// When to end early.
    pub stop: Stop,
    /// Most bytes of memory of the engine's processes; measured on Linux.
    pub memory: Option<u64>,
    /// Most bytes of memory of the photos that are looked at.
    pub photos_memory: Option<u64>,
}

impl Bounds {
    /// Threads that the engine may have; none: as many as it likes.
    pub fn threads(&self) -> Option<usize> {
        let cores = thread::available_parallelism().map_or(1, usize::from);
        self.memory.map(|most| ((most / THREAD) as usize).clamp(1, cores))
    }

    /// Runs a program to its end, or ends it. `line` hears of what it prints, if that is piped.
    ///
    /// On Linux the program also ends when this process is killed. On other systems it goes on then, and so do programs that it has
    /// started itself.
    pub fn run(&self, command: &mut Command, line: &mut dyn FnMut(&str)) -> Result<ExitStatus, CliError> {
        let program = command.get_program().to_os_string();
        let failed = |e| CliError::file(program.as_ref(), e);
        #[cfg(unix)]
        if self.memory.is_some() {
            // What it starts ends with it. Programs of a terminal stay in its group: Ctrl-C ends them.
            std::os::unix::process::CommandExt::process_group(command, 0);
        }
        #[cfg(target_os = "linux")]
        end_with_this_thread(command);
        let mut child = command.spawn().map_err(failed)?;
        let (send, lines) = mpsc::channel();
        if let Some(out) = child.stdout.take() {
            let read = move || BufReader::new(out).lines().map_while(Result::ok).try_for_each(|text| send.send(text));
            thread::Builder::new().name("engine".into()).spawn(read).map_err(CliError::failure)?;
        } else {
            drop(send);
        }
        let mut looks = 0usize;
        loop {
            lines.try_iter().for_each(|text| line(&text));
            if let Some(status) = child.try_wait().map_err(failed)? {
                // A process that it left behind may hold the pipe.
                while let Ok(text) = lines.recv_timeout(Duration::from_secs(1)) {
                    line(&text);
                }
                return Ok(status);
            }
            if let Err(e) = self.check(&child, looks.is_multiple_of(MEASURE)) {
                end(&mut child, self.memory.is_some());
                return Err(e);
            }
            thread::sleep(EVERY);
            looks += 1;
        }
    }

    fn check(&self, child: &Child, measure: bool) -> Result<(), CliError> {
        self.stop.check().map_err(SceneError::from)?;
        match self.memory {
            Some(most) if measure && memory_of(child.id()) > most => Err(CliError::input(format!(
                "finding the cameras took more than {} MB of memory, which is the limit: give fewer photos, or smaller ones",
                most >> 20
            ))),
            _ => Ok(()),
        }
    }
}

/// Has the kernel kill the program when the thread that spawns it ends, for whatever reason: after `kill -9` no code of ours runs.
///
/// It is the thread that counts, not the process: the caller has to wait for the program, as [`Bounds::run`] does.
#[cfg(target_os = "linux")]
fn end_with_this_thread(command: &mut Command) {
    use std::{io::Error, os::unix::process};
    let parent = std::process::id();
    let ask = move || {
        // SAFETY: sets a number of the calling process.
        if unsafe { libc::prctl(libc::PR_SET_PDEATHSIG, libc::SIGKILL as libc::c_ulong) } != 0 {
            return Err(Error::last_os_error());
        }
        // The parent may have ended before it could be asked for.
        if process::parent_id() == parent { Ok(()) } else { Err(Error::from_raw_os_error(libc::ESRCH)) }
    };
    // SAFETY: between fork and exec only system calls are made, and nothing is allocated.
    unsafe { process::CommandExt::pre_exec(command, ask) };
}

/// Ends a process, and its whole group if it has one of its own.
fn end(child: &mut Child, group: bool) {
    #[cfg(unix)]
    if let (true, Ok(id)) = (group, i32::try_from(child.id())) {
        // SAFETY: only sends a signal. The group has the id of a child that was not waited for: nobody else can have it.
        unsafe { libc::kill(-id, libc::SIGKILL) };
    }
    #[cfg(not(unix))]
    let _ = group;
    // One that has ended by itself cannot be killed, which is as well.
    drop(child.kill());
    drop(child.wait());
}

/// Bytes that the processes of a group have in memory.
#[cfg(target_os = "linux")]
fn memory_of(group: u32) -> u64 {
    let of = |folder: std::path::PathBuf| {
        let stat = std::fs::read_to_string(folder.join("stat")).ok()?;
        // After the name, which may hold anything: state, parent, group.
        let of: u32 = stat.rsplit_once(')')?.1.split_whitespace().nth(2)?.parse().ok()?;
        let status = (of == group).then(|| std::fs::read_to_string(folder.join("status")).ok()).flatten()?;
        let kb = status.lines().find_map(|l| l.strip_prefix("VmRSS:"))?.trim().trim_end_matches(" kB");
        kb.parse::<u64>().ok().map(|kb| kb << 10)
    };
    std::fs::read_dir("/proc").map_or(0, |all| all.flatten().filter_map(|entry| of(entry.path())).sum())
}

#[cfg(not(target_os = "linux"))]
fn memory_of(_: u32) -> u64 {
    0
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::{process::Stdio, sync::Arc, time::Instant};

    use super::*;

    fn shell(script: &str) -> Command {
        let mut command = Command::new("sh");
        command.args(["-c", script]).stdout(Stdio::piped());
        command
    }

    #[test]
    fn programs_end_by_themselves_late_or_when_asked_to() {
        let mut lines = Vec::new();
        let mut run = |bounds: &Bounds, script: &str| bounds.run(&mut shell(script), &mut |l| lines.push(l.to_owned()));
        assert!(run(&Bounds::default(), "echo one; echo two; exit 3").unwrap().code() == Some(3));
        let begin = Instant::now();
        let late = Stop::on(Arc::default(), Some(begin + Duration::from_millis(300)));
        // What the shell has started ends as well: it would hold the pipe for a minute.
        let late = Bounds { stop: late, memory: Some(1 << 30), ..Bounds::default() };
        assert!(run(&late, "sleep 60 & sleep 60").is_err());
        let asked = Bounds { stop: Stop::on(Arc::new(true.into()), None), ..Bounds::default() };
        assert!(run(&asked, "exec sleep 60").is_err());
        assert!(begin.elapsed() < Duration::from_secs(20));
        assert_eq!(lines, ["one", "two"]);
    }

    #[test]
    fn memory_is_that_of_all_processes() {
        let bounds = Bounds { memory: Some(40 << 20), ..Bounds::default() };
        // With a last command after it the shell waits for `sleep` and keeps its memory, instead of becoming it.
        let script = "(x=$(head -c 60000000 /dev/zero | tr '\\0' x); sleep 60; true) & wait";
        let error = bounds.run(&mut shell(script), &mut |_| {}).unwrap_err().to_string();
        assert!(error.contains("more than 40 MB"), "{error}");
        assert_eq!(bounds.threads(), Some(1));
        assert!(bounds.run(&mut shell("exit 0"), &mut |_| {}).unwrap().success());
    }
}
