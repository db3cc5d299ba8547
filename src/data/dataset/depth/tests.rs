//! Tests of depth in datasets.
