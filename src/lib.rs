//! `densify` trains 3D Gaussian Splatting scenes under a hard memory budget.
//!
//! What decides where Gaussians are born and die is a plugin, a *policy* (see
//! [`densify_policies`]). This crate is everything around it: data, renderer, trainer and the
//! command line. All that `densify train` does can be done from code:
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
//! println!("{}", run.ledger());
//! // Step by step, with the model at hand ...
//! for event in run.trainer().step()?.events {
//!     println!("step {}: {} Gaussians, {} denied", event.step, event.after, event.denied);
//! }
//! // ... or to the end, with everything that `densify train` writes.
//! println!("the run is in {}", run.train(Occupied::Refuse, &Silent)?.display());
//! # Ok(())
//! # }
//! ```
//!
//! Features, all on by default: `formats` (models in other formats than PLY), `gpu` (the GPU backend),
//! `scenegen` (built-in scenes and known surfaces), `selftest` (the float64 renderer and the command
//! that compares with it), `study` (`compare`, `trade` and `report`), `view` (a page in the browser).

mod animation;
pub mod backend;
#[cfg(any(feature = "formats", feature = "study"))]
mod base64;
pub mod blocks;
pub mod camera;
pub mod checkpoint;
pub mod cli;
pub mod compress;
pub mod dataset;
pub mod engine;
pub mod evaluate;
pub mod export;
pub mod exposure;
pub mod failure;
pub mod flight;
mod foreign;
pub mod gaussians;
#[cfg(feature = "study")]
mod html;
pub mod import;
pub mod importance;
pub mod init;
pub mod knobs;
mod likeness;
pub mod memory;
pub mod metrics;
mod number;
pub mod output;
mod pictures;
#[cfg(feature = "study")]
mod report;
pub mod run;
pub mod schedule;
pub mod sh;
pub mod spread;
#[cfg(feature = "study")]
pub(crate) mod study;
pub mod trainer;
#[cfg(feature = "selftest")]
pub mod verify;
#[cfg(feature = "view")]
pub(crate) mod view;
pub mod views;
mod without;
