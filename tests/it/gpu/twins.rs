//! Stage by stage: projection, tiles and rasterisation by the image; the loss and its gradient; the
//! backward stages by the gradients of every parameter and the statistics of every row.

use densify::backend::cpu::{ImageGradient, ModelGradient};
use densify::backend::gpu::{GpuBackend, GpuOptions};
use densify::backend::{Backend, Rendering};
use densify::camera::Camera;
use densify::dataset::images::Image8;
use densify::gaussians::Gaussians;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{atomics, backend, name, options, subjects, ways};
use crate::subject::{self, Resources};
use densify::verify::compare::{Limits, Table, compare_images, relative_error};
use densify::verify::reference::{CLASSES, Model, Rules, View, render};
use densify::verify::scenes;

const GREY: [f32; 3] = [0.3, 0.4, 0.6];

/// How far two backends may differ where no decision is close.
const GPU: Limits = Limits { interior: 2e-5, ..Limits::CPU };

/// Scenes: ordinary, each degree, many rows, sizes that are no multiple of a tile, and extremes.
fn scenes() -> Vec<(String, Gaussians, Camera)> {
    let mut all = Vec::new();
    for (rows, degree, width, height) in
        [(60, 0, 64, 64), (300, 1, 61, 35), (300, 2, 16, 16), (900, 3, 70, 50), (5, 3, 1, 33)]
    {
        let camera = scenes::camera(width, height, 100 + u64::from(degree));
        let model = scenes::cloud(rows, degree, &camera, 7 + u64::from(degree));
        all.push((format!("{rows} rows, degree {degree}, {width}x{height}"), model, camera));
    }
    let camera = scenes::camera(64, 48, 5);
    all.push(("extremes".into(), extremes(&camera), camera));
    all
}

/// Needles, huge and tiny rows, saturated opacities, and rows that hold what no row may.
fn extremes(camera: &Camera) -> Gaussians {
    let mut model = scenes::cloud(120, 2, camera, 77);
    for row in 0..model.len() {
        match row % 12 {
            0 => model.log_scales[row] = [-7.0, -0.5, -7.0],
            1 => model.log_scales[row] = [1.5, 1.0, 2.0],
            2 => model.log_scales[row] = [-13.0; 3],
            3 => model.opacity_logits[row] = 40.0,
            4 => model.opacity_logits[row] = -60.0,
            5 => model.means[row][1] = f32::NAN,
            6 => model.log_scales[row][2] = f32::INFINITY,
            7 => model.quats[row] = [0.0; 4],
            8 => model.sh[27 * row] = 1e20,
            9 => model.means[row] = scenes::world(camera, [0.1, 0.0, -3.0]),
            10 => model.log_scales[row] = [-30.0, 90.0, -30.0],
            _ => model.quats[row] = model.quats[row].map(|x| x * 1e-3),
        }
    }
    model
}

/// Pixels in which some decision of the renderer is close.
fn boundaries(model: &Gaussians, camera: &Camera) -> Vec<bool> {
    let view = View { camera, background: GREY.map(f64::from), sh_degree: model.sh_degree };
    render(&Model::of(model), view, &Rules::STANDARD).boundary
}

fn compare(a: &Rendering, b: &Rendering, boundary: &[bool]) -> [Result<f64, String>; 3] {
    let wide = |values: &[f32]| -> Vec<f64> { values.iter().copied().map(f64::from).collect() };
    let scale = b.depth.iter().fold(1.0_f32, |most, d| most.max(*d));
    [
        compare_images(&a.rgb, &wide(&b.rgb), boundary, GPU),
        compare_images(&a.alpha, &wide(&b.alpha), boundary, GPU),
        compare_images(&a.depth, &wide(&b.depth), boundary, GPU.scaled(f64::from(scale))),
    ]
}

#[test]
fn images_are_those_of_the_native_backend() {
    for device in subjects() {
        let mut table = Table::new("images, GPU against CPU");
        for (name, model, camera) in scenes() {
            let mut cpu = subject::backend(&model, Resources::default());
            let expected = cpu.render(&camera, GREY, model.sh_degree).expect("a rendering");
            let found = backend(&model, device).render(&camera, GREY, model.sh_degree);
            let found = found.expect("a rendering");
            let boundary = boundaries(&model, &camera);
            for (what, result) in
                ["rgb", "alpha", "depth"].into_iter().zip(compare(&found, &expected, &boundary))
            {
                table.image(&name, what, result, GPU);
            }
            // The comparison fails where one pixel is off by more than a step.
            let mut broken = found.clone();
            let middle = broken.rgb.len() / 2;
            broken.rgb[middle] += 0.01;
            assert!(compare(&broken, &expected, &boundary)[0].is_err(), "{name}");
        }
        table.finish();
    }
}

