//! MTL: the materials of OBJ files.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use glam::{Affine2, Vec2, Vec3, Vec4};
use image::RgbaImage;

use super::job::Job;
use super::obj_text::{split, statements};
use super::picture::decode;
use crate::mesh::error::MeshError;
use crate::mesh::material::{AlphaMode, Material};
use crate::mesh::picture::{Map, Picture, Wrap};
use crate::mesh::texture::Texture;

/// A material library: its text, with the statements that matter and are well formed, and the folder its textures are
/// relative to.
pub struct Library {
    pub text: String,
    folder: String,
}

/// Pictures by file name and whether they are colors; `None` for those that are missing.
pub type Pictures = HashMap<(String, bool), Option<Arc<Picture>>>;

/// Reads a library; `None` if there is no such file in the mesh's folder.
pub fn read_library(job: &mut Job, name: &str) -> Result<Option<Library>, MeshError> {
    let portable = portable(name);
    let Some(bytes) = read_optional(job, &portable)? else { return Ok(None) };
    let text = clean(job, &String::from_utf8_lossy(&bytes))?;
    let folder = portable.rsplit_once('/').map_or(String::new(), |(folder, _)| format!("{folder}/"));
    Ok(Some(Library { text, folder }))
}

/// `tobj` wants three numbers for every color and stops at the first statement it cannot parse; the format allows one
/// number, and writers are careless.
fn clean(job: &mut Job, text: &str) -> Result<String, MeshError> {
    let mut clean = String::with_capacity(text.len());
    let mut materials = 0;
    for statement in statements(text) {
        let (key, rest) = split(&statement);
        let numbers: Vec<f32> = rest.split_whitespace().map_while(|w| w.parse().ok()).collect();
        let ok = match key {
            "newmtl" => {
                materials += 1;
                !rest.is_empty()
            }
            "Ka" | "Kd" | "Ks" | "Ke" => {
                if let [gray] = numbers[..] {
                    clean.push_str(&format!("{key} {gray} {gray} {gray}\n"));
                    continue;
                }
                numbers.len() >= 3
            }
            "Ns" | "Ni" | "d" => !numbers.is_empty(),
            "illum" => rest.split_whitespace().next().is_some_and(|w| w.parse::<u8>().is_ok()),
            _ => !rest.is_empty() && !key.starts_with('#'),
        };
        if ok {
            clean.push_str(&statement);
            clean.push('\n');
        } else if !key.is_empty() && !key.starts_with('#') {
            job.note(format!("MTL statement {statement:?} is ignored"));
        }
    }
    if materials > 65536 {
        return Err(job.error("MTL newmtl", "at most 65536 materials", materials));
    }
    Ok(clean)
}

/// Gray plastic, for faces without a material.
pub fn default_material() -> Material {
    Material { specular: 0.04, roughness: 0.5, ..Material::matt(Texture::Flat(Vec3::splat(0.8))) }
}

