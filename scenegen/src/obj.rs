use crate::{error::Error, mesh::Model};
use std::path::Path;
pub(crate) fn load(path: &Path) -> Result<Model, Error> {
    Err(Error::Empty { name: path.display().to_string() })
}
