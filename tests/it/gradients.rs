//! The backend in `f32` against the reference in `f64`, on scenes made for it: every degree,
//! odd image sizes, wide and narrow lenses, rows behind the camera and beside the frustum.

use densify::backend::{Backend, Rendering};
use densify::camera::Camera;
use densify::gaussians::Gaussians;

use crate::compare::{Limits, Table, compare_images, relative_error};
use crate::reference::{CLASSES, Image, Model, Rules, Upstream, View, differentiate, render};
use crate::scenes;
use crate::subject::{self, Resources};

/// Against the largest gradient of the class. Single precision loses about 1e-6 in a sum over
/// pixels; a hundred times that leaves room for cancellation and none for a wrong term.
const GRADIENT: f64 = 1e-4;

/// Compares image, gradients and statistics of one view with the reference's.
pub(crate) fn check(
    table: &mut Table,
    what: &str,
    model: &Gaussians,
    camera: &Camera,
    background: [f32; 3],
    sh_degree: u8,
) {
    let view = View { camera, background: background.map(f64::from), sh_degree };
    let exact = Model::of(model);
    let boundary = render(&exact, view, &Rules::STANDARD).boundary;
    let upstream = undecided_ignored(scenes::upstream(camera, 99), &boundary);
    let (image, gradient) = differentiate(&exact, view, &Rules::STANDARD, &upstream);
    let mut backend = subject::backend(model, Resources::default());
    let (found, measured) =
        subject::differentiate(&mut backend, camera, background, sh_degree, &upstream);

    compare(table, what, &found, &image);
    for class in CLASSES {
        let error = relative_error(subject::class(&measured, class), gradient.model.class(class));
        table.check(what, class, error, GRADIENT);
    }
    let rows = &gradient.screen;
    let mut on_screen = |quantity: &str, found: &[f32], expected: Vec<f64>| {
        table.check(what, quantity, relative_error(found, &expected), GRADIENT);
    };
    let flat = |f: fn(&crate::reference::ScreenGradient) -> Vec<f64>| {
        rows.iter().flat_map(f).collect::<Vec<f64>>()
    };
    on_screen("mean2d", measured.mean2d.as_flattened(), flat(|s| s.mean.to_vec()));
    on_screen("mean2d_abs", measured.mean2d_abs.as_flattened(), flat(|s| s.mean_abs.to_vec()));
    on_screen("colour", measured.colour.as_flattened(), flat(|s| s.colour.to_vec()));
    on_screen("max_weight", &measured.max_weight, flat(|s| vec![s.max_weight]));
    let close = boundary.iter().filter(|b| **b).count();
    for (row, expected) in rows.iter().enumerate() {
        let off = f64::from(measured.pixel_count[row].abs_diff(expected.pixels));
        table.check(what, "pixel_count", off, close as f64);
        let off = f64::from(measured.sum_weight[row]) - expected.sum_weight;
        let flips = close as f64 * Limits::CPU.step;
        table.check(what, "sum_weight", off.abs(), GRADIENT * expected.sum_weight + flips);
        if expected.pixels > 0 && !measured.visible[row] {
            table.fail(format!("{what}: row {row} is blended but not visible"));
        }
    }
}

/// Compares the image of one view with the reference's.
pub(crate) fn check_image(
    table: &mut Table,
    what: &str,
    model: &Gaussians,
    camera: &Camera,
    background: [f32; 3],
    sh_degree: u8,
) {
    let view = View { camera, background: background.map(f64::from), sh_degree };
    let image = render(&Model::of(model), view, &Rules::STANDARD);
    let mut backend = subject::backend(model, Resources::default());
    let found = backend.render(camera, background, sh_degree).expect("a small image is rendered");
    compare(table, what, &found, &image);
}

fn compare(table: &mut Table, what: &str, found: &Rendering, image: &Image) {
    let deepest = image.depth.iter().fold(1.0_f64, |m, d| m.max(*d));
    let arrays = [
        ("rgb", &found.rgb, &image.rgb, Limits::CPU),
        ("alpha", &found.alpha, &image.alpha, Limits::CPU),
        ("depth", &found.depth, &image.depth, Limits::CPU.scaled(deepest)),
    ];
    for (quantity, found, expected, limits) in arrays {
        table.image(
            what,
            quantity,
            compare_images(found, expected, &image.boundary, limits),
            limits,
        );
    }
}

/// A loss that does not look where decisions are close, so that its gradient can be compared
/// tightly everywhere.
pub(crate) fn undecided_ignored(mut upstream: Upstream, boundary: &[bool]) -> Upstream {
    for (p, _) in boundary.iter().enumerate().filter(|(_, close)| **close) {
        upstream.rgb[3 * p..3 * p + 3].fill(0.0);
        upstream.alpha[p] = 0.0;
        upstream.depth[p] = 0.0;
    }
    upstream
}

const BACKGROUNDS: [[f32; 3]; 3] = [[0.0; 3], [1.0; 3], [0.2, 0.7, 0.4]];

#[test]
fn every_degree() {
    let mut table = Table::new("degrees");
    for degree in 0..=3 {
        let camera = scenes::camera(49, 35, 10 + u64::from(degree));
        let model = scenes::cloud(40, degree, &camera, 20 + u64::from(degree));
        for active in 0..=degree {
            let what = format!("degree {active} of {degree}");
            check(&mut table, &what, &model, &camera, BACKGROUNDS[2], active);
        }
    }
    table.finish();
}