/// The statistics of each row, row after row.
fn statistics(gradient: &ModelGradient) -> [(&'static str, Vec<f32>); 5] {
    [
        ("mean2d", gradient.mean2d.as_flattened().to_vec()),
        ("mean2d_abs", gradient.mean2d_abs.as_flattened().to_vec()),
        ("colour", gradient.colour.as_flattened().to_vec()),
        ("max_weight", gradient.max_weight.clone()),
        ("sum_weight", gradient.sum_weight.clone()),
    ]
}

fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().copied().map(f64::from).collect()
}

#[test]
fn gradients_are_those_of_the_native_backend() {
    for device in ways() {
        let mut table = Table::new(&format!("gradients, {} against CPU", name(device)));
        for (name, model, camera) in scenes() {
            let boundary = boundaries(&model, &camera);
            let upstream = scenes::upstream(&camera, 9).ignoring(&boundary);
            let mut cpu = subject::backend(&model, Resources::default());
            let degree = model.sh_degree;
            let (_, expected) = subject::differentiate(&mut cpu, &camera, GREY, degree, &upstream);
            let narrow = |values: &[f64]| values.iter().map(|&v| v as f32).collect();
            let upstream = ImageGradient {
                rgb: narrow(&upstream.rgb),
                alpha: narrow(&upstream.alpha),
                depth: narrow(&upstream.depth),
            };
            let mut gpu = backend(&model, device);
            let found = gpu.differentiate(&camera, GREY, degree, &upstream);
            let (_, found) = found.expect("a small image is rendered");
            for class in CLASSES {
                let expected = wide(subject::class(&expected, class));
                let error = relative_error(subject::class(&found, class), &expected);
                table.check(&name, class, error, 1e-4);
            }
            // Pixels with a close decision count here, each by a step at most.
            let close = boundary.iter().filter(|b| **b).count() as f64;
            for ((what, found), (_, expected)) in
                statistics(&found).into_iter().zip(statistics(&expected))
            {
                let flips = if what == "sum_weight" { close * Limits::CPU.step } else { 0.0 };
                table.check(&name, what, relative_error(&found, &wide(&expected)), 2e-4 + flips);
            }
            assert_eq!(found.visible, expected.visible, "{name}");
            let pixels = found.pixel_count.iter().zip(&expected.pixel_count);
            let most = pixels.map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0);
            table.check(&name, "pixel_count", f64::from(most), close);
        }
        table.finish();
    }
}

fn photograph(width: u32, height: u32, seed: u64, with_alpha: bool, with_mask: bool) -> Image8 {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut bytes = |n: u32| -> Vec<u8> { (0..n).map(|_| rng.random()).collect() };
    let pixels = width * height;
    Image8 {
        width,
        height,
        rgb: bytes(3 * pixels),
        alpha: with_alpha.then(|| bytes(pixels)),
        mask: with_mask.then(|| bytes(pixels)),
    }
}

#[test]
fn the_loss_and_its_gradient_are_those_of_the_native_backend() {
    for device in subjects() {
        let mut table = Table::new("loss, GPU against CPU");
        let empty = Gaussians::default();
        let mut gpu = backend(&empty, device);
        for (seed, (width, height)) in [(64, 48), (37, 29), (1, 1), (17, 3)].into_iter().enumerate()
        {
            for (with_alpha, with_mask) in [(false, false), (true, false), (false, true)] {
                let target = photograph(width, height, seed as u64, with_alpha, with_mask);
                let mut rng = ChaCha8Rng::seed_from_u64(90 + seed as u64);
                let pixels = (width * height) as usize;
                // Half of it equal to the target but for little, where SSIM cancels.
                let rgb: Vec<f32> = (0..3 * pixels)
                    .map(|i| {
                        let near = f32::from(target.rgb[i]) / 255.0;
                        if i % 2 == 0 { near + 1e-4 } else { rng.random_range(0.0..1.0) }
                    })
                    .collect();
                let rendering = Rendering {
                    width,
                    height,
                    rgb,
                    alpha: vec![1.0; pixels],
                    depth: vec![1.0; pixels],
                };
                let mut cpu = subject::backend(&empty, Resources::default());
                let (expected, by) = cpu.loss(&rendering, &target, GREY);
                let (found, measured) = gpu.loss(&rendering, &target, GREY).expect("a loss");
                let name = format!("{width}x{height}, alpha {with_alpha}, mask {with_mask}");
                let scalars = [
                    ("loss", found.loss, expected.loss),
                    ("l1", found.l1, expected.l1),
                    ("ssim", found.ssim, expected.ssim),
                ];
                for (what, found, expected) in scalars {
                    table.check(&name, what, f64::from((found - expected).abs()), 2e-6);
                }
                let error = relative_error(&measured, &wide(&by));
                table.check(&name, "gradient", error, 2e-5);
            }
        }
        table.finish();
    }
}

