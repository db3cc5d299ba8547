//! Reads glTF materials, textures and samplers.

use std::borrow::Cow;

use glam::{Vec3, Vec4};
use gltf::json;
use json::material::AlphaMode as JsonAlpha;
use json::texture::{MagFilter, MinFilter, WrappingMode};
use json::validation::Checked;

use super::Reader;
use crate::error::Error;
use crate::mesh::{AlphaMode, Material, Reflection};
use crate::resource::{self, decode};
use crate::texture::{Sampler, Texture, TextureRef, Wrap};

/// A reference to a texture; glTF has several JSON types for it.
struct TextureUse<'j> {
    texture: usize,
    uv_set: u32,
    transform: Option<&'j json::extensions::texture::TextureTransform>,
}

impl Reader<'_> {
    /// The model's index of a material, which is read at its first use.
    pub(super) fn material(&mut self, index: Option<usize>) -> Result<u32, Error> {
        if let Some(&number) = self.materials.get(&index) {
            return Ok(number);
        }
        let (path, root) = (self.path, self.root);
        let default = json::Material::default();
        let source = match index {
            None => &default,
            Some(index) => root.materials.get(index).ok_or_else(|| {
                self.fault(format!("material {index}"), "there is no such material")
            })?,
        };
        let name = index.map_or_else(|| "default material".to_owned(), |i| format!("material {i}"));
        let mut texture = |used: Option<TextureUse<'_>>, srgb| match used {
            Some(used) => self.texture(&name, &used, srgb),
            None => Ok(None),
        };
        let pbr = &source.pbr_metallic_roughness;
        let base_texture = texture(pbr.base_color_texture.as_ref().map(texture_use), true)?;
        let is_transparent = source.alpha_mode != Checked::Valid(JsonAlpha::Opaque);
        if is_transparent && base_texture.is_none() && pbr.base_color_texture.is_some() {
            let feature = format!("{name}: the texture that defines its transparency");
            let remedy =
                "store it as PNG or JPEG, with one of the first two sets of texture coordinates";
            return Err(Error::unsupported(path, &feature, remedy));
        }
        let metal_rough_texture =
            texture(pbr.metallic_roughness_texture.as_ref().map(texture_use), false)?;
        let emissive_texture = texture(source.emissive_texture.as_ref().map(texture_use), true)?;
        let normal = source.normal_texture.as_ref();
        // The gltf crate has no type for this extension of normal textures.
        let normal_transform: Option<json::extensions::texture::TextureTransform> = normal
            .and_then(|t| t.extensions.as_ref()?.others.get("KHR_texture_transform"))
            .and_then(|value| serde_json::from_value(value.clone()).ok());
        let normal_texture = texture(
            normal.map(|t| TextureUse {
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
        // The specular reflection of a fully rough dielectric is 4 % and nearly uniform, so it is ignored.
        let diffuse = metallic == 0.0 && roughness >= 1.0 && metal_rough_texture.is_none();
        let emissive = Vec3::from(source.emissive_factor.0) * strength;
        let base = Vec4::from(pbr.base_color_factor.0);
        let valid = |v: f32| if v.is_finite() { v.clamp(0.0, 1e6) } else { 0.0 };
        let material = Material {
            name: source.name.clone().unwrap_or_else(|| name.clone()),
            reflection: match (unlit, diffuse) {
                (true, _) => Reflection::Unlit,
                (_, true) => Reflection::Lambert,
                _ => Reflection::MetalRough,
            },
            base: Vec4::from(base.to_array().map(valid)),
            metallic: valid(metallic).min(1.0),
            roughness: valid(roughness).min(1.0),
            emissive: Vec3::from(emissive.to_array().map(valid)),
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
                Checked::Invalid => return Err(self.fault(name, "its alphaMode is unknown")),
            },
            double_sided: source.double_sided,
            thin: false,
            is_light: false,
        };
        let number = self.model.material(material);
        self.materials.insert(index, number);
        Ok(number)
    }

    fn texture(
        &mut self,
        material: &str,
        used: &TextureUse<'_>,
        srgb: bool,
    ) -> Result<Option<TextureRef>, Error> {
        let name = format!("{material}, texture {}", used.texture);
        let Some(texture) = self.root.textures.get(used.texture) else {
            return Err(self.fault(name, "there is no such texture"));
        };
        let uv_set = used.transform.and_then(|t| t.tex_coord).unwrap_or(used.uv_set);
        // The gltf crate reads a missing source as this index; an extension then defines the image.
        let unsupported = if texture.source.value() == u32::MAX as usize {
            Some("its image is defined by an extension")
        } else {
            (uv_set > 1).then_some("it uses a third set of texture coordinates")
        };
        if let Some(reason) = unsupported {
            self.model.notes.push(format!("{name} is ignored: {reason}"));
            return Ok(None);
        }
        let image = texture.source.value();
        let number = match self.images.get(&(image, srgb)) {
            Some(&number) => number,
            None => {
                let decoded = self.image(image, srgb)?;
                let number = resource::add_texture(self.path, &name, &mut self.model, decoded)?;
                self.images.insert((image, srgb), number);
                number
            }
        };
        let sampler = match texture.sampler {
            None => Sampler::default(),
            Some(index) => match self.root.samplers.get(index.value()) {
                Some(sampler) => convert_sampler(sampler),
                None => {
                    let problem = format!("there is no sampler {}", index.value());
                    return Err(self.fault(name, problem));
                }
            },
        };
        let mut usage = TextureRef { uv_set: uv_set as usize, sampler, ..TextureRef::new(number) };
        if let Some(t) = used.transform {
            let ([x, y], [sx, sy], angle) = (t.offset.0, t.scale.0, t.rotation.0);
            // The rotation is counter-clockwise in an image whose v points down.
            let (sin, cos) = angle.sin_cos();
            usage.transform = [[sx * cos, sy * sin, x], [-sx * sin, sy * cos, y]];
        }
        Ok(Some(usage))
    }

    fn image(&mut self, index: usize, srgb: bool) -> Result<Texture, Error> {
        let name = format!("image {index}");
        let Some(image) = self.root.images.get(index) else {
            return Err(self.fault(name, "there is no such image"));
        };
        let bytes = match (&image.uri, image.buffer_view) {
            (Some(uri), _) => Cow::from(self.buffers.uri(&name, uri)?),
            (None, Some(view)) => Cow::from(self.buffers.view(view.value(), &name)?),
            (None, None) => {
                return Err(self.fault(name, "it has neither a URI nor a buffer view"));
            }
        };
        decode(self.path, &name, &bytes, srgb)
    }
}

fn texture_use(info: &json::texture::Info) -> TextureUse<'_> {
    TextureUse {
        texture: info.index.value(),
        uv_set: info.tex_coord,
        transform: info.extensions.as_ref().and_then(|e| e.texture_transform.as_ref()),
    }
}

fn convert_sampler(sampler: &json::texture::Sampler) -> Sampler {
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
