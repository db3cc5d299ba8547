//! Rows that hold no number, or one that no row should hold, among sound ones.

use crate::compare::class;
use crate::reference::CLASSES;
use crate::scenes;
use crate::trial::{Trial, count_broken, count_different};
use crate::values::{EXTREMES, POISON, SLOTS, name_of_slot, remove, slot_of};
use densify_core::gaussians::Gaussians;
use densify_render::{BackendError, Differentiable};

const GREY: [f32; 3] = [0.2, 0.5, 0.3];
/// Sound rows among which the others lie.
const SOUND: usize = 1_000;

/// The model with a copy of its row 0 at the end for each number of a row, with `value` there.
fn with_each_slot(model: &Gaussians, value: f32) -> Gaussians {
    let mut model = model.clone();
    for slot in 0..SLOTS {
        model.means.push(model.means[0]);
        model.log_scales.push(model.log_scales[0]);
        model.quats.push(model.quats[0]);
        model.opacity_logits.push(model.opacity_logits[0]);
        model.sh.extend_from_within(..48);
        let row = model.len() - 1;
        *slot_of(&mut model, row, slot) = value;
    }
    model
}

pub(super) fn poisoned(trial: &mut Trial<'_>) -> Result<(), BackendError> {
    let camera = scenes::camera(49, 40, 19);
    let model = scenes::cloud(SOUND, 3, &camera, 32);
    let upstream = scenes::narrowed(&scenes::upstream(&camera, 5));
    let run = |backend: &mut dyn Differentiable| backend.differentiate(&camera, GREY, 3, &upstream);
    // Of the image, and of the gradients of the rows that are sound.
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
        let what = format!("{value} in every number");
        let poisoned = with_each_slot(&model, value);
        let mut backend = trial.subject.backend(&poisoned)?;
        let different = count_different(&bits(&mut *backend)?, &clean);
        trial.never(&what, "bits of other rows and pixels changed", different);
        let found: Vec<usize> = backend.audit()?.iter().map(|u| u.row as usize).collect();
        let expected: Vec<usize> = (SOUND..SOUND + SLOTS).collect();
        trial.never(&what, "rows not found, or wrongly", usize::from(found != expected));
    }
    // Finite numbers may be drawn, so that they change the image; they break nothing. The poisoned
    // rows come first and last, so that no index is another's by accident.
    for value in EXTREMES {
        let extreme = with_each_slot(&model, value);
        let extreme = remove(&extreme, 3);
        let mut backend = trial.subject.backend(&extreme)?;
        let (image, gradient) = run(&mut *backend)?;
        let what = format!("{value:e} in every number");
        let broken = count_broken(&[&image.rgb, &image.alpha, &image.depth]);
        trial.never(&what, "NaN or infinity in the image", broken);
        for name in CLASSES {
            let all = class(&gradient, name);
            let per_row = all.len() / extreme.len();
            let sound = &all[..per_row * (SOUND - 1)];
            trial.never(&what, "NaN or infinity in gradients of others", count_broken(&[sound]));
            for slot in 0..SLOTS {
                let row = SOUND - 1 + slot;
                let mine = &all[row * per_row..(row + 1) * per_row];
                let what = format!("{value:e} in {}", name_of_slot(slot));
                trial.never(&what, "NaN or infinity in its own gradient", count_broken(&[mine]));
            }
        }
    }
    Ok(())
}
