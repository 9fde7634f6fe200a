//! The metrics of one pair of images after the other, and which of them there are.

use std::{collections::BTreeMap, path::PathBuf};

use freerange_raster::metrics::{capped_psnr, ssim_3dgs, ssim_skimage_gauss, ssim_skimage_sample};

use crate::metrics::Metric;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::EvalError;

/// What a [`Scorer`] computes.
#[derive(Clone, Debug, PartialEq)]
pub struct ScorerConfig {
    /// The metrics.
    pub metrics: Vec<Metric>,
    /// Folders in which the networks' weights are looked for, the first first.
    pub weights: Vec<PathBuf>,
    /// The set of weights of [`Metric::Dino`].
    pub dino: String,
}

/// A file of weights that scores depend on.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct UsedFile {
    /// The set it belongs to.
    pub set: String,
    /// Its path below the folder of weights.
    pub file: String,
    /// Its SHA-256, hexadecimal.
    pub sha256: String,
}

/// Two images to compare, `[height, width, 3]` in 0..1.
#[derive(Clone, Copy, Debug)]
pub struct Pair<'a> {
    /// What was made.
    pub render: &'a [f32],
    /// What it should be.
    pub truth: &'a [f32],
    /// Their width and height in pixels.
    pub size: [usize; 2],
}

/// What pairs gave.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scores {
    /// For each pair, metrics by name.
    pub pairs: Vec<BTreeMap<String, f64>>,
    /// If FID is computed: Inception's features of all renders, then of all true images.
    pub features: Vec<f32>,
}

/// Computes metrics.
pub struct Scorer {
    pixel: Vec<Metric>,
    missing: BTreeMap<String, String>,
    #[cfg(feature = "networks")]
    networks: crate::metrics::Evaluator,
    used: Vec<UsedFile>,
}

impl Scorer {
    /// Reads the networks of the metrics. Metrics whose weights are nowhere, or that this program was built without, are
    /// left out and listed by [`missing`](Self::missing).
    ///
    /// # Errors
    /// If a file of weights is there but broken.
    #[cfg(feature = "networks")]
    pub fn open(config: &ScorerConfig, device: &burn::tensor::Device) -> Result<Self, EvalError> {
        use crate::metrics::{Evaluator, EvaluatorConfig, weights::Weights};
        let (networks, pixel) = config.metrics.iter().partition::<Vec<Metric>, _>(|m| m.needs_network());
        let evaluator = EvaluatorConfig { metrics: networks, dino: config.dino.clone(), ..EvaluatorConfig::default() };
        let (networks, missing) = Evaluator::open(&evaluator, &Weights::new(config.weights.iter().cloned()), device)?;
        let used = networks.used_files().iter();
        let used =
            used.map(|f| UsedFile { set: f.set.clone(), file: f.file.clone(), sha256: f.sha256.clone() }).collect();
        let missing = missing.into_iter().map(|m| (m.metric.name().to_owned(), m.reason)).collect();
        Ok(Self { pixel, missing, networks, used })
    }

    /// The metrics that need no network; the others are listed by [`missing`](Self::missing).
    #[cfg(not(feature = "networks"))]
    pub fn open(config: &ScorerConfig) -> Result<Self, EvalError> {
        let (networks, pixel) = config.metrics.iter().partition::<Vec<Metric>, _>(|m| m.needs_network());
        let reason =
            "this program was built without networks: build it with `cargo build --release --features networks`";
        let missing = networks.into_iter().map(|m| (m.name().to_owned(), reason.to_owned())).collect();
        Ok(Self { pixel, missing, used: Vec::new() })
    }

    /// The metrics that are computed, by name.
    pub fn metrics(&self) -> Vec<String> {
        let metrics = self.pixel.iter();
        #[cfg(feature = "networks")]
        let metrics = metrics.chain(self.networks.metrics());
        metrics.map(|m| m.name().to_owned()).collect()
    }

    /// The metrics that are not computed, and why.
    pub fn missing(&self) -> &BTreeMap<String, String> {
        &self.missing
    }

    /// The files of weights that were read.
    pub fn used_files(&self) -> &[UsedFile] {
        &self.used
    }

