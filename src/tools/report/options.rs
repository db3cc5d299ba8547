//! The options of runs: those that differ from the defaults or between runs, and all of them.

use std::collections::BTreeMap;

use maud::{Markup, html};
use toml::{Table, Value};

use super::groups::scene_name;
use super::runs::RunRecord;
use densify_html::{Column, Table as HtmlTable};
use densify_run::failure::Failure;
use densify_run::{Partial, RunSpec};

/// Maximum number of rows of the table of differences; more would not be readable.
const MAX_DIFFERENCES: usize = 60;
/// Options that are paths on the machine that trained the run; only their last component is published.
const PATHS: [&str; 8] =
    ["scene", "images", "sparse", "views", "depth_points", "init", "freeze", "policy_file"];

/// All options with their full names, such as `knob.alpha_min`, and their values as text.
pub(super) fn flatten(options: &Table) -> BTreeMap<String, String> {
    fn walk(parent: &str, options: &Table, flat: &mut BTreeMap<String, String>) {
        for (name, value) in options {
            let name = if parent.is_empty() { name.clone() } else { format!("{parent}.{name}") };
            match value {
                Value::Table(inner) => walk(&name, inner, flat),
                Value::String(text) => _ = flat.insert(name, text.clone()),
                value => _ = flat.insert(name, value.to_string()),
            }
        }
    }
    let mut flat = BTreeMap::new();
    walk("", options, &mut flat);
    flat
}

/// The options of a run without private paths.
fn published(spec: &RunSpec) -> Result<Table, Failure> {
    let mut all = Partial::all(spec)?.into_table();
    all.remove("output");
    for name in PATHS {
        let values = match all.get_mut(name) {
            Some(Value::Array(values)) => values.as_mut_slice(),
            Some(value) => std::slice::from_mut(value),
            None => &mut [],
        };
        for value in values {
            if let Value::String(text) = value {
                *text = scene_name(text.as_ref());
            }
        }
    }
    Ok(all)
}

/// Lists the options of a run that differ from the defaults, and below them all options.
pub(super) fn list(run: &RunRecord) -> Result<Markup, Failure> {
    let (all, defaults) = (published(&run.config.spec)?, published(&RunSpec::default())?);
    let (own, defaults) = (flatten(&all), flatten(&defaults));
    // Entries of TOML tables are left out: they include every parameter of the policy, whether or not it has its
    // default value.
    let is_changed = |name: &str| {
        all.get(name).is_some_and(|value| !value.is_table()) && own.get(name) != defaults.get(name)
    };
    let mut table = HtmlTable::new(["option", "value"].map(Column::text));
    for (name, value) in &own {
        if is_changed(name) || name == "policy" || name == "iterations" {
            table.row([name.clone(), value.clone()]);
        }
    }
    let whole = toml::to_string(&all).map_err(Failure::input)?;
    Ok(html! {
        div.settings { (table.to_html()) }
        details {
            summary { "All options, parameters of the policy included" }
            pre tabindex="0" { code { (whole) } }
        }
    })
}

/// Lists the options that all runs have and that differ between them; `None` if there are none.
pub(super) fn list_differences(runs: &[RunRecord]) -> Result<Option<Markup>, Failure> {
    let options = runs.iter().map(|run| Ok(flatten(&published(&run.config.spec)?)));
    let options: Vec<BTreeMap<String, String>> = options.collect::<Result<_, Failure>>()?;
    let names = options.first().into_iter().flat_map(|first| first.keys());
    let differs = |name: &&String| {
        let values: Option<Vec<&String>> = options.iter().map(|all| all.get(*name)).collect();
        values.is_some_and(|values| values.iter().any(|value| *value != values[0]))
    };
    let row = |name: &String| {
        let values = options.iter().map(|all| all[name].clone());
        std::iter::once(name.clone()).chain(values).collect()
    };
    let mut rows: Vec<Vec<String>> = names.filter(differs).map(row).collect();
    if rows.is_empty() {
        return Ok(None);
    }
    let left_out = rows.len().saturating_sub(MAX_DIFFERENCES);
    rows.truncate(MAX_DIFFERENCES);
    let names = std::iter::once("option").chain(runs.iter().map(|run| &*run.name));
    let mut table = HtmlTable::new(names.map(Column::text));
    rows.into_iter().for_each(|row| table.row(row));
    Ok(Some(html! {
        div.settings { (table.to_html()) }
        @if left_out > 0 { p.note { (left_out) " more options differ; they are listed below." } }
    }))
}

#[cfg(test)]
mod tests {
    use clap::Args;

    use super::*;
    use densify_run::{AbsolutePath, PolicyFile};

    /// An option is a path if its value is called a file, folder, model or scene in `--help`.
    #[test]
    fn every_path_option_is_known() {
        let command = RunSpec::augment_args(clap::Command::new("train"));
        let value_names = |arg: &clap::Arg| arg.get_value_names().unwrap_or_default().to_vec();
        let paths = command.get_arguments().filter(|arg| {
            let names = value_names(arg);
            ["DIR", "FILE", "MODEL", "SCENE"]
                .iter()
                .any(|known| names.iter().any(|name| name.contains(known)))
        });
        let paths: Vec<&str> = paths.map(|arg| arg.get_id().as_str()).collect();
        assert!(paths.len() > PATHS.len(), "{paths:?}");
        // `exposure_model` is an enumeration, and the output folder is not published at all.
        let others = ["exposure_model", "output"];
        let unknown: Vec<_> =
            paths.iter().filter(|name| !PATHS.contains(name) && !others.contains(name)).collect();
        assert!(unknown.is_empty(), "{unknown:?} may hold a path of this machine");
    }

    #[test]
    fn options_have_full_names_and_paths_lose_their_folders() {
        let options: Table = "a = 1\nb = 'x'\n[knob]\nalpha_min = '1/64'".parse().unwrap();
        let flat = flatten(&options);
        let flat: Vec<(&str, &str)> =
            flat.iter().map(|(name, value)| (&**name, &**value)).collect();
        assert_eq!(flat, [("a", "1"), ("b", "x"), ("knob.alpha_min", "1/64")]);
        let mut spec = RunSpec::default();
        spec.start.scene = Some("/home/somebody/secret/garden".into());
        spec.output.output = Some("/home/somebody/out".into());
        spec.data.images = Some("/mnt/photographs".into());
        spec.data.views = Some(AbsolutePath("/mnt/views.txt".into()));
        spec.start.freeze = Some(AbsolutePath("/mnt/rest.ply".into()));
        spec.density.policy_file = vec![PolicyFile("/home/somebody/steady.py".into())];
        let text = toml::to_string(&published(&spec).unwrap()).unwrap();
        for name in ["scene = \"garden\"", "\"photographs\"", "\"steady.py\""] {
            assert!(text.contains(name), "{text}");
        }
        assert!(!text.contains("somebody") && !text.contains("mnt"), "{text}");
    }
}
