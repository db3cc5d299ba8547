//! Geometry, materials, lights and cameras, independent of the source's format.
//!
//! Coordinates are those of the source (right-handed, +y up unless the source says otherwise) in f64, so that
//! nodes far from the origin keep their precision until the tracer recentres them.

use std::path::Path;

use glam::{DMat3, DVec3, Vec2, Vec3, Vec4};

use crate::error::Error;
use crate::texture::{Texture, TextureRef};

/// The contents of a mesh file or built-in scene.
#[derive(Debug, Clone, Default)]
pub struct Model {
    /// Name for messages and for `scene.json`.
    pub name: String,
    /// Vertex positions, finite. Shape: `[vertices]`.
    pub positions: Vec<DVec3>,
    /// Unit vertex normals; empty, or one per vertex, zero if the source has none (the geometric normal is then
    /// used). Shape: `[vertices]`.
    pub normals: Vec<Vec3>,
    /// Tangents with handedness in w; empty, or one per vertex, zero if the source has none.
    pub tangents: Vec<Vec4>,
    /// Texture coordinates, two sets; each empty or one per vertex. v points down.
    pub uvs: [Vec<Vec2>; 2],
    /// Linear RGBA vertex colours that the base colour is multiplied by; empty or one per vertex.
    pub colours: Vec<Vec4>,
    /// Vertex indices, counter-clockwise seen from outside. Shape: `[triangles]`.
    pub triangles: Vec<[u32; 3]>,
    /// Material of each triangle. Shape: `[triangles]`.
    pub triangle_materials: Vec<u32>,
    /// Materials; not empty if there are triangles.
    pub materials: Vec<Material>,
    /// Decoded images.
    pub textures: Vec<Texture>,
    /// The source's lights; if empty, the renderer adds its own.
    pub lights: Vec<Light>,
    /// The source's cameras.
    pub cameras: Vec<FileCamera>,
    /// Notes for the user about what was ignored or replaced when the source was loaded.
    pub notes: Vec<String>,
}

/// A reflection model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reflection {
    /// The base colour, without lighting (`KHR_materials_unlit`).
    Unlit,
    /// Diffuse only, independent of the viewing direction.
    Lambert,
    /// glTF's metallic-roughness model: diffuse and GGX.
    MetalRough,
}

/// The treatment of alpha.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum AlphaMode {
    /// Alpha is ignored.
    Opaque,
    /// There is no surface where alpha is below the cutoff.
    Mask(f32),
    /// The surface is blended by its alpha.
    Blend,
}

/// A material; glTF's metallic-roughness model and its special cases.
#[derive(Debug, Clone)]
pub struct Material {
    /// Name for messages.
    pub name: String,
    /// Reflection model.
    pub reflection: Reflection,
    /// Linear base colour and alpha.
    pub base: Vec4,
    /// Metalness, `0..=1`.
    pub metallic: f32,
    /// Perceptual roughness, `0..=1`; its square is GGX's alpha.
    pub roughness: f32,
    /// Linear radiance emitted.
    pub emissive: Vec3,
    /// Multiplies base colour and alpha (sRGB).
    pub base_texture: Option<TextureRef>,
    /// Its red channel multiplies alpha (OBJ's `map_d`).
    pub alpha_texture: Option<TextureRef>,
    /// Its green channel multiplies the roughness (linear).
    pub roughness_texture: Option<TextureRef>,
    /// Its blue channel multiplies the metalness (linear); in glTF it is the same texture as for roughness.
    pub metallic_texture: Option<TextureRef>,
    /// Tangent-space normals (linear).
    pub normal_texture: Option<TextureRef>,
    /// Scale of the normal map's x and y.
    pub normal_scale: f32,
    /// Multiplies the emitted radiance (sRGB).
    pub emissive_texture: Option<TextureRef>,
    /// Treatment of alpha.
    pub alpha: AlphaMode,
    /// True if the back is also visible.
    pub double_sided: bool,
    /// True for thin structures, which can be excluded from the initial points.
    pub thin: bool,
    /// True if the emission is also a [`Light`], so that secondary rays must not count it again.
    pub is_light: bool,
}

impl Default for Material {
    fn default() -> Self {
        Self {
            name: "default".into(),
            reflection: Reflection::Lambert,
            base: Vec4::ONE,
            metallic: 0.0,
            roughness: 1.0,
            emissive: Vec3::ZERO,
            base_texture: None,
            alpha_texture: None,
            roughness_texture: None,
            metallic_texture: None,
            normal_texture: None,
            normal_scale: 1.0,
            emissive_texture: None,
            alpha: AlphaMode::Opaque,
            double_sided: true,
            thin: false,
            is_light: false,
        }
    }
}

