//! Reads the files that a mesh file refers to, and decodes images. All files are untrusted.
//!
//! References must be relative paths within the mesh's folder, even after following symbolic links. No
//! allocation is sized by a header's claim: readers take the bytes that exist, and decoders have limits.

use std::fs::{File, OpenOptions};
use std::io::{Cursor, Read};
use std::path::{Path, PathBuf};

use base64::Engine as _;
use base64::alphabet::{STANDARD, URL_SAFE};
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};
use image::{ImageFormat, ImageReader, Limits, RgbaImage};

use crate::error::Error;
use crate::mesh::Model;
use crate::texture::Texture;

/// Largest file read `[bytes]`.
const MAX_FILE: u64 = 16 << 30;
/// Supported formats of textures.
const FORMATS: [ImageFormat; 3] = [ImageFormat::Png, ImageFormat::Jpeg, ImageFormat::WebP];
/// Largest side of an image `[px]`.
const MAX_SIDE: u32 = 16_384;
/// Maximum number of pixels of an image.
const MAX_PIXELS: u64 = 1 << 28;
/// Maximum memory of a decoder `[bytes]`.
pub(crate) const MAX_DECODED: u64 = 1 << 30;
/// Maximum number of bytes that one byte of a compressed file can expand to: deflate's limit of 1032 plus
/// a margin.
pub(crate) const EXPANSION: u64 = 1100;
/// Maximum number of texels of all textures of a model.
const MAX_TEXELS: u64 = 1 << 29;
/// Longest reference to a file `[bytes]`.
const MAX_NAME: usize = 4096;

