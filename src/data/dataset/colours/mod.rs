//! The colour space that an image file states, such as Display P3 or linear values, and the conversion to sRGB.

mod convert;
mod profiles;
mod stated;

#[cfg(test)]
mod tests;

use std::io::{BufRead, Seek};

use image::DynamicImage;
use moxcms::ColorProfile;

use stated::Stated;

/// A colour space other than sRGB.
#[derive(Debug, Clone)]
pub(super) struct ColourSpace {
    /// The name for messages, such as `Display P3`.
    pub(super) name: String,
    values: Values,
}

/// The meaning of an image's values.
#[derive(Debug, Clone)]
enum Values {
    /// Linear light to the power of this exponent, with the primaries of sRGB.
    Exponent(f64),
    /// What an ICC profile for RGB says.
    Profile(Box<ColorProfile>),
}

/// A statement about colours that cannot be followed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Fault {
    /// The part of the file that states it.
    pub(super) field: &'static str,
    pub(super) problem: String,
}

impl Fault {
    fn new(field: &'static str, problem: impl Into<String>) -> Self {
        Self { field, problem: problem.into() }
    }
}

/// The colour space of an image file; `None` if it is sRGB, or if the file states none.
///
/// # Errors
/// When a statement is damaged or not supported, or the colours have a high dynamic range: converting them to sRGB would
/// need tone mapping.
pub(super) fn read(input: impl BufRead + Seek) -> Result<Option<ColourSpace>, Fault> {
    match stated::read(input) {
        None => Ok(None),
        Some(Stated::Profile(bytes)) => profiles::from_icc(&bytes),
        Some(Stated::DamagedProfile) => Err(Fault::new("ICC profile", "it is damaged")),
        Some(Stated::AdobeRgb) => profiles::adobe_rgb(),
        Some(Stated::Codes { primaries, transfer }) => profiles::from_codes(primaries, transfer),
        Some(Stated::Gamma { exponent, chromaticities }) => {
            profiles::from_gamma(exponent, chromaticities)
        }
    }
}

impl ColourSpace {
    /// Converts the values of an image to sRGB. Alpha does not change, and grey images remain grey.
    ///
    /// # Errors
    /// When the profile cannot be applied.
    pub(super) fn convert(&self, image: &mut DynamicImage) -> Result<(), Fault> {
        match &self.values {
            Values::Exponent(exponent) => convert::exponent_to_srgb(image, *exponent),
            Values::Profile(profile) => convert::profile_to_srgb(image, profile)?,
        }
        Ok(())
    }
}
