//! The published weights of the networks: which files, whence, how they are found and checked.

#[cfg(feature = "fetch")]
mod fetch;

use std::path::{Path, PathBuf};

use freerange_util::sha256_of;

use crate::metrics::MetricsError;
#[cfg(feature = "fetch")]
pub use fetch::{FetchOptions, fetch};

/// Files that belong together, by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WeightSet {
    /// The name in commands.
    pub name: &'static str,
    /// What it is for.
    pub purpose: &'static str,
    /// The license that its authors publish it under.
    pub license: &'static str,
    /// The files, in the order in which networks are built from them.
    pub files: &'static [WeightFile],
}

/// One file of weights.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WeightFile {
    /// Path below a folder of weights, with `/`. Where it ends with `/` it names a folder of files.
    pub path: &'static str,
    /// Where it is published.
    pub origin: Origin,
    /// SHA-256 in hexadecimal, or the digits that are known of it (PyTorch's hub writes the first eight into the file
    /// name). Empty where the authors publish none: what the first download had is then written beside the file, and
    /// holds from then on.
    pub sha256: &'static str,
    /// What is taken where the published file is not there.
    pub twin: Option<Twin>,
}

/// Another file with the tensors of a published one that are read: what `tools/lpips_weights.py` makes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Twin {
    /// Path below a folder of weights, with `/`.
    pub path: &'static str,
    /// SHA-256, hexadecimal.
    pub sha256: &'static str,
}

/// Where a file is published.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// A file of the main branch of a model on the Hugging Face hub.
    Hub {
        /// `owner/name`.
        repository: &'static str,
        /// Path in the repository.
        path: &'static str,
    },
    /// A file at a fixed address of its authors.
    Url(&'static str),
    /// A member of a zip archive (a folder, where it ends with `/`) at a fixed address of its authors.
    Zip {
        /// The archive's address.
        url: &'static str,
        /// Path in the archive.
        member: &'static str,
    },
}

const fn url(path: &'static str, url: &'static str, sha256: &'static str) -> WeightFile {
    WeightFile { path, origin: Origin::Url(url), sha256, twin: None }
}

const fn or(file: WeightFile, path: &'static str, sha256: &'static str) -> WeightFile {
    WeightFile { twin: Some(Twin { path, sha256 }), ..file }
}

const fn hub(path: &'static str, repository: &'static str, file: &'static str) -> WeightFile {
    WeightFile { path, origin: Origin::Hub { repository, path: file }, sha256: "", twin: None }
}

const fn member(path: &'static str, url: &'static str, member: &'static str) -> WeightFile {
    WeightFile { path, origin: Origin::Zip { url, member }, sha256: "", twin: None }
}

const DINO_B16: WeightFile = url(
    "dino_vitbase16_pretrain.pth",
    "https://dl.fbaipublicfiles.com/dino/dino_vitbase16_pretrain/dino_vitbase16_pretrain.pth",
    "",
);
const DREAMSIM_ENSEMBLE: &str =
    "https://github.com/ssundaram21/dreamsim/releases/download/v0.2.0-checkpoints/dreamsim_ensemble_checkpoint.zip";
const DREAMSIM_DINO: &str =
    "https://github.com/ssundaram21/dreamsim/releases/download/v0.2.0-checkpoints/dreamsim_dino_vitb16_checkpoint.zip";

