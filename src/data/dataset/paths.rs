//! Paths in data files. They are untrusted and never followed out of the dataset's folder.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use unicode_normalization::UnicodeNormalization;

use crate::error::{LoadError, LoadRemedy};

/// Path separators of all systems, as paths may come from another system.
const SEPARATORS: [char; 2] = ['/', '\\'];
/// Extensions of photographs that COLMAP reads.
pub(super) const PHOTOGRAPHS: [&str; 7] = ["jpg", "jpeg", "png", "webp", "tif", "tiff", "bmp"];
/// Longest name accepted from a data file `[bytes]`.
pub(super) const MAX_NAME: usize = 4096;

/// A folder that paths from data files may not leave.
#[derive(Debug, Clone)]
pub(super) struct Root {
    /// The path as the user wrote it, for messages.
    shown: PathBuf,
    canonical: PathBuf,
    /// Listings of folders that were searched for names with several Unicode spellings.
    searched: Arc<Mutex<BTreeMap<PathBuf, Names>>>,
}

/// The entries with non-ASCII names in a folder, by their names in Unicode normalisation form C.
type Names = BTreeMap<String, PathBuf>;

/// A path in a data file, with its location for error messages.
#[derive(Debug, Clone, Copy)]
pub(super) struct DataPath<'a> {
    pub(super) file: &'a Path,
    pub(super) field: &'a str,
    pub(super) value: &'a str,
}

impl Root {
    pub(super) fn new(folder: &Path) -> Result<Self, LoadError> {
        let canonical = folder.canonicalize().map_err(LoadError::io(folder))?;
        if !canonical.is_dir() {
            return Err(LoadError::io(folder)(std::io::ErrorKind::NotADirectory.into()));
        }
        Ok(Self { shown: folder.to_owned(), canonical, searched: Arc::default() })
    }

    pub(super) fn path(&self) -> &Path {
        &self.shown
    }

    /// Returns true if another folder is this one or lies in it.
    pub(super) fn contains(&self, other: &Self) -> bool {
        other.canonical.starts_with(&self.canonical)
    }

    /// The full path, after all checks that do not need the file system. The file need not exist.
    pub(super) fn join(&self, named: DataPath<'_>) -> Result<PathBuf, LoadError> {
        match lexical_fault(named.value) {
            None => Ok(self.shown.join(relative(named.value))),
            Some(problem) => Err(named.fault(problem)),
        }
    }

    /// As [`existing`](Self::existing); if there is no file of the literal name, backslashes count as separators.
    pub(super) fn existing_on_any_system(
        &self,
        named: DataPath<'_>,
    ) -> Result<Option<PathBuf>, LoadError> {
        match self.existing(named)? {
            None if named.value.contains('\\') => {
                self.existing(DataPath { value: &named.value.replace('\\', "/"), ..named })
            }
            found => Ok(found),
        }
    }

    /// As [`join`](Self::join), but also refuses links that lead out of the folder; `None` if there is no such file.
    pub(super) fn existing(&self, named: DataPath<'_>) -> Result<Option<PathBuf>, LoadError> {
        let mut path = self.join(named)?;
        if !path.exists() {
            let spelled = (!named.value.is_ascii())
                .then(|| self.other_spelling(&relative(named.value)))
                .flatten();
            path = spelled.or_else(|| other_case(&path)).unwrap_or(path);
        }
        match path.canonicalize() {
            Ok(real) if !real.starts_with(&self.canonical) => {
                Err(named.fault("leads out of the folder through a symbolic link"))
            }
            Ok(real) if real.is_file() => Ok(Some(path)),
            _ => Ok(None),
        }
    }

    /// The file with the same name in another Unicode spelling: an accent may be a part of its letter or follow it.
    /// macOS stores file names in one form, and programs mostly list them in the other.
    fn other_spelling(&self, value: &str) -> Option<PathBuf> {
        let mut path = self.shown.clone();
        for part in value.split('/') {
            let plain = path.join(part);
            let is_plain = part.is_ascii() || plain.exists();
            path = if is_plain { plain } else { self.entry(path, part)? };
        }
        Some(path)
    }

    /// The entry of a folder with this name in any Unicode spelling.
    fn entry(&self, folder: PathBuf, name: &str) -> Option<PathBuf> {
        // Folders outside the root are not even listed.
        if !folder.canonicalize().ok()?.starts_with(&self.canonical) {
            return None;
        }
        let mut searched = self.searched.lock().unwrap_or_else(PoisonError::into_inner);
        let names = searched.entry(folder).or_insert_with_key(|folder| names(folder));
        names.get(&name.nfc().collect::<String>()).cloned()
    }
}

/// The file whose extension is in the other case, such as `a.JPG` for `a.jpg`: Windows and macOS do not distinguish them.
fn other_case(path: &Path) -> Option<PathBuf> {
    let ending = path.extension()?.to_str()?;
    let cases = [ending.to_ascii_lowercase(), ending.to_ascii_uppercase()];
    cases.iter().map(|ending| path.with_extension(ending)).find(|path| path.exists())
}

