//! Calls to the policy, and renderings of training views for its decisions.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};

use densify_policies::policy::{AuxRequest, AuxView, PolicyError};

use super::{AtStep, TrainError, Trainer};
use densify_data::views::ViewSource;
use densify_render::{AuxInput, AuxOutput};

impl<V: ViewSource> Trainer<V> {
    /// Renders the auxiliary views for the policy's edit after `step`, one by one.
    pub(super) fn show_aux_views(&mut self, step: u32) -> Result<(), TrainError> {
        let (rows, budget) = self.trained_rows_and_budget();
        let count = self.ask_policy(step, |policy| policy.aux_views(step, rows, budget))? as usize;
        let Some(request) = self.needs.aux.clone().filter(|_| count > 0) else {
            return Ok(());
        };
        for view in self.sample_scored_views(count, step) {
            let measured = self.observe_view(step, view, &request)?;
            let (loss, columns, points) = (measured.loss, &measured.columns, &measured.points);
            let view = AuxView { step, rows, loss, columns, points };
            let observed = call_policy(|| self.policy.observe(&view)).flatten();
            observed.map_err(|source| self.policy_error(step, source))?;
        }
        Ok(())
    }

    /// Renders a training view after `step` and measures it. Shape of the columns: `[rows that are not frozen]`.
    pub(super) fn observe_view(
        &mut self,
        step: u32,
        view: usize,
        request: &AuxRequest,
    ) -> Result<AuxOutput, TrainError> {
        let (image, depth) = self.image_with_depth(step, view)?;
        let exposure = self.state.exposures.as_ref().map(|exposures| exposures.transform(view));
        let vignette = self.vignette(view, self.views.camera(view));
        let (options, sh_degree) = (self.options, self.sh_degree(step));
        let camera = self.camera(view);
        let measured = self.backend.observe(&AuxInput {
            step,
            view,
            seed: options.seed,
            camera: &camera,
            target: &image,
            background: options.background.at(options.seed, step),
            exposure: exposure.as_ref(),
            vignette: vignette.as_ref(),
            sh_degree,
            depth: depth.as_deref(),
            request,
        });
        let mut measured = measured.at(step)?;
        let frozen = self.row_budget().frozen;
        for (_, column) in &mut measured.columns {
            column.drain(..frozen);
        }
        self.state.extra_forwards += 1;
        Ok(measured)
    }
}

/// Calls the policy, which may be third-party code: if it panics, the run ends with an error that names the policy, and
/// the model can still be read. Unwinding is safe because the policy is not called again, and because its calls change
/// nothing but the plan, which is dropped.
///
/// # Errors
/// [`PolicyError::Other`] with the message of the panic.
pub(super) fn call_policy<T>(call: impl FnOnce() -> T) -> Result<T, PolicyError> {
    catch_unwind(AssertUnwindSafe(call)).map_err(|panic| {
        let message = panic_message(&*panic);
        PolicyError::Other(format!("it panicked: {message}; this is a bug in the policy"))
    })
}

fn panic_message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("no message")
}
