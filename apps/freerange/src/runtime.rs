//! What this program is, and where it keeps things.

use std::{borrow::Cow, path::Path};

use freerange::machine::cache_folder;
use freerange_data::build::{BuildConfig, MakingConfig};

use crate::{error::CliError, progress::Progress};

/// A configuration file: training, and how `freerange-data` makes objects for it.
pub type TrainConfig = freerange_train::config::TrainConfig<MakingConfig>;

/// How shards for a training are made.
pub fn build_config(config: &TrainConfig) -> BuildConfig {
    config.data.making.build_config(config.seed, &config.depths())
}

/// The commit that this program was built from; `-dirty` if files had been changed.
pub fn commit() -> String {
    env!("FREERANGE_COMMIT").to_owned()
}

/// What hubs call a model's weights.
pub const WEIGHTS: &str = "model.safetensors";

/// The file that a checkpoint's name stands for: of `hf:owner/name[@revision]` the one in the cache, downloaded if need be.
pub fn local(path: &Path) -> Result<Cow<'_, Path>, CliError> {
    let Some(name) = path.to_str().filter(|name| name.starts_with("hf:")) else { return Ok(path.into()) };
    let Some(cache) = cache_folder() else {
        return Err(CliError::input(format!("{name}: no cache folder is known on this system: expected a file")));
    };
    let mut bar = None;
    let pinned = freerange_model::hub::Hub::new(cache).files(&name.parse()?, &[WEIGHTS], &mut |file, done, size| {
        bar.get_or_insert_with(|| Progress::new(name, size)).at(done, file);
    })?;
    bar.into_iter().for_each(|bar| bar.finish());
    Ok(pinned.folder.join(WEIGHTS).into())
}

/// [`local`] of a name that may be missing: the shipped checkpoint has none.
pub fn local_or_shipped(path: Option<&Path>) -> Result<Option<Cow<'_, Path>>, CliError> {
    path.map(local).transpose()
}
