//! A header of 16 bytes (version 4: 32), then one array after the other for all Gaussians: positions in 24-bit fixed
//! point, opacities, colours, scales, rotations, bands above 0. Before compression that is 20 bytes per Gaussian, and
//! one per coefficient. Up to version 3 everything is one gzip stream; since version 4 each array is a zstd frame, and
//! a table holds the sizes of the frames.

/// First word of the data, `NGSP` in little endian.
pub(super) const MAGIC: u32 = 0x5053_474e;
/// The bit of the header's flags (byte 14) that marks a model trained with antialiasing (`load-spz.cc`).
pub(super) const ANTIALIASED: u8 = 1;
/// The bit of the same flags that marks a file with extensions.
pub(super) const HAS_EXTENSIONS: u8 = 2;
/// Type of the extension that states the axes (Adobe).
pub(super) const COORDINATE_SYSTEM: u32 = 0xadbe_0003;
/// First bytes of a gzip stream.
pub(super) const GZIP: [u8; 2] = [0x1f, 0x8b];
/// A colour's byte is 255·(½ + `COLOUR`·coefficient).
pub(super) const COLOUR: f32 = 0.15;
/// Size of the header of version 4, which ends with the offset of the table `[bytes]`.
pub(super) const HEADER_OF_VERSION_4: u32 = 32;
