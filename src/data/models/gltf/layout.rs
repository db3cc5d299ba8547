//! Names of the extension and of its attributes.

/// First bytes of a binary file.
pub(super) const MAGIC: &[u8; 4] = b"glTF";
/// The extension.
pub(super) const SPLATS: &str = "KHR_gaussian_splatting";
/// Logarithms of the scales, an attribute of densify's own: the standard's scales cannot be inverted to the last bit.
pub(super) const LOG_SCALE: &str = "_LOG_SCALE";
/// Logits of the opacities, for the same reason.
pub(super) const OPACITY_LOGIT: &str = "_OPACITY_LOGIT";
/// Type names of accessors by their number of components.
pub(super) const SHAPES: [&str; 5] = ["", "SCALAR", "VEC2", "VEC3", "VEC4"];
/// The half turn about z between the frame of glTF and that of the other formats (x, y, z, w).
pub(super) const HALF_TURN: [f64; 4] = [0.0, 0.0, 1.0, 0.0];

/// Attribute of a coefficient of colour.
pub(super) fn coefficient(degree: u8, n: u8) -> String {
    format!("{SPLATS}:SH_DEGREE_{degree}_COEF_{n}")
}
