//! File access: untrusted files are read defensively, and files are written completely or not at all.

mod atomic;
pub mod disk;
mod error;
mod read;

pub use atomic::{
    RUN_FOLDER_DEPTH, WriteError, is_temporary, remove_incomplete, write_atomically,
    write_atomically_from, write_checked,
};
pub use error::FileError;
pub use read::{
    MAX_OPTIONS_BYTES, folder_of, max_unpacked_bytes, multi_line, one_line, open, read_text,
    wrong_kind,
};
