//! COLMAP's programs. Names of options differ between versions: those that a program's help does not list are left out and told.

use std::{
    path::Path,
    process::{Command, Stdio},
};

use super::{
    bounds::Bounds,
    job::{Done, Job, failed, log_of_engine},
};
use crate::error::CliError;

/// One of COLMAP's programs, the options that it knows, and those that were passed over.
struct Program<'a> {
    file: &'a Path,
    log: &'a Path,
    bounds: &'a Bounds,
    passed_over: Vec<String>,
}

impl Program<'_> {
    /// Runs `command` with options; of alternatives `A|B` the first that its help lists.
    fn run(&mut self, command: &str, options: &[(&str, String)]) -> Result<(), CliError> {
        let help = Command::new(self.file).args([command, "-h"]).stdin(Stdio::null()).output();
        let help = help.map_err(|e| CliError::file(self.file, e))?;
        let known = format!("{}{}", String::from_utf8_lossy(&help.stdout), String::from_utf8_lossy(&help.stderr));
        let listed = |name: &&str| known.split_whitespace().any(|w| w.trim_start_matches("--") == *name);
        let mut run = Command::new(self.file);
        run.arg(command);
        for (names, value) in options {
            match names.split('|').find(listed) {
                Some(name) => drop(run.args([&format!("--{name}"), value])),
                None => self.passed_over.push(format!("{command} {names}")),
            }
        }
        run.stdin(Stdio::null()).stdout(log_of_engine(self.log)?).stderr(log_of_engine(self.log)?);
        match self.bounds.run(&mut run, &mut |_| {})?.success() {
            true => Ok(()),
            false => Err(failed(&format!("colmap {command}"), self.log)),
        }
    }
}

/// As the script for pycolmap.
pub fn run(
    (file, version): (&Path, &str),
    job: &Job,
    log: &Path,
    bounds: &Bounds,
    tell: &mut dyn FnMut(&'static str, &str, u64),
) -> Result<Done, CliError> {
    let mut colmap = Program { file, log, bounds, passed_over: Vec::new() };
    let path = |p: &Path| p.to_string_lossy().into_owned();
    let flag = |on: bool| u8::from(on).to_string();
    let (database, images) =
        (("database_path", path(&job.work.join("database.db"))), ("image_path", path(&job.images)));
    for (i, names) in job.groups.iter().enumerate() {
        tell("features", "", 0);
        let list = job.work.join(format!("photos-{i}.txt"));
        std::fs::write(&list, names.join("\n")).map_err(|e| CliError::file(&list, e))?;
        let mut options = vec![
            database.clone(),
            images.clone(),
            ("image_list_path", path(&list)),
            ("ImageReader.single_camera", flag(true)),
            ("ImageReader.camera_model", "SIMPLE_RADIAL".into()),
            ("FeatureExtraction.use_gpu|SiftExtraction.use_gpu", flag(false)),
            ("SiftExtraction.max_num_features", "16384".into()),
            ("SiftExtraction.peak_threshold", job.peak_threshold.to_string()),
            ("SiftExtraction.estimate_affine_shape", flag(job.thorough)),
            ("SiftExtraction.domain_size_pooling", flag(job.thorough)),
        ];
        let threads = "FeatureExtraction.num_threads|SiftExtraction.num_threads";
        options.extend(job.threads.map(|n| (threads, n.to_string())));
        options.extend(job.masks.as_deref().map(|masks| ("ImageReader.mask_path", path(masks))));
        colmap.run("feature_extractor", &options)?;
    }
    let matching = [
        database.clone(),
        ("FeatureMatching.use_gpu|SiftMatching.use_gpu", flag(false)),
        ("FeatureMatching.guided_matching|SiftMatching.guided_matching", flag(job.thorough)),
        ("TwoViewGeometry.filter_stationary_matches", flag(true)),
    ];
    let mut done = Done { engine: format!("COLMAP {version}"), ..Done::default() };
    let stages = if job.all_pairs { &["neighbors", "all"][..] } else { &["neighbors"][..] };
    for (i, stage) in stages.iter().copied().enumerate() {
        tell("matches", stage, 1 + 2 * i as u64);
        let mut options = matching.to_vec();
        if stage == "neighbors" {
            options.extend([("match_list_path", path(&job.pairs)), ("match_type", "pairs".into())]);
        }
        colmap.run(if stage == "neighbors" { "matches_importer" } else { "exhaustive_matcher" }, &options)?;
        tell("model", stage, 2 + 2 * i as u64);
        let out = job.work.join(format!("models-{stage}"));
        std::fs::create_dir_all(&out).map_err(|e| CliError::file(&out, e))?;
        colmap.run("mapper", &mapper(&database.1, &images.1, &path(&out), job.seed))?;
        let models = models(&out)?;
        if let Some((count, folder)) = models.first().filter(|m| done.models.first().is_none_or(|best| m.0 > *best)) {
            done.models = models.iter().map(|m| m.0).collect();
            done.pairs = Some(stage.into());
            let model = job.work.join("model");
            std::fs::create_dir_all(&model).map_err(|e| CliError::file(&model, e))?;
            for name in ["cameras.bin", "images.bin", "points3D.bin"] {
                std::fs::copy(folder.join(name), model.join(name))
                    .map_err(|e| CliError::file(&folder.join(name), e))?;
            }
            // The count is the first number of the file.
            let points = std::fs::read(model.join("points3D.bin")).unwrap_or_default();
            done.points = points.first_chunk().map_or(0, |n| u64::from_le_bytes(*n) as usize);
            if *count == job.names.len() {
                break;
            }
        }
    }
    if !colmap.passed_over.is_empty() {
        eprintln!("note: COLMAP {version} has no option {}", colmap.passed_over.join(", "));
    }
    Ok(done)
}

fn mapper(database: &str, images: &str, out: &str, seed: u64) -> Vec<(&'static str, String)> {
    vec![
        ("database_path", database.into()),
        ("image_path", images.into()),
        ("output_path", out.into()),
        ("Mapper.min_model_size", "3".into()),
        ("Mapper.num_threads", "1".into()),
        ("Mapper.random_seed|random_seed", seed.to_string()),
        ("Mapper.abs_pose_min_num_inliers", "15".into()),
        ("Mapper.init_min_tri_angle", "4".into()),
        ("Mapper.init_min_num_inliers", "30".into()),
        ("Mapper.tri_ignore_two_view_tracks", "0".into()),
    ]
}

/// The models in a folder, and how many photos each has; the largest first.
fn models(folder: &Path) -> Result<Vec<(usize, std::path::PathBuf)>, CliError> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(|e| CliError::file(folder, e))?.flatten() {
        // The count is the first number of the file.
        if let Ok(bytes) = std::fs::read(entry.path().join("images.bin"))
            && let Some(count) = bytes.first_chunk()
        {
            found.push((u64::from_le_bytes(*count) as usize, entry.path()));
        }
    }
    found.sort_by(|a, b| b.cmp(a));
    Ok(found)
}
