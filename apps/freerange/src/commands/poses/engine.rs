//! Programs that find poses: COLMAP's on the PATH, or pycolmap in a Python. Run as processes; their words go to a log.

use std::{
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use super::{
    bounds::Bounds,
    job::{Done, Job, failed, log_of_engine},
};
use crate::error::CliError;

/// The script for pycolmap.
const SCRIPT: &str = include_str!("engine.py");
/// What is told of pycolmap's version by this.
const PROBE: &str = "import pycolmap; print(pycolmap.__version__)";

/// An engine that is there.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Engine {
    /// pycolmap: the Python that has it, and its version.
    Pycolmap(PathBuf, String),
    /// COLMAP's programs: the file, and its version.
    Colmap(PathBuf, String),
}

impl Engine {
    /// pycolmap in `python`, where one is named; else COLMAP's programs on the PATH, else pycolmap in `python3`.
    pub fn find(python: Option<&Path>) -> Result<Self, CliError> {
        if let Some(python) = python {
            return pycolmap(python).ok_or_else(|| {
                let what = "expected a Python that has pycolmap (pip install pycolmap), found none there";
                CliError::input(format!("--python {}: {what}", python.display()))
            });
        }
        let found = colmap(Path::new("colmap")).or_else(|| pycolmap(Path::new("python3")));
        found.ok_or_else(|| {
            CliError::input(
                "expected COLMAP on the PATH, or pycolmap in python3 or in --python PYTHON, found neither: \
                 `pip install pycolmap`, `apt install colmap` or `brew install colmap`",
            )
        })
    }

    /// Name and version.
    pub fn name(&self) -> String {
        match self {
            Self::Pycolmap(_, version) => format!("pycolmap {version}"),
            Self::Colmap(_, version) => format!("COLMAP {version}"),
        }
    }

    /// Finds poses: the model comes into `model` of the job's folder. `tell` hears of each step that begins: a word, which pairs, how many are
    /// done.
    pub fn run(
        &self,
        job: &Job,
        log: &Path,
        bounds: &Bounds,
        tell: &mut dyn FnMut(&'static str, &str, u64),
    ) -> Result<Done, CliError> {
        match self {
            Self::Pycolmap(python, _) => run_pycolmap(python, job, log, bounds, tell),
            Self::Colmap(program, version) => super::colmap::run((program, version), job, log, bounds, tell),
        }
    }
}

/// The first line that a program says, if it says something and ends well.
fn said(command: &mut Command) -> Option<String> {
    let done = command.stdin(Stdio::null()).output().ok().filter(|done| done.status.success())?;
    let text = String::from_utf8_lossy(&done.stdout).trim().lines().next()?.to_owned();
    (!text.is_empty()).then_some(text)
}

fn pycolmap(python: &Path) -> Option<Engine> {
    let version = said(Command::new(python).args(["-c", PROBE]))?;
    Some(Engine::Pycolmap(python.into(), version))
}

fn colmap(program: &Path) -> Option<Engine> {
    let line = said(Command::new(program).arg("help"))?;
    let version = line.split_whitespace().find(|w| w.starts_with(|c: char| c.is_ascii_digit()))?;
    Some(Engine::Colmap(program.into(), version.to_owned()))
}

fn run_pycolmap(
    python: &Path,
    job: &Job,
    log: &Path,
    bounds: &Bounds,
    tell: &mut dyn FnMut(&'static str, &str, u64),
) -> Result<Done, CliError> {
    let write = |name: &str, bytes: &[u8]| {
        let path = job.work.join(name);
        std::fs::write(&path, bytes).map_err(|e| CliError::file(&path, e)).map(|()| path)
    };
    let script = write("engine.py", SCRIPT.as_bytes())?;
    let asked = write("job.json", &serde_json::to_vec_pretty(job).map_err(CliError::failure)?)?;
    let errors = log_of_engine(log)?;
    let mut command = Command::new(python);
    command.arg(script).arg(asked).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(errors);
    let mut begun = 0;
    let status = bounds.run(&mut command, &mut |line| {
        let Ok(told) = serde_json::from_str::<serde_json::Value>(line) else { return };
        let what = ["features", "matches", "model"].into_iter().find(|what| told["step"] == *what);
        begun += u64::from(told["done"].as_u64().unwrap_or(0) == 0);
        tell(what.unwrap_or("model"), told["pairs"].as_str().unwrap_or(""), u64::saturating_sub(begun, 1));
    })?;
    if !status.success() {
        return Err(failed("pycolmap", log));
    }
    let result = job.work.join("result.json");
    let bytes = std::fs::read(&result).map_err(|e| CliError::file(&result, e))?;
    serde_json::from_slice(&bytes).map_err(|e| CliError::file(&result, e))
}
