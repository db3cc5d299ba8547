//! Tests of environment images: against gradients, by direction, and as files.

use std::fs;
use std::path::PathBuf;

use image::codecs::{hdr::HdrEncoder, openexr::OpenExrEncoder};
use image::{ExtendedColorType, ImageEncoder, Rgb};

use super::*;
use crate::random::Draws;
use crate::sky::Sky;

fn unit(draws: &mut Draws) -> Vec3 {
    let v = Vec3::new(draws.normal() as f32, draws.normal() as f32, draws.normal() as f32);
    v.normalize()
}

/// An image whose pixels are a function of their direction.
fn panorama(width: usize, radiance: impl Fn(Vec3) -> Vec3) -> Panorama {
    let pixels = (0..width * width / 2).map(|i| radiance(direction(i, width))).collect();
    Panorama::new("test".into(), width, pixels)
}

#[test]
fn an_image_of_one_colour_acts_like_a_uniform_sky() {
    let uniform = Sky::uniform(0.7);
    for width in [2, 64, 200] {
        let image = Sky::Image(panorama(width, |_| Vec3::splat(0.7)).into());
        let mut draws = Draws::new(5, &[]);
        for _ in 0..500 {
            let (d, roughness) = (unit(&mut draws), draws.unit());
            for (a, b) in [
                (image.radiance(d), uniform.radiance(d)),
                (image.irradiance(d), uniform.irradiance(d)),
                (image.blurred(d, roughness), uniform.blurred(d, roughness)),
            ] {
                assert!((a - b).abs().max_element() < 1e-5, "{width} px, {d}: {a}, not {b}");
            }
        }
    }
}

#[test]
fn an_image_of_a_gradient_lights_like_the_gradient() {
    let up = [0.0, 1.0, 0.0];
    let gradient = Sky::Gradient { zenith: [1.0, 0.5, 0.2], ground: [0.1, 0.2, 0.4], up };
    let image = Sky::Image(panorama(128, |d| gradient.radiance(d)).into());
    let mut draws = Draws::new(6, &[]);
    for _ in 0..500 {
        let d = unit(&mut draws);
        for (a, b, tolerance) in [
            (image.radiance(d), gradient.radiance(d), 0.02),
            (image.irradiance(d) / PI, gradient.irradiance(d) / PI, 0.004),
            (image.blurred(d, 1.0), gradient.blurred(d, 1.0), 0.004),
            (image.blurred(d, 0.5), gradient.blurred(d, 0.5), 0.004),
            (image.blurred(d, 0.6), gradient.blurred(d, 0.6), 0.02),
        ] {
            assert!((a - b).abs().max_element() < tolerance, "{d}: {a}, not {b}");
        }
    }
}

#[test]
fn a_bright_pixel_shines_from_its_direction() {
    // (column, row) of 16 x 8 pixels, and the direction of the pixel's centre.
    let turned = |degrees: f32, height: f32| {
        let (sin, cos) = degrees.to_radians().sin_cos();
        Vec3::new(cos, height, sin).normalize()
    };
    for (column, row, towards) in [
        (8, 4, turned(11.25, -0.2)),
        (12, 3, turned(101.25, 0.2)),
        (0, 4, turned(-168.75, -0.2)),
        (4, 4, turned(-78.75, -0.2)),
        (3, 0, Vec3::Y),
        (3, 7, -Vec3::Y),
    ] {
        let mut pixels = vec![Vec3::ZERO; 128];
        pixels[row * 16 + column] = Vec3::new(9.0, 6.0, 3.0);
        let sky = Sky::Image(Panorama::new("test".into(), 16, pixels).into());
        // At a pole all pixels of a row meet, so interpolation mixes them.
        if row != 0 && row != 7 {
            assert!(sky.radiance(towards).x > 4.0);
        }
        assert_eq!(sky.radiance(-towards), Vec3::ZERO);
        for roughness in [0.3, 1.0] {
            let lobe = sky.blurred(towards, roughness);
            assert!(lobe.x > 0.01 && (lobe.x / lobe.z - 3.0).abs() < 1e-3, "{lobe}");
            assert!(sky.blurred(-towards, roughness).x < 1e-3 * lobe.x);
            for aside in [0.0, 60.0, 120.0, 180.0, 240.0, 300.0].map(|turn| turned(turn, 0.0)) {
                if aside.dot(towards) < 0.5 {
                    assert!(sky.blurred(aside, roughness).x < 0.75 * lobe.x, "{towards} {aside}");
                }
            }
        }
    }
}

