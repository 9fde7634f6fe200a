//! The Frechet distance and the cosine against vectors of numpy's, scipy's and PyTorch's results.
#![cfg(feature = "networks")]

use freerange_eval::metrics::*;
use freerange_vectors::{Vectors, json};

fn vectors(name: &str) -> (Vectors, serde_json::Value) {
    (Vectors::read(&format!("metrics/{name}.safetensors")), json(&format!("metrics/{name}.json")))
}

/// Rows and their width.
fn matrix<'a>(vectors: &'a Vectors, name: &str) -> (&'a [f32], usize) {
    (vectors.floats(name), *vectors.shape(name).last().unwrap())
}

fn statistics(vectors: &Vectors, name: &str) -> FeatureStatistics {
    let (values, width) = matrix(vectors, name);
    let mut out = FeatureStatistics::new(width);
    values.chunks_exact(width).for_each(|row| out.add(row).unwrap());
    assert_eq!(out.count(), values.len() / width);
    out
}

fn close(found: &[f64], expected: &[f32]) {
    assert_eq!(found.len(), expected.len());
    let largest = expected.iter().fold(0.0f32, |m, x| m.max(x.abs()));
    let tolerance = f64::from(1e-4 * largest + 1e-6);
    for (f, &e) in found.iter().zip(expected) {
        assert!((f - f64::from(e)).abs() <= tolerance, "expected {e}, found {f}");
    }
}

#[test]
fn frechet() {
    for name in ["d8_n100_n80", "d10_identical", "d48_rankdef_n20_n30", "d64_n500_n400"] {
        let (v, json) = vectors(&format!("frechet_{name}"));
        let (first, second) = (statistics(&v, "in/feat1"), statistics(&v, "in/feat2"));
        close(&first.mean(), matrix(&v, "out/mu1").0);
        close(&second.mean(), matrix(&v, "out/mu2").0);
        close(&first.covariance(), matrix(&v, "out/sigma1").0);
        close(&second.covariance(), matrix(&v, "out/sigma2").0);
        let expected = json["scalars_f64"]["frechet"].as_f64().unwrap();
        for found in [frechet_distance(&first, &second).unwrap(), frechet_distance(&second, &first).unwrap()] {
            // Far within the tolerance of the vectors, 1e-3 relative and 1e-2.
            assert!((found - expected).abs() <= 1e-6 * expected + 1e-6, "{name}: expected {expected}, found {found}");
        }
    }
}

#[test]
fn frechet_of_one_value_is_the_formula() {
    let of = |values: &[f32]| {
        let mut s = FeatureStatistics::new(1);
        values.iter().for_each(|v| s.add(&[*v]).unwrap());
        s
    };
    // Means 1 and 4; deviations 1 and 3: (1 - 4)^2 + (1 - 3)^2.
    let found = frechet_distance(&of(&[0.0, 1.0, 2.0]), &of(&[1.0, 4.0, 7.0])).unwrap();
    assert!((found - 13.0).abs() < 1e-12, "{found}");
    // Without spread only the means count.
    assert_eq!(frechet_distance(&of(&[5.0, 5.0]), &of(&[3.0, 3.0])).unwrap(), 4.0);
}

#[test]
fn frechet_refuses_what_has_no_answer() {
    let mut one = FeatureStatistics::new(2);
    assert!(one.mean().iter().chain(&one.covariance()).all(|v| v.is_nan()));
    one.add(&[1.0, 2.0]).unwrap();
    assert!(one.covariance().iter().all(|v| v.is_nan()));
    let error = frechet_distance(&one, &one).unwrap_err();
    assert!(error.to_string().contains("at least 2"), "{error}");
    assert!(one.add(&[1.0]).is_err() && one.add(&[1.0, f32::NAN]).is_err());
    assert_eq!(one.count(), 1, "a refused vector does not count");
    assert!(frechet_distance(&one, &FeatureStatistics::new(3)).is_err());
}

#[test]
fn cosine() {
    let (v, json) = vectors("cosine");
    let ((a, width), (b, _)) = (matrix(&v, "in/a"), matrix(&v, "in/b"));
    let (expected, _) = matrix(&v, "out/cosine");
    let found: Vec<f64> =
        a.chunks_exact(width).zip(b.chunks_exact(width)).map(|(a, b)| cosine_similarity(a, b)).collect();
    assert_eq!(found.len(), expected.len());
    for (f, &e) in found.iter().zip(expected) {
        assert!((f - f64::from(e)).abs() <= 1e-5, "expected {e}, found {f}");
    }
    let mean = found.iter().sum::<f64>() / found.len() as f64;
    assert!((mean - json["scalars_f64"]["mean"].as_f64().unwrap()).abs() <= 1e-5);
}

#[test]
fn names_are_unique_and_parse_back() {
    for metric in Metric::ALL {
        assert_eq!(metric.name().parse::<Metric>().unwrap(), metric);
        assert_eq!(Metric::ALL.iter().filter(|m| m.label() == metric.label()).count(), 1);
    }
    let error = "lpips".parse::<Metric>().unwrap_err().to_string();
    assert!(error.contains("lpips-alex"), "{error}");
}
