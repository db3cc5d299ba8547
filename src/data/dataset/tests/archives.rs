//! Tests of datasets in ZIP archives: they load like folders, and unsafe archives are refused.

use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};

use tempfile::TempDir;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use super::super::*;
use super::{assert_noted, write_mask};
use densify_fixtures::Made;

/// An archive in its own folder.
struct Packed {
    folder: TempDir,
}

impl Packed {
    fn new(bytes: &[u8]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("my scan.zip"), bytes).unwrap();
        Self { folder }
    }

    fn path(&self) -> PathBuf {
        self.folder.path().join("my scan.zip")
    }

    fn load(&self) -> Result<Dataset, LoadError> {
        Dataset::load(&self.path(), &LoadOptions::default())
    }
}

/// The files below a folder with their relative paths.
fn files(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let mut found = Vec::new();
    let mut stack = vec![folder.to_owned()];
    while let Some(current) = stack.pop() {
        for entry in std::fs::read_dir(&current).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                stack.push(path);
            } else {
                let name = path.strip_prefix(folder).unwrap().to_str().unwrap().to_owned();
                found.push((name, std::fs::read(&path).unwrap()));
            }
        }
    }
    found.sort();
    found
}

/// Packs files with `prefix` before their names.
fn pack(files: &[(String, Vec<u8>)], prefix: &str, method: CompressionMethod) -> Vec<u8> {
    let mut writer = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(method);
    for (name, contents) in files {
        writer.start_file(format!("{prefix}{name}"), options).unwrap();
        writer.write_all(contents).unwrap();
    }
    writer.finish().unwrap().into_inner()
}

fn packed(made: &Made) -> Vec<u8> {
    pack(&files(made.path()), "", CompressionMethod::Deflated)
}

/// Replaces all occurrences of a name with another of the same length.
fn renamed(bytes: &[u8], old: &str, new: &str) -> Vec<u8> {
    assert_eq!(old.len(), new.len());
    let (mut bytes, mut count) = (bytes.to_vec(), 0);
    for at in 0..=bytes.len() - old.len() {
        if bytes[at..].starts_with(old.as_bytes()) {
            bytes[at..at + old.len()].copy_from_slice(new.as_bytes());
            count += 1;
        }
    }
    assert_eq!(count, 2, "{old}: its own header and the table of contents");
    bytes
}

/// Changes one byte at the offset `own` of each file's own header, and one at the offset `table` of its entry in the
/// table of contents.
fn with_edited_headers(
    bytes: &[u8],
    own: usize,
    table: usize,
    change: impl Fn(&mut u8),
) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    for at in 0..bytes.len() - 4 {
        if bytes[at..].starts_with(b"PK\x03\x04") {
            change(&mut bytes[at + own]);
        } else if bytes[at..].starts_with(b"PK\x01\x02") {
            change(&mut bytes[at + table]);
        }
    }
    bytes
}

/// The folder in which an archive is unpacked, according to the note.
fn unpacked_in(data: &Dataset) -> PathBuf {
    let parts = data.notes.iter().find_map(|note| match note {
        Note::Text(text) => text.split_once(" is unpacked in "),
        _ => None,
    });
    let (_, place) = parts.unwrap_or_else(|| panic!("{:?}", data.notes));
    place.split_once(" (").unwrap().0.into()
}

