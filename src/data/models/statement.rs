//! Statements about a model's antialiasing in files.
//!
//! | file | statement |
//! |---|---|
//! | PLY of densify | `comment antialiasing 0.3`, and `comment antialiased 1` for other programs |
//! | PLY of Brush | `comment SplatRenderMode: mip`, with κ = 0.1 if it also says `Exported from Brush` |
//! | PLY of Postshot | `comment antialiased 1` (splat-transform `read-ply.ts`: case is ignored, the last counts) |
//! | PLY of Mip-Splatting | property `filter_3D`, whose models have κ = 0.1 |
//! | SPZ | bit 0 of the header's flags |
//! | SOG | `"model": "antialiased"`, formerly `"antialias": true`; densify adds κ |
//! | glTF | nothing; densify writes `extras` |
//!
//! The PLY of the original trainer says nothing. κ is the variance of the kernel `[px²]`; where it is not stated it is
//! 0.3, except for Brush and Mip-Splatting.

use std::path::Path;

use serde_json::Value;

use crate::error::LoadError;
use densify_core::antialiasing::Antialiasing;

/// Key of κ in comments of PLY, and in the JSON of SOG (`asset`) and glTF (`extras`).
pub(super) const KERNEL: &str = "antialiasing";

/// Lines of a PLY header that state an antialiasing; empty for none.
pub(super) fn comments(antialiasing: Antialiasing) -> String {
    if antialiasing.is_on() {
        format!("comment {KERNEL} {antialiasing}\ncomment antialiased 1\n")
    } else {
        String::new()
    }
}

/// The antialiasing that the comments of a PLY header state, and a sentence on it unless densify wrote it.
///
/// # Errors
/// When densify's own comment states an unknown kernel.
pub(super) fn stated_in_comments(
    path: &Path,
    comments: &[String],
) -> Result<(Antialiasing, Option<String>), LoadError> {
    let (mut own, mut other) = (None, None);
    let is_of_brush = comments.iter().any(|line| line.starts_with("Exported from Brush"));
    for comment in comments {
        let lower = comment.to_lowercase();
        let words: Vec<&str> = lower.split_whitespace().collect();
        match words[..] {
            [KERNEL, kernel] => {
                own = Some(parse_kernel(path, &format!("comment {comment:?}"), kernel)?);
            }
            ["splatrendermode:", mode] => other = Some((mode == "mip", comment)),
            ["antialiased", number] => other = Some((number == "1", comment)),
            _ => {}
        }
    }
    Ok(match (own, other) {
        (Some(own), _) => (own, None),
        (None, Some((true, comment))) => {
            let kind = if is_of_brush { Antialiasing::Narrow } else { Antialiasing::Wide };
            (kind, Some(note(kind, &format!("`{comment}`"))))
        }
        (None, _) => (Antialiasing::None, None),
    })
}

/// The antialiasing that densify has stated in `holder`, an object of a JSON file.
///
/// # Errors
/// When the stated kernel is unknown.
pub(super) fn stated_in_json(
    path: &Path,
    place: &str,
    holder: &Value,
) -> Result<Option<Antialiasing>, LoadError> {
    let Some(stated) = holder.get(KERNEL) else { return Ok(None) };
    parse_kernel(path, &format!("{place}.{KERNEL}"), stated.as_str().unwrap_or_default()).map(Some)
}

fn parse_kernel(path: &Path, field: &str, kernel: &str) -> Result<Antialiasing, LoadError> {
    let problem = "the kernel is unknown; 0.3, 0.1 and none are possible";
    kernel.parse().map_err(|_| LoadError::damaged(path, field, problem))
}

/// A sentence on an antialiasing that a file states without its kernel.
pub(super) fn note(antialiasing: Antialiasing, statement: &str) -> String {
    let why = match antialiasing {
        Antialiasing::Narrow => "as the program that wrote it renders",
        Antialiasing::None | Antialiasing::Wide => "as most programs render",
    };
    format!("antialiased ({statement}), with a kernel of {antialiasing} px², {why}")
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn comments_of_other_programs_are_understood() {
        use Antialiasing::{Narrow, None, Wide};
        for (comments, expected, is_noted) in [
            (&["x"][..], None, false),
            (&["SplatRenderMode: mip"], Wide, true),
            (&["Exported from Brush 0.3", "SplatRenderMode: mip"], Narrow, true),
            (&["SplatRenderMode: mip", "Exported from Brush"], Narrow, true),
            (&["Exported from Brush", "SplatRenderMode: default"], None, false),
            (&["Exported from Brush"], None, false),
            (&["antialiased 1"], Wide, true),
            (&["Antialiased 1"], Wide, true),
            (&["antialiased 1", "antialiased 0"], None, false),
            (&["antialiasing 0.1", "antialiased 1"], Narrow, false),
            (&["antialiasing none", "antialiased 1"], None, false),
        ] {
            let comments: Vec<String> = comments.iter().map(|&text| text.to_owned()).collect();
            let (found, note) = stated_in_comments(Path::new("x.ply"), &comments).unwrap();
            assert_eq!((found, note.is_some()), (expected, is_noted), "{comments:?}");
        }
        let unknown = stated_in_comments(Path::new("x.ply"), &["antialiasing 0.7".to_owned()]);
        let message = unknown.unwrap_err().to_string();
        assert!(message.contains("x.ply") && message.contains("0.7"), "{message}");
    }

    #[test]
    fn an_unknown_kernel_in_json_is_refused() {
        let found = |json: Value| stated_in_json(Path::new("x.glb"), "extras", &json);
        assert_eq!(found(json!({})).unwrap(), None);
        assert_eq!(found(json!({"antialiasing": "0.1"})).unwrap(), Some(Antialiasing::Narrow));
        for unknown in [json!("0.7"), json!(0.3), json!(null)] {
            let message = found(json!({"antialiasing": unknown})).unwrap_err().to_string();
            assert!(
                message.contains("x.glb") && message.contains("extras.antialiasing"),
                "{message}"
            );
        }
    }
}
