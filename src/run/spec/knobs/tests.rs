//! Tests of the table and of the domains of its values.

use std::collections::BTreeSet;

use super::*;
use crate::spec::RunOption;

/// The value of `NAME=VALUE` in the table's spelling.
fn canonical(setting: &str) -> Result<String, KnobError> {
    let (name, value) = setting.split_once('=').unwrap();
    find(name)?.canonical(value)
}

#[test]
fn the_table_is_consistent() {
    let mut names = BTreeSet::new();
    for knob in KNOBS {
        let name = knob.name;
        assert!(names.insert(name), "{name} is listed twice");
        assert!(RunOption::find(name).is_none(), "{name} is an option of its own");
        assert_eq!(knob.canonical(knob.default).as_deref(), Ok(knob.default), "{name}");
        for level in knob.levels {
            assert_eq!(knob.canonical(level).as_deref(), Ok(*level), "{name}");
        }
        assert!((1..=5).contains(&knob.levels.len()), "{name}");
    }
}

#[test]
fn equal_values_have_equal_texts() {
    for (setting, value) in [
        ("alpha_min=1/255", "1/255"),
        ("alpha_min= 0.0078125", "1/128"),
        ("alpha_min=0.005", "5e-3"),
        ("transmittance_stop=0.0001", "1e-4"),
        ("pairs_per_row=2", "2"),
    ] {
        assert_eq!(canonical(setting).unwrap(), value, "{setting}");
    }
}

#[test]
fn values_out_of_range_are_refused_with_the_nearest_that_works() {
    for (setting, words) in [
        ("alpha_min=0.5", ["alpha_min", "0.5", "works is 1/32"]),
        ("alpha_min=0", ["alpha_min", "`0`", "works is 1/1024"]),
        ("alpha_min=-1/0", ["alpha_min", "1/1024 to 1/32", "works is 1/255"]),
        ("alpha_min=NaN", ["alpha_min", "NaN", "works is 1/255"]),
        ("transmittance_stop=1", ["transmittance_stop", "1e-5 to 1e-2", "works is 1e-2"]),
        ("pairs_per_row=4.4", ["pairs_per_row", "auto|4|2|1", "works is 4"]),
        ("moment_storage=bf16", ["moment_storage", "auto|f32|both8", "works is"]),
        ("alpha_mim=1/64", ["alpha_mim", "alpha_min", "densify knobs"]),
    ] {
        let message = canonical(setting).unwrap_err().to_string();
        for word in words {
            assert!(message.contains(word), "{setting}: {word:?} is not in: {message}");
        }
    }
}

#[test]
fn each_level_of_each_knob_does_something() {
    let effect = |knobs: &Knobs| {
        let Knobs { shortcuts, storage, pairs_per_row, accumulation, .. } = knobs;
        format!("{shortcuts:?}{storage:?}{pairs_per_row:?}{accumulation:?}")
    };
    let defaults = Knobs::default();
    assert_eq!(defaults.changed().count(), 0);
    assert_eq!(defaults.shortcuts, densify_render::Shortcuts::default());
    for knob in KNOBS {
        let mut seen = vec![effect(&defaults)];
        for level in knob.levels {
            let table = [(knob.name.to_owned(), (*level).into())].into_iter().collect();
            let changed = Knobs::from_table(&table).unwrap();
            let settings: Vec<_> = changed.changed().map(|(k, v)| (k.name, v)).collect();
            assert_eq!(settings, [(knob.name, *level)]);
            assert!(!seen.contains(&effect(&changed)), "{}={level} does nothing", knob.name);
            seen.push(effect(&changed));
        }
    }
    assert_eq!(find("alpha_min").unwrap().only_on, None);
    assert_eq!(find("accumulation").unwrap().only_on, Some(BackendKind::Gpu));
}

#[test]
fn presets_are_made_of_knobs_and_options() {
    let exact = preset(EXACT).unwrap().levels;
    for preset in PRESETS {
        for (name, value) in preset.levels {
            let knob = find(name).ok();
            assert!(knob.is_some() != RunOption::find(name).is_some(), "{name}");
            if let Some(knob) = knob {
                let is_bounded = knob.class != Class::Exact;
                assert!(
                    !is_bounded || exact.iter().any(|(own, _)| own == name),
                    "{name}: not in exact"
                );
                assert_eq!(knob.canonical(value).as_deref(), Ok(*value), "{}: {name}", preset.name);
            }
        }
        // Every preset but the reference states its cost.
        let shown = preset.to_string();
        assert_eq!(preset.measured.is_none(), preset.name == EXACT, "{shown}");
        assert_eq!(shown.contains(" dB ["), preset.measured.is_some(), "{shown}");
    }
    assert!(preset(DEFAULT_PRESET).is_ok());
    assert!(preset("quick").unwrap_err().to_string().contains("exact, balanced, fast"));
}
