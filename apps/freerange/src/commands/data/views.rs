//! `freerange data views`

use std::path::PathBuf;

use freerange_data::build::render_views;
use freerange_scene::camera::{View, transforms_json};

use super::build::{InputArgs, Settings};
use crate::{error::CliError, output::OutputFolder, progress::Progress};

/// Arguments of `data views`.
#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    input: InputArgs,
    #[command(flatten)]
    settings: Settings,
    /// Output folder; with several meshes, a folder each.
    #[arg(short, long)]
    output: PathBuf,
}

pub fn run(args: &Args) -> Result<(), CliError> {
    let items = args.input.items()?;
    let config = args.settings.without_input_fits(None)?;
    let single = !args.input.path().is_dir() && items.len() == 1;
    let mut bar = Progress::new("rendering", items.len());
    for index in 0..items.len() {
        let Some(item) = items.get(index) else { break };
        let (views, sets) = render_views(&item, &config)?;
        let folder = if single { args.output.clone() } else { args.output.join(&item.id) };
        let output = OutputFolder::create("data views", &folder)?;
        for view in &views {
            output.picture(&image_name(view), &view.image)?;
        }
        let all: Vec<usize> = (0..views.len()).collect();
        let mut files = vec![("transforms.json", all)];
        if let Some(sets) = sets {
            files.push(("transforms_full.json", sets.full));
            files.push(("transforms_partial.json", sets.partial));
            files.push(("transforms_val.json", sets.validation));
        }
        for (name, chosen) in files {
            let frames: Vec<_> = chosen.into_iter().map(|i| (image_name(&views[i]), views[i].camera)).collect();
            output.write(name, transforms_json(&frames).as_bytes())?;
        }
        output.commit()?;
        bar.at(index + 1, &item.id);
    }
    bar.finish();
    println!("{} objects, {} views each, in {}", items.len(), config.object.views, args.output.display());
    Ok(())
}

fn image_name(view: &View) -> String {
    format!("images/{}.png", view.name)
}
