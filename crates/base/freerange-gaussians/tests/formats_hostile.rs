//! Broken files: an error that names the file, the place, what was expected and found; never a panic, never much
//! memory.

mod common;

use std::{io::Write, path::Path};

use common::object;
use freerange_gaussians::formats::{Format, Frame, SpzVersion, WriteOptions, encode, parse};
use proptest::prelude::*;

fn try_all(format: Format, bytes: &[u8]) -> Result<usize, String> {
    match parse(format, bytes, Path::new("broken.file"), Frame::Z_UP) {
        Ok(loaded) => {
            assert!(loaded.splats.cloud.check_finite().is_ok());
            Ok(loaded.splats.cloud.len())
        }
        Err(e) => {
            let message = e.to_string();
            assert!(
                message.contains("broken.file") && message.contains("expected") && message.contains("found"),
                "{message}"
            );
            Err(message)
        }
    }
}

fn example(format: Format, version: SpzVersion) -> Vec<u8> {
    encode(&object(9).into(), format, &WriteOptions { spz_version: version, ..WriteOptions::default() }).unwrap().bytes
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut file = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    file.write_all(bytes).unwrap();
    file.finish().unwrap()
}

/// The error of an example after `change`.
fn refused(format: Format, change: impl FnOnce(&mut Vec<u8>)) -> String {
    let mut bytes = example(format, SpzVersion::V3);
    change(&mut bytes);
    try_all(format, &bytes).unwrap_err()
}

fn has(message: &str, words: &[&str]) {
    words.iter().for_each(|w| assert!(message.contains(w), "{w:?} in {message}"));
}

#[test]
fn splat_files() {
    has(&refused(Format::Splat, |b| b.truncate(100)), &["length", "multiple of 32", "100"]);
    has(&refused(Format::Splat, |b| b[44..48].copy_from_slice(&(-1f32).to_le_bytes())), &["Gaussian 1, scale 0", "-1"]);
    // What is not finite is left out; where there is nothing else, the file is refused.
    for (at, value) in [(44, f32::NAN), (0, f32::INFINITY), (12, f32::INFINITY)] {
        let mut bytes = example(Format::Splat, SpzVersion::V3);
        bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
        let loaded = parse(Format::Splat, &bytes, Path::new("a"), Frame::Z_UP).unwrap();
        assert_eq!(loaded.splats.cloud.len(), 8);
        assert!(loaded.notes[0].starts_with("1 Gaussians with numbers that are not finite"), "{:?}", loaded.notes);
    }
    let nothing = f32::NAN.to_le_bytes().repeat(8);
    has(
        &try_all(Format::Splat, &nothing).unwrap_err(),
        &["Gaussians", "at least one of finite numbers", "1 of others"],
    );
    assert_eq!(try_all(Format::Splat, &[]), Ok(0));
}

#[test]
fn spz_files() {
    let header = |version: u32, count: u32, degree: u8, bits: u8| {
        [&b"NGSP"[..], &version.to_le_bytes(), &count.to_le_bytes(), &[degree, bits, 0, 5]].concat()
    };
    let spz = |bytes: &[u8]| try_all(Format::Spz, bytes).unwrap_err();
    has(&spz(b""), &["header", "4 bytes"]);
    has(&spz(b"glTF, or so"), &["header", "\"NGSP\"", "glTF"]);
    has(&spz(&gzip(b"NGSP")), &["version", "0 and the end"]);
    has(&spz(&gzip(&header(5, 1, 0, 12))), &["version", "1, 2, 3 or 4", "found 5"]);
    has(&spz(&gzip(&header(4, 1, 0, 12))), &["version", "gzip"]);
    has(&spz(&header(3, 1, 0, 12)), &["version", "outside of a gzip"]);
    has(&spz(&gzip(&header(3, u32::MAX, 0, 12))), &["count of Gaussians", "at most", "4294967295"]);
    has(&spz(&gzip(&header(3, 3, 9, 12))), &["degree", "found 9"]);
    has(&spz(&gzip(&header(3, 3, 0, 40))), &["fractional bits", "found 40"]);
    has(&spz(&gzip(&header(3, 3, 0, 12))), &["positions", "27 bytes", "0 and the end"]);
    has(&spz(&[header(4, 1, 0, 12), vec![255; 16]].concat()), &["place of the table"]);
    has(&spz(&[header(4, 1, 3, 12), vec![32, 0, 0, 0], vec![0; 12]].concat()), &["count of streams", "6", "5"]);
    let table = [header(4, 1, 0, 12), vec![32, 0, 0, 0], vec![0; 12 + 80]].concat();
    has(&spz(&table), &["size of the positions", "expected 9", "found 0"]);
    // A stream that is all there, but cut.
    let mut cut = example(Format::Spz, SpzVersion::V3);
    cut.truncate(cut.len() / 2);
    has(&spz(&cut), &["compressed stream"]);
    // A gigabyte of zeros in a megabyte: refused by what the header may claim, before anything is made of them.
    let claim = header(3, 50_000_000, 0, 12);
    assert!(spz(&gzip(&[&claim[..], &vec![0; 1 << 16]].concat())).contains("count of Gaussians"));
}

