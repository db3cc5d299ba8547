//! What a program says that was built without one of the features `formats`, `gpu`, `scenegen`, `selftest`, `study` and `view`.

/// Why `what` cannot be done.
pub(crate) fn without(feature: &str, what: &str) -> String {
    format!(
        "{what}: this program was built without the feature `{feature}` of the crate densify; add it to the \
         features of densify in Cargo.toml"
    )
}
