//! A backend that errs on purpose. A suite that never fails shows nothing: every kind of figure of every
//! case must be one that some error moves beyond its tolerance.

use std::collections::BTreeSet;
use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use std::time::Duration;

use densify_policies::plan::RowOps;
use densify_policies::policy::{Candidate, SignalSet, Signals};

use super::cases;
use super::subject::{Differentiable, Subject};
use crate::backend::cpu::{CpuBackend, ImageGradient, ModelGradient};
use crate::backend::{
    Attribute, AuxInput, AuxOutput, Backend, BackendError, Kept, Rendering, StateArray, StateError,
    StepInput, StepOutput, Tensor, Unsound,
};
use crate::camera::Camera;
use crate::dataset::images::Image8;
use crate::gaussians::ModelArray;
use crate::memory::Ledger;

/// In what it errs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sabotage {
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

const ALL: [Sabotage; 6] = [
    Sabotage::Images,
    Sabotage::Gradients,
    Sabotage::Numbers,
    Sabotage::Steps,
    Sabotage::Model,
    Sabotage::Audit,
];

pub(super) struct Saboteur {
    inner: CpuBackend,
    how: Sabotage,
}

impl Saboteur {
    pub(super) fn new(inner: CpuBackend, how: Sabotage) -> Self {
        Self { inner, how }
    }

    fn spoil_image(&self, image: &mut Rendering) {
        static IMAGES: AtomicU32 = AtomicU32::new(1);
        let planes = [&mut image.rgb, &mut image.alpha, &mut image.depth];
        match self.how {
            Sabotage::Images => {
                let by = 0.6 + 0.02 * IMAGES.fetch_add(1, Relaxed) as f32;
                planes.into_iter().flatten().for_each(|v| *v += by);
            }
            Sabotage::Numbers => planes.into_iter().for_each(|plane| plane[0] = f32::NAN),
            _ => {}
        }
    }
}

impl Differentiable for Saboteur {
    fn differentiate(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
        upstream: &ImageGradient,
    ) -> Result<(Rendering, ModelGradient), BackendError> {
        let (mut image, mut gradient) =
            self.inner.differentiate(camera, background, sh_degree, upstream)?;
        self.spoil_image(&mut image);
        if self.how == Sabotage::Gradients {
            if gradient.means.is_empty() {
                gradient.means.push([0.0; 3]);
            }
            let ModelGradient { means, log_scales, quats, opacity_logits, sh, .. } = &mut gradient;
            let rows = means.as_flattened_mut().iter_mut().chain(log_scales.as_flattened_mut());
            let rest = quats.as_flattened_mut().iter_mut().chain(opacity_logits).chain(sh);
            rows.chain(rest).for_each(|g| *g = 1.5 * *g + 0.1);
            let ModelGradient { mean2d, colour, max_weight, .. } = &mut gradient;
            let statistics = mean2d.as_flattened_mut().iter_mut().chain(colour.as_flattened_mut());
            statistics.chain(max_weight).for_each(|g| *g = 1.5 * *g + 0.1);
            gradient.pixel_count.iter_mut().for_each(|n| *n += 5000);
        }
        Ok((image, gradient))
    }

    fn loss(
        &mut self,
        rendering: &Rendering,
        target: &Image8,
        background: [f32; 3],
    ) -> Result<(StepOutput, Vec<f32>), BackendError> {
        let (mut output, mut gradient) = self.inner.loss(rendering, target, background);
        match self.how {
            Sabotage::Images => output.ssim -= 0.01,
            Sabotage::Gradients => {
                (output.loss, output.l1, output.ssim) =
                    (output.loss + 0.01, output.l1 + 0.01, output.ssim + 2.0);
                gradient.iter_mut().for_each(|g| *g = 1.5 * *g + 0.1);
            }
            _ => {}
        }
        Ok((output, gradient))
    }
}

impl Backend for Saboteur {
    fn rows(&self) -> usize {
        self.inner.rows()
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
        let mut output = self.inner.train_step(input)?;
        match self.how {
            Sabotage::Numbers => output.loss = f32::NAN,
            Sabotage::Steps => {
                output.loss += 0.5;
                output.entries += 1;
                output.visible += 1;
                output.bands = 1;
            }
            _ => {}
        }
        Ok(output)
    }
    fn measure_weights(&mut self, camera: &Camera, sh_degree: u8) -> Result<(), BackendError> {
        self.inner.measure_weights(camera, sh_degree)
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
    fn audit(&mut self) -> Result<Vec<Unsound>, BackendError> {
        let mut found = self.inner.audit()?;
        if self.how == Sabotage::Audit {
            let (attribute, kept) = (Attribute::Mean, Kept::Parameter);
            found.insert(0, Unsound { row: 0, attribute, kept });
        }
        Ok(found)
    }
    fn render(
        &mut self,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
    ) -> Result<Rendering, BackendError> {
        let mut image = self.inner.render(camera, background, sh_degree)?;
        self.spoil_image(&mut image);
        Ok(image)
    }
    fn download_array(
        &self,
        array: ModelArray,
        rows: Range<usize>,
    ) -> Result<Vec<f32>, BackendError> {
        let mut values = self.inner.download_array(array, rows)?;
        if self.how == Sabotage::Model {
            match array {
                ModelArray::Means => values.iter_mut().for_each(|x| *x += 1.0),
                ModelArray::LogScales => values.fill(50.0),
                ModelArray::Quats => values.fill(0.0),
                ModelArray::OpacityLogits => values.fill(10.0),
                ModelArray::Sh => values.fill(9.0),
            }
        }
        Ok(values)
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

/// Number and kind of the findings on a subject that hold, or that do not.
fn kinds(subject: &Subject, hold: bool) -> BTreeSet<(u8, String)> {
    let findings = cases().iter().flat_map(|case| case.run(subject, false));
    findings.filter(|f| f.holds() == hold).map(|f| (f.number, f.kind)).collect()
}

#[test]
fn every_figure_can_fail() {
    let all = kinds(&Subject::NATIVE, true);
    assert!(all.len() > 80, "{all:?}");
    let mut failed = BTreeSet::new();
    for how in ALL {
        failed.extend(kinds(&Subject::Sabotaged(how), false));
    }
    // A backend over its budget does not get this far: the trainer stops before.
    failed.insert((30, "steps over the budget".into()));
    let never: Vec<_> = all.difference(&failed).collect();
    assert!(never.is_empty(), "these never fail: {never:?}");
}
