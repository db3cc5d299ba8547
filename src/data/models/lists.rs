//! Files that list models instead of being one: streamed SOG, and tilesets of 3D Tiles.

use std::path::Path;

use serde_json::Value;

use crate::error::LoadError;
use densify_core::files::one_line;

/// Name of the list in a folder of streamed SOG.
pub(super) const STREAMED: &str = "lod-meta.json";

/// Returns true if an archive with these files holds a streamed SOG.
pub(crate) fn is_streamed<N: AsRef<str>>(names: &[N]) -> bool {
    let file = |name: &str| name.rsplit('/').next() == Some(STREAMED);
    names.iter().map(AsRef::as_ref).any(|name| file(name) && !name.starts_with("__MACOSX/"))
}

/// The error for an archive of which [`is_streamed`] is true.
pub(super) fn refusal_of_archive(path: &Path) -> LoadError {
    LoadError::Data(format!(
        "{} is a streamed SOG in a ZIP archive: a list ({STREAMED}) of models in several levels of detail; unpack it, \
         and name one of the meta.json files that the list names",
        path.display()
    ))
}

/// The error for a JSON file that lists models; `None` for other files.
pub(super) fn refusal(path: &Path, text: &str) -> Option<LoadError> {
    // The whole text is parsed only if it may be a list.
    if !["\"lodLevels\"", "\"geometricError\""].iter().any(|key| text.contains(key)) {
        return None;
    }
    let json: Value = serde_json::from_str(text).ok()?;
    let path = path.display();
    if json.get("lodLevels").is_some() {
        return Some(LoadError::Data(format!(
            "{path} is a list of models in several levels of detail; name one of the meta.json files that it lists"
        )));
    }
    let root = json.get("root").filter(|_| json.get("geometricError").is_some())?;
    let name = content(root).map(|uri| one_line(&uri.chars().take(200).collect::<String>()));
    let file = name.map_or("one of the files that it lists".to_owned(), |name| {
        format!("a file that it lists, such as {name}")
    });
    Some(LoadError::Data(format!("{path} is a tileset (3D Tiles), not a model; name {file}")))
}

/// The first content of a tile or of the tiles below it (3D Tiles 1.1; `url` in versions before 1.0).
fn content(tile: &Value) -> Option<&str> {
    let list = |key: &str| tile.get(key).and_then(Value::as_array).into_iter().flatten();
    let mut contents = tile.get("content").into_iter().chain(list("contents"));
    let own = contents.find_map(|content| content.get("uri").or(content.get("url"))?.as_str());
    own.or_else(|| list("children").find_map(content))
}