/// Every known set.
pub const SETS: &[WeightSet] = &[
    WeightSet {
        name: "lpips-alex",
        purpose: "LPIPS on AlexNet",
        license: "backbone BSD-3-Clause (torchvision), heads BSD-2-Clause (lpips)",
        files: &[
            or(
                url(
                    "alexnet-owt-7be5be79.pth",
                    "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth",
                    "7be5be79",
                ),
                "alexnet-owt-7be5be79.safetensors",
                "56010723d1a158768cf1cd27fa73a2b261ceb6633300f22a8381b4865286a2e3",
            ),
            url(
                "lpips/v0.1/alex.pth",
                "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/alex.pth",
                "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
            ),
        ],
    },
    WeightSet {
        name: "lpips-vgg",
        purpose: "LPIPS on VGG16",
        license: "backbone BSD-3-Clause (torchvision), heads BSD-2-Clause (lpips)",
        files: &[
            or(
                url("vgg16-397923af.pth", "https://download.pytorch.org/models/vgg16-397923af.pth", "397923af"),
                "vgg16-397923af.safetensors",
                "4b2a978702e2ec75b21297ff870088260d11769286d67fe6500c3f5ef7ce52bd",
            ),
            url(
                "lpips/v0.1/vgg.pth",
                "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/master/lpips/weights/v0.1/vgg.pth",
                "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
            ),
        ],
    },
    WeightSet {
        name: "fid",
        purpose: "FID: Inception-v3 of TensorFlow's 2015 graph, as pytorch-fid publishes it",
        license: "Apache-2.0 (pytorch-fid)",
        files: &[url(
            "pt_inception-2015-12-05-6726825d.pth",
            "https://github.com/mseitzer/pytorch-fid/releases/download/fid_weights/pt_inception-2015-12-05-6726825d.pth",
            "6726825d",
        )],
    },
    WeightSet {
        name: "dinov2-small",
        purpose: "DINO similarity; image encoder",
        license: "Apache-2.0",
        files: &[
            hub("dinov2-small/model.safetensors", "facebook/dinov2-small", "model.safetensors"),
            hub("dinov2-small/config.json", "facebook/dinov2-small", "config.json"),
        ],
    },
    WeightSet {
        name: "dinov2-base",
        purpose: "DINO similarity; image encoder",
        license: "Apache-2.0",
        files: &[
            hub("dinov2-base/model.safetensors", "facebook/dinov2-base", "model.safetensors"),
            hub("dinov2-base/config.json", "facebook/dinov2-base", "config.json"),
        ],
    },
    WeightSet {
        name: "dinov2-large",
        purpose: "DINO similarity; image encoder",
        license: "Apache-2.0",
        files: &[
            hub("dinov2-large/model.safetensors", "facebook/dinov2-large", "model.safetensors"),
            hub("dinov2-large/config.json", "facebook/dinov2-large", "config.json"),
        ],
    },
    WeightSet {
        name: "dreamsim",
        purpose: "DreamSim, the ensemble of DINO, CLIP and OpenCLIP",
        license: "adapter and CLIP MIT (dreamsim, CLIP, OpenCLIP), DINO Apache-2.0",
        files: &[
            DINO_B16,
            member("dreamsim_ensemble/clip_vitb16_pretrain.pth.tar", DREAMSIM_ENSEMBLE, "clip_vitb16_pretrain.pth.tar"),
            member(
                "dreamsim_ensemble/open_clip_vitb16_pretrain.pth.tar",
                DREAMSIM_ENSEMBLE,
                "open_clip_vitb16_pretrain.pth.tar",
            ),
            member("dreamsim_ensemble/ensemble_lora/", DREAMSIM_ENSEMBLE, "ensemble_lora/"),
        ],
    },
    WeightSet {
        name: "dreamsim-dino",
        purpose: "DreamSim, the single DINO ViT-B/16",
        license: "adapter MIT (dreamsim), DINO Apache-2.0",
        files: &[
            DINO_B16,
            member("dreamsim_dino_vitb16/dino_vitb16_single_lora/", DREAMSIM_DINO, "dino_vitb16_single_lora/"),
        ],
    },
];

/// The set of this name.
///
/// # Errors
/// If there is none.
pub fn set(name: &str) -> Result<&'static WeightSet, MetricsError> {
    SETS.iter().find(|set| set.name == name).ok_or_else(|| MetricsError::UnknownWeights {
        found: name.to_owned(),
        expected: SETS.iter().map(|set| set.name).collect::<Vec<_>>().join(", "),
    })
}

/// Folders in which weights are looked for, one after the other.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Weights {
    folders: Vec<PathBuf>,
}

/// A file that was read, for reports.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct UsedFile {
    /// The set it belongs to.
    pub set: String,
    /// Its path below the folder of weights.
    pub file: String,
    /// Its SHA-256, hexadecimal.
    pub sha256: String,
}

impl Weights {
    /// Looks in these folders, the first first: what the user named, then the cache.
    pub fn new(folders: impl IntoIterator<Item = PathBuf>) -> Self {
        Self { folders: folders.into_iter().collect() }
    }

    /// The paths of a set's files, all from the first folder that has them all.
    ///
    /// # Errors
    /// [`MetricsError::NotFound`] if no folder has them; or if the set is unknown.
    pub fn find(&self, name: &str) -> Result<Vec<PathBuf>, MetricsError> {
        Ok(self.parts(name)?.into_iter().map(|part| part.path).collect())
    }

