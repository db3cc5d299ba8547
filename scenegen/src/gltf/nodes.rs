//! Places the nodes of a scene, with their meshes, cameras and lights: hierarchies, skins, instances.

use glam::{DAffine3, DMat3, DMat4, DQuat, DVec3, Vec3};
use gltf::json;
use json::extensions::scene::khr_lights_punctual::Type as LightType;
use json::validation::Checked;

use serde_json::Value;

use super::accessors::Floats;
use super::{MAX_ITEMS, Reader, fault, remedy};
use crate::error::Error;
use crate::mesh::{FileCamera, Light, LightKind};

pub(super) const INSTANCING: &str = "EXT_mesh_gpu_instancing";
pub(super) const VISIBILITY: &str = "KHR_node_visibility";
/// Maximum depth of the node hierarchy.
const MAX_DEPTH: usize = 256;

/// Where a mesh is placed in the world.
pub(super) enum Places {
    /// A transform from the mesh to the world for each instance.
    Instances(Vec<DAffine3>),
    /// A transform from the mesh to the world for each joint of its skin.
    Joints(Vec<DAffine3>),
}

/// A node of the scene, with the transform from its coordinates to the world's.
struct Placed {
    index: usize,
    world: DAffine3,
    /// Number of nodes above this one.
    depth: usize,
    is_shown: bool,
}

