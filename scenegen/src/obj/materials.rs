//! Reads MTL material libraries with their textures.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use glam::{Vec2, Vec3};
use image::RgbaImage;

use super::statements::{self, Statement, split_word};
use crate::error::Error;
use crate::mesh::{AlphaMode, Material, Model, Reflection};
use crate::resource::{self, Folder, shortened};
use crate::texture::{Texture, TextureRef, Wrap};

/// Linear base colour of materials without a colour, and of faces without a material.
pub(super) const GREY: f32 = 0.6;

/// The keys of the maps that are read.
const MAPS: [&str; 6] = ["map_kd", "map_d", "map_ke", "norm", "map_pr", "map_pm"];
/// Base and gain of a map without the option `-mm`.
const WHOLE_RANGE: [f32; 2] = [0.0, 1.0];

/// A material's statements (line, key as written, text) by key in lower case, as programs differ in case. Of several
/// statements with the same key, the last counts.
type Entries = HashMap<String, (usize, String, String)>;

/// The materials of all libraries of an OBJ file.
pub(super) struct Materials {
    folder: Folder,
    /// The model's indices of materials by name; `None` for those already noted as missing.
    indices: HashMap<String, Option<u32>>,
    /// The model's indices of textures, by file, colour space (true for sRGB), and base and gain (as bits).
    textures: HashMap<(PathBuf, bool, [u32; 2]), u32>,
    /// The model's indices of materials with neither colour nor texture, which show vertex colours if there are any.
    pub(super) uncoloured: HashSet<u32>,
    /// The model that materials, textures and notes are added to.
    pub(super) model: Model,
}

impl Materials {
    pub(super) fn new(obj: &Path) -> Result<Self, Error> {
        let (indices, textures) = (HashMap::new(), HashMap::new());
        let (uncoloured, model) = (HashSet::new(), Model::default());
        Ok(Self { folder: Folder::containing(obj)?, indices, textures, uncoloured, model })
    }

    /// The model's index of a material. An undefined material is noted once.
    pub(super) fn index_of(&mut self, name: &str) -> Option<u32> {
        if let Some(&index) = self.indices.get(name) {
            return index;
        }
        self.indices.insert(name.to_owned(), None);
        let name = shortened(name);
        self.model.notes.push(format!("material {name} is not defined; it is replaced by grey"));
        None
    }

    /// Reads the libraries named by a `mtllib` statement. Missing ones are noted.
    pub(super) fn read_libraries(&mut self, s: Statement<'_>) -> Result<(), Error> {
        let element = format!("line {}: mtllib", s.line);
        // The statement may be one name with spaces, or several names.
        let names: Vec<&str> = match self.resolve(&element, s.text) {
            Ok(path) if path.is_file() => vec![s.text],
            _ => s.words().collect(),
        };
        for name in names {
            let path = self.resolve(&element, name)?;
            if path.is_file() {
                self.read(&path)?;
            } else {
                let name = shortened(name);
                self.model.notes.push(format!("{name} is missing; its materials are grey"));
            }
        }
        Ok(())
    }

    /// The path of a file. Quotes around its name, which Metashape writes, are removed if no file has the quoted name.
    fn resolve(&self, element: &str, name: &str) -> Result<PathBuf, Error> {
        let name = with_slashes(name);
        let path = self.folder.resolve(element, &name)?;
        match name.strip_prefix('"').and_then(|name| name.strip_suffix('"')) {
            Some(plain) if !plain.is_empty() && !path.is_file() => {
                self.folder.resolve(element, plain)
            }
            _ => Ok(path),
        }
    }

    /// Reads a library.
    fn read(&mut self, path: &Path) -> Result<(), Error> {
        let mut material: Option<(String, Entries)> = None;
        // MeshLab writes the opacity as `Tr`.
        let mut tr_is_opacity = false;
        statements::for_each(path, |statement| {
            let key = statement.key.to_ascii_lowercase();
            if key == "newmtl" {
                let name = statement.value().to_owned();
                if name.is_empty() {
                    return Err(statement.fault("newmtl has no name"));
                }
                if let Some((name, entries)) = material.replace((name, Entries::default())) {
                    self.add(path, &name, &entries, tr_is_opacity)?;
                }
            } else if key.starts_with('#') {
                tr_is_opacity |= statement.text.to_ascii_lowercase().contains("meshlab");
            } else if let Some((_, entries)) = &mut material {
                let Statement { line, key: written, text, .. } = statement;
                entries.insert(key, (line, written.to_owned(), text.to_owned()));
            }
            Ok(())
        })?;
        material.map_or(Ok(()), |(name, entries)| self.add(path, &name, &entries, tr_is_opacity))
    }

