//! Blending thresholds (`Shortcuts`): backends with non-default thresholds are compared with the reference under
//! the same thresholds, in the forward and the backward pass.

use densify::core::camera::Camera;
use densify::core::gaussians::Gaussians;
use densify::render::Shortcuts;

use crate::subject::{BLUE, all, make_with};
use densify::selftest::compare::{Limits, Table, class, compare_images, relative_error};
use densify::selftest::reference::{CLASSES, Image, Model, Rules, View, blend, project};
use densify::selftest::{Setup, scenes};

/// Tolerance of gradients relative to the largest of their class.
const GRADIENT_TOLERANCE: f64 = 1e-4;

/// Overlapping translucent Gaussians, so that blending stops early in many pixels.
fn scene() -> (Gaussians, Camera) {
    let camera = scenes::camera(52, 41, 5);
    let mut model = scenes::cloud(160, 1, &camera, 8);
    for logit in &mut model.opacity_logits {
        *logit += 1.5;
    }
    (model, camera)
}

/// Image and gradients of the reference under these rules.
fn truth(
    model: &Gaussians,
    camera: &Camera,
    rules: &Rules,
) -> (Image, Model, densify::selftest::reference::Upstream) {
    let view = View { camera, background: BLUE.map(f64::from), sh_degree: 1 };
    let exact = Model::from(model);
    let splats = project::project(&exact, view, rules);
    let order = project::by_depth(&splats);
    let image = blend::render(&splats, &order, view, rules);
    let upstream = scenes::upstream(camera, 99).ignoring(&image.boundary);
    let screen = blend::backward(&splats, &order, view, rules, &upstream);
    (image, project::backward(&exact, view, &splats, &screen), upstream)
}

#[test]
fn blending_thresholds_apply_to_the_forward_and_backward_pass() {
    let (model, camera) = scene();
    let mut table = Table::new("blending thresholds");
    let standard = truth(&model, &camera, &Rules::STANDARD).0;
    for (alpha_min, transmittance_min) in
        [(1.0 / 255.0, 1e-4), (1.0 / 1024.0, 1e-5), (1.0 / 32.0, 1e-4), (1.0 / 255.0, 1e-2)]
    {
        let shortcuts = Shortcuts { alpha_min, transmittance_min };
        let rules = Rules {
            alpha_min: f64::from(alpha_min),
            transmittance_min: f64::from(transmittance_min),
            ..Rules::STANDARD
        };
        let (image, gradient, upstream) = truth(&model, &camera, &rules);
        let is_standard = shortcuts == Shortcuts::default();
        assert_eq!(image.rgb == standard.rgb, is_standard, "the thresholds have no effect");
        let upstream = scenes::narrowed(&upstream);
        for subject in all() {
            let mut backend = make_with(&subject, &model, Setup { shortcuts, ..Setup::default() });
            let outcome = backend.differentiate(&camera, BLUE, 1, &upstream);
            let (rendering, measured) = outcome.expect("a small image is rendered");
            let name = subject.name();
            let case = format!("{name}, {alpha_min:.4}, {transmittance_min:e}");
            // Near a threshold, a splat may be blended by only one of the renderers; the pixel then differs by about the
            // splat's alpha.
            let step = 1.5 * f64::from(alpha_min.max(transmittance_min).max(1.0 / 255.0));
            let tolerances = Limits { step, ..Limits::CPU };
            let outcome = compare_images(&rendering.rgb, &image.rgb, &image.boundary, tolerances);
            table.image(&case, "rgb", outcome, tolerances);
            for name in CLASSES {
                let error = relative_error(class(&measured, name), gradient.class(name));
                table.check(&case, name, error, GRADIENT_TOLERANCE);
            }
        }
    }
    table.finish();
}
