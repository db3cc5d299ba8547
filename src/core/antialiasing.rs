//! The antialiasing that a model was trained with: how renderers treat Gaussians that are smaller than a pixel.
//!
//! Every renderer widens a projected Gaussian of covariance S `[px²]` to B = S + κ·I, so that it covers about a
//! pixel. With antialiasing, the renderer also multiplies the opacity by ρ = √(det S / det B), so that the widening
//! adds no light (Yu et al., *Mip-Splatting*, CVPR 2024, equation 9). A model must be rendered as it was trained:
//! without ρ, the small Gaussians of an antialiased model are too opaque.

use std::fmt::{self, Display};
use std::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// The antialiasing that a model was trained with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Antialiasing {
    /// No antialiasing: opacities are not lowered. κ is 0.3 px².
    #[default]
    None,
    /// κ is 0.3 px², as in the original trainer's `--antialiasing`, gsplat, nerfstudio, Postshot, splat-transform, and
    /// `densify train --antialias`.
    Wide,
    /// κ is 0.1 px², as in Mip-Splatting, Brush and LichtFeld.
    Narrow,
}

impl Antialiasing {
    /// All variants.
    pub const ALL: [Self; 3] = [Self::None, Self::Wide, Self::Narrow];

    /// κ, the variance added to both axes of a projected Gaussian `[px²]`.
    pub const fn kernel(self) -> f32 {
        match self {
            Self::None | Self::Wide => 0.3,
            Self::Narrow => 0.1,
        }
    }

    /// True if opacities are multiplied by ρ.
    pub const fn is_on(self) -> bool {
        !matches!(self, Self::None)
    }

    /// The spelling on the command line and in files: `none`, `0.3` or `0.1`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Wide => "0.3",
            Self::Narrow => "0.1",
        }
    }
}

impl Display for Antialiasing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The text does not name an antialiasing kernel.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{0}` is not an antialiasing kernel; choose 0.3, 0.1 (Mip-Splatting, Brush, LichtFeld) or none"
)]
pub struct AntialiasingError(String);

impl FromStr for Antialiasing {
    type Err = AntialiasingError;

    fn from_str(text: &str) -> Result<Self, AntialiasingError> {
        let kind = Self::ALL.into_iter().find(|kind| kind.name() == text);
        kind.ok_or_else(|| AntialiasingError(text.to_owned()))
    }
}

impl Serialize for Antialiasing {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_str(self.name())
    }
}

impl<'de> Deserialize<'de> for Antialiasing {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        /// The kernel may be given as text or as a number.
        #[derive(Deserialize)]
        #[serde(untagged, expecting = "expected 0.3, 0.1 or none")]
        enum TextOrNumber {
            Text(String),
            Number(f64),
        }
        let text = match TextOrNumber::deserialize(from)? {
            TextOrNumber::Text(text) => text,
            TextOrNumber::Number(kernel) => kernel.to_string(),
        };
        text.parse().map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_back() {
        for kind in Antialiasing::ALL {
            assert_eq!(kind.to_string().parse(), Ok(kind));
        }
        let read = |json: &str| serde_json::from_str::<Antialiasing>(json).ok();
        assert_eq!(read("0.1"), Some(Antialiasing::Narrow));
        assert_eq!(read("\"0.3\""), Some(Antialiasing::Wide));
        assert_eq!((read("0.2"), read("true")), (None, None));
        let message = "0.2".parse::<Antialiasing>().unwrap_err().to_string();
        assert!(message.contains("0.2") && message.contains("none"), "{message}");
    }
}