    /// What is compared by the Frechet distance of [`Metric::FrechetVgg`]: VGG16's features of each image (`[height, width, 3]` in
    /// 0..1, with its width and height), one after the other. Empty if that is not computed.
    ///
    /// # Errors
    /// If an image has another size or a value that is not finite.
    #[cfg(feature = "networks")]
    pub fn vgg_features(&self, images: &[(&[f32], [usize; 2])]) -> Result<Vec<f32>, EvalError> {
        let each = images.iter().map(|(image, [width, height])| self.networks.vgg_features(image, *width, *height));
        Ok(each.collect::<Result<Option<Vec<_>>, _>>()?.unwrap_or_default().concat())
    }

    /// Empty: this program was built without networks.
    ///
    /// # Errors
    /// None.
    #[cfg(not(feature = "networks"))]
    pub fn vgg_features(&self, _: &[(&[f32], [usize; 2])]) -> Result<Vec<f32>, EvalError> {
        Ok(Vec::new())
    }

    /// The scores of pairs, each at its own size.
    ///
    /// # Errors
    /// If an image has not its pair's size, is too small for a metric, or holds a value that is not finite.
    pub fn score(&self, pairs: &[Pair<'_>]) -> Result<Scores, EvalError> {
        let pixel = |pair: &Pair<'_>| {
            let (a, b, [width, height]) = (pair.render, pair.truth, pair.size);
            let value = |metric: Metric| {
                Ok::<f64, EvalError>(match metric {
                    Metric::Psnr => capped_psnr(a, b)?,
                    Metric::SsimCropped => ssim_skimage_gauss(a, b, width, height)?,
                    Metric::SsimSample => ssim_skimage_sample(a, b, width, height)?,
                    Metric::Ssim => ssim_3dgs(a, b, width, height)?,
                    of_network => unreachable!("{of_network} is no metric of pixels"),
                })
            };
            self.pixel
                .iter()
                .map(|&m| Ok((m.name().to_owned(), value(m)?)))
                .collect::<Result<BTreeMap<_, _>, EvalError>>()
        };
        for (i, pair) in pairs.iter().enumerate() {
            if pair.render.iter().chain(pair.truth).any(|v| !v.is_finite()) {
                let found = format!("a value that is not in the images of pair {i}");
                return Err(EvalError::Object { object: "render".into(), expected: "finite values".into(), found });
            }
        }
        let pairs_scored =
            pairs.par_iter().map(pixel).collect::<Vec<_>>().into_iter().collect::<Result<Vec<_>, EvalError>>()?;
        #[allow(unused_mut)] // without networks there is nothing to add
        let mut scores = Scores { pairs: pairs_scored, features: Vec::new() };
        #[cfg(feature = "networks")]
        if !self.networks.metrics().is_empty() {
            let mut of_truths = Vec::new();
            let mut values = scores.pairs.iter_mut();
            // Networks take as many as they can at once, but of one size.
            for same in pairs.chunk_by(|a, b| a.size == b.size) {
                let [width, height] = same[0].size;
                let same: Vec<_> =
                    same.iter().map(|p| crate::metrics::Pair { render: p.render, truth: p.truth }).collect();
                for (scored, values) in self.networks.score(&same, width, height)?.into_iter().zip(&mut values) {
                    values.extend(scored.values.iter().map(|(m, v)| (m.name().to_owned(), *v)));
                    if let Some([render, truth]) = scored.inception {
                        scores.features.extend(render);
                        of_truths.extend(truth);
                    }
                }
            }
            scores.features.extend(of_truths);
        }
        Ok(scores)
    }
}

/// FID of many cases, one after the other: each item is what [`Scorer::score`] gave as features of one of them. `None` of
/// fewer than two images.
///
/// # Errors
/// Those of the items; if features are not finite or come in odd numbers.
#[cfg(feature = "networks")]
pub fn fid(features: impl Iterator<Item = Result<Vec<f32>, EvalError>>) -> Result<Option<f64>, EvalError> {
    use crate::metrics::{FeatureStatistics, Inception, frechet_distance};
    let mut renders = FeatureStatistics::new(Inception::WIDTH);
    let mut truths = renders.clone();
    for case in features {
        let case = case?;
        let (first, second) = case.split_at(case.len() / 2);
        for (half, side) in [(first, &mut renders), (second, &mut truths)] {
            half.chunks(Inception::WIDTH).try_for_each(|vector| side.add(vector))?;
        }
    }
    match renders.count() < 2 {
        true => Ok(None),
        false => Ok(Some(frechet_distance(&renders, &truths)?)),
    }
}

