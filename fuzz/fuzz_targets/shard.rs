//! A letter (`t` shard, `m` manifest), then the file. Must end in an error or in valid objects.
#![no_main]

use std::path::Path;

use freerange_data::{Manifest, ShardReader};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let Some((kind, bytes)) = data.split_first() else { return };
    match kind {
        b'm' => {
            if let Ok(manifest) = Manifest::from_json(Path::new("manifest.json"), bytes) {
                let depths = manifest.plan.config.depths();
                depths.iter().for_each(|&d| drop(manifest.statistics(d)));
                assert!(manifest.objects().all(|o| o.bytes > 0));
            }
        }
        _ => {
            let Ok(reader) = ShardReader::from_bytes(Path::new("shard.tar"), bytes.to_vec()) else { return };
            for i in 0..reader.len() {
                assert!(reader.id(i).is_some());
                let _ = reader.metadata(i);
                let _ = reader.leaves(i);
                if let Ok(object) = reader.read(i, &[2, 3]) {
                    assert!(!object.views.is_empty() && object.slices.len() == 2);
                    assert!(object.slices.values().all(|c| c.check_finite().is_ok()));
                }
            }
        }
    }
});
