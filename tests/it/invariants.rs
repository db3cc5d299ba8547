//! The walls of the house as tests: what must not depend on what, and what must not be said
//! where. The compiler keeps most of them; these keep the rest, and keep the compiler's.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::source_text::{Strings, code};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// A source file: its path from the root with `/`, and its text.
struct Source {
    path: String,
    text: String,
}

/// All Rust and WGSL files of the workspace.
fn sources() -> Vec<Source> {
    fn walk(folder: &Path, found: &mut Vec<PathBuf>) {
        let entries = std::fs::read_dir(folder);
        let entries = entries.unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
        for path in entries.map(|entry| entry.expect("a folder's entry").path()) {
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            if path.is_dir() {
                if !name.starts_with('.') && !matches!(&*name, "target" | "out") {
                    walk(&path, found);
                }
            } else if name.ends_with(".rs") || name.ends_with(".wgsl") {
                found.push(path);
            }
        }
    }
    let mut found = Vec::new();
    walk(root(), &mut found);
    found.sort();
    let sources: Vec<Source> = found
        .into_iter()
        .map(|path| {
            let inside = path.strip_prefix(root()).expect("found under the root");
            Source { path: inside.to_string_lossy().replace('\\', "/"), text: read(&path) }
        })
        .collect();
    assert!(sources.len() > 10, "only {} source files found", sources.len());
    sources
}

/// Checks each source that `applies`, and fails with all complaints at once.
fn check(applies: impl Fn(&str) -> bool, complaint: impl Fn(&str) -> Option<String>) {
    let sources: Vec<Source> = sources().into_iter().filter(|s| applies(&s.path)).collect();
    assert!(!sources.is_empty(), "no file is checked");
    let complaints: Vec<String> = sources
        .iter()
        .filter_map(|s| complaint(&s.text).map(|c| format!("{}: {c}", s.path)))
        .collect();
    assert!(complaints.is_empty(), "{}", complaints.join("\n"));
}

/// The words of a text: runs of letters, digits and underscores.
fn words(text: &str) -> impl Iterator<Item = &str> {
    text.split(|c: char| !c.is_alphanumeric() && c != '_').filter(|w| !w.is_empty())
}

/// Files of the program.
fn is_production(path: &str) -> bool {
    ["src/", "policies/src/", "scenegen/src/"].iter().any(|p| path.starts_with(p))
        && path.ends_with(".rs")
        && !path.ends_with("/tests.rs")
        && !path.contains("/tests/")
}

// --- What depends on what ---------------------------------------------------------------------

/// Everything that `package` needs, directly or not, as the lock file has it.
fn dependencies(lock: &str, package: &str) -> BTreeSet<String> {
    let lock: toml::Table = lock.parse().expect("Cargo.lock is TOML");
    let mut direct: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for entry in lock["package"].as_array().expect("Cargo.lock lists packages") {
        let name = entry["name"].as_str().expect("a package has a name").to_owned();
        let needs = entry.get("dependencies").and_then(toml::Value::as_array);
        let needs = needs.into_iter().flatten().filter_map(toml::Value::as_str);
        // "name", or "name version" where there are several.
        let needs = needs.filter_map(|n| n.split(' ').next()).map(str::to_owned);
        direct.entry(name).or_default().extend(needs);
    }
    assert!(direct.contains_key(package), "Cargo.lock has no package {package}");
    let (mut found, mut open) = (BTreeSet::new(), vec![package.to_owned()]);
    while let Some(name) = open.pop() {
        for need in direct.get(&name).into_iter().flatten() {
            if found.insert(need.clone()) {
                open.push(need.clone());
            }
        }
    }
    found
}

#[test]
fn policies_depend_on_no_device_no_image_and_not_on_the_root() {
    let found = dependencies(&read(&root().join("Cargo.lock")), "densify-policies");
    assert!(found.contains("serde"), "the lock file was not understood");
    for forbidden in ["wgpu", "image", "rayon", "densify", "densify-scenegen"] {
        assert!(!found.contains(forbidden), "densify-policies depends on {forbidden}");
    }
}

