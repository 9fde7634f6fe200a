//! OBJ with MTL, and PLY.

use std::path::Path;

use freerange_assets::mesh::{
    AlphaMode, LoadLimits, Loaded, MeshFormat, Texture, Up, load_mesh, load_mesh_bytes, srgb_to_linear,
};
use glam::{Vec2, Vec4};

use crate::glb::{assert_close, file_triangles, small_picture};

fn load(format: MeshFormat, text: &[u8]) -> Loaded {
    load_mesh_bytes(format, text, &LoadLimits::default()).unwrap()
}

fn error(format: MeshFormat, text: impl AsRef<[u8]>) -> String {
    load_mesh_bytes(format, text.as_ref(), &LoadLimits::default()).expect_err("must be refused").to_string()
}

const SQUARE: &str = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\n";

#[test]
fn obj_polygons_become_fans_with_normals_and_coordinates() {
    let text = format!("{SQUARE}vt 0 0.25\nvt 1 0\nvn 0 0 1 # up\nf 1/1/1 2/2/1 3/2/1 \\\n -1/-2/-1\n");
    let loaded = load(MeshFormat::Obj, text.as_bytes());
    let triangles = file_triangles(&loaded);
    assert_eq!(triangles.len(), 2);
    assert_close(triangles[1][0], [0.0, 0.0, 0.0]);
    assert_close(triangles[1][1], [2.0, 2.0, 0.0]);
    assert_close(triangles[1][2], [0.0, 2.0, 0.0]);
    // +y is up: the normal +z becomes -y. v runs down: 0.25 becomes 0.75.
    assert_close(loaded.mesh.normals[0], [0.0, -1.0, 0.0]);
    assert_eq!(loaded.mesh.uvs[loaded.mesh.triangles[0][0] as usize], Vec2::new(0.0, 0.75));
    assert_eq!(loaded.mesh.positions.len(), 4, "corners that agree share a vertex");
    assert!(loaded.notes.is_empty(), "{:?}", loaded.notes);
}

#[test]
fn the_up_axis_can_be_chosen() {
    let text = format!("{SQUARE}f 1 2 3 4\n");
    let limits = LoadLimits { up: Some(Up::Z), ..LoadLimits::default() };
    let loaded = load_mesh_bytes(MeshFormat::Obj, text.as_bytes(), &limits).unwrap();
    assert_close(loaded.mesh.normals[0], [0.0, 0.0, 1.0]);
    let limits = LoadLimits { up: Some(Up::Y), ..LoadLimits::default() };
    let ply = ply_text("ascii", 3, 1) + "0 0 0\n2 0 0\n0 2 0\n3 0 1 2\n";
    let loaded = load_mesh_bytes(MeshFormat::Ply, ply.as_bytes(), &limits).unwrap();
    assert_close(loaded.mesh.normals[0], [0.0, -1.0, 0.0]);
}

#[test]
fn obj_vertex_colors_are_srgb() {
    let text = "v 0 0 0 0.5 1 0\nv 1 0 0 0.5 1 0\nv 0 1 0 0.5 1 0\nf 1 2 3\n";
    let loaded = load(MeshFormat::Obj, text.as_bytes());
    let want = Vec4::new(srgb_to_linear(0.5), 1.0, 0.0, 1.0);
    assert_eq!(loaded.mesh.colors, [want; 3]);
    let some = load(MeshFormat::Obj, text.replacen("v 1 0 0 0.5 1 0", "v 1 0 0", 1).as_bytes());
    assert!(some.mesh.colors.is_empty() && some.notes[0].contains("vertex colors are ignored"));
}

fn write_obj(folder: &Path, mtl: &str) -> Loaded {
    let text = format!(
        "mtllib my scene.mtl\nmtllib none.mtl\n{SQUARE}vt 0 0\nvt 1 1\nusemtl\ta\nf 1/1 2/2 3/2\nusemtl b\nf 1/1 3/1 4/1\n"
    );
    std::fs::write(folder.join("scene.obj"), text).unwrap();
    std::fs::write(folder.join("my scene.mtl"), mtl).unwrap();
    load_mesh(&folder.join("scene.obj"), &LoadLimits::default()).unwrap()
}

#[test]
fn obj_materials() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("photo 1.png"), small_picture(image::ImageFormat::Png)).unwrap();
    let loaded = write_obj(
        folder.path(),
        "newmtl a\nKd 0.1 0.1 0.1\nmap_Kd -s 2 2 C:\\someone\\photo 1.png\nmap_Bump gone.png\nKs 0.5 0.5 0.5\nNs 30\n\
         newmtl b\nKd 0.25\nKs 0 0 0\nTr 0.25\nPr 0.7\nPm 1\nmap_d other.png\n",
    );
    let [a, b] = &loaded.mesh.materials[..] else { panic!("two materials") };
    let Texture::Image(map) = &a.texture else { panic!("a picture") };
    assert_eq!((map.picture.width(), a.factor), (4, Vec4::ONE));
    assert_eq!(map.transform.transform_vector2(Vec2::ONE), Vec2::new(2.0, 2.0));
    assert!((a.specular - 0.04).abs() < 1e-6 && (a.roughness - 0.5).abs() < 1e-6);
    assert_eq!(a.alpha, AlphaMode::Opaque);
    assert_eq!((b.factor, b.alpha), (Vec4::new(0.25, 0.25, 0.25, 0.75), AlphaMode::Blend));
    assert_eq!((b.specular, b.roughness, b.metallic), (0.0, 0.7, 1.0));
    let notes = loaded.notes.join("; ");
    for word in ["none.mtl\" is missing", "gone.png\" is missing", "map_d"] {
        assert!(notes.contains(word), "{word} in {notes}");
    }
}

