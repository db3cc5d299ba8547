//! Loads Wavefront OBJ files. Their MTL libraries are read through `tobj`.
//!
//! Faces are not: `tobj` holds about 100 bytes for each face of an object until the object ends, and
//! its objects share no vertices, so that one of the two takes twice this reader's memory. It also
//! mixes up files in which only some vertices have colours, texture coordinates or normals, and its
//! errors name no line.
//!
//! Faces are visible from both sides. Materials are diffuse unless they have one of the PBR keys `Pr`,
//! `Pm`, `map_Pr` or `map_Pm`. `norm` is a tangent-space normal map as in glTF; height maps (`bump`,
//! `map_bump`) are noted and left out.
//!
//! A corner without a normal is flat, or smooth within its smoothing group (`s 1`): the mean of the
//! normals of the group's faces there, weighted by their angles (Thürmer and Wüthrich, "Computing
//! Vertex Normals from Polygonal Facets", 1998).

mod materials;
mod polygons;
mod statements;

use std::collections::HashMap;
use std::path::Path;

use glam::{DVec3, Vec2, Vec3, Vec4};

use crate::error::Error;
use crate::mesh::{Material, Model, pad};
use materials::{GREY, Materials};
use statements::{Statement, shortened};

/// Most triangles of a file.
const MAX_TRIANGLES: usize = 1 << 26;

/// A face's corner. There is one for each vertex of the model, so it is small.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
struct Corner {
    /// Numbers of position, texture coordinates and normal, counted from 1; 0 is none.
    numbers: [u32; 3],
    /// Smoothing group; 0 is none. Faces with normals need none.
    group: u32,
}

/// A file as far as it is read.
struct Reader {
    materials: Materials,
    positions: Vec<DVec3>,
    /// Empty, or one per position up to the last that has one.
    colours: Vec<Vec3>,
    uvs: Vec<Vec2>,
    normals: Vec<Vec3>,
    /// The model's vertices.
    vertices: HashMap<Corner, u32>,
    /// Sums of face normals weighted by angles, by position and smoothing group.
    sums: HashMap<(u32, u32), DVec3>,
    /// Material of the faces to come, if it is defined.
    material: Option<u32>,
    /// The material of faces without one.
    grey: Option<u32>,
    /// Smoothing group of the faces to come; 0 is none.
    group: u32,
}

/// Loads a file with its materials.
pub(crate) fn load(path: &Path) -> Result<Model, Error> {
    let mut reader = Reader {
        materials: Materials::new(path)?,
        positions: Vec::new(),
        colours: Vec::new(),
        uvs: Vec::new(),
        normals: Vec::new(),
        vertices: HashMap::new(),
        sums: HashMap::new(),
        material: None,
        grey: None,
        group: 0,
    };
    statements::each(path, |statement| reader.read(statement))?;
    reader.finish().of_file(path)
}

impl Reader {
    fn read(&mut self, statement: Statement<'_>) -> Result<(), Error> {
        match statement.key {
            "v" => self.vertex(statement)?,
            "vt" => {
                let uv = statement.numbers(2)?;
                let [u, v] = [0, 1].map(|i| uv.get(i).copied().unwrap_or(0.0) as f32);
                // OBJ's v points up.
                self.uvs.push(Vec2::new(u, 1.0 - v));
            }
            "vn" => {
                let normal = statement.vector()?.normalize_or_zero().as_vec3();
                self.normals.push(if normal.is_finite() { normal } else { Vec3::ZERO });
            }
            "f" => self.face(statement)?,
            "s" => {
                self.group = match statement.value() {
                    "off" | "" => 0,
                    "on" => 1,
                    word => word.parse().map_err(|_| {
                        statement.fault(format!("{:?} is not a smoothing group", shortened(word)))
                    })?,
                };
            }
            "usemtl" => self.material = self.materials.number(statement.value()),
            "mtllib" => self.materials.read_libraries(statement)?,
            // Lines, points, groups and curves: nothing to render.
            _ => {}
        }
        Ok(())
    }

    fn vertex(&mut self, statement: Statement<'_>) -> Result<(), Error> {
        let position = statement.vector()?;
        if !position.is_finite() {
            let vertex = self.positions.len() + 1;
            return Err(statement.fault(format!("vertex {vertex} is not finite")));
        }
        // x y z r g b, or x y z w r g b.
        if let &([r, g, b] | [_, r, g, b]) = &statement.numbers(8)?[3..] {
            let rgb = DVec3::new(r, g, b).as_vec3();
            self.colours.resize(self.positions.len(), Vec3::ONE);
            self.colours.push(if rgb.is_finite() { rgb.max(Vec3::ZERO) } else { Vec3::ONE });
        }
        self.positions.push(position);
        Ok(())
    }

