//! Reads MTL material libraries with their textures.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use glam::{Vec2, Vec3};

use super::statements::{self, Statement, shortened, split_word};
use crate::error::Error;
use crate::mesh::{AlphaMode, Material, Model, Reflection};
use crate::resource::{self, Folder};
use crate::texture::{TextureRef, Wrap};

/// Linear base colour of materials without a colour, and of faces without a material.
pub(super) const GREY: [f32; 3] = [0.6; 3];

/// The materials of all libraries of an OBJ file.
pub(super) struct Materials {
    folder: Folder,
    /// The model's indices of materials; `None` for those already noted as missing.
    numbers: HashMap<String, Option<u32>>,
    /// The model's indices of textures, by file and colour space (true for sRGB).
    textures: HashMap<(PathBuf, bool), u32>,
    /// The model that materials, textures and notes are added to.
    pub(super) model: Model,
}

impl Materials {
    pub(super) fn new(obj: &Path) -> Result<Self, Error> {
        let (numbers, textures) = (HashMap::new(), HashMap::new());
        Ok(Self { folder: Folder::around(obj)?, numbers, textures, model: Model::default() })
    }

    /// The model's index of a material. An undefined material is noted once.
    pub(super) fn number(&mut self, name: &str) -> Option<u32> {
        if let Some(&number) = self.numbers.get(name) {
            return number;
        }
        self.numbers.insert(name.to_owned(), None);
        let name = shortened(name);
        self.model.notes.push(format!("material {name} is not defined; it is replaced by grey"));
        None
    }

    /// Reads the libraries named by a `mtllib` statement. Missing ones are noted.
    pub(super) fn read_libraries(&mut self, s: Statement<'_>) -> Result<(), Error> {
        let element = format!("line {}: mtllib", s.line);
        // The statement may be one name with spaces, or several names.
        let names: Vec<&str> = match self.folder.resolve(&element, &with_slashes(s.text)) {
            Ok(path) if path.is_file() => vec![s.text],
            _ => s.words().collect(),
        };
        for name in names {
            let path = self.folder.resolve(&element, &with_slashes(name))?;
            if path.is_file() {
                self.read(&path)?;
            } else {
                let name = shortened(name);
                self.model.notes.push(format!("{name} is missing; its materials are grey"));
            }
        }
        Ok(())
    }

    /// Reads a library. Statements are checked before `tobj` parses them, as it panics if a colour does not have
    /// three numbers (`Kd 1 1`), and its errors do not name the line.
    fn read(&mut self, path: &Path) -> Result<(), Error> {
        let mut text = String::new();
        statements::for_each(path, |statement| {
            text += &checked(statement)?;
            Ok(())
        })?;
        let library = tobj::load_mtl_buf(&mut text.as_bytes()).map_err(|error| {
            let remedy = "correct the file or export it again";
            Error::malformed(path, "the library", error.to_string(), remedy)
        })?;
        library.0.iter().try_for_each(|material| self.add(path, material))
    }

    fn add(&mut self, path: &Path, source: &tobj::Material) -> Result<(), Error> {
        let more = &source.unknown_param;
        let number = |key| more.get(key).and_then(|value: &String| value.parse::<f32>().ok());
        let mut material = Material::lambert(&source.name, GREY);
        if let Some(colour) = source.diffuse {
            material.base = linear(colour).extend(1.0);
        }
        material.emissive = source.emissive.map_or(Vec3::ZERO, linear);
        material.base.w = source.dissolve.unwrap_or(1.0) as f32;
        if ["Pr", "Pm", "map_Pr", "map_Pm"].iter().any(|&key| more.contains_key(key)) {
            material.reflection = Reflection::MetalRough;
        }
        material.roughness = number("Pr").unwrap_or(material.roughness);
        // Without a number, the map itself is the metalness.
        let alone = if more.contains_key("map_Pm") { 1.0 } else { material.metallic };
        material.metallic = number("Pm").unwrap_or(alone);
        let mut texture = |map: Option<&String>, srgb| match map.and_then(|map| Map::read(map)) {
            Some(map) => self.texture(path, &map, srgb).map(Some),
            None => Ok(None),
        };
        material.base_texture = texture(source.diffuse_texture.as_ref(), true)?;
        material.emissive_texture = texture(more.get("map_Ke"), true)?;
        material.alpha_texture = texture(source.dissolve_texture.as_ref(), false)?;
        material.normal_texture = texture(more.get("norm"), false)?;
        material.roughness_texture = texture(more.get("map_Pr"), false)?;
        material.metallic_texture = texture(more.get("map_Pm"), false)?;
        if material.base.w < 1.0 || material.alpha_texture.is_some() {
            material.alpha = AlphaMode::Blend;
        }
        if source.normal_texture.is_some() {
            let name = shortened(&source.name);
            self.model.notes.push(format!(
                "material {name}: bump maps are not supported; store a normal map (norm) instead"
            ));
        }
        let number = self.model.material(material);
        self.numbers.insert(source.name.clone(), Some(number));
        Ok(())
    }

