//! Loads Wavefront OBJ files with their MTL libraries through `tobj`.
//!
//! Every statement is checked first, because errors of `tobj` do not name the line, and it misreads indices
//! of 0 and files in which only some vertices have colours, texture coordinates or normals. `tobj` gets the
//! faces in blocks, as it holds about 100 bytes per face until an object ends. Its objects share no vertices, so
//! the vertices of the blocks are merged here. Polygons are triangulated by ear clipping rather than as fans.
//!
//! Faces are visible from both sides. Materials are diffuse unless they have one of the PBR keys `Pr`,
//! `Pm`, `map_Pr` or `map_Pm`. `norm` is a tangent-space normal map as in glTF; height maps (`bump`,
//! `map_bump`) and turbulence (`-t`) are ignored with a note. Where common programs deviate from the format, this reader follows them: a
//! map whose factor is 0 is shown, `d` takes precedence over `Tr`, and a `Tr` that would hide a material is ignored.
//!
//! Vertex colours (`v x y z r g b`) are sRGB, from 0 to 1, or from 0 to 255 if any value is at least 2. They
//! replace a missing or black colour of materials without a texture.
//!
//! A corner without a normal is shaded flat, or smooth within its smoothing group (`s 1`). A smooth normal is the mean
//! of the normals of the group's faces, weighted by their angles (Thürmer and Wüthrich, "Computing Vertex
//! Normals from Polygonal Facets", 1998).

mod block;
mod materials;
mod polygons;
mod statements;

use std::collections::HashMap;
use std::mem;
use std::path::Path;

use glam::{DVec2, DVec3, Vec2, Vec3};
use tobj::Mesh;

use crate::error::Error;
use crate::mesh::{Material, Model, pad};
use crate::resource::shortened;
use crate::texture::linear_from_srgb;
use block::Block;
use materials::{GREY, Materials};
use statements::Statement;

/// Maximum number of triangles of a file.
const MAX_TRIANGLES: usize = 1 << 26;

/// A face's corner. Kept small, as one is stored for each vertex of the model.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
struct Corner {
    /// Numbers of position, texture coordinates and normal, counted from 1; 0: none.
    numbers: [u32; 3],
    /// Smoothing group; 0: none, also for faces with normals.
    group: u32,
}

