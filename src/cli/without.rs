//! Replacements for commands whose cargo feature is not built into this program: they only print an error.

use std::ffi::OsString;

use clap::Args;

use super::console::Console;
use densify_run::failure::Failure;

/// The error for an option or command that needs a missing feature.
pub(super) fn without(feature: &str, name: &str) -> String {
    format!(
        "{name}: this program was built without the feature `{feature}` of the crate densify; add it to the \
         features of densify in Cargo.toml"
    )
}

/// Not available: this program was built without the feature that it needs.
#[derive(Debug, Args)]
pub(super) struct Absent {
    /// Ignored
    #[arg(hide = true, trailing_var_arg = true, allow_hyphen_values = true)]
    words: Vec<OsString>,
}

/// Defines the items of a command's module that the parent module uses.
macro_rules! absent {
    ($module:ident, $feature:literal, $($run:ident($args:ident $(, $more:ty)*) $command:literal),*) => {
        #[cfg(not(feature = $feature))]
        pub(super) mod $module {
            $(
                pub(in crate) use super::Absent as $args;

                pub(in crate) fn $run(
                    _: &$args,
                    $(_: $more,)*
                    _: &super::Console,
                ) -> Result<(), super::Failure> {
                    Err(super::Failure::input(super::without($feature, $command)))
                }
            )*
        }
    };
}

absent!(devices, "gpu", run(DevicesArgs) "densify devices");
absent!(report, "study", run(ReportArgs) "densify report");
absent!(selftest, "selftest", run(SelftestArgs) "densify selftest");
absent!(study, "study", compare(Comparison) "densify compare", trade(Trade) "densify trade", run(StudyRun) "densify study-run");
absent!(view, "view", run(ViewArgs, &clap::ArgMatches) "densify view");
