//! Fingerprints of datasets: a run can be continued only with the views that it was started with.
//!
//! Reading all pixels could take minutes, so the sizes of image files stand in for them. The `Debug` texts of cameras,
//! image headers and lenses are part of the fingerprint and must therefore not change.

use std::fmt::{self, Write};

use serde::{Deserialize, Serialize};

use densify_data::dataset::normalise::Normalisation;
use densify_data::dataset::{Dataset, View};

/// The fingerprint of a dataset.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Fingerprint {
    /// Views trained on.
    pub train: ViewsFingerprint,
    /// Views held out.
    pub test: ViewsFingerprint,
    /// Transform from the dataset's coordinates to normalised coordinates.
    pub normalisation: Normalisation,
}

/// The fingerprint of views: their number, and checksums (CRC-32C).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewsFingerprint {
    /// Number of views.
    pub count: usize,
    /// Checksum of their names, in order.
    pub names: u32,
    /// Checksum of poses, intrinsics and sizes.
    pub cameras: u32,
    /// Checksum of lens distortions, of the sizes of image files and masks, and of pixels of images without a file.
    pub images: u32,
}

impl Fingerprint {
    /// The fingerprint of a dataset.
    pub fn new(dataset: &Dataset) -> Self {
        Self {
            train: ViewsFingerprint::new(&dataset.train),
            test: ViewsFingerprint::new(&dataset.test),
            normalisation: dataset.normalisation,
        }
    }

    /// A description of the first difference from another dataset, if there is one.
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

impl ViewsFingerprint {
    fn new(views: &[View]) -> Self {
        let [mut names, mut cameras, mut images] = [0; 3].map(Checksum);
        for View { name, camera, source } in views {
            names.add(format_args!("{name}\0"));
            cameras.add(format_args!("{camera:?}"));
            let mask = source.mask.as_ref().map(|mask| mask.file.length());
            images.add(format_args!("{:?}{mask:?}{:?}", source.header, source.undistortion));
            if let Some(depth) = &source.depth {
                images.add(format_args!("{}", depth.fingerprint()));
            }
            if let Some(image) = &source.rendered {
                for pixels in [Some(&image.rgb), image.alpha.as_ref(), image.mask.as_ref()] {
                    images.0 = crc32c::crc32c_append(images.0, pixels.map_or(&[], |p| &p[..]));
                }
            }
        }
        Self { count: views.len(), names: names.0, cameras: cameras.0, images: images.0 }
    }

    fn difference(&self, other: &Self, views: &str) -> Option<String> {
        let Self { count, names, cameras, images } = self;
        if *count != other.count {
            return Some(format!("{count} {views}, now {}", other.count));
        }
        let parts = [
            (*names != other.names, "names"),
            (*cameras != other.cameras, "cameras"),
            (*images != other.images, "image files"),
        ];
        let differs = parts.iter().find(|(differs, _)| *differs)?.1;
        Some(format!("the {differs} of the {views} differ"))
    }
}

/// A running CRC-32C over text.
struct Checksum(u32);

impl Checksum {
    fn add(&mut self, text: fmt::Arguments<'_>) {
        // Writing to a checksum never fails.
        let _ = self.write_fmt(text);
    }
}

impl Write for Checksum {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        self.0 = crc32c::crc32c_append(self.0, text.as_bytes());
        Ok(())
    }
}
