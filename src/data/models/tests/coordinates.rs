//! Models far from the origin: local coordinates in every format, coordinates in f64, and damaged offsets.

use std::path::Path;

use super::round_trips::plausible;
use super::{saved, written};
use crate::models::{
    Frame, PLY, export_formats, find, is_finer_than_f32, local_origin, read_model, sidecar_path,
};
use densify_core::gaussians::Gaussians;

/// An offset as in UTM `[m]`.
const OFFSET: [f64; 3] = [512_345.5, 5_400_123.25, -81.125];
const COMMENT: &[u8] = b"comment densify offset 512345.5 5400123.25 -81.125\n";

fn remote() -> Gaussians {
    Gaussians { origin: OFFSET, ..plausible(300, 1) }
}

/// The largest distance along an axis between positions of the same row, after both are sorted by x.
fn apart(a: &Gaussians, b: &Gaussians) -> f64 {
    let sorted = |model: &Gaussians| {
        let mut all: Vec<[f64; 3]> = (0..model.len()).map(|row| model.position(row)).collect();
        all.sort_by(|a, b| a[0].total_cmp(&b[0]));
        all
    };
    let (a, b) = (sorted(a), sorted(b));
    assert_eq!(a.len(), b.len());
    let pairs = a.iter().flatten().zip(b.iter().flatten());
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

fn find_bytes(bytes: &[u8], part: &[u8]) -> usize {
    bytes.windows(part.len()).position(|bytes| bytes == part).unwrap()
}

#[test]
fn every_format_keeps_local_coordinates_and_their_offset() {
    let folder = tempfile::tempdir().unwrap();
    let model = remote();
    for format in export_formats().into_iter().filter(|format| format.name != "call-log") {
        let name = format.name;
        let path = folder.path().join(format!("{name}.{}", format.extension));
        format.save(&model, &path).unwrap();
        assert_eq!(sidecar_path(&path).is_file(), !format.states_offset(), "{name}");
        let found = read_model(&path).unwrap().gaussians;
        assert_eq!(found.origin, OFFSET, "{name}");
        if format.is_lossy() {
            assert!(apart(&found, &model) < 2e-3, "{name}: {}", apart(&found, &model));
        } else {
            assert_eq!(found, model, "{name}");
        }
        // A later file in world coordinates must not be moved by the old sidecar.
        format.save(&plausible(300, 1), &path).unwrap();
        assert!(!sidecar_path(&path).exists(), "{name}");
        assert_eq!(read_model(&path).unwrap().gaussians.origin, [0.0; 3], "{name}");
    }
    let states = ["ply", "compressed-ply", "glb", "spz", "spz-v4", "sog"]
        .map(|name| find(name).unwrap().states_offset());
    assert_eq!(states, [true, true, true, false, false, true]);
}

#[test]
fn coordinates_in_f64_are_kept_by_ply_and_refused_by_others() {
    let model = remote();
    let frame = Frame { origin: OFFSET, is_double: true };
    let mut bytes = Vec::new();
    PLY.write_in(frame, &model, &mut bytes).unwrap();
    let head = String::from_utf8_lossy(&bytes[..400]).into_owned();
    assert!(head.contains("property double x") && head.contains("property float nx"), "{head}");
    let (_folder, path) = saved("double.ply", &bytes);
    let found = read_model(&path).unwrap().gaussians;
    assert_eq!(found.origin, OFFSET);
    assert!(apart(&found, &model) < 1e-9, "{}", apart(&found, &model));
    assert_eq!((&found.log_scales, &found.sh), (&model.log_scales, &model.sh));
    // Other programs write no such comment.
    let comment = b"comment densify near 512345.5 5400123.25 -81.125\n";
    let at = find_bytes(&bytes, comment);
    bytes.drain(at..at + comment.len());
    let (_folder, path) = saved("double.ply", &bytes);
    let found = read_model(&path).unwrap().gaussians;
    assert!(found.origin != [0.0; 3] && apart(&found, &model) < 1e-6, "{:?}", found.origin);
    for name in ["compressed-ply", "glb", "spz", "spz-v4", "sog"] {
        let refused = find(name).unwrap().write_in(frame, &model, &mut Vec::new()).unwrap_err();
        assert!(refused.to_string().contains("only ply"), "{name}: {refused}");
    }
    // Near the origin, f64 needs no offset.
    let frame = Frame { origin: [0.0; 3], is_double: true };
    let near = plausible(40, 0);
    let mut bytes = Vec::new();
    PLY.write_in(frame, &near, &mut bytes).unwrap();
    let (_folder, path) = saved("double.ply", &bytes);
    assert_eq!(read_model(&path).unwrap().gaussians, near);
}

fn refused(path: &Path, words: &[&str]) {
    let message = read_model(path).unwrap_err().to_string();
    for word in words {
        assert!(message.contains(word), "{word:?} is not in: {message}");
    }
}

#[test]
fn damaged_sidecars_are_refused_by_file_and_field() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.spz");
    find("spz").unwrap().save(&remote(), &path).unwrap();
    let sidecar = sidecar_path(&path);
    let good = std::fs::read_to_string(&sidecar).unwrap();
    for (text, word) in [
        ("", "JSON"),
        ("{\"offset\": [1, 2]}", "JSON"),
        ("{\"offset\": [1, 2, 3], \"unit\": 1}", "unit"),
        ("{\"offset\": [1, 2, 1e999]}", "JSON"),
        ("{\"offset\": [1, 2, 3], \"bytes\": 7}", "bytes"),
    ] {
        std::fs::write(&sidecar, text).unwrap();
        refused(&path, &["model.spz.offset.json", word]);
    }
    std::fs::write(&sidecar, "{\"offset\": [1, 2, 3]}").unwrap();
    assert_eq!(read_model(&path).unwrap().gaussians.origin, [1.0, 2.0, 3.0]);
    // A sidecar belongs to the file with which it was written.
    std::fs::write(&sidecar, &good).unwrap();
    std::fs::write(&path, written(find("spz").unwrap(), &plausible(301, 1)).unwrap()).unwrap();
    refused(&path, &["model.spz.offset.json", "bytes"]);
    // A sidecar may not contradict the header of a PLY.
    let path = folder.path().join("model.ply");
    PLY.save(&remote(), &path).unwrap();
    std::fs::write(sidecar_path(&path), "{\"offset\": [1, 2, 3]}").unwrap();
    refused(&path, &["model.ply.offset.json", "offset", "512345.5"]);
}

