//! Depth as a NumPy array of shape `[height, width]`, as nerfstudio and scenegen store it.
//!
//! Format: numpy.org/doc/stable/reference/generated/numpy.lib.format.html

use std::path::Path;

use super::super::LoadError;
use super::super::images::SourceFile;
use super::raw::{self, DepthHeader, Values, malformed};

const MAGIC: &[u8] = b"\x93NUMPY";
/// Longest header that is read `[bytes]`.
const MAX_HEADER: u64 = 1 << 16;

/// A type of values in an array.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    F32,
    F64,
    U16,
    I16,
    U32,
    I32,
}

impl Kind {
    /// All types, with their names in the header.
    const ALL: [(Self, &str); 6] = [
        (Self::F32, "f4"),
        (Self::F64, "f8"),
        (Self::U16, "u2"),
        (Self::I16, "i2"),
        (Self::U32, "u4"),
        (Self::I32, "i4"),
    ];

    fn bytes(self) -> usize {
        match self {
            Self::F32 | Self::U32 | Self::I32 => 4,
            Self::F64 => 8,
            Self::U16 | Self::I16 => 2,
        }
    }

    /// The value of little-endian bytes, as many as the type has.
    fn value(self, bytes: &[u8]) -> f32 {
        let first = |count: usize| {
            let mut all = [0; 8];
            all[..count].copy_from_slice(&bytes[..count]);
            u64::from_le_bytes(all)
        };
        match self {
            Self::F32 => f32::from_bits(first(4) as u32),
            Self::F64 => f64::from_bits(first(8)) as f32,
            Self::U16 => first(2) as f32,
            Self::I16 => f32::from(first(2) as u16 as i16),
            Self::U32 => first(4) as f32,
            Self::I32 => first(4) as u32 as i32 as f32,
        }
    }
}

/// The header of an array.
struct Header {
    kind: Kind,
    is_big_endian: bool,
    width: u64,
    height: u64,
    /// Place of the first value in the file `[bytes]`.
    begins: usize,
}

pub(super) fn read_header(source: &SourceFile) -> Result<DepthHeader, LoadError> {
    let (start, length) = raw::start(source, MAX_HEADER)?;
    let header = parse(&start).map_err(|problem| malformed(&source.path, "the header", problem))?;
    checked(&source.path, &header, length)
}

fn checked(path: &Path, header: &Header, length: u64) -> Result<DepthHeader, LoadError> {
    let found = DepthHeader::checked(path, [header.width, header.height], length, 0)?;
    let needed = header.begins as u64 + header.width * header.height * header.kind.bytes() as u64;
    if length < needed {
        let problem = format!("it has {length} of {needed} bytes");
        return Err(malformed(path, "the file", problem));
    }
    Ok(found)
}

pub(super) fn read(source: &SourceFile) -> Result<Values, LoadError> {
    let bytes = raw::bytes(source)?;
    let start = &bytes[..bytes.len().min(MAX_HEADER as usize)];
    let header = parse(start).map_err(|problem| malformed(&source.path, "the header", problem))?;
    let size = checked(&source.path, &header, bytes.len() as u64)?;
    let one = header.kind.bytes();
    let pixels = size.width as usize * size.height as usize;
    let value = |bytes: &[u8]| {
        let mut little = [0; 8];
        little[..one].copy_from_slice(bytes);
        if header.is_big_endian {
            little[..one].reverse();
        }
        header.kind.value(&little[..one])
    };
    let values = bytes[header.begins..].chunks_exact(one).take(pixels).map(value).collect();
    raw::image(&source.path, (size.width, size.height), values)
}