/// A material of the mesh from one of a library. `map_Kd` stands in the place of `Kd`, as most writers mean it; colors
/// are linear. The exponent `Ns` becomes the roughness of equal width, and `Ks` of one half the reflectance 0.04.
pub fn convert(
    job: &mut Job,
    source: &tobj::Material,
    libraries: &BTreeMap<&str, Library>,
    pictures: &mut Pictures,
) -> Result<Material, MeshError> {
    let name = &source.name;
    let numbers = source.diffuse.into_iter().chain(source.specular).chain(source.emissive).flatten();
    if numbers.chain(source.shininess).chain(source.dissolve).any(|x| !x.is_finite()) {
        return Err(job.error(format!("material {name:?}"), "finite numbers", "an infinite one"));
    }
    let extra = |key: &str| source.unknown_param.get(key);
    let number = |key: &str| extra(key)?.split_whitespace().next()?.parse::<f32>().ok().filter(|x| x.is_finite());
    let mut load = |job: &mut Job, text: Option<&String>, srgb: bool| match text {
        None => Ok(None),
        Some(text) => map(job, text, srgb, libraries, pictures),
    };
    let base = load(job, source.diffuse_texture.as_ref(), true)?;
    let normal_map = match extra("norm") {
        Some(text) => load(job, Some(text), false)?,
        None => match load(job, source.normal_texture.as_ref(), false)? {
            Some(map) if !looks_like_normals(&map.picture) => {
                job.note(format!("material {name:?}: the bump map is ignored: it holds heights, not normals"));
                None
            }
            other => other,
        },
    };
    let emission_map = load(job, extra("map_Ke"), true)?;
    if source.dissolve_texture.is_some() && source.dissolve_texture != source.diffuse_texture {
        job.note(format!("material {name:?}: map_d is ignored, as it is not the alpha of map_Kd"));
    }

    let mut dissolve = source.dissolve.or_else(|| number("Tr").map(|t| 1.0 - t)).unwrap_or(1.0).clamp(0.0, 1.0);
    if dissolve == 0.0 {
        job.note(format!("material {name:?}: invisible by its d or Tr, taken as opaque"));
        dissolve = 1.0;
    }
    let alpha_of_map = source.dissolve_texture.is_some() && source.dissolve_texture == source.diffuse_texture;
    let blend = dissolve < 1.0 || alpha_of_map && base.as_ref().is_some_and(|b| b.picture.has_alpha());
    let diffuse = source.diffuse.map_or(Vec3::splat(0.8), Vec3::from);
    let roughness = match (number("Pr"), source.shininess) {
        (Some(roughness), _) => roughness,
        // Blinn-Phong's exponent n and a roughness r have lobes of equal width at n = 2 / r^4 - 2.
        (None, Some(exponent)) => (2.0 / (exponent.max(0.0) + 2.0)).powf(0.25),
        (None, None) => 0.5,
    };
    let specular =
        source.specular.map_or(0.04, |ks| 0.08 * Vec3::from(ks).clamp(Vec3::ZERO, Vec3::ONE).element_sum() / 3.0);
    let emission = source.emissive.map_or(if emission_map.is_some() { Vec3::ONE } else { Vec3::ZERO }, Vec3::from);
    let textured = base.is_some();
    Ok(Material {
        factor: if textured { Vec4::ONE } else { diffuse.clamp(Vec3::ZERO, Vec3::ONE).extend(1.0) }
            * Vec4::new(1.0, 1.0, 1.0, dissolve),
        alpha: if blend { AlphaMode::Blend } else { AlphaMode::Opaque },
        specular,
        roughness: roughness.clamp(0.0, 1.0),
        metallic: number("Pm").unwrap_or(0.0).clamp(0.0, 1.0),
        normal_map: normal_map.map(|m| (m, 1.0)),
        emission: emission.max(Vec3::ZERO),
        emission_map,
        ..Material::matt(base.map_or(Texture::Flat(Vec3::ONE), Texture::Image))
    })
}

/// A texture statement: options, then a file name that may contain spaces.
fn map(
    job: &mut Job,
    text: &str,
    srgb: bool,
    libraries: &BTreeMap<&str, Library>,
    pictures: &mut Pictures,
) -> Result<Option<Map>, MeshError> {
    let (name, transform, wrap) = options(text);
    let name = portable(name);
    let key = (name.clone(), srgb);
    let picture = match pictures.get(&key) {
        Some(known) => known.clone(),
        None => {
            let read = read_texture(job, &name, libraries)?;
            if read.is_none() {
                job.note(format!("texture {name:?} is missing"));
            }
            let picture = read.map(|image| Arc::new(Picture::new(image, srgb)));
            pictures.insert(key, picture.clone());
            picture
        }
    };
    Ok(picture.map(|picture| Map { picture, transform, wrap: [wrap; 2] }))
}

/// Looks in the folders of the libraries, then for the bare name beside the mesh: names are often absolute paths of the
/// writer's own computer.
fn read_texture(
    job: &mut Job,
    name: &str,
    libraries: &BTreeMap<&str, Library>,
) -> Result<Option<RgbaImage>, MeshError> {
    let bare = name.rsplit('/').next().unwrap_or(name).to_owned();
    let mut places: Vec<String> = libraries.values().map(|l| format!("{}{name}", l.folder)).collect();
    places.push(bare);
    places.dedup();
    for place in places {
        if let Some(bytes) = read_optional(job, &place)? {
            return Ok(Some(decode(job, &format!("texture {name:?}"), &bytes)?));
        }
    }
    Ok(None)
}

/// Reads a file of the mesh's folder; `None` if it is not there or the name leads elsewhere.
fn read_optional(job: &mut Job, name: &str) -> Result<Option<Vec<u8>>, MeshError> {
    let Ok(path) = job.resolve("file name", name) else { return Ok(None) };
    match job.read_file(&path) {
        Ok(bytes) => Ok(Some(bytes)),
        Err(MeshError::Io(_)) => Ok(None),
        Err(e) => Err(e),
    }
}

