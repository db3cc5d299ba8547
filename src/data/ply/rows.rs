//! Reads selected columns of an element in any encoding, as f64, which represents every type exactly.

use std::fmt::Display;
use std::fs::File;
use std::io::{BufRead, BufReader, ErrorKind, Read};
use std::path::Path;

use super::header::{Element, Encoding, Header, Scalar};
use crate::error::LoadError;
use densify_core::files;

/// Longest number accepted in an ascii file `[bytes]`.
const MAX_WORD: usize = 128;
/// Longest list that is read.
const MAX_LIST: f64 = 1024.0;

/// A PLY file whose header has been read.
pub(crate) struct Ply<'a> {
    path: &'a Path,
    input: BufReader<File>,
    header: Header,
    /// Size of the data after the header `[bytes]`.
    data: u64,
    /// Number of elements that have been read or skipped.
    passed: usize,
}

impl<'a> Ply<'a> {
    /// Opens a file and reads its header.
    pub(crate) fn open(path: &'a Path) -> Result<Self, LoadError> {
        let file = files::open(path).map_err(LoadError::io(path))?;
        let length = file.metadata().map_err(LoadError::io(path))?.len();
        let mut input = BufReader::with_capacity(1 << 16, file);
        let header = Header::read(path, &mut input)?;
        let data = length.saturating_sub(header.length);
        Ok(Self { path, input, header, data, passed: 0 })
    }

    /// All elements in the order of the file.
    pub(crate) fn elements(&self) -> &[Element] {
        &self.header.elements
    }

    /// Texts of the comments in the header, except long ones, with single spaces between words.
    pub(crate) fn comments(&self) -> &[String] {
        &self.header.comments
    }

    /// The three numbers after `prefix` in a comment; `None` without such a comment. Several such comments must agree.
    pub(crate) fn comment_numbers(&self, prefix: &str) -> Result<Option<[f64; 3]>, LoadError> {
        let mut prior = None;
        let texts = self.header.comments.iter().filter_map(|comment| comment.strip_prefix(prefix));
        for text in texts.filter(|text| text.starts_with(' ')) {
            let wrong = |problem: String| {
                let field = format!("header comment {prefix:?}");
                LoadError::damaged(self.path, field, problem)
            };
            let numbers: Vec<f64> = text.split_whitespace().map_while(|n| n.parse().ok()).collect();
            let count = text.split_whitespace().count();
            let numbers = <[f64; 3]>::try_from(numbers).ok();
            let numbers = numbers.filter(|n| count == 3 && n.iter().all(|value| value.is_finite()));
            let numbers =
                numbers.ok_or_else(|| wrong(format!("{:?} is not three numbers", text.trim())))?;
            if let Some(other) = prior
                .filter(|other: &[f64; 3]| other.map(f64::to_bits) != numbers.map(f64::to_bits))
            {
                return Err(wrong(format!("{numbers:?} contradicts the {other:?} before it")));
            }
            prior = Some(numbers);
        }
        Ok(prior)
    }

    /// The element with this name.
    pub(crate) fn element(&self, name: &str) -> Result<Element, LoadError> {
        let element = self.header.elements.iter().find(|element| element.name == name).cloned();
        element.ok_or_else(|| {
            LoadError::damaged(self.path, "header", format!("there is no element {name:?}"))
        })
    }

    /// Calls `each` with the values of `columns` for every row of `wanted`, after skipping the
    /// elements before it. Several elements must be read in the order of the file.
    pub(crate) fn each_row(
        &mut self,
        wanted: &Element,
        columns: &[usize],
        mut each: impl FnMut(&[f64]),
    ) -> Result<(), LoadError> {
        let elements = std::mem::take(&mut self.header.elements);
        let place = elements.iter().position(|element| element.name == wanted.name);
        let skipped = elements.get(self.passed..place.unwrap_or(0)).unwrap_or_default();
        for element in skipped {
            self.rows(element, &[], &mut |_| ())?;
        }
        self.rows(wanted, columns, &mut each)?;
        self.passed += skipped.len() + 1;
        self.header.elements = elements;
        Ok(())
    }

    /// Calls `each` with the list `column` of every row of `wanted`, the only element read after those that were read
    /// or skipped. A list with more than [`MAX_LIST`] values is refused.
    pub(crate) fn each_list(
        &mut self,
        wanted: &Element,
        column: usize,
        mut each: impl FnMut(u64, &[f64]) -> Result<(), String>,
    ) -> Result<(), LoadError> {
        let elements = std::mem::take(&mut self.header.elements);
        let place = elements.iter().position(|element| element.name == wanted.name);
        for element in elements.get(self.passed..place.unwrap_or(0)).unwrap_or_default() {
            self.rows(element, &[], &mut |_| ())?;
        }
        let mut list = Vec::new();
        for index in 0..wanted.rows {
            for (at, property) in wanted.properties.iter().enumerate() {
                let Some(length) = property.list else {
                    self.scalar(wanted, index, property.kind)?;
                    continue;
                };
                if at != column {
                    self.skip_list(wanted, index, length, property.kind)?;
                    continue;
                }
                let length = self.scalar(wanted, index, length)?;
                if !(0.0..=MAX_LIST).contains(&length) {
                    return Err(self.fault(wanted, index, format!("a list of length {length}")));
                }
                list.clear();
                for _ in 0..length as u64 {
                    list.push(self.scalar(wanted, index, property.kind)?);
                }
            }
            each(index, &list).map_err(|problem| self.fault(wanted, index, problem))?;
        }
        self.passed = place.map_or(self.passed, |place| place + 1);
        self.header.elements = elements;
        Ok(())
    }