#[test]
fn obj_normal_maps_are_told_from_bump_maps() {
    let folder = tempfile::tempdir().unwrap();
    image::RgbImage::from_pixel(4, 4, image::Rgb([128, 128, 255])).save(folder.path().join("normal.png")).unwrap();
    image::RgbImage::from_pixel(4, 4, image::Rgb([99, 99, 99])).save(folder.path().join("height.png")).unwrap();
    let loaded = write_obj(folder.path(), "newmtl a\nmap_Bump -bm 0.2 normal.png\nnewmtl b\nbump height.png\n");
    assert!(loaded.mesh.materials[0].normal_map.is_some());
    assert!(loaded.mesh.materials[1].normal_map.is_none());
    assert!(loaded.notes.iter().any(|n| n.contains("heights")));
}

#[test]
fn obj_files_that_are_broken() {
    for (text, word) in [
        ("f 1 2 3\n", "statement 1: f"),
        ("v 0 0\n", "statement 1: v"),
        ("v 0 0 x\n", "statement 1: v"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "statement 4: f"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "statement 4: f"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -4 1 2\n", "statement 4: f"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/9223372036854775807 2/1 3/1\n", "statement 4: f"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/-9223372036854775808 2 3\n", "statement 4: f"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1/1/1 2 3\n", "statement 4: f"),
        ("v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", "positions"),
        ("v 0 0 0\nv 1 0 0\nv 0 1e99 0\nf 1 2 3\n", "positions"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "area"),
        ("v 0 0 0\nv 1 0 0\nl 1 2\n", "triangles"),
        ("", "triangles"),
    ] {
        assert!(error(MeshFormat::Obj, text).contains(word), "{text:?}: {}", error(MeshFormat::Obj, text));
    }
    let limits = LoadLimits { max_triangles: 9, max_vertices: 4, ..LoadLimits::default() };
    let fan = format!("{SQUARE}f {}\n", "1 ".repeat(12));
    let message = load_mesh_bytes(MeshFormat::Obj, fan.as_bytes(), &limits).unwrap_err().to_string();
    assert!(message.contains("max_triangles"), "{message}");
    let many = load_mesh_bytes(MeshFormat::Obj, format!("{SQUARE}v 0 0 0\nf 1 2 3").as_bytes(), &limits);
    assert!(many.unwrap_err().to_string().contains("max_vertices"));
}

fn ply_text(format: &str, vertices: u64, faces: u64) -> String {
    format!(
        "ply\nformat {format} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n\
         element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    )
}

const FULL_HEADER: &str = "element vertex 4\nproperty double x\nproperty float y\nproperty short z\nproperty float nx\n\
    property float ny\nproperty float nz\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n\
    property float s\nproperty float t\nelement edge 1\nproperty int a\nelement face 1\n\
    property uchar flags\nproperty list uchar uint vertex_index\nend_header\n";

#[test]
fn ply_in_three_encodings() {
    let corners = [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]];
    let mut ascii = format!("ply\nformat ascii 1.0\ncomment x\n{FULL_HEADER}").into_bytes();
    let mut little = format!("ply\nformat binary_little_endian 1.0\n{FULL_HEADER}").into_bytes();
    let mut big = format!("ply\nformat binary_big_endian 1.0\n{FULL_HEADER}").into_bytes();
    for [x, y] in corners {
        ascii.extend(format!("{x} {y} 3 0 0 1 255 128 0 {} {}\n", x / 4.0, y / 4.0).bytes());
        let rest = [0.0, 0.0, 1.0].map(|n: f32| n);
        let uv = [x as f32 / 4.0, y as f32 / 4.0];
        little.extend(f64::to_le_bytes(x));
        little.extend((y as f32).to_le_bytes());
        little.extend(3i16.to_le_bytes());
        rest.iter().for_each(|n| little.extend(n.to_le_bytes()));
        little.extend([255, 128, 0]);
        uv.iter().for_each(|n| little.extend(n.to_le_bytes()));
        big.extend(f64::to_be_bytes(x));
        big.extend((y as f32).to_be_bytes());
        big.extend(3i16.to_be_bytes());
        rest.iter().for_each(|n| big.extend(n.to_be_bytes()));
        big.extend([255, 128, 0]);
        uv.iter().for_each(|n| big.extend(n.to_be_bytes()));
    }
    ascii.extend(b"7\n1 4 0 1 2 3\n");
    little.extend([7, 0, 0, 0, 1, 4]);
    big.extend([0, 0, 0, 7, 1, 4]);
    for i in 0..4u32 {
        little.extend(i.to_le_bytes());
        big.extend(i.to_be_bytes());
    }
    for bytes in [ascii, little, big] {
        let loaded = load(MeshFormat::Ply, &bytes);
        let triangles = file_triangles(&loaded);
        assert_eq!(triangles.len(), 2);
        assert_close(triangles[1][1], [2.0, 2.0, 3.0]);
        // +z is up.
        assert_close(loaded.mesh.normals[0], [0.0, 0.0, 1.0]);
        assert_eq!(loaded.mesh.uvs[2], Vec2::new(0.5, 0.5));
        assert_eq!(loaded.mesh.uvs[0], Vec2::new(0.0, 1.0));
        let want = Vec4::new(1.0, srgb_to_linear(128.0 / 255.0), 0.0, 1.0);
        assert!(loaded.mesh.colors.iter().all(|c| c.distance(want) < 1e-6));
        assert_eq!(loaded.notes, ["elements \"edge\" are ignored"]);
    }
}