impl Material {
    /// A diffuse material of one linear colour.
    pub fn lambert(name: &str, colour: [f32; 3]) -> Self {
        Self { name: name.into(), base: Vec3::from(colour).extend(1.0), ..Self::default() }
    }
}

/// The shape of a light, in the source's coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LightKind {
    /// Parallel light travelling along `direction` (unit length); intensity is irradiance.
    Directional {
        /// Direction of travel.
        direction: DVec3,
    },
    /// Light from a point; intensity is radiant intensity, so that irradiance falls with the square of the distance.
    Point {
        /// Position.
        position: DVec3,
    },
    /// Light from a point into a cone; intensity is as for `Point`.
    Spot {
        /// Position.
        position: DVec3,
        /// Axis of the cone, unit length.
        direction: DVec3,
        /// Cosine of the angle from the axis within which intensity is full.
        cos_inner: f32,
        /// Cosine of the angle from the axis beyond which intensity is zero.
        cos_outer: f32,
    },
    /// A rectangle that emits to the side of `u x v`, sampled at random points; intensity is radiance.
    Area {
        /// A corner.
        corner: DVec3,
        /// One side, as a vector from the corner.
        u: DVec3,
        /// The other side, as a vector from the corner.
        v: DVec3,
    },
}

/// A light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Light {
    /// Shape and position.
    pub kind: LightKind,
    /// Linear colour times intensity, in the unit given by the kind.
    pub intensity: Vec3,
    /// Distance beyond which the light has no effect; may be infinite.
    pub range: f64,
}

/// A camera defined in a file.
#[derive(Debug, Clone, PartialEq)]
pub struct FileCamera {
    /// Name, for messages.
    pub name: String,
    /// Columns: right, down, forward; orthonormal.
    pub world_from_camera: DMat3,
    /// Position.
    pub centre: DVec3,
    /// Vertical field of view `[rad]`.
    pub yfov: f64,
}

impl Model {
    /// Appends a triangle mesh whose triangles share one material. Normals may be empty (flat
    /// shading); UVs may be empty.
    pub fn add(
        &mut self,
        positions: &[DVec3],
        normals: &[Vec3],
        uvs: &[Vec2],
        triangles: &[[u32; 3]],
        material: u32,
    ) {
        let first = self.positions.len() as u32;
        self.positions.extend_from_slice(positions);
        let place = (first as usize, positions.len());
        pad(&mut self.normals, normals.iter().copied(), place, Vec3::ZERO);
        pad(&mut self.uvs[0], uvs.iter().copied(), place, Vec2::ZERO);
        self.triangles.extend(triangles.iter().map(|t| t.map(|i| i + first)));
        self.triangle_materials.resize(self.triangles.len(), material);
    }

    /// Adds a material and returns its index.
    pub fn material(&mut self, material: Material) -> u32 {
        self.materials.push(material);
        self.materials.len() as u32 - 1
    }

    /// Names the model after its file, and checks that there is something to render.
    pub(crate) fn finish(mut self, path: &Path) -> Result<Self, Error> {
        if self.triangles.is_empty() {
            return Err(Error::empty(path.display()));
        }
        let has_area = |triangle: &[u32; 3]| {
            let [a, b, c] = triangle.map(|i| self.positions[i as usize]);
            (b - a).cross(c - a).length_squared() > 0.0
        };
        if !self.triangles.iter().any(has_area) {
            let problem = "no triangle has an area";
            return Err(Error::malformed(
                path,
                "the mesh",
                problem,
                "correct the mesh or its scale",
            ));
        }
        self.name =
            path.file_stem().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        Ok(self)
    }

    /// True if a triangle belongs to a thin structure.
    pub fn is_thin(&self, triangle: u32) -> bool {
        let material = self.triangle_materials.get(triangle as usize);
        material.is_some_and(|&m| self.materials[m as usize].thin)
    }

    /// Smallest and largest coordinates of all triangles' vertices.
    pub fn bounds(&self) -> (DVec3, DVec3) {
        let used = self.triangles.iter().flatten().map(|&i| self.positions[i as usize]);
        let empty = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        used.fold(empty, |(lo, hi), p| (lo.min(p), hi.max(p)))
    }
}

/// Appends the values of `count` new vertices, after `before` existing ones, to a list that stays empty as long
/// as no vertex has a value. Vertices without a value get `missing`.
pub(crate) fn pad<T: Copy>(
    list: &mut Vec<T>,
    values: impl IntoIterator<Item = T>,
    (before, count): (usize, usize),
    missing: T,
) {
    let mut values = values.into_iter().peekable();
    if values.peek().is_some() || !list.is_empty() {
        list.reserve(before + count - list.len());
        list.resize(before, missing);
        list.extend(values);
        list.resize(before + count, missing);
    }
}
