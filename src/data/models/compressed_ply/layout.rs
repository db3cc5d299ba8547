//! Elements and properties of the format.
//!
//! Every 256 Gaussians share a `chunk`, which holds the bounds of their positions, log-scales and colours. A
//! `vertex` is four words: 11-10-11 bits of position and of scale, the index of the quaternion's largest component
//! (2 bits) with the three others (10 bits each), and eight bits each of red, green, blue and opacity. Element `sh`
//! holds the bands above 0, channel by channel.

/// Gaussians per chunk.
pub(super) const CHUNK: usize = 256;
/// The bounds of a chunk, minimum before maximum, of position, log-scale and colour. Older files have no bounds of
/// colour, which then lies in `[0, 1]`.
#[rustfmt::skip] // Minimum and maximum of one quantity per line.
pub(super) const BOUNDS: [&str; 18] = [
    "min_x", "min_y", "min_z", "max_x", "max_y", "max_z",
    "min_scale_x", "min_scale_y", "min_scale_z", "max_scale_x", "max_scale_y", "max_scale_z",
    "min_r", "min_g", "min_b", "max_r", "max_g", "max_b",
];
/// The words of a Gaussian.
pub(super) const WORDS: [&str; 4] =
    ["packed_position", "packed_rotation", "packed_scale", "packed_color"];
