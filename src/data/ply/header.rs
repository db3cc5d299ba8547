//! The header of a PLY file: encoding, elements, properties.

use std::fmt::Display;
use std::io::{BufRead, Read};
use std::path::Path;

use crate::error::LoadError;

/// Longest header accepted `[bytes]`.
const MAX_HEADER: u64 = 1 << 20;
/// Longest comment that is kept `[bytes]`.
const MAX_COMMENT: usize = 256;
/// An element with this number of rows or more is refused.
const MAX_ROWS: u64 = 1 << 32;

/// Encoding of the data.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Encoding {
    Ascii,
    LittleEndian,
    BigEndian,
}

/// A numeric type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

/// A column of an element.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Property {
    pub(crate) name: String,
    pub(crate) kind: Scalar,
    /// Type of the length, if the property is a list.
    pub(super) list: Option<Scalar>,
}

/// A table of the file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Element {
    pub(crate) name: String,
    pub(crate) rows: u64,
    pub(crate) properties: Vec<Property>,
}

/// A parsed header.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Header {
    pub(super) encoding: Encoding,
    pub(super) elements: Vec<Element>,
    /// Texts of the `comment` and `obj_info` lines, except long ones, with single spaces between words.
    pub(super) comments: Vec<String>,
    /// Size of the header `[bytes]`.
    pub(super) length: u64,
}

