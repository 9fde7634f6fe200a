//! Where training objects come from, and how they are used.

use freerange_data::Making;
use serde::{Deserialize, de::Error};

/// Where training objects come from, and how they are used.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields, bound(deserialize = "M: Default"))]
pub struct DataConfig<M = ()> {
    /// Shards made by `freerange data build`: a folder (in a file, its path is relative to the file), or a URL (`s3://`,
    /// `gs://`, `https://`). Without it, objects are generated on the fly, without end.
    pub shards: Option<String>,
    /// Train on the shards that are finished by now where the folder is still being made. Resuming takes those finished in
    /// the meantime too: a resumed run is then not bit-identical to an uninterrupted one.
    pub allow_incomplete: bool,
    /// Objects held in memory, from which each batch is drawn.
    pub window: usize,
    /// Objects of the window that are replaced at every step.
    pub fresh: usize,
    /// Threads that make or read objects beside training.
    pub workers: usize,
    /// Virtual ranks. Object i belongs to virtual rank i mod `virtual_ranks`; each has its part of window, fresh objects and batch.
    /// Any number of processes that divides it trains the same, and each reads only its own objects.
    pub virtual_ranks: usize,
    /// Objects over which the normalization statistics are measured before training.
    pub statistics_objects: usize,
    /// How objects are made. Its fields are beside the others.
    #[serde(flatten, skip_deserializing)]
    pub making: M,
}

impl<M: Default> Default for DataConfig<M> {
    fn default() -> Self {
        Self {
            shards: None,
            allow_incomplete: false,
            window: 64,
            fresh: 2,
            workers: 1,
            virtual_ranks: 1,
            statistics_objects: 256,
            making: M::default(),
        }
    }
}

/// Reads `[data]`: its fields of training, and those that belong to whoever makes objects.
pub(super) fn with_making<'de, D: serde::Deserializer<'de>, M: Making>(
    deserializer: D,
) -> Result<DataConfig<M>, D::Error> {
    let mut training = toml::Table::deserialize(deserializer)?;
    let making: toml::Table = M::FIELDS.iter().filter_map(|field| training.remove_entry(*field)).collect();
    let wrong = |e: toml::de::Error| D::Error::custom(e.to_string().trim_end());
    let making = M::deserialize(making).map_err(wrong)?;
    let training: DataConfig<M> = training.try_into().map_err(wrong)?;
    Ok(DataConfig { making, ..training })
}