#[test]
fn scenegen_depends_on_neither_of_the_others() {
    let found = dependencies(&read(&root().join("Cargo.lock")), "densify-scenegen");
    for forbidden in ["densify", "densify-policies", "wgpu"] {
        assert!(!found.contains(forbidden), "densify-scenegen depends on {forbidden}");
    }
}

#[test]
fn dependencies_are_followed_through_others() {
    let lock = r#"
        [[package]]
        name = "a"
        dependencies = ["b 1.0.0", "c"]
        [[package]]
        name = "b"
        dependencies = ["d"]
        [[package]]
        name = "c"
        [[package]]
        name = "d"
        dependencies = ["a"]
    "#;
    let found: Vec<String> = dependencies(lock, "b").into_iter().collect();
    assert_eq!(found, ["a", "b", "c", "d"]);
    assert!(dependencies(lock, "c").is_empty());
}

#[test]
fn unsafe_code_is_forbidden_everywhere() {
    let workspace: toml::Table = read(&root().join("Cargo.toml")).parse().unwrap();
    assert_eq!(workspace["workspace"]["lints"]["rust"]["unsafe_code"].as_str(), Some("forbid"));
    let members = workspace["workspace"]["members"].as_array().unwrap();
    let members = members.iter().map(|m| m.as_str().unwrap()).chain(["."]);
    for member in members {
        let manifest: toml::Table = read(&root().join(member).join("Cargo.toml")).parse().unwrap();
        let inherited = manifest.get("lints").and_then(|l| l.get("workspace"));
        assert_eq!(
            inherited.and_then(toml::Value::as_bool),
            Some(true),
            "{member}/Cargo.toml does not take the workspace's lints"
        );
    }
}

// --- What is said where -----------------------------------------------------------------------

fn prints(text: &str) -> Option<String> {
    let code = code(text, Strings::Drop);
    ["println!", "eprintln!", "print!", "eprint!", "dbg!"]
        .into_iter()
        .find(|call| code.contains(call))
        .map(|call| format!("calls {call}; only src/cli prints"))
}

#[test]
fn only_the_command_line_prints() {
    check(|path| is_production(path) && !path.starts_with("src/cli/"), prints);
}

#[test]
fn only_the_gpu_backend_names_wgpu() {
    check(
        |path| is_production(path) && !path.starts_with("src/backend/gpu"),
        |text| {
            let code = code(text, Strings::Drop);
            words(&code).any(|w| w == "wgpu").then(|| "names wgpu".into())
        },
    );
}

#[test]
fn every_shader_has_a_native_file_of_the_same_name() {
    let names = |folder: &str, ending: &str| -> BTreeSet<String> {
        let sources = sources().into_iter().map(|s| s.path);
        let of = |path: String| {
            let name = path.strip_prefix(folder)?.strip_suffix(ending)?;
            Some(name.trim_end_matches("/mod").to_owned())
        };
        sources.filter_map(of).collect()
    };
    let mut shaders = names("shaders/", ".wgsl");
    // Texts that stages share.
    shaders.retain(|name| !name.starts_with("shared/"));
    // A stage in two ways has one native file.
    for two in ["rasterize_bwd", "observe"] {
        assert!(shaders.contains(two) && shaders.remove(&format!("{two}_atomic")), "{two}");
    }
    assert!(shaders.len() >= 9, "{shaders:?}");
    let native = names("src/backend/cpu/", ".rs");
    assert!(shaders.is_subset(&native), "no native twin: {:?}", shaders.difference(&native));
}