impl Scalar {
    fn parse(word: &str) -> Option<Self> {
        Some(match word {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// Size in a binary file `[bytes]`.
    pub(super) fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The largest value of an integer type; infinity for a floating-point type.
    pub(crate) fn largest(self) -> f64 {
        match self {
            Self::I8 => 127.0,
            Self::U8 => 255.0,
            Self::I16 => 32_767.0,
            Self::U16 => 65_535.0,
            Self::I32 => f64::from(i32::MAX),
            Self::U32 => f64::from(u32::MAX),
            Self::F32 | Self::F64 => f64::INFINITY,
        }
    }
}

impl Element {
    /// Index of the scalar property with the first of these names that exists.
    pub(crate) fn find(&self, names: &[&str]) -> Option<usize> {
        self.find_by(names, |own, name| own == name)
    }

    /// Index of the list with the first of these names that exists.
    pub(crate) fn find_list(&self, names: &[&str]) -> Option<usize> {
        let is_list = |p: &Property, name: &str| p.list.is_some() && p.name == name;
        names.iter().find_map(|name| self.properties.iter().position(|p| is_list(p, name)))
    }

    /// As [`find`](Self::find), ignoring case.
    pub(crate) fn find_in_any_case(&self, names: &[&str]) -> Option<usize> {
        self.find_by(names, str::eq_ignore_ascii_case)
    }

    fn find_by(&self, names: &[&str], is_same: impl Fn(&str, &str) -> bool) -> Option<usize> {
        names.iter().find_map(|name| {
            self.properties.iter().position(|p| p.list.is_none() && is_same(&p.name, name))
        })
    }

    /// Index of a required property.
    ///
    /// # Errors
    /// When it is missing; the message ends with `remedy`.
    pub(crate) fn column(
        &self,
        path: &Path,
        property: &str,
        remedy: &str,
    ) -> Result<usize, LoadError> {
        self.find(&[property]).ok_or_else(|| {
            let path = path.display();
            LoadError::Data(format!("{path}: the vertices have no property {property}; {remedy}"))
        })
    }

    /// Smallest possible size of a row `[bytes]`.
    pub(super) fn min_bytes(&self, encoding: Encoding) -> u64 {
        let size = |p: &Property| match encoding {
            // A digit and a separator.
            Encoding::Ascii => 2,
            _ => p.list.unwrap_or(p.kind).size() as u64,
        };
        self.properties.iter().map(size).sum()
    }
}

impl Header {
    /// Reads the header and leaves `input` at the first byte of data.
    pub(super) fn read(path: &Path, input: &mut impl BufRead) -> Result<Self, LoadError> {
        let mut lines = Lines { path, input, number: 0, read: 0 };
        // A byte-order mark may come first.
        if lines.next()?.trim_start_matches('\u{feff}').trim_end() != "ply" {
            return Err(lines.fault("it is not a PLY file: the first line is not `ply`"));
        }
        let mut encoding = None;
        let mut elements: Vec<Element> = Vec::new();
        let mut comments = Vec::new();
        loop {
            let line = lines.next()?;
            let words: Vec<&str> = line.split_whitespace().collect();
            match words[..] {
                [] => {}
                ["comment" | "obj_info", ..] => {
                    let text = words[1..].join(" ");
                    // Comments that are used are short; others may be long.
                    comments.extend(Some(text).filter(|text| text.len() <= MAX_COMMENT));
                }
                ["format", kind, "1.0"] if encoding.is_none() && elements.is_empty() => {
                    encoding = Some(match kind {
                        "ascii" => Encoding::Ascii,
                        "binary_little_endian" => Encoding::LittleEndian,
                        "binary_big_endian" => Encoding::BigEndian,
                        _ => return Err(lines.fault(format!("the format {kind:?} is unknown"))),
                    });
                }
                _ if encoding.is_none() => {
                    return Err(lines.fault(
                        "expected `format ascii|binary_little_endian|binary_big_endian 1.0`",
                    ));
                }
                ["element", name, rows] => {
                    let rows = rows
                        .bytes()
                        .all(|b| b.is_ascii_digit())
                        .then(|| rows.parse().ok())
                        .flatten();
                    let rows = rows.filter(|&rows| rows < MAX_ROWS);
                    let rows = rows.ok_or_else(|| {
                        lines.fault("the number of rows is not an integer below 2^32")
                    })?;
                    if elements.iter().any(|element| element.name == name) {
                        return Err(lines.fault(format!("the element {name:?} occurs twice")));
                    }
                    elements.push(Element { name: name.to_owned(), rows, properties: Vec::new() });
                }
                ["property", "list", length, kind, name] => {
                    let length =
                        Scalar::parse(length).filter(|s| !matches!(s, Scalar::F32 | Scalar::F64));
                    let (Some(length), Some(kind)) = (length, Scalar::parse(kind)) else {
                        return Err(lines.fault(
                            "a type is unknown, or the length of a list is not an integer",
                        ));
                    };
                    lines.push(&mut elements, name, kind, Some(length))?;
                }
                ["property", kind, name] => {
                    let Some(kind) = Scalar::parse(kind) else {
                        return Err(lines.fault(format!("the type {kind:?} is unknown")));
                    };
                    lines.push(&mut elements, name, kind, None)?;
                }
                ["end_header"] => break,
                _ => {
                    return Err(lines.fault(format!(
                        "{:?} is not a header line",
                        line.trim().chars().take(60).collect::<String>()
                    )));
                }
            }
        }
        let encoding = encoding.ok_or_else(|| lines.fault("there is no `format` line"))?;
        Ok(Self { encoding, elements, comments, length: lines.read })
    }
}

/// The lines of a header, counted for messages.
struct Lines<'a, R> {
    path: &'a Path,
    input: &'a mut R,
    number: usize,
    /// Bytes read so far.
    read: u64,
}

impl<R: BufRead> Lines<'_, R> {
    fn fault(&self, problem: impl Display) -> LoadError {
        LoadError::damaged(self.path, format!("header line {}", self.number), problem)
    }

    fn next(&mut self) -> Result<String, LoadError> {
        let mut line = Vec::new();
        self.number += 1;
        let room = MAX_HEADER.saturating_sub(self.read);
        let read =
            self.input.take(room).read_until(b'\n', &mut line).map_err(LoadError::io(self.path))?;
        self.read += read as u64;
        if line.last() != Some(&b'\n') && line.trim_ascii() != b"end_header" {
            return Err(self.fault("the header ends without `end_header`, or is longer than 1 MiB"));
        }
        // Comments may be in any character encoding.
        Ok(String::from_utf8_lossy(&line).into_owned())
    }

    fn push(
        &self,
        elements: &mut [Element],
        name: &str,
        kind: Scalar,
        list: Option<Scalar>,
    ) -> Result<(), LoadError> {
        let Some(element) = elements.last_mut() else {
            return Err(self.fault("a property comes before any element"));
        };
        element.properties.push(Property { name: name.to_owned(), kind, list });
        Ok(())
    }
}
