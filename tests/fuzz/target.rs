//! Every fuzz target: the binary's name is that of the format it reads. See `formats.rs`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    densify_fuzz::read(env!("CARGO_BIN_NAME"), bytes);
});
