//! The frames that a file lists, and how each is used.

use serde_json::Value;

use super::super::LoadError;
use super::super::frame_lists;
use super::fields::Fields;
use super::{DeclaredSplit, SINGLE};

const MAX_FRAMES: usize = 1_000_000;
/// ScanNet++'s list of further frames, which are for tests.
const TEST_FRAMES: &str = "test_frames";

impl<'a> Fields<'a> {
    /// The frames, each with the source of its split. `self` is the top level.
    pub(super) fn frames(
        &self,
        declared: DeclaredSplit,
    ) -> Result<Vec<(Fields<'a>, DeclaredSplit)>, LoadError> {
        let frames = self.list("frames")?.ok_or_else(|| self.fault("frames", "it is missing"))?;
        let tests = self.list(TEST_FRAMES)?.unwrap_or_default();
        if frames.len() + tests.len() > MAX_FRAMES {
            return Err(self.fault("frames", "there are more than a million"));
        }
        let has_tests = !tests.is_empty();
        if has_tests {
            self.check_test_frames(declared)?;
        }
        let splits = match declared {
            DeclaredSplit::InLists if has_tests => [DeclaredSplit::Train, DeclaredSplit::Test],
            declared => [declared; 2],
        };
        let mut listed = Vec::with_capacity(frames.len() + tests.len());
        for ((field, list), split) in [("frames", frames), (TEST_FRAMES, tests)].iter().zip(splits)
        {
            for (index, entry) in list.iter().enumerate() {
                let Value::Object(entry) = entry else {
                    return Err(self.fault(&format!("{field}[{index}]"), "it is not an object"));
                };
                let place = format!("{field}[{index}].");
                listed.push((Fields { place, frame: Some(entry), ..*self }, split));
            }
        }
        Ok(listed)
    }

    /// Refuses a list of frames for tests beside another division into training and tests.
    fn check_test_frames(&self, declared: DeclaredSplit) -> Result<(), LoadError> {
        let other = if self.path.file_name().is_none_or(|name| name != SINGLE) {
            Some("transforms_test.json")
        } else if declared == DeclaredSplit::InLists {
            frame_lists::FIELDS.into_iter().find(|field| self.own(field).is_some())
        } else {
            None
        };
        other.map_or(Ok(()), |other| {
            let problem = format!("{other} divides the frames, too");
            Err(LoadError::malformed(self.path, TEST_FRAMES, problem, "remove one of the two"))
        })
    }

    fn list(&self, field: &str) -> Result<Option<&'a [Value]>, LoadError> {
        match self.own(field) {
            None => Ok(None),
            Some(Value::Array(list)) => Ok(Some(list)),
            Some(_) => Err(self.fault(field, "it is not a list of frames")),
        }
    }
}
