//! The main file of all fuzz targets: the name of the binary is the format that it reads. See
//! `formats.rs`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    densify_fuzz::read(env!("CARGO_BIN_NAME"), bytes);
});
