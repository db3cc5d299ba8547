//! Fault injection: shows that the selftest can fail.
//!
//! In tests, a [`FaultyBackend`] stands in for the native backend and spoils one kind of output. Every kind
//! of measurement of every case must exceed its tolerance under at least one fault.

use std::cell::Cell;
use std::collections::BTreeSet;
use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use std::time::Duration;

use densify_core::antialiasing::Antialiasing;
use densify_core::camera::Camera;
use densify_core::gaussians::ModelArray;
use densify_core::image::Image8;
use densify_core::memory::Ledger;
use densify_policies::plan::RowOps;
use densify_policies::policy::{Candidate, SignalSet, Signals};
use densify_render::cpu::{CpuBackend, ModelGradient};
use densify_render::{
    AuxInput, AuxOutput, Backend, BackendError, Differentiable, ImageGradient, NonFinite,
    NumberKind, Rendering, StateArray, StateError, StepInput, StepOutput, Tensor,
};

use super::{Subject, cases};

/// The kind of output that is made wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fault {
    /// Images too bright, each more so than the one before; SSIM too low.
    Images,
    /// Gradients, row statistics, losses and SSIM too large.
    Gradients,
    /// NaN in images and losses.
    NotANumber,
    /// Wrong losses and counts reported by training steps.
    Steps,
    /// A downloaded model with wrong values.
    Model,
    /// One non-finite number too many reported by the audit.
    Audit,
}

thread_local! {
    /// The fault of the backends that this thread makes.
    static FAULT: Cell<Option<Fault>> = const { Cell::new(None) };
}

/// Wraps a native backend in the fault that is switched on for this thread, if any.
pub(crate) fn wrap(inner: CpuBackend) -> Box<dyn Differentiable> {
    match FAULT.get() {
        Some(fault) => Box::new(FaultyBackend { inner, fault }),
        None => Box::new(inner),
    }
}

/// A native backend with spoilt outputs.
struct FaultyBackend {
    inner: CpuBackend,
    fault: Fault,
}

impl FaultyBackend {
    fn spoil_image(&self, mut image: Rendering) -> Rendering {
        static IMAGES: AtomicU32 = AtomicU32::new(1);
        let planes = [&mut image.rgb, &mut image.alpha, &mut image.depth];
        match self.fault {
            Fault::Images => {
                let offset = 0.6 + 0.02 * IMAGES.fetch_add(1, Relaxed) as f32;
                planes.into_iter().flatten().for_each(|v| *v += offset);
            }
            Fault::NotANumber => planes.into_iter().for_each(|plane| plane[0] = f32::NAN),
            _ => {}
        }
        image
    }

    fn spoil_gradient(&self, mut gradient: ModelGradient) -> ModelGradient {
        if self.fault != Fault::Gradients {
            return gradient;
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
        arrays.into_iter().for_each(|values| self.spoil_values(values));
        gradient.pixel_count.iter_mut().for_each(|n| *n += 5000);
        gradient
    }

    fn spoil_values(&self, gradient: &mut [f32]) {
        if self.fault == Fault::Gradients {
            gradient.iter_mut().for_each(|g| *g = 1.5 * *g + 0.1);
        }
    }

    fn spoil_output(&self, output: StepOutput) -> StepOutput {
        let StepOutput { loss, l1, ssim, visible, entries, .. } = output;
        match self.fault {
            Fault::Images => StepOutput { ssim: ssim - 0.01, ..output },
            Fault::Gradients => {
                StepOutput { loss: loss + 0.01, l1: l1 + 0.01, ssim: ssim + 2.0, ..output }
            }
            Fault::NotANumber => StepOutput { loss: f32::NAN, ..output },
            Fault::Steps => {
                let (visible, entries) = (visible + 1, entries + 1);
                StepOutput { loss: loss + 0.5, visible, entries, bands: 1, ..output }
            }
            _ => output,
        }
    }
}

impl Backend for FaultyBackend {
    fn rows(&self) -> usize {
        self.inner.rows()
    }

    fn antialiasing(&self) -> Antialiasing {
        self.inner.antialiasing()
    }

    fn sh_degree(&self) -> u8 {
        self.inner.sh_degree()
    }

    fn budget(&self) -> usize {
        self.inner.budget()
    }

    fn ledger(&self) -> &Ledger {
        self.inner.ledger()
    }

    fn begin_epoch(&mut self) {
        self.inner.begin_epoch();
    }

    fn train_step(&mut self, input: &StepInput<'_>) -> Result<StepOutput, BackendError> {
        self.inner.train_step(input).map(|output| self.spoil_output(output))
    }

