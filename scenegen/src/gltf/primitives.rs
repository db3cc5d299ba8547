//! Reads the triangles of a mesh, deformed by its morph targets and placed by its node or skin.

use glam::{DAffine3, DVec3, Vec2, Vec3, Vec4};
use gltf::json;
use json::accessor::ComponentType;
use json::mesh::{Mode, MorphTarget, Primitive, Semantic};
use json::validation::Checked;

use super::accessors::Floats;
use super::nodes::Places;
use super::{DRACO, Reader, fault, remedy};
use crate::error::Error;
use crate::mesh::pad;
use crate::resource::shortened;

/// Maximum number of triangles of a scene, including instances.
const MAX_TRIANGLES: usize = 1 << 26;

/// A primitive being read.
struct Source<'a> {
    primitive: &'a Primitive,
    /// Its name, for messages.
    element: &'a str,
    /// Morph targets that have an effect, with their weights.
    morphs: Vec<(&'a MorphTarget, f32)>,
}

impl Source<'_> {
    fn accessor(&self, semantic: Semantic) -> Option<usize> {
        Some(self.primitive.attributes.get(&Checked::Valid(semantic))?.value())
    }
}

impl Reader<'_> {
    /// Adds the triangles of a primitive to the model, placed in the world by `places`.
    pub(super) fn primitive(
        &mut self,
        primitive: &Primitive,
        element: &str,
        weights: &[f32],
        places: &Places,
    ) -> Result<(), Error> {
        let Checked::Valid(mode) = primitive.mode else {
            return Err(self.fault(element, "its mode is not in 0 to 6"));
        };
        if !matches!(mode, Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan) {
            let note = "points and lines are not rendered".to_owned();
            if !self.model.notes.contains(&note) {
                self.model.notes.push(note);
            }
            return Ok(());
        }
        self.refuse_hidden_geometry(primitive, element)?;
        let morphs = self.morphs(primitive, element, weights)?;
        let source = Source { primitive, element, morphs };
        let Some(positions) = self.attribute(&source, Semantic::Positions, &[3], None)? else {
            // This is valid (glTF 2.0, 3.7.2.1).
            let note = format!("{element} has no positions and is not rendered");
            self.model.notes.push(note);
            return Ok(());
        };
        let count = positions.count();
        let mut read =
            |semantic, sizes: &[usize]| self.attribute(&source, semantic, sizes, Some(count));
        let normals = read(Semantic::Normals, &[3])?;
        let tangents = read(Semantic::Tangents, &[4])?;
        let uvs = [read(Semantic::TexCoords(0), &[2])?, read(Semantic::TexCoords(1), &[2])?];
        let colours = read(Semantic::Colors(0), &[3, 4])?;
        self.refuse_plain_integers(&source)?;
        let indices = match primitive.indices {
            Some(index) => self.buffers.indices(index.value(), element)?,
            None => (0..u32::try_from(count).unwrap_or(u32::MAX)).collect(),
        };
        if let Some(&index) = indices.iter().find(|&&i| i as usize >= count) {
            let problem = format!("index {index} is out of range: there are {count} vertices");
            return Err(self.fault(element, problem));
        }
        let triangles = triangles(mode, &indices);
        // All matrices, and how many make one pose: one for all vertices, or one for each vertex.
        let skinned;
        let (matrices, per_pose) = match places {
            Places::Instances(all) => (all, 1),
            Places::Joints(joints) => {
                skinned = self.skinned(&source, joints, count)?;
                (&skinned, count)
            }
        };
        let poses = matrices.len() / per_pose;
        if self.model.triangles.len() + poses * triangles.len() > MAX_TRIANGLES
            || self.model.positions.len() + poses * count > u32::MAX as usize
        {
            return Err(self.fault(element, "the scene has more than 2^26 triangles"));
        }
        let material = self.material(primitive.material.map(|index| index.value()))?;
        for pose in matrices.chunks(per_pose) {
            let matrix_of = |vertex: usize| if per_pose == 1 { 0 } else { vertex };
            let normal_matrices: Vec<_> =
                pose.iter().map(|world| world.matrix3.inverse().transpose()).collect();
            let mirrored: Vec<bool> =
                pose.iter().map(|world| world.matrix3.determinant() < 0.0).collect();
            let first = self.model.positions.len();
            for vertex in 0..count {
                let p = Vec3::from(positions.get::<3>(vertex)).as_dvec3();
                let p = pose[matrix_of(vertex)].transform_point3(p);
                if !p.is_finite() {
                    return Err(self.fault(element, format!("vertex {vertex} is not finite")));
                }
                self.model.positions.push(p);
            }
            let model = &mut self.model;
            let normal = |i, v: [f32; 3]| {
                (normal_matrices[matrix_of(i)] * Vec3::from(v).as_dvec3())
                    .as_vec3()
                    .normalize_or_zero()
            };
            let tangent = |i, [x, y, z, w]: [f32; 4]| {
                let t = pose[matrix_of(i)].matrix3 * DVec3::new(x.into(), y.into(), z.into());
                let side = if mirrored[matrix_of(i)] { -1.0 } else { 1.0 };
                t.as_vec3().normalize_or_zero().extend(w * side)
            };
            let colour = |_, v: [f32; 4]| Vec4::from(v).clamp(Vec4::ZERO, Vec4::splat(1e4));
            let place = (first, count);
            pad(&mut model.normals, converted(normals.as_ref(), normal), place, Vec3::ZERO);
            pad(&mut model.tangents, converted(tangents.as_ref(), tangent), place, Vec4::ZERO);
            for (list, values) in model.uvs.iter_mut().zip(&uvs) {
                let uv = |_, uv: [f32; 2]| Vec2::from(uv);
                pad(list, converted(values.as_ref(), uv), place, Vec2::ZERO);
            }
            pad(&mut model.colours, converted(colours.as_ref(), colour), place, Vec4::ONE);
            model.triangles.extend(triangles.iter().map(|&[a, b, c]| {
                let [b, c] = if mirrored[matrix_of(a as usize)] { [c, b] } else { [b, c] };
                [a, b, c].map(|i| i + first as u32)
            }));
            model.triangle_materials.resize(model.triangles.len(), material);
        }
        Ok(())
    }

    /// Refuses colours in integers that are not normalised, as their range is not defined (glTF 2.0, 3.7.2.1).
    fn refuse_plain_integers(&self, source: &Source<'_>) -> Result<(), Error> {
        let accessor = source.accessor(Semantic::Colors(0));
        let Some(accessor) = accessor.and_then(|index| self.root.accessors.get(index)) else {
            return Ok(());
        };
        let float = ComponentType::F32;
        let is_float =
            matches!(&accessor.component_type, Checked::Valid(component) if component.0 == float);
        if is_float || accessor.normalized {
            return Ok(());
        }
        let element = format!("{} COLOR_0", source.element);
        let problem = "its integers are not marked as normalized, so that their range is unknown";
        Err(self.fault(element, problem))
    }

    /// Refuses a primitive whose geometry only an extension defines.
    fn refuse_hidden_geometry(&self, primitive: &Primitive, element: &str) -> Result<(), Error> {
        let Some(extensions) = primitive.extensions.as_ref().map(|e| &e.others) else {
            return Ok(());
        };
        let positions = primitive.attributes.get(&Checked::Valid(Semantic::Positions));
        let accessors = positions.into_iter().chain(&primitive.indices);
        let mut accessors = accessors.filter_map(|index| self.root.accessors.get(index.value()));
        let name = match extensions.keys().next() {
            Some(name) if positions.is_none() => name,
            _ if extensions.contains_key(DRACO) && accessors.any(|a| a.buffer_view.is_none()) => {
                DRACO
            }
            _ => return Ok(()),
        };
        let shown = shortened(name);
        let feature = format!("{element}: geometry that only the extension {shown} defines");
        Err(Error::unsupported(self.path, &feature, remedy(name)))
    }

    /// The morph targets that have an effect, with their weights.
    fn morphs<'p>(
        &self,
        primitive: &'p Primitive,
        element: &str,
        weights: &[f32],
    ) -> Result<Vec<(&'p MorphTarget, f32)>, Error> {
        let targets = primitive.targets.as_deref().unwrap_or_default();
        let weights = weights.iter().enumerate().filter(|(_, weight)| **weight != 0.0);
        let target = |(i, &weight): (usize, &f32)| match targets.get(i) {
            Some(target) => Ok((target, weight)),
            None => Err(self.fault(element, format!("weight {i} has no morph target"))),
        };
        weights.map(target).collect()
    }

    /// An attribute with morph targets applied; `None` if the primitive lacks it. `count` is the number of
    /// positions; `None` for the positions themselves.
    fn attribute(
        &mut self,
        source: &Source<'_>,
        semantic: Semantic,
        sizes: &[usize],
        count: Option<usize>,
    ) -> Result<Option<Floats>, Error> {
        let Some(index) = source.accessor(semantic.clone()) else { return Ok(None) };
        let (path, element) = (self.path, source.element);
        let mut values = self.buffers.floats(index, sizes, element)?;
        let count = count.unwrap_or(values.count());
        let check = |index: usize, found: usize| {
            if found == count {
                return Ok(());
            }
            let problem = format!("accessor {index} has {found} elements, POSITION {count}");
            Err(fault(path, format!("{element} {semantic:?}"), problem))
        };
        check(index, values.count())?;
        for (target, weight) in &source.morphs {
            let deltas = match semantic {
                Semantic::Positions => target.positions,
                Semantic::Normals => target.normals,
                Semantic::Tangents => target.tangents,
                _ => None,
            };
            if let Some(index) = deltas.map(|index| index.value()) {
                let deltas = self.buffers.floats(index, &[3], element)?;
                check(index, deltas.count())?;
                values.add(&deltas, *weight);
            }
        }
        Ok(Some(values))
    }

    /// For each vertex, the weighted mean of its joints' transforms (glTF 2.0, 3.7.3.3). Weights need not sum to 1.
    fn skinned(
        &mut self,
        source: &Source<'_>,
        joints: &[DAffine3],
        count: usize,
    ) -> Result<Vec<DAffine3>, Error> {
        let mut sums = vec![(DAffine3::ZERO, 0.0); count];
        for set in 0.. {
            let mut read = |semantic| self.attribute(source, semantic, &[4], Some(count));
            let (Some(numbers), Some(weights)) =
                (read(Semantic::Joints(set))?, read(Semantic::Weights(set))?)
            else {
                break;
            };
            for (vertex, (sum, total)) in sums.iter_mut().enumerate() {
                let weighted = numbers.get::<4>(vertex).into_iter().zip(weights.get::<4>(vertex));
                for (number, weight) in weighted.filter(|(_, weight)| *weight != 0.0) {
                    let joint = joints.get(number as usize).filter(|_| number.fract() == 0.0);
                    let Some(joint) = joint else {
                        let count = joints.len();
                        let problem = format!("there is no joint {number}: the skin has {count}");
                        return Err(self.fault(source.element, problem));
                    };
                    let weight = f64::from(weight);
                    sum.matrix3 += joint.matrix3 * weight;
                    sum.translation += joint.translation * weight;
                    *total += weight;
                }
            }
        }
        let mean = |(vertex, (sum, total)): (usize, (DAffine3, f64))| {
            if total > 0.0 {
                return Ok(DAffine3 {
                    matrix3: sum.matrix3 * total.recip(),
                    translation: sum.translation / total,
                });
            }
            let problem = format!("vertex {vertex} has no weight at a joint of its skin");
            Err(self.fault(source.element, problem))
        };
        sums.into_iter().enumerate().map(mean).collect()
    }
}

/// The converted values of an attribute, by vertex; none if the primitive lacks it.
fn converted<T, const N: usize>(
    values: Option<&Floats>,
    convert: impl Fn(usize, [f32; N]) -> T,
) -> impl Iterator<Item = T> {
    let finite = |v: [f32; N]| v.map(|x| if x.is_finite() { x } else { 0.0 });
    let count = values.map_or(0, Floats::count);
    (0..count).filter_map(move |i| Some(convert(i, finite(values?.get(i)))))
}

/// Triangles of a list, strip or fan, counter-clockwise.
fn triangles(mode: Mode, indices: &[u32]) -> Vec<[u32; 3]> {
    match mode {
        Mode::TriangleStrip => indices
            .windows(3)
            .enumerate()
            .map(|(i, t)| if i % 2 == 0 { [t[0], t[1], t[2]] } else { [t[1], t[0], t[2]] })
            .collect(),
        Mode::TriangleFan => indices.windows(2).skip(1).map(|t| [t[0], t[1], indices[0]]).collect(),
        // An incomplete triangle at the end is ignored.
        _ => indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]]).collect(),
    }
}
