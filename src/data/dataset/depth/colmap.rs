//! Depth maps of COLMAP's dense reconstruction: the text `width&height&channels&`, then f32 depths in the units of the
//! model.

use super::super::LoadError;
use super::super::images::SourceFile;
use super::raw::{self, DepthHeader, Values, malformed};

/// Longest header `[bytes]`: three numbers.
const MAX_HEADER: usize = 64;

pub(super) fn read_header(source: &SourceFile) -> Result<DepthHeader, LoadError> {
    let (start, length) = raw::start(source, MAX_HEADER as u64)?;
    parse(source, &start, length).map(|(header, _)| header)
}

/// The size, and the place of the first value `[bytes]`.
fn parse(
    source: &SourceFile,
    start: &[u8],
    length: u64,
) -> Result<(DepthHeader, usize), LoadError> {
    let mut numbers = Vec::new();
    let mut begins = 0;
    for field in start.split(|&byte| byte == b'&').take(3) {
        begins += field.len() + 1;
        numbers.extend(std::str::from_utf8(field).ok().and_then(|text| text.parse::<u64>().ok()));
    }
    let [width, height, 1] = numbers[..] else {
        let problem = "it does not begin with `width&height&1&`";
        return Err(malformed(&source.path, "the header", problem));
    };
    let header = DepthHeader::checked(&source.path, [width, height], length, 0)?;
    let needed = begins as u64 + 4 * width * height;
    if length != needed {
        let problem = format!("it has {length} bytes instead of {needed}");
        return Err(malformed(&source.path, "the file", problem));
    }
    Ok((header, begins))
}

pub(super) fn read(source: &SourceFile) -> Result<Values, LoadError> {
    let bytes = raw::bytes(source)?;
    let start = &bytes[..bytes.len().min(MAX_HEADER)];
    let (header, begins) = parse(source, start, bytes.len() as u64)?;
    let value = |bytes: &[u8]| f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
    let values = bytes[begins..].chunks_exact(4).map(value).collect();
    raw::image(&source.path, (header.width, header.height), values)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_are_read_and_damaged_ones_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.jpg.geometric.bin");
        let with = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            let source = SourceFile::existing(path.clone()).unwrap();
            let header = read_header(&source).map_err(|error| error.to_string());
            let values = read(&source).map_err(|error| error.to_string());
            assert_eq!(header.is_ok(), values.is_ok());
            values
        };
        let data: Vec<u8> = [1.5_f32, 0.0].iter().flat_map(|z| z.to_le_bytes()).collect();
        let values = with(&[&b"2&1&1&"[..], &data].concat()).unwrap();
        assert_eq!((values.dimensions(), &values.as_raw()[..]), ((2, 1), &[1.5, 0.0][..]));
        for (head, part) in [
            ("3&1&1&", "instead of 18"),
            ("2&1&3&", "begin with"),
            ("2&", "begin"),
            ("0&1&1&", "not supported"),
        ] {
            let message = with(&[head.as_bytes(), &data].concat()).unwrap_err();
            assert!(message.contains("geometric.bin") && message.contains(part), "{message}");
        }
    }
}
