//! Names in glTF's extension for Gaussian splats, and constants of the files that use it.

/// First bytes of a binary file.
pub(super) const MAGIC: &[u8; 4] = b"glTF";
/// Name of the extension.
pub(super) const SPLATS: &str = "KHR_gaussian_splatting";
/// Logarithms of the scales, in an attribute of densify's own: they cannot be recovered bit for bit from the scales
/// that the standard stores.
pub(super) const LOG_SCALE: &str = "_LOG_SCALE";
/// Logits of the opacities, for the same reason.
pub(super) const OPACITY_LOGIT: &str = "_OPACITY_LOGIT";
/// Type names of accessors by their number of components.
pub(super) const SHAPES: [&str; 5] = ["", "SCALAR", "VEC2", "VEC3", "VEC4"];
/// Quaternion (x, y, z, w) of the half turn about z between the frame of glTF and that of the other formats.
pub(super) const HALF_TURN: [f64; 4] = [0.0, 0.0, 1.0, 0.0];

/// Name of the attribute that holds a spherical-harmonic coefficient.
pub(super) fn coefficient(degree: u8, n: u8) -> String {
    format!("{SPLATS}:SH_DEGREE_{degree}_COEF_{n}")
}
