//! Reads OBJ and MTL files statement by statement.

use std::fmt::Display;
use std::io::{BufRead as _, BufReader, Read as _};
use std::path::Path;

use glam::DVec3;

use crate::error::Error;
use crate::resource;

/// Longest line `[bytes]`, enough for a polygon of a million corners.
const MAX_LINE: u64 = 1 << 24;

/// A line of an OBJ or MTL file.
#[derive(Clone, Copy)]
pub(super) struct Statement<'a> {
    pub(super) path: &'a Path,
    pub(super) line: usize,
    pub(super) key: &'a str,
    /// The text after the key, including comments.
    pub(super) text: &'a str,
}

impl<'a> Statement<'a> {
    /// The text after the key, without comments.
    pub(super) fn value(&self) -> &'a str {
        self.text.split('#').next().unwrap_or(self.text).trim()
    }

    pub(super) fn words(&self) -> impl Iterator<Item = &'a str> + Clone + use<'a> {
        self.value().split_whitespace()
    }

    /// The first words, at most `max_count`, as numbers.
    pub(super) fn numbers(&self, max_count: usize) -> Result<Vec<f64>, Error> {
        let parse = |word: &str| {
            word.parse()
                .map_err(|_| self.fault(format!("{:?} is not a number", resource::shortened(word))))
        };
        self.words().take(max_count).map(parse).collect()
    }

    /// The first three words as a vector.
    pub(super) fn vector(&self) -> Result<DVec3, Error> {
        match self.numbers(3)?[..] {
            [x, y, z] => Ok(DVec3::new(x, y, z)),
            _ => Err(self.fault(format!("{} needs three numbers", self.key))),
        }
    }

    /// An error in this statement.
    pub(super) fn fault(&self, problem: impl Display) -> Error {
        fault(self.path, self.line, problem)
    }
}

/// Passes the statements of a file to `read`, holding only one line in memory.
pub(super) fn for_each(
    path: &Path,
    mut read: impl FnMut(Statement<'_>) -> Result<(), Error>,
) -> Result<(), Error> {
    let mut file = BufReader::new(resource::open(path)?);
    let (mut text, mut lines) = (Vec::new(), 0);
    loop {
        text.clear();
        let line = lines + 1;
        // A backslash at the end of a line continues it.
        loop {
            let room = MAX_LINE - text.len() as u64;
            let count = (&mut file).take(room + 1).read_until(b'\n', &mut text);
            if count.map_err(Error::io(path))? == 0 {
                break;
            }
            lines += 1;
            if text.len() as u64 > MAX_LINE {
                return Err(fault(path, lines, "it is longer than 16 MiB"));
            }
            text.truncate(text.trim_ascii_end().len());
            match text.last_mut() {
                Some(end) if *end == b'\\' => *end = b' ',
                _ => break,
            }
        }
        if lines < line {
            return Ok(());
        }
        let bytes: &[u8] = if line == 1 {
            resource::without_bom(&text).map_err(|problem| fault(path, line, problem))?
        } else {
            &text
        };
        let text = String::from_utf8_lossy(bytes);
        let (key, text) = split_word(text.trim());
        read(Statement { path, line, key, text })?;
    }
}

fn fault(path: &Path, line: usize, problem: impl Display) -> Error {
    let remedy = "correct the file or export it again";
    Error::malformed(path, format!("line {line}"), problem, remedy)
}

/// The first word and the rest.
pub(super) fn split_word(text: &str) -> (&str, &str) {
    let (word, rest) = text.split_once(char::is_whitespace).unwrap_or((text, ""));
    (word, rest.trim_start())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &[u8]) -> Result<String, Error> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("lines.obj");
        std::fs::write(&path, text).expect("written");
        let mut all = String::new();
        for_each(&path, |s| {
            all += &format!("{} {} {}\n", s.line, s.key, s.text);
            Ok(())
        })?;
        Ok(all)
    }

    #[test]
    fn lines_are_numbered_and_joined() {
        let found = read(b"a b \r\n\nc\\\nd\\ \n e\nf\xff\\").expect("text");
        assert_eq!(found, "1 a b\n2  \n3 c d  e\n6 f\u{fffd} \n");
        assert!(read(b"").expect("nothing").is_empty());
    }

    #[test]
    fn a_line_longer_than_16_mib_is_refused() {
        let mut text = b"v 0 0 0\n".to_vec();
        text.resize(text.len() + MAX_LINE as usize, b'x');
        assert_eq!(read(&text).expect("the longest line").lines().count(), 2);
        text.push(b'x');
        let fault = read(&text).expect_err("one byte too many").to_string();
        assert!(fault.contains("line 2") && fault.contains("16 MiB"), "{fault}");
    }
}
