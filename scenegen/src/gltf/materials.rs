//! Reads glTF materials, textures and samplers.

use std::collections::HashMap;
use std::path::Path;

use glam::{Vec3, Vec4};
use gltf::json;
use json::material::AlphaMode as JsonAlpha;
use json::texture::{MagFilter, MinFilter, WrappingMode};
use json::validation::Checked;

use super::accessors::Buffers;
use super::fault;
use crate::error::Error;
use crate::mesh::{AlphaMode, Material, Model, Reflection};
use crate::resource::{check_texels, data_uri, decode};
use crate::texture::{Sampler, TextureRef, Wrap};

/// Materials and images read so far.
#[derive(Default)]
pub(super) struct Materials {
    /// Number in the model by number in the file; None is glTF's default material.
    numbers: HashMap<Option<usize>, u32>,
    /// Texture in the model by image and whether it is sRGB.
    images: HashMap<(usize, bool), u32>,
}

/// A reference to a texture, from wherever in the JSON.
struct Use<'j> {
    texture: usize,
    uv_set: u32,
    transform: Option<&'j json::extensions::texture::TextureTransform>,
}

impl Materials {
    /// The model's number of a material, which is read at its first use.
    pub(super) fn number(
        &mut self,
        path: &Path,
        root: &json::Root,
        buffers: &mut Buffers<'_>,
        model: &mut Model,
        index: Option<usize>,
    ) -> Result<u32, Error> {
        if let Some(&number) = self.numbers.get(&index) {
            return Ok(number);
        }
        let default = json::Material::default();
        let source = match index {
            None => &default,
            Some(index) => root.materials.get(index).ok_or_else(|| {
                fault(path, format!("material {index}"), "there is no such material")
            })?,
        };
        let name = index.map_or_else(|| "default material".to_owned(), |i| format!("material {i}"));
        let mut texture = |used: Option<Use<'_>>, srgb| match used {
            Some(used) => self.texture(path, root, buffers, model, &name, &used, srgb),
            None => Ok(None),
        };
        let pbr = &source.pbr_metallic_roughness;
        let base_texture = texture(pbr.base_color_texture.as_ref().map(of_info), true)?;
        let metal_rough_texture =
            texture(pbr.metallic_roughness_texture.as_ref().map(of_info), false)?;
        let emissive_texture = texture(source.emissive_texture.as_ref().map(of_info), true)?;
        let normal = source.normal_texture.as_ref();
        // The crate has no type for this extension of normal textures.
        let normal_transform: Option<json::extensions::texture::TextureTransform> = normal
            .and_then(|t| t.extensions.as_ref()?.others.get("KHR_texture_transform"))
            .and_then(|value| serde_json::from_value(value.clone()).ok());
        let normal_texture = texture(
            normal.map(|t| Use {
                texture: t.index.value(),
                uv_set: t.tex_coord,
                transform: normal_transform.as_ref(),
            }),
            false,
        )?;
        let extensions = source.extensions.as_ref();
        let strength = extensions
            .and_then(|e| e.emissive_strength.as_ref())
            .map_or(1.0, |e| e.emissive_strength.0);
        let (metallic, roughness) = (pbr.metallic_factor.0, pbr.roughness_factor.0);
        let unlit = extensions.is_some_and(|e| e.unlit.is_some());
        // A fully rough dielectric has 4 % of nearly even reflectance: counted as diffuse.
        let diffuse = metallic == 0.0 && roughness >= 1.0 && metal_rough_texture.is_none();
        let emissive = Vec3::from(source.emissive_factor.0) * strength;
        let base = Vec4::from(pbr.base_color_factor.0);
        let sane = |v: f32| if v.is_finite() { v.clamp(0.0, 1e6) } else { 0.0 };
        let material = Material {
            name: source.name.clone().unwrap_or(name),
            reflection: match (unlit, diffuse) {
                (true, _) => Reflection::Unlit,
                (_, true) => Reflection::Lambert,
                _ => Reflection::MetalRough,
            },
            base: Vec4::from(base.to_array().map(sane)),
            metallic: sane(metallic).min(1.0),
            roughness: sane(roughness).min(1.0),
            emissive: Vec3::from(emissive.to_array().map(sane)),
            base_texture,
            alpha_texture: None,
            roughness_texture: metal_rough_texture,
            metallic_texture: metal_rough_texture,
            normal_texture,
            normal_scale: normal.map_or(1.0, |t| t.scale),
            emissive_texture,
            alpha: match source.alpha_mode {
                Checked::Valid(JsonAlpha::Opaque) => AlphaMode::Opaque,
                Checked::Valid(JsonAlpha::Mask) => {
                    AlphaMode::Mask(source.alpha_cutoff.map_or(0.5, |cutoff| cutoff.0))
                }
                Checked::Valid(JsonAlpha::Blend) => AlphaMode::Blend,
                Checked::Invalid => {
                    return Err(fault(
                        path,
                        format!("material {index:?}"),
                        "its alphaMode is unknown",
                    ));
                }
            },
            double_sided: source.double_sided,
            thin: false,
            is_light: false,
        };
        let number = model.material(material);
        self.numbers.insert(index, number);
        Ok(number)
    }

    #[expect(clippy::too_many_arguments, reason = "the parts of the reader that a texture needs")]
    fn texture(
        &mut self,
        path: &Path,
        root: &json::Root,
        buffers: &mut Buffers<'_>,
        model: &mut Model,
        material: &str,
        used: &Use<'_>,
        srgb: bool,
    ) -> Result<Option<TextureRef>, Error> {
        let name = format!("{material}, texture {}", used.texture);
        let Some(texture) = root.textures.get(used.texture) else {
            return Err(fault(path, name, "there is no such texture"));
        };
        let uv_set = used.transform.and_then(|t| t.tex_coord).unwrap_or(used.uv_set);
        // The crate's mark of an absent source: another extension brings the image.
        if texture.source.value() == u32::MAX as usize || uv_set > 1 {
            model.notes.push(format!(
                "{name} has no plain image, or a third set of coordinates, and is left out"
            ));
            return Ok(None);
        }
        let image = texture.source.value();
        let number = match self.images.get(&(image, srgb)) {
            Some(&number) => number,
            None => {
                let decoded = read_image(path, root, buffers, image, srgb)?;
                check_texels(path, &name, &model.textures, &decoded)?;
                model.textures.push(decoded);
                let number = model.textures.len() as u32 - 1;
                self.images.insert((image, srgb), number);
                number
            }
        };
        let sampler = match texture.sampler {
            None => Sampler::default(),
            Some(index) => match root.samplers.get(index.value()) {
                Some(sampler) => sampler_of(sampler),
                None => {
                    return Err(fault(
                        path,
                        name,
                        format!("there is no sampler {}", index.value()),
                    ));
                }
            },
        };
        let mut found = TextureRef { uv_set: uv_set as usize, sampler, ..TextureRef::new(number) };
        if let Some(t) = used.transform {
            let ([x, y], [sx, sy], angle) = (t.offset.0, t.scale.0, t.rotation.0);
            // Counter-clockwise in an image whose v points down.
            let (sin, cos) = angle.sin_cos();
            found.transform = [[sx * cos, sy * sin, x], [-sx * sin, sy * cos, y]];
        }
        Ok(Some(found))
    }
}

