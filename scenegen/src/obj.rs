//! Wavefront OBJ with MTL.
//!
//! Read here rather than by the `tobj` crate, which panics on short colours (`Kd 1 1`), refuses `v` with
//! weight and colour, and triangulates concave polygons as fans. Faces are seen from both sides;
//! materials are diffuse unless they bring the PBR keys `Pr`, `Pm`, `map_Pr` or `map_Pm`. `norm` is a
//! tangent-space normal map as in glTF; height maps (`bump`, `map_bump`) are left out with a note.
//!
//! A corner without normal is flat, or smooth within its smoothing group (`s 1`): the mean of the
//! normals of the group's faces there, weighted by their angles (Thürmer and Wüthrich, "Computing
//! Vertex Normals from Polygonal Facets", 1998).
//!
//! One piece: geometry and materials share the reader and its faults.

use std::collections::HashMap;
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};

use glam::{DVec2, DVec3, Vec2, Vec3, Vec4};

use crate::error::Error;
use crate::lines::{Lines, fault};
use crate::mesh::{AlphaMode, Material, Model, Reflection};
use crate::resource::{self, Folder};
use crate::texture::{Texture, TextureRef, Wrap};

/// Most triangles of a file.
const MAX_TRIANGLES: usize = 1 << 26;
/// Corners up to which a polygon is cut ear by ear, which takes the cube of their number.
const MAX_EARS: usize = 256;

/// A vertex, texture coordinate or normal of the file, by its number there: the first is 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct Index(NonZeroU32);

impl Index {
    fn of<T: Copy>(self, list: &[T]) -> T {
        list[self.place()]
    }

    fn place(self) -> usize {
        self.0.get() as usize - 1
    }
}

/// A face's corner: what it names. There is one for each vertex of the model, so it is small.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct Corner {
    position: Index,
    uv: Option<Index>,
    normal: Option<Index>,
    /// Smoothing group, where the corner has no normal and one is to be found.
    group: Option<NonZeroU32>,
}

struct Reader<'a> {
    path: &'a Path,
    folder: Folder,
    positions: Vec<DVec3>,
    colours: Vec<Vec3>,
    uvs: Vec<Vec2>,
    normals: Vec<Vec3>,
    vertices: HashMap<Corner, u32>,
    materials: HashMap<String, u32>,
    textures: HashMap<(PathBuf, bool), u32>,
    current: Option<u32>,
    /// Smoothing group of the faces to come.
    group: Option<NonZeroU32>,
    /// Sums of face normals by angle, by position and group.
    smooth: HashMap<(Index, NonZeroU32), DVec3>,
    model: Model,
}

/// Loads a file with its materials.
pub(crate) fn load(path: &Path) -> Result<Model, Error> {
    let mut lines = Lines::open(path)?;
    let mut reader = Reader {
        path,
        folder: Folder::of(path)?,
        positions: Vec::new(),
        colours: Vec::new(),
        uvs: Vec::new(),
        normals: Vec::new(),
        vertices: HashMap::new(),
        materials: HashMap::new(),
        textures: HashMap::new(),
        current: None,
        group: None,
        smooth: HashMap::new(),
        model: Model::default(),
    };
    reader.model.name =
        path.file_stem().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    while let Some((number, line)) = lines.next()? {
        reader.line(&line, number)?;
    }
    if reader.model.triangles.is_empty() {
        return Err(Error::Empty { name: path.display().to_string() });
    }
    reader.close_groups();
    Ok(reader.model)
}

