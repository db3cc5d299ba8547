//! Errors on purpose, where the native backend calls these functions in tests. A suite that never fails
//! shows nothing: every kind of figure of every case must be one that some error moves beyond its
//! tolerance.

use std::cell::Cell;
use std::collections::BTreeSet;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use super::{Subject, cases};
use densify_core::gaussians::ModelArray;
use densify_render::cpu::ModelGradient;
use densify_render::{Attribute, NonFinite, NumberKind, Rendering, StepOutput};

/// In what the native backend errs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Sabotage {
    /// Images, each more than the one before, and similarities, downwards.
    Images,
    /// Gradients, statistics of rows, losses, and similarities, upwards.
    Gradients,
    /// Numbers of images and losses that are none.
    Numbers,
    /// What steps report.
    Steps,
    /// The model that is downloaded.
    Model,
    /// Rows that are found to be unsound.
    Audit,
}

thread_local! {
    /// In what backends err that are called by this thread.
    static HOW: Cell<Option<Sabotage>> = const { Cell::new(None) };
}

pub(crate) fn spoil_image(image: &mut Rendering) {
    static IMAGES: AtomicU32 = AtomicU32::new(1);
    let planes = [&mut image.rgb, &mut image.alpha, &mut image.depth];
    match HOW.get() {
        Some(Sabotage::Images) => {
            let by = 0.6 + 0.02 * IMAGES.fetch_add(1, Relaxed) as f32;
            planes.into_iter().flatten().for_each(|v| *v += by);
        }
        Some(Sabotage::Numbers) => planes.into_iter().for_each(|plane| plane[0] = f32::NAN),
        _ => {}
    }
}

pub(crate) fn spoil_gradient(gradient: &mut ModelGradient) {
    if HOW.get() != Some(Sabotage::Gradients) {
        return;
    }
    if gradient.means.is_empty() {
        gradient.means.push([0.0; 3]);
    }
    let arrays = [
        gradient.means.as_flattened_mut(),
        gradient.log_scales.as_flattened_mut(),
        gradient.quats.as_flattened_mut(),
        &mut gradient.opacity_logits,
        &mut gradient.sh,
        gradient.mean2d.as_flattened_mut(),
        gradient.colour.as_flattened_mut(),
        &mut gradient.max_weight,
    ];
    arrays.into_iter().for_each(spoil_numbers);
    gradient.pixel_count.iter_mut().for_each(|n| *n += 5000);
}

pub(crate) fn spoil_numbers(gradient: &mut [f32]) {
    if HOW.get() == Some(Sabotage::Gradients) {
        gradient.iter_mut().for_each(|g| *g = 1.5 * *g + 0.1);
    }
}

pub(crate) fn spoilt_output(output: StepOutput) -> StepOutput {
    let StepOutput { loss, l1, ssim, visible, entries, .. } = output;
    match HOW.get() {
        Some(Sabotage::Images) => StepOutput { ssim: ssim - 0.01, ..output },
        Some(Sabotage::Gradients) => {
            StepOutput { loss: loss + 0.01, l1: l1 + 0.01, ssim: ssim + 2.0, ..output }
        }
        Some(Sabotage::Numbers) => StepOutput { loss: f32::NAN, ..output },
        Some(Sabotage::Steps) => {
            let (visible, entries) = (visible + 1, entries + 1);
            StepOutput { loss: loss + 0.5, visible, entries, bands: 1, ..output }
        }
        _ => output,
    }
}

pub(crate) fn spoilt_audit(mut found: Vec<NonFinite>) -> Vec<NonFinite> {
    if HOW.get() == Some(Sabotage::Audit) {
        let (attribute, kind) = (Attribute::Mean, NumberKind::Parameter);
        found.insert(0, NonFinite { row: 0, attribute, kind });
    }
    found
}

pub(crate) fn spoilt_array(array: ModelArray, values: Vec<f32>) -> Vec<f32> {
    let all = |value| vec![value; values.len()];
    match (HOW.get(), array) {
        (Some(Sabotage::Model), ModelArray::Means) => values.iter().map(|x| x + 1.0).collect(),
        (Some(Sabotage::Model), ModelArray::LogScales) => all(50.0),
        (Some(Sabotage::Model), ModelArray::Quats) => all(0.0),
        (Some(Sabotage::Model), ModelArray::OpacityLogits) => all(10.0),
        (Some(Sabotage::Model), ModelArray::Sh) => all(9.0),
        _ => values,
    }
}

/// Number and kind of the findings on the native backend, erring or not, that hold, or that do not.
fn kinds(how: Option<Sabotage>, hold: bool) -> BTreeSet<(u8, String)> {
    HOW.set(how);
    let findings = cases().iter().flat_map(|case| case.run(&Subject::NATIVE, false));
    let kinds = findings.filter(|f| f.holds() == hold).map(|f| (f.number, f.kind)).collect();
    HOW.set(None);
    kinds
}

#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn every_figure_can_fail() {
    use Sabotage::{Audit, Gradients, Images, Model, Numbers, Steps};
    let all = kinds(None, true);
    assert!(all.len() > 80, "{all:?}");
    let ways = [Images, Gradients, Numbers, Steps, Model, Audit];
    let mut failed: BTreeSet<_> =
        ways.into_iter().flat_map(|how| kinds(Some(how), false)).collect();
    // A backend over its budget does not get this far: the trainer stops before.
    failed.insert((30, "steps over the budget".into()));
    let never: Vec<_> = all.difference(&failed).collect();
    assert!(never.is_empty(), "these never fail: {never:?}");
}