fn of_info(info: &json::texture::Info) -> Use<'_> {
    Use {
        texture: info.index.value(),
        uv_set: info.tex_coord,
        transform: info.extensions.as_ref().and_then(|e| e.texture_transform.as_ref()),
    }
}

fn read_image(
    path: &Path,
    root: &json::Root,
    buffers: &mut Buffers<'_>,
    index: usize,
    srgb: bool,
) -> Result<crate::texture::Texture, Error> {
    let name = format!("image {index}");
    let Some(image) = root.images.get(index) else {
        return Err(fault(path, name, "there is no such image"));
    };
    match (&image.uri, image.buffer_view) {
        (Some(uri), _) if uri.starts_with("data:") => match data_uri(uri) {
            Some(bytes) => decode(path, &name, &bytes, srgb),
            None => Err(fault(path, name, "its data URI is no base64")),
        },
        (Some(uri), _) => {
            let bytes = buffers.folder().read_uri(&name, uri)?;
            decode(path, &name, &bytes, srgb)
        }
        (None, Some(view)) => decode(path, &name, buffers.view(view.value(), &name)?, srgb),
        (None, None) => Err(fault(path, name, "it has neither a URI nor a buffer view")),
    }
}

fn sampler_of(sampler: &json::texture::Sampler) -> Sampler {
    let wrap = |mode| match mode {
        Checked::Valid(WrappingMode::ClampToEdge) => Wrap::Clamp,
        Checked::Valid(WrappingMode::MirroredRepeat) => Wrap::Mirror,
        Checked::Valid(WrappingMode::Repeat) | Checked::Invalid => Wrap::Repeat,
    };
    let no_mipmaps =
        matches!(sampler.min_filter, Some(Checked::Valid(MinFilter::Nearest | MinFilter::Linear)));
    Sampler {
        wrap_u: wrap(sampler.wrap_s),
        wrap_v: wrap(sampler.wrap_t),
        nearest: matches!(sampler.mag_filter, Some(Checked::Valid(MagFilter::Nearest))),
        mipmaps: !no_mipmaps,
    }
}
