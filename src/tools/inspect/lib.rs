//! Inspection of trained models: pictures and depth, films along camera paths, comparison with other formats, and
//! limits on scores. Prints nothing.

mod animation;
mod fidelity;
mod film;
mod limits;
mod pictures;

pub use fidelity::Reference;
pub use film::{CameraRoute, Film, FilmError, FilmOptions, FilmSource};
pub use limits::{Limit, LimitError, Limits, Side, measured_values, mesh_values};
pub use pictures::{Channels, PictureFolder, file_names};
