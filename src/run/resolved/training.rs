//! Decisions that depend on the model that a run starts from: the policy with its parameters, and the learning rates.

use densify_policies::policy::{DensityPolicy, Needs, SceneInfo};
use toml::Table;

use super::ResolvedRun;
use crate::failure::Failure;
use densify_train::schedule::RateOptions;

/// The policy of a run and its learning rates.
pub(crate) struct ResolvedTraining {
    pub(crate) policy: Box<dyn DensityPolicy>,
    /// The scene as the policy sees it.
    pub(crate) scene: SceneInfo,
    /// The needs that the policy declares.
    pub(crate) declared: Needs,
    /// Every parameter of the policy, with its value.
    pub(crate) parameters: Table,
    pub(crate) rates: RateOptions,
}

impl ResolvedTraining {
    /// Builds the policy and the learning rates of a run that starts with `initial_rows` rows besides frozen ones.
    ///
    /// # Errors
    /// When a parameter of the policy or a learning rate is invalid.
    pub(crate) fn new(run: &ResolvedRun<'_>, initial_rows: usize) -> Result<Self, Failure> {
        let ResolvedRun { case, size, .. } = run;
        let choices = &case.choices;
        let scene = case.scene(size.rows, initial_rows)?;
        let policy = choices.entry.build(&choices.parameters, &scene)?;
        let declared = policy.needs(&scene);
        let rates = case.spec.learning_rates(
            &declared.rates,
            declared.pixel_loss,
            choices.position_rates.factor,
        )?;
        let parameters = choices.entry.effective(&choices.parameters, &scene)?;
        Ok(Self { policy, scene, declared, parameters, rates })
    }

    /// The policy's parameters that are given in steps, formatted for the user; empty if it has none.
    pub(crate) fn steps(&self, run: &ResolvedRun<'_>) -> String {
        let names = run.case.choices.entry.step_parameters().iter().map(|step| step.name());
        let steps = names.filter_map(|name| Some(format!("{name} {}", self.parameters.get(name)?)));
        steps.collect::<Vec<_>>().join(", ")
    }
}
