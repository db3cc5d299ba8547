//! Density-control policies for 3D Gaussian Splatting: which Gaussians are cloned, split, pruned or added.
//!
//! This crate holds the interface ([`policy`], [`plan`]), the registry ([`registry`]), a conformance
//! suite for any policy ([`conformance`]), and the built-in policies: [`vanilla`], the original
//! adaptive density control; [`taming`], growth by score along a curve; [`diet`], replacement of the
//! least important Gaussians; [`mcmc`], relocation and noise; [`igs`], long-axis splits at edges;
//! [`lightgaussian`] and [`radsplat`], which prune a model grown by `vanilla`; [`compact_3dgs`], which
//! learns which Gaussians to prune; [`eagles`], coarse-to-fine images with pruning by influence;
//! [`mini_splatting`], sampling by importance; [`reduced_3dgs`], pruning where many Gaussians share a pixel;
//! [`absgs`], splits by absolute gradients; [`fastgs`], the same where several views agree on an error;
//! [`mrnf`], growth by error with decay; and [`merit`], our own, replacement of hardly visible Gaussians. The
//! crate depends on no renderer, image type or device.
//!
//! # For users of gsplat
//!
//! A policy is what gsplat calls a strategy, with one difference: it never modifies parameters or
//! optimiser state. It reads statistics as plain slices and returns a plan of edits, which a backend
//! executes within the budget.
//!
//! | gsplat | here |
//! |---|---|
//! | a subclass of `Strategy` | a type that implements [`DensityPolicy`](policy::DensityPolicy) |
//! | `state["grad2d"]`, `state["count"]` | [`Signal::ScreenGradient`](policy::Signal::ScreenGradient), [`Signal::VisibleCount`](policy::Signal::VisibleCount), declared in [`Needs`](policy::Needs) and accumulated by the backend |
//! | `params["means"]` | [`Signal::Position`](policy::Signal::Position), declared like the others and read with [`positions`](policy::Snapshot::positions) |
//! | `step_post_backward(step, ...)` | [`plan`](policy::DensityPolicy::plan), called after the optimiser step of every iteration for which [`is_due`](policy::DensityPolicy::is_due) returns true |
//! | `duplicate` | [`plan.grow`](plan::EditPlan::grow)`(row, `[`clone_at`](adc::clone_at)`([0.0; 3]))` |
//! | `split` | `plan.grow(row, `[`split_by`](adc::split_by)`(1.6))` |
//! | `remove` | [`plan.prune`](plan::EditPlan::prune)`(row)` |
//! | `relocate`, `sample_add` | `prune`, and `grow` with [`OpacityRule::Conserved`](plan::OpacityRule::Conserved) |
//! | writing to `params` | [`plan.update`](plan::EditPlan::update)`(row, `[`Update`](plan::Update)` { … })` |
//! | `reset_opa` | [`plan.clamp_opacity`](plan::EditPlan::clamp_opacity)`(max)` |
//! | `inject_noise_to_position` | [`Needs::noise`](policy::Needs::noise) |
//! | `cap_max` | the budget of the run, the same for every policy |
//!
//! A *row* is one Gaussian in the parameter arrays.
//!
//! # Writing a policy
//!
//! A policy is one file with five parts; the example below has all but the last.
//!
//! 1. **A manual page**: the leading `//!` block, with a table of the parameters. `densify policies NAME`
//!    prints it, and [`conformance::check_manual`] compares it with the code. A cell in the column `range` holds
//!    `>= a`, `> a`, `a to b` (optionally followed by `, a excluded`, `, b excluded` or `, both excluded`), a list of
//!    words, or nothing.
//! 2. **Parameters**: a struct with defaults, which `--policy-set NAME.parameter=value` overrides. Those
//!    listed in [`STEP_PARAMETERS`](registry::ConfiguredPolicy::STEP_PARAMETERS), as a step or an interval,
//!    scale with the length of the run.
//! 3. **Needs**: the [`Signal`](policy::Signal)s that it reads. Only these are accumulated, and reading
//!    any other is an error. Signals measured in training cost little. Auxiliary views
//!    ([`Needs::aux`](policy::Needs::aux)) cost extra renders, so the policy requests them only for the
//!    events (the steps at which it plans) that need them ([`aux_views`](policy::DensityPolicy::aux_views)).
//!    Loss terms, noise, learning rates, the interval of optimiser steps and changes to the initial model are
//!    declared here too.
//! 4. **A plan**: at the steps at which it is due, the policy reads the
//!    [`Snapshot`](policy::Snapshot) and adds edits to the [`EditPlan`](plan::EditPlan).
//! 5. **State**, if it has any: [`save`](policy::DensityPolicy::save) and
//!    [`restore`](policy::DensityPolicy::restore) store in checkpoints everything that future decisions
//!    depend on, apart from parameters and signals. A policy without state implements neither.
//!
//! Rules:
//!
//! - The plan keeps the budget. A call that would exceed it is refused and counted as denied; a refusal
//!   is not an error. At the budget, prune first, then grow: a pruned row makes room within the
//!   same plan.
//! - Each row has at most one edit in a plan. Rows are identified by their index before the plan is executed.
//! - Signals may hold any value, such as zero views, or NaN from a broken Gaussian. The functions of
//!   [`sample`] sort NaN last.
//! - Runs are reproducible: draw random numbers only from the
//!   [`PolicyRng`](rng::PolicyRng), and use no clock, no threads and no iteration over a `HashMap`.
//! - Leave at least one row ([`adc::spare_one`]).
//!
//! ```
//! //! # fade — replace the faintest Gaussians
//! //!
//! //! | name | default | range | unit | meaning |
//! //! |---|---|---|---|---|
//! //! | every | 200 | >= 1 | steps | interval |
//! //! | share | 0.05 | 0 to 1 | Gaussians | share that is replaced |
//!
//! use densify_policies::adc::split_by;
//! use densify_policies::parameters::StepParameter::{self, Interval, Step};
//! use densify_policies::parameters::in_range;
//! use densify_policies::plan::EditPlan;
//! use densify_policies::policy::{
//!     DensityPolicy, Needs, PolicyResult, SceneInfo, Signal, Snapshot,
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
//! /// Prunes the faintest rows and splits those with the largest sums of blend weights.
//! pub struct Fade(FadeParams);
//!
//! impl ConfiguredPolicy for Fade {
//!     type Params = FadeParams;
//!     const STEP_PARAMETERS: &'static [StepParameter] = &[Interval("every")];
//!
//!     fn new(params: FadeParams, _scene: &SceneInfo) -> PolicyResult<Self> {
//!         in_range("every", f64::from(params.every), 1.0..)?;
//!         in_range("share", params.share, 0.0..=1.0)?;
//!         Ok(Self(params))
//!     }
//! }
//!
//! impl DensityPolicy for Fade {
//!     fn needs(&self, _scene: &SceneInfo) -> Needs {
//!         let signals = [Signal::Opacity, Signal::WeightSum].into();
//!         Needs { signals, ..Needs::default() }
//!     }
//!
//!     fn is_due(&self, step: u32) -> bool {
//!         step.is_multiple_of(self.0.every)
//!     }
//!
//!     fn plan(&mut self, now: &Snapshot, _: &PolicyRng, plan: &mut EditPlan) -> PolicyResult {
//!         plan.cause("fade");
//!         let count = (self.0.share * now.rows() as f64) as usize;
//!         let rows: Vec<u32> = (0..now.rows() as u32).collect();
//!         // Keep at least one row, as an empty model could never grow again.
//!         let pruned = count.min(now.rows().saturating_sub(1));
//!         plan.prune_all(smallest(rows, now.signal(Signal::Opacity)?, pruned));
//!         // Rows that were just pruned are refused here, and counted as denied.
//!         for row in top_k(now.signal(Signal::WeightSum)?, count) {
//!             let _ = plan.grow(row, split_by(1.6));
//!         }
//!         Ok(())
//!     }
//! }
//!
//! densify_policies::register_policy!(
//!     "fade",
//!     Fade,
//!     summary: "replaces the faintest Gaussians by splits of those with the largest weights",
//!     source: "an example",
//!     // In a file of its own: include_str!("fade.rs").
//!     doc: "| name | default | range | unit | meaning |\n\
//!           |---|---|---|---|---|\n\
//!           | every | 200 | >= 1 | steps | interval |\n\
//!           | share | 0.05 | 0 to 1 | Gaussians | share that is replaced |\n",
//! );
//!
//! // In the tests of your crate:
//! let entry = densify_policies::registry::find("fade")?;
//! densify_policies::conformance::check_policy(entry)?;
//! densify_policies::conformance::check_manual(entry)?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Using the policy
//!
//! The linker drops crates that are never named. The main file of the program that uses your policy
//! therefore says `use my_policies as _;` and calls the command line of `densify`; CONTRIBUTING.md has the
//! complete file.

pub mod absgs;
pub mod adc;
pub mod compact_3dgs;
pub mod conformance;
pub mod diet;
pub mod eagles;
mod edit;
mod error;
#[cfg(test)]
mod event;
pub mod fastgs;
pub mod igs;
pub mod lightgaussian;
pub mod mcmc;
pub mod merit;
pub mod mini_splatting;
pub mod mrnf;
mod needs;
pub mod neighbours;
mod ops;
pub mod parameters;
pub mod plan;
pub mod policy;
pub mod prune;
mod quota;
pub mod radsplat;
pub mod reduced_3dgs;
pub mod registry;
pub mod rng;
pub mod sample;
mod signals;
pub mod surface;
pub mod taming;
pub mod vanilla;
