//! Depth as OpenEXR, as Blender and scenegen write it: the channel `Z`, or one that ends with `.Z`.
//!
//! Blender's background is 1e10, 65504 in half floats, or infinite; all of them count as unknown.

use std::io::Cursor;

use exr::meta::MetaData;
use exr::meta::header::Header;
use exr::prelude::{ReadChannels, ReadLayers, read as reader};

use super::super::LoadError;
use super::super::images::SourceFile;
use super::raw::{self, DepthHeader, Values, malformed};

/// Largest ratio of the decoded size to the size of the file: that of run lengths and of deflate.
const EXPANSION: u64 = 2048;
/// Smallest value of the background: the largest half float.
const BACKGROUND: f32 = 65_504.0;
/// The first bytes of a file that hold its header.
const HEADER_BYTES: u64 = 1 << 20;

pub(super) fn read_header(source: &SourceFile) -> Result<DepthHeader, LoadError> {
    let (start, length) = raw::start(source, HEADER_BYTES)?;
    parse(source, &start, length).map(|(header, _)| header)
}

/// The size, and the name of the channel of depth.
fn parse(
    source: &SourceFile,
    start: &[u8],
    length: u64,
) -> Result<(DepthHeader, String), LoadError> {
    let bad = |problem: String| malformed(&source.path, "the header", problem);
    let meta = MetaData::read_from_buffered(Cursor::new(start), false);
    let meta = meta.map_err(|error| bad(error.to_string()))?;
    let header = meta.headers.first().ok_or_else(|| bad("it has no layer".to_owned()))?;
    let channel = channel(header).ok_or_else(|| {
        let names: Vec<String> =
            header.channels.list.iter().map(|channel| channel.name.to_string()).collect();
        bad(format!("it has no channel Z, but {}", names.join(", ")))
    })?;
    let is_plain =
        header.channels.list.iter().all(|channel| channel.sampling == exr::math::Vec2(1, 1));
    if header.deep || !is_plain {
        return Err(bad("deep or subsampled data is not supported".to_owned()));
    }
    let size = [header.layer_size.0, header.layer_size.1].map(|side| side as u64);
    let all_bytes: usize =
        header.channels.list.iter().map(|channel| channel.sample_type.bytes_per_sample()).sum();
    let found = DepthHeader::checked(&source.path, size, length, all_bytes as u64)?;
    // The file must be large enough to hold such an image.
    if found.decoded_bytes > length.saturating_mul(EXPANSION) {
        return Err(bad(format!("{}x{} px cannot be in so small a file", size[0], size[1])));
    }
    Ok((found, channel))
}

/// The name of the channel of depth: `Z`, one that ends with `.Z`, the only channel, or the first of a grey picture.
fn channel(header: &Header) -> Option<String> {
    let names: Vec<String> =
        header.channels.list.iter().map(|channel| channel.name.to_string()).collect();
    let by = |is_named: &dyn Fn(&str) -> bool| names.iter().find(|name| is_named(name)).cloned();
    by(&|name| name == "Z")
        .or_else(|| by(&|name| name.ends_with(".Z")))
        .or_else(|| names.first().filter(|_| names.len() == 1).cloned())
        .or_else(|| by(&|name| name == "R"))
}

pub(super) fn read(source: &SourceFile) -> Result<Values, LoadError> {
    let bytes = raw::bytes(source)?;
    let start = &bytes[..bytes.len().min(HEADER_BYTES as usize)];
    let (header, name) = parse(source, start, bytes.len() as u64)?;
    let image = reader()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .non_parallel()
        .from_buffered(Cursor::new(&*bytes));
    let image = image.map_err(|error| malformed(&source.path, "the pixels", error))?;
    let list = &image.layer_data.channel_data.list;
    let channel = list.iter().find(|channel| channel.name.to_string() == name);
    let channel = channel.ok_or_else(|| {
        malformed(&source.path, "the pixels", "its channels differ from the header")
    })?;
    let value = |value: f32| if value >= BACKGROUND { f32::NAN } else { value };
    let values = channel.sample_data.values_as_f32().map(value).collect();
    raw::image(&source.path, (header.width, header.height), values)
}
