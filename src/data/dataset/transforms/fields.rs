//! The fields of a frame and of the top level, with their types checked.

use std::fmt::Display;
use std::path::Path;

use serde_json::{Map, Value};

use super::super::LoadError;
use super::super::folders::Folders;
use super::super::frame_lists::{self, FrameLists};
use super::super::paths::DataPath;
use super::REMEDY;

/// The fields of one frame, with those at the top level as defaults.
pub(super) struct Fields<'a> {
    pub(super) path: &'a Path,
    /// Prefix of field names in messages that names the frame, such as `frames[3].`; empty at the top level.
    pub(super) place: String,
    pub(super) frame: Option<&'a Map<String, Value>>,
    pub(super) top: &'a Map<String, Value>,
}

impl<'a> Fields<'a> {
    /// The place of a field for messages: at the top level if it is only there, else in the frame.
    pub(super) fn full(&self, field: &str) -> String {
        if self.own(field).is_none() && self.inherited(field).is_some() {
            return field.to_owned();
        }
        format!("{}{field}", self.place)
    }

    pub(super) fn fault(&self, field: &str, problem: impl Display) -> LoadError {
        LoadError::malformed(self.path, self.full(field), problem, REMEDY)
    }

    /// A field of the frame itself, or of the top level if there is no frame.
    pub(super) fn own(&self, field: &str) -> Option<&'a Value> {
        self.frame.unwrap_or(self.top).get(field).filter(|value| !value.is_null())
    }

    pub(super) fn text(&self, field: &str) -> Result<Option<&'a str>, LoadError> {
        match self.own(field) {
            None => Ok(None),
            Some(Value::String(text)) => Ok(Some(text)),
            Some(_) => Err(self.fault(field, "it is not a string")),
        }
    }

    /// Reads the lists of frames in the file.
    pub(super) fn frame_lists(
        &self,
        folders: &Folders,
        lists: &mut FrameLists,
    ) -> Result<(), LoadError> {
        for (list, field) in frame_lists::FIELDS.into_iter().enumerate() {
            let Some(value) = self.own(field) else { continue };
            let fault = || self.fault(field, "it is not a list of file names");
            let names = value.as_array().ok_or_else(fault)?.iter();
            let named = |value: &'a Value| {
                let value = value.as_str().ok_or_else(fault)?;
                Ok(DataPath { file: self.path, field, value })
            };
            lists.add(folders, list, &names.map(named).collect::<Result<Vec<_>, LoadError>>()?)?;
        }
        Ok(())
    }

    pub(super) fn inherited(&self, field: &str) -> Option<&'a Value> {
        self.own(field).or_else(|| self.top.get(field)).filter(|value| !value.is_null())
    }

    pub(super) fn number(&self, field: &str) -> Result<Option<f64>, LoadError> {
        let Some(value) = self.inherited(field) else {
            return Ok(None);
        };
        value.as_f64().map(Some).ok_or_else(|| self.fault(field, "it is not a number"))
    }

    pub(super) fn side(&self, field: &str) -> Result<Option<u32>, LoadError> {
        let Some(value) = self.number(field)? else {
            return Ok(None);
        };
        if value >= 1.0 && value <= f64::from(u32::MAX) && value.fract().abs() < f64::EPSILON {
            return Ok(Some(value as u32));
        }
        Err(self.fault(field, format!("{value} px is not an image size")))
    }

    /// A field that is true or false, or 1 or 0; false if it is absent.
    pub(super) fn flag(&self, field: &str) -> Result<bool, LoadError> {
        match self.inherited(field) {
            None => Ok(false),
            Some(Value::Bool(value)) => Ok(*value),
            Some(value) if value.as_f64() == Some(0.0) => Ok(false),
            Some(value) if value.as_f64() == Some(1.0) => Ok(true),
            Some(value) => Err(self.fault(field, format!("{value} is neither true nor false"))),
        }
    }
}