/// Files of both formats with the same pixels, all of them finite.
fn files(folder: &Path, width: u32, height: u32, pixels: &[[f32; 3]]) -> [PathBuf; 2] {
    let path = folder.join("sky.hdr");
    let colours: Vec<Rgb<f32>> = pixels.iter().map(|&p| Rgb(p)).collect();
    let file = fs::File::create(&path).expect("a file");
    HdrEncoder::new(file).encode(&colours, width as usize, height as usize).expect("HDR");
    [path, exr(folder, width, height, pixels)]
}

fn exr(folder: &Path, width: u32, height: u32, pixels: &[[f32; 3]]) -> PathBuf {
    let path = folder.join("sky.exr");
    let bytes: Vec<u8> = pixels.iter().flatten().flat_map(|v| v.to_ne_bytes()).collect();
    let encoder = OpenExrEncoder::new(fs::File::create(&path).expect("a file"));
    encoder.write_image(&bytes, width, height, ExtendedColorType::Rgb32F).expect("EXR");
    path
}

#[test]
fn files_of_both_formats_are_read_and_clamped() {
    let folder = tempfile::tempdir().expect("folder");
    let mut pixels = [[0.5, 1.0, 2.0]; 32];
    pixels[0] = [16.0, 0.0, 0.25];
    for path in files(folder.path(), 8, 4, &pixels) {
        let sky = Panorama::load(&path).expect("a sky");
        assert_eq!(sky.image.values[0], Vec3::new(16.0, 0.0, 0.25));
        assert_eq!(sky.image.values[31], Vec3::new(0.5, 1.0, 2.0));
    }
    pixels[0] = [f32::NAN, f32::INFINITY, -1.0];
    let sky = Panorama::load(&exr(folder.path(), 8, 4, &pixels)).expect("a sky");
    assert_eq!(sky.image.values[0], Vec3::new(0.0, BRIGHTEST, 0.0));
}

#[test]
fn bad_files_are_errors_that_name_them() {
    let folder = tempfile::tempdir().expect("folder");
    let refused = |path: &Path, words: &[&str]| {
        let message = Panorama::load(path).expect_err("refused").to_string();
        for word in words {
            assert!(message.contains(word), "{message}");
        }
    };
    for path in files(folder.path(), 6, 4, &[[1.0; 3]; 24]) {
        refused(&path, &["6x4", "the sky", "equirectangular"]);
    }
    for path in files(folder.path(), 8, 4, &[[1.0; 3]; 32]) {
        let whole = fs::read(&path).expect("read");
        // A truncated file may load or be refused, but must not panic.
        for length in 0..whole.len() - 1 {
            fs::write(&path, &whole[..length]).expect("write");
            let _ = Panorama::load(&path);
        }
        fs::write(&path, &whole[..whole.len() / 2]).expect("write");
        refused(&path, &["the sky"]);
        // Sizes that the file cannot hold.
        let huge = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8192 +X 16384\n";
        fs::write(&path, huge).expect("write");
        refused(&path, &["16384x8192"]);
        fs::write(&path, b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 99999 +X 199998\n").expect("");
        refused(&path, &["the sky"]);
    }
    let png = folder.path().join("sky.png");
    image::RgbImage::new(4, 2).save(&png).expect("PNG");
    refused(&png, &["sky.png", "neither Radiance HDR nor OpenEXR"]);
    refused(&folder.path().join("none.hdr"), &["none.hdr"]);
}
