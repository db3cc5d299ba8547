//! Tests of PLY files in the layouts of other programs, and of damaged files.

use std::path::Path;

use super::read::read;
use crate::models::PLY;
use crate::models::tests::{model, saved, written};
use crate::points::read_points;
use densify_core::gaussians::{Gaussians, sigmoid};

/// One splat in ASCII and in big endian. Its properties are shuffled, have other types, are mixed with unknown ones and
/// a list, and follow another element.
#[test]
fn properties_may_have_any_order_and_type() {
    let properties = "property double rot_3\nproperty double rot_0\nproperty list uchar short extra\nproperty double rot_1\n\
        property double rot_2\nproperty int x\nproperty float label\nproperty double y\nproperty double z\nproperty double opacity\n\
        property double scale_2\nproperty double scale_1\nproperty double scale_0\nproperty double f_dc_2\n\
        property double f_dc_1\nproperty double f_dc_0\nend_header\n";
    let head = |format| {
        format!(
            "ply\nformat {format} 1.0\ncomment x\nelement other 2\nproperty list int float l\nelement vertex 1\n{properties}"
        )
    };
    let row =
        [0.5, 1.0, 0.25, 0.125, 7.0, 9.0, 2.5, 3.5, -1.5, 0.3125, 0.75, 0.625, -2.0, -3.0, -4.0];
    let ascii = head("ascii")
        + "2 1 2\n0\n0.5 1 3 5 6 7 0.25\n0.125 7 9 2.5 3.5 -1.5 0.3125 .75 6.25e-1 -2 -3 -4";
    let mut binary = head("binary_big_endian").into_bytes();
    binary.extend(2i32.to_be_bytes());
    binary.extend([0; 8]);
    binary.extend(0i32.to_be_bytes());
    for (index, value) in row.iter().enumerate() {
        match index {
            4 => binary.extend(7i32.to_be_bytes()),
            5 => binary.extend(9f32.to_be_bytes()),
            _ => binary.extend(f64::to_be_bytes(*value)),
        }
        if index == 1 {
            binary.extend([3, 0, 5, 0, 6, 0, 7]);
        }
    }
    for bytes in [ascii.into_bytes(), binary] {
        let (_folder, path) = saved("file.ply", bytes);
        let found = read(&path).unwrap().gaussians;
        assert_eq!(found.means, [[7.0, 2.5, 3.5]]);
        assert_eq!(found.quats, [[1.0, 0.25, 0.125, 0.5]]);
        assert_eq!(found.opacity_logits, [-1.5]);
        assert_eq!(found.log_scales, [[0.625, 0.75, 0.3125]]);
        assert_eq!((found.sh_degree, found.sh), (0, vec![-4.0, -3.0, -2.0]));
    }
}

#[test]
fn damaged_rows_are_dropped_up_to_one_percent() {
    let mut few = model(200, 1);
    few.means[3][1] = f32::NAN;
    few.sh[5 * 12 + 4] = f32::INFINITY;
    few.quats[9] = [0.0; 4];
    let (_folder, path) = saved("file.ply", written(PLY, &few).unwrap());
    let found = read(&path).unwrap();
    assert_eq!((found.dropped, found.repaired, found.gaussians.len()), (2, 1, 198));
    assert_eq!(found.gaussians.sh_of(3), few.sh_of(4));
    assert_eq!(found.gaussians.quats[7], [1.0, 0.0, 0.0, 0.0]);
    few.opacity_logits[20] = f32::NAN;
    let (_folder, path) = saved("file.ply", written(PLY, &few).unwrap());
    let message = read(&path).unwrap_err().to_string();
    assert!(message.contains("3 of 200") && message.contains("file.ply"), "{message}");
}

