//! Options for reading depth that is given beside photographs.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Options for reading depth.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct DepthOptions {
    /// The depth to read, if any.
    pub choice: DepthChoice,
    /// Unit of the values; `None`: that of the format.
    pub unit: Option<DepthUnit>,
    /// The distance that the values measure.
    pub along: DepthAlong,
    /// A point cloud in the dataset's coordinates, which is projected into the views instead of reading depth maps.
    pub points: Option<PathBuf>,
    /// True if a map that cannot be read in training costs only the depth of its view.
    pub drops_damaged: bool,
}

/// The use of depth that is given beside photographs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum DepthChoice {
    /// Use it if there is any and it passes all checks, unless densify rendered it as ground truth
    Auto,
    /// Do not look for it
    #[default]
    Off,
    /// Require it, even if densify rendered it; a failed check ends the run
    On,
}

/// The distance that depth files hold.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum DepthAlong {
    /// From the camera's plane, along its optical axis
    #[default]
    Axis,
    /// From the camera's centre, along the ray of each pixel
    Ray,
}

/// The unit of the values in depth files.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum DepthUnit {
    /// Depth in multiples of this length, > 0 `[world units]`.
    World(f64),
    /// Inverse depth up to a scale and an offset, which are fitted to the points that each view sees.
    Relative,
}

const RELATIVE: &str = "relative";

impl FromStr for DepthUnit {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == RELATIVE {
            return Ok(Self::Relative);
        }
        let number = match text.split_once('/') {
            None => text.parse().ok(),
            Some((over, under)) => over
                .parse()
                .ok()
                .zip(under.parse().ok())
                .map(|(over, under): (f64, f64)| over / under),
        };
        match number.filter(|unit: &f64| unit.is_normal() && *unit > 0.0) {
            Some(unit) => Ok(Self::World(unit)),
            None => Err(format!(
                "{text:?} is no unit of depth: give the length of one step in the dataset's units, such as 0.001 or \
                 1/5000, or {RELATIVE}"
            )),
        }
    }
}

impl fmt::Display for DepthUnit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::World(unit) => write!(f, "{unit}"),
            Self::Relative => f.write_str(RELATIVE),
        }
    }
}

impl Serialize for DepthUnit {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::World(unit) => unit.serialize(serializer),
            Self::Relative => RELATIVE.serialize(serializer),
        }
    }
}

impl<'de> Deserialize<'de> for DepthUnit {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        densify_core::numbers::number_or_text(deserializer)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_are_numbers_fractions_or_relative() {
        for (text, unit) in [
            ("0.001", DepthUnit::World(0.001)),
            ("1/5000", DepthUnit::World(0.0002)),
            ("relative", DepthUnit::Relative),
        ] {
            assert_eq!(text.parse(), Ok(unit), "{text}");
            assert_eq!(unit.to_string().parse(), Ok(unit), "{text}");
        }
        for bad in ["0", "-1", "1/0", "0/3", "inf", "mm", "", "1/2/3"] {
            assert!(bad.parse::<DepthUnit>().is_err(), "{bad}");
        }
    }
}
