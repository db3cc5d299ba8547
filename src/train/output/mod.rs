//! Writes and reads the folder of a run, whose files are never incomplete.
//!
//! ```text
//! RUN/
//!   config.toml                                  everything needed to reproduce the run
//!   cameras.json                                 all cameras, in the coordinates of the saved model
//!   point_cloud/iteration_N/point_cloud.ply      the model
//!   point_cloud/iteration_N/exposure.json        exposures of the training views
//!   point_cloud/iteration_N/vignette.json        vignettes of the cameras
//!   checkpoints/iteration_N.safetensors          state for continuing the run
//!   stats/train.jsonl  events.jsonl  summary.json  requirements.json
//!   results.json  per_view.json                  test scores in the format of the original trainer
//!   geometry.json                                errors against a known surface
//!   events.out.tfevents.*                        loss, rows and test scores for TensorBoard
//! ```
//!
//! A file appears under its name only when it is complete ([`densify_core::files::write_atomically`]). The two logs and
//! the TensorBoard file grow by complete records.

mod cameras;
mod error;
mod folder;
mod lock;
mod reading;
mod records;
mod tensorboard;

pub use cameras::cameras_json;
pub use error::FolderError;
pub use folder::{CHECKPOINTS, Guard, RunFolder, is_in_use, model_path, saved_iterations};
pub use lock::FolderLock;
pub use reading::{
    all_scores, events_of, geometry_of, psnr_by_view, read_json, scores_by_view, scores_of,
    steps_of, summary_of,
};
pub use records::{RecordLog, StepRecord, Summary, write_geometry, write_json, write_scores};
pub use tensorboard::TensorBoard;

pub use crate::evaluate::Mean;

/// Name of the file in a run's folder that describes the run.
pub const CONFIG_FILE: &str = "config.toml";
