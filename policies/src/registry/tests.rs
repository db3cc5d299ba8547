//! Tests of the names, manuals and parameters of registered policies.

use serde::Deserialize;

use super::*;
use crate::parameters::StepParameter::Step;
use crate::parameters::in_range;
use crate::plan::EditPlan;
use crate::policy::{Needs, Snapshot};
use crate::rng::PolicyRng;

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Params {
    threshold: f64,
    every: u32,
    from: u32,
    mode: Mode,
    seldom: Option<u32>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Mode {
    First,
    SecondOne,
}

impl Default for Params {
    fn default() -> Self {
        Self { threshold: 0.1, every: 100, from: 500, mode: Mode::First, seldom: None }
    }
}

struct Idle(Params);

impl DensityPolicy for Idle {
    fn needs(&self, _scene: &SceneInfo) -> Needs {
        Needs::default()
    }
    fn is_due(&self, step: u32) -> bool {
        step.is_multiple_of(self.0.every)
    }
    fn plan(&mut self, _: &Snapshot<'_>, _: &PolicyRng, _: &mut EditPlan) -> PolicyResult {
        Ok(())
    }
}

impl ConfiguredPolicy for Idle {
    type Params = Params;
    const STEP_PARAMETERS: &'static [StepParameter] = &[Step("every"), Step("from")];
    fn new(params: Params, _scene: &SceneInfo) -> PolicyResult<Self> {
        in_range("threshold", params.threshold, 0.0..=1.0)?;
        Ok(Self(params))
    }
}

fn idle(name: &'static str, line: u32) -> PolicyEntry {
    PolicyEntry::new::<Idle>(
        name,
        "does nothing",
        "nowhere",
        "//! # Idle\n//!\n//! Text.\nuse x;\n//! no",
        ("idle.rs", line),
    )
}

fn scene(iterations: u32) -> SceneInfo {
    SceneInfo {
        extent: 1.0,
        train_views: 10,
        budget: 100,
        initial_rows: 10,
        iterations,
        white_background: false,
    }
}

fn set(text: &str) -> Table {
    text.parse().unwrap()
}

#[test]
fn names_are_sorted_and_unique() {
    let (a, b, c) = (idle("a", 2), idle("b", 1), idle("c", 3));
    let names: Vec<_> = sorted(vec![&b, &a, &c]).unwrap().iter().map(|e| e.name).collect();
    assert_eq!(names, ["a", "b", "c"]);
    let twin = idle("c", 1);
    let error = sorted(vec![&a, &c, &b, &twin]).unwrap_err().to_string();
    assert!(error.contains("`c`"), "{error}");
    assert!(error.contains("idle.rs:1 and idle.rs:3"), "{error}");
}

#[test]
fn policies_are_found_by_name() {
    let diet = find("diet").unwrap();
    assert!(diet.location().contains("diet/mod.rs:"), "{}", diet.location());
    let error = find("vanila").unwrap_err().to_string();
    assert!(error.contains("did you mean `vanilla`?"), "{error}");
    let error = find("quux").unwrap_err();
    assert_eq!(error, PolicyError::UnknownPolicy { name: "quux".into(), nearest: None });
}

#[test]
fn the_manual_is_the_leading_doc_comment() {
    assert_eq!(idle("idle", 1).manual(), "# Idle\n\nText.\n");
    let plain = PolicyEntry { doc: "Only text.", ..idle("idle", 1) };
    assert_eq!(plain.manual(), "Only text.\n");
}

#[test]
fn parameters_are_listed_as_declared() {
    let listed = idle("idle", 1).parameters();
    let names: Vec<&str> = listed.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, ["threshold", "every", "from", "mode"]);
    assert_eq!(listed[3].1.as_str(), Some("first"));
}

#[test]
fn defaults_scale_with_the_run_and_settings_do_not() {
    let idle = idle("idle", 1);
    let effective = idle.effective(&set("every = 100\nthreshold = 1"), &scene(3_000)).unwrap();
    assert_eq!(effective["every"].as_integer(), Some(100));
    assert_eq!(effective["from"].as_integer(), Some(50));
    assert_eq!(effective["threshold"].as_float(), Some(1.0));
    assert!(!effective.contains_key("seldom"));
    let policy = idle.build(&Table::new(), &scene(3_000)).unwrap();
    assert!(policy.is_due(20) && !policy.is_due(25));
    let with_option = idle.effective(&set("seldom = 7"), &scene(3_000)).unwrap();
    assert_eq!(with_option["seldom"].as_integer(), Some(7));
}

#[test]
fn bad_parameters_are_named() {
    let build = |text| match idle("idle", 1).build(&set(text), &scene(30_000)) {
        Ok(_) => panic!("`{text}` was accepted"),
        Err(error) => error.to_string(),
    };
    let message = build("treshold = 1");
    assert!(message.contains("no parameter `treshold`"), "{message}");
    assert!(message.contains("did you mean `threshold`?"), "{message}");
    let message = build("threshold = 2");
    assert!(message.contains("`idle.threshold`: 2 is out of range"), "{message}");
    let message = build("every = \"often\"");
    assert!(message.contains("`idle.every`: \"often\" does not fit"), "{message}");
    let message = build("every = -1");
    assert!(message.contains("`idle.every`: -1 does not fit"), "{message}");
    let message = build("mode = \"third\"");
    assert!(message.contains("second-one"), "{message}");
    let message = build("threshold = nan");
    assert!(message.contains("NaN is out of range"), "{message}");
}