#[test]
fn sog_files() {
    let archive = |meta: &str| {
        let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
        zip.start_file("meta.json", zip::write::SimpleFileOptions::default()).unwrap();
        zip.write_all(meta.as_bytes()).unwrap();
        zip.start_file("picture", zip::write::SimpleFileOptions::default()).unwrap();
        zip.write_all(b"RIFF, but no picture").unwrap();
        zip.finish().unwrap().into_inner()
    };
    let sog = |meta: &str| try_all(Format::Sog, &archive(meta)).unwrap_err();
    has(&try_all(Format::Sog, b"no archive").unwrap_err(), &["archive"]);
    has(&sog("{"), &["meta.json", "JSON"]);
    has(&sog("{}"), &["version", "expected 2", "none"]);
    has(&sog("{\"version\":1}"), &["version", "found 1"]);
    has(&sog("{\"version\":2}"), &["meta.json", "missing field"]);
    let meta = |count: u64, codes: usize, file: &str| {
        let codebook = vec!["0.5"; codes].join(",");
        format!(
            "{{\"version\":2,\"count\":{count},\"means\":{{\"mins\":[0,0,0],\"maxs\":[1,1,1],\"files\":[\"{file}\",\"u\"]}},\
             \"scales\":{{\"codebook\":[{codebook}],\"files\":[\"s\"]}},\"quats\":{{\"files\":[\"q\"]}},\
             \"sh0\":{{\"codebook\":[{codebook}],\"files\":[\"c\"]}}}}"
        )
    };
    has(&sog(&meta(1 << 40, 256, "l")), &["meta.json, count", "at most"]);
    has(&sog(&meta(4, 255, "l")), &["codebook", "256 numbers", "255"]);
    has(&sog(&meta(4, 256, "l")), &["l: expected such a file"]);
    has(&sog(&meta(4, 256, "picture")), &["picture", "WebP"]);
    has(&sog(&meta(4, 256, "meta.json")), &["meta.json", "at most", "more"]); // text that shrank more than a picture can
}

#[test]
fn glb_files() {
    let glb = |json: &str| {
        let json = format!("{json:width$}", width = json.len().next_multiple_of(4));
        let mut file = Vec::new();
        for word in [0x4654_6c67, 2, 20 + json.len() as u32, json.len() as u32, 0x4e4f_534a] {
            file.extend(word.to_le_bytes());
        }
        file.extend(json.as_bytes());
        try_all(Format::Glb, &file).unwrap_err()
    };
    has(&try_all(Format::Glb, b"ply").unwrap_err(), &["header", "4 bytes"]);
    has(&try_all(Format::Glb, b"plyply").unwrap_err(), &["header", "glTF"]);
    has(&refused(Format::Glb, |b| b[4] = 1), &["version", "found 1"]);
    has(&refused(Format::Glb, |b| b.truncate(500)), &["length", "500"]);
    has(&refused(Format::Glb, |b| b[12..16].fill(255)), &["chunk"]);
    has(&glb("{\"nodes\":3}"), &["JSON"]);
    has(&glb("{\"extensionsRequired\":[\"KHR_draco_mesh_compression\"]}"), &["extensionsRequired", "draco"]);
    has(&glb("{}"), &["scene", "0 of 0"]);
    has(&glb("{\"scenes\":[{\"nodes\":[0]}],\"nodes\":[{\"children\":[0]}]}"), &["node 0", "circle"]);
    has(&glb("{\"scenes\":[{\"nodes\":[4]}]}"), &["node", "found 4"]);
    has(&glb("{\"scenes\":[{\"nodes\":[0]}],\"nodes\":[{\"mesh\":1}]}"), &["node 0, mesh"]);
    has(&glb("{\"scenes\":[{\"nodes\":[0]}],\"nodes\":[{\"scale\":[1,2,1]}]}"), &["node 0", "same positive scale"]);
    has(&glb("{\"scenes\":[{\"nodes\":[0]}],\"nodes\":[{\"scale\":[-1,-1,-1]}]}"), &["node 0", "same positive scale"]);
    has(&glb("{\"scenes\":[{}]}"), &["KHR_gaussian_splatting", "0 primitives"]);
    // Changes to the text of a good file, of the same length.
    let edited = |from: &str, to: &str| {
        assert_eq!(from.len(), to.len());
        refused(Format::Glb, |b| {
            let at = b.windows(from.len()).position(|w| w == from.as_bytes()).unwrap_or_else(|| panic!("{from}"));
            b[at..at + from.len()].copy_from_slice(to.as_bytes());
        })
    };
    has(&edited("\"ellipse\"", "\"circle_\""), &["kernel", "ellipse", "circle_"]);
    has(&edited("srgb_rec709_display", "lim__rec709_display"), &["colorSpace", "lim__rec709"]);
    has(&edited("\"mode\":0", "\"mode\":4"), &["mode", "0 (points)", "4"]);
    has(&edited("_splatting:SCALE", "_splatting:SCALD"), &["SCALE", "no such attribute"]);
    has(&edited("\"count\":9", "\"count\":8"), &["count"]);
    has(&edited("\"type\":\"SCALAR\"", "\"type\":\"SCALA_\""), &["OPACITY", "SCALAR"]);
    has(&edited("\"byteLength\":108", "\"byteLength\":107"), &["beyond its end"]);
}

