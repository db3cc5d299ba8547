//! Checks before the first step that scene, options, views, backend and policy agree.

use densify_policies::policy::{DensityPolicy, Needs, SceneInfo};

use super::{TrainError, TrainOptions};
use densify_core::budget::RowBudget;
use densify_render::Backend;

/// Checks that scene, options, views and backend agree.
pub(super) fn check_options(
    scene: &SceneInfo,
    options: &TrainOptions,
    views: usize,
    backend: &dyn Backend,
) -> Result<(), TrainError> {
    let bad = |reason: String| Err(TrainError::BadOption(reason));
    if views == 0 {
        return Err(TrainError::NoView);
    }
    if u32::try_from(views) != Ok(scene.train_views) {
        return bad(format!("{views} views, but the scene has {}", scene.train_views));
    }
    if options.iterations == 0 || options.iterations != scene.iterations {
        let (given, of_scene) = (options.iterations, scene.iterations);
        return bad(format!("{given} iterations (scene: {of_scene}); both must be equal and >= 1"));
    }
    if !(scene.extent.is_finite() && scene.extent > 0.0) {
        return bad(format!("the scene's extent is {}; it must be positive", scene.extent));
    }
    if let Some(problem) = options.rates.problem() {
        return bad(format!("learning rates: {problem}"));
    }
    let (rows, budget) = (backend.rows(), backend.budget());
    let frozen = options.frozen;
    let expected = RowBudget::for_trainable(scene.budget, frozen).total;
    if budget != expected || rows > budget || rows < frozen {
        let asked = scene.budget;
        return bad(format!("{rows} rows ({frozen} frozen), budget {budget} (scene's: {asked})"));
    }
    Ok(())
}

/// The needs of a policy, after checking their values.
pub(super) fn checked_needs(
    name: &str,
    policy: &dyn DensityPolicy,
    scene: &SceneInfo,
) -> Result<Needs, TrainError> {
    let needs = policy.needs(scene);
    let bad = |error| TrainError::BadOption(format!("the needs of policy `{name}`: {error}"));
    needs.check().map_err(bad)?;
    Ok(needs)
}
