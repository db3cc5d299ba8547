//! Turns point records into positions and colours.

use glam::DVec3;

use super::Header;
use crate::points::PointCloud;

/// Place of red, green and blue in the records of the formats that have them `[bytes]`.
const COLOURS: [(u8, usize); 6] = [(2, 20), (3, 28), (5, 28), (7, 30), (8, 30), (10, 30)];
/// Colour of points that have none.
const GREY: u8 = 128;

/// Positions and colours of the records so far.
pub(super) struct Records {
    scale: DVec3,
    offset: DVec3,
    /// Place of the colour in a record, if there is one `[bytes]`.
    colour: Option<usize>,
    positions: Vec<DVec3>,
    /// Colours of 16 bits, unless the records have none. Shape: `[points]`.
    deep: Vec<[u16; 3]>,
}

impl Records {
    pub(super) fn new(header: &Header) -> Self {
        let colour = COLOURS.iter().find(|(known, _)| *known == header.format).map(|(_, at)| *at);
        Self {
            scale: header.scale,
            offset: header.offset,
            colour: colour.filter(|at| at + 6 <= header.record),
            positions: Vec::new(),
            deep: Vec::new(),
        }
    }

    /// Adds a record, which has the length that the header states.
    pub(super) fn push(&mut self, record: &[u8]) {
        let axis =
            |at: usize| f64::from(i32::from_le_bytes([0, 1, 2, 3].map(|byte| record[at + byte])));
        self.positions.push(DVec3::new(axis(0), axis(4), axis(8)) * self.scale + self.offset);
        if let Some(at) = self.colour {
            let channel = |at: usize| u16::from_le_bytes([record[at], record[at + 1]]);
            self.deep.push([0, 2, 4].map(|place| channel(at + place)));
        }
    }

    pub(super) fn finish(self) -> PointCloud {
        let Self { positions, deep, .. } = self;
        // Many programs write colours of 0 to 255 into the 16-bit fields.
        let shift = if deep.iter().flatten().all(|&value| value <= 255) { 0 } else { 8 };
        let mut colours: Vec<[u8; 3]> =
            deep.iter().map(|colour| colour.map(|value| (value >> shift) as u8)).collect();
        colours.resize(positions.len(), [GREY; 3]);
        PointCloud { positions, colours }
    }
}
