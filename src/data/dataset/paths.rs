//! Paths in data files: untrusted, and never followed out of the dataset's folder.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use unicode_normalization::UnicodeNormalization;

use super::DatasetError;

/// What separates the parts of a path: both, as paths may come from another system.
const SEPARATORS: [char; 2] = ['/', '\\'];
/// Longest name accepted from a data file `[bytes]`.
pub(super) const MAX_NAME: usize = 4096;

/// A folder that paths from data files may not leave.
#[derive(Debug, Clone)]
pub(super) struct Root {
    /// As the user wrote it, for messages.
    shown: PathBuf,
    canonical: PathBuf,
    /// Folders that were searched for names which Unicode can write in several ways.
    searched: Arc<Mutex<BTreeMap<PathBuf, Names>>>,
}

/// Entries of a folder by their composed names, those of ASCII alone left out.
type Names = BTreeMap<String, PathBuf>;

/// A path in a data file, with its place for error messages.
#[derive(Debug, Clone, Copy)]
pub(super) struct DataPath<'a> {
    pub(super) file: &'a Path,
    pub(super) field: &'a str,
    pub(super) value: &'a str,
}

impl Root {
    pub(super) fn new(folder: &Path) -> Result<Self, DatasetError> {
        let canonical = folder.canonicalize().map_err(DatasetError::io(folder))?;
        if !canonical.is_dir() {
            return Err(DatasetError::io(folder)(std::io::ErrorKind::NotADirectory.into()));
        }
        Ok(Self { shown: folder.to_owned(), canonical, searched: Arc::default() })
    }

    pub(super) fn path(&self) -> &Path {
        &self.shown
    }

    /// The full path, after all checks that need no file system. The file need not exist.
    pub(super) fn join(&self, named: DataPath<'_>) -> Result<PathBuf, DatasetError> {
        match lexical_fault(named.value) {
            None => Ok(self.shown.join(relative(named.value))),
            Some(problem) => Err(named.fault(problem)),
        }
    }

    /// As [`existing`](Self::existing), or else with the separators of Windows read as such. Where there is a file of
    /// the literal name, it is that one.
    pub(super) fn listed(&self, named: DataPath<'_>) -> Result<Option<PathBuf>, DatasetError> {
        match self.existing(named)? {
            None if named.value.contains('\\') => {
                self.existing(DataPath { value: &named.value.replace('\\', "/"), ..named })
            }
            found => Ok(found),
        }
    }

    /// As [`join`](Self::join), also refusing links that lead out; `None` if there is no such file.
    pub(super) fn existing(&self, named: DataPath<'_>) -> Result<Option<PathBuf>, DatasetError> {
        let mut path = self.join(named)?;
        if !named.value.is_ascii() && !path.exists() {
            path = self.spelled_otherwise(&relative(named.value)).unwrap_or(path);
        }
        match path.canonicalize() {
            Ok(real) if !real.starts_with(&self.canonical) => {
                Err(named.fault("leads out of the folder through a symbolic link"))
            }
            Ok(real) if real.is_file() => Ok(Some(path)),
            _ => Ok(None),
        }
    }

    /// The file with the same letters: an accent may be a part of its letter or follow it. macOS writes names of
    /// files in the one way, and what lists them mostly in the other.
    fn spelled_otherwise(&self, value: &str) -> Option<PathBuf> {
        let mut path = self.shown.clone();
        for part in value.split('/') {
            let plain = path.join(part);
            path = match part.is_ascii() || plain.exists() {
                true => plain,
                false => self.entry(path, part)?,
            };
        }
        Some(path)
    }

    /// The entry of a folder that has this name in any spelling.
    fn entry(&self, folder: PathBuf, name: &str) -> Option<PathBuf> {
        // What is outside is not even listed.
        if !folder.canonicalize().ok()?.starts_with(&self.canonical) {
            return None;
        }
        let mut searched = self.searched.lock().unwrap_or_else(PoisonError::into_inner);
        let names = searched.entry(folder).or_insert_with_key(|folder| names(folder));
        names.get(&name.nfc().collect::<String>()).cloned()
    }
}

fn names(folder: &Path) -> Names {
    let mut entries: Vec<PathBuf> =
        fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()).collect();
    // Of several with the same letters the last counts, in whatever order the system lists them.
    entries.sort();
    let name = |path: PathBuf| {
        let name = path.file_name()?.to_str().filter(|name| !name.is_ascii())?;
        Some((name.nfc().collect(), path))
    };
    entries.into_iter().filter_map(name).collect()
}

