//! `densify` trains 3D Gaussian Splatting scenes under a hard memory budget.
//!
//! What decides where Gaussians are born and die is a plugin, a *policy* (see
//! [`densify_policies`]). This crate is everything around it: data, renderer, trainer and the
//! command line. The same numbers that `densify train` prints are to be had from code:
//!
//! ```no_run
//! use densify::backend::cpu::{CpuBackend, CpuOptions};
//! use densify::dataset::{Dataset, LoadOptions};
//! use densify::init::initialise;
//! use densify::schedule::{Background, RateOptions};
//! use densify::trainer::{OnNan, Savings, TrainOptions, Trainer};
//! use densify::views::DatasetViews;
//! use densify_policies::policy::SceneInfo;
//! use densify_policies::registry::find;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let (budget, iterations, seed, sh_degree) = (50_000, 3_000, 0, 3);
//! let dataset = Dataset::load("data/garden".as_ref(), &LoadOptions::default())?;
//! let (model, _) = initialise(&dataset.points, budget, sh_degree, seed)?;
//! let scene = SceneInfo {
//!     extent: dataset.extent() as f32,
//!     train_views: dataset.train.len() as u32,
//!     budget,
//!     initial_rows: model.len(),
//!     iterations,
//!     white_background: false,
//! };
//! let policy = find("diet")?.build(&toml::toml! { rho = 0.2 }, &scene)?;
//! let mut options = CpuOptions::new(budget);
//! options.needs = policy.needs(&scene);
//! let backend = CpuBackend::new(&model, &options)?;
//! let views = DatasetViews::new(dataset.train, 1 << 30, 2);
//! let options = TrainOptions {
//!     iterations,
//!     seed,
//!     sh_degree,
//!     background: Background::Black,
//!     rates: RateOptions::default(),
//!     sh_every: None,
//!     prefetch: 4,
//!     on_nan: OnNan::Prune,
//!     savings: Savings::NONE,
//! };
//! let mut trainer = Trainer::new(views, Box::new(backend), ("diet", policy), scene, options)?;
//! for _ in 0..iterations {
//!     let report = trainer.step()?;
//!     for event in report.events {
//!         println!("step {}: {} rows, {} denied", event.step, event.after, event.denied);
//!     }
//! }
//! let model = dataset.normalisation.model_to_world(trainer.model()?);
//! densify::export::PLY.write(&model, &mut std::fs::File::create("garden.ply")?)?;
//! # Ok(())
//! # }
//! ```

pub mod backend;
pub mod camera;
pub mod checkpoint;
pub mod cli;
pub mod dataset;
pub mod evaluate;
pub mod export;
pub mod gaussians;
pub mod import;
pub mod init;
pub mod knobs;
pub mod memory;
pub mod metrics;
pub mod output;
pub mod schedule;
pub mod sh;
pub mod spread;
pub mod trainer;
pub mod verify;
pub mod views;