#[test]
fn an_archive_loads_like_its_folder() {
    let renames: fn(&mut serde_json::Value) =
        |json| json["frames"][1]["file_path"] = "Фото 1/Küche (2).png".into();
    let names = Made::transforms(renames);
    std::fs::create_dir(names.file("Фото 1")).unwrap();
    std::fs::rename(names.file("images/b.png"), names.file("Фото 1/Küche (2).png")).unwrap();
    for made in [Made::colmap_txt(), Made::colmap_bin(), names, Made::realitycapture()] {
        let folder = Dataset::load(made.path(), &LoadOptions::default()).unwrap();
        let files = files(made.path());
        let with_system_files = [
            files.clone(),
            vec![
                ("__MACOSX/._images".to_owned(), b"?".to_vec()),
                (".DS_Store".to_owned(), b"?".to_vec()),
            ],
        ]
        .concat();
        let mut backslashes = files.clone();
        backslashes.iter_mut().for_each(|(name, _)| *name = name.replace('/', "\\"));
        for bytes in [
            pack(&files, "", CompressionMethod::Stored),
            pack(&files, "", CompressionMethod::Deflated),
            pack(&files, "Scan/", CompressionMethod::Deflated),
            pack(&with_system_files, "", CompressionMethod::Deflated),
            pack(&files, "Küche – neu/2026 11/", CompressionMethod::Deflated),
            pack(&backslashes, "", CompressionMethod::Deflated),
        ] {
            let archive = Packed::new(&bytes);
            let data = archive.load().unwrap_or_else(|error| panic!("{error}"));
            assert_eq!(data.points, folder.points);
            assert_eq!((data.train.len(), data.root.clone()), (3, archive.path()));
            for (view, other) in data.train.iter().zip(&folder.train) {
                assert_eq!((&view.name, view.camera), (&other.name, other.camera));
                let (a, b) = (view.source.load().unwrap(), other.source.load().unwrap());
                assert!(a == b, "{}", view.name);
                assert_eq!(view.source.working_bytes(), other.source.working_bytes());
                assert!(view.source.file.path.starts_with(archive.path()), "{:?}", view.source);
            }
        }
    }
}

#[test]
fn the_unpacked_folder_lives_as_long_as_a_view() {
    let archive = Packed::new(&packed(&Made::colmap_txt()));
    let data = archive.load().unwrap();
    let place = unpacked_in(&data);
    let view = data.train[1].clone();
    drop(data);
    assert!(place.join("images/b.png").is_file());
    assert_eq!(view.source.load().unwrap().rgb[0], 40);
    drop(view);
    assert!(!place.exists());
    // A refused archive leaves nothing behind either.
    let made = Made::colmap_txt();
    made.remove("images/b.png");
    let error = Packed::new(&packed(&made)).load().unwrap_err().to_string();
    assert!(error.contains("my scan.zip/sparse/0/images.txt"), "{error}");
    assert!(error.contains("my scan.zip/images/b.png does not exist"), "{error}");
    assert!(!error.contains("densify-zip-"), "{error}");
}

/// Masks and points are read from the archive too, and messages name files by their path in it.
#[test]
fn masks_and_points_are_read_from_the_archive() {
    let made = Made::colmap_txt();
    write_mask(&made.file("masks/b.png"), |x| if x < 10 { 0 } else { 255 });
    let archive = Packed::new(&pack(&files(made.path()), "a/b/", CompressionMethod::Stored));
    let data = archive.load().unwrap();
    let source = &data.train[1].source;
    assert_eq!(source.load().unwrap().mask.unwrap()[..2], [0, 0]);
    let shown = &source.mask.as_ref().unwrap().file.path;
    assert_eq!(*shown, archive.path().join("masks/b.png"));
    let made = Made::transforms(|_| ());
    made.replace("points.ply", "\n3 0 0.5", "\nnan 0 0.5");
    let data = Packed::new(&packed(&made)).load().unwrap();
    assert_noted(&data, "1 of 200");
}

#[test]
fn models_are_not_datasets() {
    let model = [("meta.json".to_owned(), b"{}".to_vec())];
    assert!(!is_archive(&Packed::new(&pack(&model, "", CompressionMethod::Stored)).path()));
    let inside = pack(&model, "scene/", CompressionMethod::Stored);
    assert!(!is_archive(&Packed::new(&inside).path()), "in a folder");
    let archive = Packed::new(&packed(&Made::colmap_txt()));
    let streamed = ["lod-meta.json", "0_0/meta.json"].map(|name| (name.to_owned(), b"{}".to_vec()));
    let streamed = Packed::new(&pack(&streamed, "", CompressionMethod::Stored));
    assert!(!is_archive(&streamed.path()), "streamed");
    assert!(is_archive(&archive.path()) && !is_archive(archive.folder.path()));
    refused("a model", &pack(&model, "", CompressionMethod::Stored), "is not a dataset");
}

fn refused(case: &str, bytes: &[u8], words: &str) {
    let archive = Packed::new(bytes);
    let Err(error) = archive.load() else { panic!("{case}: it loaded") };
    let message = error.to_string();
    for word in words.split(", ").chain(["my scan.zip"]) {
        assert!(message.contains(word), "{case}: {word:?} is not in: {message}");
    }
    assert_eq!(std::fs::read_dir(archive.folder.path()).unwrap().count(), 1, "{case}");
}

