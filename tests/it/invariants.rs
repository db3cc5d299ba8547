//! The walls of the house as tests: what must not depend on what, where the compiler does not see it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use densify_policies::registry::policies;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// All files below a folder, with `/`, from the root.
fn files(folder: &str) -> Vec<String> {
    let entries = std::fs::read_dir(root().join(folder)).expect("a folder of the project");
    let mut found = Vec::new();
    for entry in entries.map(|entry| entry.expect("a folder's entry")) {
        let path = format!("{folder}/{}", entry.file_name().to_string_lossy());
        match entry.path().is_dir() {
            true => found.extend(files(&path)),
            false => found.push(path),
        }
    }
    assert!(!found.is_empty(), "{folder} is empty");
    found
}

/// The places below `src` whose code, without comments and unit tests, has one of these words; paths that
/// `may` are left out.
fn found_in(words: &[String], may: impl Fn(&str) -> bool) -> Vec<String> {
    let mut found = Vec::new();
    for path in files("src") {
        if !path.ends_with(".rs") || path.ends_with("tests.rs") || may(&path) {
            continue;
        }
        let text = read(&root().join(&path));
        let code = text.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default();
        let lines = code.lines().filter(|line| !line.trim_start().starts_with("//"));
        let has = |line: &&str| words.iter().any(|word| line.contains(word));
        found.extend(lines.filter(has).map(|line| format!("{path}: {}", line.trim())));
    }
    found
}

#[test]
fn only_the_gpu_backend_names_wgpu() {
    let wgpu = ["wgpu::".to_owned()];
    let found = found_in(&wgpu, |path| path.starts_with("src/backend/gpu"));
    assert!(found.is_empty(), "{found:#?}");
    assert!(!found_in(&wgpu, |_| false).is_empty(), "the search finds nothing at all");
}

#[test]
fn the_library_does_not_know_the_command_line() {
    let may = |path: &str| path.starts_with("src/cli/") || path == "src/main.rs";
    let found = found_in(&["crate::cli".to_owned(), "densify::cli".to_owned()], may);
    assert!(found.is_empty(), "{found:#?}");
}

#[test]
fn the_trainer_names_no_policy() {
    let all = policies().expect("the registry is sound");
    let words = |name: &str| [format!("\"{name}\""), format!("densify_policies::{name}")];
    let words: Vec<String> = all.iter().flat_map(|entry| words(entry.name)).collect();
    let found = found_in(&words, |path| !path.starts_with("src/trainer"));
    assert!(!words.is_empty() && found.is_empty(), "{found:#?}");
}

#[test]
fn every_shader_has_a_native_file_of_the_same_name() {
    let names = |folder: &str, ending: &str| -> BTreeSet<String> {
        let inside = |path: String| {
            let name = path.strip_prefix(folder)?.strip_prefix('/')?.strip_suffix(ending)?;
            Some(name.strip_suffix("/mod").unwrap_or(name).to_owned())
        };
        files(folder).into_iter().filter_map(inside).collect()
    };
    let mut shaders = names("shaders", ".wgsl");
    // Texts that stages share.
    shaders.retain(|name| !name.starts_with("shared/"));
    // A stage in two ways has one native file.
    for two in ["rasterize_bwd", "observe"] {
        assert!(shaders.contains(two) && shaders.remove(&format!("{two}_atomic")), "{two}");
    }
    assert!(shaders.len() >= 9, "{shaders:?}");
    let native = names("src/backend/cpu", ".rs");
    assert!(shaders.is_subset(&native), "no native twin: {:?}", shaders.difference(&native));
}

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
