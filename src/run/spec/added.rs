//! Files of runs that were saved before a parameter of their policy existed: the parameter gets the value that stands
//! for what the run did without it.

use toml::{Table, Value};

use densify_policies::policy::PixelLossChoice;
use densify_policies::registry::find;

use super::Assignment;

/// A learning rate that development versions which had Huber's function, but not yet a parameter for it, saved in short
/// runs with this function only.
const RATE_WITH_HUBER: &str = "noise_end";

/// Adds the parameters that the policy of a saved run has got since then, and returns them as settings of the policy.
/// Does nothing for policies that are not known here.
pub(crate) fn add_missing_parameters(run: &mut Table) -> Vec<Assignment> {
    let name = run.get("policy").and_then(Value::as_str).unwrap_or_default().to_owned();
    let has_rate = |name: &str| run.get("lr").is_some_and(|rates| rates.get(name).is_some());
    let is_huber = has_rate(RATE_WITH_HUBER);
    let saved = run.get_mut("policy_set").and_then(|policies| policies.get_mut(&name));
    let (Some(saved), Ok(policy)) = (saved.and_then(Value::as_table_mut), find(&name)) else {
        return Vec::new();
    };
    let mut added = Vec::new();
    for &(parameter, value) in policy.added_parameters() {
        if !saved.contains_key(parameter) {
            let is_loss = parameter == PixelLossChoice::BEFORE.0;
            let value = Value::from(if is_loss && is_huber { "huber" } else { value });
            saved.insert(parameter.to_owned(), value.clone());
            added.push(Assignment { path: vec![name.clone(), parameter.to_owned()], value });
        }
    }
    added
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_runs_that_lack_a_parameter_get_what_they_did() {
        let completed = |text: &str| {
            let mut run: Table = text.parse().unwrap();
            let added = add_missing_parameters(&mut run);
            let names: Vec<String> = added.iter().map(|set| set.path.join(".")).collect();
            let policy = run["policy"].as_str().unwrap();
            let set = run.get("policy_set").and_then(|all| all.get(policy)?.get("pixel_loss"));
            (names, set.and_then(Value::as_str).map(str::to_owned))
        };
        let l1 = (vec!["diet.pixel_loss".to_owned()], Some("l1".to_owned()));
        assert_eq!(completed("policy = 'diet'\npolicy_set.diet.rho = 0.25"), l1);
        let rates = "lr.mean_end = 2e-6\n";
        assert_eq!(completed(&format!("policy = 'diet'\n{rates}policy_set.diet.rho = 0.25")), l1);
        let rates = "lr.noise_end = 2e-6\n";
        let huber = (vec!["merit.pixel_loss".to_owned()], Some("huber".to_owned()));
        let merit = format!("policy = 'merit'\n{rates}policy_set.merit.rho = 0.25");
        assert_eq!(completed(&merit), huber);
        // Runs that have it, and policies without it or unknown here.
        let kept = |value: &str| (Vec::new(), Some(value.to_owned()));
        let saved = "policy = 'diet'\npolicy_set.diet.pixel_loss = 'auto'";
        assert_eq!(completed(saved), kept("auto"));
        for policy in ["vanilla", "unknown"] {
            let run = format!("policy = '{policy}'\npolicy_set.{policy}.grow_every = 100");
            assert_eq!(completed(&run), (Vec::new(), None));
        }
    }
}