#[test]
fn unsafe_archives_are_refused() {
    let made = Made::colmap_txt();
    made.write("images/zz.png", b"?");
    let whole = packed(&made);
    let name = "images/zz.png";
    for (case, new, words) in [
        ("upwards", "../../../z.pn", "../../../z.pn, `..`, pack the folder again"),
        ("upwards with backslashes", "..\\..\\..\\z.pn", "../../../z.pn, `..`"),
        ("absolute", "/etc/passwd.x", "/etc/passwd.x, absolute"),
        ("of a drive", "C:\\images.png", "absolute"),
        ("upwards within", "images/../zzz", "`..`"),
        ("a control character", "images/z\u{1b}.png", "control character"),
        ("another file's name", "././imag/b.pn", ""),
    ] {
        match words {
            // An odd spelling of a path is accepted if no other file has that path.
            "" => assert!(Packed::new(&renamed(&whole, name, new)).load().is_ok(), "{case}"),
            _ => refused(case, &renamed(&whole, name, new), words),
        }
    }
    made.remove(name);
    made.write("x/images/b.png", b"?");
    let twice = renamed(&packed(&made), "x/images/b.png", "./images/b.png");
    refused("twice", &twice, "images/b.png, another file has this name");
    std::fs::remove_dir_all(made.file("x")).unwrap();
    made.write("imagez", b"?");
    let both = renamed(&packed(&made), "imagez", "images");
    refused("a file and a folder", &both, "images, this name");

    let mut writer = ZipWriter::new(Cursor::new(Vec::new()));
    writer.add_symlink("images", "/etc", SimpleFileOptions::default()).unwrap();
    let link = writer.finish().unwrap().into_inner();
    refused("a link", &link, "images, symbolic link");

    let whole = packed(&Made::colmap_txt());
    let encrypted = with_edited_headers(&whole, 6, 8, |flags| *flags |= 1);
    refused("encrypted", &encrypted, "images/a.png, encrypted, without a password");
    let method = with_edited_headers(&whole, 8, 10, |method| *method = 93);
    refused("an unsupported method", &method, "images/a.png, pack the folder again");
}

#[test]
fn damaged_archives_are_refused() {
    let made = Made::colmap_txt();
    let whole = pack(&files(made.path()), "", CompressionMethod::Stored);
    let mut other = whole.clone();
    let at = other.windows(9).position(|w| w == b"# cameras").unwrap();
    other[at + 3] ^= 1;
    refused("a checksum", &other, "sparse/0/cameras.txt, cannot be unpacked");
    // Truncation at many places.
    for kept in (0..whole.len()).step_by(97) {
        let archive = Packed::new(&whole[..kept]);
        let message = archive.load().unwrap_err().to_string();
        assert!(message.contains("my scan.zip"), "{kept}: {message}");
        let remedy = "pack the folder again, or unpack the archive and give that folder instead";
        assert!(kept < 2 || message.contains(remedy), "{kept}: {message}");
    }
    let nothing = pack(&[], "", CompressionMethod::Stored);
    refused("empty", &nothing, "is not a dataset, sparse/0/cameras.bin, folder or ZIP archive");
    let notes = [("notes/readme.txt".to_owned(), b"?".to_vec())];
    refused("no dataset", &pack(&notes, "", CompressionMethod::Stored), "is not a dataset");
}

/// 65 MiB of zeros are compressed to about 64 KiB; the size that the archive states may be false.
#[test]
fn zip_bombs_are_refused_before_they_fill_the_disk() {
    let mut all = files(Made::colmap_txt().path());
    all.push(("images/zeros.png".to_owned(), vec![0; 65 << 20]));
    let bomb = pack(&all, "", CompressionMethod::Deflated);
    assert!(bomb.len() < 1 << 20);
    refused("a bomb", &bomb, "unpacks to more than 64.0 MiB, unpack it yourself");
    let claimed = u32::try_from(65 << 20).unwrap().to_le_bytes();
    let mut lying = bomb;
    for at in 0..lying.len() - 4 {
        if lying[at..at + 4] == claimed {
            lying[at..at + 4].copy_from_slice(&100_u32.to_le_bytes());
        }
    }
    refused("a lying bomb", &lying, "unpack");
}
