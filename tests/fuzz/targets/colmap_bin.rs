//! See `formats.rs`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    densify_fuzz::colmap_bin(bytes);
});
