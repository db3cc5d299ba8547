//! A policy of the comparison, with or without parameters.

use densify_policies::policy::SceneInfo;
use densify_policies::registry::find;

use toml::Table;

use densify_run::failure::Failure;
use densify_run::{Assignment, Partial};

/// A policy as given on the command line: `NAME`, or `NAME:PARAMETER=VALUE:…`.
pub(super) struct PolicyVariant<'a> {
    name: &'a str,
    settings: Vec<&'a str>,
}

impl<'a> PolicyVariant<'a> {
    pub(super) fn parse(text: &'a str) -> Self {
        let mut parts = text.split(':');
        Self { name: parts.next().unwrap_or_default(), settings: parts.collect() }
    }

    /// Values of the parameters, by name.
    fn parameters(&self) -> Result<Table, Failure> {
        let mut parameters = Table::new();
        let malformed = |error: String| Failure::input(format!("--policies: {error}"));
        for setting in &self.settings {
            let assignment = format!("{}.{setting}", self.name).parse();
            let Assignment { path, value } = assignment.map_err(malformed)?;
            parameters.insert(path[1..].join("."), value);
        }
        Ok(parameters)
    }

    /// The options of a run with this policy.
    pub(super) fn options(&self) -> Partial {
        let parameters = self.parameters().unwrap_or_default();
        let mut settings = Table::new();
        if !parameters.is_empty() {
            settings.insert(self.name.to_owned(), parameters.into());
        }
        Partial::option("policy_set", settings).over(Partial::option("policy", self.name))
    }

    /// The policy and its parameters as part of a folder's name.
    pub(super) fn folder(&self) -> String {
        let is_plain = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
        [&[self.name], &self.settings[..]].concat().join("-").replace(|c| !is_plain(c), "-")
    }

    /// Checks that the policy exists and accepts its parameters for this budget and number of iterations.
    pub(super) fn check(&self, budget: usize, iterations: u32) -> Result<(), Failure> {
        let entry = find(self.name)?;
        let parameters = self.parameters()?;
        // The other properties of the scene do not restrict parameters.
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
        let plain = PolicyVariant::parse("diet");
        assert_eq!(plain.options().get("policy").and_then(|name| name.as_str()), Some("diet"));
        assert_eq!(plain.folder(), "diet");
        let set = PolicyVariant::parse("diet:rho=0:split=random");
        let expected: Table = toml::toml! { diet = { rho = 0, split = "random" } };
        assert_eq!(set.options().get("policy_set"), Some(&expected.into()));
        assert_eq!(set.folder(), "diet-rho-0-split-random");
    }
}