/// The name of a photograph beside `path` that differs from it only by its extension.
pub(super) fn namesake(path: &Path) -> Option<String> {
    let both = PHOTOGRAPHS.iter().flat_map(|ending| [(*ending).to_owned(), ending.to_uppercase()]);
    let other = both.map(|ending| path.with_extension(ending)).find(|other| other.is_file())?;
    Some(other.file_name()?.to_string_lossy().into_owned())
}

/// Words for the [`namesake`] of a missing photograph, to follow its name; empty if there is none.
pub(super) fn existing_namesake(path: &Path) -> String {
    namesake(path).map_or_else(String::new, |other| format!("; {other} exists"))
}

fn names(folder: &Path) -> Names {
    let mut entries: Vec<PathBuf> =
        fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()).collect();
    // Of several spellings of one name, the last in sorted order counts, whatever order the system lists them in.
    entries.sort();
    let name = |path: PathBuf| {
        let name = path.file_name()?.to_str().filter(|name| !name.is_ascii())?;
        Some((name.nfc().collect(), path))
    };
    entries.into_iter().filter_map(name).collect()
}

impl<'a> DataPath<'a> {
    /// The suffixes of an absolute path of any system, longest first, each of which is a relative path.
    pub(super) fn suffixes(self) -> Result<impl Iterator<Item = String> + use<'a>, LoadError> {
        let parts = parts(self.value);
        let problem = if parts.is_empty() { Some("is empty") } else { text_fault(self.value) };
        match problem {
            Some(problem) => Err(self.fault(problem)),
            None => Ok((0..parts.len())
                .map(move |first| parts[first..].join("/"))
                .filter(|suffix| !is_absolute(suffix))),
        }
    }

    fn fault(self, problem: &str) -> LoadError {
        let value: String = self.value.chars().take(200).collect();
        let problem = format!("the path {value:?} {problem}");
        LoadError::remedied(self.file, self.field, problem, LoadRemedy::OtherImagesFolder)
    }
}

/// The path without `./` parts, with `/` as separator, as in the names of views.
pub(super) fn relative(value: &str) -> String {
    value.split('/').filter(|part| !part.is_empty() && *part != ".").collect::<Vec<_>>().join("/")
}

/// Returns true if a path of any system begins with a root, a drive or a scheme.
pub(super) fn is_absolute(value: &str) -> bool {
    value.starts_with(['/', '\\'])
        || value.as_bytes().get(1) == Some(&b':')
        || value.starts_with("file:")
}

/// The problem that the text of a path shows, if there is one.
pub(super) fn lexical_fault(value: &str) -> Option<&'static str> {
    if relative(value).is_empty() {
        Some("is empty")
    } else if is_absolute(value) {
        // More serious problems take precedence.
        text_fault(value).or(Some("is absolute"))
    } else {
        text_fault(value)
    }
}

/// As [`lexical_fault`], for paths that may be absolute.
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

/// The parts of an absolute path of any system without scheme and drive: `file:///C:/a`, `\\?\C:\a` and `/a` all
/// become `a`.
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

    /// The two Unicode spellings of "Küche/é.png".
    const SPELLINGS: [&str; 2] = ["K\u{fc}che/\u{e9}.png", "Ku\u{308}che/e\u{301}.png"];

    fn existing(root: &Root, value: &str) -> Result<Option<PathBuf>, LoadError> {
        root.existing(DataPath { file: Path::new("list"), field: "name", value })
    }

    #[test]
    fn names_are_found_in_either_unicode_spelling() {
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
            // If both spellings exist, the listed one counts.
            let both = folder.path().join(listed);
            fs::create_dir_all(both.parent().unwrap()).unwrap();
            fs::write(&both, "itself").unwrap();
            assert_eq!(fs::read(existing(&root, listed).unwrap().unwrap()).unwrap(), b"itself");
        }
    }

    #[test]
    fn extensions_are_found_in_either_case() {
        for (listed, written) in [("a.JPG", "a.jpg"), ("a.jpg", "a.JPG"), ("é.png", "é.PNG")] {
            let folder = tempfile::tempdir().unwrap();
            fs::write(folder.path().join(written), "other").unwrap();
            let root = Root::new(folder.path()).unwrap();
            let found = existing(&root, listed).unwrap().expect(listed);
            assert_eq!(fs::read(found).unwrap(), b"other");
            assert_eq!(existing(&root, "A.jpg").unwrap(), None, "another name");
            // If both exist, the listed one counts.
            fs::write(folder.path().join(listed), "itself").unwrap();
            assert_eq!(fs::read(existing(&root, listed).unwrap().unwrap()).unwrap(), b"itself");
        }
    }

    #[cfg(unix)]
    #[test]
    fn no_spelling_leads_out_of_the_folder() {
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
