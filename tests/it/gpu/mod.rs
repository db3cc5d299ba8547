//! What only the GPU backend has, on every adapter that there is.

mod ledger;
mod long_lists;
mod photographs;
