//! `.ply` files: our own, those of other tools, and broken ones.

use freerange_gaussians::{
    Gaussians, Harmonics, PlyFile, RenderMode, SplatError, Splats, channel, coefficients, encode_splats, parse_ply,
    read_ply, write_ply,
};
use glam::DVec3;
use proptest::prelude::*;
use std::path::Path;

const COLUMNS: &str = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";

fn parse(bytes: &[u8]) -> Result<PlyFile, SplatError> {
    parse_ply(bytes, Path::new("test.ply"))
}

fn example() -> Gaussians {
    Gaussians::from_rows((0..6 * channel::COUNT).map(|v| (v as f32 * 0.7).sin()).collect())
}

/// The value of column `name` in a file.
fn stored(row: &[f32; 14], name: &str) -> f32 {
    let number = || name.bytes().last().map(|b| usize::from(b - b'0')).unwrap();
    match name {
        "x" => row[0],
        "y" => row[1],
        "z" => row[2],
        "opacity" => row[10],
        _ if name.starts_with("scale_") => row[3 + number()],
        _ if name.starts_with("rot_") => row[6 + number()],
        _ if name.starts_with("f_dc_") => ((f64::from(row[11 + number()]) - 0.5) / 0.28209479177387814) as f32,
        _ => 9.5,
    }
}

fn header(format: &str, count: impl std::fmt::Display, columns: &str, kind: &str) -> String {
    let properties: String = columns.split(' ').map(|c| format!("property {kind} {c}\n")).collect();
    format!("ply\nformat {format} 1.0\ncomment made by a test\nelement vertex {count}\n{properties}end_header\n")
}

fn ascii(cloud: &Gaussians, columns: &str) -> String {
    let mut text = header("ascii", cloud.len(), columns, "float");
    for row in cloud {
        let words: Vec<String> = columns.split(' ').map(|c| stored(row, c).to_string()).collect();
        text += &(words.join(" ") + "\n");
    }
    text
}

/// Equal in every bit, but for color, which goes through one rounding.
fn assert_same(found: &Gaussians, expected: &Gaussians) {
    assert_eq!(found.len(), expected.len());
    for (f, e) in found.iter().zip(expected) {
        assert_eq!(
            f[..11].iter().map(|v| v.to_bits()).collect::<Vec<_>>(),
            e[..11].iter().map(|v| v.to_bits()).collect::<Vec<_>>()
        );
        for c in channel::COLOR {
            assert!((f[c] - e[c]).abs() <= 1.2e-7 * e[c].abs().max(0.5), "{} {}", f[c], e[c]);
        }
    }
}