fn parse(start: &[u8]) -> Result<Header, String> {
    let rest = start.strip_prefix(MAGIC).ok_or("it is not a NumPy array")?;
    let (length, text) = match *rest {
        [1, _, a, b, ref text @ ..] => (usize::from(u16::from_le_bytes([a, b])), text),
        [2 | 3, _, a, b, c, d, ref text @ ..] => (u32::from_le_bytes([a, b, c, d]) as usize, text),
        _ => return Err("its version is unknown".to_owned()),
    };
    let begins = start.len() - text.len() + length;
    let text = text.get(..length).and_then(|text| std::str::from_utf8(text).ok());
    let text = text.ok_or("it is cut off")?;
    let field = |name: &str| {
        let (_, rest) = text.split_once(&format!("'{name}':"))?;
        Some(rest.trim_start())
    };
    let missing = |name: &str| format!("it has no {name}");
    let descr = field("descr").ok_or_else(|| missing("descr"))?;
    let name = descr.strip_prefix('\'').and_then(|rest| rest.split('\'').next()).unwrap_or(descr);
    let (order, type_name) = name.split_at_checked(1).unwrap_or(("", name));
    let kind = Kind::ALL.iter().find(|(_, known)| *known == type_name);
    let Some((kind, _)) = kind.filter(|_| matches!(order, "<" | ">" | "=" | "|")) else {
        let supported: Vec<&str> = Kind::ALL.iter().map(|(_, name)| *name).collect();
        return Err(format!(
            "values of type {:?} are not supported; save the array as one of {}",
            name.chars().take(20).collect::<String>(),
            supported.join(", ")
        ));
    };
    if field("fortran_order").is_none_or(|order| !order.starts_with("False")) {
        return Err("it is in Fortran order; save it with numpy.ascontiguousarray".to_owned());
    }
    let shape = field("shape").and_then(|shape| shape.strip_prefix('(')?.split(')').next());
    let sides = shape.ok_or_else(|| missing("shape"))?.split(',').map(str::trim);
    let sides: Result<Vec<u64>, _> =
        sides.filter(|side| !side.is_empty()).map(str::parse).collect();
    let sides = sides.map_err(|_| "its shape is not a list of numbers")?;
    let [height, width] = match sides[..] {
        [height, width] | [height, width, 1] | [1, height, width] => [height, width],
        _ => return Err(format!("its shape {sides:?} is not [height, width]")),
    };
    Ok(Header { kind: *kind, is_big_endian: order == ">", width, height, begins })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn array(descr: &str, order: &str, shape: &str, data: &[u8]) -> Vec<u8> {
        let text =
            format!("{{'descr': '{descr}', 'fortran_order': {order}, 'shape': ({shape}), }}\n");
        let mut bytes = MAGIC.to_vec();
        bytes.extend([1, 0]);
        bytes.extend((text.len() as u16).to_le_bytes());
        bytes.extend(text.bytes());
        bytes.extend(data);
        bytes
    }

    fn read_array(bytes: &[u8]) -> Result<Vec<f32>, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.npy");
        std::fs::write(&path, bytes).unwrap();
        let source = SourceFile::existing(path).unwrap();
        let values = read(&source).map_err(|error| error.to_string())?;
        let header = read_header(&source).unwrap();
        assert_eq!((header.width, header.height), values.dimensions());
        Ok(values.into_raw())
    }

    #[test]
    fn arrays_of_every_type_are_read() {
        for (descr, data) in [
            ("<f4", 2.5_f32.to_le_bytes().repeat(2)),
            (">f4", 2.5_f32.to_be_bytes().repeat(2)),
            ("<f8", 2.5_f64.to_le_bytes().repeat(2)),
        ] {
            assert_eq!(
                read_array(&array(descr, "False", "1, 2", &data)).unwrap(),
                [2.5; 2],
                "{descr}"
            );
        }
        for (descr, data) in [
            ("<u2", 700_u16.to_le_bytes().repeat(2)),
            (">u2", 700_u16.to_be_bytes().repeat(2)),
            ("<i2", 700_i16.to_le_bytes().repeat(2)),
            ("<i4", 700_i32.to_le_bytes().repeat(2)),
            ("<u4", 700_u32.to_le_bytes().repeat(2)),
        ] {
            let values = read_array(&array(descr, "False", "2, 1, 1", &data)).unwrap();
            assert_eq!(values, [700.0; 2], "{descr}");
        }
        let negative = read_array(&array("<i2", "False", "1, 1", &(-3_i16).to_le_bytes())).unwrap();
        assert_eq!(negative, [-3.0]);
    }

    #[test]
    fn other_arrays_are_refused_with_the_reason() {
        let data = [0; 16];
        for (bytes, part) in [
            (array("|u1", "False", "4, 4", &data), "type \"|u1\""),
            (array("<c8", "False", "1, 2", &data), "type"),
            (array("<f4", "True", "2, 2", &data), "Fortran"),
            (array("<f4", "False", "2, 2, 1, 1", &data), "shape"),
            (array("<f4", "False", "2, x", &data), "shape"),
            (array("<f4", "False", "2, 3", &data), "of"),
            (array("<f4", "False", "99999999999, 99999999999", &data), "not supported"),
            (array("<f4", "False", "0, 4", &data), "not supported"),
            (b"\x93NUMPY\x09".to_vec(), "version"),
            (b"PNG".to_vec(), "NumPy"),
            (b"\x93NUMPY\x01\x00\xff\x00{".to_vec(), "cut off"),
        ] {
            let message = read_array(&bytes).unwrap_err();
            assert!(message.contains("a.npy") && message.contains(part), "{part}: {message}");
        }
    }
}
