//! What tells one dataset from another: a run goes on only with the views that it began with.
//!
//! Pixels of files are not read for it, which could take minutes; their sizes stand for them.

use std::fmt::{self, Write};

use serde::{Deserialize, Serialize};

use crate::dataset::normalise::Normalisation;
use crate::dataset::{Dataset, View};

/// A dataset as far as a run depends on it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fingerprint {
    /// Views trained on.
    pub train: ViewsPrint,
    /// Views held out.
    pub test: ViewsPrint,
    /// From the dataset's coordinates to those of the model.
    pub normalisation: Normalisation,
}

/// Views: how many, and checksums (CRC-32C) of what they are.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewsPrint {
    /// Number of views.
    pub count: usize,
    /// Their names, in order.
    pub names: u32,
    /// Poses, intrinsics and sizes.
    pub cameras: u32,
    /// Sizes of image files and masks, lens distortions; pixels where no file holds them.
    pub images: u32,
}

impl Fingerprint {
    /// The fingerprint of a dataset.
    #[must_use]
    pub fn of(dataset: &Dataset) -> Self {
        Self {
            train: ViewsPrint::of(&dataset.train),
            test: ViewsPrint::of(&dataset.test),
            normalisation: dataset.normalisation,
        }
    }

    /// In what another dataset differs from this one, if it does.
    #[must_use]
    pub fn difference(&self, other: &Self) -> Option<String> {
        let train = self.train.difference(&other.train, "views to train on");
        let test = || self.test.difference(&other.test, "views held out");
        let scale = || {
            (self.normalisation != other.normalisation)
                .then(|| "the scene's position or scale differs".to_owned())
        };
        train.or_else(test).or_else(scale)
    }
}

impl ViewsPrint {
    fn of(views: &[View]) -> Self {
        let [mut names, mut cameras, mut images] = [0; 3].map(Checksum);
        for View { name, camera, source } in views {
            names.add(format_args!("{name}\0"));
            cameras.add(format_args!("{camera:?}"));
            let mask = source.mask.as_ref().map(|path| path.metadata().map_or(0, |m| m.len()));
            images.add(format_args!("{:?}{mask:?}{:?}", source.header, source.undistortion));
            if let Some(image) = &source.rendered {
                for pixels in [Some(&image.rgb), image.alpha.as_ref(), image.mask.as_ref()] {
                    images.0 = crc32c::crc32c_append(images.0, pixels.map_or(&[], |p| &p[..]));
                }
            }
        }
        Self { count: views.len(), names: names.0, cameras: cameras.0, images: images.0 }
    }

    fn difference(&self, other: &Self, what: &str) -> Option<String> {
        let Self { count, names, cameras, images } = self;
        if *count != other.count {
            return Some(format!("{count} {what}, now {}", other.count));
        }
        let parts = [
            (*names != other.names, "names"),
            (*cameras != other.cameras, "cameras"),
            (*images != other.images, "image files"),
        ];
        let differs = parts.iter().find(|(differs, _)| *differs)?.1;
        Some(format!("the {differs} of the {what} differ"))
    }
}

/// A running CRC-32C over text. Numbers as text are exact: each has a text of its own.
struct Checksum(u32);

impl Checksum {
    fn add(&mut self, text: fmt::Arguments<'_>) {
        // Nothing here fails.
        let _ = self.write_fmt(text);
    }
}

impl Write for Checksum {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.0 = crc32c::crc32c_append(self.0, text.as_bytes());
        Ok(())
    }
}
