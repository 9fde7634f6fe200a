//! Weights of networks: read, converted, refused.

use super::*;

#[test]
fn the_table_is_consistent() {
    for (i, set) in SETS.iter().enumerate() {
        assert!(SETS[..i].iter().all(|other| other.name != set.name), "{} twice", set.name);
        assert!(!set.files.is_empty() && !set.license.is_empty() && !set.purpose.is_empty());
        for file in set.files {
            assert!(file.sha256.len() <= 64 && file.sha256.bytes().all(|b| b.is_ascii_hexdigit()));
            // PyTorch's hub writes the hash's first digits before the ending.
            let stem = file.path.strip_suffix(".pth").unwrap_or("");
            if let Some((_, digits)) = stem.rsplit_once('-').filter(|(_, d)| d.len() == 8) {
                assert_eq!(digits, file.sha256);
            }
            match file.origin {
                Origin::Url(url) | Origin::Zip { url, .. } => assert!(url.starts_with("https://")),
                Origin::Hub { repository, path } => assert!(repository.contains('/') && file.path.ends_with(path)),
            }
            if let Some(twin) = file.twin {
                assert_eq!(twin.path.strip_suffix(".safetensors"), Some(stem));
                assert!(twin.sha256.len() == 64 && twin.sha256.bytes().all(|b| b.is_ascii_hexdigit()));
            }
            if let Origin::Zip { member, .. } = file.origin {
                assert_eq!(member.ends_with('/'), file.path.ends_with('/'));
            }
        }
    }
    assert!(matches!(set("nothing"), Err(MetricsError::UnknownWeights { .. })));
}

#[test]
fn folders_are_searched_in_order_and_must_be_complete() {
    let (first, second) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let weights = Weights::new([first.path().to_owned(), second.path().to_owned()]);
    let error = weights.find("dinov2-base").unwrap_err().to_string();
    assert!(error.contains("freerange weights fetch dinov2-base") && error.contains("model.safetensors"), "{error}");
    for folder in [&first, &second] {
        std::fs::create_dir(folder.path().join("dinov2-base")).unwrap();
        std::fs::write(folder.path().join("dinov2-base/model.safetensors"), b"x").unwrap();
    }
    let error = weights.find("dinov2-base").unwrap_err().to_string();
    assert!(error.contains("config.json"), "{error}");
    std::fs::write(second.path().join("dinov2-base/config.json"), b"{}").unwrap();
    let found = weights.find("dinov2-base").unwrap();
    assert!(found.iter().all(|path| path.starts_with(second.path())));

    let mut used = Vec::new();
    weights.open("dinov2-base", &mut used).unwrap();
    assert_eq!(used[0].sha256, "2d711642b726b04401627ca9fbac32f5c8530fb1903cc4db02258717921a4881"); // of "x"
    std::fs::write(second.path().join("dinov2-base/config.json.sha256"), "00").unwrap();
    let error = weights.open("dinov2-base", &mut used).unwrap_err();
    assert!(matches!(error, MetricsError::Checksum { .. }), "{error}");
}

#[test]
fn a_twin_is_taken_where_the_published_file_is_missing() {
    let folder = tempfile::tempdir().unwrap();
    let weights = Weights::new([folder.path().to_owned()]);
    std::fs::create_dir_all(folder.path().join("lpips/v0.1")).unwrap();
    std::fs::write(folder.path().join("lpips/v0.1/vgg.pth"), b"x").unwrap();
    let error = weights.find("lpips-vgg").unwrap_err().to_string();
    assert!(error.contains("vgg16-397923af.pth"), "{error}");
    let twin = folder.path().join("vgg16-397923af.safetensors");
    std::fs::write(&twin, b"x").unwrap();
    assert_eq!(weights.find("lpips-vgg").unwrap()[0], twin);
    // It is held to a hash of its own.
    let error = weights.open("lpips-vgg", &mut Vec::new()).unwrap_err().to_string();
    assert!(error.contains("vgg16-397923af.safetensors") && error.contains("4b2a9787"), "{error}");
    let published = folder.path().join("vgg16-397923af.pth");
    std::fs::write(&published, b"x").unwrap();
    assert_eq!(weights.find("lpips-vgg").unwrap()[0], published);
}