/// Opens a file for reading. Pipes, sockets and devices are refused without waiting for their data.
pub(crate) fn open(path: &Path) -> Result<File, Error> {
    let mut options = OpenOptions::new();
    options.read(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::custom_flags(&mut options, libc::O_NONBLOCK);
    let file = options.open(path).map_err(Error::io(path))?;
    let metadata = file.metadata().map_err(Error::io(path))?;
    if !metadata.is_file() && !metadata.is_dir() {
        let problem = "it is a pipe, a socket or a device, not a file";
        return Err(Error::malformed(path, "the file", problem, "replace it with a regular file"));
    }
    Ok(file)
}

/// Reads a whole file.
pub(crate) fn read(path: &Path) -> Result<Vec<u8>, Error> {
    let file = open(path)?;
    let metadata = file.metadata().map_err(Error::io(path))?;
    let too_large =
        || Error::malformed(path, "the file", "it is larger than 16 GiB", "split the mesh");
    if metadata.len() > MAX_FILE {
        return Err(too_large());
    }
    let mut bytes = Vec::new();
    // A growing buffer could end up with twice the capacity.
    bytes
        .try_reserve_exact(metadata.len() as usize + 1)
        .map_err(|_| Error::io(path)(std::io::ErrorKind::OutOfMemory.into()))?;
    file.take(MAX_FILE + 1).read_to_end(&mut bytes).map_err(Error::io(path))?;
    if bytes.len() as u64 > MAX_FILE { Err(too_large()) } else { Ok(bytes) }
}

/// The folder of a mesh file.
pub(crate) struct Folder {
    /// The mesh file, for messages.
    file: PathBuf,
    folder: PathBuf,
}

impl Folder {
    /// The folder that contains a mesh file.
    pub(crate) fn containing(file: &Path) -> Result<Self, Error> {
        let folder = folder_of(file);
        let folder = folder.canonicalize().map_err(Error::io(folder))?;
        Ok(Self { file: file.to_owned(), folder })
    }

    /// The path of the file that `reference` names; the file need not exist.
    pub(crate) fn resolve(&self, element: &str, reference: &str) -> Result<PathBuf, Error> {
        let refuse = |problem| Err(self.refused(element, reference, problem));
        if reference.is_empty() || reference.len() > MAX_NAME {
            return refuse("is empty or longer than 4 KiB");
        }
        if reference.contains('\0') {
            return refuse("contains a NUL character");
        }
        // A colon before the first slash marks a scheme or a drive.
        if reference.split(['/', '\\']).next().is_some_and(|first| first.contains(':')) {
            return refuse("is not a relative path");
        }
        if reference.starts_with(['/', '\\']) {
            return refuse("is an absolute path");
        }
        if reference.split(['/', '\\']).any(|part| part == "..") {
            return refuse("leaves the folder");
        }
        let path = self.folder.join(reference);
        match path.canonicalize() {
            Ok(real) if !real.starts_with(&self.folder) => refuse("leaves the folder"),
            _ => Ok(path),
        }
    }

    /// The error for a reference that is not a relative path within the folder.
    fn refused(&self, element: &str, uri: &str, problem: &str) -> Error {
        let uri = shortened(uri);
        let remedy = "keep all files in the mesh's own folder";
        Error::malformed(&self.file, element, format!("the URI {uri:?} {problem}"), remedy)
    }

    /// Reads the file of a percent-encoded relative URI.
    pub(crate) fn read_uri(&self, element: &str, uri: &str) -> Result<Vec<u8>, Error> {
        // A file with the literal name takes precedence, as names may contain a %.
        let literal = self.resolve(element, uri)?;
        if literal.is_file() {
            return read(&literal);
        }
        let decoded = percent_decoded(uri).ok_or_else(|| {
            let uri = shortened(uri);
            let problem = format!("the URI {uri:?} is not percent-encoded UTF-8");
            let remedy = "give the file a name in UTF-8, and write a % in it as %25";
            Error::malformed(&self.file, element, problem, remedy)
        })?;
        self.read(element, &self.resolve(element, &decoded)?)
    }

    /// Reads the file at the resolved `path`, to which `element` refers.
    pub(crate) fn read(&self, element: &str, path: &Path) -> Result<Vec<u8>, Error> {
        if path.exists() {
            return read(path);
        }
        let name = path.strip_prefix(&self.folder).unwrap_or(path);
        let problem = format!("there is no file {}", name.display());
        let remedy = if name.to_string_lossy().contains(char::REPLACEMENT_CHARACTER) {
            "its name is not UTF-8: rename it, and save the mesh file as UTF-8"
        } else {
            "put it where the mesh file says, or remove the reference"
        };
        Err(Error::malformed(&self.file, element, problem, remedy))
    }
}

/// Adds a texture to a model and returns its index. The total number of texels is limited, as many small files
/// can contain many large images.
pub(crate) fn add_texture(
    file: &Path,
    element: &str,
    model: &mut Model,
    texture: Texture,
) -> Result<u32, Error> {
    let texels = |texture: &Texture| {
        let (width, height) = texture.size();
        u64::from(width) * u64::from(height)
    };
    model.textures.push(texture);
    if model.textures.iter().map(texels).sum::<u64>() > MAX_TEXELS {
        let problem = "all textures together have more than 2^29 texels";
        return Err(Error::malformed(file, element, problem, "store smaller textures"));
    }
    Ok(model.textures.len() as u32 - 1)
}

/// Shortens text from a file for a message.
pub(crate) fn shortened(text: &str) -> String {
    text.chars().take(80).collect()
}

fn percent_decoded(text: &str) -> Option<String> {
    let mut bytes = Vec::with_capacity(text.len());
    let mut rest = text.as_bytes();
    while let [first, after @ ..] = rest {
        if *first == b'%' {
            let digits = std::str::from_utf8(after.get(..2)?).ok()?;
            bytes.push(u8::from_str_radix(digits, 16).ok()?);
            rest = &after[2..];
        } else {
            bytes.push(*first);
            rest = after;
        }
    }
    String::from_utf8(bytes).ok()
}

/// The bytes of a base64 `data:` URI (RFC 4648, sections 4 and 5), with or without padding; `None` for other URIs.
pub fn data_uri(uri: &str) -> Option<Vec<u8>> {
    const PADDING: GeneralPurposeConfig =
        GeneralPurposeConfig::new().with_decode_padding_mode(DecodePaddingMode::Indifferent);
    let (head, body) = uri.strip_prefix("data:")?.split_once(',')?;
    let alphabet = if body.contains(['-', '_']) { URL_SAFE } else { STANDARD };
    head.ends_with(";base64").then(|| GeneralPurpose::new(&alphabet, PADDING).decode(body).ok())?
}

/// The text after a byte-order mark, or the whole text if it has none.
///
/// # Errors
/// When the mark is not that of UTF-8.
pub(crate) fn without_bom(text: &[u8]) -> Result<&[u8], &'static str> {
    match text {
        [0xff, 0xfe, ..] | [0xfe, 0xff, ..] => Err("it is UTF-16, not UTF-8"),
        _ => Ok(text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text)),
    }
}

