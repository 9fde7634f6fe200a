//! `freerange inspect`

use std::path::PathBuf;

use freerange::{
    choose_views,
    internal::{Settings, checkpoint_header},
};
use freerange_scene::camera::{canonical_from_user, transforms_json};
use freerange_scene::{
    KeepWhole,
    inspect::{Inspection, inspect, sheet},
    write_masks,
};

use crate::{error::CliError, output::OutputFolder, photos::Photos, runtime::local_or_shipped};

/// Check a scene before reconstruction: cameras, masks, place and size of the object, and warnings.
///
/// Writes inspect.png (the cameras from above, every photo with its mask and the object's sphere), inspect.json and masks/.
/// Corrected masks can be used with --masks.
#[derive(clap::Args)]
pub struct Args {
    /// Folder with photos and cameras (transforms.json, COLMAP, Polycam, Metashape, RealityCapture, OPF), or the camera file.
    scene: PathBuf,
    /// Output folder.
    #[arg(short, long, default_value = "inspect")]
    output: PathBuf,
    #[command(flatten)]
    photos: Photos,
    /// Model whose number of network views is used [default: the built-in one].
    #[arg(long, value_name = "FILE", conflicts_with = "views")]
    checkpoint: Option<PathBuf>,
    /// Most photos that the network would see [default: as in `reconstruct`].
    #[arg(long, value_name = "K", value_parser = clap::value_parser!(u16).range(1..=256))]
    views: Option<u16>,
    /// Also write cut/: the photos undistorted and masked, with a transforms.json, for other programs.
    #[arg(long)]
    cut: bool,
    /// Print the report as JSON.
    #[arg(long)]
    json: bool,
}

/// Whole photos that are kept in memory.
const MOST_IN_MEMORY: usize = 64;

/// Runs the command.
pub fn run(args: &Args) -> Result<(), CliError> {
    let cameras = args.photos.cameras(&args.scene)?;
    // Files where there are many: whole photos would take as much memory again as those that are cut out.
    let folder = (cameras.photos.len() > MOST_IN_MEMORY).then(tempfile::tempdir).transpose();
    let folder = folder.map_err(CliError::failure)?;
    let whole = folder.as_ref().map_or(KeepWhole::Memory, |folder| KeepWhole::Folder(folder.path().into()));
    let scene = args.photos.load(cameras, whole)?;
    let views = match args.views {
        Some(k) => usize::from(k),
        None => {
            let checkpoint = local_or_shipped(args.checkpoint.as_deref())?;
            Settings::of(&checkpoint_header(checkpoint.as_deref())?.provenance)?.network_views
        }
    };
    let frame = canonical_from_user(&scene.loaded.views, &scene.frame)?;
    let shown = choose_views(&scene.loaded.views, views)?;
    let found = inspect(&scene.cameras, &scene.loaded, &scene.notes, &frame, &shown);
    let output = OutputFolder::create("inspect", &args.output)?;
    output.picture("inspect.png", &sheet(&scene.loaded, &found)?)?;
    let json = serde_json::to_string_pretty(&found).map_err(CliError::failure)?;
    output.write("inspect.json", json.as_bytes())?;
    write_masks(&output.path("masks")?, &scene.cameras, &scene.loaded)?;
    if args.cut {
        let mut frames = Vec::new();
        for view in &scene.loaded.views {
            let name = format!("images/{}.png", view.name);
            output.picture(&format!("cut/{name}"), &view.image)?;
            frames.push((name, view.camera));
        }
        output.write("cut/transforms.json", transforms_json(&frames).as_bytes())?;
    }
    output.commit()?;
    match args.json {
        true => println!("{json}"),
        false => print(args, &found),
    }
    Ok(())
}

fn print(args: &Args, found: &Inspection) {
    let shown = found.views.iter().filter(|v| v.shown).count();
    println!(
        "{}: {} cameras, {} photos, {shown} seen by the network",
        args.scene.display(),
        found.format.name(),
        found.views.len()
    );
    let [x, y, z] = found.center;
    println!("  object: middle ({x:.4}, {y:.4}, {z:.4}), radius {:.4}", found.radius);
    let [x, y, z] = found.up;
    println!("  up: ({x:.3}, {y:.3}, {z:.3})");
    for view in &found.views {
        println!(
            "  {:24} {} x {}, azimuth {:4.0}, elevation {:3.0}, mask {:4.1} %, agrees {:3.0} %{}{}",
            view.name,
            view.width,
            view.height,
            view.azimuth,
            view.elevation,
            100.0 * view.covers,
            100.0 * view.agreement,
            if view.cut_off { ", cut off" } else { "" },
            if view.shown { "" } else { ", for the optimization" },
        );
    }
    found.notes.iter().for_each(|note| println!("  {note}"));
    found.warnings.iter().for_each(|warning| println!("  warning: {warning}"));
    println!("  {}", args.output.join("inspect.png").display());
}
