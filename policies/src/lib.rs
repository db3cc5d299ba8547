//! Density-control policies for 3D Gaussian Splatting: where Gaussians are born and die.
//!
//! This crate holds the interface ([`policy`], [`plan`]), the registry ([`registry`]), a
//! conformance suite for any policy ([`conformance`]), and the built-in policies: [`vanilla`], the
//! original adaptive density control; [`taming`], growth by score along a curve; [`diet`], growth by
//! turnover and compensation; [`mcmc`], relocation and noise; [`igs`], long-axis splits by edges. It
//! knows no renderer, no image and no device.
//!
//! # Writing a policy
//!
//! A policy is one file with five parts; the example below has them all.
//!
//! 1. **A manual page**: the leading `//!` block, with a table of the parameters. It is what
//!    `densify policies NAME` prints, and [`conformance::check_manual`] compares it with the code.
//! 2. **Parameters**: a struct with defaults. `--policy-set NAME.parameter=value` sets one. Those
//!    named in [`STEP_PARAMETERS`](registry::ConfiguredPolicy::STEP_PARAMETERS) follow the run's
//!    length.
//! 3. **Needs**: the [`Signal`](policy::Signal)s that it reads. Only these are accumulated, and
//!    reading another is an error. What is measured in training costs nothing more;
//!    [`Signal::FreshWeightMax`](policy::Signal::FreshWeightMax) costs renders of training views, so
//!    say [when it is wanted](policy::DensityPolicy::wants_fresh). So do auxiliary views
//!    ([`Needs::aux`](policy::Needs::aux)), which the policy
//!    [observes](policy::DensityPolicy::observe) one by one. Terms of the loss, noise, the optimiser's
//!    cadence, step sizes and the start are declared there too.
//! 4. **A plan**: at the steps for which it is due, the policy reads the
//!    [`Snapshot`](policy::Snapshot) and calls [`EditPlan`](plan::EditPlan). It never touches a
//!    parameter or a device, so that it runs unchanged on every backend.
//! 5. **State**: what its future depends on beside the signals, as JSON for checkpoints.
//!
//! Rules to remember:
//!
//! - The budget is the plan's to keep. A call that would exceed it is refused and counted as denied;
//!   a refusal is a value, not an error of the policy. At the budget, prune first, then grow: a
//!   pruned row frees its slot within the same plan.
//! - Each row has one fate in a plan. Rows are named by their index before the edit.
//! - Signals may hold anything: zero views, NaN from a Gaussian gone wrong. [`sample`] sorts NaN
//!   last.
//! - Randomness comes from the [`PolicyRng`](rng::PolicyRng) only, keyed by row and purpose: the same
//!   run must make the same plans. No clock, no thread, no iteration over a `HashMap`.
//! - Leave at least one row ([`adc::spare_one`]).
//!
//! ```
//! //! # fade — replace the faintest
//! //!
//! //! | name | default | range | unit | what |
//! //! |---|---|---|---|---|
//! //! | every | 200 | >= 1 | steps | interval |
//! //! | share | 0.05 | 0 to 1 | rows | share of the rows that is replaced |
//!
//! use densify_policies::adc::split_by;
//! use densify_policies::parameters::in_range;
//! use densify_policies::plan::EditPlan;
//! use densify_policies::policy::{
//!     DensityPolicy, Needs, PolicyError, PolicyState, SceneInfo, Signal, SignalSet, Snapshot,
//!     restore_nothing,
//! };
//! use densify_policies::registry::ConfiguredPolicy;
//! use densify_policies::rng::PolicyRng;
//! use densify_policies::sample::{smallest, top_k};
//! use serde::{Deserialize, Serialize};
//!
//! #[derive(Serialize, Deserialize)]
//! #[serde(deny_unknown_fields, default)]
//! pub struct FadeParams {
//!     every: u32,
//!     share: f64,
//! }
//!
//! impl Default for FadeParams {
//!     fn default() -> Self {
//!         Self { every: 200, share: 0.05 }
//!     }
//! }
//!
//! /// Prunes the faintest rows and splits those that carry most of the images.
//! pub struct Fade(FadeParams);
//!
//! impl ConfiguredPolicy for Fade {
//!     type Params = FadeParams;
//!     const STEP_PARAMETERS: &'static [&'static str] = &["every"];
//!
//!     fn new(params: FadeParams, _scene: &SceneInfo) -> Result<Self, PolicyError> {
//!         in_range("every", f64::from(params.every), 1.0..)?;
//!         in_range("share", params.share, 0.0..=1.0)?;
//!         Ok(Self(params))
//!     }
//! }
//!
//! impl DensityPolicy for Fade {
//!     fn needs(&self, _scene: &SceneInfo) -> Needs {
//!         let signals = SignalSet::of(&[Signal::Opacity, Signal::WeightSum]);
//!         Needs { signals, ..Needs::default() }
//!     }
//!
//!     fn is_due(&self, step: u32) -> bool {
//!         step.is_multiple_of(self.0.every)
//!     }
//!
//!     fn plan(
//!         &mut self,
//!         now: &Snapshot<'_>,
//!         _rng: &PolicyRng,
//!         plan: &mut EditPlan,
//!     ) -> Result<(), PolicyError> {
//!         plan.cause("fade");
//!         let count = (self.0.share * now.rows() as f64) as usize;
//!         let rows: Vec<u32> = (0..now.rows() as u32).collect();
//!         // One row fewer than all: a model without rows could never grow again.
//!         let faintest = count.min(now.rows().saturating_sub(1));
//!         for row in smallest(rows, now.signal(Signal::Opacity)?, faintest) {
//!             let _ = plan.prune(row);
//!         }
//!         // Rows that were just pruned are refused here, and counted as denied.
//!         for row in top_k(now.signal(Signal::WeightSum)?, count) {
//!             let _ = plan.grow(row, split_by(1.6));
//!         }
//!         Ok(())
//!     }
//!
//!     fn save(&self) -> PolicyState {
//!         PolicyState::Null
//!     }
//!
//!     fn restore(&mut self, state: PolicyState) -> Result<(), PolicyError> {
//!         restore_nothing(&state)
//!     }
//! }
//!
//! densify_policies::register_policy!(
//!     "fade",
//!     Fade,
//!     summary: "replaces the faintest rows by halves of the heaviest",
//!     source: "an example",
//!     // In a file of its own: include_str!("fade.rs").
//!     doc: "| name | default | range | unit | what |\n\
//!           |---|---|---|---|---|\n\
//!           | every | 200 | >= 1 | steps | interval |\n\
//!           | share | 0.05 | 0 to 1 | rows | share of the rows that is replaced |\n",
//! );
//!
//! // In the tests of your crate:
//! let entry = densify_policies::registry::find("fade")?;
//! densify_policies::conformance::check_policy(entry)?;
//! densify_policies::conformance::check_manual(entry)?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Using it
//!
//! A linker drops a crate that nothing names. The program that is to know an outside policy says so
//! in its main file, `use my_policies as _;`, and calls the command line of `densify`.

pub mod adc;
pub mod conformance;
pub mod diet;
mod edit;
mod error;
#[cfg(test)]
mod event;
pub mod igs;
pub mod mcmc;
mod needs;
mod neighbours;
mod ops;
pub mod parameters;
pub mod plan;
pub mod policy;
pub mod registry;
pub mod rng;
pub mod sample;
pub mod taming;
pub mod vanilla;
