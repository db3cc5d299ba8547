//! What the subcommands share that run `train` many times: calls in processes of their own, records of
//! what is finished, names of scenes, paired differences.

mod call;
mod difference;
mod journal;

use std::path::PathBuf;

pub(super) use call::{Call, Summary, common, has_geometry, in_run};
pub(super) use difference::Difference;
pub(super) use journal::{Entry, Records};

use crate::dataset::builtin;
use crate::failure::Failure;

/// A short name for each scene: its folder's, or that of the built-in scene.
pub(super) fn labels(scenes: &[PathBuf]) -> Result<Vec<String>, Failure> {
    let mut labels = Vec::new();
    for scene in scenes {
        if let Some(name) = builtin::name(scene) {
            labels.push(unlike(&labels, name.to_owned())?);
            continue;
        }
        let whole = std::fs::canonicalize(scene).map_err(|e| {
            Failure::input(format!("{}: {e}; name the scene's folder", scene.display()))
        })?;
        let name = whole.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let name = name.replace(|c: char| !c.is_ascii_alphanumeric() && c != '.', "-");
        labels.push(unlike(&labels, name)?);
    }
    Ok(labels)
}

/// The name, if it is none of those that are taken.
fn unlike(taken: &[String], name: String) -> Result<String, Failure> {
    if taken.contains(&name) {
        return Err(Failure::input(format!(
            "two scenes are called {name}; take them in two calls, or rename one folder"
        )));
    }
    Ok(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn built_in_scenes_go_by_their_names() {
        let paths = ["scene:table", "scene:thin"].map(PathBuf::from);
        assert_eq!(labels(&paths).ok(), Some(vec!["table".to_owned(), "thin".to_owned()]));
        let twice = ["scene:table", "scene:table"].map(PathBuf::from);
        assert!(labels(&twice).is_err_and(|failure| failure.message.contains("table")));
    }
}