impl Reader<'_> {
    fn fault(&self, line: usize, problem: impl Into<String>) -> Error {
        fault(self.path, line, problem)
    }

    fn line(&mut self, line: &str, number: usize) -> Result<(), Error> {
        let line = line.trim_start();
        let (key, rest) = line.split_once(char::is_whitespace).unwrap_or((line, ""));
        match key {
            "v" => {
                let v = self.numbers(rest, number)?;
                let &[x, y, z, ..] = &v[..] else {
                    return Err(self.fault(number, "a vertex needs x, y and z"));
                };
                let position = DVec3::new(x, y, z);
                if !position.is_finite() {
                    let vertex = self.positions.len() + 1;
                    return Err(self.fault(number, format!("vertex {vertex} is not finite")));
                }
                // x y z r g b, or x y z w r g b.
                if v.len() == 6 || v.len() == 7 {
                    self.colours.resize(self.positions.len(), Vec3::ONE);
                    let c = &v[v.len() - 3..];
                    let colour = Vec3::new(c[0] as f32, c[1] as f32, c[2] as f32);
                    self.colours.push(if colour.is_finite() {
                        colour.max(Vec3::ZERO)
                    } else {
                        Vec3::ONE
                    });
                }
                self.positions.push(position);
            }
            "vt" => {
                let v = self.numbers(rest, number)?;
                let u = v.first().copied().unwrap_or(0.0) as f32;
                // OBJ's v points up.
                let v = 1.0 - v.get(1).copied().unwrap_or(0.0) as f32;
                self.uvs.push(Vec2::new(u, v));
            }
            "vn" => {
                let v = self.numbers(rest, number)?;
                let &[x, y, z, ..] = &v[..] else {
                    return Err(self.fault(number, "a normal needs x, y and z"));
                };
                let normal = DVec3::new(x, y, z).normalize_or_zero().as_vec3();
                self.normals.push(if normal.is_finite() { normal } else { Vec3::ZERO });
            }
            "f" => self.face(rest, number)?,
            "s" => {
                let word = without_comment(rest).trim();
                self.group = match word {
                    "off" | "" => None,
                    "on" => Some(NonZeroU32::MIN),
                    _ => match word.parse() {
                        Ok(group) => NonZeroU32::new(group),
                        Err(_) => {
                            let word: String = word.chars().take(40).collect();
                            let problem = format!("{word:?} is no smoothing group");
                            return Err(self.fault(number, problem));
                        }
                    },
                };
            }
            "usemtl" => {
                let name = without_comment(rest).trim();
                self.current = self.materials.get(name).copied();
                if self.current.is_none() && !self.model.notes.iter().any(|n| n.contains(name)) {
                    let name: String = name.chars().take(80).collect();
                    self.model
                        .notes
                        .push(format!("there is no material {name}; a grey one stands in"));
                }
            }
            "mtllib" => self.library(rest, number)?,
            // Lines, points, groups, curves: nothing to trace.
            _ => {}
        }
        Ok(())
    }

    fn numbers(&self, text: &str, number: usize) -> Result<Vec<f64>, Error> {
        let parse = |word: &str| {
            word.parse::<f64>().map_err(|_| {
                let word: String = word.chars().take(40).collect();
                self.fault(number, format!("{word:?} is no number"))
            })
        };
        without_comment(text).split_whitespace().take(8).map(parse).collect()
    }

    fn face(&mut self, rest: &str, number: usize) -> Result<(), Error> {
        let words = without_comment(rest).split_whitespace();
        let corners = words.map(|word| self.corner(word, number)).collect::<Result<Vec<_>, _>>()?;
        // Points and lines written as faces.
        if corners.len() < 3 {
            return Ok(());
        }
        let vertices: Vec<u32> = corners.iter().map(|&corner| self.vertex(corner)).collect();
        let places: Vec<DVec3> = corners.iter().map(|c| c.position.of(&self.positions)).collect();
        let material = match self.current {
            Some(material) => material,
            None => self.stand_in(),
        };
        let triangles = triangulated(&places);
        if self.model.triangles.len() + triangles.len() > MAX_TRIANGLES {
            return Err(self.fault(number, "the file has more than 2^26 triangles"));
        }
        for triangle in triangles {
            self.smoothen(triangle.map(|i| corners[i]));
            self.model.triangles.push(triangle.map(|i| vertices[i]));
            self.model.triangle_materials.push(material);
        }
        Ok(())
    }

    fn stand_in(&mut self) -> u32 {
        if let Some(&number) = self.materials.get("") {
            return number;
        }
        let number = self.model.material(Material::lambert("none", [0.6; 3]));
        self.materials.insert(String::new(), number);
        number
    }

    fn corner(&self, word: &str, number: usize) -> Result<Corner, Error> {
        let mut parts = word.split('/');
        let mut index = |count: usize, what: &str| {
            let text = parts.next().unwrap_or("");
            if text.is_empty() {
                return Ok(None);
            }
            let text: String = text.chars().take(40).collect();
            let value: i64 = text
                .parse()
                .map_err(|_| self.fault(number, format!("{text:?} is no {what} index")))?;
            // Negative ones count back from the last.
            let found = if value > 0 { value } else { count as i64 + 1 + value };
            let valid = value != 0 && (1..=count as i64).contains(&found);
            let found = u32::try_from(found).ok().filter(|_| valid).and_then(NonZeroU32::new);
            let problem = || self.fault(number, format!("{what} index {value} of {count}"));
            found.map(|found| Some(Index(found))).ok_or_else(problem)
        };
        let position = index(self.positions.len(), "vertex")?;
        let uv = index(self.uvs.len(), "texture")?;
        let normal = index(self.normals.len(), "normal")?;
        let position =
            position.ok_or_else(|| self.fault(number, "a corner has no vertex index"))?;
        let group = self.group.filter(|_| normal.is_none());
        Ok(Corner { position, uv, normal, group })
    }

    /// Adds a triangle's normal to those of its corners' groups.
    fn smoothen(&mut self, corners: [Corner; 3]) {
        let place = corners.map(|corner| corner.position.of(&self.positions));
        for i in 0..3 {
            let Some(group) = corners[i].group else { continue };
            let (u, v) = (place[(i + 1) % 3] - place[i], place[(i + 2) % 3] - place[i]);
            // Nothing for triangles without area: their normal is none.
            let angle = u.cross(v).length().atan2(u.dot(v));
            let sum = self.smooth.entry((corners[i].position, group)).or_default();
            *sum += angle * u.cross(v).normalize_or_zero();
        }
    }

    /// Gives the corners of smoothing groups their normals.
    fn close_groups(&mut self) {
        if self.smooth.is_empty() {
            return;
        }
        let normals = &mut self.model.normals;
        normals.resize(self.model.positions.len(), Vec3::ZERO);
        for (corner, &vertex) in &self.vertices {
            if let Some(sum) = corner.group.and_then(|g| self.smooth.get(&(corner.position, g))) {
                normals[vertex as usize] = sum.normalize_or_zero().as_vec3();
            }
        }
    }

    fn vertex(&mut self, corner: Corner) -> u32 {
        let model = &mut self.model;
        *self.vertices.entry(corner).or_insert_with(|| {
            let first = model.positions.len();
            model.positions.push(corner.position.of(&self.positions));
            let colour = self.colours.get(corner.position.place()).map(|c| c.extend(1.0));
            let colour = colour.or((!self.colours.is_empty()).then_some(Vec4::ONE));
            push(&mut model.colours, first, colour, Vec4::ONE);
            push(&mut model.uvs[0], first, corner.uv.map(|i| i.of(&self.uvs)), Vec2::ZERO);
            let normal = corner.normal.map(|i| i.of(&self.normals));
            push(&mut model.normals, first, normal, Vec3::ZERO);
            first as u32
        })
    }

    /// Reads a material library. A missing one is noted.
    fn library(&mut self, rest: &str, number: usize) -> Result<(), Error> {
        let whole = rest.trim();
        let element = format!("line {number}: mtllib");
        // One name with spaces, or several names.
        let one = self.folder.resolve(&element, &slashed(whole)).ok().filter(|path| path.is_file());
        let names: Vec<&str> = match one {
            Some(_) => vec![whole],
            None => without_comment(whole).split_whitespace().collect(),
        };
        for name in names {
            let path = self.folder.resolve(&element, &slashed(name))?;
            if path.is_file() {
                self.read_materials(&path)?;
            } else {
                let name: String = name.chars().take(80).collect();
                self.model.notes.push(format!("there is no {name}; its materials are grey"));
            }
        }
        Ok(())
    }

    fn read_materials(&mut self, path: &Path) -> Result<(), Error> {
        let mut lines = Lines::open(path)?;
        let mut open: Option<(Material, Maps)> = None;
        while let Some((number, line)) = lines.next()? {
            let line = line.trim_start();
            let (key, rest) = line.split_once(char::is_whitespace).unwrap_or((line, ""));
            if key == "newmtl" {
                self.close_material(path, open.take())?;
                let name = without_comment(rest).trim();
                open = Some((Material::lambert(name, [0.6; 3]), Maps::default()));
            } else if let Some((material, maps)) = &mut open {
                maps.line(material, key, rest, (path, number))?;
            }
        }
        self.close_material(path, open)
    }

    fn close_material(&mut self, path: &Path, open: Option<(Material, Maps)>) -> Result<(), Error> {
        let Some((mut material, maps)) = open else {
            return Ok(());
        };
        material.base_texture = self.map(path, maps.base.as_ref(), true)?;
        material.emissive_texture = self.map(path, maps.emissive.as_ref(), true)?;
        material.alpha_texture = self.map(path, maps.alpha.as_ref(), false)?;
        material.normal_texture = self.map(path, maps.normal.as_ref(), false)?;
        if material.base.w < 1.0 || material.alpha_texture.is_some() {
            material.alpha = AlphaMode::Blend;
        }
        material.roughness_texture = self.map(path, maps.roughness.as_ref(), false)?;
        material.metallic_texture = self.map(path, maps.metallic.as_ref(), false)?;
        // A map without a number beside it says everything.
        if maps.metallic.is_some() && !maps.has_metallic {
            material.metallic = 1.0;
        }
        if maps.has_height {
            let name: String = material.name.chars().take(80).collect();
            self.model.notes.push(format!(
                "material {name}: bump maps are not rendered; a normal map (norm) would be"
            ));
        }
        let name = material.name.clone();
        let number = self.model.material(material);
        self.materials.insert(name, number);
        Ok(())
    }

    fn map(
        &mut self,
        path: &Path,
        map: Option<&Map>,
        srgb: bool,
    ) -> Result<Option<TextureRef>, Error> {
        let Some(map) = map else {
            return Ok(None);
        };
        let library = path.file_name().unwrap_or_default().to_string_lossy();
        let element = format!("{library} line {}: texture", map.line);
        let file = self.folder.resolve(&element, &map.file)?;
        let key = (file.clone(), srgb);
        let number = match self.textures.get(&key) {
            Some(&number) => number,
            None => {
                let bytes = self.folder.read(&element, &file)?;
                let texture: Texture = resource::decode(&file, &element, &bytes, srgb)?;
                let model = &mut self.model;
                resource::check_texels(path, &element, &model.textures, &texture)?;
                model.textures.push(texture);
                let number = model.textures.len() as u32 - 1;
                self.textures.insert(key, number);
                number
            }
        };
        let mut found = TextureRef::new(number);
        if map.clamp {
            found.sampler.wrap_u = Wrap::Clamp;
            found.sampler.wrap_v = Wrap::Clamp;
        }
        // Scale and offset are meant with v pointing up.
        let (s, o) = (map.scale, map.offset);
        found.transform = [[s.x, 0.0, o.x], [0.0, s.y, 1.0 - s.y - o.y]];
        Ok(Some(found))
    }
}

