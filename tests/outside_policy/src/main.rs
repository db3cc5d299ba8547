//! densify with a policy from this crate.
use outside_policy as _;
fn main() -> std::process::ExitCode {
    densify::cli::run()
}
