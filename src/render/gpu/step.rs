//! A training step: fills the uniform buffer and runs the passes.

use std::time::Instant;

use densify_policies::policy::MaskTerm;

use super::frame::{Frame, due, target as target_flags};
use super::observe::RenderedView;
use super::passes::{Passes, Recorder};
use super::{GpuBackend, Waiting, pose};
use crate::candidates::{Photograph, error_weights};
use crate::depth::{DepthLoss, DepthTerm};
use crate::pixel_map::edge_weights;
use crate::signals::Field;
use crate::{BackendError, StepInput, StepOutput, assert_same_size};
use densify_core::image::Image8;

impl GpuBackend {
    /// Returns the bits of the frame ([`due`]) that tell which parameter groups this step updates and which have
    /// gradients waiting from earlier steps, and then the groups whose gradients wait after this step.
    fn cadence_bits(&self, input: &StepInput<'_>) -> (u32, Waiting) {
        let (step, cadence) = (input.step, input.cadence);
        assert!(cadence.is_within(self.cadence), "step {step}: {cadence:?} was not declared");
        let [main, rest] = cadence.steps_at(step);
        let bits = [
            (main, due::MAIN_STEPS),
            (rest, due::REST_STEPS),
            (self.waiting.main, due::MAIN_WAITED),
            (self.waiting.rest, due::REST_WAITED),
            (self.cadence.sh_rest > 1, due::REST_AGES),
        ];
        let bits = bits.iter().filter(|(on, _)| *on).fold(0, |all, (_, bit)| all | bit);
        (bits, Waiting { main: !main, rest: !rest })
    }

    /// Sets what the scores of rows need of the errors of pixels.
    fn load_scores(&self, frame: &mut Frame, target: &Image8, background: [f32; 3]) {
        let score = &self.planes.score;
        let [by_difference, by_dissimilarity] = score.map.weights();
        frame.errors = [0.0, 0.0, by_difference, by_dissimilarity];
        if self.sizes.records.has(Field::Error) {
            frame.draw[3] |= target_flags::BY_PIXEL;
            if score.edge > 0.0 {
                let weights = edge_weights(target, background, score);
                self.write("edges", bytemuck::cast_slice(&weights));
            }
        }
    }

    /// Forward pass, loss, backward pass and optimiser; unless it `trains`, only the pose is differentiated.
    pub(super) fn step(
        &mut self,
        input: &StepInput<'_>,
        trains: bool,
    ) -> Result<StepOutput, BackendError> {
        let StepInput { camera, target, background, exposure, vignette, .. } = *input;
        assert_same_size(camera, target);
        assert!(!input.pose || self.sizes.poses, "the backend was not made for poses");
        let start = Instant::now();
        if self.sizes.alpha_and_depth {
            (self.sizes.alpha_and_depth, self.sizes.records) = (false, self.records);
            self.rebuild()?;
        }
        self.fit_image(camera.width, camera.height)?;
        let (due, waiting) = self.cadence_bits(input);
        let mut frame = self.frame(camera, background, input.sh_degree);
        // Only training views are kept on the device.
        frame.draw[3] = if trains {
            self.load_photograph(input.view, target)
        } else {
            self.upload_target(target)
        };
        let is_exposed = self.load_camera(&mut frame, exposure, vignette);
        let depth = self.load_depth(&mut frame, input);
        let trained = self.sizes.budget.trained(self.rows).max(1) as f32;
        frame.add_step(input, trained, due, &self.planes);
        self.load_scores(&mut frame, target, background);
        let (degree, signals) = (frame.model[1] as u8, self.planes.count > 0);
        let mask = self.mask.map(|mask| MaskTerm { weight: mask.weight / trained, ..mask });
        let pixels = camera.width * camera.height;
        // All passes up to dL/dpixel.
        let compare = |passes: &Passes<'_>, to: &mut Recorder<'_>| {
            if depth.is_some_and(|depth| depth.term == DepthTerm::Samples) {
                passes.place_depth(to, pixels);
            }
            passes.forward(to);
            // Before the loss, which replaces the image.
            if let Some(DepthLoss { distortion, least_inverse, weight, by_transmittance, .. }) =
                depth
            {
                let numbers = [distortion, least_inverse, weight, by_transmittance];
                passes.depth_gradient(to, pixels, numbers);
            }
            if is_exposed {
                passes.expose(to, pixels);
            }
            if vignette.is_some() {
                passes.dim(to, pixels);
            }
            passes.loss(to, is_exposed, true);
            if vignette.is_some() {
                passes.dim_bwd(to, pixels);
            }
            if is_exposed {
                passes.expose_bwd(to, pixels);
            }
        };
        let step = |passes: &Passes<'_>, to: &mut Recorder<'_>| {
            passes.backward(to);
            if trains {
                passes.optimise(to, degree, [input.pose, signals], mask);
            } else {
                passes.differentiate(to, true);
            }
        };
        let picks = trains.then(|| self.candidates.due(input.step, self.rows)).flatten();
        let state = if let Some((request, count)) = picks {
            let weights = error_weights(request.error);
            if let Some(weights) = weights {
                frame.draw[3] |= target_flags::WITH_ERROR;
                frame.errors[..2].copy_from_slice(&weights);
            }
            let search = self.search(&request, count, frame.image);
            let (state, shape) = self.run(&frame, |passes, to| {
                compare(passes, to);
                if let Some(search) = &search {
                    passes.worst(to, search);
                }
            })?;
            let photograph = Photograph::from(input);
            let rendered = RenderedView { frame, shape, photograph };
            self.collect_candidates(&rendered, &request, count, search)?;
            self.continue_view(shape, step);
            if input.pose {
                self.pose_sums = self.read_pose_sums()?;
            }
            state
        } else {
            let run = self.run(&frame, |passes, to| {
                compare(passes, to);
                step(passes, to);
            })?;
            run.0
        };
        if trains {
            self.waiting = waiting;
        }
        if self.device.clock.is_none() {
            self.stage_times = vec![("device", start.elapsed())];
        }
        let exposure = exposure.map(|exposure| self.exposure_gradient(exposure, background));
        let vignette = vignette.map(|_| self.vignette_gradient());
        let given = input.depth.map(|_| state.depth);
        let pose = input.pose.then(|| pose::gradient(self.pose_sums));
        Ok(StepOutput { exposure, vignette, pose, depth: given, ..state.output() })
    }
}
