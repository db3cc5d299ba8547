//! A text file line by line, as OBJ and MTL write them. A file of gigabytes takes no more memory
//! than its longest line.

use std::fs::File;
use std::io::{BufRead as _, BufReader, Read as _};
use std::path::Path;

use crate::error::Error;

/// Longest line `[bytes]`: a polygon of a million corners.
const MAX_LINE: u64 = 1 << 24;

/// The lines of a file.
pub(crate) struct Lines<'a> {
    path: &'a Path,
    file: BufReader<File>,
    /// Lines read.
    read: usize,
}

impl<'a> Lines<'a> {
    pub(crate) fn open(path: &'a Path) -> Result<Self, Error> {
        let file = File::open(path).map_err(Error::io(path))?;
        Ok(Self { path, file: BufReader::new(file), read: 0 })
    }

    /// The next line and the number of its first part: joined where a part ends with a backslash,
    /// without white space at the end.
    pub(crate) fn next(&mut self) -> Result<Option<(usize, String)>, Error> {
        let mut line = Vec::new();
        if !self.part(&mut line)? {
            return Ok(None);
        }
        let number = self.read;
        while line.ends_with(b"\\") {
            line.pop();
            line.push(b' ');
            if !self.part(&mut line)? {
                break;
            }
        }
        Ok(Some((number, String::from_utf8_lossy(&line).trim_end().to_owned())))
    }

    /// Appends what stands before the next line break; false at the end of the file.
    fn part(&mut self, line: &mut Vec<u8>) -> Result<bool, Error> {
        let room = MAX_LINE.saturating_sub(line.len() as u64);
        let read = (&mut self.file).take(room + 1).read_until(b'\n', line);
        if read.map_err(Error::io(self.path))? == 0 {
            return Ok(false);
        }
        self.read += 1;
        if line.len() as u64 > MAX_LINE {
            return Err(fault(self.path, self.read, "it is longer than 16 MiB"));
        }
        line.truncate(line.trim_ascii_end().len());
        Ok(true)
    }
}

/// Something is wrong in a line.
pub(crate) fn fault(path: &Path, line: usize, problem: impl Into<String>) -> Error {
    Error::Malformed {
        path: path.to_owned(),
        element: format!("line {line}"),
        problem: problem.into(),
        remedy: "correct the file or export it again",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &[u8]) -> Result<Vec<(usize, String)>, Error> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("lines.obj");
        std::fs::write(&path, text).expect("written");
        let mut lines = Lines::open(&path)?;
        std::iter::from_fn(|| lines.next().transpose()).collect()
    }

    #[test]
    fn lines_are_numbered_and_joined() {
        let found = read(b"a b \r\n\nc\\\nd\\ \n e\nf\xff\\").expect("text");
        let expected = [(1, "a b"), (2, ""), (3, "c d  e"), (6, "f\u{fffd}")];
        let shown: Vec<_> = found.iter().map(|(n, line)| (*n, line.as_str())).collect();
        assert_eq!(shown, expected);
        assert!(read(b"").expect("nothing").is_empty());
    }

    #[test]
    fn a_line_without_end_is_refused() {
        let mut text = b"v 0 0 0\n".to_vec();
        text.resize(text.len() + MAX_LINE as usize, b'x');
        assert_eq!(read(&text).expect("as long as may be").len(), 2);
        text.push(b'x');
        let fault = read(&text).expect_err("one byte too many").to_string();
        assert!(fault.contains("line 2") && fault.contains("16 MiB"), "{fault}");
    }
}