/// Names under which policies are registered, and those the design promises.
fn policy_names() -> BTreeSet<String> {
    let mut names: BTreeSet<String> =
        ["vanilla", "taming", "diet", "mcmc", "igs"].map(str::to_owned).into();
    for source in sources().iter().filter(|s| s.path.starts_with("policies/src/")) {
        let code = code(&source.text, Strings::Keep);
        for call in code.split("register_policy!").skip(1) {
            let name = call.trim_start().strip_prefix('(').map(str::trim_start);
            let name = name.and_then(|n| n.strip_prefix('"')).and_then(|n| n.split('"').next());
            names.extend(name.map(str::to_owned));
        }
    }
    names
}

fn names_a_policy(text: &str, names: &BTreeSet<String>) -> Option<String> {
    let code = code(text, Strings::Keep).to_lowercase();
    words(&code).find(|w| names.contains(*w)).map(|w| format!("names the policy {w}"))
}

#[test]
fn the_trainer_names_no_policy() {
    let names = policy_names();
    check(
        |path| path == "src/trainer.rs" || path.starts_with("src/trainer/"),
        |text| names_a_policy(text, &names),
    );
}

#[test]
fn no_policy_names_a_backend() {
    check(
        |path| path.starts_with("policies/src/"),
        |text| {
            let code = code(text, Strings::Keep);
            let named = words(&code).find(|w| {
                let w = w.to_lowercase();
                w.contains("backend") || w == "cpu" || w.contains("gpu")
            });
            named.map(|w| format!("names a backend: {w}"))
        },
    );
}

// --- How files look ---------------------------------------------------------------------------

/// The comment that opens a file: leading lines that start with `//`, and blank ones.
fn head(text: &str) -> Vec<&str> {
    text.lines().take_while(|l| l.is_empty() || l.starts_with("//")).collect()
}

fn is_long_without_a_word(text: &str) -> Option<String> {
    let lines = text.lines().count();
    // A comment breaks its lines anywhere.
    let head = head(text).join(" ").replace("//!", " ").replace("//", " ").to_lowercase();
    let head = head.split_whitespace().collect::<Vec<_>>().join(" ");
    (lines > 400 && !head.contains("one piece"))
        .then(|| format!("{lines} lines; its head does not say why it is one piece"))
}

#[test]
fn a_long_file_says_why_it_is_one_piece() {
    check(|_| true, is_long_without_a_word);
}

#[test]
fn every_file_says_what_it_does() {
    check(
        |path| path.ends_with(".rs"),
        |text| {
            let opens = head(text).iter().any(|line| line.starts_with("//! "));
            (!opens).then(|| "does not open with a `//!` comment".into())
        },
    );
}

#[test]
fn no_file_is_a_drawer() {
    let drawers = ["util", "utils", "helper", "helpers", "common", "misc"];
    let found: Vec<String> = sources()
        .into_iter()
        .map(|s| s.path)
        .filter(|path| path.split(['/', '.']).any(|part| drawers.contains(&part)))
        .collect();
    assert!(found.is_empty(), "{found:?}: name a file by what it does");
}

// --- The checks themselves --------------------------------------------------------------------

#[test]
fn what_is_forbidden_is_found() {
    assert!(prints("fn f() { let c = '\"'; println!(\"x\"); }").is_some());
    assert!(prints("/// doc\nfn f() { /* a */ dbg!(1); }").is_some());
    assert!(prints("fn f() { std::eprint!(\"x\") }").is_some());

    let names = policy_names();
    assert!(names_a_policy("let p = build(\"diet\");", &names).is_some());
    assert!(names_a_policy("use densify_policies::Vanilla;", &names).is_some());
    assert!(names_a_policy("let configs = 1; // diet", &names).is_none());

    let long = "x\n".repeat(401);
    assert!(is_long_without_a_word(&long).is_some());
    assert!(is_long_without_a_word(&format!("//! It is one\n//! piece.\n{long}")).is_none());
    assert!(is_long_without_a_word(&format!("use x;\n//! one piece\n{long}")).is_some());
}
