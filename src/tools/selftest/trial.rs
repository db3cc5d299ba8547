//! One run of a case on a backend: compares with the reference and records figures.

use densify_policies::adc;
use densify_policies::plan::EditPlan;
use densify_policies::policy::{Cadence, LossTerms};

use super::compare::{Limits, Table, class, compare_images, relative_error};
use super::reference::{self, CLASSES, Image, Model, Rules, ScreenGradient, View, blend, project};
use super::scenes;
use super::subject::Subject;
use super::values::RATES;
use densify_core::camera::Camera;
use densify_core::gaussians::Gaussians;
use densify_core::image::Image8;
use densify_render::cpu::ModelGradient;
use densify_render::{BackendError, Differentiable, Rendering, StepInput, StepOutput};

/// Training steps after each comparison of a scene.
const STEPS: u32 = 5;
/// Name of the figure that counts non-finite numbers after these steps.
const BROKEN_BY_STEPS: &str = "NaN or infinity in 5 steps and an edit";

/// A running case.
pub(super) struct Trial<'a> {
    pub(super) subject: &'a Subject,
    /// True to include checks that take minutes.
    pub(super) long: bool,
    pub(super) table: Table,
    /// Tolerances of images.
    pub(super) limits: Limits,
    /// Tolerance of gradients, relative to the largest of their parameter class.
    pub(super) gradient_tolerance: f64,
}

impl<'a> Trial<'a> {
    pub(super) fn new(subject: &'a Subject, long: bool) -> Self {
        let (limits, gradient_tolerance) = (subject.limits(), subject.gradient_tolerance());
        Self { subject, long, table: Table::new("selftest"), limits, gradient_tolerance }
    }

    /// True if the native backend's memory can be measured as that of the process: long cases run alone,
    /// others may run beside other tests.
    pub(super) fn is_memory_measurable(&self) -> bool {
        self.long && matches!(self.subject, Subject::Native { .. })
    }

    /// Records a figure and its tolerance.
    pub(super) fn record(&mut self, label: &str, quantity: &str, error: f64, tolerance: f64) {
        self.table.check(label, quantity, error, tolerance);
    }

    /// Records a count that must be zero.
    pub(super) fn count(&mut self, label: &str, quantity: &str, count: usize) {
        self.record(label, quantity, count as f64, 0.0);
    }

    /// Compares the image, gradients and row statistics of a view with the reference's, then trains on it.
    /// Returns the gradients of the backend and of the reference.
    pub(super) fn check(
        &mut self,
        label: &str,
        model: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
    ) -> Result<(ModelGradient, Model), BackendError> {
        let view = View { camera, background: background.map(f64::from), sh_degree };
        let (exact, rules) = (Model::from(model), Rules::STANDARD);
        let splats = project::project(&exact, view, &rules);
        let order = project::by_depth(&splats);
        let image = blend::render(&splats, &order, view, &rules);
        let upstream = scenes::upstream(camera, 99).ignoring(&image.boundary);
        let screen = blend::backward(&splats, &order, view, &rules, &upstream);
        let expected = project::backward(&exact, view, &splats, &screen);

        let mut backend = self.subject.backend(model)?;
        let upstream = scenes::narrowed(&upstream);
        let (found, measured) = backend.differentiate(camera, background, sh_degree, &upstream)?;
        self.compare_image(label, &found, &image);
        for name in CLASSES {
            let error = relative_error(class(&measured, name), expected.class(name));
            self.record(label, name, error, self.gradient_tolerance);
        }
        self.compare_statistics(label, &measured, &screen, &image.boundary);
        self.train(label, &mut *backend, camera, background, sh_degree)?;
        Ok((measured, expected))
    }

    /// Compares the image of a view with the reference's.
    pub(super) fn check_image(
        &mut self,
        label: &str,
        model: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
    ) -> Result<(), BackendError> {
        let view = View { camera, background: background.map(f64::from), sh_degree };
        let image = reference::render(&Model::from(model), view, &Rules::STANDARD);
        let found = self.subject.backend(model)?.render(camera, background, sh_degree)?;
        self.compare_image(label, &found, &image);
        Ok(())
    }

    /// Checks that the image of a view and its gradients are finite, then trains on it.
    pub(super) fn check_finite(
        &mut self,
        label: &str,
        model: &Gaussians,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
    ) -> Result<ModelGradient, BackendError> {
        let mut backend = self.subject.backend(model)?;
        let upstream = scenes::narrowed(&scenes::upstream(camera, 5));
        let (image, gradient) = backend.differentiate(camera, background, sh_degree, &upstream)?;
        let images: [&[f32]; 3] = [&image.rgb, &image.alpha, &image.depth];
        let gradients = CLASSES.map(|name| class(&gradient, name));
        let broken = count_non_finite(&images) + count_non_finite(&gradients);
        self.count(label, "NaN or infinity", broken);
        self.train(label, &mut *backend, camera, background, sh_degree)?;
        Ok(gradient)
    }