#[test]
fn ply_texture_and_coordinates_of_corners() {
    let folder = tempfile::tempdir().unwrap();
    let header = ply_text("ascii", 3, 2)
        .replace("ply\nformat ascii 1.0\n", "ply\nformat ascii 1.0\ncomment TextureFile scan.png\n")
        .replace("end_header", "property list uchar float texcoord\nend_header");
    let body = "0 0 0\n1 0 0\n0 1 0\n3 0 1 2 6 0 0 1 0 0 1\n3 0 2 1 6 0.5 0.5 0 1 1 0\n";
    let path = folder.path().join("scan.ply");
    std::fs::write(&path, header + body).unwrap();
    let without = load_mesh(&path, &LoadLimits::default()).unwrap();
    assert!(without.notes.iter().any(|n| n.contains("scan.png")), "{:?}", without.notes);
    std::fs::write(folder.path().join("scan.png"), small_picture(image::ImageFormat::Png)).unwrap();
    let mesh = load_mesh(&path, &LoadLimits::default()).unwrap().mesh;
    assert!(matches!(&mesh.materials[0].texture, Texture::Image(map) if map.picture.width() == 4));
    let uv = |t: usize| mesh.triangles[t].map(|i| mesh.uvs[i as usize]);
    assert_eq!(uv(0), [Vec2::new(0.0, 1.0), Vec2::new(1.0, 1.0), Vec2::new(0.0, 0.0)]);
    assert_eq!(uv(1), [Vec2::new(0.5, 0.5), Vec2::new(0.0, 0.0), Vec2::new(1.0, 1.0)]);
}

#[test]
fn ply_files_that_are_broken() {
    let triangle = "0 0 0\n1 0 0\n0 1 0\n";
    for (text, word) in [
        (String::new(), "end_header"),
        ("ply\nend_header\n".into(), "header"),
        (ply_text("ascii", 3, 1) + triangle, "element face"),
        (ply_text("ascii", 3, 1) + triangle + "3 0 1 3\n", "face 0"),
        (ply_text("ascii", 3, 1) + triangle + "3 0 1 -1\n", "element face"),
        (ply_text("ascii", 3, 1) + triangle + "2 0 1\n", "triangles"),
        (ply_text("ascii", 3, 1) + triangle + "200 0 1 2\n", "element face"),
        (ply_text("ascii", 3, 0) + triangle, "element face: expected at least one"),
        (ply_text("ascii", 1_000_000_000, 1) + triangle + "3 0 1 2\n", "element vertex: expected a count that fits"),
        (ply_text("binary_little_endian", 1_000_000_000, 1) + triangle, "element vertex: expected a count that fits"),
        (ply_text("binary_little_endian", u64::MAX, 1) + triangle, "element vertex: expected a count that fits"),
        (ply_text("ascii", 3, 4_000_000_000) + triangle, "element face: expected a count that fits"),
        (ply_text("binary_big_endian", 1, 1) + "123456789012\u{7f}", "element face"),
        ("ply\nformat ascii 1.0\nelement nothing 1000000000\nend_header\n".into(), "element nothing"),
    ] {
        assert!(error(MeshFormat::Ply, &text).contains(word), "{text:?}: {}", error(MeshFormat::Ply, &text));
    }
    // A list that claims four thousand million indices.
    let header = ply_text("binary_little_endian", 1, 1).replace("list uchar int", "list uint int");
    let bytes = [header.as_bytes(), &[0; 12], &[255; 4], &[0; 40]].concat();
    assert!(error(MeshFormat::Ply, bytes).contains("truncated"));
    let nan = [ply_text("binary_little_endian", 3, 1).as_bytes(), &[255; 36], &[3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]]
        .concat();
    assert!(error(MeshFormat::Ply, nan).contains("positions"));
}