#[test]
fn stages() {
    let usd = |bytes: &[u8]| try_all(Format::Usda, bytes).unwrap_err();
    has(&usd(b"nothing of the kind"), &["layer", "text layer"]);
    has(&usd(&[0xff, 0xfe]), &["layer", "UTF-8"]);
    has(&usd(b"PXR-USDC and no more"), &["layer", "usdcat", "a binary one (.usdc)"]);
    has(&usd(b"PK and no more"), &["archive", ".usdz"]);
    has(&usd(b"#usda 1.0\n"), &["stage", "ParticleField3DGaussianSplat", "none"]);
    // Changes to the text of a good file.
    let edited = |from: &str, to: &str| {
        let text = String::from_utf8(example(Format::Usda, SpzVersion::V3)).unwrap();
        assert!(text.contains(from), "{from}");
        usd(text.replacen(from, to, 1).as_bytes())
    };
    has(&edited("upAxis = \"Z\"", "upAxis = \"X\""), &["upAxis", "\"Y\" or \"Z\"", "X"]);
    has(&edited("float[] opacities = [", "float[] opacities = [0.5, "), &["opacities", "9 values", "found 10"]);
    has(&edited("float[] opacities = [", "float[] opacitie = ["), &["opacities", "its values", "none"]);
    has(
        &edited("quatf[] orientations = [(", "quatf[] orientations = [(0, 0, 0, 0), ("),
        &["orientations", "9 values", "10"],
    );
    has(&edited("float3[] scales = [", "float3[] scales = [(1, 1, 1), "), &["scales", "9 values", "10"]);
    has(&edited("sphericalHarmonicsDegree = 0", "sphericalHarmonicsDegree = 1"), &["4 values (degree 1)", "found 9"]);
    has(&edited("sphericalHarmonicsDegree = 0", "sphericalHarmonicsDegree = -1"), &["Degree", "0 to 8"]);
    has(&edited("uniform int radiance:sphericalHarmonicsDegree = 0", ""), &["16 values (degree 3)", "found 9"]);
    let first = |name: &str, value: &str| {
        let text = String::from_utf8(example(Format::Usda, SpzVersion::V3)).unwrap();
        let at = text.find(&format!("{name} = [")).unwrap() + name.len() + 4;
        let end = at + text[at..].find(if name.contains("opacities") { "," } else { ")" }).unwrap();
        let end = if name.contains("opacities") { end } else { end + 1 };
        format!("{}{value}{}", &text[..at], &text[end..])
    };
    has(&usd(first("float[] opacities", "1.5").as_bytes()), &["opacities, element 0", "0 to 1", "1.5"]);
    has(&usd(first("float3[] scales", "(1, -1, 1)").as_bytes()), &["scales, element 0", "at least 0", "-1"]);
    has(&usd(first("quatf[] orientations", "(0, 0, 0, 0)").as_bytes()), &["orientations, element 0", "unit length"]);
    let stretched = "double3 xformOp:scale = (1, 2, 1)\n    uniform token[] xformOpOrder = [\"xformOp:scale\"]\n    uniform token s";
    has(&edited("uniform token s", stretched), &["xformOpOrder", "same positive scale"]);
    let unknown = "double xformOp:spin = 3\n    uniform token[] xformOpOrder = [\"xformOp:spin\"]\n    uniform token s";
    has(&edited("uniform token s", unknown), &["xformOpOrder", "translate, scale", "xformOp:spin"]);
}