fn portable(name: &str) -> String {
    name.trim().trim_matches('"').replace('\\', "/")
}

/// Splits `-s 2 2 1 -clamp on file.png` into the file name, the transform of (u, v running down), and the wrap mode.
fn options(text: &str) -> (&str, Affine2, Wrap) {
    let (mut scale, mut offset, mut wrap) = (Vec2::ONE, Vec2::ZERO, Wrap::Repeat);
    let mut rest = text.trim();
    while rest.starts_with('-') {
        let (flag, after) = split(rest);
        // Some options take up to three numbers, the others one word.
        let most = match flag {
            "-s" | "-o" | "-t" => 3,
            "-mm" => 2,
            _ => 1,
        };
        let mut values = Vec::new();
        rest = after;
        for i in 0..most {
            let (word, after) = split(rest);
            let number = word.parse::<f32>().ok().filter(|x| x.is_finite());
            if after.is_empty() || most == 3 && i > 0 && number.is_none() {
                break;
            }
            values.push(number.unwrap_or(0.0));
            if flag == "-clamp" && word == "on" {
                wrap = Wrap::Clamp;
            }
            rest = after;
        }
        let uv = |default: f32| {
            Vec2::new(values.first().copied().unwrap_or(default), values.get(1).copied().unwrap_or(default))
        };
        match flag {
            "-s" => scale = uv(1.0),
            "-o" => offset = uv(0.0),
            _ => {}
        }
        if after.is_empty() {
            break;
        }
    }
    // With v up, the picture's coordinates are scale * uv + offset; ours are (u, 1 - v).
    let transform = Affine2::from_scale_angle_translation(scale, 0.0, Vec2::new(offset.x, 1.0 - scale.y - offset.y));
    (rest, transform, wrap)
}

/// Tells normals from heights: nearly all pixels are unit vectors that point outwards, and blue prevails.
fn looks_like_normals(picture: &Picture) -> bool {
    let pixels = picture.pixels();
    let unit = |p: &&[u8; 4]| {
        let n = Vec3::new(p[0].into(), p[1].into(), p[2].into()) / 127.5 - 1.0;
        n.z > 0.0 && (n.length() - 1.0).abs() < 0.2 && n.x.abs().max(n.y.abs()) < n.z + 0.5
    };
    let mean = |k: usize| pixels.iter().map(|p| f64::from(p[k])).sum::<f64>() / pixels.len().max(1) as f64;
    pixels.iter().filter(unit).count() * 10 > pixels.len() * 9 && mean(2) > mean(0) + 40.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texture_options_are_split_off() {
        let (name, transform, wrap) = options("-s 2 3 1 -o 0.25 0.5 -bm 0.3 -clamp on my photo.png");
        assert_eq!((name, wrap), ("my photo.png", Wrap::Clamp));
        // With v up: (0.1, 0.2) goes to (0.45, 1.1); v down of it is -0.1.
        let uv = transform.transform_point2(Vec2::new(0.1, 0.8));
        assert!(uv.distance(Vec2::new(0.45, -0.1)) < 1e-6, "{uv}");
        assert_eq!(options("a.png").0, "a.png");
        assert_eq!(options("-s 2 a.png").0, "a.png");
        assert_eq!(options("-bm").0, "");
    }

    #[test]
    fn normals_are_told_from_heights() {
        let normals = RgbaImage::from_fn(8, 8, |x, _| image::Rgba([100 + 8 * x as u8, 128, 250, 255]));
        assert!(looks_like_normals(&Picture::new(normals, false)));
        for gray in [0, 128, 200, 255] {
            let heights = RgbaImage::from_pixel(8, 8, image::Rgba([gray, gray, gray, 255]));
            assert!(!looks_like_normals(&Picture::new(heights, false)), "{gray}");
        }
    }

    #[test]
    fn careless_statements_are_mended_or_noted() {
        let limits = crate::mesh::load::LoadLimits::default();
        let mut job = Job::new(std::path::Path::new("test"), None, &limits);
        let text = clean(&mut job, "newmtl a\nKd 0.5\nKs x\nNs\nmap_Kd\nd 0.5\n# Kd").unwrap();
        assert_eq!(text, "newmtl a\nKd 0.5 0.5 0.5\nd 0.5\n");
        assert_eq!(job.notes.len(), 3);
        assert!(tobj::load_mtl_buf(&mut text.as_bytes()).is_ok());
    }
}
