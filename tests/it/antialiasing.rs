//! Models trained with antialiasing: the kind that files of other programs state, and its rendering on every backend.

use std::path::Path;

use densify::core::antialiasing::Antialiasing;
use densify::core::camera::Camera;
use densify::data::models::read_model;
use glam::{DMat3, DVec3};

use crate::subject::{all, make};

/// A PLY of one white Gaussian with scale 0.02 and opacity 0.9. `comments` are lines of its header, `more` are further
/// properties.
fn one(comments: &str, more: &[(&str, f32)]) -> Vec<u8> {
    let names =
        "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    let own = [0.0, 0.0, 0.0, 1.772_453_9, 1.772_453_9, 1.772_453_9, 2.197_224_6];
    let shape = [0.02_f32.ln(), 0.02_f32.ln(), 0.02_f32.ln(), 1.0, 0.0, 0.0, 0.0];
    let names = names.split(' ').chain(more.iter().map(|(name, _)| *name));
    let properties: String = names.map(|name| format!("property float {name}\n")).collect();
    let header = format!(
        "ply\nformat binary_little_endian 1.0\n{comments}element vertex 1\n{properties}end_header\n"
    );
    let values = own.into_iter().chain(shape).chain(more.iter().map(|(_, value)| *value));
    [header.into_bytes(), values.flat_map(f32::to_le_bytes).collect()].concat()
}

/// Checks the antialiasing that a file states, and the grey of the pixel at the Gaussian, whose scale there is 0.2 px.
fn check(file: &Path, stated: Antialiasing, grey: f32) {
    let model = read_model(file).expect("a model").gaussians;
    assert_eq!(model.antialiasing, stated, "{}", file.display());
    let camera = Camera {
        translation: DVec3::new(0.0, 0.0, 5.0),
        ..Camera::centred((33, 33), (50.0, 50.0), DMat3::IDENTITY, DVec3::ZERO)
    };
    for subject in all() {
        let mut backend = make(&subject, &model);
        assert_eq!(backend.download().expect("the model").antialiasing, stated);
        let rendering = backend.render(&camera, [0.0; 3], 0).expect("a small image");
        let found = 255.0 * rendering.rgb[3 * (16 * 33 + 16)];
        assert!((found - grey).abs() < 0.6, "{}: {found} for {grey}", subject.name());
    }
}

#[test]
fn small_gaussians_are_rendered_with_the_stated_antialiasing() {
    let folder = tempfile::tempdir().expect("a folder");
    let mip = "comment SplatRenderMode: mip\n";
    let brush = format!("comment Exported from Brush\n{mip}");
    // A 3D filter as wide as the Gaussian doubles its variances and multiplies its opacity by 2^(−3/2). At a
    // projected variance of 0.08 px², the kernel of 0.1 px² then multiplies the opacity by 0.08 / 0.18.
    let filter = [("filter_3D", 0.02)];
    let filtered = 0.9 * 0.5_f32.powf(1.5) * 255.0 * (0.08 / 0.18);
    for (comments, more, stated, grey) in [
        ("", &[][..], Antialiasing::None, 229.5),
        (mip, &[], Antialiasing::Wide, 27.0),
        (&brush, &[], Antialiasing::Narrow, 65.6),
        ("comment antialiased 1\n", &[], Antialiasing::Wide, 27.0),
        ("comment antialiasing 0.1\n", &[], Antialiasing::Narrow, 65.6),
        ("", &filter, Antialiasing::Narrow, filtered),
    ] {
        let file = folder.path().join("one.ply");
        std::fs::write(&file, one(comments, more)).expect("a file");
        check(&file, stated, grey);
    }
}

#[test]
#[ignore = "needs the shared cases: set DENSIFY_SHARED"]
fn shared_models_with_antialiasing_have_the_expected_grey() {
    for (name, stated, grey) in
        [("one_mip", Antialiasing::Wide, 27.0), ("one_mip_brush", Antialiasing::Narrow, 66.0)]
    {
        let file = densify_fixtures::shared(&format!("../cases/mip/{name}.ply"));
        check(&file, stated, grey);
    }
}
