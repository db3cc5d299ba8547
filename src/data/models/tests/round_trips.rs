//! Round trips: exact in formats with f32, within half a step in quantised ones.

use std::io;
use std::ops::Range;
use std::path::Path;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{piece, saved, written};
use crate::models::{export_formats, find, find_by_extension, read_model};
use densify_core::antialiasing::Antialiasing;
use densify_core::gaussians::{Gaussians, sh_coefficients, sigmoid};

/// A model like a trained one: a few units wide, with mostly small Gaussians whose colours depend little on direction.
pub(super) fn plausible(rows: usize, sh_degree: u8) -> Gaussians {
    let mut random = ChaCha8Rng::seed_from_u64(rows as u64);
    let mut value = |reach: f32| random.random_range(-reach..reach);
    let mut model = Gaussians { sh_degree, ..Gaussians::default() };
    for row in 0..rows {
        // On a curve, so that a row is identified by its position.
        let t = row as f32 / rows as f32;
        model.means.push([4.0 * t - 2.0, (9.0 * t).sin(), (7.0 * t).cos()]);
        model.log_scales.push([value(1.5) - 4.0, value(1.5) - 4.0, value(1.5) - 5.0]);
        model.quats.push([value(1.0), value(1.0), value(1.0), value(1.0)]);
        model.opacity_logits.push(value(4.0));
        model.sh.extend((0..3).map(|_| value(1.5)));
        model.sh.extend((3..3 * sh_coefficients(sh_degree)).map(|_| value(0.3)));
    }
    model
}

fn read(bytes: &[u8]) -> Gaussians {
    let (_folder, path) = saved("model", bytes);
    let file = read_model(&path).unwrap_or_else(|error| panic!("{error}"));
    assert_eq!((file.dropped, file.repaired), (0, 0));
    file.gaussians
}

/// The model sorted by its first coordinate, the original order of [`plausible`] models.
fn in_order(model: &Gaussians) -> Gaussians {
    let mut rows: Vec<usize> = (0..model.len()).collect();
    rows.sort_by(|&a, &b| model.means[a][0].total_cmp(&model.means[b][0]));
    model.gather(&rows)
}

/// Largest errors of position, logarithm of scale, opacity, colour, and of a quaternion's component.
fn errors(a: &Gaussians, b: &Gaussians) -> [f32; 5] {
    assert_eq!((a.len(), a.sh_degree), (b.len(), b.sh_degree));
    let largest =
        |x: &[f32], y: &[f32]| x.iter().zip(y).map(|(x, y)| (x - y).abs()).fold(0.0, f32::max);
    let opacities =
        |m: &Gaussians| m.opacity_logits.iter().map(|&x| sigmoid(x)).collect::<Vec<_>>();
    let quats = a.quats.iter().zip(&b.quats).flat_map(|(p, q)| {
        let length = |q: &[f32; 4]| q.iter().map(|v| v * v).sum::<f32>().sqrt();
        let same = p.iter().zip(q).map(|(p, q)| p * q).sum::<f32>();
        let sign = 1f32.copysign(same);
        [0, 1, 2, 3].map(|i| (p[i] / length(p) - sign * q[i] / length(q)).abs())
    });
    [
        largest(a.means.as_flattened(), b.means.as_flattened()),
        largest(a.log_scales.as_flattened(), b.log_scales.as_flattened()),
        largest(&opacities(a), &opacities(b)),
        largest(&a.sh, &b.sh),
        quats.fold(0.0, f32::max),
    ]
}

#[test]
fn formats_in_f32_keep_every_bit() {
    // The numbers of rows lie around 256, the number that the PLY writer writes at once.
    for (name, rows) in
        [("ply", 0), ("ply", 1), ("ply", 255), ("ply", 256), ("ply", 700), ("glb", 100)]
    {
        for degree in 0..=3 {
            let mut model = plausible(rows, degree);
            if let Some(first) = model.means.first_mut() {
                *first = [-0.0, f32::MIN_POSITIVE / 4.0, f32::MAX];
            }
            if rows > 6 {
                (model.opacity_logits[4], model.opacity_logits[5]) = (17.5, -40.0);
                model.log_scales[6] = [-30.0, 3e-5, 12.0];
            }
            let format = find(name).unwrap();
            let bytes = written(format, &model).unwrap();
            let again = read(&bytes);
            let case = format!("{name}, {rows} rows, degree {degree}");
            assert_eq!(again, model, "{case}");
            // Bits are compared too, because −0 equals 0.
            assert!(written(format, &again).unwrap() == bytes, "{case}");
        }
    }
}

#[test]
fn formats_are_lossy_if_a_round_trip_changes_values() {
    let model = plausible(100, 3);
    for format in export_formats().into_iter().filter(|format| format.name != "call-log") {
        let changes = in_order(&read(&written(format, &model).unwrap())) != model;
        assert_eq!(format.is_lossy(), changes, "{}", format.name);
    }
}

