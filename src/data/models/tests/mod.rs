//! Tests of the registry, the calls to a writer, the PLY layout, round trips through every format, and files of other
//! programs.

#![allow(clippy::float_cmp, reason = "results are exact")]

mod changes;
mod coordinates;
mod reading;
mod round_trips;

use std::io::{self, Write};
use std::ops::Range;
use std::path::PathBuf;

use super::*;
use densify_core::files::FileError;
use densify_core::gaussians::{Gaussians, sh_coefficients};
use densify_core::pieces::ROWS_AT_A_TIME;

/// A model whose values all differ, so that tests notice swapped columns, and have odd bits, so that tests notice
/// conversions.
pub(crate) fn model(rows: usize, sh_degree: u8) -> Gaussians {
    let mut next = 0u32;
    let mut value = || {
        next += 1;
        f32::from_bits(0x3e80_0001 ^ (next.wrapping_mul(7919) & 0x007f_ffff) ^ ((next % 2) << 31))
    };
    let mut model = Gaussians { sh_degree, ..Gaussians::default() };
    for _ in 0..rows {
        model.means.push([value(), value(), value()]);
        model.log_scales.push([value(), value(), value()]);
        model.quats.push([value(), value(), value(), value()]);
        model.opacity_logits.push(value());
        model.sh.extend((0..3 * sh_coefficients(sh_degree)).map(|_| value()));
    }
    model
}

fn piece(whole: &Gaussians, rows: Range<usize>) -> Gaussians {
    whole.gather(&rows.collect::<Vec<_>>())
}

pub(crate) fn written(format: &Format, model: &Gaussians) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    format.write(model, &mut bytes).map(|()| bytes)
}

/// A file with these contents in a folder of its own.
pub(crate) fn saved(name: &str, contents: impl AsRef<[u8]>) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, contents).unwrap();
    (folder, path)
}

/// A format that any crate could add; it writes how it was called.
struct CallLog;

inventory::submit! {
    Format {
        name: "call-log",
        extension: "log.txt",
        summary: "for tests",
        reader: None,
        writer: Some(|| Box::new(CallLog)),
        compress_rank: None,
    }
}

impl ModelWriter for CallLog {
    fn held_bytes(&self, shape: Shape) -> u64 {
        shape.rows as u64
    }

    fn begin(&mut self, shape: Shape, out: &mut dyn Write) -> io::Result<()> {
        let Shape { rows, sh_degree, .. } = shape;
        write!(out, "begin {rows} {sh_degree};")
    }

    fn rows(&mut self, rows: &Gaussians, out: &mut dyn Write) -> io::Result<()> {
        write!(out, "{};", rows.len())
    }

    fn finish(&mut self, out: &mut dyn Write) -> io::Result<()> {
        write!(out, "finish")
    }
}

#[test]
fn a_registered_format_is_found_and_given_every_row_once() {
    let format = find("call-log").unwrap();
    assert_eq!(find_by_extension(Path::new("a/model.LOG.txt")).unwrap().name, format.name);
    assert_eq!(format.held_bytes((&model(7, 0)).into()), 7);
    let rows = 2 * ROWS_AT_A_TIME + 4;
    let (folder, whole) = (tempfile::tempdir().unwrap(), model(rows, 1));
    let path = folder.path().join("new/model.log.txt");
    let pieces = |rows| Ok::<_, FileError>(piece(&whole, rows));
    format.write_file(&path, (&whole).into(), pieces).unwrap();
    let expected = format!("begin {rows} 1;{ROWS_AT_A_TIME};{ROWS_AT_A_TIME};4;finish");
    assert_eq!(std::fs::read_to_string(&path).unwrap(), expected);
}

/// `find` and `find_by_extension` offer only formats that can be written.
#[test]
fn a_format_that_is_only_read_is_not_exported() {
    let names: Vec<&str> = formats().iter().map(|format| format.name).collect();
    assert!(["splat", "gltf"].iter().all(|name| names.contains(name)), "{names:?}");
    for name in ["splat", "gltf"] {
        let message = find(name).unwrap_err().to_string();
        assert!(!message.contains(&format!("{name},")), "{message}");
        assert!(find_by_extension(Path::new(&format!("model.{name}"))).is_err());
    }
    let splat = formats().into_iter().find(|format| format.name == "splat").unwrap();
    let refused = splat.write(&model(1, 0), &mut Vec::new()).unwrap_err();
    assert!(is_unfit(&refused) && refused.to_string().contains("splat"), "{refused}");
}

#[test]
fn compressing_tries_the_most_exact_format_first() {
    let names: Vec<&str> = compress_formats().iter().map(|format| format.name).collect();
    assert_eq!(names, ["ply", "sog", "compressed-ply", "spz"]);
}

#[test]
fn a_failed_source_leaves_the_old_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.ply");
    std::fs::write(&path, "old").unwrap();
    let shape = Shape { rows: ROWS_AT_A_TIME + 1, ..(&model(0, 0)).into() };
    let lost = || FileError::malformed(Path::new("lost"), "it is gone");
    let written = PLY.write_file(&path, shape, |rows| match rows.start {
        0 => Ok(model(rows.len(), 0)),
        _ => Err(lost()),
    });
    assert_eq!(written.unwrap_err().to_string(), lost().to_string());
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "old");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn the_error_for_an_unknown_format_names_the_nearest_and_all_formats() {
    let message = find("plz").unwrap_err().to_string();
    assert!(message.contains("did you mean `ply`?") && message.contains("call-log, "), "{message}");
    assert!(!find("zzz").unwrap_err().to_string().contains("did you mean"));
    for path in ["model", "model.zip", "ply", ""] {
        let message = find_by_extension(Path::new(path)).unwrap_err().to_string();
        assert!(message.contains("call-log, ") && message.contains("ply"), "{message}");
    }
}

#[test]
fn the_writer_of_ply_holds_as_many_bytes_as_it_reports() {
    let whole = model(300, 2);
    let shape = Shape::from(&whole);
    let mut writer = PLY.open_writer(shape, &mut io::sink()).unwrap();

    /// Remembers the size of the largest write `[bytes]`.
    struct Largest(usize);
    impl Write for Largest {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0 = self.0.max(bytes.len());
            Ok(bytes.len())
        }
        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }
    for rows in [20, 300] {
        let mut largest = Largest(0);
        writer.rows(&piece(&whole, 0..rows), &mut largest).unwrap();
        assert_eq!(writer.held_bytes(Shape { rows, ..shape }), largest.0 as u64);
    }
}

#[test]
fn the_ply_layout_is_that_of_the_original_trainer() {
    let mut one = model(1, 1);
    one.sh = (0..12u8).map(f32::from).collect();
    let bytes = written(PLY, &one).unwrap();
    let header_end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&bytes[..header_end]).unwrap();
    let names: Vec<&str> =
        header.lines().filter_map(|line| line.strip_prefix("property float ")).collect();
    let rest: Vec<String> = (0..9).map(|i| format!("f_rest_{i}")).collect();
    let mut expected = vec!["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"];
    expected.extend(rest.iter().map(String::as_str));
    expected
        .extend(["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]);
    assert_eq!(names, expected);
    let values: Vec<f32> = bytes[header_end..]
        .chunks_exact(4)
        .map(|b| f32::from_le_bytes(b.try_into().unwrap()))
        .collect();
    assert_eq!(values.len(), expected.len());
    // In memory, coefficient k of channel c is value 3 + 3k + c; the file goes channel by channel.
    assert_eq!(values[3..18], [0., 0., 0., 0., 1., 2., 3., 6., 9., 4., 7., 10., 5., 8., 11.]);
}