    fn add(
        &mut self,
        path: &Path,
        name: &str,
        entries: &Entries,
        tr_is_opacity: bool,
    ) -> Result<(), Error> {
        let statement = |key: &str| {
            let (line, key, text) = entries.get(key)?;
            Some(Statement { path, line: *line, key, text })
        };
        // Spectral and XYZ colours are ignored.
        let colour = |key| {
            let statement = statement(key).filter(|s| !s.text.starts_with(['s', 'x']));
            statement.map(|s| numbers(s, 3)).transpose()
        };
        let share = |key| -> Result<Option<Vec3>, Error> {
            let value = statement(key).map(|s| numbers(s, 1)).transpose()?;
            Ok(value.map(|value| value.min(Vec3::ONE)))
        };
        let map = |key| statement(key).and_then(Map::read);
        let mut texture =
            |map: Option<&Map>, srgb| map.map(|map| self.texture(path, map, srgb)).transpose();
        let (base_map, alpha_map) = (map("map_kd"), map("map_d"));
        // An image that is the map of both colour and opacity holds the opacity in its alpha channel.
        let maps = alpha_map.as_ref().zip(base_map.as_ref());
        let shares_alpha = maps.is_some_and(|(alpha, base)| alpha.file == base.file);
        let base_texture = texture(base_map.as_ref(), true)?;
        let alpha_texture = texture(alpha_map.as_ref().filter(|_| !shares_alpha), false)?;
        let emissive_texture = texture(map("map_ke").as_ref(), true)?;
        let normal_texture = texture(map("norm").as_ref(), false)?;
        let roughness_texture = texture(map("map_pr").as_ref(), false)?;
        let metallic_texture = texture(map("map_pm").as_ref(), false)?;
        let kd = colour("kd")?;
        let mut opacity = share("d")?;
        if let (None, Some(Vec3 { x: tr, .. })) = (opacity, share("tr")?) {
            let shown = if tr_is_opacity { tr } else { 1.0 - tr };
            if shown == 0.0 {
                let name = shortened(name);
                self.model.notes.push(format!(
                    "material {name} is shown: Tr {tr} means invisible, but some programs write it for opaque \
                     materials; write `d 0` to hide the material"
                ));
            }
            opacity = Some(Vec3::splat(if shown == 0.0 { 1.0 } else { shown }));
        }
        let opacity = factor(opacity, alpha_map.is_some(), 1.0).x;
        let is_shiny =
            ["pr", "pm", "map_pr", "map_pm"].iter().any(|&key| entries.contains_key(key));
        let is_transparent = opacity < 1.0 || alpha_map.is_some();
        let number = self.model.material(Material {
            name: name.to_owned(),
            reflection: if is_shiny { Reflection::MetalRough } else { Reflection::Lambert },
            base: factor(kd, base_texture.is_some(), GREY).extend(opacity),
            metallic: factor(share("pm")?, metallic_texture.is_some(), 0.0).x,
            roughness: factor(share("pr")?, roughness_texture.is_some(), 1.0).x,
            emissive: factor(colour("ke")?, emissive_texture.is_some(), 0.0),
            base_texture,
            alpha_texture,
            roughness_texture,
            metallic_texture,
            normal_texture,
            emissive_texture,
            alpha: if is_transparent { AlphaMode::Blend } else { AlphaMode::Opaque },
            ..Material::default()
        });
        if base_texture.is_none() && kd.is_none_or(|kd| kd == Vec3::ZERO) {
            self.uncoloured.insert(number);
        }
        let name_shown = shortened(name);
        if map("bump").or(map("map_bump")).is_some() {
            self.model.notes.push(format!(
                "material {name_shown}: bump maps are not supported; store a normal map (norm) instead"
            ));
        }
        for key in MAPS {
            let Some(map) = map(key) else { continue };
            if map.is_turbulent {
                self.model.notes.push(format!(
                    "material {name_shown}: the turbulence -t of {key} is not supported and ignored"
                ));
            }
            if key == "map_d" && shares_alpha && map.range != WHOLE_RANGE {
                self.model.notes.push(format!(
                    "material {name_shown}: -mm of {key} is ignored, as the map is an alpha channel"
                ));
            }
        }
        self.indices.insert(name.to_owned(), Some(number));
        Ok(())
    }

    fn texture(&mut self, path: &Path, map: &Map, srgb: bool) -> Result<TextureRef, Error> {
        let library = path.file_name().unwrap_or_default().to_string_lossy();
        let element = format!("{library} line {}: texture", map.line);
        let file = self.resolve(&element, &map.file)?;
        let key = (file.clone(), srgb, map.range.map(f32::to_bits));
        let number = match self.textures.get(&key) {
            Some(&number) => number,
            None => {
                let bytes = self.folder.read(&element, &file)?;
                let mut image = resource::decode_image(&file, &element, &bytes)?;
                map.change_range(&mut image);
                let texture = Texture::new(image.width(), image.height(), image.into_raw(), srgb);
                let number = resource::add_texture(path, &element, &mut self.model, texture)?;
                self.textures.insert(key, number);
                number
            }
        };
        let mut usage = TextureRef::new(number);
        if map.clamp {
            usage.sampler.wrap_u = Wrap::Clamp;
            usage.sampler.wrap_v = Wrap::Clamp;
        }
        // Scale and offset assume that v points up.
        let (s, o) = (map.scale, map.offset);
        usage.transform = [[s.x, 0.0, o.x], [0.0, s.y, 1.0 - s.y - o.y]];
        Ok(usage)
    }
}