#[test]
fn quantised_formats_round_trip_within_half_a_step() {
    // In the order compressed PLY, SPZ, SOG. Positions: 11 bits of a chunk's range (y: 10), 12 fractional bits, 16 bits
    // of a logarithm. Log-scales: 10 bits of a range of 3, sixteenths, a codebook, whose entries are far apart where
    // there are few values. Opacities: a byte. Colours: steps of 1/32; steps of 1/38 and, within the allowed error,
    // bands in eighths; a codebook, and a palette with half as many entries as rows. Quaternions: ten bits of √2, nine
    // of 1/√2, a byte of √2; the largest component follows from the others.
    for (name, limits) in [
        ("compressed-ply", [1.1e-3, 1.6e-3, 2e-3, 0.017, 2e-3]),
        ("spz", [1.3e-4, 0.032, 2e-3, 0.07, 3e-3]),
        ("spz-v4", [1.3e-4, 0.032, 2e-3, 0.07, 3e-3]),
        ("sog", [6e-5, 0.08, 2e-3, 0.7, 9e-3]),
    ] {
        for degree in 0..=3 {
            let model = plausible(500, degree);
            let found = in_order(&read(&written(find(name).unwrap(), &model).unwrap()));
            let errors = errors(&model, &found);
            let fits = errors.iter().zip(limits).all(|(error, limit)| *error <= limit);
            assert!(fits, "{name}, degree {degree}: {errors:?}");
        }
    }
}

#[test]
fn coefficients_of_zero_are_zero_on_average() {
    for degree in 1..=3 {
        let mut model = plausible(256, degree);
        let width = 3 * sh_coefficients(degree);
        for row in model.sh.chunks_exact_mut(width) {
            row[3..].fill(0.0);
        }
        let found = read(&written(find("compressed-ply").unwrap(), &model).unwrap());
        for k in 3..width {
            let mean = found.sh.iter().skip(k).step_by(width).sum::<f32>() / 256.0;
            assert!(mean.abs() < 1e-6, "degree {degree}, coefficient {k}: {mean}");
        }
    }
}

#[test]
fn every_format_states_the_antialiasing_or_says_that_it_cannot() {
    for kind in Antialiasing::ALL {
        let model = Gaussians { antialiasing: kind, ..plausible(300, 1) };
        for format in export_formats().into_iter().filter(|format| format.name != "call-log") {
            let found = read(&written(format, &model).unwrap()).antialiasing;
            let expected = if format.states_antialiasing(kind) { kind } else { Antialiasing::Wide };
            assert_eq!(found, expected, "{} of {kind}", format.name);
            let cannot = format.name.starts_with("spz") && kind == Antialiasing::Narrow;
            assert_eq!(format.states_antialiasing(kind), !cannot, "{}", format.name);
        }
    }
}

#[test]
fn files_do_not_depend_on_the_pieces_and_equal_models_give_equal_files() {
    let model = plausible(300, 2);
    for format in export_formats().into_iter().filter(|format| format.name != "call-log") {
        let in_pieces = |pieces: &[Range<usize>]| {
            let mut bytes = Vec::new();
            let mut writer = format.open_writer((&model).into(), &mut bytes).unwrap();
            for rows in pieces {
                writer.rows(&piece(&model, rows.clone()), &mut bytes).unwrap();
            }
            writer.finish(&mut bytes).unwrap();
            bytes
        };
        let pieces = in_pieces(&[0..0, 0..7, 7..270, 270..300]);
        assert!(pieces == in_pieces(&[0..300, 300..300]), "{}", format.name);
        assert!(written(format, &model).unwrap() == written(format, &model).unwrap());
    }
}

/// The extension of version 4, `.v4.spz`, ends in that of the default.
#[test]
fn the_version_of_spz_is_chosen_by_the_name() {
    let version = |path: &str| {
        let bytes =
            written(find_by_extension(Path::new(path)).unwrap(), &plausible(40, 1)).unwrap();
        let is_gzip = bytes.starts_with(&[0x1f, 0x8b]);
        if is_gzip { 3 } else { bytes[4] }
    };
    assert_eq!(["a.spz", "a.v4.spz", "v4.spz", "av4.spz"].map(version), [3, 4, 3, 3]);
}

#[test]
fn extreme_models_are_written_or_refused() {
    let mut one = plausible(1, 3);
    one.quats[0] = [0.0, 0.0, 0.0, -2.0];
    one.log_scales[0] = [-90.0, 40.0, 0.0];
    one.opacity_logits[0] = 88.0;
    let mut remote = plausible(9, 1);
    remote.means[2][1] = 1e9;
    for format in export_formats().into_iter().filter(|format| format.name != "call-log") {
        let name = format.name;
        assert_eq!(read(&written(format, &one).unwrap()).len(), 1, "{name}");
        let empty = Gaussians::zeros(0, 2);
        for (model, refusing) in [(&remote, &["spz", "spz-v4"][..]), (&empty, &["sog"])] {
            match written(format, model) {
                Ok(bytes) => assert_eq!(read(&bytes).len(), model.len(), "{name}"),
                Err(error) => {
                    assert_eq!(error.kind(), io::ErrorKind::InvalidInput);
                    assert!(refusing.contains(&name), "{name}: {error}");
                    assert!(error.to_string().contains("choose another format"), "{error}");
                }
            }
        }
    }
}
