//! The fuzz target: reads inputs in the format that the environment variable `FORMAT` names. See `formats.rs`.
#![no_main]

use std::sync::LazyLock;

use densify_fuzz::Target;

static TARGET: LazyLock<Target> = LazyLock::new(|| {
    let name = std::env::var("FORMAT").expect("the variable FORMAT with the name of a corpus");
    Target::named(&name)
});

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    TARGET.accepts(bytes);
});
