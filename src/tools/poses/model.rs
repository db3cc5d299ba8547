//! A reconstruction as COLMAP stores it in binary files: little endian, no padding, counts first.
//!
//! The engine's files are not trusted: every length, number and reference is checked.

use std::collections::HashSet;
use std::io::{self, Write};
use std::path::Path;

use glam::{DQuat, DVec3};

/// Names of the three files.
pub(crate) const FILES: [&str; 3] = ["cameras.bin", "images.bin", "points3D.bin"];
/// Number of parameters of each camera model, by COLMAP's number for it.
const PARAMETERS: [usize; 11] = [3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12];
/// Observation that belongs to no point.
const NO_POINT: u64 = u64::MAX;
const TRUNCATED: &str = "it ends too early";

/// A camera without its pose.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Camera {
    pub(crate) id: u32,
    pub(crate) model: u32,
    /// Width and height `[px]`.
    pub(crate) size: [u64; 2],
    pub(crate) parameters: Vec<f64>,
}

/// A photograph with its pose.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Image {
    pub(crate) id: u32,
    pub(crate) name: String,
    /// Rotation of `camera_from_world`.
    pub(crate) rotation: DQuat,
    /// Translation of `camera_from_world`.
    pub(crate) translation: DVec3,
    pub(crate) camera: u32,
    /// Pixel (x, y) and point of each observation; [`NO_POINT`] without one.
    pub(crate) observations: Vec<([f64; 2], u64)>,
}

impl Image {
    /// The camera's centre in the world.
    pub(crate) fn centre(&self) -> DVec3 {
        -(self.rotation.inverse() * self.translation)
    }

    /// Number of points that the photograph shows.
    pub(crate) fn points(&self) -> usize {
        self.observations.iter().filter(|(_, point)| *point != NO_POINT).count()
    }
}

/// A triangulated point.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Point {
    pub(crate) id: u64,
    pub(crate) position: DVec3,
    pub(crate) colour: [u8; 3],
    /// Mean reprojection error `[px]`.
    pub(crate) error: f64,
    /// Photograph and index of the observation in it.
    pub(crate) track: Vec<(u32, u32)>,
}

/// A reconstruction.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Model {
    pub(crate) cameras: Vec<Camera>,
    pub(crate) images: Vec<Image>,
    pub(crate) points: Vec<Point>,
}

impl Model {
    /// Reads the three files.
    ///
    /// # Errors
    /// The name of a file and what is wrong with it.
    pub(crate) fn read(folder: &Path) -> Result<Self, (&'static str, String)> {
        let part = |name: &'static str| {
            std::fs::read(folder.join(name)).map_err(|error| (name, error.to_string()))
        };
        let [cameras, images, points] = FILES;
        let model = Self {
            cameras: records(&part(cameras)?, camera).map_err(|problem| (cameras, problem))?,
            images: records(&part(images)?, image).map_err(|problem| (images, problem))?,
            points: records(&part(points)?, point).map_err(|problem| (points, problem))?,
        };
        model.check().map_err(|problem| (images, problem))?;
        Ok(model)
    }

    /// Checks numbers and references between the files.
    fn check(&self) -> Result<(), String> {
        let cameras: HashSet<u32> = self.cameras.iter().map(|camera| camera.id).collect();
        let images: HashSet<u32> = self.images.iter().map(|image| image.id).collect();
        let names: HashSet<&str> = self.images.iter().map(|image| &*image.name).collect();
        if images.len() != self.images.len() || names.len() != self.images.len() {
            return Err("a photograph appears twice".to_owned());
        }
        for Image { name, camera, rotation, translation, .. } in &self.images {
            if !cameras.contains(camera) {
                return Err(format!("{name} has the camera {camera}, which does not exist"));
            }
            if !translation.is_finite() || !rotation.is_finite() || !rotation.is_normalized() {
                return Err(format!("the pose of {name} is no rotation and translation"));
            }
        }
        let is_sound = |point: &Point| {
            point.position.is_finite() && point.track.iter().all(|(id, _)| images.contains(id))
        };
        match self.points.iter().find(|point| !is_sound(point)) {
            Some(point) => {
                Err(format!("the point {} is not finite, or has an unknown photograph", point.id))
            }
            None => Ok(()),
        }
    }

    /// Keeps the photographs for which `keep` holds, and points that at least two of these show.
    pub(crate) fn retain(&mut self, keep: impl Fn(&Image) -> bool) {
        self.images.retain(|image| keep(image));
        let images: HashSet<u32> = self.images.iter().map(|image| image.id).collect();
        for point in &mut self.points {
            point.track.retain(|(image, _)| images.contains(image));
        }
        self.points.retain(|point| point.track.len() >= 2);
        let points: HashSet<u64> = self.points.iter().map(|point| point.id).collect();
        for (_, point) in self.images.iter_mut().flat_map(|image| &mut image.observations) {
            if !points.contains(point) {
                *point = NO_POINT;
            }
        }
        let used: HashSet<u32> = self.images.iter().map(|image| image.camera).collect();
        self.cameras.retain(|camera| used.contains(&camera.id));
    }

    /// Turns the world.
    pub(crate) fn turn(&mut self, new_from_old: DQuat) {
        for image in &mut self.images {
            image.rotation = (image.rotation * new_from_old.inverse()).normalize();
        }
        for point in &mut self.points {
            point.position = new_from_old * point.position;
        }
    }

    /// Writes one of the [`FILES`].
    pub(crate) fn write(&self, name: &str, out: &mut dyn Write) -> io::Result<()> {
        let count =
            |out: &mut dyn Write, count: usize| out.write_all(&(count as u64).to_le_bytes());
        let floats = |out: &mut dyn Write, values: &[f64]| {
            values.iter().try_for_each(|value| out.write_all(&value.to_le_bytes()))
        };
        if name == FILES[0] {
            count(out, self.cameras.len())?;
            for camera in &self.cameras {
                out.write_all(&camera.id.to_le_bytes())?;
                out.write_all(&camera.model.to_le_bytes())?;
                camera.size.iter().try_for_each(|side| out.write_all(&side.to_le_bytes()))?;
                floats(out, &camera.parameters)?;
            }
        } else if name == FILES[1] {
            count(out, self.images.len())?;
            for image in &self.images {
                let (q, t) = (image.rotation, image.translation);
                out.write_all(&image.id.to_le_bytes())?;
                floats(out, &[q.w, q.x, q.y, q.z, t.x, t.y, t.z])?;
                out.write_all(&image.camera.to_le_bytes())?;
                out.write_all(image.name.as_bytes())?;
                out.write_all(&[0])?;
                count(out, image.observations.len())?;
                for (pixel, point) in &image.observations {
                    floats(out, pixel)?;
                    out.write_all(&point.to_le_bytes())?;
                }
            }
        } else {
            count(out, self.points.len())?;
            for point in &self.points {
                out.write_all(&point.id.to_le_bytes())?;
                floats(out, &point.position.to_array())?;
                out.write_all(&point.colour)?;
                floats(out, &[point.error])?;
                count(out, point.track.len())?;
                for (image, observation) in &point.track {
                    out.write_all(&image.to_le_bytes())?;
                    out.write_all(&observation.to_le_bytes())?;
                }
            }
        }
        Ok(())
    }
}