    fn observe(&mut self, input: &AuxInput<'_>) -> Result<AuxOutput, BackendError> {
        self.inner.observe(input)
    }

    fn take_signals(&mut self, wanted: SignalSet) -> Result<Signals, BackendError> {
        self.inner.take_signals(wanted)
    }

    fn give_back(&mut self, signals: Signals) {
        self.inner.give_back(signals);
    }

    fn candidates(&self) -> &[Candidate] {
        self.inner.candidates()
    }

    fn apply(&mut self, ops: &RowOps, seed: u64, step: u32) -> Result<(), BackendError> {
        self.inner.apply(ops, seed, step)
    }

    fn audit(&mut self) -> Result<Vec<NonFinite>, BackendError> {
        let mut found = self.inner.audit()?;
        if self.fault == Fault::Audit {
            let (array, kind) = (ModelArray::Means, NumberKind::Parameter);
            found.insert(0, NonFinite { row: 0, array, kind });
        }
        Ok(found)
    }

    fn render(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
    ) -> Result<Rendering, BackendError> {
        let image = self.inner.render(camera, background, sh_degree)?;
        Ok(self.spoil_image(image))
    }

    fn download_array(
        &self,
        array: ModelArray,
        rows: Range<usize>,
    ) -> Result<Vec<f32>, BackendError> {
        let values = self.inner.download_array(array, rows)?;
        if self.fault != Fault::Model {
            return Ok(values);
        }
        let all = |value| vec![value; values.len()];
        Ok(match array {
            ModelArray::Means => values.iter().map(|x| x + 1.0).collect(),
            ModelArray::LogScales => all(50.0),
            ModelArray::Quats => all(0.0),
            ModelArray::OpacityLogits => all(10.0),
            ModelArray::Sh => all(9.0),
        })
    }

    fn upload_array(
        &mut self,
        array: ModelArray,
        rows: Range<usize>,
        values: &[f32],
    ) -> Result<(), BackendError> {
        self.inner.upload_array(array, rows, values)
    }

    fn state(&self) -> Vec<StateArray> {
        self.inner.state()
    }

    fn save_rows(&self, name: &str, rows: Range<usize>) -> Result<Tensor, BackendError> {
        self.inner.save_rows(name, rows)
    }

    fn restore_rows(&mut self, tensor: Tensor, rows: Range<usize>) -> Result<(), StateError> {
        self.inner.restore_rows(tensor, rows)
    }

    fn stage_times(&self) -> &[(&'static str, Duration)] {
        self.inner.stage_times()
    }
}

impl Differentiable for FaultyBackend {
    fn differentiate(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
        upstream: &ImageGradient,
    ) -> Result<(Rendering, ModelGradient), BackendError> {
        let (image, gradient) =
            self.inner.differentiate(camera, background, sh_degree, upstream)?;
        Ok((self.spoil_image(image), self.spoil_gradient(gradient)))
    }

    fn loss(
        &mut self,
        rendering: &Rendering,
        target: &Image8,
        background: [f32; 3],
    ) -> Result<(StepOutput, Vec<f32>), BackendError> {
        let (output, mut gradient) = self.inner.loss(rendering, target, background)?;
        self.spoil_values(&mut gradient);
        Ok((self.spoil_output(output), gradient))
    }
}

/// Case number and kind of the native backend's findings that pass (or fail, if `passing` is false), with `fault`
/// injected.
fn finding_kinds(fault: Option<Fault>, passing: bool) -> BTreeSet<(u8, String)> {
    FAULT.set(fault);
    let findings = cases().iter().flat_map(|case| case.run(&Subject::NATIVE, false));
    let kinds = findings.filter(|f| f.passes() == passing).map(|f| (f.case, f.kind)).collect();
    FAULT.set(None);
    kinds
}

#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn every_figure_can_fail() {
    use Fault::{Audit, Gradients, Images, Model, NotANumber, Steps};
    let all = finding_kinds(None, true);
    assert!(all.len() > 80, "{all:?}");
    let faults = [Images, Gradients, NotANumber, Steps, Model, Audit];
    let mut failed: BTreeSet<_> =
        faults.into_iter().flat_map(|fault| finding_kinds(Some(fault), false)).collect();
    // No fault makes this figure fail: the trainer stops a backend that exceeds its budget before the step is counted.
    failed.insert((30, "steps over the budget".into()));
    let never: Vec<_> = all.difference(&failed).collect();
    assert!(never.is_empty(), "these never fail: {never:?}");
}
