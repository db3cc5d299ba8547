//! Reading of untrusted files. Only regular files are read, up to a maximum size, and control characters are
//! escaped before their text is shown.

use std::fs::{File, OpenOptions};
use std::io::{self, Read};
use std::path::Path;

/// The message for a file that is not UTF-8, often only because of a file name that it contains.
pub(super) const NOT_UTF8: &str = "it is not text in UTF-8; save it as UTF-8, and rename files whose names are in another encoding";
/// Maximum size of a file that holds options `[bytes]`.
pub const MAX_OPTIONS_BYTES: u64 = 4 << 20;

/// Opens a file for reading. Pipes, sockets and devices are refused without waiting for their data.
///
/// # Errors
/// When it cannot be opened, or is not a regular file.
pub fn open(path: &Path) -> io::Result<File> {
    let mut options = OpenOptions::new();
    options.read(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::custom_flags(&mut options, libc::O_NONBLOCK);
    let file = options.open(path)?;
    let kind = file.metadata()?.file_type();
    if kind.is_file() {
        Ok(file)
    } else if kind.is_dir() {
        Err(io::ErrorKind::IsADirectory.into())
    } else {
        Err(io::Error::other("it is a pipe, a socket or a device, not a file; name a file"))
    }
}

/// Reads a text of at most `limit` bytes, without the byte-order mark that some editors write.
///
/// # Errors
/// The errors of [`open`], and when the file is larger than `limit` or not text in UTF-8.
pub fn read_text(path: &Path, limit: u64) -> io::Result<String> {
    let mut bytes = Vec::new();
    open(path)?.take(limit + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > limit {
        return Err(io::Error::other(format!(
            "it is larger than {} MiB; put the right file there",
            limit >> 20
        )));
    }
    if let Some(problem) = wrong_kind(&bytes) {
        return Err(io::Error::other(problem));
    }
    let text = String::from_utf8(bytes).map_err(|_| io::Error::other(NOT_UTF8))?;
    Ok(match text.strip_prefix('\u{feff}') {
        Some(rest) => rest.to_owned(),
        None => text,
    })
}

/// Maximum unpacked size `[bytes]` of a compressed file of `packed` bytes.
pub fn max_unpacked_bytes(packed: u64) -> u64 {
    /// The limit for small files.
    const MIN_LIMIT: u64 = 64 << 20;
    /// Limit per packed byte of a larger file. Models unpack to 2 to 5 times their packed size (up to 20 times if they
    /// have little colour information), text tables to up to 10 times.
    const RATIO: u64 = 100;
    MIN_LIMIT.max(packed.saturating_mul(RATIO))
}

/// Recognises, by its first bytes, a file that is often found in place of the real one; returns a message with the
/// remedy.
pub fn wrong_kind(start: &[u8]) -> Option<&'static str> {
    if start.starts_with(b"version https://git-lfs") {
        Some("it is a Git LFS pointer, not the file itself; fetch the file with `git lfs pull`")
    } else if start.starts_with(&[0xff, 0xfe]) || start.starts_with(&[0xfe, 0xff]) {
        Some("it is text in UTF-16; save it as UTF-8")
    } else {
        None
    }
}

/// Escapes control characters, so that a text stays on one line and no terminal executes them.
pub fn one_line(text: &str) -> String {
    escaped(text, &[])
}

/// Escapes control characters except line breaks and tabs.
pub fn multi_line(text: &str) -> String {
    escaped(text, &['\n', '\t'])
}

fn escaped(text: &str, kept: &[char]) -> String {
    let mut shown = String::with_capacity(text.len());
    for c in text.chars() {
        if c.is_control() && !kept.contains(&c) {
            shown.extend(c.escape_default());
        } else {
            shown.push(c);
        }
    }
    shown
}

/// The folder that holds a file; `.` for a bare file name.
pub fn folder_of(file: &Path) -> &Path {
    match file.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_read_up_to_the_size_limit_and_other_contents_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("text");
        let read = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            read_text(&path, 1 << 20).map_err(|error| error.to_string())
        };
        assert_eq!(read("\u{feff}{}".as_bytes()).unwrap(), "{}");
        assert_eq!(read(&vec![b' '; 1 << 20]).unwrap().len(), 1 << 20);
        for (bytes, words) in [
            (&vec![b' '; (1 << 20) + 1][..], "larger than 1 MiB"),
            (b"\xff\xfe{\0}\0", "UTF-16"),
            (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
            (b"\xc3(", "not text in UTF-8"),
        ] {
            let error = read(bytes).unwrap_err();
            assert!(error.contains(words), "{error}");
        }
        assert_eq!(open(folder.path()).unwrap_err().kind(), io::ErrorKind::IsADirectory);
    }

    #[cfg(unix)]
    #[test]
    fn pipes_and_devices_are_refused_without_waiting() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pipe");
        let status = std::process::Command::new("mkfifo").arg(&path).status().unwrap();
        assert!(status.success());
        for path in [&path, Path::new("/dev/zero")] {
            let error = read_text(path, 10).unwrap_err().to_string();
            assert!(error.contains("not a file"), "{error}");
        }
    }

    #[test]
    fn control_characters_are_escaped() {
        let text = "a\x1b[31m\r\nü\u{9b}";
        assert_eq!(one_line(text), "a\\u{1b}[31m\\r\\nü\\u{9b}");
        assert_eq!(multi_line(text), "a\\u{1b}[31m\\r\nü\\u{9b}");
    }
}