#[test]
fn odd_sizes_and_backgrounds() {
    let mut table = Table::new("sizes");
    let sizes = [(1, 1), (1, 17), (17, 1), (15, 15), (16, 16), (17, 17), (33, 47), (257, 17)];
    for (seed, (width, height)) in sizes.into_iter().enumerate() {
        let camera = scenes::camera(width, height, seed as u64);
        let model = scenes::cloud(37, 1, &camera, 50 + seed as u64);
        let what = format!("{width}x{height}");
        check(&mut table, &what, &model, &camera, BACKGROUNDS[seed % 3], 1);
    }
    table.finish();
}

#[test]
fn lenses() {
    let base = scenes::camera(40, 32, 3);
    let focal = |degrees: f64| 20.0 / (0.5 * degrees).to_radians().tan();
    let wide = |degrees| Camera { fx: focal(degrees), fy: focal(degrees), ..base };
    let lenses = [
        ("0.5 degrees", wide(0.5)),
        ("1 degree", wide(1.0)),
        ("120 degrees", wide(120.0)),
        ("160 degrees", wide(160.0)),
        ("fx = 100 fy", Camera { fx: 400.0, fy: 4.0, ..base }),
        ("centre outside", Camera { cx: -30.0, cy: 55.0, ..base }),
    ];
    let mut table = Table::new("lenses");
    for (seed, (what, camera)) in lenses.into_iter().enumerate() {
        let camera = scenes::rounded(&camera);
        let model = scenes::cloud(30, 1, &camera, 80 + seed as u64);
        check(&mut table, what, &model, &camera, BACKGROUNDS[2], 1);
    }
    table.finish();
}

#[test]
fn rows_behind_and_near_the_camera_are_left_out() {
    let camera = scenes::camera(30, 26, 6);
    let mut model = Gaussians { sh_degree: 1, ..Gaussians::default() };
    // Left-out rows first: an index among the visible ones is not a row's index.
    for z in [-3.0, -0.5, -0.02, 0.0, 0.004, 0.0099, 0.0101, 0.02, 0.3] {
        let colour = |k| if k < 3 { 0.5 - 0.2 * k as f32 } else { 0.05 };
        let mean = scenes::world(&camera, [0.1 * z, -0.05 * z, z]);
        // At most a third of its distance wide, as else a row at 0.01 fills the screen.
        let scale = [0.3, 0.2, 0.1].map(|s: f32| s * (z.abs() as f32).max(1e-3));
        scenes::push(&mut model, mean, scale, [0.8, 0.2, -0.5, 0.1], 0.3, colour);
    }
    let cloud = scenes::cloud(20, 1, &camera, 7);
    model.means.extend(cloud.means);
    model.log_scales.extend(cloud.log_scales);
    model.quats.extend(cloud.quats);
    model.opacity_logits.extend(cloud.opacity_logits);
    model.sh.extend(cloud.sh);
    let mut table = Table::new("near plane");
    check(&mut table, "behind and near", &model, &camera, BACKGROUNDS[2], 1);
    table.finish();
}

#[test]
fn rows_beside_the_frustum() {
    let camera = scenes::camera(34, 28, 12);
    let mut table = Table::new("beside the frustum");
    for times in [1.0, 1.1, 1.2, 1.5, 2.0, 5.0, 20.0] {
        let mut model = Gaussians { sh_degree: 1, ..Gaussians::default() };
        for (row, [x, y]) in [[1.0, 0.1], [-0.2, 1.0], [-1.0, -1.0], [1.0, -0.7]].iter().enumerate()
        {
            let z = 2.0 + 0.4 * row as f64;
            let side = z * times * 0.5;
            let mean = scenes::world(&camera, [x * side, y * side, z]);
            // Long enough to reach into the image.
            let scale = [0.5 * side as f32, 0.2 * side as f32, 0.1];
            let colour = |k| if k < 3 { 0.5 - 0.2 * k as f32 } else { 0.05 };
            scenes::push(&mut model, mean, scale, [0.9, 0.1 * row as f32, -0.3, 0.2], 0.6, colour);
        }
        let what = format!("{times} times the half width");
        check(&mut table, &what, &model, &camera, BACKGROUNDS[2], 1);
    }
    table.finish();
}

#[test]
fn an_empty_model_is_the_background() {
    let camera = scenes::camera(21, 13, 1);
    let model = Gaussians { sh_degree: 2, ..Gaussians::default() };
    let mut backend = subject::backend(&model, Resources::default());
    let background = [0.25, 0.5, 0.75];
    let upstream = scenes::upstream(&camera, 1);
    let (image, gradient) = subject::differentiate(&mut backend, &camera, background, 2, &upstream);
    assert!(image.rgb.chunks_exact(3).all(|rgb| rgb == background));
    assert!(image.alpha.iter().chain(&image.depth).all(|&v| v.to_bits() == 0));
    assert!(CLASSES.iter().all(|class| subject::class(&gradient, class).is_empty()));
}

#[test]
fn the_background_enters_linearly() {
    let camera = scenes::camera(33, 20, 2);
    let model = scenes::cloud(25, 0, &camera, 2);
    let mut backend = subject::backend(&model, Resources::default());
    let upstream = scenes::upstream(&camera, 1);
    let mut image =
        |background| subject::differentiate(&mut backend, &camera, background, 0, &upstream).0;
    let (on_black, on_colour) = (image([0.0; 3]), image([0.3, 0.6, 0.9]));
    for (p, alpha) in on_black.alpha.iter().enumerate() {
        for (c, background) in [0.3, 0.6, 0.9].iter().enumerate() {
            let expected = on_black.rgb[3 * p + c] + (1.0 - alpha) * background;
            assert!((on_colour.rgb[3 * p + c] - expected).abs() < 1e-6, "pixel {p}");
        }
    }
}
