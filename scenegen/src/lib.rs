//! Known geometry, ray-traced into posed ground-truth images.
//!
//! This package is the wall that keeps mesh loading and ray tracing away from the trainer and
//! from the policies. It has no public item yet.
