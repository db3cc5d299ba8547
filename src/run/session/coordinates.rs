//! The coordinates of saved models, and measuring a model as its file holds it.

use super::Session;
use crate::failure::{Failure, notes};
use densify_core::gaussians::{Gaussians, ModelArray};
use densify_core::pieces::pieces;
use densify_data::models::{Coarseness, Coordinates, Frame};

impl Session<'_> {
    /// The coordinates of the file that is saved next, and their coarseness if it makes the file worse than the model.
    /// Tells the user once if world coordinates are too coarse.
    pub(super) fn choose_frame(&mut self) -> Result<(Frame, Option<Coarseness>), Failure> {
        let to_world = self.run.dataset.normalisation;
        let local = Frame::from_origin(to_world.local_origin());
        let coordinates = self.run.spec.output.coordinates;
        match coordinates {
            Coordinates::Local => return Ok((local, None)),
            Coordinates::Double => return Ok((Frame { is_double: true, ..local }, None)),
            Coordinates::Auto | Coordinates::World if !to_world.is_remote() => {
                return Ok((Frame::WORLD, None));
            }
            Coordinates::Auto | Coordinates::World => {}
        }
        let mut coarseness = Coarseness::default();
        let backend = self.run.trainer.backend();
        for piece in pieces(backend.rows()) {
            let world = to_world.world_from_model(backend.download_rows(piece)?, local.origin);
            coarseness.add(&world, to_world.centre.to_array(), 1.0 / to_world.scale);
        }
        if !coarseness.is_noted() {
            return Ok((Frame::WORLD, None));
        }
        let is_automatic = coordinates == Coordinates::Auto;
        if !std::mem::replace(&mut self.has_told_coordinates, true) {
            let spelling = self.observer.spelling();
            self.observer.say(format_args!(
                "{}",
                if is_automatic {
                    notes::saved_in_local(spelling, &coarseness, local.origin)
                } else {
                    format!("note: {}", notes::coarse(spelling, &coarseness, true))
                }
            ));
        }
        Ok(if is_automatic { (local, None) } else { (Frame::WORLD, Some(coarseness)) })
    }

    /// Rounds the means as in the saved file, if the rounding makes a difference, so that the quality of the file is
    /// measured. Returns the exact means, to be [restored](Self::restore_means).
    pub(super) fn round_means_as_saved(&mut self) -> Result<Option<Vec<f32>>, Failure> {
        if self.run.spec.output.coordinates != Coordinates::World
            || self.choose_frame()?.1.is_none()
        {
            return Ok(None);
        }
        let to_world = self.run.dataset.normalisation;
        let backend = self.run.trainer.backend();
        let mut exact = Vec::with_capacity(3 * backend.rows());
        for piece in pieces(backend.rows()) {
            let means = backend.download_array(ModelArray::Means, piece.clone())?;
            let mut rows = Gaussians::zeros(piece.len(), 0);
            rows.means.as_flattened_mut().copy_from_slice(&means);
            exact.extend(means);
            let rows = to_world.model_from_world(to_world.world_from_model(rows, [0.0; 3]));
            backend.upload_array(ModelArray::Means, piece, rows.means.as_flattened())?;
        }
        Ok(Some(exact))
    }

    /// Undoes [`round_means_as_saved`](Self::round_means_as_saved).
    pub(super) fn restore_means(&mut self, exact: Option<Vec<f32>>) -> Result<(), Failure> {
        let Some(exact) = exact else { return Ok(()) };
        let backend = self.run.trainer.backend();
        for piece in pieces(backend.rows()) {
            let means = &exact[3 * piece.start..3 * piece.end];
            backend.upload_array(ModelArray::Means, piece, means)?;
        }
        Ok(())
    }
}
