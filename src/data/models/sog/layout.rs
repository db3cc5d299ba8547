//! `meta.json` lists the images. Positions are 16 bits between bounds of sign(x)·ln(1 + |x|), in two images. Scales,
//! colours and coefficients are bytes that index codebooks of 256 numbers each. The bands above 0 are an index into a
//! palette, whose image has 64 entries in a row. A quaternion is its three smaller components, and the index of the
//! largest in the alpha channel.

/// The file that describes the images.
pub(super) const META: &str = "meta.json";
/// Key of the offset of local coordinates in the `asset` of `meta.json`, which only densify writes.
pub(super) const OFFSET: &str = "offset";
/// The `model` in `meta.json` of a model with antialiasing.
pub(super) const ANTIALIASED: &str = "antialiased";
/// Palette entries per row of its image.
pub(super) const PALETTE_WIDTH: usize = 64;
/// Number of values in a codebook.
pub(super) const CODEBOOK: usize = 256;
/// Alpha of a quaternion whose first component is the largest; the next values name the other components.
pub(super) const FIRST_LARGEST: u8 = 252;
