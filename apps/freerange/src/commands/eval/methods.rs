//! What makes the Gaussians.

use std::{
    ops::ControlFlow,
    path::{Path, PathBuf},
    sync::Arc,
};

use freerange::{
    FrameConfig, Options, Reconstructor, Up, View,
    internal::{is_without_network, optimize_alone},
    to_canonical, to_user,
};
use freerange_eval::{
    MeshSurface,
    record::{Case, ViewSet},
    runner::{self, Reconstructed},
};
use freerange_gaussians::{Gaussians, read_ply};
use freerange_optim::{FitConfig, Rates, fit};
use serde_json::{Value, json};

use super::oracle::on_true_surface;
use crate::error::CliError;

/// What is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum MethodName {
    /// The model.
    Model,
    /// The same pipeline without the network: initial fits, then the optimization.
    Start,
    /// The model's result with a layer of Gaussians on the true surface, optimized again. Needs objects with meshes.
    Oracle,
    /// 3DGS-MCMC on the input views alone.
    Fit,
    /// No Gaussians: a white image.
    White,
    /// Gaussians of any program: see --ply.
    Ply,
}

/// A way to make Gaussians for input views.
#[derive(Clone)]
pub enum Method {
    /// The model.
    Model {
        /// Itself.
        model: Arc<Reconstructor>,
        /// How it samples.
        options: Box<Options>,
        /// SHA-256 of the checkpoint.
        sha256: String,
        /// Whether the true surface is given away.
        oracle: bool,
    },
    /// 3DGS-MCMC; one fit per seed.
    Fit {
        /// Its configuration, but for the seed.
        config: Box<FitConfig>,
        /// Seeds.
        seeds: Vec<u64>,
        /// Which way is up.
        up: Up,
    },
    /// Nothing.
    White,
    /// `NAME.ply` in this folder, or in `full/` and `partial/` below it.
    Ply(PathBuf),
}

/// The baseline: 3DGS-MCMC on the input photos alone. Rates are for long fits that start from the hull of few masks.
pub fn fit_config(iterations: usize, size: u32) -> FitConfig {
    FitConfig {
        iterations,
        render_size: Some(size),
        rates: Rates { mean: 1.5e-3, scale: 5e-3, ..FitConfig::default().rates },
        final_mean_rate: 1.5e-5,
        ..FitConfig::default()
    }
}

impl runner::Method for Method {
    fn label(&self) -> String {
        match self {
            Self::Model { oracle: true, .. } => "on the true surface".into(),
            Self::Model { options, .. } => {
                let what = if is_without_network(options) { "without the network" } else { "model" };
                match options.pipeline.optimize.iterations {
                    0 => what.into(),
                    steps => format!("{what}, optimized {steps}"),
                }
            }
            Self::Fit { .. } => "3DGS-MCMC fit".into(),
            Self::White => "white".into(),
            Self::Ply(folder) => folder.file_name().map_or_else(|| "ply".into(), |n| n.to_string_lossy().into_owned()),
        }
    }

    fn make(&self, case: &Case, inputs: &[View], truth: Option<&MeshSurface>) -> Result<Reconstructed, String> {
        self.gaussians(case, inputs, truth).map_err(|e| e.to_string())
    }
}

impl Method {
    /// What its numbers depend on.
    pub fn settings(&self) -> Value {
        match self {
            Self::Model { options, sha256, oracle, .. } => {
                let name = match (oracle, is_without_network(options)) {
                    (true, _) => "oracle",
                    (false, true) => "start",
                    (false, false) => "model",
                };
                json!({
                    "name": name, "checkpoint_sha256": sha256, "pipeline": options.pipeline,
                    "seeds": options.seeds, "up": format!("{:?}", options.frame.up).to_lowercase(),
                })
            }
            Self::Fit { config, seeds, up } => json!({
                "name": "fit", "fit": config, "seeds": seeds, "up": format!("{up:?}").to_lowercase(),
            }),
            Self::White => json!({ "name": "white" }),
            Self::Ply(folder) => json!({ "name": "ply", "folder": folder }),
        }
    }

    fn gaussians(&self, case: &Case, inputs: &[View], truth: Option<&MeshSurface>) -> Result<Reconstructed, CliError> {
        let mut notes = Vec::new();
        let clouds = match self {
            Self::Model { oracle: true, .. } if truth.is_none() => {
                let text = "--method oracle: expected objects with meshes: generated ones, or --scenes with --meshes";
                return Err(CliError::input(text));
            }
            Self::Model { model, options, oracle, .. } => {
                let result = model.run(inputs, options, &mut |_| ControlFlow::Continue(()))?;
                notes = result.notes.into_iter().map(|note| note.text).collect();
                let samples = result.samples.into_iter().map(|s| (s.seed, s.gaussians));
                match truth.filter(|_| *oracle) {
                    None => samples.collect(),
                    Some(truth) => {
                        let again = |(seed, cloud): (u64, Gaussians)| {
                            let cloud = on_true_surface(&cloud, truth, inputs);
                            Ok((seed, optimize_alone(inputs, options, &cloud, seed)?))
                        };
                        samples.map(again).collect::<Result<_, CliError>>()?
                    }
                }
            }
            Self::Fit { config, seeds, up } => {
                let (frame, canonical) = to_canonical(inputs, &FrameConfig { up: *up, ..FrameConfig::default() })?;
                let fitted = |&seed: &u64| {
                    let config = FitConfig { seed, ..(**config).clone() };
                    let cloud = fit(&canonical, None, &config, |_| ControlFlow::Continue(()))?;
                    Ok((seed, to_user(&cloud, &frame.canonical_from_user)))
                };
                notes = frame.notes.clone();
                seeds.iter().map(fitted).collect::<Result<_, CliError>>()?
            }
            Self::White => vec![(0, Gaussians::default())],
            Self::Ply(folder) => {
                let file = read_ply(&ply_file(folder, &case.object, case.views)?)?;
                notes = file.notes.into_iter().map(|note| note.text).collect();
                vec![(0, file.splats.cloud)]
            }
        };
        Ok(Reconstructed { clouds, notes })
    }
}

/// `NAME.ply`, in the folder of the view set where there is one.
fn ply_file(folder: &Path, object: &str, views: ViewSet) -> Result<PathBuf, CliError> {
    // A name comes from the data; it must not lead out of the folder.
    if object.is_empty() || object.contains(['/', '\\']) {
        return Err(CliError::input(format!("expected an object's name without slashes, found {object:?}")));
    }
    let own = folder.join(views.to_string());
    Ok(if own.is_dir() { own } else { folder.to_path_buf() }.join(format!("{object}.ply")))
}