#[test]
fn an_offset_that_gains_no_precision_is_not_kept() {
    let mut model = plausible(300, 1);
    model.origin = [1.0, 0.0, 0.0];
    assert!(is_finer_than_f32(&model));
    model.means.iter_mut().for_each(|mean| mean[1] += 5.4e6);
    assert!(!is_finer_than_f32(&model));
    assert!((local_origin(&model)[1] - 5.4e6).abs() < 10.0, "{:?}", local_origin(&model));
}

#[test]
fn a_file_name_too_long_for_a_sidecar_is_accepted_unless_one_is_needed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(format!("{}.spz", "n".repeat(246)));
    let model = plausible(40, 0);
    find("spz").unwrap().save(&model, &path).unwrap();
    assert_eq!(read_model(&path).unwrap().gaussians.len(), 40);
    assert!(find("spz").unwrap().save(&remote(), &path).is_err());
    assert_eq!(read_model(&path).unwrap().gaussians.len(), 40);
}

#[test]
fn damaged_offsets_in_a_header_are_refused_by_file_and_field() {
    let whole = written(PLY, &remote()).unwrap();
    let at = find_bytes(&whole, COMMENT);
    let with = |lines: &str| {
        let bytes = [&whole[..at], lines.as_bytes(), &whole[at + COMMENT.len()..]].concat();
        saved("model.ply", bytes)
    };
    for (lines, word) in [
        ("comment densify offset 1 2\n", "not three numbers"),
        ("comment densify offset 1 2 NaN\n", "not three numbers"),
        ("comment densify offset 1 2 3 4\n", "not three numbers"),
        ("comment densify offset 1 2 x\n", "not three numbers"),
        ("comment densify offset 1 2 3\ncomment densify offset 1 2 4\n", "contradicts"),
    ] {
        let (_folder, path) = with(lines);
        refused(&path, &["model.ply", "densify offset", word]);
    }
    let (_folder, path) = with(
        "comment densify offset 1 2 3\ncomment densify offsets 4\ncomment densify offset 1 2 3\n",
    );
    assert_eq!(read_model(&path).unwrap().gaussians.origin, [1.0, 2.0, 3.0]);
}