    fn face(&mut self, statement: Statement<'_>) -> Result<(), Error> {
        let mut corners: Vec<Corner> =
            statement.words().map(|word| self.corner(statement, word)).collect::<Result<_, _>>()?;
        // Points and lines written as faces.
        if corners.len() < 3 {
            return Ok(());
        }
        if corners.iter().any(|corner| corner.numbers[2] > 0) {
            corners.iter_mut().for_each(|corner| corner.group = 0);
        }
        let places: Vec<DVec3> =
            corners.iter().map(|corner| self.positions[corner.numbers[0] as usize - 1]).collect();
        let vertices: Vec<u32> = corners.iter().map(|&corner| self.model_vertex(corner)).collect();
        let material = match self.material {
            Some(material) => material,
            None => *self.grey.get_or_insert_with(|| {
                self.materials.model.material(Material::lambert("none", GREY))
            }),
        };
        for triangle in polygons::cut(&places) {
            for i in 0..3 {
                let [a, b, c] = [i, (i + 1) % 3, (i + 2) % 3].map(|k| places[triangle[k]]);
                let Corner { numbers: [position, ..], group } = corners[triangle[i]];
                if group > 0 {
                    let (u, v) = (b - a, c - a);
                    // Nothing for triangles without area: they have no normal.
                    let angle = u.cross(v).length().atan2(u.dot(v));
                    let sum = self.sums.entry((position, group)).or_default();
                    *sum += angle * u.cross(v).normalize_or_zero();
                }
            }
            let model = &mut self.materials.model;
            if model.triangles.len() == MAX_TRIANGLES {
                return Err(statement.fault("the file has more than 2^26 triangles"));
            }
            model.triangles.push(triangle.map(|i| vertices[i]));
            model.triangle_materials.push(material);
        }
        Ok(())
    }

    fn corner(&self, statement: Statement<'_>, word: &str) -> Result<Corner, Error> {
        let mut numbers = [0; 3];
        let counts = [self.positions.len(), self.uvs.len(), self.normals.len()];
        let fields = numbers.iter_mut().zip(counts).zip(["vertex", "texture", "normal"]);
        for (((number, count), what), text) in fields.zip(word.split('/')) {
            if text.is_empty() {
                continue;
            }
            let value: i64 = text.parse().map_err(|_| {
                statement.fault(format!("{:?} is not a {what} index", shortened(text)))
            })?;
            // Negative ones count back from the last.
            let found = if value < 0 { count as i64 + 1 + value } else { value };
            *number = u32::try_from(found)
                .ok()
                .filter(|&found| (1..=count).contains(&(found as usize)))
                .ok_or_else(|| statement.fault(format!("{what} index {value} of {count}")))?;
        }
        if numbers[0] == 0 {
            return Err(statement.fault("a corner has no vertex index"));
        }
        Ok(Corner { numbers, group: self.group })
    }

    /// The model's vertex of a corner.
    fn model_vertex(&mut self, corner: Corner) -> u32 {
        let model = &mut self.materials.model;
        *self.vertices.entry(corner).or_insert_with(|| {
            let first = model.positions.len();
            let [position, uv, normal] = corner.numbers.map(|number| number as usize);
            model.positions.push(self.positions[position - 1]);
            let colour = self.colours.get(position - 1).map(|colour| colour.extend(1.0));
            pad(&mut model.colours, colour, (first, 1), Vec4::ONE);
            let uv = uv.checked_sub(1).map(|place| self.uvs[place]);
            pad(&mut model.uvs[0], uv, (first, 1), Vec2::ZERO);
            let normal = normal.checked_sub(1).map(|place| self.normals[place]);
            pad(&mut model.normals, normal, (first, 1), Vec3::ZERO);
            first as u32
        })
    }

    /// The model, with the normals of smoothing groups.
    fn finish(self) -> Model {
        let mut model = self.materials.model;
        if !self.sums.is_empty() {
            model.normals.resize(model.positions.len(), Vec3::ZERO);
        }
        for (Corner { numbers: [position, ..], group }, vertex) in self.vertices {
            if let Some(sum) = self.sums.get(&(position, group)) {
                model.normals[vertex as usize] = sum.normalize_or_zero().as_vec3();
            }
        }
        model
    }
}

#[cfg(test)]
mod tests;
