//! In place of the measurements where a program is built without the feature `scenegen`: no surface is known.

use super::{Geometry, KnownScene};
use crate::backend::Backend;
use crate::evaluate::EvaluateError;
use crate::views::ViewSource;

/// Cannot be called, as there is no known scene.
#[expect(clippy::missing_errors_doc, reason = "it cannot be called")]
pub fn measure(
    _: &mut dyn Backend,
    ground: &KnownScene<'_>,
    _: &impl ViewSource,
    _: &impl ViewSource,
) -> Result<Geometry, EvaluateError> {
    match *ground.truth {}
}