/// A texture statement.
struct Map {
    file: String,
    line: usize,
    scale: Vec2,
    offset: Vec2,
    clamp: bool,
}

/// The textures of a material.
#[derive(Default)]
struct Maps {
    base: Option<Map>,
    emissive: Option<Map>,
    alpha: Option<Map>,
    normal: Option<Map>,
    roughness: Option<Map>,
    metallic: Option<Map>,
    /// Whether `Pm` was there.
    has_metallic: bool,
    /// Whether there is a height map.
    has_height: bool,
}

impl Maps {
    /// A statement of a material library; unknown ones are skipped.
    fn line(
        &mut self,
        material: &mut Material,
        key: &str,
        rest: &str,
        (path, line): (&Path, usize),
    ) -> Result<(), Error> {
        let numbers = || -> Result<Vec<f32>, Error> {
            let words = without_comment(rest).split_whitespace();
            let parse = |word: &str| match word.parse::<f32>() {
                Ok(value) if value.is_finite() => Ok(value),
                _ => Err(fault(path, line, format!("{key} is no finite number"))),
            };
            words.take(3).map(parse).collect()
        };
        let one = || -> Result<f32, Error> {
            numbers()?
                .first()
                .copied()
                .ok_or_else(|| fault(path, line, format!("{key} has no value")))
        };
        // A colour of one number is grey.
        let colour = || -> Result<Vec3, Error> {
            match numbers()?[..] {
                [r, g, b] => Ok(Vec3::new(r, g, b).max(Vec3::ZERO)),
                [grey] => Ok(Vec3::splat(grey.max(0.0))),
                _ => Err(fault(path, line, format!("{key} needs three numbers"))),
            }
        };
        let is_spectral = matches!(rest.split_whitespace().next(), Some("spectral" | "xyz"));
        match key {
            "Kd" if !is_spectral => material.base = colour()?.extend(material.base.w),
            "Ke" if !is_spectral => material.emissive = colour()?,
            // `d -halo 0.5` begins with a word; the halo is left out.
            "d" => material.base.w = halo(rest).map_or_else(one, Ok)?.clamp(0.0, 1.0),
            "Tr" => material.base.w = (1.0 - one()?).clamp(0.0, 1.0),
            "Pr" => {
                material.reflection = Reflection::MetalRough;
                material.roughness = one()?.clamp(0.0, 1.0);
            }
            "Pm" => {
                material.reflection = Reflection::MetalRough;
                material.metallic = one()?.clamp(0.0, 1.0);
                self.has_metallic = true;
            }
            "map_Kd" => self.base = Map::read(rest, line),
            "map_Ke" => self.emissive = Map::read(rest, line),
            "map_d" => self.alpha = Map::read(rest, line),
            "norm" => self.normal = Map::read(rest, line),
            "map_Pr" => {
                material.reflection = Reflection::MetalRough;
                self.roughness = Map::read(rest, line);
            }
            "map_Pm" => {
                material.reflection = Reflection::MetalRough;
                self.metallic = Map::read(rest, line);
            }
            "bump" | "map_bump" | "map_Bump" => self.has_height = true,
            _ => {}
        }
        Ok(())
    }
}

