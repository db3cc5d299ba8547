//! The native backend: rayon over tiles and rows, SIMD with run-time dispatch.
