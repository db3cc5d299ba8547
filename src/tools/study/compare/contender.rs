//! Who competes: a policy, or a policy with parameters of its own.

use densify_policies::policy::SceneInfo;
use densify_policies::registry::find;

use toml::Table;

use densify_run::failure::Failure;
use densify_run::{Assignment, Partial};

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

    /// Its parameters by name.
    fn parameters(&self) -> Result<Table, Failure> {
        let mut parameters = Table::new();
        for setting in &self.settings {
            let text = format!("{}.{setting}", self.name);
            let set: Result<Assignment, String> = text.parse();
            let Assignment { path, value } =
                set.map_err(|error| Failure::input(format!("--policies: {error}")))?;
            parameters.insert(path[1..].join("."), value);
        }
        Ok(parameters)
    }

    /// Its options of a run.
    pub(super) fn options(&self) -> Partial {
        let own = self.parameters().unwrap_or_default();
        let mut set = Table::new();
        if !own.is_empty() {
            set.insert(self.name.to_owned(), own.into());
        }
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
        let parameters = self.parameters()?;
        // Of a scene parameters only have to fit the length and the budget.
        let scene = SceneInfo {
            extent: 1.0,
            train_views: 1,
            budget,
            initial_rows: 1,
            iterations,
            white_background: false,
        };
        entry.build(&parameters, &scene)?;
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
