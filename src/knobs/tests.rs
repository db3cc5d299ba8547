//! Tests of the table and of what its values may be.

use std::collections::BTreeSet;

use super::*;

#[test]
fn the_table_agrees_with_itself() {
    let mut names = BTreeSet::new();
    for knob in KNOBS {
        let name = knob.name;
        assert!(names.insert(name), "{name} is there twice");
        assert!(name.chars().all(|c| c.is_ascii_lowercase() || c == '_'), "{name}");
        assert!(!knob.what.is_empty() && !knob.what.ends_with('.'), "{name}");
        if knob.default.starts_with('[') {
            assert!(knob.how != How::Knob, "{name} is set by nothing else, so it needs a default");
        } else {
            assert_eq!(knob.canonical(knob.default).as_deref(), Ok(knob.default), "{name}");
        }
        if let Levels::Values(values) = knob.levels {
            for level in values {
                assert_eq!(knob.canonical(level).as_deref(), Ok(*level), "{name}");
            }
            assert!(values.iter().any(|level| *level != knob.default), "{name} has one level");
        }
    }
}

#[test]
fn equal_values_are_equal_texts() {
    for (setting, name, value) in [
        ("alpha_min=1/255", "alpha_min", "1/255"),
        (" alpha_min = 0.0078125", "alpha_min", "1/128"),
        ("alpha_min=0.005", "alpha_min", "5e-3"),
        ("transmittance_stop=0.0001", "transmittance_stop", "1e-4"),
        ("moment_storage=both8", "moment_storage", "both8"),
        ("budget=2e5", "budget", "200000"),
    ] {
        let (knob, found) = parse(setting).unwrap();
        assert_eq!((knob.name, &*found), (name, value), "{setting}");
        assert_eq!(knob.canonical(&found).as_deref(), Ok(value), "{setting}");
    }
}

#[test]
fn what_is_outside_is_refused_with_the_nearest_that_works() {
    for (setting, words) in [
        ("alpha_min=0.5", ["alpha_min", "0.5", "works is 1/32"]),
        ("alpha_min=0", ["alpha_min", "`0`", "works is 1/1024"]),
        ("alpha_min=-1/0", ["alpha_min", "1/1024 to 1/32", "works is 1/255"]),
        ("alpha_min=NaN", ["alpha_min", "NaN", "works is 1/255"]),
        ("transmittance_stop=1", ["transmittance_stop", "1e-5 to 1e-2", "works is 1e-2"]),
        ("ssim_every=4", ["ssim_every", "1|2|5|10", "works is 5"]),
        ("ssim_every=nine", ["ssim_every", "nine", "works is"]),
        ("sh_degree=4", ["sh_degree", "0 to 3", "works is 3"]),
        ("sh_degree=1.5", ["sh_degree", "1.5", "works is 2"]),
        ("sh_degree=", ["sh_degree", "``", "works is 0"]),
        ("budget=0", ["budget", "1 or more", "works is 1"]),
        ("alpha_mim=1/64", ["alpha_mim", "alpha_min", "densify knobs"]),
        ("alpha_min", ["alpha_min", "NAME=VALUE", "1/128"]),
    ] {
        let message = parse(setting).unwrap_err().to_string();
        for word in words {
            assert!(message.contains(word), "{setting}: {word:?} is not in: {message}");
        }
    }
}

#[test]
fn settings_hold_every_knob_of_their_own_and_what_follows_from_it() {
    let settings = Settings::default();
    assert_eq!(settings.shortcuts(), crate::backend::Shortcuts::default());
    assert_eq!(settings.savings(), crate::trainer::Savings::NONE);
    assert_eq!(settings.storage(), crate::backend::Storage::default());
    assert_eq!(settings.pairs_per_row(), None);
    let effect = |settings: &Settings| {
        let (shortcuts, savings) = (settings.shortcuts(), settings.savings());
        let (storage, pairs) = (settings.storage(), settings.pairs_per_row());
        format!("{shortcuts:?}{savings:?}{storage:?}{pairs:?}{:?}", settings.accumulation())
    };
    assert_eq!(settings.changed().count(), 0);
    let own: Vec<_> = KNOBS.iter().filter(|knob| knob.how == How::Knob).collect();
    assert_eq!(settings.iter().count(), own.len());
    // Each level of each knob does something.
    for knob in own {
        let Levels::Values(values) = knob.levels else { panic!("{}: values", knob.name) };
        let mut seen = vec![effect(&settings)];
        for level in values.iter().filter(|level| !knob.is_default(level)) {
            let changed = Settings::of(&[format!("{}={level}", knob.name)]).unwrap();
            let found: Vec<_> = changed.changed().map(|(k, v)| (k.name, v)).collect();
            assert_eq!(found, [(knob.name, *level)]);
            assert!(!seen.contains(&effect(&changed)), "{}={level} does nothing", knob.name);
            assert_eq!(changed.check_backend(true).is_err(), knob.on == On::Native);
            assert_eq!(changed.check_backend(false).is_err(), knob.on == On::Gpu);
            seen.push(effect(&changed));
        }
    }
    let elsewhere = Settings::of(&["sh_degree=1".into(), "budget=9".into()]).unwrap();
    assert_eq!(elsewhere, settings);
}

#[test]
fn a_run_of_an_older_version_has_the_knobs_that_it_had() {
    use crate::backend::gpu::Accumulation;
    let older: Settings = toml::from_str("alpha_min = \"1/64\"").unwrap();
    let native = Settings::of(&["alpha_min=1/64".into()]).unwrap();
    assert_eq!(older.completed(false), native);
    assert_eq!(older.completed(true).accumulation(), Some(Accumulation::Slots));
    let mut newer = native.clone();
    newer.take_accumulation(Accumulation::SubgroupCas);
    assert_eq!(newer.completed(true), newer);
}

#[test]
fn presets_are_made_of_knobs() {
    let names: Vec<&str> = PRESETS.iter().map(|preset| preset.name).collect();
    let knob = find("preset").unwrap();
    assert!(knob.domain == Domain::Choice(&["exact", "balanced", "fast", "tiny-memory"]));
    assert_eq!(names, ["exact", "balanced", "fast", "tiny-memory"]);
    assert_eq!(knob.default, DEFAULT_PRESET);
    let exact = preset(EXACT).unwrap().levels;
    for preset in PRESETS {
        for (name, value) in preset.levels {
            let knob = find(name).unwrap();
            // Those that trade nothing for accuracy, or are the policy's, are no matter of `exact`.
            let trades = knob.how == How::Knob && knob.class != Class::Exact;
            assert!(!trades || exact.iter().any(|(own, _)| own == name), "{name}: not in exact");
            assert_eq!(knob.canonical(value).as_deref(), Ok(*value), "{}: {name}", preset.name);
        }
        // It says what it costs; the one that is the measure has nothing to say.
        let said = preset.to_string();
        assert_eq!(preset.measured.is_none(), preset.name == EXACT, "{said}");
        assert_eq!(said.contains(" dB ["), preset.measured.is_some(), "{said}");
    }
    assert!(preset("quick").unwrap_err().to_string().contains("exact, balanced, fast"));
}
