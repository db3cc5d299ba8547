//! The largest run that fits a memory limit, and what the system still grants this process.

mod fit;
mod grant;

pub use fit::{Fit, IMAGES, PAIRS, RunSize, SizeRequest, fit, min_memory, most_within};
pub use grant::{MemoryLimit, grant};
