//! Features that only the GPU backend has, tested on every adapter of the machine.

mod ledger;
mod long_lists;
mod photographs;
