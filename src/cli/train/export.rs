//! The model as a file, in the dataset's own coordinates: some rows at a time, as it may be most of what there
//! is memory for.

use std::path::Path;

use crate::backend::pieces;
use crate::cli::failure::Failure;
use crate::dataset::normalise::Normalisation;
use crate::output::{Stop, write_atomically_from};
use crate::ply::{write_splat_header, write_splat_rows};
use crate::trainer::Trainer;
use crate::views::ViewSource;

/// Writes the model that is trained.
pub(super) fn export<V: ViewSource>(
    trainer: &mut Trainer<V>,
    normalisation: &Normalisation,
    path: &Path,
) -> Result<(), Failure> {
    let rows = trainer.backend().rows();
    let sh_degree = trainer.model_rows(0..0)?.sh_degree;
    write_atomically_from(path, |mut out| {
        write_splat_header(rows, sh_degree, &mut out)?;
        for piece in pieces(rows) {
            let scene = trainer.model_rows(piece).map_err(|error| Stop::Source(error.into()))?;
            write_splat_rows(&normalisation.model_to_world(scene), &mut out)?;
        }
        Ok(())
    })
}