#[test]
fn bands_and_sizes_leave_nothing_behind() {
    for device in subjects() {
        let camera = scenes::camera(70, 90, 32);
        let other = scenes::camera(100, 20, 3);
        let model = scenes::cloud(150, 1, &camera, 42);
        let bits = |gpu: &mut GpuBackend| -> Vec<u32> {
            let image = gpu.render(&camera, GREY, 1).expect("a rendering");
            image.rgb.iter().chain(&image.depth).map(|v| v.to_bits()).collect()
        };
        let whole = bits(&mut backend(&model, device));
        for cap in [1, 500] {
            let options = GpuOptions { tile_cap: Some(cap), ..options(&model) };
            let mut gpu = GpuBackend::new(&model, &options, device).expect("a small model fits");
            assert!(bits(&mut gpu) == whole, "cap {cap}");
            gpu.render(&other, GREY, 1).expect("a rendering");
            assert!(bits(&mut gpu) == whole, "cap {cap}, after another view");
        }
    }
}

/// Sums start at 0 with every pass, go on over bands, and start again where a pass is taken again because
/// its bands did not do.
#[test]
fn atomic_sums_are_those_of_one_pass_with_any_cap() {
    let camera = scenes::camera(70, 90, 32);
    let model = scenes::cloud(150, 1, &camera, 42);
    let upstream = scenes::upstream(&camera, 9);
    let narrow = |values: &[f64]| values.iter().map(|&v| v as f32).collect();
    let upstream = ImageGradient {
        rgb: narrow(&upstream.rgb),
        alpha: narrow(&upstream.alpha),
        depth: narrow(&upstream.depth),
    };
    let slots = subjects().first().map(|device| {
        let whole = backend(&model, device).differentiate(&camera, GREY, 1, &upstream);
        whole.expect("a small image is rendered").1
    });
    let Some(expected) = slots else { return };
    for device in atomics() {
        let mut table = Table::new(&format!("passes, {}", name(device)));
        for cap in [None, Some(500), Some(1)] {
            let options = GpuOptions { tile_cap: cap, ..options(&model) };
            let mut gpu = GpuBackend::new(&model, &options, device).expect("a small model fits");
            for pass in 1..=3 {
                let found = gpu.differentiate(&camera, GREY, 1, &upstream);
                let (_, found) = found.expect("a small image is rendered");
                let what = format!("cap {cap:?}, pass {pass}");
                for class in CLASSES {
                    let expected = wide(subject::class(&expected, class));
                    let error = relative_error(subject::class(&found, class), &expected);
                    table.check(&what, class, error, 2e-5);
                }
                for ((of, found), (_, expected)) in
                    statistics(&found).into_iter().zip(statistics(&expected))
                {
                    table.check(&what, of, relative_error(&found, &wide(&expected)), 2e-5);
                }
            }
        }
        table.finish();
    }
}

#[test]
fn what_is_allocated_is_what_the_ledger_says() {
    for device in ways() {
        let camera = scenes::camera(40, 30, 32);
        let model = scenes::cloud(20, 3, &camera, 42);
        let options =
            GpuOptions { largest_image: (40, 30), tile_cap: Some(700), ..options(&model) };
        let mut gpu = GpuBackend::new(&model, &options, device).expect("a small model fits");
        let promised = gpu.promised();
        let lines: u64 = gpu.ledger().lines.iter().map(|line| line.bytes).sum();
        assert_eq!((gpu.allocated(), lines), (promised, promised));
        assert_eq!(gpu.ledger().on_device(), promised);
        assert_eq!(&GpuBackend::promise(model.sh_degree, &options, device), gpu.ledger());
        gpu.render(&camera, GREY, 1).expect("a rendering");
        assert_eq!(gpu.allocated(), promised);
        // Only slots take records: nine numbers per pair.
        let of_pairs = gpu.ledger().lines.iter().filter(|line| line.what.contains("per entry"));
        let records: u64 = of_pairs.map(|line| line.bytes).sum();
        let is_in_slots = device.accumulation().is_deterministic();
        assert_eq!(records, if is_in_slots { 4 * 9 * 700 } else { 0 }, "{}", name(device));
    }
}
