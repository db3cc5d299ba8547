//! Tests of the formats and sizes that are tried, and of training on a decoded file.

use std::collections::HashSet;

use super::*;
use densify_core::gaussians::sh_coefficients;
use densify_data::dataset::DepthChoice;
use densify_fixtures::Made;
use densify_render::BackendChoice;
use densify_run::refining::Refinement;
use densify_run::{DataSpec, DepthSpec, Silent};

#[test]
fn degrees_are_tried_downwards_from_that_of_the_model() {
    assert_eq!(degrees(3, Target::Bytes(1)), [3, 2, 1, 0]);
    assert_eq!(degrees(1, Target::Bytes(1)), [1, 0]);
    assert_eq!(degrees(0, Target::Bytes(1)), [0]);
    assert_eq!(degrees(3, Target::Rows(1)), [3]);
}

/// A model in which no two Gaussians have the same colour coefficients.
fn colourful(rows: usize) -> Gaussians {
    let mut model = Gaussians::zeros(rows, 3);
    let share = |index: usize| (index * 7919 % 4093) as f32 / 4093.0;
    for row in 0..rows {
        model.means[row] = [0, 1, 2].map(|axis| 2.0 * share(3 * row + axis) - 1.0);
        model.log_scales[row] = [-2.0; 3];
        model.quats[row] = [1.0, 0.0, 0.0, 0.0];
    }
    for (index, value) in model.sh.iter_mut().enumerate() {
        *value = share(index) - 0.5;
    }
    model
}

fn sog() -> &'static Format {
    densify_data::models::find("sog").expect("a format")
}

fn options<'a>(to: Target, scene: &Path, formats: &'a [&'static Format]) -> Options<'a> {
    Options {
        model: TrainedModel {
            file: "model.ply".into(),
            scene: scene.to_owned(),
            data: DataSpec::default(),
            depth: DepthSpec::default(),
            exposure: None,
            poses: Default::default(),
            vignette: false,
            near: None,
        },
        antialias: None,
        device: DeviceSpec { backend: BackendChoice::Cpu, ..DeviceSpec::default() },
        to,
        iterations: 12,
        seed: 0,
        formats,
        output: Path::new("small.sog"),
    }
}

#[test]
fn a_size_that_no_gaussian_fits_is_refused_before_training() {
    let formats = [sog(), PLY];
    let check = |to: u64| {
        let options = options(Target::Bytes(to), Path::new(""), &formats);
        fit::check(&options, &colourful(3)).map_err(|failure| failure.to_string())
    };
    let one = fit::file_size(PLY, &colourful(1).with_degree(0)).expect("it is written");
    let refused = check(one - 1).expect_err("too small");
    assert!(refused.contains(&format!("one Gaussian takes {one} bytes as ply")), "{refused}");
    assert_eq!(check(one), Ok(()));
}

#[test]
fn formats_that_do_not_hold_the_model_are_not_tried() {
    let folder = tempfile::tempdir().expect("a folder");
    let scratch = folder.path().join("scratch");
    let mut model = colourful(400).with_degree(0);
    model.log_scales.fill([8.0; 3]);
    let spz = densify_data::models::find("spz").expect("a format");
    let usable = |formats: &[&'static Format]| {
        let options = options(Target::Rows(9), Path::new(""), formats);
        fit::usable_formats(&options, &model, &scratch, &Silent)
    };
    let names = |formats: Vec<&Format>| formats.iter().map(|format| format.name).collect();
    let usable_names: Vec<&str> = usable(&[spz, sog(), PLY]).map(names).expect("two formats");
    assert_eq!(usable_names, ["sog", "ply"]);
    let refused = usable(&[spz]).expect_err("spz cannot hold it").to_string();
    assert!(refused.contains("spz cannot hold") && refused.contains("such as"), "{refused}");
}

/// Less accurate variants are smaller, so that more rows fit. Variants that hold fewer than four fifths of the maximum
/// number of rows are not tried. If all rows fit with the default accuracy, the most accurate variant that holds them
/// is tried.
#[test]
fn only_variants_that_hold_enough_rows_are_tried() {
    let model = colourful(2_000);
    let sizes: Vec<u64> = sog()
        .variants()
        .iter()
        .map(|variant| fit::file_size(variant, &model).expect("it is written"))
        .collect();
    assert!(sizes.len() > 2 && sizes.windows(2).all(|pair| pair[0] > pair[1]), "{sizes:?}");
    let formats = [sog()];
    let packings =
        |to: Target| fit::packings(&options(to, Path::new(""), &formats), &model).expect("it fits");
    let size_of_whole = |to: u64| {
        let [whole] = packings(Target::Bytes(to))[..] else { panic!("several attempts at {to}") };
        assert!(whole.is_whole && whole.rows == 2_000, "{whole:?}");
        fit::file_size(whole.format, &model).expect("it is written")
    };
    let usual = fit::file_size(sog(), &model).expect("it is written");
    assert!(sizes[2] < usual && usual < sizes[0], "{usual}, {sizes:?}");
    assert_eq!(size_of_whole(sizes[0]), sizes[0]);
    assert_eq!(size_of_whole(sizes[0] - 1), usual);
    let tight = packings(Target::Bytes(usual - 1));
    assert!(tight.len() > 1 && tight.iter().all(|packing| !packing.is_whole), "{tight:?}");
    let rows: Vec<usize> = tight.iter().map(|packing| packing.rows).collect();
    assert!(rows.is_sorted() && rows.iter().all(|n| 5 * n >= 4 * rows[rows.len() - 1]), "{rows:?}");
    let [few] = packings(Target::Rows(500))[..] else { panic!("several attempts") };
    assert_eq!(few.rows, 500);
}

/// The last iterations train the decoded model and keep its view-dependent colours, each of which is a palette entry
/// shared by many rows.
#[test]
fn colours_stay_as_decoded_from_the_file() {
    let made = Made::colmap_txt();
    let formats = [sog()];
    let options = options(Target::Rows(256), made.path(), &formats);
    let variant = &sog().variants()[2];
    let scratch = scratch_beside(&made.path().join("small.sog")).expect("a file");
    let start = colourful(256);
    let tuned =
        tune::tune(start.clone(), (variant, 256), &options, &scratch, &Silent, &mut |_| Ok(()));
    let tuned = tuned.expect("it trains");
    let palette_size = |model: &Gaussians| {
        let bands = model.sh.chunks_exact(3 * sh_coefficients(3)).map(|row| &row[3..]);
        let text = |row: &[f32]| format!("{row:.6?}").replace("-0.000000", "0.000000");
        bands.map(text).collect::<HashSet<_>>().len()
    };
    assert_eq!((tuned.len(), palette_size(&start)), (256, 256));
    assert!(palette_size(&tuned) <= 256 / 4, "{} entries", palette_size(&tuned));
    assert_ne!(tuned.opacity_logits, [0.0; 256], "the rest is trained");
}

#[test]
fn training_has_the_depth_options_of_the_run() {
    let depth = DepthSpec { depth: Some(DepthChoice::Off), ..DepthSpec::default() };
    let formats = [sog()];
    let Options { model, device, .. } = options(Target::Rows(3), Path::new(""), &formats);
    let model = TrainedModel { depth: depth.clone(), ..model };
    let refinement =
        Refinement { device: &device, rows: 3, iterations: 5, seed: 0, freezes_bands: false };
    let spec = model.describe_training(&colourful(3), &refinement, Path::new("scratch.ply"));
    assert_eq!(spec.expect("described").depth, depth);
}
