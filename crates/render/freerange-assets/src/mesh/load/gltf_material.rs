//! Materials and textures of glTF.

use std::collections::HashMap;
use std::sync::Arc;

use glam::{Affine2, Vec2, Vec3, Vec4};
use gltf::json::extensions::texture::TextureTransform;
use gltf::json::material::AlphaMode as JsonAlpha;
use gltf::json::texture::WrappingMode;
use gltf::json::validation::Checked;
use gltf::json::{self, Index};

use super::accessor::Document;
use super::job::{Job, Soup};
use super::picture::decode;
use crate::mesh::error::MeshError;
use crate::mesh::material::{AlphaMode, Material};
use crate::mesh::picture::{Map, Picture, Wrap};
use crate::mesh::texture::Texture;

/// A material of the mesh, and the texture coordinates that its pictures need.
#[derive(Clone, Copy)]
pub struct Placed {
    pub index: u16,
    pub uv_set: Option<u32>,
}

/// The materials and pictures made so far; those that no triangle uses are never made.
#[derive(Default)]
pub struct Materials {
    made: HashMap<Option<usize>, Placed>,
    /// By image and whether it is sRGB.
    pictures: HashMap<(usize, bool), Arc<Picture>>,
}

/// A reference to a texture, in the same form for all of a material's maps.
struct Reference {
    texture: usize,
    uv_set: u32,
    transform: Affine2,
}

impl Materials {
    /// The mesh's material for one of the file's, or for glTF's default one.
    pub fn get(
        &mut self,
        job: &mut Job,
        document: &Document,
        index: Option<Index<json::Material>>,
        soup: &mut Soup,
    ) -> Result<Placed, MeshError> {
        let key = index.map(|i| i.value());
        if let Some(&placed) = self.made.get(&key) {
            return Ok(placed);
        }
        let default = json::Material::default();
        let (name, source) = match key {
            None => ("default material".to_owned(), &default),
            Some(i) => {
                let materials = &document.root.materials;
                let expected = || format!("an index below {}", materials.len());
                (
                    format!("materials[{i}]"),
                    materials.get(i).ok_or_else(|| job.error("primitive.material", expected(), i))?,
                )
            }
        };
        let (material, uv_set) = self.make(job, document, &name, source)?;
        let placed = Placed { index: soup.material(job, material)?, uv_set };
        self.made.insert(key, placed);
        Ok(placed)
    }

    fn make(
        &mut self,
        job: &mut Job,
        document: &Document,
        name: &str,
        source: &json::Material,
    ) -> Result<(Material, Option<u32>), MeshError> {
        let extensions = source.extensions.as_ref();
        let pbr = &source.pbr_metallic_roughness;
        let mut factor = pbr.base_color_factor.0;
        let mut base = pbr.base_color_texture.as_ref();
        let mut metallic_roughness = pbr.metallic_roughness_texture.as_ref();
        let (mut metallic, mut roughness) = (pbr.metallic_factor.0, pbr.roughness_factor.0);
        if let Some(old) = extensions.and_then(|e| e.pbr_specular_glossiness.as_ref()) {
            job.note("specular colors of KHR_materials_pbrSpecularGlossiness are ignored");
            factor = old.diffuse_factor.0;
            base = old.diffuse_texture.as_ref();
            metallic_roughness = None;
            (metallic, roughness) = (0.0, 1.0 - old.glossiness_factor.0);
        }
        let base = base.map(reference);
        let metallic_roughness = metallic_roughness.map(reference);
        let normal = match &source.normal_texture {
            Some(info) => Some((normal_reference(job, name, info)?, info.scale)),
            None => None,
        };
        let emissive = source.emissive_texture.as_ref().map(reference);
        let emission = Vec3::from(source.emissive_factor.0)
            * extensions.and_then(|e| e.emissive_strength.as_ref()).map_or(1.0, |s| s.emissive_strength.0);

        // A vertex carries one set: that of the base color, else that of the first map there is.
        let set = |r: &Reference| r.uv_set;
        let uv_set = base
            .as_ref()
            .map(set)
            .or(metallic_roughness.as_ref().map(set))
            .or(normal.as_ref().map(|(r, _)| r.uv_set))
            .or(emissive.as_ref().map(set));
        let mut map = |reference: Option<Reference>, what: &str, srgb: bool| match reference {
            None => Ok(None),
            Some(r) if Some(r.uv_set) != uv_set => {
                job.note(format!("{name}: the {what} map is ignored: it uses another set of texture coordinates"));
                Ok(None)
            }
            Some(r) => self.map(job, document, &format!("{name}: {what} map"), r, srgb),
        };
        let base = map(base, "base color", true)?;
        let metallic_roughness = map(metallic_roughness, "metallic-roughness", false)?;
        let (normal, scale) = normal.map_or((None, 1.0), |(r, scale)| (Some(r), scale));
        let normal_map = map(normal, "normal", false)?.map(|m| (m, scale));
        let emission_map = map(emissive, "emission", true)?;

        let Checked::Valid(alpha) = source.alpha_mode else {
            return Err(job.error(format!("{name}.alphaMode"), "OPAQUE, MASK or BLEND", "another"));
        };
        let unlit = extensions.is_some_and(|e| e.unlit.is_some());
        let finite = [metallic, roughness, scale].into_iter().chain(factor).chain(emission.to_array());
        if finite.into_iter().any(|x| !x.is_finite()) {
            return Err(job.error(name, "finite factors", "an infinite one"));
        }
        let material = Material {
            factor: Vec4::from(factor).clamp(Vec4::ZERO, Vec4::ONE),
            alpha: match alpha {
                JsonAlpha::Opaque => AlphaMode::Opaque,
                JsonAlpha::Mask => AlphaMode::Mask { cutoff: source.alpha_cutoff.map_or(0.5, |c| c.0) },
                JsonAlpha::Blend => AlphaMode::Blend,
            },
            specular: 0.04,
            roughness: roughness.clamp(0.0, 1.0),
            metallic: metallic.clamp(0.0, 1.0),
            metallic_roughness,
            normal_map,
            emission: emission.max(Vec3::ZERO),
            emission_map,
            unlit,
            ..Material::matt(base.map_or(Texture::Flat(Vec3::ONE), Texture::Image))
        };
        Ok((material, uv_set))
    }

