//! Lets `tobj` read a text file statement by statement, each checked before.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, BufRead as _, BufReader, Read};
use std::path::Path;

use tobj::LoadError;

use crate::error::Error;

/// Longest line `[bytes]`: a polygon of a million corners.
const MAX_LINE: u64 = 1 << 24;

/// A line of an OBJ or MTL file.
#[derive(Clone, Copy)]
pub(super) struct Statement<'a> {
    path: &'a Path,
    pub(super) line: usize,
    pub(super) key: &'a str,
    /// The text after the key, with comments.
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

    /// An error in this statement.
    pub(super) fn fault(&self, problem: impl Into<String>) -> Error {
        fault(self.path, self.line, problem)
    }
}

/// A file that `tobj` reads. However large it is, only one line is in memory.
pub(super) struct Statements<'a> {
    path: &'a Path,
    file: BufReader<File>,
    /// Returns the lines that `tobj` reads in place of a statement.
    check: &'a mut dyn FnMut(Statement<'_>) -> Result<String, Error>,
    /// Lines read so far.
    lines: usize,
    /// What is left to read of the last statement's lines.
    checked: VecDeque<u8>,
    /// Why a statement was refused: `tobj` drops the causes of read errors.
    refused: Option<Error>,
}

impl<'a> Statements<'a> {
    pub(super) fn open(
        path: &'a Path,
        check: &'a mut dyn FnMut(Statement<'_>) -> Result<String, Error>,
    ) -> Result<Self, Error> {
        let file = BufReader::new(File::open(path).map_err(Error::io(path))?);
        Ok(Self { path, file, check, lines: 0, checked: VecDeque::new(), refused: None })
    }

    /// What `tobj` made of the file. Its errors get the line that was read last.
    pub(super) fn outcome<T>(self, result: Result<T, LoadError>) -> Result<T, Error> {
        match self.refused {
            Some(error) => Err(error),
            None => result.map_err(|error| fault(self.path, self.lines, error.to_string())),
        }
    }

    /// Checks the next statement; false at the end of the file.
    fn check_next(&mut self) -> Result<bool, Error> {
        let mut line = Vec::new();
        if !self.append_line(&mut line)? {
            return Ok(false);
        }
        let number = self.lines;
        // A backslash at the end continues a line.
        while line.ends_with(b"\\") {
            line.pop();
            line.push(b' ');
            if !self.append_line(&mut line)? {
                break;
            }
        }
        let line = String::from_utf8_lossy(&line);
        let (key, text) = split_word(line.trim());
        let statement = Statement { path: self.path, line: number, key, text };
        self.checked = (self.check)(statement)?.into_bytes().into();
        Ok(true)
    }

    /// Appends the text up to the next line break; false at the end of the file.
    fn append_line(&mut self, line: &mut Vec<u8>) -> Result<bool, Error> {
        let room = MAX_LINE.saturating_sub(line.len() as u64);
        let read = (&mut self.file).take(room + 1).read_until(b'\n', line);
        if read.map_err(Error::io(self.path))? == 0 {
            return Ok(false);
        }
        self.lines += 1;
        if line.len() as u64 > MAX_LINE {
            return Err(fault(self.path, self.lines, "it is longer than 16 MiB"));
        }
        line.truncate(line.trim_ascii_end().len());
        Ok(true)
    }
}

/// Reads no further than to the end of a statement, so that the last line is that of an error.
impl Read for Statements<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        while self.checked.is_empty() {
            match self.check_next() {
                Ok(true) => {}
                Ok(false) => break,
                Err(error) => {
                    self.refused = Some(error);
                    return Err(io::ErrorKind::InvalidData.into());
                }
            }
        }
        self.checked.read(buffer)
    }
}

fn fault(path: &Path, line: usize, problem: impl Into<String>) -> Error {
    let remedy = "correct the file or export it again";
    Error::malformed(path, format!("line {line}"), problem, remedy)
}

/// The first word and what follows it.
pub(super) fn split_word(text: &str) -> (&str, &str) {
    let (word, rest) = text.split_once(char::is_whitespace).unwrap_or((text, ""));
    (word, rest.trim_start())
}

/// Text of the file, short enough for a message.
pub(super) fn shortened(text: &str) -> String {
    text.chars().take(80).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &[u8]) -> Result<String, Error> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("lines.obj");
        std::fs::write(&path, text).expect("written");
        let mut numbered = |s: Statement<'_>| Ok(format!("{} {} {}\n", s.line, s.key, s.text));
        let mut statements = Statements::open(&path, &mut numbered)?;
        let mut all = String::new();
        let result = statements.read_to_string(&mut all).map_err(|_| LoadError::ReadError);
        statements.outcome(result)?;
        Ok(all)
    }

    #[test]
    fn lines_are_numbered_and_joined() {
        let found = read(b"a b \r\n\nc\\\nd\\ \n e\nf\xff\\").expect("text");
        assert_eq!(found, "1 a b\n2  \n3 c d  e\n6 f\u{fffd} \n");
        assert!(read(b"").expect("nothing").is_empty());
    }

    #[test]
    fn a_line_without_end_is_refused() {
        let mut text = b"v 0 0 0\n".to_vec();
        text.resize(text.len() + MAX_LINE as usize, b'x');
        assert_eq!(read(&text).expect("the longest line").lines().count(), 2);
        text.push(b'x');
        let fault = read(&text).expect_err("one byte too many").to_string();
        assert!(fault.contains("line 2") && fault.contains("16 MiB"), "{fault}");
    }
}
