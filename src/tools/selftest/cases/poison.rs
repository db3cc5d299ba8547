//! Rows that hold NaN, infinity or extreme numbers, among sound ones.

use super::GREEN;
use crate::compare::class;
use crate::reference::CLASSES;
use crate::scenes;
use crate::trial::{Trial, count_different, count_non_finite};
use crate::values::{EXTREMES, POISON, SLOTS, remove, slot_mut, slot_name};
use densify_core::gaussians::Gaussians;
use densify_render::{BackendError, Differentiable};

/// Number of sound rows.
const SOUND: usize = 1_000;

/// Appends a copy of row 0 for each parameter of a row, with `value` in place of that parameter.
fn with_value_in_each_slot(model: &Gaussians, value: f32) -> Gaussians {
    let first = model.len();
    let mut model = model.gather(&(0..first).chain([0; SLOTS]).collect::<Vec<_>>());
    for slot in 0..SLOTS {
        *slot_mut(&mut model, first + slot, slot) = value;
    }
    model
}

pub(super) fn poisoned(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = scenes::camera(49, 40, 19);
    let model = scenes::cloud(SOUND, 3, &camera, 32);
    let upstream = scenes::narrowed(&scenes::upstream(&camera, 5));
    let run =
        |backend: &mut dyn Differentiable| backend.differentiate(&camera, GREEN, 3, &upstream);
    // The bits of the image and of the gradients of the sound rows.
    let bits = |backend: &mut dyn Differentiable| -> Result<Vec<u32>, BackendError> {
        let (image, gradient) = run(backend)?;
        let rows = gradient.means.len();
        let sound = CLASSES.iter().flat_map(|name| {
            let all = class(&gradient, name);
            &all[..all.len() / rows * SOUND]
        });
        let image = [&image.rgb, &image.alpha, &image.depth].into_iter().flatten();
        Ok(image.chain(sound).map(|v| v.to_bits()).collect())
    };
    let clean = bits(&mut *trial.subject.backend(&model)?)?;
    for value in POISON {
        let label = format!("{value} in every parameter");
        let poisoned = with_value_in_each_slot(&model, value);
        let mut backend = trial.subject.backend(&poisoned)?;
        let different = count_different(&bits(&mut *backend)?, &clean);
        trial.count(&label, "bits of other Gaussians and of pixels changed", different);
        let reported: Vec<usize> = backend.audit()?.iter().map(|u| u.row as usize).collect();
        let expected: Vec<usize> = (SOUND..SOUND + SLOTS).collect();
        let is_wrong = usize::from(reported != expected);
        trial.count(&label, "Gaussians missed or wrongly reported by the audit", is_wrong);
    }
    // Finite numbers may be rendered, and change the image; all results stay finite.
    for value in EXTREMES {
        // Without row 3, the extreme rows begin at row 999, which is not a multiple of any vector's length.
        let extreme = remove(&with_value_in_each_slot(&model, value), 3);
        let mut backend = trial.subject.backend(&extreme)?;
        let (image, gradient) = run(&mut *backend)?;
        let label = format!("{value:e} in every parameter");
        let broken = count_non_finite(&[&image.rgb, &image.alpha, &image.depth]);
        trial.count(&label, "NaN or infinity in the image", broken);
        for name in CLASSES {
            let all = class(&gradient, name);
            let per_row = all.len() / extreme.len();
            let broken = count_non_finite(&[&all[..per_row * (SOUND - 1)]]);
            trial.count(&label, "NaN or infinity in the gradients of others", broken);
            for slot in 0..SLOTS {
                let row = SOUND - 1 + slot;
                let own = &all[row * per_row..(row + 1) * per_row];
                let label = format!("{value:e} in {}", slot_name(slot));
                trial.count(&label, "NaN or infinity in its gradient", count_non_finite(&[own]));
            }
        }
    }
    Ok(())
}