    fn map(
        &mut self,
        job: &mut Job,
        document: &Document,
        name: &str,
        reference: Reference,
        srgb: bool,
    ) -> Result<Option<Map>, MeshError> {
        let root = &document.root;
        let Some(texture) = root.textures.get(reference.texture) else {
            return Err(job.error(name, format!("a texture index below {}", root.textures.len()), reference.texture));
        };
        if !reference.transform.is_finite() {
            return Err(job.error(name, "a finite KHR_texture_transform", "an infinite one"));
        }
        let webp = texture
            .extensions
            .as_ref()
            .and_then(|e| e.others.get("EXT_texture_webp")?.get("source")?.as_u64())
            .and_then(|i| usize::try_from(i).ok());
        // The crate's mark of a texture without a source.
        let plain = Some(texture.source.value()).filter(|&i| i != u32::MAX as usize);
        let Some(image) = webp.or(plain) else {
            job.note(format!("{name} is ignored: its texture has no PNG, JPEG or WebP source"));
            return Ok(None);
        };
        let wrap = match texture.sampler {
            None => [Wrap::Repeat; 2],
            Some(i) => {
                let Some(sampler) = root.samplers.get(i.value()) else {
                    return Err(job.error(name, format!("a sampler index below {}", root.samplers.len()), i.value()));
                };
                [wrap(job, name, sampler.wrap_s)?, wrap(job, name, sampler.wrap_t)?]
            }
        };
        let picture = match self.pictures.get(&(image, srgb)) {
            Some(picture) => picture.clone(),
            None => {
                let picture = Arc::new(read_picture(job, document, image, srgb)?);
                self.pictures.insert((image, srgb), picture.clone());
                picture
            }
        };
        Ok(Some(Map { picture, transform: reference.transform, wrap }))
    }
}

fn read_picture(job: &mut Job, document: &Document, index: usize, srgb: bool) -> Result<Picture, MeshError> {
    let name = format!("images[{index}]");
    let Some(image) = document.root.images.get(index) else {
        return Err(job.error(name, format!("an index below {}", document.root.images.len()), index));
    };
    let pixels = match (&image.buffer_view, &image.uri) {
        (Some(view), _) => decode(job, &name, document.view(job, &name, *view)?.0)?,
        (None, Some(uri)) => {
            let bytes = job.read_uri(&format!("{name}.uri"), uri)?;
            decode(job, &name, &bytes)?
        }
        (None, None) => return Err(job.error(name, "a bufferView or a uri", "neither")),
    };
    Ok(Picture::new(pixels, srgb))
}

fn wrap(job: &Job, name: &str, mode: Checked<WrappingMode>) -> Result<Wrap, MeshError> {
    match mode {
        Checked::Valid(WrappingMode::Repeat) => Ok(Wrap::Repeat),
        Checked::Valid(WrappingMode::MirroredRepeat) => Ok(Wrap::Mirror),
        Checked::Valid(WrappingMode::ClampToEdge) => Ok(Wrap::Clamp),
        Checked::Invalid => Err(job.error(name, "a wrapping mode of glTF", "another number")),
    }
}

fn reference(info: &json::texture::Info) -> Reference {
    let transform = info.extensions.as_ref().and_then(|e| e.texture_transform.as_ref());
    with_transform(info.index.value(), info.tex_coord, transform)
}

fn normal_reference(job: &Job, name: &str, info: &json::material::NormalTexture) -> Result<Reference, MeshError> {
    // The crate leaves this extension of normal textures unparsed.
    let transform = match info.extensions.as_ref().and_then(|e| e.others.get("KHR_texture_transform")) {
        None => None,
        Some(value) => Some(
            json::deserialize::from_value::<TextureTransform>(value.clone())
                .map_err(|e| job.error(format!("{name}.normalTexture"), "a KHR_texture_transform", e))?,
        ),
    };
    Ok(with_transform(info.index.value(), info.tex_coord, transform.as_ref()))
}

fn with_transform(texture: usize, uv_set: u32, transform: Option<&TextureTransform>) -> Reference {
    let Some(t) = transform else { return Reference { texture, uv_set, transform: Affine2::IDENTITY } };
    // The rotation is counter-clockwise as one sees it; as v runs down, its angle is negative in (u, v).
    let transform = Affine2::from_scale_angle_translation(Vec2::from(t.scale.0), -t.rotation.0, Vec2::from(t.offset.0));
    Reference { texture, uv_set: t.tex_coord.unwrap_or(uv_set), transform }
}