fn halo(rest: &str) -> Option<f32> {
    rest.trim().strip_prefix("-halo")?.trim().parse().ok()
}

impl Map {
    /// Options, then a file name that may hold spaces; None without a name.
    fn read(rest: &str, line: usize) -> Option<Self> {
        let mut map =
            Self { file: String::new(), line, scale: Vec2::ONE, offset: Vec2::ZERO, clamp: false };
        let mut rest = rest.trim();
        while rest.starts_with('-') {
            let (option, mut after) = cut(rest);
            // Up to three numbers for some; the second and third may be left out.
            let most = match option {
                "-o" | "-s" | "-t" => 3,
                "-mm" => 2,
                _ => 1,
            };
            let mut values = Vec::new();
            while values.len() < most {
                let (word, behind) = cut(after);
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
        map.file = slashed(rest);
        (!map.file.is_empty()).then_some(map)
    }
}

/// The first word and what follows it.
fn cut(text: &str) -> (&str, &str) {
    let (word, rest) = text.split_once(char::is_whitespace).unwrap_or((text, ""));
    (word, rest.trim_start())
}

fn without_comment(text: &str) -> &str {
    text.split('#').next().unwrap_or(text)
}

/// Names from other systems use backslashes.
fn slashed(name: &str) -> String {
    name.replace('\\', "/")
}

/// Appends a value to a list that stays empty until a vertex has one.
fn push<T: Copy>(list: &mut Vec<T>, before: usize, value: Option<T>, missing: T) {
    if value.is_some() || !list.is_empty() {
        list.resize(before, missing);
        list.push(value.unwrap_or(missing));
    }
}

/// A polygon as triangles: ears are cut off until a triangle is left.
fn triangulated(corners: &[DVec3]) -> Vec<[usize; 3]> {
    let fan =
        |left: &[usize]| left.windows(2).skip(1).map(|t| [left[0], t[0], t[1]]).collect::<Vec<_>>();
    let mut left: Vec<usize> = (0..corners.len()).collect();
    if left.len() <= 3 || left.len() > MAX_EARS {
        return fan(&left);
    }
    // Newell's normal: the plane that fits a polygon that is not quite flat.
    let next = |i: usize| corners[(i + 1) % corners.len()];
    let sum = |i: usize| (corners[i] - corners[0]).cross(next(i) - corners[0]);
    let normal = (0..corners.len()).map(sum).sum::<DVec3>().normalize_or_zero();
    if normal == DVec3::ZERO {
        return fan(&left);
    }
    let (x, y) = normal.any_orthonormal_pair();
    // The pair may be left-handed about the normal.
    let hand = x.cross(y).dot(normal).signum();
    let flat: Vec<DVec2> = corners.iter().map(|p| DVec2::new(p.dot(x), hand * p.dot(y))).collect();
    let area = |a: usize, b: usize, c: usize| (flat[b] - flat[a]).perp_dot(flat[c] - flat[a]);
    let mut triangles = Vec::with_capacity(corners.len() - 2);
    while left.len() > 3 {
        let count = left.len();
        let ear = (0..count).find(|&i| {
            let (a, b, c) = (left[(i + count - 1) % count], left[i], left[(i + 1) % count]);
            let inside =
                |&p: &usize| area(a, b, p) >= 0.0 && area(b, c, p) >= 0.0 && area(c, a, p) >= 0.0;
            area(a, b, c) > 0.0 && !left.iter().filter(|p| ![a, b, c].contains(p)).any(inside)
        });
        // A polygon that crosses itself has no ear; what is left becomes a fan.
        let Some(i) = ear else {
            break;
        };
        triangles.push([left[(i + count - 1) % count], left[i], left[(i + 1) % count]]);
        left.remove(i);
    }
    triangles.extend(fan(&left));
    triangles
}

#[cfg(test)]
#[allow(clippy::float_cmp, reason = "exact values")]
mod tests {
    use std::io::Cursor;

    use super::*;

    fn area(corners: &[DVec3], triangles: &[[usize; 3]]) -> (f64, f64) {
        let cross = |t: &[usize; 3]| {
            let [a, b, c] = t.map(|i| corners[i]);
            (b - a).cross(c - a) * 0.5
        };
        let sum: DVec3 = triangles.iter().map(cross).sum();
        (sum.length(), triangles.iter().map(|t| cross(t).length()).sum())
    }

    #[test]
    fn concave_polygons_keep_their_area() {
        // An L of area 3, in any order of turning and any plane.
        let l = [(0., 0.), (2., 0.), (2., 1.), (1., 1.), (1., 2.), (0., 2.)];
        for turn in 0..6 {
            for reversed in [false, true] {
                let mut corners: Vec<DVec3> = (0..6)
                    .map(|i| l[(i + turn) % 6])
                    .map(|(x, y)| DVec3::new(x, y, 0.5 * x + y))
                    .collect();
                if reversed {
                    corners.reverse();
                }
                let triangles = triangulated(&corners);
                let (signed, total) = area(&corners, &triangles);
                let expected = 3.0 * DVec3::new(0.5, 1.0, -1.0).length();
                assert_eq!(triangles.len(), 4);
                assert!((signed - expected).abs() < 1e-12, "{signed}");
                assert!((total - expected).abs() < 1e-12, "{total}");
            }
        }
    }

    /// Loads an OBJ file with files beside it.
    fn loaded(obj: &str, files: &[(&str, &[u8])]) -> Result<Model, Error> {
        let folder = tempfile::tempdir().expect("folder");
        for (name, bytes) in files {
            std::fs::write(folder.path().join(name), bytes).expect("write");
        }
        let path = folder.path().join("test.obj");
        std::fs::write(&path, obj).expect("write");
        load(&path)
    }

    /// Two squares that meet at a right angle, along the y axis.
    const ROOF: &str = "v 0 0 0\nv 0 1 0\nv 1 0 0\nv 1 1 0\nv 0 0 -1\nv 0 1 -1\n";

    #[test]
    fn smoothing_groups_share_normals_and_no_group_is_flat() {
        let normals = |text: &str| {
            let model = loaded(&format!("{ROOF}{text}"), &[]).expect("a roof");
            let at = |i: u32| model.normals.get(i as usize).copied().unwrap_or_default();
            // By triangle and corner: position and normal.
            let corners = model.triangles.iter().flatten();
            corners.map(|&i| (model.positions[i as usize], at(i))).collect::<Vec<_>>()
        };
        let (z, x) = (Vec3::Z, Vec3::NEG_X);
        let edge = (z + x).normalize();
        for (text, at_edge, beside) in [
            ("s 1\nf 1 3 4 2\nf 5 1 2 6\n", [edge, edge], [z, x]),
            ("s 1\nf 1 3 4 2\ns 2\nf 5 1 2 6\n", [z, x], [z, x]),
            ("f 1 3 4 2\nf 5 1 2 6\n", [Vec3::ZERO; 2], [Vec3::ZERO; 2]),
            ("s 1\ns off\nf 1 3 4 2\ns 0\nf 5 1 2 6\n", [Vec3::ZERO; 2], [Vec3::ZERO; 2]),
            // A normal of its own comes before the group's.
            (
                "vn 0 1 0\ns 1\nf 1//1 3//1 4//1 2//1\ns off\nf 5 1 2 6\n",
                [Vec3::Y, Vec3::ZERO],
                [Vec3::Y, Vec3::ZERO],
            ),
        ] {
            for (i, (position, normal)) in normals(text).into_iter().enumerate() {
                let face = i / 6;
                let is_edge = position.x == 0.0 && position.z == 0.0;
                let expected = if is_edge { at_edge[face] } else { beside[face] };
                assert!(normal.distance(expected) < 1e-6, "{text}: {position} has {normal}");
            }
        }
        let error = loaded(&format!("{ROOF}s five\nf 1 2 3\n"), &[]).expect_err("no group");
        assert!(error.to_string().contains("line 7") && error.to_string().contains("five"));
    }

    #[test]
    fn maps_of_roughness_and_metalness_are_read() {
        let grey = |value: u8| {
            let mut bytes = Cursor::new(Vec::new());
            let image = image::GrayImage::from_pixel(2, 2, image::Luma([value]));
            image.write_to(&mut bytes, image::ImageFormat::Png).expect("PNG");
            bytes.into_inner()
        };
        let (rough, metal) = (grey(51), grey(204));
        let load = |library: &str| {
            let obj = format!("mtllib a.mtl\n{ROOF}vt 0 0\nusemtl m\nf 1/1 3/1 4/1\n");
            let files: [(&str, &[u8]); 3] =
                [("a.mtl", library.as_bytes()), ("r.png", &rough), ("m.png", &metal)];
            loaded(&obj, &files).expect("a triangle")
        };
        let model = load("newmtl m\nmap_Pr r.png\nmap_Pm m.png\nPr 0.5\nbump r.png\n");
        let material = &model.materials[0];
        assert_eq!(material.reflection, Reflection::MetalRough);
        assert_eq!((material.roughness, material.metallic), (0.5, 1.0));
        let value = |texture: &Option<TextureRef>| {
            let texture = texture.as_ref().expect("a texture");
            let image = &model.textures[texture.texture as usize];
            image.sample(Vec2::splat(0.5), &texture.sampler, 0.0)
        };
        // Where shading looks: green for roughness, blue for metalness.
        assert!((value(&material.roughness_texture).y - 0.2).abs() < 1e-6);
        assert!((value(&material.metallic_texture).z - 0.8).abs() < 1e-6);
        assert!(model.notes.iter().any(|note| note.contains("bump")), "{:?}", model.notes);
        // Without the map of one of them, it is the number's, and no metal by default.
        let model = load("newmtl m\nmap_Pr r.png\n");
        let material = &model.materials[0];
        assert_eq!((material.roughness, material.metallic), (1.0, 0.0));
        assert!(material.metallic_texture.is_none() && model.notes.is_empty());
        let model = load("newmtl m\nPm 0.25\nmap_Pm m.png\n");
        assert_eq!(model.materials[0].metallic, 0.25);
    }

    #[test]
    fn texture_options_are_told_from_the_name() {
        let map = Map::read("-o 0.5 0.25 -s 2 3 1 -clamp on -bm 0.3 my file.png", 1).expect("map");
        assert_eq!(map.file, "my file.png");
        assert_eq!((map.offset, map.scale), (Vec2::new(0.5, 0.25), Vec2::new(2.0, 3.0)));
        assert!(map.clamp);
        assert!(Map::read("-s 1 1 1", 1).is_none());
        assert!(Map::read("", 1).is_none());
    }
}
