//! A run in three stages: its description as the user gave it (`spec`), the description with every choice made
//! (`resolved`), and its training (`session`).
//!
//! The crate knows no subcommand, prints nothing, and changes nothing that the whole process shares, such as signal
//! handlers. Its caller provides a [`Host`]; progress goes to an [`Observer`]; errors stay data until they are shown.
//!
//! Modules from bottom to top, each of which uses only those before it: failure, spec, companion, observer, process,
//! host, models, coordinate_check, near_plane, position_rates, resolved, finished, session,
//! refining.

mod companion;
pub mod coordinate_check;
pub mod failure;
pub mod finished;
mod host;
mod models;
mod near_plane;
mod observer;
mod position_rates;
mod process;
pub mod refining;
mod resolved;
mod session;
pub mod spec;

pub use companion::{Companion, CompanionSize};
pub use host::Host;
pub use near_plane::NearPlane;
pub use observer::{Interrupt, NextAction, Observer, Silent, check_interrupt, say_notes};
pub use process::{MemoryLimit, ProcessMemory, grant};
pub use resolved::{
    Alternatives, DEFAULT_BUDGET, DegreeSource, DegreeTrial, ExposureSource, Extent, Findings,
    ModelSize, Plan, PoseSource, RunConfig, VignetteSource, estimate, extent, plan,
};
pub use session::{LeftOut, Occupied, Reductions, Requirements, Resumed, Run, start};
pub use spec::{
    AbsolutePath, Assignment, Budget, ByteCount, DataSpec, DepthSpec, DeviceSpec, Fraction,
    ImageCache, InitChoice, OPTIONS, OnResume, OutputSpec, Partial, PolicyFile, PolicySpec, Rows,
    RunOption, RunSpec, ScheduleSpec, ShDegree, SizeSpec, StartSpec, Threads, Weight, Whole, knobs,
};
