//! The interface of writers, which take a model in pieces, and the functions that drive them.

use std::io::{self, Write};
use std::ops::Range;
use std::path::Path;

use super::spatial_order::spatial_order;
use super::{
    Changes, Format, Frame, PLY, compress_formats, read_model, remove_sidecar, write_sidecar,
};
use crate::error::LoadError;
use densify_core::antialiasing::Antialiasing;
use densify_core::files::{FileError, WriteError, write_atomically, write_checked};
use densify_core::gaussians::Gaussians;
use densify_core::pieces::pieces;

/// Size of a model, and what a file states about all of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shape {
    /// Number of Gaussians.
    pub rows: usize,
    /// Spherical-harmonic degree, 0..=3.
    pub sh_degree: u8,
    /// Antialiasing with which the model was trained.
    pub antialiasing: Antialiasing,
    /// Frame of the coordinates.
    pub frame: Frame,
}

impl From<&Gaussians> for Shape {
    fn from(model: &Gaussians) -> Self {
        let Gaussians { sh_degree, antialiasing, origin, .. } = *model;
        Self { rows: model.len(), sh_degree, antialiasing, frame: Frame::from_origin(origin) }
    }
}

/// Writes one model to one file: [`begin`](Self::begin), then [`rows`](Self::rows) for each piece
/// in order, then [`finish`](Self::finish).
pub trait ModelWriter {
    /// Upper bound on the memory that the writer takes in addition to the piece it is given `[bytes]`. It is part of a
    /// run's memory ledger, so it must hold for every model of this shape.
    fn held_bytes(&self, shape: Shape) -> u64;

    /// True if the format packs consecutive Gaussians together, so that they should be neighbours in space. The file
    /// then has all Gaussians in spatial order.
    fn wants_spatial_order(&self) -> bool {
        false
    }

    /// True if the format stores values with less precision than `f32`, so that what is read back differs.
    fn is_lossy(&self) -> bool {
        true
    }

    /// True if files can state this antialiasing; if not, readers use another kernel.
    fn states_antialiasing(&self, _antialiasing: Antialiasing) -> bool {
        true
    }

    /// The same format with other trade-offs between size and accuracy, the most accurate first.
    fn variants(&self) -> &'static [Format] {
        &[]
    }

    /// True if files state the offset of local coordinates; if not, a [sidecar](super::sidecar_path) must.
    fn states_offset(&self) -> bool {
        false
    }

    /// True if files can hold coordinates in f64; if not, [`begin`](Self::begin) is never called for them.
    fn has_double(&self) -> bool {
        false
    }

    /// Writes what precedes the Gaussians.
    ///
    /// # Errors
    /// Those of `out`, and [`io::ErrorKind::InvalidInput`] where the format cannot hold the model.
    fn begin(&mut self, shape: Shape, out: &mut dyn Write) -> io::Result<()>;

    /// Takes the next Gaussians, some thousand at a time, in the dataset's own coordinates, measured from the origin of
    /// the [frame](Shape::frame).
    ///
    /// # Errors
    /// As [`begin`](Self::begin).
    fn rows(&mut self, rows: &Gaussians, out: &mut dyn Write) -> io::Result<()>;

    /// Writes what is still held and what follows the Gaussians.
    ///
    /// # Errors
    /// As [`begin`](Self::begin).
    fn finish(&mut self, out: &mut dyn Write) -> io::Result<()>;
}

/// True if a writer failed because its format cannot hold the model, and not because of the disk.
pub fn is_unfit(error: &io::Error) -> bool {
    error.raw_os_error().is_none() && error.kind() == io::ErrorKind::InvalidInput
}

/// The least exact of the [`compress_formats`] that holds a model; each is tried in the file `scratch`.
pub fn fitting_format(model: &Gaussians, scratch: &Path) -> &'static Format {
    let fits = |format: &&Format| {
        write_atomically(scratch, |out| format.write(model, out)).is_ok()
            && format.changes(model, scratch).is_ok_and(|changes| !changes.is_unfit())
    };
    compress_formats().into_iter().rev().find(fits).unwrap_or(PLY)
}

/// The error of a format that cannot hold the model.
pub(super) fn unfit(problem: impl Into<String>) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidInput, problem.into())
}

impl Format {
    /// Begins a file with a model of this shape. The caller passes all rows to the writer, then
    /// [finishes](ModelWriter::finish) it.
    ///
    /// # Errors
    /// Those of `out`, and [`io::ErrorKind::InvalidInput`] if densify does not write the format or the format cannot
    /// hold the model.
    pub fn open_writer(
        &self,
        shape: Shape,
        out: &mut dyn Write,
    ) -> io::Result<Box<dyn ModelWriter>> {
        let problem = || format!("densify does not write {}; choose another format", self.name);
        let mut writer = self.writer.map(|make| make()).ok_or_else(|| unfit(problem()))?;
        if shape.frame.is_double && !writer.has_double() {
            return Err(unfit(
                "only ply holds coordinates in f64; choose that format, or local coordinates",
            ));
        }
        writer.begin(shape, out)?;
        Ok(writer)
    }