/// SHARP states the colours in an element of its own, after the splats.
#[test]
fn colours_that_are_not_srgb_are_refused() {
    let with = |value: u8| {
        let mut bytes = written(PLY, &model(3, 0)).unwrap();
        let end = bytes.windows(11).position(|part| part == b"end_header\n").unwrap();
        let element = b"element color_space 1\nproperty uchar color_space\n";
        bytes.splice(end..end, *element);
        bytes.push(value);
        bytes
    };
    let (_folder, path) = saved("file.ply", with(0));
    assert_eq!(read(&path).unwrap().gaussians.len(), 3);
    let (_folder, path) = saved("file.ply", with(1));
    let message = read(&path).unwrap_err().to_string();
    assert!(message.contains("file.ply: color_space: 1 means"), "{message}");
}

/// Properties that change the look are refused by name, harmless ones are ignored, and all others are named.
#[test]
fn properties_that_are_not_read_are_refused_or_noted() {
    let with = |names: &[&str]| {
        let mut bytes = written(PLY, &model(1, 0)).unwrap();
        let end = bytes.windows(11).position(|part| part == b"end_header\n").unwrap();
        let more: String = names.iter().map(|name| format!("property float {name}\n")).collect();
        bytes.splice(end..end, more.into_bytes());
        bytes.extend(vec![0; 4 * names.len()]);
        let (_folder, path) = saved("file.ply", bytes);
        read(&path).map(|file| file.notes).map_err(|error| error.to_string())
    };
    let long = "x".repeat(90);
    for (names, noted) in [
        (&["red", "green", "blue"][..], None),
        (&["label", "t"], Some("label, t".to_owned())),
        (&["scale_t"], Some("scale_t".to_owned())),
        (&["a", "b", "c", "d", "e", "f", "g"], Some("a, b, c, d, e, and 2 more".to_owned())),
        (&[&long], Some("x".repeat(40))),
    ] {
        let expected: Vec<String> =
            noted.iter().map(|names| format!("properties that are not read: {names}")).collect();
        assert_eq!(with(names), Ok(expected), "{names:?}");
    }
    for (names, words) in [
        (&["label", "sb_params_0"][..], ["property sb_params_0", "Spherical Betas", "harmonics"]),
        (&["trbf_center"], ["property trbf_center", "move", "single moment"]),
        (&["motion_0"], ["property motion_0", "move", "single moment"]),
        (&["omega_3"], ["property omega_3", "move", "single moment"]),
        (&["scale_t", "t"], ["property scale_t", "move", "single moment"]),
        (&["t", "rot_r_0"], ["property rot_r_0", "move", "single moment"]),
    ] {
        let message = with(names).unwrap_err();
        assert!(words.iter().all(|word| message.contains(word)), "{names:?}: {message}");
    }
}

/// An interrupted export leaves rows of zeros.
#[test]
fn rows_of_zeros_are_dropped_up_to_one_percent() {
    let mut some = model(300, 1);
    let zero = |some: &mut Gaussians, row: usize| {
        (some.means[row], some.log_scales[row], some.quats[row]) = ([0.0; 3], [0.0; 3], [0.0; 4]);
        some.opacity_logits[row] = 0.0;
        some.sh[12 * row..12 * (row + 1)].fill(0.0);
    };
    (297..300).for_each(|row| zero(&mut some, row));
    let (_folder, path) = saved("file.ply", written(PLY, &some).unwrap());
    let found = read(&path).unwrap();
    assert_eq!((found.dropped, found.repaired, found.gaussians.len()), (3, 0, 297));
    zero(&mut some, 0);
    let (_folder, path) = saved("file.ply", written(PLY, &some).unwrap());
    let message = read(&path).unwrap_err().to_string();
    assert!(message.contains("4 of 300") && message.contains("only zeros"), "{message}");
}