impl Reader<'_> {
    /// Visits the nodes of the default scene.
    pub(super) fn scene(&mut self) -> Result<(), Error> {
        let root = self.root;
        let number = root.scene.map_or(0, |index| index.value());
        let roots: Vec<usize> = match root.scenes.get(number) {
            Some(scene) => scene.nodes.iter().map(json::Index::value).collect(),
            None if root.scene.is_some() => {
                return Err(self.fault(format!("scene {number}"), "there is no such scene"));
            }
            None => {
                // A file without scenes: its roots are all nodes without a parent.
                let mut is_child = vec![false; root.nodes.len()];
                for child in root.nodes.iter().flat_map(|node| node.children.iter().flatten()) {
                    if let Some(mark) = is_child.get_mut(child.value()) {
                        *mark = true;
                    }
                }
                (0..root.nodes.len()).filter(|&i| !is_child[i]).collect()
            }
        };
        let mut worlds = vec![None; root.nodes.len()];
        let mut order: Vec<Placed> = Vec::new();
        let at_top = |index: &usize| Placed {
            index: *index,
            world: DAffine3::IDENTITY,
            depth: 0,
            is_shown: true,
        };
        let mut open: Vec<Placed> = roots.iter().rev().map(at_top).collect();
        while let Some(Placed { index, world: parent, depth, is_shown }) = open.pop() {
            let name = format!("node {index}");
            let Some(node) = root.nodes.get(index) else {
                return Err(self.fault(name, "there is no such node"));
            };
            let world = parent * local(node);
            if worlds[index].replace(world).is_some() {
                return Err(self.fault(name, "it is its own ancestor or has two parents"));
            }
            if depth > MAX_DEPTH {
                return Err(self.fault(name, format!("it is more than {MAX_DEPTH} levels deep")));
            }
            if !world.is_finite() {
                return Err(self.fault(name, "its transform is not finite"));
            }
            let is_hidden = extension(node, VISIBILITY).is_some_and(|e| e["visible"] == false);
            let is_shown = is_shown && !is_hidden;
            let children = node.children.iter().flatten().rev().map(json::Index::value);
            open.extend(children.map(|index| Placed { index, world, depth: depth + 1, is_shown }));
            order.push(Placed { index, world, depth, is_shown });
        }
        order.iter().try_for_each(|placed| self.node(placed, &worlds))
    }

    fn node(
        &mut self,
        &Placed { index, ref world, is_shown, .. }: &Placed,
        worlds: &[Option<DAffine3>],
    ) -> Result<(), Error> {
        let (root, name) = (self.root, format!("node {index}"));
        let node = &root.nodes[index];
        if let Some(index) = node.mesh.map(|mesh| mesh.value()).filter(|_| is_shown) {
            let Some(mesh) = root.meshes.get(index) else {
                return Err(self.fault(name, format!("there is no mesh {index}")));
            };
            let places = match node.skin {
                Some(_) if extension(node, INSTANCING).is_some() => {
                    let feature = format!("{name}: {INSTANCING} of a mesh with a skin");
                    return Err(Error::unsupported(self.path, &feature, remedy(INSTANCING)));
                }
                Some(skin) => Places::Joints(self.joints(skin.value(), &name, worlds)?),
                None => Places::Instances(self.instances(node, &name, world)?),
            };
            let weights = node.weights.as_ref().or(mesh.weights.as_ref());
            for (number, primitive) in mesh.primitives.iter().enumerate() {
                let element = format!("mesh {index} primitive {number}");
                let weights = weights.map_or(&[][..], Vec::as_slice);
                self.primitive(primitive, &element, weights, &places)?;
            }
        }
        if let Some(index) = node.camera {
            self.camera(index.value(), &name, world)?;
        }
        let light = node.extensions.as_ref().and_then(|e| e.khr_lights_punctual.as_ref());
        if let Some(light) = light.filter(|_| is_shown) {
            self.light(light.light.value(), &name, world)?;
        }
        Ok(())
    }

    /// For each joint of a skin, the transform from the mesh to the world. The transform of the mesh's own node is
    /// ignored (glTF 2.0, 3.7.3.2).
    fn joints(
        &mut self,
        index: usize,
        node: &str,
        worlds: &[Option<DAffine3>],
    ) -> Result<Vec<DAffine3>, Error> {
        let name = format!("skin {index}");
        let Some(skin) = self.root.skins.get(index) else {
            return Err(self.fault(node, format!("there is no {name}")));
        };
        let binds = skin.inverse_bind_matrices;
        let binds =
            binds.map(|binds| self.buffers.floats(binds.value(), &[16], &name)).transpose()?;
        if let Some(found) = binds.as_ref().map(Floats::count).filter(|n| *n < skin.joints.len()) {
            let problem =
                format!("{} joints have {found} inverse bind matrices", skin.joints.len());
            return Err(self.fault(name, problem));
        }
        let joint = |(i, joint): (usize, &json::Index<json::Node>)| {
            let Some(world) = worlds.get(joint.value()).copied().flatten() else {
                let problem = format!("its joint, node {}, is not in the scene", joint.value());
                return Err(self.fault(&name, problem));
            };
            let bind = binds.as_ref().map(|binds| affine(&binds.get(i)));
            Ok(world * bind.unwrap_or(DAffine3::IDENTITY))
        };
        skin.joints.iter().enumerate().map(joint).collect()
    }

    /// The transforms from a mesh to the world: that of its node, or those of its instances.
    fn instances(
        &mut self,
        node: &json::Node,
        name: &str,
        world: &DAffine3,
    ) -> Result<Vec<DAffine3>, Error> {
        let Some(extension) = extension(node, INSTANCING) else { return Ok(vec![*world]) };
        let name = format!("{name} {INSTANCING}");
        let mut read = |key, size| {
            let Some(index) = extension["attributes"].get(key) else { return Ok(None) };
            match index.as_f64().filter(|index| index.fract() == 0.0 && *index >= 0.0) {
                Some(index) => self.buffers.floats(index as usize, &[size], &name).map(Some),
                None => Err(fault(self.path, &name, format!("its {key} is not an accessor"))),
            }
        };
        let all = [read("TRANSLATION", 3)?, read("ROTATION", 4)?, read("SCALE", 3)?];
        let mut counts = all.iter().flatten().map(Floats::count);
        // Other attributes do not move instances.
        let Some(count) = counts.next() else { return Ok(vec![*world]) };
        if counts.any(|other| other != count) || count > MAX_ITEMS {
            let problem = "its attributes differ in length, or have more than a million elements";
            return Err(self.fault(name, problem));
        }
        let [translations, rotations, scales] = &all;
        let three = |values: &Option<Floats>, i| values.as_ref().map(|values| values.get(i));
        let instance = |i| {
            let rotation = rotations.as_ref().map(|rotations| rotations.get(i));
            *world * transform(three(translations, i), rotation, three(scales, i))
        };
        Ok((0..count).map(instance).collect())
    }

    fn camera(&mut self, index: usize, name: &str, world: &DAffine3) -> Result<(), Error> {
        let Some(camera) = self.root.cameras.get(index) else {
            return Err(self.fault(name, format!("there is no camera {index}")));
        };
        let Some(perspective) = &camera.perspective else {
            self.model.notes.push(format!("camera {index} is ignored: it is orthographic"));
            return Ok(());
        };
        let yfov = f64::from(perspective.yfov);
        let m = world.matrix3;
        let right = m.x_axis.normalize_or_zero();
        let forward = (-m.z_axis).normalize_or_zero();
        let down = forward.cross(right).normalize_or_zero();
        let right = down.cross(forward);
        if !(yfov > 0.0 && yfov < std::f64::consts::PI) || right.length_squared() < 0.5 {
            let problem = "its field of view or its node's axes are invalid";
            return Err(self.fault(format!("camera {index}"), problem));
        }
        self.model.cameras.push(FileCamera {
            name: camera.name.clone().unwrap_or_else(|| format!("camera {index}")),
            world_from_camera: DMat3::from_cols(right, down, forward),
            centre: world.translation,
            yfov,
        });
        Ok(())
    }

    fn light(&mut self, index: usize, name: &str, world: &DAffine3) -> Result<(), Error> {
        let lights = self.root.extensions.as_ref().and_then(|e| e.khr_lights_punctual.as_ref());
        let Some(light) = lights.and_then(|lights| lights.lights.get(index)) else {
            return Err(self.fault(name, format!("there is no light {index}")));
        };
        let intensity = Vec3::from(light.color) * light.intensity;
        let element = format!("light {index}");
        if !(intensity.is_finite() && intensity.min_element() >= 0.0) {
            return Err(self.fault(element, "its intensity is negative or not finite"));
        }
        let direction = (-world.matrix3.z_axis).normalize_or(DVec3::NEG_Z);
        let position = world.translation;
        let kind = match light.type_ {
            Checked::Valid(LightType::Directional) => LightKind::Directional { direction },
            Checked::Valid(LightType::Point) => LightKind::Point { position },
            Checked::Valid(LightType::Spot) => {
                let (inner, outer) =
                    light.spot.as_ref().map_or((0.0, std::f32::consts::FRAC_PI_4), |s| {
                        (s.inner_cone_angle, s.outer_cone_angle)
                    });
                let (cos_inner, cos_outer) = (inner.cos(), outer.cos());
                LightKind::Spot { position, direction, cos_inner, cos_outer }
            }
            Checked::Invalid => return Err(self.fault(element, "its type is unknown")),
        };
        let range = light.range.map_or(f64::INFINITY, f64::from);
        let range = if range > 0.0 { range } else { f64::INFINITY };
        self.model.lights.push(Light { kind, intensity, range });
        Ok(())
    }
}