/// The unread rest of a file.
struct Bytes<'a>(&'a [u8]);

impl Bytes<'_> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let (first, rest) = self.0.split_first_chunk::<N>().ok_or(TRUNCATED)?;
        self.0 = rest;
        Ok(*first)
    }

    fn u32(&mut self) -> Result<u32, String> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, String> {
        self.take().map(u64::from_le_bytes)
    }

    fn f64(&mut self) -> Result<f64, String> {
        self.take().map(f64::from_le_bytes)
    }

    fn vector(&mut self) -> Result<DVec3, String> {
        Ok(DVec3::new(self.f64()?, self.f64()?, self.f64()?))
    }

    /// Reads a count, and then so many items. Nothing is allocated for items that the file is too short for.
    fn items<T>(
        &mut self,
        mut item: impl FnMut(&mut Self) -> Result<T, String>,
    ) -> Result<Vec<T>, String> {
        let count = self.u64()?;
        let mut items = Vec::new();
        for _ in 0..count {
            items.push(item(self)?);
        }
        Ok(items)
    }

    fn text(&mut self) -> Result<String, String> {
        let end = self.0.iter().position(|byte| *byte == 0).ok_or(TRUNCATED)?;
        let text = String::from_utf8_lossy(&self.0[..end]).into_owned();
        self.0 = &self.0[end + 1..];
        Ok(text)
    }
}

/// Reads a whole file of records.
fn records<T>(
    file: &[u8],
    record: impl Fn(&mut Bytes<'_>) -> Result<T, String>,
) -> Result<Vec<T>, String> {
    let mut bytes = Bytes(file);
    let all = bytes.items(record)?;
    if bytes.0.is_empty() { Ok(all) } else { Err(format!("{} bytes are left over", bytes.0.len())) }
}

fn camera(bytes: &mut Bytes<'_>) -> Result<Camera, String> {
    let (id, model) = (bytes.u32()?, bytes.u32()?);
    let size = [bytes.u64()?, bytes.u64()?];
    let count = PARAMETERS
        .get(model as usize)
        .ok_or_else(|| format!("the camera model {model} is not known"))?;
    let parameters = (0..*count).map(|_| bytes.f64()).collect::<Result<Vec<f64>, _>>()?;
    if parameters.iter().any(|value| !value.is_finite()) || parameters[0] <= 0.0 {
        return Err(format!("the camera {id} has the parameters {parameters:?}"));
    }
    Ok(Camera { id, model, size, parameters })
}

fn image(bytes: &mut Bytes<'_>) -> Result<Image, String> {
    let id = bytes.u32()?;
    let (w, vector) = (bytes.f64()?, bytes.vector()?);
    let rotation = DQuat::from_xyzw(vector.x, vector.y, vector.z, w);
    let (translation, camera, name) = (bytes.vector()?, bytes.u32()?, bytes.text()?);
    let observations = bytes.items(|bytes| Ok(([bytes.f64()?, bytes.f64()?], bytes.u64()?)))?;
    Ok(Image { id, name, rotation, translation, camera, observations })
}

fn point(bytes: &mut Bytes<'_>) -> Result<Point, String> {
    let (id, position) = (bytes.u64()?, bytes.vector()?);
    let (colour, error) = (bytes.take()?, bytes.f64()?);
    let track = bytes.items(|bytes| Ok((bytes.u32()?, bytes.u32()?)))?;
    Ok(Point { id, position, colour, error, track })
}
