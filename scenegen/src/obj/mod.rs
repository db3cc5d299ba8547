//! Loads Wavefront OBJ files with their MTL libraries through `tobj`.
//!
//! Every statement is checked before `tobj` reads it, because `tobj` panics on short colours
//! (`Kd 1 1`), misreads indices of 0 and files in which only some vertices have colours, texture
//! coordinates or normals, and its errors name no line. Polygons are cut by ear clipping rather than
//! as fans. Read here and not by `tobj`: smoothing groups, and the options of texture statements.
//!
//! Faces are visible from both sides. Materials are diffuse unless they have one of the PBR keys `Pr`,
//! `Pm`, `map_Pr` or `map_Pm`. `norm` is a tangent-space normal map as in glTF; height maps (`bump`,
//! `map_bump`) are noted and left out.
//!
//! A corner without a normal is flat, or smooth within its smoothing group (`s 1`): the mean of the
//! normals of the group's faces there, weighted by their angles (Thürmer and Wüthrich, "Computing
//! Vertex Normals from Polygonal Facets", 1998).

mod geometry;
mod materials;
mod polygons;
mod statements;

use std::cell::RefCell;
use std::collections::{HashMap, VecDeque};
use std::io::{BufReader, Read as _};
use std::path::Path;

use glam::{DVec3, Vec2, Vec3, Vec4};
use tobj::{LoadError, LoadOptions};

use crate::error::Error;
use crate::mesh::{Material, Model, pad};
use geometry::{Geometry, PLACEHOLDERS};
use materials::{GREY, Materials};
use statements::{Statement, Statements};

/// Loads a file with its materials.
pub(crate) fn load(path: &Path) -> Result<Model, Error> {
    let libraries = RefCell::new(VecDeque::new());
    let mut geometry = Geometry::new(Materials::new(path)?, &libraries);
    let mut check = |statement: Statement<'_>| geometry.check(statement);
    let mut statements = Statements::open(path, &mut check)?;
    let mut file = BufReader::new(PLACEHOLDERS.chain(&mut statements));
    let options = LoadOptions { single_index: true, ..LoadOptions::default() };
    let result = tobj::load_obj_buf(&mut file, &options, |_| {
        libraries.borrow_mut().pop_front().unwrap_or(Err(LoadError::GenericFailure))
    });
    let (objects, _) = statements.outcome(result)?;
    let mut model = joined(objects, geometry);
    if model.triangles.is_empty() {
        return Err(Error::Empty { name: path.display().to_string() });
    }
    model.name =
        path.file_stem().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    Ok(model)
}

/// Joins the objects to one model.
fn joined(objects: Vec<tobj::Model>, geometry: Geometry<'_>) -> Model {
    let mut model = geometry.materials.model;
    let mut smooth_corners = geometry.smooth_corners.into_iter();
    let mut smoothing = Smoothing::default();
    let mut without_material = None;
    for tobj::Model { mesh, name } in objects {
        let first = model.positions.len();
        let positions: Vec<DVec3> = mesh.positions.chunks_exact(3).map(DVec3::from_slice).collect();
        let normals: Vec<Vec3> = mesh.normals.chunks_exact(3).map(unit).collect();
        // OBJ's v points up.
        let uv = |uv: &[f64]| Vec2::new(uv[0] as f32, 1.0 - uv[1] as f32);
        let uvs: Vec<Vec2> = mesh.texcoords.chunks_exact(2).map(uv).collect();
        let mut colours: Vec<Vec4> = mesh.vertex_color.chunks_exact(3).map(colour).collect();
        if colours.iter().all(|colour| *colour == Vec4::ONE) {
            colours.clear();
        }
        let mut triangles = Vec::with_capacity(mesh.indices.len() / 3);
        let mut rest = &mesh.indices[..];
        // There are no arities where all faces are triangles.
        let mut arities = mesh.face_arities.iter();
        while !rest.is_empty() {
            let corners = arities.next().map_or(3, |&arity| arity as usize);
            let (face, others) = rest.split_at(corners);
            polygons::cut(&positions, face, &mut triangles);
            rest = others;
        }
        let group = name.parse().unwrap_or(0);
        if group > 0 {
            let mut numbers = vec![0; positions.len()];
            for (&vertex, number) in mesh.indices.iter().zip(&mut smooth_corners) {
                numbers[vertex as usize] = number;
            }
            smoothing.add(first, &positions, &triangles, |vertex| (numbers[vertex], group));
        }
        let material = match mesh.material_id {
            Some(number) => number as u32,
            None => *without_material
                .get_or_insert_with(|| model.material(Material::lambert("none", GREY))),
        };
        pad(&mut model.colours, &colours, first, positions.len(), Vec4::ONE);
        model.add(&positions, &normals, &uvs, &triangles, material);
    }
    smoothing.finish(&mut model);
    model
}

/// A unit normal; zero where it has no direction.
fn unit(normal: &[f64]) -> Vec3 {
    let normal = DVec3::from_slice(normal).normalize_or_zero().as_vec3();
    if normal.is_finite() { normal } else { Vec3::ZERO }
}

fn colour(rgb: &[f64]) -> Vec4 {
    let rgb = DVec3::from_slice(rgb).as_vec3();
    if rgb.is_finite() { rgb.max(Vec3::ZERO).extend(1.0) } else { Vec4::ONE }
}

/// A position's number in the file, and a smoothing group.
type SmoothCorner = (u32, u32);

/// Normals of smoothing groups.
#[derive(Default)]
struct Smoothing {
    /// Sums of face normals, weighted by angles.
    sums: HashMap<SmoothCorner, DVec3>,
    /// The model's vertices that get them.
    vertices: Vec<(usize, SmoothCorner)>,
}

impl Smoothing {
    /// Adds the triangles of an object whose vertices follow the model's first ones.
    fn add(
        &mut self,
        first: usize,
        positions: &[DVec3],
        triangles: &[[u32; 3]],
        corner_of: impl Fn(usize) -> SmoothCorner,
    ) {
        self.vertices.extend((0..positions.len()).map(|i| (first + i, corner_of(i))));
        for triangle in triangles {
            let corners = triangle.map(|i| i as usize);
            for i in 0..3 {
                let [a, b, c] = [i, (i + 1) % 3, (i + 2) % 3].map(|k| positions[corners[k]]);
                let (u, v) = (b - a, c - a);
                // Nothing for triangles without area: they have no normal.
                let angle = u.cross(v).length().atan2(u.dot(v));
                let sum = self.sums.entry(corner_of(corners[i])).or_default();
                *sum += angle * u.cross(v).normalize_or_zero();
            }
        }
    }

    /// Gives the vertices their normals.
    fn finish(self, model: &mut Model) {
        if self.vertices.is_empty() {
            return;
        }
        model.normals.resize(model.positions.len(), Vec3::ZERO);
        for (vertex, corner) in self.vertices {
            let sum = self.sums.get(&corner).copied().unwrap_or_default();
            model.normals[vertex] = sum.normalize_or_zero().as_vec3();
        }
    }
}

#[cfg(test)]
mod tests;
