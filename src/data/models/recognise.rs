//! Opens a model of any format, recognised by its content and never by its name.
//!
//! A file's own statements about its size are never trusted: memory is allocated only for bytes that exist, and
//! compressed data may expand only up to [`files::max_unpacked_bytes`].

use std::cell::OnceCell;
use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::{Path, PathBuf};

use super::{Format, SplatFile, formats, lists, names, sidecar};
use crate::error::LoadError;
use densify_core::files;

/// Number of bytes at the start of a file that are used to recognise its format.
const START: u64 = 64;
/// Largest accepted JSON file, such as glTF with embedded buffers `[bytes]`.
const MAX_JSON: u64 = 1 << 30;

/// The functions that recognise and read a format's files.
#[derive(Debug, Clone, Copy)]
pub struct Reader {
    /// Judges from a file's content whether it has this format.
    pub recognise: fn(&ModelFile<'_>) -> Result<Match, LoadError>,
    /// Reads a file that was recognised.
    pub read: fn(ModelFile<'_>) -> Result<SplatFile, LoadError>,
    /// The file that makes a folder a model of this format; `None` if a model is always one file.
    pub main_file: Option<&'static str>,
}

/// The certainty that a file has a format, judged by its content.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Match {
    /// The file has another format.
    None,
    /// The file may have this format, if no other claims it with certainty.
    Weak,
    /// The file has this format.
    Strong,
}

impl Match {
    pub(super) fn strong_if(condition: bool) -> Self {
        if condition { Self::Strong } else { Self::None }
    }

    pub(super) fn weak_if(condition: bool) -> Self {
        if condition { Self::Weak } else { Self::None }
    }
}

/// An opened model file.
#[derive(Debug)]
pub struct ModelFile<'a> {
    pub(super) path: &'a Path,
    /// Its first bytes, at most [`START`].
    pub(super) start: Vec<u8>,
    /// Its length `[bytes]`.
    pub(super) length: u64,
    /// The file from its first byte.
    pub(super) input: BufReader<File>,
    json: OnceCell<String>,
}

impl<'a> ModelFile<'a> {
    fn open(path: &'a Path) -> Result<Self, LoadError> {
        let mut file = files::open(path).map_err(LoadError::io(path))?;
        let mut start = Vec::new();
        (&mut file).take(START).read_to_end(&mut start).map_err(LoadError::io(path))?;
        file.rewind().map_err(LoadError::io(path))?;
        if let Some(problem) = files::wrong_kind(&start) {
            return Err(LoadError::Data(format!("{}: the file: {problem}", path.display())));
        }
        let length = file.metadata().map_err(LoadError::io(path))?.len();
        let input = BufReader::with_capacity(1 << 16, file);
        Ok(Self { path, start, length, input, json: OnceCell::new() })
    }

    /// The first bytes, without a byte-order mark.
    pub(super) fn unmarked_start(&self) -> &[u8] {
        self.start.strip_prefix("\u{feff}".as_bytes()).unwrap_or(&self.start)
    }

    /// The text of a file that begins like a JSON object, without a byte-order mark; read once.
    pub(super) fn json(&self) -> Result<Option<&str>, LoadError> {
        if !self.unmarked_start().trim_ascii_start().starts_with(b"{") {
            return Ok(None);
        }
        let text = match self.json.get() {
            Some(text) => text,
            None => {
                let text =
                    files::read_text(self.path, MAX_JSON).map_err(LoadError::io(self.path))?;
                self.json.get_or_init(|| text)
            }
        };
        Ok(Some(text))
    }
}

/// Reads a model in any registered format: a file, or a folder that is a model (SOG). The model is in the coordinates
/// of its dataset, measured from an offset if the file or its sidecar names one; formats with a frame of their own
/// (glTF) are converted.
///
/// # Errors
/// When the file is unreadable, of no known format, contradicts its format, or more than 1 % of its Gaussians are
/// not finite.
pub fn read_model(path: &Path) -> Result<SplatFile, LoadError> {
    if path.is_dir() {
        let list = Some(path.join(lists::STREAMED)).filter(|list| list.is_file());
        let main = main_file(path).or(list).ok_or_else(|| no_main_file(path))?;
        return read_model(&main);
    }
    let file = ModelFile::open(path)?;
    if let Some(error) = file.json()?.and_then(|text| lists::refusal(path, text)) {
        return Err(error);
    }
    let mut best = None;
    for (_, reader) in readers() {
        match (reader.recognise)(&file)? {
            Match::Strong => {
                best = Some(reader);
                break;
            }
            Match::Weak => best = best.or(Some(reader)),
            Match::None => {}
        }
    }
    let mut model = match best {
        Some(reader) => (reader.read)(file)?,
        None => return Err(unrecognised(path)),
    };
    sidecar::apply(path, &mut model)?;
    Ok(model)
}

/// The main file of a folder that is a model; `None` if the folder is not one.
pub fn main_file(folder: &Path) -> Option<PathBuf> {
    let names = readers().into_iter().filter_map(|(_, reader)| reader.main_file);
    names.map(|name| folder.join(name)).find(|path| path.is_file())
}

/// Returns true if a folder is a model, or a list of models, which [`read_model`] refuses with the reason.
pub fn is_model_folder(folder: &Path) -> bool {
    main_file(folder).is_some() || folder.join(lists::STREAMED).is_file()
}

fn readers() -> Vec<(&'static Format, Reader)> {
    formats().into_iter().filter_map(|format| Some((format, format.reader?))).collect()
}

fn no_main_file(folder: &Path) -> LoadError {
    let known = |(format, reader): (&Format, Reader)| {
        Some(format!("{}, which a {} folder has", reader.main_file?, format.name))
    };
    let known: Vec<String> = readers().into_iter().filter_map(known).collect();
    LoadError::Data(format!(
        "{} is a folder without {}; name a file of Gaussian splats",
        folder.display(),
        known.join(", or ")
    ))
}

fn unrecognised(path: &Path) -> LoadError {
    let readable: Vec<&Format> = readers().into_iter().map(|(format, _)| format).collect();
    LoadError::Data(format!(
        "{} is not a model of Gaussian splats that densify reads (its formats: {}); convert it, e.g. with \
         splat-transform or SuperSplat",
        path.display(),
        names(&readable)
    ))
}
