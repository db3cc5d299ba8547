//! Passes faces to `tobj`, a bounded number at a time.

use std::collections::HashMap;
use std::fmt::Write as _;

use tobj::{LoadError, LoadOptions, Mesh};

use super::Corner;

/// Number of corners at which a block is full; it then takes about 10 MiB.
const CORNERS: usize = 1 << 14;

/// Faces of one material and smoothing group.
#[derive(Default)]
pub(super) struct Block {
    pub(super) material: u32,
    pub(super) group: u32,
    /// The corners of all faces.
    pub(super) corners: Vec<Corner>,
    /// OBJ text of the faces, with the positions, texture coordinates and normals that they use.
    text: String,
    /// Numbers of positions, texture coordinates and normals in the text, by their numbers in the file.
    numbers: [HashMap<u32, usize>; 3],
}

impl Block {
    pub(super) fn is_full(&self) -> bool {
        self.corners.len() >= CORNERS
    }

    /// Adds a face. `line` returns the statement of a position (0), texture coordinate (1) or normal (2), given
    /// its number in the file.
    pub(super) fn add(&mut self, face: &[Corner], line: impl Fn(usize, usize) -> String) {
        self.corners.extend(face);
        let mut statement = "f".to_owned();
        for corner in face {
            for (i, separator) in [' ', '/', '/'].into_iter().enumerate() {
                let number = corner.numbers[i];
                let next = self.numbers[i].len() + 1;
                let own = self.numbers[i].entry(number).or_insert_with(|| {
                    self.text += &line(i, number as usize);
                    next
                });
                let _ = write!(statement, "{separator}{own}");
            }
        }
        self.text += &statement;
        self.text.push('\n');
    }

    /// Parses the faces with `tobj`, which merges equal corners into one vertex.
    pub(super) fn read(&self) -> Result<Mesh, LoadError> {
        let options = LoadOptions { single_index: true, ..LoadOptions::default() };
        let no_library = |_: &_| Err(LoadError::OpenFileFailed);
        let (mut objects, _) = tobj::load_obj_buf(&mut self.text.as_bytes(), &options, no_library)?;
        Ok(objects.pop().map(|object| object.mesh).unwrap_or_default())
    }
}
