//! densify with a policy of our own.
use outside_policy as _;
fn main() -> std::process::ExitCode {
    densify::cli::run()
}