/// The factor of a map or, without a map, the value itself. Beside a map, exporters write 0 or nothing; both mean 1.
fn factor(given: Option<Vec3>, has_map: bool, default: f32) -> Vec3 {
    match given {
        Some(value) if !has_map || value != Vec3::ZERO => value,
        None if !has_map => Vec3::splat(default),
        _ => Vec3::ONE,
    }
}

/// The first numbers of a statement, at most `max_count`; a single number is used for all three components.
fn numbers(statement: Statement<'_>, max_count: usize) -> Result<Vec3, Error> {
    let fault = |problem: &str| statement.fault(format!("{} {problem}", statement.key));
    let number = |word: &str| match word.parse::<f32>() {
        Ok(value) if value.is_finite() => Ok(value.max(0.0)),
        _ => Err(fault("is not a finite number")),
    };
    // The option `-halo` of `d -halo 0.5` is ignored.
    let words = statement.words().filter(|word| *word != "-halo").take(max_count);
    match words.map(number).collect::<Result<Vec<_>, _>>()?[..] {
        [r, g, b] => Ok(Vec3::new(r, g, b)),
        [grey] => Ok(Vec3::splat(grey)),
        [] => Err(fault("has no value")),
        _ => Err(fault("needs three numbers")),
    }
}

/// A texture statement.
pub(super) struct Map {
    pub(super) line: usize,
    pub(super) file: String,
    pub(super) scale: Vec2,
    pub(super) offset: Vec2,
    pub(super) clamp: bool,
    /// Base and gain: a value v of the image, from 0 to 1, becomes base + gain·v.
    pub(super) range: [f32; 2],
    /// True if the coordinates are to be distorted by noise.
    pub(super) is_turbulent: bool,
}

impl Map {
    /// Parses options, and a file name that may contain spaces; `None` if there is no name.
    pub(super) fn read(statement: Statement<'_>) -> Option<Self> {
        let Statement { line, text: mut rest, .. } = statement;
        let mut map = Self {
            line,
            file: String::new(),
            scale: Vec2::ONE,
            offset: Vec2::ZERO,
            clamp: false,
            range: WHOLE_RANGE,
            is_turbulent: false,
        };
        while rest.starts_with('-') {
            let (option, mut after) = split_word(rest);
            // Some options take up to three numbers, of which the later ones are optional.
            let max_count = match option {
                "-o" | "-s" | "-t" => 3,
                "-mm" => 2,
                _ => 1,
            };
            let mut values = Vec::new();
            while values.len() < max_count {
                let (word, behind) = split_word(after);
                let number = word.parse::<f32>().ok().filter(|v| v.is_finite());
                if max_count > 1 && number.is_none() {
                    break;
                }
                if option == "-clamp" {
                    map.clamp = word == "on";
                }
                values.push(number.unwrap_or(0.0));
                after = behind;
            }
            let pair = |default: f32| {
                let at = |i: usize| values.get(i).copied().unwrap_or(default);
                Vec2::new(at(0), at(1))
            };
            match option {
                "-o" => map.offset = pair(0.0),
                "-s" => map.scale = pair(1.0),
                "-t" => map.is_turbulent = values.iter().any(|value| *value != 0.0),
                "-mm" => {
                    let at = |i: usize| values.get(i).copied().unwrap_or(WHOLE_RANGE[i]);
                    map.range = [0, 1].map(at);
                }
                _ => {}
            }
            rest = after;
        }
        map.file = with_slashes(rest);
        (!map.file.is_empty()).then_some(map)
    }

    /// Applies base and gain to the values as they are stored; the alpha channel keeps its values.
    fn change_range(&self, image: &mut RgbaImage) {
        if self.range == WHOLE_RANGE {
            return;
        }
        let [base, gain] = self.range;
        // A conversion to u8 clamps.
        let changed = |value: u8| (255.0 * base + gain * f32::from(value) + 0.5) as u8;
        let table: [u8; 256] = std::array::from_fn(|value| changed(value as u8));
        for image::Rgba([r, g, b, _]) in image.pixels_mut() {
            [r, g, b].into_iter().for_each(|value| *value = table[usize::from(*value)]);
        }
    }
}

/// Replaces the backslashes in names from other systems.
fn with_slashes(name: &str) -> String {
    name.replace('\\', "/")
}
