//! Who competes: a policy, or a policy with parameters of its own.

use densify_policies::parameters::parse_overrides;
use densify_policies::policy::SceneInfo;
use densify_policies::registry::find;

use toml::Table;

use crate::failure::Failure;
use crate::run::Partial;

/// A policy as it is named on the command line: `NAME`, or `NAME:PARAMETER=VALUE`, with as many
/// parameters as wanted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Contender<'a> {
    name: &'a str,
    settings: Vec<&'a str>,
}

impl<'a> Contender<'a> {
    pub(super) fn new(text: &'a str) -> Self {
        let mut parts = text.split(':');
        Self { name: parts.next().unwrap_or_default(), settings: parts.collect() }
    }

    /// Values of `--policy-set`.
    fn overrides(&self) -> Vec<String> {
        self.settings.iter().map(|setting| format!("{}.{setting}", self.name)).collect()
    }

    /// Its options of a run.
    pub(super) fn options(&self) -> Partial {
        let tables = parse_overrides(&self.overrides()).unwrap_or_default();
        let set: Table = tables.into_iter().map(|(name, set)| (name, set.into())).collect();
        Partial::option("policy_set", set).over(Partial::option("policy", self.name))
    }

    /// A name for folders.
    pub(super) fn folder(&self) -> String {
        let plain = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
        let parts = std::iter::once(&self.name).chain(&self.settings);
        let parts: Vec<String> = parts.map(|part| part.replace(|c| !plain(c), "-")).collect();
        parts.join("-")
    }

    /// Checks that there is such a policy, and that it takes these parameters in a run of so many
    /// iterations.
    pub(super) fn check(&self, budget: usize, iterations: u32) -> Result<(), Failure> {
        let entry = find(self.name)?;
        let tables = parse_overrides(&self.overrides())
            .map_err(|error| Failure::input(format!("--policies: {error}")))?;
        // Of a scene parameters only have to fit the length and the budget.
        let scene = SceneInfo {
            extent: 1.0,
            train_views: 1,
            budget,
            initial_rows: 1,
            iterations,
            white_background: false,
        };
        entry.build(&tables.get(self.name).cloned().unwrap_or_default(), &scene)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameters_follow_the_name() {
        let plain = Contender::new("diet");
        assert_eq!(plain.options().get("policy").and_then(|name| name.as_str()), Some("diet"));
        assert_eq!(plain.folder(), "diet");
        let set = Contender::new("diet:rho=0:split=random");
        let expected: Table = toml::toml! { diet = { rho = 0, split = "random" } };
        assert_eq!(set.options().get("policy_set"), Some(&expected.into()));
        assert_eq!(set.folder(), "diet-rho-0-split-random");
    }
}
