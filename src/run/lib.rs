//! A run as data, in three stages: a description as it was asked for (`spec`), the same with everything decided
//! (`resolved`), and the training of it (`session`).
//!
//! The crate knows no subcommand, prints nothing, and changes nothing of its process. Its caller provides a [`Host`];
//! progress goes to an [`Observer`]; errors stay data until they are shown.
//!
//! From below, each module using only those before it: failure, spec, companion, observer, process, host, models,
//! coordinate_check, near_plane, resolved, finished, session.

mod companion;
pub mod coordinate_check;
pub mod failure;
pub mod finished;
mod host;
mod models;
mod near_plane;
mod observer;
mod process;
mod resolved;
mod session;
pub mod spec;

pub use companion::{Companion, CompanionSize};
pub use host::Host;
pub use near_plane::NearPlane;
pub use observer::{Between, Interrupt, Observer, Silent, say_notes};
pub use process::{MemoryLimit, ProcessMemory, grant};
pub use resolved::{
    Alternatives, DEFAULT_BUDGET, DegreeSource, ExposureSource, Findings, ModelSize, Plan,
    RunConfig, estimate, host_bytes, plan,
};
pub use session::{LeftOut, Occupied, Reductions, Requirements, Resumed, Run, start};
pub use spec::{
    AbsolutePath, Assignment, Budget, ByteCount, DataSpec, DeviceSpec, Fraction, ImageCache,
    InitChoice, OPTIONS, OnResume, OutputSpec, Partial, PolicySpec, Rows, RunOption, RunSpec,
    ScheduleSpec, ShDegree, SizeSpec, StartSpec, Threads, Whole, knobs,
};