#[test]
fn pages() {
    has(&try_all(Format::Html, b"<!doctype html>").unwrap_err(), &["Gaussians", "this program"]);
    has(&try_all(Format::Html, &[0xff, 0xfe]).unwrap_err(), &["UTF-8"]);
    let data = |text: &str| {
        let page =
            format!("<script type=\"application/octet-stream\" id=\"gaussians\" data-up=\"0 0 1\">{text}</script>");
        try_all(Format::Html, page.as_bytes()).unwrap_err()
    };
    has(&data("?"), &["base64"]);
    has(&data("AAAA"), &["multiple of 56", "found 3"]);
}

/// Three quarters of a file, as an interrupted copy or download leaves it.
#[test]
fn files_that_are_cut_off_are_said_to_be() {
    let versions = [SpzVersion::V3, SpzVersion::V4];
    for (format, version) in Format::ALL.into_iter().flat_map(|f| versions.map(|v| (f, v))) {
        let mut bytes = example(format, version);
        let mut end = bytes.len() * 3 / 4;
        if format == Format::Html {
            // Most of a small page is the script after the Gaussians.
            let mark: &[u8] = b"id=\"gaussians\"";
            end = bytes.windows(mark.len()).position(|w| w == mark).unwrap() + 100;
        }
        bytes.truncate(end);
        has(&try_all(format, &bytes).unwrap_err(), &["cut off"]);
    }
    // Before the Gaussians of a page; and the lengths of a .glb in their order.
    has(&refused(Format::Html, |b| b.truncate(300)), &["another one, or the file is cut off"]);
    let whole = example(Format::Glb, SpzVersion::V3).len();
    let (claimed, longer) = (format!("expected {whole} bytes, as the header says"), format!("found {}", whole + 4));
    has(&refused(Format::Glb, |b| b.truncate(500)), &[&claimed, "found 500: cut off or incomplete"]);
    has(&refused(Format::Glb, |b| b.extend([0; 4])), &[&claimed, &longer]);
    has(&try_all(Format::Glb, b"{\"scenes\": [").unwrap_err(), &["JSON", "cut off"]);
    // What is damaged, but whole, is not.
    let damaged = refused(Format::Sog, |b| b[..200].fill(7));
    assert!(!damaged.contains("cut off"), "{damaged}");
}

fn formats() -> impl Strategy<Value = (Format, SpzVersion)> {
    let all = Format::ALL.into_iter().map(|f| (f, SpzVersion::V3));
    prop::sample::select(all.chain([(Format::Spz, SpzVersion::V4)]).collect::<Vec<_>>())
}

proptest! {
    // PROPTEST_CASES asks for more.
    #![proptest_config(ProptestConfig { cases: ProptestConfig::default().cases.max(2000), ..ProptestConfig::default() })]

    #[test]
    fn garbage_never_panics((format, _) in formats(), bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let _ = try_all(format, &bytes);
    }

    #[test]
    fn damaged_files_never_panic((format, version) in formats(), changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6), cut in any::<prop::sample::Index>(), keep: bool) {
        let mut bytes = example(format, version);
        for (at, value) in changes {
            let length = bytes.len();
            bytes[at.index(length)] = value;
        }
        if !keep {
            bytes.truncate(cut.index(bytes.len()));
        }
        let _ = try_all(format, &bytes);
    }

    #[test]
    fn damage_within_a_compressed_stream_never_panics(changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6)) {
        let mut raw = Vec::new();
        std::io::Read::read_to_end(&mut flate2::read::GzDecoder::new(&example(Format::Spz, SpzVersion::V3)[..]), &mut raw).unwrap();
        for (at, value) in changes {
            let length = raw.len();
            raw[at.index(length)] = value;
        }
        let _ = try_all(Format::Spz, &gzip(&raw));
    }
}