    fn compare_image(&mut self, label: &str, found: &Rendering, image: &Image) {
        let deepest = image.depth.iter().fold(1.0_f64, |m, d| m.max(*d));
        let limits = self.limits;
        let arrays = [
            ("rgb", &found.rgb, &image.rgb, limits),
            ("alpha", &found.alpha, &image.alpha, limits),
            ("depth", &found.depth, &image.depth, limits.scaled(deepest)),
        ];
        for (quantity, found, expected, limits) in arrays {
            let outcome = compare_images(found, expected, &image.boundary, limits);
            self.table.image(label, quantity, outcome, limits);
        }
    }

    fn compare_statistics(
        &mut self,
        label: &str,
        measured: &ModelGradient,
        rows: &[ScreenGradient],
        boundary: &[bool],
    ) {
        let tolerance = self.gradient_tolerance;
        let mut compare = |quantity: &str, found: &[f32], expected: Vec<f64>| {
            self.table.check(label, quantity, relative_error(found, &expected), tolerance);
        };
        let flat = |f: fn(&ScreenGradient) -> Vec<f64>| rows.iter().flat_map(f).collect::<Vec<_>>();
        compare("mean2d", measured.mean2d.as_flattened(), flat(|s| s.mean.to_vec()));
        compare("mean2d_abs", measured.mean2d_abs.as_flattened(), flat(|s| s.mean_abs.to_vec()));
        compare("colour", measured.colour.as_flattened(), flat(|s| s.colour.to_vec()));
        compare("max_weight", &measured.max_weight, flat(|s| vec![s.max_weight]));
        let boundary_pixels = boundary.iter().filter(|b| **b).count() as f64;
        let mut invisible = 0;
        for (row, expected) in rows.iter().enumerate() {
            let error = f64::from(measured.pixel_count[row].abs_diff(expected.pixels));
            self.record(label, "pixel_count", error, boundary_pixels);
            let error = (f64::from(measured.sum_weight[row]) - expected.sum_weight).abs();
            let flips = boundary_pixels * Limits::CPU.step;
            self.record(label, "sum_weight", error, tolerance * expected.sum_weight + flips);
            invisible += usize::from(expected.pixels > 0 && !measured.visible[row]);
        }
        self.count(label, "rows blended but not visible", invisible);
    }

    /// Trains for some steps and applies an edit; then the number of rows must be unchanged, and every number of
    /// the model, of the optimiser and of an image finite.
    pub(super) fn train(
        &mut self,
        label: &str,
        backend: &mut dyn Differentiable,
        camera: &Camera,
        background: [f32; 3],
        sh_degree: u8,
    ) -> Result<(), BackendError> {
        let target = scenes::target(camera);
        let mut broken = 0;
        for number in 1..=STEPS {
            let output = step(backend, number, camera, &target, background, sh_degree)?;
            broken += usize::from(!(output.loss.is_finite() && output.ssim.is_finite()));
        }
        let rows = backend.rows();
        let mut plan = EditPlan::new(rows, backend.budget());
        if rows > 1 {
            // The pruned row makes room for the child of the split, so neither edit is refused.
            let _ = plan.prune(0);
            let _ = plan.grow(rows as u32 - 1, adc::split_by(1.6));
        }
        backend.apply(&plan.compile(), 7, STEPS)?;
        broken += usize::from(backend.rows() != rows);
        broken += backend.audit()?.len();
        let image = backend.render(camera, background, sh_degree)?;
        broken += count_non_finite(&[&image.rgb, &image.alpha, &image.depth]);
        self.count(label, BROKEN_BY_STEPS, broken);
        Ok(())
    }
}

/// One training step with the learning rates of the suite.
pub(super) fn step(
    backend: &mut dyn Differentiable,
    number: u32,
    camera: &Camera,
    target: &Image8,
    background: [f32; 3],
    sh_degree: u8,
) -> Result<StepOutput, BackendError> {
    backend.train_step(&StepInput {
        step: number,
        view: 0,
        camera,
        target,
        background,
        exposure: None,
        pose: false,
        vignette: None,
        depth: None,
        distortion: 0.0,
        sh_degree,
        rates: RATES,
        loss_terms: LossTerms::default(),
        noise: None,
        cadence: Cadence::default(),
        seed: 7,
    })
}

/// Number of values that are not finite.
pub(super) fn count_non_finite(arrays: &[&[f32]]) -> usize {
    arrays.iter().flat_map(|values| values.iter()).filter(|v| !v.is_finite()).count()
}

/// The bits of an image, its gradients and its pixel counts.
pub(super) fn bits((image, gradient): &(Rendering, ModelGradient)) -> Vec<u32> {
    let classes = CLASSES.map(|name| class(gradient, name));
    let images: [&[f32]; 3] = [&image.rgb, &image.alpha, &image.depth];
    let all = images.into_iter().chain(classes).flatten().map(|v| v.to_bits());
    all.chain(gradient.pixel_count.iter().copied()).collect()
}

/// Number of positions at which two arrays differ.
pub(super) fn count_different(a: &[u32], b: &[u32]) -> usize {
    a.len().abs_diff(b.len()) + a.iter().zip(b).filter(|(a, b)| a != b).count()
}