proptest! {
    #[test]
    fn our_files_come_back(rows in prop::collection::vec(prop::array::uniform14(any::<f32>()), 0..50)) {
        let finite = |v: f32| if v.is_finite() { v } else { 1.0 };
        let mut cloud = Gaussians::from_rows(rows.concat().into_iter().map(finite).collect());
        for row in cloud.iter_mut() {
            // Of colors a thousand times brighter than white nobody keeps the last bit.
            row[channel::COLOR].iter_mut().for_each(|v| *v %= 1000.0);
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ply");
        write_ply(&cloud, &path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        prop_assert!(bytes.ends_with(b"end_header\n") || !cloud.is_empty());
        assert_same(&read_ply(&path).unwrap().splats.cloud, &cloud);
        write_ply(&cloud, &path).unwrap();
        prop_assert_eq!(bytes, std::fs::read(&path).unwrap());
        prop_assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn garbage_is_refused_without_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        prop_assert!(parse(&bytes).is_err());
        let with_magic = [b"ply\nformat ascii 1.0\n".as_slice(), &bytes].concat();
        prop_assert!(parse(&with_magic).is_err());
        // After a good header anything can follow; what comes out is finite.
        for format in ["ascii", "binary_little_endian", "binary_big_endian"] {
            let text = header(format, 3, COLUMNS, "float");
            if let Ok(file) = parse(&[text.as_bytes(), &bytes].concat()) {
                prop_assert!((1..=3).contains(&file.splats.cloud.len()));
                prop_assert!(file.splats.cloud.check_finite().is_ok());
            }
        }
    }

    #[test]
    fn a_damaged_file_is_refused_or_finite(at in 0usize..900, value: u8, cut in 0usize..900) {
        let mut bytes = ascii(&example(), COLUMNS).into_bytes();
        let length = bytes.len();
        bytes[at % length] = value;
        bytes.truncate(length - cut % length);
        if let Ok(file) = parse(&bytes) {
            prop_assert!(file.splats.cloud.check_finite().is_ok());
        }
    }

    #[test]
    fn any_order_of_properties_will_do(order in Just(COLUMNS.split(' ').collect::<Vec<_>>()).prop_shuffle()) {
        let file = parse(ascii(&example(), &order.join(" ")).as_bytes()).unwrap();
        assert_same(&file.splats.cloud, &example());
        prop_assert!(file.notes.is_empty());
    }
}

#[test]
fn the_bytes_are_those_of_the_format() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("one.ply");
    let mut row = std::array::from_fn::<f32, 14, _>(|i| i as f32);
    row[11..].copy_from_slice(&[0.5, 0.5 + 0.282_094_8, 0.0]);
    write_ply(&Gaussians::from_rows(row.to_vec()), &path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let expected = header("binary_little_endian", 1, COLUMNS, "float").replace("comment made by a test\n", "");
    assert_eq!(std::str::from_utf8(&bytes[..expected.len()]).unwrap(), expected);
    let values: Vec<f32> = bytes[expected.len()..].as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    assert_eq!(values[..6], [0.0, 1.0, 2.0, 0.0, 0.0, 0.0]);
    assert_eq!(values[6], 0.0);
    assert!((values[7] - 1.0).abs() < 1e-6 && (values[8] + 0.5 / 0.282_094_8).abs() < 1e-6);
    assert_eq!(values[9..], [10.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]);
}

#[test]
fn both_byte_orders_and_doubles() {
    let cloud = example();
    for kind in ["float", "double", "float32", "float64"] {
        for format in ["binary_little_endian", "binary_big_endian"] {
            let mut bytes = header(format, cloud.len(), COLUMNS, kind).into_bytes();
            for row in &cloud {
                for column in COLUMNS.split(' ') {
                    let v = stored(row, column);
                    let (little, double) = (format.contains("little"), kind.contains('6') || kind == "double");
                    match (little, double) {
                        (true, false) => bytes.extend(v.to_le_bytes()),
                        (true, true) => bytes.extend(f64::from(v).to_le_bytes()),
                        (false, false) => bytes.extend(v.to_be_bytes()),
                        (false, true) => bytes.extend(f64::from(v).to_be_bytes()),
                    }
                }
            }
            bytes.extend(b"trailing bytes are nobody's");
            assert_same(&parse(&bytes).unwrap().splats.cloud, &cloud);
        }
    }
}

#[test]
fn files_of_other_tools() {
    // No normals, spherical harmonics of higher order, a byte color, faces before and after, Windows line ends.
    let mut bytes = b"ply\r\nformat binary_little_endian 1.0\r\nobj_info x\r\nelement face 2\r\nproperty list uchar int vertex_indices\r\nelement nothing 99999999999999\r\nelement vertex 1\r\nproperty uchar red\r\n".to_vec();
    let columns = COLUMNS.replace("nx ny nz ", "");
    for name in columns.split(' ').chain(["f_rest_0", "f_rest_1", "f_rest_2"]) {
        bytes.extend(format!("property float {name}\r\n").bytes());
    }
    bytes.extend(b"element after 5\r\nproperty int a\r\nend_header\r\n");
    for face in [vec![1i32, 2, 3], vec![4, 5, 6, 7]] {
        bytes.push(face.len() as u8);
        bytes.extend(face.iter().flat_map(|v| v.to_le_bytes()));
    }
    bytes.push(200);
    let cloud = example().select([2]);
    bytes.extend(columns.split(' ').flat_map(|c| stored(cloud.row(0), c).to_le_bytes()));
    bytes.extend([0x7f; 12]);
    let file = parse(&bytes).unwrap();
    assert_same(&file.splats.cloud, &cloud);
    assert_eq!(file.notes.len(), 3, "{:?}", file.notes);
    assert!(file.notes[0].starts_with("3 of 3 properties f_rest_*"));
    assert!(file.notes[1].contains("red"));
    assert!(file.notes[2].contains("face, nothing, after"));

    // ascii: blank lines, tabs, lists, and whole numbers as positions.
    let text = "ply\nformat ascii 1.0\nelement vertex 1\nproperty int x\nproperty int y\nproperty short z\nproperty list uchar float tail\n";
    let rest: String = columns.split(' ').skip(3).map(|c| format!("property float {c}\n")).collect();
    let text = format!("{text}{rest}end_header\n\n 1\t-2 3 2 0.5 0.25 0 0 0 1 2 3 4 0 0 0 0\r\n");
    let file = parse(text.as_bytes()).unwrap();
    assert_eq!(file.splats.cloud.rows(), [1.0, -2.0, 3.0, 2.0, 3.0, 4.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.5, 0.5, 0.5]);
    assert!(file.notes.iter().any(|n| n.contains("rotation of length zero")));
}

/// The message of the error that `bytes` give.
fn refusal(bytes: &[u8]) -> String {
    parse(bytes).unwrap_err().to_string()
}

#[test]
fn errors_say_what_and_where() {
    let good = ascii(&example(), COLUMNS);
    let vertex = good.lines().nth(24).unwrap();
    let with = |from: &str, to: &str| refusal(good.replacen(from, to, 1).as_bytes());
    let words: Vec<&str> = vertex.split(' ').collect();
    for (message, parts) in [
        (refusal(b"plx\n"), &["test.ply", "line 1", "\"ply\"", "plx"][..]),
        (refusal(b""), &["line 1", "end of the file"]),
        (refusal(b"ply\nend_header\n"), &["format"]),
        (with("ascii", "utf8"), &["line 2", "binary_little_endian", "utf8"]),
        (with("vertex 6", "vertex -6"), &["line 4", "count", "-6"]),
        (with("vertex 6", "vertex 99999999999999999999999"), &["line 4", "count"]),
        (with("property float ny", "property float nx"), &["line 9", "once"]),
        (with("property float nx", "property half nx"), &["line 8", "type", "half"]),
        (with("property float nx", "propertee float nx"), &["line 8", "propertee"]),
        (with("element vertex", "element points"), &["vertex", "points"]),
        (with("property float opacity", "property float alpha"), &["\"opacity\"", "no such property"]),
        (with("property float opacity", "property uchar opacity"), &["\"opacity\"", "float or double", "uchar"]),
        (with("property float rot_2", "property list uchar float rot_2"), &["\"rot_2\"", "a list"]),
        (with("vertex 6", "vertex 7"), &["row 6", "7 rows", "end of the file"]),
        (with(vertex, &format!("{vertex} 1")), &["row 2", "rot_3", "end of the line"]),
        (with(vertex, &words[1..].join(" ")), &["row 2", "rot_3", "a number", "end of the line"]),
        (with(vertex, &vertex.replacen(words[1], "one", 1)), &["row 2", "\"y\"", "a number (float)", "one"]),
    ] {
        assert!(parts.iter().all(|part| message.contains(part)), "{message:?} lacks one of {parts:?}");
    }
    let missing = read_ply(Path::new("no/such.ply")).unwrap_err().to_string();
    assert!(missing.contains("no/such.ply"), "{missing}");
    let mut poisoned = example();
    poisoned.rows_mut()[20] = f32::NAN;
    let error = write_ply(&poisoned, Path::new("never-written.ply")).unwrap_err();
    assert!(matches!(error, SplatError::Value { row: 1, channel: 6, .. }), "{error}");
    assert!(!Path::new("never-written.ply").exists());
}

/// An ascii file of the example, whose values of `column` in the first rows are `values`.
fn with_values(column: &str, values: &[&str]) -> PlyFile {
    let at = COLUMNS.split(' ').position(|c| c == column).unwrap();
    let mut text = header("ascii", 6, COLUMNS, "float");
    for (i, line) in ascii(&example(), COLUMNS).lines().skip_while(|l| *l != "end_header").skip(1).enumerate() {
        let mut words: Vec<&str> = line.split(' ').collect();
        words[at] = values.get(i).copied().unwrap_or(words[at]);
        text += &(words.join(" ") + "\n");
    }
    parse(text.as_bytes()).unwrap()
}

#[test]
fn infinite_opacities_are_those_of_0_and_1() {
    let file = with_values("opacity", &["inf", "-inf"]);
    let cloud = file.splats.cloud;
    assert!(cloud.len() == 6 && 1.0 - cloud.opacity(0) < 2e-7 && cloud.opacity(1) < 2e-7);
    assert!(file.notes.iter().any(|n| n.starts_with("2 Gaussians have an infinite opacity")), "{:?}", file.notes);
    let flat = with_values("scale_1", &["-inf"]);
    assert!(flat.splats.cloud.len() == 6 && flat.splats.cloud.scale(0).y < 1e-16);
}

#[test]
fn gaussians_that_are_not_finite_are_left_out_and_counted() {
    for (column, value) in [("opacity", "NaN"), ("x", "inf"), ("scale_0", "inf"), ("f_dc_0", "1e50"), ("rot_3", "-NaN")]
    {
        let file = with_values(column, &["0", value]);
        assert_eq!(file.splats.cloud.len(), 5, "{column}");
        assert_eq!(file.splats.cloud.row(1)[..2], example().row(2)[..2]);
        assert!(file.notes.iter().any(|n| n.starts_with("1 Gaussians with numbers")), "{:?}", file.notes);
    }
    let all = header("ascii", 1, COLUMNS, "float") + &"NaN ".repeat(17) + "\n";
    assert!(refusal(all.as_bytes()).contains("at least one Gaussian of finite numbers"));
}

#[test]
fn flat_gaussians_have_no_third_deviation() {
    let columns = COLUMNS.replace("scale_2 ", "");
    let file = parse(ascii(&example(), &columns).as_bytes()).unwrap();
    assert_eq!(file.splats.mode, RenderMode::Flat);
    assert!(file.notes[0].contains("scale_2"), "{:?}", file.notes);
    for (found, expected) in file.splats.cloud.iter().zip(&example()) {
        assert_eq!((found[5], &found[..5], &found[6..11]), (-40.0, &expected[..5], &expected[6..11]));
    }
    let columns = COLUMNS.replace("scale_1 ", "");
    assert!(refusal(ascii(&example(), &columns).as_bytes()).contains("scale_1"));
}

#[test]
fn colors_may_be_bytes() {
    let columns = "x y z opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3 red green blue";
    let text = header("ascii", 1, columns, "float");
    let row = "1 2 3 0.5 -1 -2 -3 1 0 0 0 255 51 0\n";
    for (kind, most) in [("uchar", 255.0), ("ushort", 65535.0), ("float", 1.0)] {
        let kinds = ["red", "green", "blue"]
            .iter()
            .fold(text.clone(), |t, c| t.replace(&format!("float {c}"), &format!("{kind} {c}")));
        let file = parse((kinds + row).as_bytes()).unwrap();
        let color = file.splats.cloud.color(0);
        assert!(color.abs_diff_eq(DVec3::new(255.0, 51.0, 0.0) / most, 1e-6), "{kind}: {color}");
        assert!(file.notes.is_empty(), "{:?}", file.notes);
    }
    assert!(refusal((text.replace("float red", "int red") + row).as_bytes()).contains("\"red\" of element"));
}

#[test]
fn comments_tell_how_to_draw_and_which_way_is_up() {
    let told = |comments: &[&str]| {
        let lines: String = comments.iter().map(|c| format!("comment {c}\n")).collect();
        let text = ascii(&example(), COLUMNS).replace("comment made by a test\n", &lines);
        let file = parse(text.as_bytes()).unwrap();
        (file.splats.mode, file.up)
    };
    assert_eq!(told(&[]), (RenderMode::Default, None));
    assert_eq!(told(&["SplatRenderMode: mip", "Vertical axis: y"]), (RenderMode::Mip, Some(-DVec3::Y)));
    assert_eq!(
        told(&["antialiased 1", "vertical  axis: 0 0.6 0.8"]),
        (RenderMode::Mip, Some(DVec3::new(0.0, 0.6, 0.8)))
    );
    assert_eq!(told(&["SplatRenderMode: mip", "antialiased 0"]), (RenderMode::Default, None));
    assert_eq!(told(&["SplatRenderMode: 2dgs", "SplatRenderMode: of 2040"]), (RenderMode::Flat, None));
    assert_eq!(
        told(&["Vertical axis: 0 0 0", "Vertical axis: 1 NaN 2", "Vertical axis:"]),
        (RenderMode::Default, None)
    );
}

#[test]
fn harmonics_mode_axis_and_origin_survive() {
    let cloud = example();
    for degree in 0..=3 {
        let width = 3 * coefficients(degree);
        let harmonics = Harmonics::from_rows(degree, (0..6 * width).map(|v| (v as f32 * 0.37).cos()).collect());
        let origin = DVec3::new(4e6, -1e6, 2.0) * f64::from(u8::from(degree == 2));
        let splats = Splats { cloud: cloud.clone(), harmonics, mode: RenderMode::Mip, origin };
        let bytes = encode_splats(&splats, -DVec3::Y).unwrap();
        let file = parse(&bytes).unwrap();
        assert_same(&file.splats.cloud, &cloud);
        let (harmonics, mode) = (&file.splats.harmonics, file.splats.mode);
        assert_eq!((harmonics, mode, file.up), (&splats.harmonics, RenderMode::Mip, Some(-DVec3::Y)));
        assert_eq!(file.splats.origin, origin);
        // Channel by channel: the second number of a Gaussian is its second coefficient of red.
        if degree > 0 {
            let text = String::from_utf8_lossy(&bytes);
            let start = text.find("end_header\n").unwrap() + 11 + 9 * 4;
            let second = f32::from_le_bytes(bytes[start + 4..start + 8].try_into().unwrap());
            assert_eq!(second, splats.harmonics.row(0)[3]);
        }
    }
}

#[test]
fn positions_of_64_bits_far_away_keep_their_shape() {
    let far = [3_959_505.25f64, -3_699_979.5, 12.0];
    let mut bytes = header("binary_little_endian", 6, COLUMNS, "double").into_bytes();
    for row in &example() {
        for column in COLUMNS.split(' ') {
            let shift = "xyz".find(column).map_or(0.0, |k| far[k]);
            bytes.extend((f64::from(stored(row, column)) + shift).to_le_bytes());
        }
    }
    let splats = parse(&bytes).unwrap().splats;
    for i in 0..6 {
        let expected = example().mean(i) + DVec3::from_array(far);
        assert!((splats.position(i) - expected).length() < 1e-6, "{}", splats.position(i) - expected);
    }
}

#[test]
fn counts_are_not_believed() {
    // Neither memory nor time: the bytes run out at once.
    for format in ["ascii", "binary_little_endian"] {
        let message = refusal(header(format, u64::MAX, COLUMNS, "float").as_bytes());
        assert!(message.contains("row 0") && message.contains("end of the file"), "{message}");
    }
    let mut bytes = header("binary_big_endian", 1, "a", "list uint double").into_bytes();
    bytes.extend([0xff; 4]);
    assert!(refusal(&bytes).contains("\"x\""));
    let list = header("binary_big_endian", 1, COLUMNS, "float")
        .replace("element", "element a 1\nproperty list uint double b\nelement");
    let message = refusal(&[list.as_bytes(), &[0xff; 4]].concat());
    assert!(message.contains("element \"a\"") && message.contains("end of the file"), "{message}");
    let negative = list.replace("list uint", "list int");
    assert!(refusal(&[negative.as_bytes(), &[0xff; 4]].concat()).contains("length of a list"));
    // A header without end.
    let endless = [b"ply\n".as_slice(), &b"comment x\n".repeat(1 << 18)].concat();
    assert!(refusal(&endless).contains("too long"));
    let endless = [b"ply\ncomment ".as_slice(), &vec![b'x'; 1 << 20]].concat();
    assert!(refusal(&endless).contains("too long"));
}

/// A compressed file of so many chunks and Gaussians: all bounds are -1 and 3, all words are `word`.
fn compressed(chunks: usize, gaussians: usize, word: u32) -> Vec<u8> {
    let bounds = ["x", "y", "z", "scale_x", "scale_y", "scale_z"];
    let columns = |side: &str, names: &[&str]| -> String {
        names.iter().map(|name| format!("property float {side}_{name}\n")).collect()
    };
    let mut file = format!("ply\nformat binary_little_endian 1.0\nelement chunk {chunks}\n");
    for names in [&bounds[..3], &bounds[3..]] {
        file += &(columns("min", names) + &columns("max", names));
    }
    file += &format!("element vertex {gaussians}\n");
    for name in ["position", "rotation", "scale", "color"] {
        file += &format!("property uint packed_{name}\n");
    }
    let mut bytes = (file + "end_header\n").into_bytes();
    for _ in 0..2 * chunks {
        [-1f32, -1.0, -1.0, 3.0, 3.0, 3.0].iter().for_each(|v| bytes.extend(v.to_le_bytes()));
    }
    (0..4 * gaussians).for_each(|_| bytes.extend(word.to_le_bytes()));
    bytes
}

#[test]
fn compressed_files_are_unpacked_between_the_bounds_of_their_chunk() {
    // All ones are the greatest value, of a rotation three components of half the root of 2: more than a unit
    // quaternion has.
    let row = *parse(&compressed(1, 3, u32::MAX)).unwrap().splats.cloud.row(2);
    assert_eq!(row[..6], [3.0; 6]);
    assert!(row[6..9].iter().all(|v| (v - (1f32 / 3.0).sqrt()).abs() < 1e-6) && row[9] == 0.0, "{row:?}");
    assert!(row[10] > 5.5 && row[11..] == [1.0; 3]);
    let row = *parse(&compressed(1, 1, 0)).unwrap().splats.cloud.row(0);
    assert_eq!(row[..6], [-1.0; 6]);
    assert!(row[10] < -5.5 && row[11..] == [0.0; 3]);
    // Gaussian 256 is in the second chunk.
    assert_eq!(parse(&compressed(2, 257, 0)).unwrap().splats.cloud.len(), 257);
}

#[test]
fn broken_compressed_files_are_refused() {
    let refused = |bytes: &[u8], words: &[&str]| {
        let message = parse(bytes).unwrap_err().to_string();
        words.iter().for_each(|w| assert!(message.contains(w), "{w:?} in {message}"));
    };
    let edited = |from: &str, to: &str| {
        let mut bytes = compressed(1, 2, 7);
        let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
        bytes.splice(at..at + from.len(), to.bytes());
        bytes
    };
    refused(&compressed(1, 257, 0), &["row 256", "packed_position", "a chunk for every Gaussian", "1 chunks"]);
    refused(&edited("element chunk", "element other"), &["\"chunk\" before", "none"]);
    refused(&edited("float min_x", "float mix_x"), &["min_x", "no such property"]);
    refused(&edited("float max_scale_y", "int max_scale_y"), &["max_scale_y", "float or double", "int"]);
    refused(&edited("uint packed_color", "int packed_color"), &["packed_color", "expected uint", "int"]);
    refused(
        &edited("element vertex 2", "element vertex 9000000000"),
        &["row 2", "9000000000 rows", "the end of the file"],
    );
    let mut infinite = compressed(1, 2, 7);
    let at = infinite.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    infinite[at + 4..at + 8].copy_from_slice(&f32::INFINITY.to_le_bytes());
    refused(&infinite, &["element \"chunk\"", "row 0", "min_y", "a finite number", "inf"]);
}