    /// [`ModelWriter::held_bytes`] of this format; 0 if densify does not write it.
    pub fn held_bytes(&self, shape: Shape) -> u64 {
        self.writer.map_or(0, |make| make().held_bytes(shape))
    }

    /// [`ModelWriter::is_lossy`] of this format; false if densify does not write it.
    pub fn is_lossy(&self) -> bool {
        self.writer.is_some_and(|make| make().is_lossy())
    }

    /// [`ModelWriter::states_antialiasing`] of this format; true if densify does not write it.
    pub fn states_antialiasing(&self, antialiasing: Antialiasing) -> bool {
        self.writer.is_none_or(|make| make().states_antialiasing(antialiasing))
    }

    /// [`ModelWriter::variants`] of this format; none if densify does not write it.
    pub fn variants(&self) -> &'static [Self] {
        self.writer.map_or(&[], |make| make().variants())
    }

    /// Writes a model that is in memory as a whole, in the order that suits the format. The model's origin is lost
    /// unless the format [has a place](Self::states_offset) for it.
    ///
    /// # Errors
    /// Those of [`ModelWriter`].
    pub fn write(&self, model: &Gaussians, out: &mut dyn Write) -> io::Result<()> {
        self.write_in(Frame::from_origin(model.origin), model, out)
    }

    /// As [`write`](Self::write), for a frame with the origin of the model.
    ///
    /// # Errors
    /// Those of [`ModelWriter`].
    pub fn write_in(&self, frame: Frame, model: &Gaussians, out: &mut dyn Write) -> io::Result<()> {
        let mut writer = self.open_writer(Shape { frame, ..model.into() }, out)?;
        if writer.wants_spatial_order() {
            let order = spatial_order(model);
            for piece in pieces(model.len()) {
                writer.rows(&model.gather(&order[piece]), out)?;
            }
        } else {
            writer.rows(model, out)?;
        }
        writer.finish(out)
    }

    /// The changes to `model` in the file that [`write`](Self::write) made of it; none if the format is exact.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn changes(&self, model: &Gaussians, file: &Path) -> Result<Changes, LoadError> {
        let Some(writer) = self.writer.map(|make| make()).filter(|writer| writer.is_lossy()) else {
            return Ok(Changes::default());
        };
        let order = if writer.wants_spatial_order() {
            spatial_order(model)
        } else {
            (0..model.len()).collect()
        };
        Ok(Changes::measure(model, &order, &read_model(file)?.gaussians))
    }

    /// True if files of this format name the origin of their coordinates.
    pub fn states_offset(&self) -> bool {
        self.writer.is_some_and(|make| make().states_offset())
    }

    /// Does the same as [`write_checked`], and writes the sidecar if a file with this frame needs one. The sidecar of a
    /// previous file at `path` is replaced or removed.
    ///
    /// # Errors
    /// Those of [`write_checked`], and when the sidecar cannot be written or removed.
    pub fn write_checked<E: From<FileError>>(
        &self,
        path: &Path,
        frame: Frame,
        write: impl FnOnce(&mut dyn Write) -> Result<(), WriteError<E>>,
        check: impl FnOnce(&Path) -> Result<(), E>,
    ) -> Result<(), E> {
        let offset = frame.offset().filter(|_| !self.states_offset());
        write_checked(path, write, |written| {
            check(written)?;
            offset.map_or(Ok(()), |offset| Ok(write_sidecar(path, offset, written)?))
        })?;
        if offset.is_none() {
            remove_sidecar(path)?;
        }
        Ok(())
    }

    /// Writes a model that is in memory as a whole to a file that appears only when it is complete, with its sidecar if
    /// it needs one.
    ///
    /// # Errors
    /// Those of [`ModelWriter`] and [`write_atomically`].
    pub fn save(&self, model: &Gaussians, path: &Path) -> Result<(), FileError> {
        let frame = Frame::from_origin(model.origin);
        self.write_checked(path, frame, |out| Ok(self.write(model, out)?), |_| Ok(()))
    }

    /// Writes a model to a file that appears only when it is complete, with its sidecar if it needs one. `rows` is
    /// asked for one piece after the other, as a second copy of the model may not fit into memory; each piece has the
    /// origin of the frame.
    ///
    /// # Errors
    /// Those of `rows`, [`ModelWriter`] and [`write_checked`].
    pub fn write_file<E: From<FileError>>(
        &self,
        path: &Path,
        shape: Shape,
        mut rows: impl FnMut(Range<usize>) -> Result<Gaussians, E>,
    ) -> Result<(), E> {
        let write = |out: &mut dyn Write| {
            let mut writer = self.open_writer(shape, out)?;
            for piece in pieces(shape.rows) {
                writer.rows(&rows(piece).map_err(WriteError::Source)?, out)?;
            }
            Ok(writer.finish(out)?)
        };
        self.write_checked(path, shape.frame, write, |_| Ok(()))
    }
}