/// `None`: this program was built without networks, and its records hold no features.
///
/// # Errors
/// Those of the items.
#[cfg(not(feature = "networks"))]
pub fn fid(mut features: impl Iterator<Item = Result<Vec<f32>, EvalError>>) -> Result<Option<f64>, EvalError> {
    features.try_for_each(|case| case.map(drop)).map(|()| None)
}

/// Frechet distance between two sets of [VGG16's features](Scorer::vgg_features). `None` of fewer than two images.
///
/// # Errors
/// If features are not finite.
#[cfg(feature = "networks")]
pub fn frechet_vgg(renders: &[&[f32]], truths: &[&[f32]]) -> Result<Option<f64>, EvalError> {
    use crate::metrics::{FeatureStatistics, VGG_WIDTH, frechet_distance, frechet_distance_of_few};
    let statistics = |vectors: &[&[f32]]| {
        let mut all = FeatureStatistics::new(VGG_WIDTH);
        vectors.iter().try_for_each(|vector| all.add(vector)).map(|()| all)
    };
    match renders.len() {
        0 | 1 => Ok(None),
        n if n < VGG_WIDTH && truths.len() < VGG_WIDTH => Ok(Some(frechet_distance_of_few(renders, truths)?)),
        _ => Ok(Some(frechet_distance(&statistics(renders)?, &statistics(truths)?)?)),
    }
}

/// `None`: this program was built without networks.
///
/// # Errors
/// None.
#[cfg(not(feature = "networks"))]
pub fn frechet_vgg(_: &[&[f32]], _: &[&[f32]]) -> Result<Option<f64>, EvalError> {
    Ok(None)
}

#[cfg(all(test, feature = "networks"))]
mod tests {
    use crate::metrics::Inception;

    use super::*;

    /// Features that differ by a constant: the covariances agree, and the distance is that of the means.
    #[test]
    fn fid_is_over_all_cases_and_refuses_torn_features() {
        let value = |case: usize, image: usize, k: usize| ((case * 7 + image * 3 + k) % 11) as f32 * 0.1;
        let vector = |case, image, shift: f32| (0..Inception::WIDTH).map(move |k| value(case, image, k) + shift);
        let case = |c: usize| -> Result<Vec<f32>, EvalError> {
            let of = |shift| (0..3).flat_map(move |i| vector(c, i, shift));
            Ok(of(0.0).chain(of(0.5)).collect())
        };
        let found = fid((0..4).map(case)).unwrap().unwrap();
        let expected = 0.25 * Inception::WIDTH as f64;
        assert!((found - expected).abs() < 1e-3 * expected, "{found} {expected}");
        assert_eq!(fid(std::iter::empty()).unwrap(), None);
        assert!(fid((0..2).map(|_| Ok(vec![0.0; 2 * Inception::WIDTH - 2]))).is_err());
    }
}

#[cfg(all(test, not(feature = "networks")))]
mod tests {
    use super::*;

    #[test]
    fn each_pair_is_scored_at_its_own_size() {
        let config = ScorerConfig { metrics: vec![Metric::Psnr, Metric::Ssim], weights: vec![], dino: String::new() };
        let scorer = Scorer::open(&config).unwrap();
        let image = |width: usize, height: usize, shift: f32| -> Vec<f32> {
            (0..width * height * 3).map(|i| (i % 17) as f32 / 20.0 + shift).collect()
        };
        let (wide, high) = ([image(24, 16, 0.0), image(24, 16, 0.1)], [image(16, 30, 0.0), image(16, 30, 0.05)]);
        let both = [
            Pair { render: &wide[0], truth: &wide[1], size: [24, 16] },
            Pair { render: &high[0], truth: &high[1], size: [16, 30] },
        ];
        let alone = both.map(|pair| scorer.score(&[pair]).unwrap().pairs.remove(0));
        assert_eq!(scorer.score(&both).unwrap().pairs, alone);
        assert!((alone[0]["psnr"] - 20.0).abs() < 1e-3 && alone[1]["psnr"] > 25.0, "{alone:?}");
        assert!(scorer.score(&[Pair { size: [16, 30], ..both[0] }]).is_err());
    }
}
