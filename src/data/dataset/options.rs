//! Options for loading a dataset: images, resolution, test split.

use std::num::NonZeroU32;
use std::path::PathBuf;
use std::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::depth::DepthOptions;

/// Options for loading a dataset.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LoadOptions {
    /// Folder of the images, relative to the dataset, instead of the one named in its files. Images outside the
    /// dataset's folder can only be used with this option.
    pub images: Option<PathBuf>,
    /// Folder of the COLMAP model, relative to the dataset; `None`: the model with the most images.
    pub sparse: Option<PathBuf>,
    /// Training resolution; `None`: the size of the images.
    pub resolution: Option<Resolution>,
    /// Rule for holding out test views.
    pub split: Split,
    /// File that names the views to use, one per line; `None`: all.
    pub views: Option<PathBuf>,
    /// Treatment of views whose camera is far from all others.
    pub far_cameras: FarCameras,
    /// True if undistorted images show the whole field of view of the lens, with the rest masked, instead of the
    /// largest rectangle inside it.
    pub keep_fov: bool,
    /// True if white pixels of masks hide those of the photographs, instead of black ones.
    pub invert_masks: bool,
    /// Meaning of masked pixels.
    pub mask_mode: MaskMode,
    /// Cache folder of rendered built-in scenes; `None`: they are rendered each time.
    pub cache: Option<PathBuf>,
    /// What to read of the [`Tracks`](super::Tracks) of the reconstruction's points.
    pub tracks: TrackReading,
    /// Depth beside the photographs.
    pub depth: DepthOptions,
}

/// What to read of the tracks of the reconstruction's points.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum TrackReading {
    /// Nothing.
    #[default]
    Nothing,
    /// Points, and the views that show them.
    Views,
    /// Also where the photographs show the points, for which all observations of the reconstruction are read.
    Directions,
}

/// Training resolution. Images are never enlarged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Resolution {
    /// Divisor of both sides: 1, 2, 4 or 8. The folder `images_2`, `images_4` or `images_8` is used if it exists.
    Divisor(u32),
    /// Width `[px]`, above 8.
    Width(u32),
}

/// Treatment of views whose camera is far from all others, mostly by an error of structure from motion. Such views
/// never count for the extent of the scene.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum FarCameras {
    /// They are left out.
    #[default]
    LeaveOut,
    /// They are kept.
    Keep,
}

/// Meaning of the pixels that a mask hides.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum MaskMode {
    /// Unknown: they do not count, and anything may be there
    #[default]
    Ignore,
    /// Empty: they are trained to show the background, which removes what the mask hides
    Background,
}

/// Rule for holding out test views.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Split {
    /// The test split in the file of poses, if there is one; otherwise no view. (Lists beside COLMAP models are for
    /// [`Eval`](Self::Eval), as in the programs that write them.)
    #[default]
    None,
    /// The dataset's own test split, if it has one; otherwise every 8th view by sorted name.
    Eval,
    /// Every K-th of all views by sorted name, starting with the first, instead of the dataset's own split.
    Every(NonZeroU32),
}

impl Split {
    /// Every 8th view, as is usual in the literature.
    pub(super) const EVAL_EVERY: u32 = 8;
}

impl Resolution {
    /// The resolution as a number, as on the command line.
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
