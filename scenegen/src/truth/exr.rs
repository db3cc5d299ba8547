//! Reads the float images written by this program.

use std::fs;
use std::io::Cursor;
use std::path::Path;

use exr::meta::MetaData;
use exr::prelude::{ReadChannels, ReadLayers, SampleType, read as reader};

use super::REMEDY;
use crate::error::Error;
use crate::resource::EXPANSION;

/// Reads the channels of an image, in the given order; `None` if the image has a different size.
pub(super) fn read<const N: usize>(
    path: &Path,
    channels: [&str; N],
    (width, height): (u32, u32),
) -> Result<Option<[Vec<f32>; N]>, Error> {
    let bytes = fs::read(path).map_err(Error::io(path))?;
    let bad = |element: &str, problem: String| Error::malformed(path, element, problem, REMEDY);
    let meta = MetaData::read_from_buffered(Cursor::new(&*bytes), false);
    let meta = meta.map_err(|error| bad("header", error.to_string()))?;
    let [header] = &meta.headers[..] else {
        return Err(bad("header", format!("it has {} layers instead of one", meta.headers.len())));
    };
    let found = &header.channels.list;
    let plain = found.iter().all(|channel| {
        channel.sample_type == SampleType::F32 && channel.sampling == exr::math::Vec2(1, 1)
    });
    if header.deep || !plain || found.len() != N {
        let problem = format!(
            "it must have exactly {N} channels of 32-bit floats, without subsampling or deep data"
        );
        return Err(bad("header", problem));
    }
    let size = (width as usize, height as usize);
    if (header.layer_size.0, header.layer_size.1) != size {
        return Ok(None);
    }
    // The camera bounds the image's size, but the file must also be large enough to hold such an image.
    let needed = u64::from(width) * u64::from(height) * 4 * N as u64;
    if needed > (bytes.len() as u64).saturating_mul(EXPANSION) {
        return Err(bad("header", format!("{width}x{height} px cannot be in so small a file")));
    }
    let image = reader()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .non_parallel()
        .from_buffered(Cursor::new(&*bytes));
    let image = image.map_err(|error| bad("pixels", error.to_string()))?;
    let mut all = channels.map(|_| Vec::new());
    for (values, name) in all.iter_mut().zip(channels) {
        let list = &image.layer_data.channel_data.list;
        let channel = list.iter().find(|channel| channel.name.eq(name));
        let channel = channel.ok_or_else(|| bad("header", format!("it has no channel {name}")))?;
        values.extend(channel.sample_data.values_as_f32());
        if values.len() != size.0 * size.1 || values.iter().any(|value| !value.is_finite()) {
            return Err(bad(&format!("channel {name}"), "a value is missing or not finite".into()));
        }
    }
    Ok(Some(all))
}