/// Some programs write the logarithm of 0, and the logits of 0 and 1.
#[test]
fn infinite_opacities_and_flat_gaussians_are_read() {
    let mut model = model(10, 0);
    (model.opacity_logits[0], model.opacity_logits[1]) = (f32::INFINITY, f32::NEG_INFINITY);
    model.log_scales[2][1] = f32::NEG_INFINITY;
    let (_folder, path) = saved("file.ply", written(PLY, &model).unwrap());
    let found = read(&path).unwrap();
    assert_eq!((found.dropped, found.gaussians.len()), (0, 10));
    let [opaque, transparent, other, ..] = found.gaussians.opacity_logits[..] else {
        panic!("ten")
    };
    assert!((13.0..20.0).contains(&opaque) && (-20.0..-13.0).contains(&transparent));
    assert!(other.to_bits() == model.opacity_logits[2].to_bits());
    assert!(found.gaussians.log_scales[2][1].to_bits() == (-20f32).to_bits());
}

/// Some programs leave out the logit, the logarithm, or both, or write one size or one opacity for all Gaussians.
#[test]
fn activated_values_are_recognised() {
    let mut model = model(200, 0);
    for row in 0..200 {
        let share = row as f32 / 200.0;
        model.means[row] = [60.0 * share, 30.0 * (7.0 * share).sin(), 0.0];
        model.log_scales[row] = [-2.0 - share, -3.0, -6.0 * share];
        model.opacity_logits[row] = 9.0 * share - 4.0;
    }
    let opacities = |m: &mut Gaussians| {
        m.opacity_logits.iter_mut().for_each(|v| *v = sigmoid(*v));
    };
    let scales = |m: &mut Gaussians| {
        m.log_scales.as_flattened_mut().iter_mut().for_each(|v| *v = v.exp());
    };
    let small_unit = |m: &mut Gaussians| {
        m.means.as_flattened_mut().iter_mut().for_each(|v| *v *= 1e4);
        m.log_scales.as_flattened_mut().iter_mut().for_each(|v| *v += 10.0_f32.ln() * 4.0);
    };
    let faint = |m: &mut Gaussians| m.opacity_logits.iter_mut().for_each(|v| *v *= 0.8);
    let one_size = |m: &mut Gaussians| m.log_scales.fill([0.05; 3]);
    let opaque = |m: &mut Gaussians| m.opacity_logits.fill(1.0);
    type Change<'a> = &'a dyn Fn(&mut Gaussians);
    let cases: [(&str, &[Change<'_>], bool, &[&str]); 9] = [
        ("as it is", &[], false, &[]),
        ("in a small unit", &[&small_unit], false, &[]),
        ("opacities", &[&opacities], true, &["opacities"]),
        ("scales", &[&scales], false, &["export their logarithms"]),
        ("both", &[&opacities, &scales], true, &["opacities", "not as logarithms"]),
        (
            "both in a small unit",
            &[&small_unit, &opacities, &scales],
            true,
            &["opacities", "scales"],
        ),
        ("faint", &[&opacities, &faint, &scales], true, &["opacities", "scales"]),
        ("one size", &[&opacities, &one_size], true, &["opacities", "scales"]),
        ("opaque", &[&opaque, &scales], true, &["opacities", "scales"]),
    ];
    for (case, changes, is_undone, words) in cases {
        let mut stated = model.clone();
        changes.iter().for_each(|change| change(&mut stated));
        let (_folder, path) = saved("file.ply", written(PLY, &stated).unwrap());
        let found = read(&path).unwrap();
        assert_eq!(found.notes.len(), words.len(), "{case}: {:?}", found.notes);
        for (note, word) in found.notes.iter().zip(words) {
            assert!(note.contains(word), "{case}: {word:?} is not in {note}");
        }
        if !is_undone {
            assert_eq!(found.gaussians, stated, "{case}");
            continue;
        }
        for row in 0..200 {
            let near = |a: f32, b: f32| (a - b).abs() < 1e-4 * a.abs().max(1.0);
            let opacity = sigmoid(found.gaussians.opacity_logits[row]);
            let stated_opacity = stated.opacity_logits[row];
            assert!(near(opacity, stated_opacity), "{case}: {opacity} for {stated_opacity}");
            let size = |log: f32| if words.len() > 1 { log.exp() } else { log };
            let fits = |i: usize| {
                near(size(found.gaussians.log_scales[row][i]), stated.log_scales[row][i])
            };
            assert!((0..3).all(fits), "{case}, row {row}");
        }
    }
}

#[test]
fn other_ply_files_are_refused_with_the_reason() {
    let good = String::from_utf8_lossy(&written(PLY, &model(1, 0)).unwrap()).into_owned();
    let header = |from: &str, to: &str| {
        assert!(good.contains(from));
        good.replacen(from, to, 1)
    };
    for (case, contents, words) in [
        ("points", header("property float opacity\n", ""), &["opacity", "point cloud"][..]),
        ("2-D splats", header("property float scale_2\n", ""), &["scale_2", "2DGS", "SuperSplat"]),
        (
            "plain colours",
            good.replace("float f_dc_", "uchar colour_"),
            &["f_dc_0", "plain colours", "--ply-color-mode sh_coeffs"],
        ),
        (
            "degree",
            header("property float opacity\n", "property float f_rest_0\nproperty float opacity\n"),
            &["f_rest_*", "9, 24 or 45"],
        ),
        ("count", header("vertex 1\n", "vertex 2\n"), &["element vertex", "2 rows"]),
        ("absurd count", header("vertex 1\n", "vertex 99999999999999999999\n"), &["line 3"]),
        ("large count", header("vertex 1\n", "vertex 4000000000\n"), &["element vertex"]),
        ("negative count", header("vertex 1\n", "vertex -1\n"), &["line 3"]),
        ("no vertices", header("element vertex", "element face"), &["no element \"vertex\""]),
        ("not PLY", "obj\n".into(), &["not a PLY file"]),
        ("empty", String::new(), &["header"]),
        ("endless", "ply\n".to_owned() + &"comment\n".repeat(200_000), &["1 MiB"]),
    ] {
        let (_folder, path) = saved("file.ply", contents);
        let message = read(&path).unwrap_err().to_string();
        for word in words.iter().chain(&["file.ply"]) {
            assert!(message.contains(word), "{case}: {word:?} is not in: {message}");
        }
    }
    let message = read(Path::new("/none/x.ply")).unwrap_err().to_string();
    assert!(message.contains("cannot read /none/x.ply"), "{message}");
}

/// A file cut or damaged anywhere gives an error or a model, never a panic or a huge allocation.
#[test]
fn damaged_files_never_panic() {
    let whole = written(PLY, &model(3, 1)).unwrap();
    for at in 0..whole.len() {
        let (_folder, path) = saved("file.ply", &whole[..at]);
        assert!(read(&path).is_err(), "cut at {at}");
        let mut damaged = whole.clone();
        damaged[at] ^= 0x95;
        let (_folder, path) = saved("file.ply", damaged);
        let _ = (read(&path), read_points(&path));
    }
}

#[test]
#[ignore = "needs files of other programs: set DENSIFY_SHARED"]
fn shared_splats_of_other_programs_load() {
    for path in densify_fixtures::shared_files("splats", "ply") {
        if path.to_string_lossy().contains("compressed") {
            let message = read(&path).unwrap_err().to_string();
            assert!(message.contains("no property x"), "{message}");
            continue;
        }
        let file = read(&path).unwrap_or_else(|e| panic!("{e}"));
        assert!(file.gaussians.len() >= 3 && file.dropped == 0, "{}", path.display());
        if path.ends_with("train-1000.ply") {
            assert_eq!((file.gaussians.len(), file.gaussians.sh_degree), (1000, 3));
            // The written file is that of the original implementation, byte for byte.
            assert!(written(PLY, &file.gaussians).unwrap() == std::fs::read(&path).unwrap());
        }
    }
}
