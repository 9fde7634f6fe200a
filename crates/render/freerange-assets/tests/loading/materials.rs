//! Materials and textures of glTF.

use freerange_assets::mesh::{AlphaMode, Material, Texture, Wrap, srgb_to_linear};
use glam::{Vec2, Vec3, Vec4};
use image::ImageFormat;
use serde_json::{Value, json};

use crate::glb::*;

fn png() -> Vec<u8> {
    small_picture(ImageFormat::Png)
}

fn base() -> Value {
    json!({"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}})
}

fn material(glb: &Glb) -> Material {
    glb.load().mesh.materials[0].clone()
}

fn map(material: &Material) -> &freerange_assets::mesh::Map {
    match &material.texture {
        Texture::Image(map) => map,
        other => panic!("no picture but {other:?}"),
    }
}

#[test]
fn pictures_of_three_formats_are_decoded() {
    for format in [ImageFormat::Png, ImageFormat::Jpeg, ImageFormat::WebP] {
        let mut glb = Glb::textured(base(), &small_picture(format));
        if format == ImageFormat::WebP {
            glb.json["textures"] = json!([{"extensions": {"EXT_texture_webp": {"source": 0}}}]);
            glb.json["extensionsRequired"] = json!(["EXT_texture_webp"]);
        }
        let material = material(&glb);
        let picture = &map(&material).picture;
        assert_eq!((picture.width(), picture.height(), picture.is_srgb()), (4, 2, true), "{format:?}");
        let [r, g, _, a] = picture.pixels()[0];
        let corner = picture.pixels()[7];
        assert!(corner[1] > 200 && corner[0] < 60, "{format:?}: green at the lower right, not {corner:?}");
        if format != ImageFormat::Jpeg {
            assert_eq!((r, g, a), (255, 0, 128), "{format:?}: red at the upper left");
        }
    }
}

#[test]
fn factors_alpha_and_wrap() {
    let mut source = base();
    source["pbrMetallicRoughness"]["baseColorFactor"] = json!([0.5, 0.25, 1, 0.75]);
    source["pbrMetallicRoughness"]["metallicFactor"] = json!(0.3);
    source["pbrMetallicRoughness"]["roughnessFactor"] = json!(0.6);
    source["pbrMetallicRoughness"]["metallicRoughnessTexture"] = json!({"index": 0});
    source["normalTexture"] = json!({"index": 0, "scale": 0.5});
    source["emissiveFactor"] = json!([0, 0.5, 1]);
    source["emissiveTexture"] = json!({"index": 0});
    source["extensions"] = json!({"KHR_materials_emissive_strength": {"emissiveStrength": 4}});
    source["alphaMode"] = json!("MASK");
    let mut glb = Glb::textured(source, &png());
    glb.json["samplers"] = json!([{"wrapS": 33071, "wrapT": 33648}]);
    glb.json["textures"][0]["sampler"] = json!(0);
    let m = material(&glb);
    assert_eq!(m.factor, Vec4::new(0.5, 0.25, 1.0, 0.75));
    assert_eq!(m.alpha, AlphaMode::Mask { cutoff: 0.5 });
    assert_eq!((m.metallic, m.roughness, m.unlit), (0.3, 0.6, false));
    assert_eq!(m.emission, Vec3::new(0.0, 2.0, 4.0));
    assert_eq!(map(&m).wrap, [Wrap::Clamp, Wrap::Mirror]);
    assert!(m.emission_map.as_ref().unwrap().picture.is_srgb());
    // Data, not colors, though it is the same image.
    assert!(!m.metallic_roughness.as_ref().unwrap().picture.is_srgb());
    let (normal, scale) = m.normal_map.as_ref().unwrap();
    assert!(!normal.picture.is_srgb() && *scale == 0.5);
    assert!(std::sync::Arc::ptr_eq(&map(&m).picture, &m.emission_map.as_ref().unwrap().picture), "decoded once");

    glb.json["materials"][0]["alphaMode"] = json!("BLEND");
    glb.json["materials"][0]["extensions"] = json!({"KHR_materials_unlit": {}});
    let m = material(&glb);
    assert_eq!((m.alpha, m.unlit, m.emission), (AlphaMode::Blend, true, Vec3::new(0.0, 0.5, 1.0)));
}

#[test]
fn the_picture_lies_with_v_running_down() {
    let glb = Glb::textured(base(), &png());
    let loaded = glb.load();
    // (0, 0) is the upper left; the first vertex has it.
    assert_eq!(loaded.mesh.uvs[0], Vec2::ZERO);
    let color = map(&loaded.mesh.materials[0]).sample(Vec2::new(0.125, 0.25), 0.0);
    assert!(color.distance(Vec4::new(1.0, 0.0, 0.0, srgb_free(128))) < 1e-3, "{color}");
    let color = map(&loaded.mesh.materials[0]).sample(Vec2::new(0.875, 0.75), 0.0);
    assert!(color.distance(Vec4::new(0.0, 1.0, 0.0, 1.0)) < 1e-3, "{color}");
    assert!(srgb_to_linear(1.0) == 1.0);
}

/// Alpha is linear as it is stored.
fn srgb_free(byte: u8) -> f32 {
    f32::from(byte) / 255.0
}

#[test]
fn texture_transforms_scale_then_turn_then_move() {
    let mut source = base();
    let transform = json!({"offset": [0.1, 0.2], "rotation": std::f32::consts::FRAC_PI_2, "scale": [2, 3]});
    source["pbrMetallicRoughness"]["baseColorTexture"]["extensions"] = json!({"KHR_texture_transform": transform});
    source["normalTexture"] = json!({"index": 0, "extensions": {"KHR_texture_transform": transform}});
    let glb = Glb::textured(source, &png());
    let m = material(&glb);
    for t in [map(&m).transform, m.normal_map.as_ref().unwrap().0.transform] {
        // Counter-clockwise as seen, v running down: right (1, 0) turns to up (0, -1), down (0, 1) to right (1, 0).
        assert!(t.transform_point2(Vec2::ZERO).distance(Vec2::new(0.1, 0.2)) < 1e-6);
        assert!(t.transform_point2(Vec2::X).distance(Vec2::new(0.1, -1.8)) < 1e-6);
        assert!(t.transform_point2(Vec2::Y).distance(Vec2::new(3.1, 0.2)) < 1e-6);
    }
}

#[test]
fn a_vertex_carries_the_coordinates_of_its_base_color() {
    let mut source = base();
    source["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] = json!(1);
    source["emissiveTexture"] = json!({"index": 0});
    let mut glb = Glb::textured(source, &png());
    assert!(glb.load().notes.iter().any(|n| n.contains("without TEXCOORD_1")));
    glb.attribute("TEXCOORD_1", "VEC2", &[0.5, 0.0, 0.5, 0.25, 0.5, 1.0]);
    let loaded = glb.load();
    assert_eq!(loaded.mesh.uvs, [Vec2::new(0.5, 0.0), Vec2::new(0.5, 0.25), Vec2::new(0.5, 1.0)]);
    assert!(loaded.mesh.materials[0].emission_map.is_none());
    assert!(loaded.notes.iter().any(|n| n.contains("emission map is ignored")), "{:?}", loaded.notes);
    // The transform's own texCoord goes before the reference's.
    let transform = json!({"KHR_texture_transform": {"texCoord": 1}});
    glb.json["materials"][0]["emissiveTexture"]["extensions"] = transform;
    assert!(glb.load().mesh.materials[0].emission_map.is_some());
}

#[test]
fn specular_glossiness_becomes_metallic_roughness() {
    let old = json!({"diffuseFactor": [0.5, 0.5, 0.5, 1], "diffuseTexture": {"index": 0}, "glossinessFactor": 0.75});
    let glb = Glb::textured(json!({"extensions": {"KHR_materials_pbrSpecularGlossiness": old}}), &png());
    let m = material(&glb);
    assert_eq!((m.metallic, m.roughness, m.factor.x), (0.0, 0.25, 0.5));
    assert_eq!(map(&m).picture.width(), 4);
}

#[test]
fn several_materials_and_primitives() {
    let mut glb = Glb::textured(base(), &png());
    glb.json["materials"] = json!([base(), {"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}}, base()]);
    let mut second = glb.json["meshes"][0]["primitives"][0].clone();
    second["material"] = json!(1);
    glb.json["meshes"][0]["primitives"].as_array_mut().unwrap().push(second);
    glb.json["nodes"] = json!([{"mesh": 0}, {"mesh": 0, "translation": [0, 0, 1]}]);
    let mesh = glb.load().mesh;
    assert_eq!(mesh.triangle_materials, [0, 1, 0, 1]);
    assert_eq!(mesh.materials.len(), 2, "unused ones are not made");
    assert_eq!(mesh.materials[1].factor, Vec4::new(1.0, 0.0, 0.0, 1.0));
}