    fn texture(&mut self, path: &Path, map: &Map, srgb: bool) -> Result<TextureRef, Error> {
        let library = path.file_name().unwrap_or_default().to_string_lossy();
        let element = format!("{library} line {}: texture", map.line);
        let file = self.folder.resolve(&element, &map.file)?;
        let key = (file.clone(), srgb);
        let number = match self.textures.get(&key) {
            Some(&number) => number,
            None => {
                let bytes = self.folder.read(&element, &file)?;
                let texture = resource::decode(&file, &element, &bytes, srgb)?;
                let number = resource::add_texture(path, &element, &mut self.model, texture)?;
                self.textures.insert(key, number);
                number
            }
        };
        let mut found = TextureRef::new(number);
        if map.clamp {
            found.sampler.wrap_u = Wrap::Clamp;
            found.sampler.wrap_v = Wrap::Clamp;
        }
        // Scale and offset assume that v points up.
        let (s, o) = (map.scale, map.offset);
        found.transform = [[s.x, 0.0, o.x], [0.0, s.y, 1.0 - s.y - o.y]];
        Ok(found)
    }
}

fn linear(colour: [f64; 3]) -> Vec3 {
    Vec3::from(colour.map(|v| v as f32)).max(Vec3::ZERO)
}

/// Checks a statement and returns the text to pass to `tobj`. Texture statements are prefixed with their line
/// number, for messages.
fn checked(statement: Statement<'_>) -> Result<String, Error> {
    let (key, line) = (statement.key, statement.line);
    let fault = |problem: &str| statement.fault(format!("{key} {problem}"));
    let number = |word: &str| match word.parse::<f32>() {
        Ok(value) if value.is_finite() => Ok(value),
        _ => Err(fault("is not a finite number")),
    };
    // The halo of `d -halo 0.5` is ignored.
    let words = statement.words().filter(|word| *word != "-halo").take(3);
    let share = || -> Result<f32, Error> {
        let word = words.clone().next().ok_or_else(|| fault("has no value"))?;
        Ok(number(word)?.clamp(0.0, 1.0))
    };
    Ok(match key {
        "newmtl" if statement.value().is_empty() => return Err(fault("has no name")),
        "newmtl" => format!("newmtl {}\n", statement.value()),
        // Spectral and XYZ colours are ignored.
        "Kd" | "Ke" if !statement.text.starts_with(['s', 'x']) => {
            let [r, g, b] = match words.clone().map(number).collect::<Result<Vec<_>, _>>()?[..] {
                [r, g, b] => [r, g, b],
                [grey] => [grey; 3],
                _ => return Err(fault("needs three numbers")),
            };
            format!("{key} {r} {g} {b}\n")
        }
        "d" | "Pr" | "Pm" => format!("{key} {}\n", share()?),
        "Tr" => format!("d {}\n", 1.0 - share()?),
        "map_Kd" | "map_Ke" | "map_d" | "norm" | "map_Pr" | "map_Pm" | "bump" | "map_bump"
        | "map_Bump" => format!("{key} {line} {}\n", statement.text),
        _ => String::new(),
    })
}

/// A texture statement.
pub(super) struct Map {
    pub(super) line: usize,
    pub(super) file: String,
    pub(super) scale: Vec2,
    pub(super) offset: Vec2,
    pub(super) clamp: bool,
}

impl Map {
    /// Parses a line number, options, and a file name that may contain spaces; `None` if there is no name.
    pub(super) fn read(statement: &str) -> Option<Self> {
        let (line, mut rest) = split_word(statement);
        let line = line.parse().ok()?;
        let mut map =
            Self { line, file: String::new(), scale: Vec2::ONE, offset: Vec2::ZERO, clamp: false };
        while rest.starts_with('-') {
            let (option, mut after) = split_word(rest);
            // Some options take up to three numbers, of which the later ones are optional.
            let most = match option {
                "-o" | "-s" | "-t" => 3,
                "-mm" => 2,
                _ => 1,
            };
            let mut values = Vec::new();
            while values.len() < most {
                let (word, behind) = split_word(after);
                let number = word.parse::<f32>().ok().filter(|v| v.is_finite());
                if most > 1 && number.is_none() {
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
                _ => {}
            }
            rest = after;
        }
        map.file = with_slashes(rest);
        (!map.file.is_empty()).then_some(map)
    }
}

/// Replaces the backslashes in names from other systems.
fn with_slashes(name: &str) -> String {
    name.replace('\\', "/")
}
