//! Awkward image sizes, extreme lenses, and rows that fill the image.

use super::{GREEN, UPRIGHT, axis_camera, shade};
use crate::reference::{Model, Rules, View, blend, project};
use crate::scenes;
use crate::trial::{Trial, count_non_finite, step};
use crate::values::{LARGE_SIZES, SIZES};
use densify_core::camera::Camera;
use densify_core::gaussians::Gaussians;
use densify_core::memory::resident;
use densify_render::{BackendError, Setup};

const BACKGROUNDS: [[f32; 3]; 3] = [[0.0; 3], [1.0; 3], [0.2, 0.7, 0.4]];

pub(super) fn images(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    for (seed, (width, height)) in SIZES.into_iter().enumerate() {
        let camera = scenes::camera(width, height, seed as u64);
        let model = scenes::cloud(37, 1, &camera, 50 + seed as u64);
        let label = format!("{width}x{height}");
        trial.check(&label, &model, &camera, BACKGROUNDS[seed % 3], 1)?;
    }
    for (width, height) in LARGE_SIZES {
        check_large_image(trial, width, height)?;
    }
    Ok(())
}

/// Compares some pixels with the reference: at corners, at the borders of tiles, and spread over the image.
fn check_large_image(trial: &mut Trial<'_>, width: u32, height: u32) -> Result<(), BackendError> {
    let camera = scenes::camera(width, height, 60);
    let model = scenes::cloud(40, 1, &camera, 61);
    let label = format!("{width}x{height}");
    let image = match trial.subject.backend(&model)?.render(&camera, GREEN, 1) {
        // A device with small buffers does not support such an image; there is nothing to compare.
        Err(BackendError::BufferTooLarge { .. }) => return Ok(()),
        other => other?,
    };
    let view = View { camera: &camera, background: GREEN.map(f64::from), sh_degree: 1 };
    let splats = project::project(&Model::from(&model), view, &Rules::STANDARD);
    let order = project::by_depth(&splats);
    let ends = |size: u32| [0, 15, 16, size / 2, size - 17, size - 16, size - 1];
    let borders = ends(height).into_iter().flat_map(|y| ends(width).map(|x| [x, y]));
    let spread = (0..500_u32).map(|i| [i * 2_654_435 % width, i * 40_503 % height]);
    let mut worst = 0.0_f64;
    for [x, y] in borders.chain(spread) {
        let exact = blend::render_pixel(&splats, &order, view, &Rules::STANDARD, [x, y]);
        let at = 3 * (y as usize * width as usize + x as usize);
        for (found, exact_value) in image.rgb[at..at + 3].iter().zip(exact.rgb) {
            let error = (f64::from(*found) - exact_value).abs();
            worst = if error.is_nan() || exact.boundary { worst } else { worst.max(error) };
        }
    }
    let broken = count_non_finite(&[&image.rgb, &image.alpha, &image.depth]);
    trial.count(&label, "NaN or infinity", broken);
    let tolerance = trial.limits.interior;
    trial.record(&format!("{label}: rgb of 549 pixels"), "image", worst, tolerance);
    Ok(())
}

pub(super) fn lenses(trial: &mut Trial<'_>) -> Result<(), BackendError> {
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
    for (seed, (label, camera)) in lenses.into_iter().enumerate() {
        let camera = scenes::rounded(&camera);
        let model = scenes::cloud(30, 1, &camera, 80 + seed as u64);
        trial.check(label, &model, &camera, BACKGROUNDS[2], 1)?;
    }
    Ok(())
}

/// Rows that each touch every tile of a full-HD image; in the long case half a million, whose number of tile
/// entries exceeds 32 bits. Pixels are opaque after the front rows, so that the image must equal, bit for bit,
/// that of the front rows alone, which is rendered in a single band.
pub(super) fn large_rows(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    const TILES: u64 = 120 * 68;
    let (rows, front) = if trial.long { (530_000, 128) } else { (300, 128) };
    // The long case uses the default cap, which is 16 entries per row.
    let tile_cap = (!trial.long).then_some(rows * TILES as usize / 6);
    let camera = axis_camera(1920, 1080);
    let model = |rows: usize| {
        let mut model = Gaussians::default();
        for row in 0..rows {
            let z = 1.0 + row as f32 * 1e-6;
            scenes::push(&mut model, [0.0, 0.0, z], [100.0 * z; 3], UPRIGHT, -2.0, shade(row));
        }
        model
    };
    let label = format!("{rows} Gaussians");
    let expected = {
        let front = model(front);
        let tile_cap = Some(front.len() * TILES as usize);
        let mut backend =
            trial.subject.backend_with(&front, Setup { tile_cap, ..Setup::default() })?;
        backend.render(&camera, GREEN, 0)?
    };
    let all = model(rows);
    let target = scenes::target(&camera);
    let before = resident();
    let largest_image = (camera.width, camera.height);
    let setup = Setup { largest_image, tile_cap, ..Setup::default() };
    let mut backend = trial.subject.backend_with(&all, setup)?;
    let output = step(&mut *backend, 1, &camera, &target, GREEN, 0)?;
    if let (Some(before), Some(after), true) = (before, resident(), trial.is_memory_measurable()) {
        let used = after.saturating_sub(before) as f64 / backend.ledger().total() as f64;
        trial.record(&label, "memory used, relative to the ledger", used, 1.1);
    }
    let miscounted = output.entries.abs_diff(rows as u64 * TILES) as usize;
    trial.count(&label, "entries miscounted", miscounted);
    trial.count(&label, "images in a single band", usize::from(output.bands < 2));
    let broken = backend.audit()?.len() + usize::from(!output.loss.is_finite());
    trial.count(&label, "NaN or infinity", broken);
    drop(backend);
    let mut backend = trial.subject.backend_with(&all, Setup { tile_cap, ..Setup::default() })?;
    let image = backend.render(&camera, GREEN, 0)?;
    let pairs = image.rgb.iter().zip(&expected.rgb).chain(image.depth.iter().zip(&expected.depth));
    let different = pairs.filter(|(a, b)| a.to_bits() != b.to_bits()).count();
    trial.count(&label, "bits that differ from the front Gaussians alone", different);
    Ok(())
}
