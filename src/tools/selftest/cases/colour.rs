//! SH coefficients of any size, and rows that start black or white.

use glam::DVec3;

use super::GREEN;
use crate::compare::class;
use crate::reference::CLASSES;
use crate::scenes;
use crate::trial::{Trial, count_non_finite, step};
use densify_core::image::Image8;
use densify_data::dataset::PointCloud;
use densify_render::BackendError;
use densify_train::init::initialise;

pub(super) fn colours(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    extreme_coefficients(trial)?;
    black_and_white_learn(trial)
}

fn extreme_coefficients(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = scenes::camera(33, 25, 22);
    for value in [0.0, 1e-30, -1e-30] {
        let mut model = scenes::cloud(16, 3, &camera, 23);
        model.sh[5 * 48..6 * 48].fill(value);
        trial.check(&format!("coefficients {value:e}"), &model, &camera, GREEN, 3)?;
    }
    // Far beyond any colour: the image and the gradients of other rows stay finite.
    for value in [1e4, -1e4, 1e20, -1e20, 1e38, -1e38] {
        let mut model = scenes::cloud(16, 3, &camera, 23);
        model.sh[5 * 48..6 * 48].fill(value);
        let upstream = scenes::narrowed(&scenes::upstream(&camera, 5));
        let mut backend = trial.subject.backend(&model)?;
        let (image, gradient) = backend.differentiate(&camera, GREEN, 3, &upstream)?;
        let mut broken = count_non_finite(&[&image.rgb, &image.alpha, &image.depth]);
        for name in CLASSES {
            let all = class(&gradient, name);
            let per_row = all.len() / model.len();
            broken += count_non_finite(&[&all[..5 * per_row], &all[6 * per_row..]]);
        }
        let label = format!("coefficients {value:e}");
        trial.count(&label, "NaN or infinity", broken);
        trial.train(&label, &mut *backend, &camera, GREEN, 3)?;
    }
    Ok(())
}

/// Checks that black and white rows still learn their colour.
fn black_and_white_learn(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = scenes::camera(24, 24, 24);
    let (width, height) = (camera.width, camera.height);
    let rgb = vec![128; 3 * (width * height) as usize];
    let grey = Image8 { width, height, rgb, alpha: None, mask: None };
    for (label, colour) in [("black", 0), ("white", 255)] {
        let positions = (0..12_u8).map(|i| {
            let at = f64::from(i);
            let local = [0.3 * (at * 1.7).sin(), 0.3 * (at * 2.9).cos(), 2.0 + 0.05 * at];
            DVec3::from(scenes::world(&camera, local).map(f64::from))
        });
        let positions: Vec<DVec3> = positions.collect();
        let points = PointCloud { colours: vec![[colour; 3]; positions.len()], positions };
        let (model, _) = initialise(&points, 12, 0, 1).expect("a sound point cloud");
        let mut backend = trial.subject.backend(&model)?;
        for number in 1..=200 {
            step(&mut *backend, number, &camera, &grey, [0.5; 3], 0)?;
        }
        let after = backend.download()?;
        // The coefficients of grey are 0.
        let moved = model.sh.iter().zip(&after.sh).filter(|(a, b)| b.abs() < a.abs() - 0.05);
        let dead = model.sh.len() - moved.count();
        trial.count(&format!("{label} points"), "colours that did not learn in 200 steps", dead);
    }
    Ok(())
}