impl<'a> DataPath<'a> {
    /// What of an absolute path of any system may lie below a folder: all of it, then without its first part, and so
    /// on. What would be absolute itself is left out.
    pub(super) fn ends(self) -> Result<impl Iterator<Item = String> + use<'a>, DatasetError> {
        let parts = parts(self.value);
        let problem = if parts.is_empty() { Some("is empty") } else { text_fault(self.value) };
        match problem {
            Some(problem) => Err(self.fault(problem)),
            None => Ok((0..parts.len())
                .map(move |first| parts[first..].join("/"))
                .filter(|end| !is_absolute(end))),
        }
    }

    fn fault(self, problem: &str) -> DatasetError {
        let value: String = self.value.chars().take(200).collect();
        let problem = format!("the path {value:?} {problem}");
        let remedy = "only paths below the dataset's folder are followed (a folder elsewhere can be named with \
                      --images)";
        DatasetError::malformed(self.file, self.field, problem, remedy)
    }
}

/// The path without `./` parts, with `/` as separator: the name of a view.
pub(super) fn relative(value: &str) -> String {
    value.split('/').filter(|part| !part.is_empty() && *part != ".").collect::<Vec<_>>().join("/")
}

/// Whether it begins at the root, a drive or a scheme, of whatever system.
pub(super) fn is_absolute(value: &str) -> bool {
    value.starts_with(['/', '\\'])
        || value.as_bytes().get(1) == Some(&b':')
        || value.starts_with("file:")
}

/// What is wrong with a path, as far as its text says.
pub(super) fn lexical_fault(value: &str) -> Option<&'static str> {
    if relative(value).is_empty() {
        Some("is empty")
    } else if is_absolute(value) {
        // What is worse is said of such a path, too.
        text_fault(value).or(Some("is absolute"))
    } else {
        text_fault(value)
    }
}

/// The same, wherever it begins.
fn text_fault(value: &str) -> Option<&'static str> {
    if value.len() > MAX_NAME {
        Some("is longer than 4 KiB")
    } else if value.contains(char::is_control) {
        Some("contains a control character")
    } else if value.split(SEPARATORS).any(|part| part == "..") {
        Some("contains `..`")
    } else {
        None
    }
}

/// The parts of an absolute path of any system, without its scheme and drive: `file:///C:/a`, `\\?\C:\a` and `/a`
/// are all `a`.
fn parts(value: &str) -> Vec<&str> {
    let local = value.strip_prefix("file:").unwrap_or(value).trim_start_matches(SEPARATORS);
    let local = local.strip_prefix(['?', '.']).filter(|rest| rest.starts_with(SEPARATORS));
    let local = local.unwrap_or_else(|| value.strip_prefix("file:").unwrap_or(value));
    let local = local.trim_start_matches(SEPARATORS);
    let local = match local.as_bytes().get(1) {
        Some(b':') => &local[2..],
        _ => local,
    };
    local.split(SEPARATORS).filter(|part| !part.is_empty() && *part != ".").collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Both ways to write "Küche/é.png".
    const SPELLINGS: [&str; 2] = ["K\u{fc}che/\u{e9}.png", "Ku\u{308}che/e\u{301}.png"];

    fn existing(root: &Root, value: &str) -> Result<Option<PathBuf>, DatasetError> {
        root.existing(DataPath { file: Path::new("list"), field: "name", value })
    }

    #[test]
    fn letters_count_and_not_how_they_are_written() {
        for (listed, written) in [(0, 1), (1, 0)].map(|(a, b)| (SPELLINGS[a], SPELLINGS[b])) {
            let folder = tempfile::tempdir().unwrap();
            let file = folder.path().join(written);
            fs::create_dir(file.parent().unwrap()).unwrap();
            fs::write(&file, "photograph").unwrap();
            let root = Root::new(folder.path()).unwrap();
            let found = existing(&root, listed).unwrap().expect(listed);
            assert_eq!(fs::read(found).unwrap(), b"photograph");
            assert_eq!(existing(&root, "K\u{fc}che/e.png").unwrap(), None, "another letter");
            assert!(existing(&root, "../K\u{fc}che/\u{e9}.png").is_err());
            // Where there are both, the one that is listed.
            let both = folder.path().join(listed);
            fs::create_dir_all(both.parent().unwrap()).unwrap();
            fs::write(&both, "itself").unwrap();
            assert_eq!(fs::read(existing(&root, listed).unwrap().unwrap()).unwrap(), b"itself");
        }
    }

    #[cfg(unix)]
    #[test]
    fn no_spelling_leads_out() {
        let (folder, outside) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        fs::write(outside.path().join("e\u{301}.png"), "secret").unwrap();
        std::os::unix::fs::symlink(outside.path(), folder.path().join("out")).unwrap();
        let secret = outside.path().join("e\u{301}.png");
        std::os::unix::fs::symlink(secret, folder.path().join("o\u{308}.png")).unwrap();
        let root = Root::new(folder.path()).unwrap();
        assert!(existing(&root, "out/\u{e9}.png").is_ok_and(|found| found.is_none()));
        assert!(existing(&root, "\u{f6}.png").is_err());
    }
}