    /// As [`find`](Self::find), with what the files are to be.
    fn parts(&self, name: &str) -> Result<Vec<Part>, MetricsError> {
        let set = set(name)?;
        let mut missing = set.files[0].path; // of the folder that comes closest: the last file that is missing
        for folder in &self.folders {
            let parts: Vec<_> = set.files.iter().map(|file| part(folder, file)).collect();
            match parts.iter().position(Option::is_none) {
                None => return Ok(parts.into_iter().flatten().collect()),
                Some(i) => missing = set.files[i].path,
            }
        }
        let searched: Vec<String> = self.folders.iter().map(|f| f.display().to_string()).collect();
        let searched = if searched.is_empty() { "no folder".to_owned() } else { searched.join(", ") };
        Err(MetricsError::NotFound { name: name.to_owned(), file: missing.to_owned(), searched })
    }

    /// As [`find`](Self::find), and checks the files against the hashes that are known, noting what they are.
    pub(crate) fn open(&self, name: &str, used: &mut Vec<UsedFile>) -> Result<Vec<PathBuf>, MetricsError> {
        let parts = self.parts(name)?;
        for part in &parts {
            for path in members(&part.path)? {
                let sha256 = check(&path, part.sha256)?;
                let member = path.file_name().unwrap_or_default().to_string_lossy();
                let file =
                    if part.name.ends_with('/') { format!("{}{member}", part.name) } else { part.name.to_owned() };
                let entry = UsedFile { set: name.to_owned(), file, sha256 };
                if !used.contains(&entry) {
                    used.push(entry);
                }
            }
        }
        Ok(parts.into_iter().map(|part| part.path).collect())
    }
}

/// A file or folder of a set that is there.
struct Part {
    /// Where.
    path: PathBuf,
    /// Its path below the folder of weights.
    name: &'static str,
    /// Its SHA-256, or the digits that are known of it.
    sha256: &'static str,
}

/// The published file, or its twin, or neither.
fn part(folder: &Path, file: &WeightFile) -> Option<Part> {
    let published = Part { path: folder.join(file.path), name: file.path, sha256: file.sha256 };
    let twin = || file.twin.map(|twin| Part { path: folder.join(twin.path), name: twin.path, sha256: twin.sha256 });
    if is_there(folder, file) { Some(published) } else { twin().filter(|twin| twin.path.is_file()) }
}

/// Whether the published file, or folder of files, is there.
fn is_there(folder: &Path, file: &WeightFile) -> bool {
    let path = folder.join(file.path);
    if file.path.ends_with('/') { path.is_dir() } else { path.is_file() }
}

/// A file, or the files of a folder without the notes of their hashes, sorted.
fn members(path: &Path) -> Result<Vec<PathBuf>, MetricsError> {
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let entries = std::fs::read_dir(path).map_err(|e| MetricsError::io(path, e))?;
    let mut out = Vec::new();
    for entry in entries {
        let entry = entry.map_err(|e| MetricsError::io(path, e))?.path();
        if entry.is_file() && entry.extension().is_none_or(|e| e != NOTE) {
            out.push(entry);
        }
    }
    out.sort();
    Ok(out)
}

/// Extension of the note that holds the hash which a file had when it was fetched.
const NOTE: &str = "sha256";

/// `FILE.sha256`
fn note_of(path: &Path) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(".");
    name.push(NOTE);
    path.with_file_name(name)
}

/// The file's hash, if it is the known one: the published one, and what was noted at the download.
fn check(path: &Path, published: &str) -> Result<String, MetricsError> {
    let found = hash_file(path)?;
    let noted = std::fs::read_to_string(note_of(path)).unwrap_or_default(); // a note need not be there
    for expected in [published, noted.trim()] {
        if !found.starts_with(expected) {
            return Err(MetricsError::Checksum { path: path.to_owned(), expected: expected.to_owned(), found });
        }
    }
    Ok(found)
}

fn hash_file(path: &Path) -> Result<String, MetricsError> {
    let fail = |e| MetricsError::io(path, e);
    sha256_of(&mut std::fs::File::open(path).map_err(fail)?).map_err(fail)
}

#[cfg(test)]
mod tests;
