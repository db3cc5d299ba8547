//! The settings of runs: what differs from the defaults, what differs between runs, and everything.

use std::collections::BTreeMap;

use maud::{Markup, html};
use toml::{Table, Value};

use super::groups::scene_name;
use super::runs::Told;
use densify_html::{Column, table};
use densify_run::failure::Failure;
use densify_run::{Partial, RunSpec};

/// Most rows of a table of differences: with more, nothing is compared any more.
const MOST: usize = 60;
/// Options that name places on the machine that trained. Of these only the last part is told.
const PLACES: [&str; 5] = ["scene", "images", "views", "init", "freeze"];

/// All options with their whole names, such as `knob.alpha_min`, and their values as text.
pub(super) fn flat(options: &Table) -> BTreeMap<String, String> {
    fn walk(above: &str, options: &Table, found: &mut BTreeMap<String, String>) {
        for (name, value) in options {
            let name = if above.is_empty() { name.clone() } else { format!("{above}.{name}") };
            match value {
                Value::Table(inner) => walk(&name, inner, found),
                Value::String(text) => _ = found.insert(name, text.clone()),
                value => _ = found.insert(name, value.to_string()),
            }
        }
    }
    let mut found = BTreeMap::new();
    walk("", options, &mut found);
    found
}

/// The options of a run, as they may be told to others.
fn told(spec: &RunSpec) -> Result<Table, Failure> {
    let mut all = Partial::all(spec)?.into_table();
    all.remove("output");
    for name in PLACES {
        if let Some(Value::String(text)) = all.get_mut(name) {
            *text = scene_name(text.as_ref());
        }
    }
    Ok(all)
}

/// What a run was told: what is not the default, and below everything.
pub(super) fn of_run(run: &Told) -> Result<Markup, Failure> {
    let (all, usual) = (told(&run.config.spec)?, told(&RunSpec::default())?);
    let (own, usual) = (flat(&all), flat(&usual));
    // Parameters are complete in the file of a run, and those by default are not told apart there.
    let is_own = |name: &str| {
        all.get(name).is_some_and(|value| !value.is_table()) && own.get(name) != usual.get(name)
    };
    let rows: Vec<Vec<String>> = own
        .iter()
        .filter(|(name, _)| is_own(name) || *name == "policy" || *name == "iterations")
        .map(|(name, value)| vec![name.clone(), value.clone()])
        .collect();
    let whole = toml::to_string(&all).map_err(Failure::input)?;
    Ok(html! {
        div.settings { (table(&[Column::Text("option"), Column::Text("value")], &rows)) }
        details {
            summary { "All options, parameters of the policy included" }
            pre tabindex="0" { code { (whole) } }
        }
    })
}

/// What differs between runs, of the options that all have; nothing for one run, or where nothing differs.
pub(super) fn differing(runs: &[Told]) -> Result<Option<Markup>, Failure> {
    let options = runs.iter().map(|run| Ok(flat(&told(&run.config.spec)?)));
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
    let left_out = rows.len().saturating_sub(MOST);
    rows.truncate(MOST);
    let names = std::iter::once("option").chain(runs.iter().map(|run| &*run.name));
    let columns: Vec<Column<'_>> = names.map(Column::Text).collect();
    Ok(Some(html! {
        div.settings { (table(&columns, &rows)) }
        @if left_out > 0 { p.note { (left_out) " more options differ; they stand below." } }
    }))
}

#[cfg(test)]
mod tests {
    use clap::Args;

    use super::*;
    use densify_run::AbsolutePath;

    /// What takes a file or a folder is a place.
    #[test]
    fn every_place_is_known() {
        let command = RunSpec::augment_args(clap::Command::new("train"));
        let of = |arg: &clap::Arg| arg.get_value_names().unwrap_or_default().to_vec();
        let places = command.get_arguments().filter(|arg| {
            let names = of(arg);
            ["DIR", "FILE", "MODEL", "SCENE"]
                .iter()
                .any(|known| names.iter().any(|name| name.contains(known)))
        });
        let found: Vec<&str> = places.map(|arg| arg.get_id().as_str()).collect();
        assert!(found.len() > PLACES.len(), "{found:?}");
        // That one is an enumeration, and the output's folder is not told at all.
        let others = ["exposure_model", "output"];
        let unknown: Vec<_> =
            found.iter().filter(|name| !PLACES.contains(name) && !others.contains(name)).collect();
        assert!(unknown.is_empty(), "{unknown:?} may hold a path of this machine");
    }

    #[test]
    fn options_have_whole_names_and_places_lose_what_lies_above() {
        let options: Table = "a = 1\nb = 'x'\n[knob]\nalpha_min = '1/64'".parse().unwrap();
        let flat = flat(&options);
        let flat: Vec<(&str, &str)> =
            flat.iter().map(|(name, value)| (&**name, &**value)).collect();
        assert_eq!(flat, [("a", "1"), ("b", "x"), ("knob.alpha_min", "1/64")]);
        let mut spec = RunSpec::default();
        spec.start.scene = Some("/home/somebody/secret/garden".into());
        spec.output.output = Some("/home/somebody/out".into());
        spec.data.images = Some("/mnt/photographs".into());
        spec.data.views = Some(AbsolutePath("/mnt/views.txt".into()));
        spec.start.freeze = Some(AbsolutePath("/mnt/rest.ply".into()));
        let text = toml::to_string(&told(&spec).unwrap()).unwrap();
        assert!(text.contains("scene = \"garden\"") && text.contains("\"photographs\""), "{text}");
        assert!(!text.contains("somebody") && !text.contains("mnt"), "{text}");
    }
}