/// A file being read.
struct Reader {
    materials: Materials,
    positions: Vec<DVec3>,
    /// Colours as in the file; empty, or one per position up to the last one with a colour.
    colours: Vec<Option<Vec3>>,
    uvs: Vec<Vec2>,
    normals: Vec<Vec3>,
    /// Number of triangles so far.
    triangles: usize,
    /// Faces that are not yet in the model.
    block: Block,
    /// The model's vertex for each distinct corner.
    vertices: HashMap<Corner, u32>,
    /// Sums of face normals weighted by angles, by position and smoothing group.
    sums: HashMap<(u32, u32), DVec3>,
    /// Material of the next faces, if it is defined.
    material: Option<u32>,
    /// Material of faces without one.
    grey: Option<u32>,
    /// Smoothing group of the next faces; 0: none.
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
        triangles: 0,
        block: Block::default(),
        vertices: HashMap::new(),
        sums: HashMap::new(),
        material: None,
        grey: None,
        group: 0,
    };
    statements::for_each(path, |statement| reader.read(statement))?;
    reader.add_block(path)?;
    reader.into_model().finish(path)
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
            "usemtl" => self.material = self.materials.index_of(statement.value()),
            "mtllib" => self.materials.read_libraries(statement)?,
            // Lines, points, groups and curves are not rendered.
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
        // The numbers are x y z r g b, or x y z w r g b.
        if let &([r, g, b] | [_, r, g, b]) = &statement.numbers(8)?[3..] {
            let rgb = DVec3::new(r, g, b).as_vec3();
            if rgb.max_element() > 255.0 {
                let problem = format!("the vertex colour {} is above 255", rgb.max_element());
                return Err(statement.fault(problem));
            }
            self.colours.resize(self.positions.len(), None);
            self.colours.push(rgb.is_finite().then_some(rgb));
        }
        self.positions.push(position);
        Ok(())
    }

    fn face(&mut self, statement: Statement<'_>) -> Result<(), Error> {
        let mut corners: Vec<Corner> =
            statement.words().map(|word| self.corner(statement, word)).collect::<Result<_, _>>()?;
        // A point or line written as a face is not rendered.
        if corners.len() < 3 {
            return Ok(());
        }
        self.triangles += corners.len() - 2;
        if self.triangles > MAX_TRIANGLES {
            return Err(statement.fault("the file has more than 2^26 triangles"));
        }
        if corners.iter().any(|corner| corner.numbers[2] > 0) {
            corners.iter_mut().for_each(|corner| corner.group = 0);
        }
        let group = corners[0].group;
        let material = match self.material {
            Some(material) => material,
            None => *self.grey.get_or_insert_with(|| {
                let grey = self.materials.model.material(Material::lambert("none", [GREY; 3]));
                self.materials.uncoloured.insert(grey);
                grey
            }),
        };
        if self.block.is_full() || (self.block.material, self.block.group) != (material, group) {
            self.add_block(statement.path)?;
            (self.block.material, self.block.group) = (material, group);
        }
        // Every corner gets all attributes, as `tobj` would mix up attributes that only some corners have.
        self.block.add(&corners, |i, number| {
            let index = number.wrapping_sub(1);
            if i == 0 {
                let [x, y, z] = self.positions[index].to_array();
                format!("v {x} {y} {z}\n")
            } else if i == 1 {
                let uv = self.uvs.get(index).copied().unwrap_or_default().as_dvec2();
                format!("vt {} {}\n", uv.x, uv.y)
            } else {
                let [x, y, z] =
                    self.normals.get(index).copied().unwrap_or_default().as_dvec3().to_array();
                format!("vn {x} {y} {z}\n")
            }
        });
        Ok(())
    }

    fn corner(&self, statement: Statement<'_>, word: &str) -> Result<Corner, Error> {
        let mut numbers = [0; 3];
        let counts = [self.positions.len(), self.uvs.len(), self.normals.len()];
        let fields = numbers.iter_mut().zip(counts).zip(["vertex", "texture", "normal"]);
        for (((number, count), kind), text) in fields.zip(word.split('/')) {
            if text.is_empty() {
                continue;
            }
            let value: i64 = text.parse().map_err(|_| {
                statement.fault(format!("{:?} is not a {kind} index", shortened(text)))
            })?;
            // Negative indices count back from the last element.
            let index = if value < 0 { count as i64 + 1 + value } else { value };
            *number = u32::try_from(index)
                .ok()
                .filter(|&index| (1..=count).contains(&(index as usize)))
                .ok_or_else(|| {
                    let problem = format!("is out of range: the file has {count} so far");
                    statement.fault(format!("{kind} index {value} {problem}"))
                })?;
        }
        if numbers[0] == 0 {
            return Err(statement.fault("a corner has no vertex index"));
        }
        Ok(Corner { numbers, group: self.group })
    }

    /// Adds the faces of the block to the model and starts a new block.
    fn add_block(&mut self, path: &Path) -> Result<(), Error> {
        let block = mem::take(&mut self.block);
        let mesh = block.read().map_err(|error| {
            let remedy = "correct the file or export it again";
            Error::malformed(path, "the faces", error.to_string(), remedy)
        })?;
        let mut vertices = Vec::new();
        for (&corner, &vertex) in block.corners.iter().zip(&mesh.indices) {
            // `tobj` numbers vertices in the order of their first use.
            if vertex as usize == vertices.len() {
                vertices.push(self.model_vertex(corner, &mesh, vertices.len()));
            }
        }
        // `face_arities` is empty if all faces are triangles.
        let mut arities = mesh.face_arities.iter();
        let mut first = 0;
        while first < mesh.indices.len() {
            let end = first + arities.next().map_or(3, |&arity| arity as usize);
            let face = &mesh.indices[first..end];
            let place = |&i: &u32| DVec3::from_slice(&mesh.positions[3 * i as usize..]);
            let places: Vec<DVec3> = face.iter().map(place).collect();
            for triangle in polygons::triangulate(&places) {
                for i in 0..3 {
                    let [a, b, c] = [i, (i + 1) % 3, (i + 2) % 3].map(|k| places[triangle[k]]);
                    let Corner { numbers: [position, ..], group } =
                        block.corners[first + triangle[i]];
                    if group > 0 {
                        let (u, v) = (b - a, c - a);
                        // A triangle without area has no normal and adds nothing.
                        let angle = u.cross(v).length().atan2(u.dot(v));
                        let sum = self.sums.entry((position, group)).or_default();
                        *sum += angle * u.cross(v).normalize_or_zero();
                    }
                }
                let model = &mut self.materials.model;
                model.triangles.push(triangle.map(|i| vertices[face[i] as usize]));
                model.triangle_materials.push(block.material);
            }
            first = end;
        }
        Ok(())
    }

    /// The model's vertex for a corner that is vertex `i` of a block.
    fn model_vertex(&mut self, corner: Corner, mesh: &Mesh, i: usize) -> u32 {
        let model = &mut self.materials.model;
        *self.vertices.entry(corner).or_insert_with(|| {
            let at = |values: &[f64]| DVec3::from_slice(&values[3 * i..]);
            let place = (model.positions.len(), 1);
            model.positions.push(at(&mesh.positions));
            let uv = DVec2::from_slice(&mesh.texcoords[2 * i..]).as_vec2();
            pad(&mut model.uvs[0], (corner.numbers[1] > 0).then_some(uv), place, Vec2::ZERO);
            let normal = at(&mesh.normals).as_vec3();
            pad(&mut model.normals, (corner.numbers[2] > 0).then_some(normal), place, Vec3::ZERO);
            place.0 as u32
        })
    }

    /// Sets the colours of vertices and the normals of smoothing groups, and returns the model.
    fn into_model(mut self) -> Model {
        self.add_colours();
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

    fn add_colours(&mut self) {
        let values = self.colours.iter().flatten();
        let Some(largest) = values.map(|colour| colour.max_element()).reduce(f32::max) else {
            return;
        };
        // Slightly more than 1 is a rounding error.
        let full = if largest >= 2.0 { 255.0 } else { 1.0 };
        let decoded = |v: f32| linear_from_srgb(f64::from((v / full).clamp(0.0, 1.0))) as f32;
        let Materials { model, uncoloured, .. } = &mut self.materials;
        let mut colours = vec![None; model.positions.len()];
        for (corner, &vertex) in &self.vertices {
            let colour = self.colours.get(corner.numbers[0] as usize - 1).copied().flatten();
            colours[vertex as usize] = colour.map(|c| Vec3::from(c.to_array().map(decoded)));
        }
        for (triangle, material) in model.triangles.iter().zip(&model.triangle_materials) {
            if uncoloured.contains(material)
                && triangle.iter().any(|&i| colours[i as usize].is_some())
            {
                let base = &mut model.materials[*material as usize].base;
                *base = Vec3::ONE.extend(base.w);
            }
        }
        model.colours =
            colours.into_iter().map(|colour| colour.unwrap_or(Vec3::ONE).extend(1.0)).collect();
    }
}

#[cfg(test)]
mod tests;
