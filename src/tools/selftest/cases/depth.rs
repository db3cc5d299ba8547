//! Rows at the camera, around the near plane, and at equal or nearly equal depths.

use super::{GREEN, UPRIGHT, axis_camera, flat_colour};
use crate::scenes;
use crate::trial::{Trial, bits, count_different};
use densify_core::gaussians::Gaussians;
use densify_render::BackendError;

/// Near plane of the default options.
const NEAR: f32 = 0.01;

pub(super) fn near_plane(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = scenes::camera(30, 26, 6);
    let mut model = Gaussians { sh_degree: 1, ..Gaussians::default() };
    // Invisible rows come first, so that an index among the visible ones differs from the row's index.
    for z in [-3.0, -0.5, -0.02, 0.0, 0.004, 0.0099, 0.0101, 0.02, 0.3, 1e3] {
        let colour = |k| if k < 3 { 0.5 - 0.2 * k as f32 } else { 0.05 };
        let mean = scenes::world(&camera, [0.1 * z, -0.05 * z, z]);
        // At most a third of the distance wide; otherwise a row at 0.01 fills the screen.
        let scale = [0.3, 0.2, 0.1].map(|s: f32| s * (z.abs() as f32).clamp(1e-3, 3.0));
        scenes::push(&mut model, mean, scale, [0.8, 0.2, -0.5, 0.1], 0.3, colour);
    }
    model.append(scenes::cloud(20, 1, &camera, 7));
    trial.check("behind and near", &model, &camera, GREEN, 1)?;

    // One bit to either side of the plane; without rotation, camera z equals the mean's z exactly.
    let camera = axis_camera(16, 16);
    for z in [NEAR.next_down(), NEAR, NEAR.next_up()] {
        let mut model = Gaussians::default();
        scenes::push(&mut model, [0.0, 0.0, z], [z / 20.0; 3], UPRIGHT, 2.0, flat_colour);
        let image = trial.subject.backend(&model)?.render(&camera, GREEN, 0)?;
        let is_drawn = image.alpha.iter().any(|a| *a > 0.5);
        let wrong = is_drawn != (z > NEAR);
        trial.count(&format!("z = {z:.9}"), "Gaussians on the wrong side", usize::from(wrong));
    }
    Ok(())
}

pub(super) fn camera_inside(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = axis_camera(40, 30);
    for times in [1.0_f32, 10.0, 100.0] {
        let mut model = Gaussians::default();
        for (row, z) in [0.02_f32, 0.3, 1.0].into_iter().enumerate() {
            let shade = |k: usize| 0.5 - 0.2 * (k + row) as f32;
            scenes::push(&mut model, [0.0, 0.1 * z, z], [times * z; 3], UPRIGHT, -1.0, shade);
        }
        let mut back = scenes::cloud(10, 0, &camera, 34);
        back.append(model);
        let label = format!("as wide as {times} times the distance");
        trial.check(&label, &back, &camera, GREEN, 0)?;
    }
    Ok(())
}

pub(super) fn camera_at_mean(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    for (label, offset) in [("0", 0.0), ("1e-20", 1e-20_f32), ("0.001", 1e-3)] {
        let camera = axis_camera(33, 30);
        let mut model = scenes::cloud(10, 2, &camera, 34);
        for row in 0..3 {
            model.means[row] = [0.0; 3];
            model.means[row][row] = offset;
            model.log_scales[row] = [0.7, 0.0, 2.0];
        }
        let label = format!("{label} from the camera");
        let gradient = trial.check_finite(&label, &model, &camera, GREEN, 2)?;
        let nonzero = gradient.sh[..3 * 27].iter().filter(|g| **g != 0.0).count();
        trial.count(&label, "gradients of SH without a direction", nonzero);
    }
    Ok(())
}

pub(super) fn equal_depths(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = scenes::camera(32, 24, 36);
    let mut model = scenes::cloud(1000, 0, &camera, 45);
    let place = scenes::world(&camera, [0.0, 0.0, 3.0]);
    model.means.fill(place);
    trial.check("1000 Gaussians at one place", &model, &camera, GREEN, 0)?;
    let upstream = scenes::narrowed(&scenes::upstream(&camera, 12));
    let run = || trial.subject.backend(&model)?.differentiate(&camera, GREEN, 0, &upstream);
    let first = bits(&run()?);
    let mut different = 0;
    for _ in 0..3 {
        different += count_different(&bits(&run()?), &first);
    }
    trial.count("1000 Gaussians at one place", "bits that differ between runs", different);
    Ok(())
}

pub(super) fn depth_order(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = axis_camera(16, 16);
    // Red in front of green, in both orders of the rows.
    let (red, green) = ([1.5, -2.0, -2.0], [-2.0, 1.5, -2.0]);
    let (mut wrong, mut pairs) = (0, 0);
    let mut z = NEAR.next_up();
    while z <= 1e6 {
        let pair = [(z, red), (z.next_up(), green)];
        for order in [[0, 1], [1, 0]] {
            let mut model = Gaussians::default();
            for (z, colour) in order.map(|i| pair[i]) {
                let scale = [z * 0.1; 3];
                scenes::push(&mut model, [0.0, 0.0, z], scale, UPRIGHT, 4.0, |k| colour[k]);
            }
            let image = trial.subject.backend(&model)?.render(&camera, [0.0; 3], 0)?;
            let middle = 3 * (8 * 16 + 8);
            wrong += usize::from(image.rgb[middle] <= 2.0 * image.rgb[middle + 1]);
            pairs += 1;
        }
        z *= 7.3;
    }
    trial.count(&format!("{pairs} pairs"), "Gaussians in the wrong order", wrong);
    // Zero of either sign and the smallest numbers are closer than the near plane.
    let mut drawn = 0;
    for z in [0.0, -0.0, 1e-45, -1e-45, 1e-38, f32::MIN_POSITIVE] {
        let mut model = Gaussians::default();
        scenes::push(&mut model, [0.0, 0.0, z], [1e-3; 3], UPRIGHT, 4.0, flat_colour);
        let image = trial.subject.backend(&model)?.render(&camera, GREEN, 0)?;
        drawn += image.alpha.iter().filter(|a| **a != 0.0).count();
    }
    trial.count("depths around zero", "pixels of Gaussians that are too near", drawn);
    Ok(())
}
