//! Options for loading a dataset: images, resolution, test split.

use std::num::NonZeroU32;
use std::path::PathBuf;
use std::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// How to load a dataset.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LoadOptions {
    /// Folder of the images (`--images`) instead of the one named in the dataset's files; relative
    /// to the dataset. The only way to use images outside the dataset's folder.
    pub images: Option<PathBuf>,
    /// Size to train at (`--resolution`); `None`: the size of the images.
    pub resolution: Option<Resolution>,
    /// Which views are held out.
    pub split: Split,
    /// File that names the views to use, one in each line (`--views`); `None`: all.
    pub views: Option<PathBuf>,
    /// What happens to views whose camera is far from all others.
    pub far_cameras: FarCameras,
    /// Whether undistorted images hold all that the lens saw (`--keep-fov`), with what it did not masked,
    /// instead of the largest rectangle without such pixels.
    pub keep_fov: bool,
    /// Whether masks are white, not black, where pixels are ignored (`--invert-masks`).
    pub invert_masks: bool,
    /// What masked pixels are (`--mask-mode`).
    pub mask_mode: MaskMode,
    /// Folder that keeps built-in scenes as they were rendered; `None`: they are rendered.
    pub cache: Option<PathBuf>,
    /// Whether to read which views show which points ([`Tracks`](super::Tracks)).
    pub tracks: bool,
}

/// The size to train at. Images are never enlarged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Resolution {
    /// Sides divided by this: 1, 2, 4 or 8. Uses the folder `images_2`, `images_4` or `images_8`
    /// where there is one.
    Divisor(u32),
    /// Width `[px]`, above 8.
    Width(u32),
}

/// What happens to views whose camera is far from all others, as structure from motion places some by
/// mistake. In neither case do they count for the extent of the scene.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum FarCameras {
    /// They are left out.
    #[default]
    LeaveOut,
    /// They are kept.
    Keep,
}

/// What the pixels are that a mask hides.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum MaskMode {
    /// Unknown: they do not count, and anything may be there
    #[default]
    Ignore,
    /// Empty: they are trained to show --background, which carves away what is not in the mask
    Background,
}

/// Which views are held out for tests.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Split {
    /// Those of the dataset's own test file, if it has one; else none.
    #[default]
    None,
    /// Those of the dataset's own test file, if it has one; else every 8th by sorted name.
    Eval,
    /// Every K-th of all views by sorted name, the first included, whatever the dataset says.
    Every(NonZeroU32),
}

impl Split {
    /// Every 8th view, as is usual in the literature.
    pub const EVAL_EVERY: u32 = 8;
}

impl Resolution {
    /// The number that stands for it on the command line.
    #[must_use]
    pub fn number(self) -> u32 {
        let (Self::Divisor(number) | Self::Width(number)) = self;
        number
    }
}

impl<'de> Deserialize<'de> for Resolution {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        densify_core::numbers::number_or_text(deserializer)
    }
}

impl Serialize for Resolution {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.number().serialize(serializer)
    }
}

impl FromStr for Resolution {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, Self::Err> {
        match word.parse() {
            Ok(k @ (1 | 2 | 4 | 8)) => Ok(Self::Divisor(k)),
            Ok(width) if width > 8 => Ok(Self::Width(width)),
            _ => Err(format!(
                "{word:?} is not a resolution: give 1, 2, 4 or 8 to divide the sides of images by, or a width in \
                 px above 8"
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn resolutions_parse() {
        assert_eq!("4".parse(), Ok(Resolution::Divisor(4)));
        assert_eq!("640".parse(), Ok(Resolution::Width(640)));
        for bad in ["0", "3", "-1", "", "1.5", "x"] {
            assert!(bad.parse::<Resolution>().is_err(), "{bad:?}");
        }
    }
}