/// An extension of a node that has no type in the `gltf` crate.
fn extension<'a>(node: &'a json::Node, name: &str) -> Option<&'a Value> {
    node.extensions.as_ref()?.others.get(name)
}

/// The transform of a 4×4 matrix given by its columns.
fn affine(columns: &[f32; 16]) -> DAffine3 {
    DAffine3::from_mat4(DMat4::from_cols_array(&columns.map(f64::from)))
}

/// A node's own transform.
fn local(node: &json::Node) -> DAffine3 {
    match &node.matrix {
        Some(matrix) => affine(matrix),
        None => transform(node.translation, node.rotation.map(|rotation| rotation.0), node.scale),
    }
}

fn transform(
    translation: Option<[f32; 3]>,
    rotation: Option<[f32; 4]>,
    scale: Option<[f32; 3]>,
) -> DAffine3 {
    let vector =
        |v: Option<[f32; 3]>, default| v.map_or(default, |v| DVec3::from(v.map(f64::from)));
    let rotation = rotation.map_or(DQuat::IDENTITY, |q| {
        let q = DQuat::from_array(q.map(f64::from));
        if q.length_squared() > 0.0 { q.normalize() } else { DQuat::IDENTITY }
    });
    let (scale, translation) = (vector(scale, DVec3::ONE), vector(translation, DVec3::ZERO));
    DAffine3::from_scale_rotation_translation(scale, rotation, translation)
}
