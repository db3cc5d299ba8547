//! Exports the model that is being trained, in the dataset's own coordinates.

use std::path::Path;

use crate::cli::failure::Failure;
use crate::dataset::normalise::Normalisation;
use crate::export::{PLY, Shape};
use crate::trainer::Trainer;
use crate::views::ViewSource;

/// Writes the model to a PLY file.
pub(super) fn export<V: ViewSource>(
    trainer: &mut Trainer<V>,
    normalisation: &Normalisation,
    path: &Path,
) -> Result<(), Failure> {
    let rows = trainer.backend().rows();
    let sh_degree = trainer.model_rows(0..0)?.sh_degree;
    PLY.write_file(path, Shape { rows, sh_degree }, |piece| {
        Ok(normalisation.model_to_world(trainer.model_rows(piece)?))
    })
}
