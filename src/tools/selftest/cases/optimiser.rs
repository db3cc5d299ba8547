//! The optimiser's arithmetic after gradients of any size, which are set as moments.

use densify_policies::plan::EditPlan;

use crate::scenes;
use crate::trial::{Trial, step};
use crate::values::RATES;
use densify_core::camera::Camera;
use densify_render::{BackendError, LearningRates, NumberKind, StateArray, Values};

/// Gradients whose square is zero, subnormal, ordinary, almost overflowing, and overflowing.
const GRADIENTS: [f32; 8] = [0.0, 1e-45, 1e-23, 1e-15, 1e-6, 1.0, 1e19, 1e30];
/// Row of the gradient whose square overflows.
const OVERFLOWING: u32 = 7;

/// Length of a first step with zero gradient, in units of the learning rate, if the moments were m = g and v = g²
/// before it (Kingma and Ba, algorithm 1).
fn expected_step(gradient: f32) -> f64 {
    let (m, v) = (0.9 * f64::from(gradient), 0.999 * f64::from(gradient * gradient));
    let (m_hat, v_hat) = (m / (1.0 - 0.9), v / (1.0 - 0.999));
    m_hat / (v_hat.sqrt() + 1e-15)
}

pub(super) fn moments(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = scenes::camera(20, 20, 27);
    // A camera that sees nothing, so that there is no gradient.
    let away = Camera { translation: glam::DVec3::new(0.0, 0.0, -1e3), ..camera };
    let mut model = scenes::cloud(GRADIENTS.len(), 3, &camera, 28);
    // All parameters of a kind are equal, so that they are rounded alike, and far from their limits.
    model.means.as_flattened_mut().fill(0.5);
    model.log_scales.as_flattened_mut().fill(-1.0);
    model.opacity_logits.fill(0.5);
    model.sh.fill(0.5);
    let mut backend = trial.subject.backend(&model)?;
    for StateArray { name, .. } in backend.state() {
        let is_first = name.contains("first");
        if !is_first && !name.contains("second") {
            continue;
        }
        let mut moments = backend.save(&name)?;
        let numbers = moments.shape[1];
        let Values::F32(values) = &mut moments.values else { continue };
        for (row, values) in values.chunks_mut(numbers).enumerate() {
            let g = GRADIENTS[row];
            values.fill(if is_first { g } else { g * g });
        }
        if let Err(error) = backend.restore(moments) {
            trial.table.fail(error.to_string());
        }
    }
    let target = scenes::target(&camera);
    step(&mut *backend, 1, &away, &target, [0.2; 3], 3)?;
    let after = backend.download()?;
    let LearningRates { mean, log_scale, opacity, sh_dc, sh_rest, .. } = RATES;
    for (row, &gradient) in GRADIENTS.iter().enumerate() {
        let label = format!("gradient {gradient:e}");
        let expected = if row == OVERFLOWING as usize { 0.0 } else { expected_step(gradient) };
        let sh = after.sh_of(row);
        for (moved, rate) in [
            (0.5 - after.means[row][1], mean),
            (-1.0 - after.log_scales[row][2], log_scale),
            (0.5 - after.opacity_logits[row], opacity),
            (0.5 - sh[1], sh_dc),
            (0.5 - sh[40], sh_rest),
        ] {
            let length = f64::from(moved / rate);
            trial.record(&label, "step, in learning rates", (length - expected).abs(), 5e-3);
        }
    }
    // The audit reports exactly the row whose moment overflows.
    let audit = backend.audit()?;
    let is_expected =
        |u: &densify_render::NonFinite| u.row == OVERFLOWING && u.kind == NumberKind::Moment;
    let wrong = usize::from(audit.is_empty()) + audit.iter().filter(|u| !is_expected(u)).count();
    trial.count("gradient 1e30", "Gaussians missed or wrongly reported by the audit", wrong);
    let mut plan = EditPlan::new(backend.rows(), backend.budget());
    let _ = plan.prune(OVERFLOWING);
    backend.apply(&plan.compile(), 1, 1)?;
    trial.count("gradient 1e30", "Gaussians not finite after its removal", backend.audit()?.len());
    Ok(())
}
