//! See `formats.rs`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    densify_fuzz::config(bytes);
});