    fn fault(&self, element: &Element, row: u64, problem: impl Display) -> LoadError {
        let place = format!("{} {row} of {}", element.name, element.rows);
        LoadError::damaged(self.path, place, problem)
    }

    fn rows(
        &mut self,
        element: &Element,
        columns: &[usize],
        each: &mut impl FnMut(&[f64]),
    ) -> Result<(), LoadError> {
        let encoding = self.header.encoding;
        let min_bytes = element.min_bytes(encoding);
        // The last number of an ascii file needs no separator.
        if element.rows.saturating_mul(min_bytes) > self.data + 1 {
            let problem = format!(
                "{} rows need {min_bytes} bytes each, but the file holds {}",
                element.rows, self.data
            );
            let place = format!("element {}", element.name);
            return Err(LoadError::damaged(self.path, place, problem));
        }
        if min_bytes == 0 {
            return Ok(());
        }
        let mut row = vec![0.0; element.properties.len()];
        let mut chosen = vec![0.0; columns.len()];
        for index in 0..element.rows {
            for (value, property) in row.iter_mut().zip(&element.properties) {
                *value = match property.list {
                    None => self.scalar(element, index, property.kind)?,
                    Some(length) => {
                        self.skip_list(element, index, length, property.kind)?;
                        0.0
                    }
                };
            }
            for (value, &column) in chosen.iter_mut().zip(columns) {
                *value = row[column];
            }
            each(&chosen);
        }
        Ok(())
    }

    fn skip_list(
        &mut self,
        element: &Element,
        row: u64,
        length: Scalar,
        kind: Scalar,
    ) -> Result<(), LoadError> {
        let length = self.scalar(element, row, length)?;
        if !(0.0..=f64::from(u32::MAX)).contains(&length) {
            return Err(self.fault(element, row, format!("a list of length {length}")));
        }
        if self.header.encoding == Encoding::Ascii {
            for _ in 0..length as u64 {
                self.scalar(element, row, kind)?;
            }
            return Ok(());
        }
        let bytes = length as u64 * kind.size() as u64;
        let skipped = std::io::copy(&mut (&mut self.input).take(bytes), &mut std::io::sink());
        if skipped.map_err(LoadError::io(self.path))? < bytes {
            return Err(self.fault(element, row, "the file ends here (truncated?)"));
        }
        Ok(())
    }

    fn scalar(&mut self, element: &Element, row: u64, kind: Scalar) -> Result<f64, LoadError> {
        if self.header.encoding == Encoding::Ascii {
            return self.word(element, row);
        }
        let mut bytes = [0; 8];
        let size = kind.size();
        self.input.read_exact(&mut bytes[..size]).map_err(|source| match source.kind() {
            ErrorKind::UnexpectedEof => self.fault(element, row, "the file ends here (truncated?)"),
            _ => LoadError::io(self.path)(source),
        })?;
        if self.header.encoding == Encoding::BigEndian {
            bytes[..size].reverse();
        }
        let [a, b, c, d, ..] = bytes;
        Ok(match kind {
            Scalar::I8 => f64::from(a as i8),
            Scalar::U8 => f64::from(a),
            Scalar::I16 => f64::from(i16::from_le_bytes([a, b])),
            Scalar::U16 => f64::from(u16::from_le_bytes([a, b])),
            Scalar::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            Scalar::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
            Scalar::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            Scalar::F64 => f64::from_le_bytes(bytes),
        })
    }

    /// The next number of an ascii file, whichever line it is on.
    fn word(&mut self, element: &Element, row: u64) -> Result<f64, LoadError> {
        let mut word = [0u8; MAX_WORD];
        let mut length = 0;
        loop {
            let buffer = match self.input.fill_buf() {
                Ok(buffer) => buffer,
                Err(source) if source.kind() == ErrorKind::Interrupted => continue,
                Err(source) => return Err(LoadError::io(self.path)(source)),
            };
            let at_end = buffer.is_empty();
            let mut used = 0;
            let mut ended = at_end;
            for &byte in buffer {
                used += 1;
                if !byte.is_ascii_whitespace() {
                    if length == MAX_WORD {
                        let problem = "a number is longer than 128 characters";
                        return Err(self.fault(element, row, problem));
                    }
                    word[length] = byte;
                    length += 1;
                } else if length > 0 {
                    ended = true;
                    break;
                }
            }
            self.input.consume(used);
            if ended {
                break;
            }
        }
        if length == 0 {
            return Err(self.fault(element, row, "the file ends here (truncated?)"));
        }
        let text = std::str::from_utf8(&word[..length]).ok();
        text.and_then(|text| text.parse().ok()).ok_or_else(|| {
            let text = String::from_utf8_lossy(&word[..length]).into_owned();
            self.fault(element, row, format!("{text:?} is not a number"))
        })
    }
}
