//! `freerange model export`

use std::path::PathBuf;

use freerange::{
    SETTINGS_SCHEMA,
    internal::{Settings, checkpoint_bytes, checkpoint_header, network_gaussians},
};
use freerange_model::Header;

use crate::{error::CliError, output::OutputFolder, runtime};

/// Arguments of `model export`.
#[derive(clap::Args)]
pub struct Args {
    /// Output folder: config.json, model.safetensors and README.md, as model hubs expect them.
    output: PathBuf,
    /// Checkpoint to export: a file, or hf:OWNER/NAME[@REVISION] [default: the built-in one].
    #[arg(long, value_name = "FILE", requires = "license")]
    checkpoint: Option<PathBuf>,
    /// Licenses of the model, by their hub names [default: mit,apache-2.0 of the built-in model].
    #[arg(long, value_name = "LICENSES", value_delimiter = ',', value_parser = parse_license)]
    license: Vec<String>,
    /// Title of the card.
    #[arg(long, default_value = "free-range")]
    name: String,
}

/// Names that hubs use: what is not plain could break the card's head.
fn parse_license(text: &str) -> Result<String, String> {
    let plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || "-._".contains(c);
    match !text.is_empty() && text.chars().all(plain) {
        true => Ok(text.into()),
        false => Err("expected a hub's name of a license, such as mit or cc-by-4.0".into()),
    }
}

/// What is known of the shipped checkpoint; links in it lead to files beside it.
const SHIPPED_CARD: &str = include_str!("../../../../docs/model-card.md");

pub fn run(args: &Args) -> Result<(), CliError> {
    let path = runtime::local_or_shipped(args.checkpoint.as_deref())?;
    let bytes = checkpoint_bytes(path.as_deref())?;
    let checkpoint = checkpoint_header(path.as_deref())?;
    let gaussians = network_gaussians(&checkpoint.config, &checkpoint.provenance, checkpoint.depth)? as u64;
    let settings = Settings::of(&checkpoint.provenance).map_err(CliError::input)?;
    let config = serde_json::json!({
        "model_type": "free-range",
        "library_name": "freerange",
        "gaussians": gaussians,
        "architecture": checkpoint.config,
        "settings_schema": SETTINGS_SCHEMA,
        "network_views": settings.network_views,
        "sample": settings.sample,
        "refiner": settings.refiner,
    });
    let output = OutputFolder::create("model export", &args.output)?;
    output.write("config.json", (serde_json::to_string_pretty(&config).map_err(CliError::input)? + "\n").as_bytes())?;
    output.write(runtime::WEIGHTS, &bytes)?;
    output.write("README.md", card(args, &checkpoint, gaussians)?.as_bytes())?;
    output.commit()?;
    println!("{}", args.output.display());
    Ok(())
}

/// The model's card: what hubs read, how it is used, what is known of it.
fn card(args: &Args, checkpoint: &Header, gaussians: u64) -> Result<String, CliError> {
    let licenses = match args.license.is_empty() {
        true => vec!["mit".to_owned(), "apache-2.0".to_owned()],
        false => args.license.clone(),
    };
    let licenses: String = licenses.iter().map(|l| format!("- {l}\n")).collect();
    let title: String = args.name.chars().filter(|c| !c.is_control()).collect();
    let about = match args.checkpoint {
        None => SHIPPED_CARD.split_once("\n\n").map_or(SHIPPED_CARD, |(_, rest)| rest).to_owned(),
        Some(_) => {
            let provenance = serde_json::to_string_pretty(&checkpoint.provenance).map_err(CliError::input)?;
            format!("## How it was made\n```json\n{provenance}\n```\n")
        }
    };
    Ok(format!(
        "---\nlicense:\n{licenses}library_name: freerange\npipeline_tag: image-to-3d\ntags:\n- gaussian-splatting\n- 3d\n---\n\n\
         # {title}\n\n\
         Makes {gaussians} 3D Gaussians of an object from a few posed photos, with the program `freerange`:\n\n\
         ```sh\nfreerange reconstruct SCENE -o out --checkpoint model.safetensors\n```\n\n{about}"
    ))
}
