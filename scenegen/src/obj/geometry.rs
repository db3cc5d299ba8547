//! Checks the statements of an OBJ file and rewrites those that `tobj` would misread.

use std::cell::RefCell;
use std::collections::VecDeque;

use tobj::MTLLoadResult;

use super::materials::Materials;
use super::statements::{Statement, shortened};
use crate::error::Error;

/// Most triangles of a file.
const MAX_TRIANGLES: usize = 1 << 26;
/// Faces after which `tobj` is told that a new object begins: until it has read all of an object, it
/// needs about 100 bytes for each face.
const OBJECT_FACES: usize = 1 << 17;
/// The first lines of every file. Where only some corners of a face have texture coordinates or
/// normals, the others refer to these: `tobj` would mix them up.
pub(super) const PLACEHOLDERS: &[u8] = b"vt 0 1\nvn 0 0 0\n";

/// A corner's indices of position, texture coordinates and normal, counted from 1; 0 is none.
type Corner = [u32; 3];

/// What all faces of an object have in common: the smoothing group (0 is none; corners with normals
/// need none), and whether they have texture coordinates and normals.
type FaceKind = (u32, bool, bool);

/// The state of a file while its statements are checked. Faces are handed on in objects of one kind
/// that are named after their smoothing group.
pub(super) struct Geometry<'a> {
    pub(super) materials: Materials,
    /// Libraries for `tobj` to take over.
    libraries: &'a RefCell<VecDeque<MTLLoadResult>>,
    /// Positions, texture coordinates and normals so far.
    counts: [usize; 3],
    triangles: usize,
    /// Smoothing group of the faces to come; 0 is none.
    group: u32,
    /// Kind and number of the current object's faces.
    object: (FaceKind, usize),
    /// Position indices of all corners in smoothing groups.
    pub(super) smooth_corners: Vec<u32>,
}

impl<'a> Geometry<'a> {
    pub(super) fn new(
        materials: Materials,
        libraries: &'a RefCell<VecDeque<MTLLoadResult>>,
    ) -> Self {
        Self {
            materials,
            libraries,
            counts: [0; 3],
            triangles: 0,
            group: 0,
            object: ((0, false, false), 0),
            smooth_corners: Vec::new(),
        }
    }

    /// Returns the lines that `tobj` reads in place of a statement.
    pub(super) fn check(&mut self, statement: Statement<'_>) -> Result<String, Error> {
        match statement.key {
            "v" => self.vertex(statement),
            "vt" => {
                self.counts[1] += 1;
                // v may be missing.
                Ok(format!("vt {} 0\n", statement.value()))
            }
            "vn" => {
                self.counts[2] += 1;
                Ok(format!("vn {}\n", statement.value()))
            }
            "f" => self.face(statement),
            "s" => {
                self.group = match statement.value() {
                    "off" | "" => 0,
                    "on" => 1,
                    word => word.parse().map_err(|_| {
                        statement.fault(format!("{:?} is not a smoothing group", shortened(word)))
                    })?,
                };
                Ok(String::new())
            }
            "usemtl" => {
                self.materials.note_missing(statement.value());
                Ok(format!("usemtl {}\n", statement.value()))
            }
            "mtllib" => {
                let read = self.materials.read_libraries(statement)?;
                let lines = "mtllib read\n".repeat(read.len());
                self.libraries.borrow_mut().extend(read.into_iter().map(Ok));
                Ok(lines)
            }
            // Lines, points, groups and curves: nothing to render.
            _ => Ok(String::new()),
        }
    }

    fn vertex(&mut self, statement: Statement<'_>) -> Result<String, Error> {
        let words: Vec<&str> = statement.words().collect();
        let vertex = self.counts[0] + 1;
        for (i, word) in words.iter().enumerate() {
            match word.parse::<f64>() {
                Ok(value) if i >= 3 || value.is_finite() => {}
                Ok(_) => return Err(statement.fault(format!("vertex {vertex} is not finite"))),
                Err(_) => {
                    let problem = format!("{:?} is not a number", shortened(word));
                    return Err(statement.fault(problem));
                }
            }
        }
        // x y z r g b, or x y z w r g b. `tobj` wants a colour for all vertices or none.
        let colour = match words.len() {
            6 | 7 => &words[words.len() - 3..],
            _ => &["1"; 3],
        };
        self.counts[0] = vertex;
        let position = &words[..words.len().min(3)];
        Ok(format!("v {} {}\n", position.join(" "), colour.join(" ")))
    }

    fn face(&mut self, statement: Statement<'_>) -> Result<String, Error> {
        let corners: Vec<Corner> =
            statement.words().map(|word| self.corner(statement, word)).collect::<Result<_, _>>()?;
        // Points and lines written as faces.
        if corners.len() < 3 {
            return Ok(String::new());
        }
        self.triangles += corners.len() - 2;
        if self.triangles > MAX_TRIANGLES {
            return Err(statement.fault("the file has more than 2^26 triangles"));
        }
        let [has_uvs, has_normals] = [1, 2].map(|i| corners.iter().any(|corner| corner[i] > 0));
        let group = if has_normals { 0 } else { self.group };
        let kind = (group, has_uvs, has_normals);
        let mut lines = String::new();
        if self.object.0 != kind || self.object.1.is_multiple_of(OBJECT_FACES) {
            self.object = (kind, 0);
            lines = format!("o {group}\n");
        }
        self.object.1 += 1;
        lines.push('f');
        for [v, uv, normal] in corners {
            if group > 0 {
                self.smooth_corners.push(v);
            }
            // The placeholders are the first.
            let field = |has: bool, i: u32| {
                if has { (u64::from(i) + 1).to_string() } else { String::new() }
            };
            lines += &format!(" {v}/{}/{}", field(has_uvs, uv), field(has_normals, normal));
        }
        lines.push('\n');
        Ok(lines)
    }

    fn corner(&self, statement: Statement<'_>, word: &str) -> Result<Corner, Error> {
        let mut corner = [0; 3];
        let fields = corner.iter_mut().zip(self.counts).zip(["vertex", "texture", "normal"]);
        for (((index, count), what), text) in fields.zip(word.split('/')) {
            if text.is_empty() {
                continue;
            }
            let value: i64 = text.parse().map_err(|_| {
                statement.fault(format!("{:?} is not a {what} index", shortened(text)))
            })?;
            // Negative ones count back from the last.
            let found = if value < 0 { count as i64 + 1 + value } else { value };
            *index = u32::try_from(found)
                .ok()
                .filter(|&found| (1..=count).contains(&(found as usize)))
                .ok_or_else(|| statement.fault(format!("{what} index {value} of {count}")))?;
        }
        if corner[0] == 0 {
            return Err(statement.fault("a corner has no vertex index"));
        }
        Ok(corner)
    }
}
