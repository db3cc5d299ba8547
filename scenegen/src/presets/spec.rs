//! Parses the name and optional size of a built-in scene: `room`, `town:4`.

use std::fmt;
use std::str::FromStr;

use super::{Build, PRESETS, Preset, Staging};
use crate::error::Error;

/// A built-in scene and its size. It is printed in the form that is parsed, without the size if that is the default.
#[derive(Debug, Clone, Copy)]
pub struct PresetSpec {
    preset: Preset,
    size: Option<u32>,
}

impl PresetSpec {
    /// Builds the scene. Only scenes with a size depend on the seed.
    pub(crate) fn build(&self, seed: u64) -> Staging {
        match self.preset.build {
            Build::Fixed(build) => build(),
            Build::Sized { default, build, .. } => build(self.size.unwrap_or(default), seed),
        }
    }
}

impl FromStr for PresetSpec {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self, Error> {
        let (name, size) = text.split_once(':').map_or((text, None), |(n, s)| (n, Some(s)));
        let Some(&preset) = PRESETS.iter().find(|preset| preset.name == name) else {
            let known = PRESETS.map(|preset| preset.name).join(", ");
            return Err(Error::Input(format!(
                "there is no preset {text:?}; the presets are {known}"
            )));
        };
        let size = match (size, preset.build) {
            (None, _) => None,
            (Some(_), Build::Fixed(_)) => {
                let problem = format!("the preset {name} has a fixed size; use {name}");
                return Err(Error::Input(format!("{text}: {problem}")));
            }
            (Some(size), Build::Sized { default, largest, .. }) => {
                match size.parse().ok().filter(|size| (1..=largest).contains(size)) {
                    Some(size) => Some(size).filter(|&size| size != default),
                    None => {
                        return Err(Error::Input(format!(
                            "{text}: {size:?} is not a size of the preset {name}; use one from {name}:1 to {name}:{largest}"
                        )));
                    }
                }
            }
        };
        Ok(Self { preset, size })
    }
}

impl fmt::Display for PresetSpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.preset.name)?;
        self.size.map_or(Ok(()), |size| write!(f, ":{size}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_sizes_are_read_and_written() {
        for (text, written) in
            [("room", "room"), ("town", "town"), ("town:2", "town"), ("town:04", "town:4")]
        {
            let read: PresetSpec = text.parse().unwrap_or_else(|e| panic!("{text}: {e}"));
            assert_eq!(read.to_string(), written, "{text}");
        }
        for (text, word) in [
            ("nonsense", "spheres, thin"),
            ("nonsense:3", "spheres, thin"),
            ("room:3", "use room"),
            ("town:", "town:1 to town:16"),
            ("town:0", "town:1 to town:16"),
            ("town:17", "town:1 to town:16"),
            ("town:4x4", "town:1 to town:16"),
            ("town:4:4", "town:1 to town:16"),
            ("../town", "spheres, thin"),
        ] {
            let error = text.parse::<PresetSpec>().expect_err(text).to_string();
            assert!(error.contains(word) && error.contains(text), "{error}");
        }
    }
}