/// The folder that holds a file.
pub(crate) fn folder_of(file: &Path) -> &Path {
    match file.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

/// A decoder for images of these formats, with limits; `problem` is the error for images of other formats.
pub(crate) fn image_reader<'a>(
    bytes: &'a [u8],
    formats: &[ImageFormat],
    problem: &str,
) -> std::io::Result<ImageReader<Cursor<&'a [u8]>>> {
    let mut reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format()?;
    if !reader.format().is_some_and(|format| formats.contains(&format)) {
        return Err(std::io::Error::other(problem));
    }
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_SIDE);
    limits.max_image_height = Some(MAX_SIDE);
    limits.max_alloc = Some(MAX_DECODED);
    reader.limits(limits);
    Ok(reader)
}

/// Decodes a PNG, JPEG or WebP image as a texture.
pub(crate) fn decode(
    file: &Path,
    element: &str,
    bytes: &[u8],
    srgb: bool,
) -> Result<Texture, Error> {
    let image = decode_image(file, element, bytes)?;
    Ok(Texture::new(image.width(), image.height(), image.into_raw(), srgb))
}

/// Decodes a PNG, JPEG or WebP image.
pub(crate) fn decode_image(file: &Path, element: &str, bytes: &[u8]) -> Result<RgbaImage, Error> {
    let remedy = "store it as a PNG or JPEG of at most 16384 px a side";
    let fault = |problem: String| Error::malformed(file, element, problem, remedy);
    let problem = "it is neither PNG, JPEG nor WebP";
    let reader = || image_reader(bytes, &FORMATS, problem).map_err(|e| fault(e.to_string()));
    let (width, height) = reader()?.into_dimensions().map_err(|e| fault(e.to_string()))?;
    if width > MAX_SIDE || height > MAX_SIDE || u64::from(width) * u64::from(height) > MAX_PIXELS {
        return Err(fault(format!("it has {width}x{height} px")));
    }
    Ok(reader()?.decode().map_err(|e| fault(e.to_string()))?.into_rgba8())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn references_stay_in_the_folder() {
        let folder = tempfile::tempdir().expect("folder");
        let file = folder.path().join("a.gltf");
        std::fs::write(&file, "x").expect("write");
        let here = Folder::containing(&file).expect("folder");
        for bad in [
            "../b.bin",
            "a/../../b",
            "/etc/passwd",
            "file:///etc/passwd",
            "C:\\x",
            "\\\\host\\x",
            "",
            "http://x/y",
            "a\0b",
            "..",
            "x\\..\\..\\y",
        ] {
            let error = here.resolve("buffer 0", bad).expect_err(bad).to_string();
            assert!(error.contains("keep all files"), "{error}");
        }
        for (bad, remedy) in [
            ("%2e%2e/b.bin", "keep all files"),
            ("%2Fetc/passwd", "keep all files"),
            ("%zz", "a name in UTF-8"),
            ("%", "write a % in it as %25"),
            ("caf%e9.bin", "a name in UTF-8"),
            ("caf\u{fffd}.bin", "its name is not UTF-8: rename it"),
            ("b.bin", "put it where the mesh file says"),
        ] {
            let error = here.read_uri("buffer 0", bad).expect_err(bad).to_string();
            assert!(error.contains(remedy), "{error}");
        }
        std::fs::write(folder.path().join("a b.bin"), "seen").expect("write");
        assert_eq!(here.read_uri("buffer 0", "a%20b.bin").expect("read"), b"seen");
        assert_eq!(here.read_uri("buffer 0", "./a b.bin").expect("read"), b"seen");
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink("/etc", folder.path().join("out")).expect("link");
            assert!(here.resolve("image 1", "out/hostname").is_err());
        }
    }

    #[test]
    fn base64_is_read_with_and_without_padding() {
        assert_eq!(data_uri("data:x/y;base64,Zm9vYg==").expect("data"), b"foob");
        assert_eq!(data_uri("data:;base64,Zm9vYmE").expect("data"), b"fooba");
        assert_eq!(data_uri("data:;base64,-_8=").expect("URL-safe letters"), [251, 255]);
        assert_eq!(data_uri("data:;base64,+/8=").expect("data"), [251, 255]);
        assert_eq!(data_uri("data:;base64,Zm*v"), None);
        assert_eq!(data_uri("data:text/plain,abc"), None);
    }
}
