//! `densify` trains 3D Gaussian Splatting scenes under a hard memory budget.
//!
//! A *policy*, which is a plugin, decides where Gaussians are added and removed (see
//! `densify_policies`). This crate is everything around it: data, renderer, trainer and the
//! command line. Everything that `densify train` does can be done from code:
//!
//! ```no_run
//! use densify::run::{Budget, Occupied, Run, RunSpec, Silent};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let mut spec = RunSpec::default();
//! spec.start.scene = Some("data/garden".into());
//! spec.size.budget = Some(Budget::Rows(50_000));
//! spec.density.policy_set = vec!["diet.rho=0.2".parse()?];
//! let mut run = Run::prepare(&spec)?;
//! println!("{}", run.ledger);
//! // Step by step, with the model at hand ...
//! for event in run.trainer.step()?.events {
//!     println!("step {}: {} Gaussians, {} denied", event.step, event.after, event.denied);
//! }
//! // ... or to the end, with everything that `densify train` writes.
//! println!("the run is in {}", run.train(Occupied::Refuse, &Silent)?.display());
//! # Ok(())
//! # }
//! ```
//!
//! Each layer is a package of its own and uses only the layers below it:
//!
//! | package | purpose | may depend on |
//! |---|---|---|
//! | [`cli`] | command-line arguments and messages | all below |
//! | [`blocks`], [`compress`], [`launch`], … | tools that make several runs, or use finished runs | `run` and below |
//! | [`run`] | a run: its options, the values chosen for them, and its execution | all below |
//! | [`train`] | the loop, schedule, metrics, checkpoints | all below |
//! | [`render`] | rasterisers, native and on a GPU | `core`, policies, shaders |
//! | [`data`] | datasets and models as files | `core`, policies, scene generator |
//! | [`core`] | cameras, Gaussians, memory ledger, atomic file writing | nothing of this workspace |
//!
//! Features, all on by default: `gpu` (the GPU backend), `selftest` (the float64 renderer and the command that
//! compares backends with it), `study` (`compare`, `trade` and `report`), `view` (a page in the browser).

pub use densify_blocks as blocks;
pub use densify_clean as clean;
pub use densify_cli as cli;
pub use densify_compress as compress;
pub use densify_core as core;
pub use densify_data as data;
pub use densify_inspect as inspect;
pub use densify_launch as launch;
pub use densify_mesh as mesh;
pub use densify_poses as poses;
pub use densify_render as render;
pub use densify_run as run;
#[cfg(feature = "selftest")]
pub use densify_selftest as selftest;
pub use densify_train as train;
