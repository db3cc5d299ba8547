//! The walls of the house as tests: what must not depend on what, where the compiler does not see it.

use std::collections::BTreeSet;
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

/// The packages that a member names; what others need it cannot name.
fn dependencies(member: &str) -> Vec<String> {
    let manifest: toml::Table = read(&root().join(member).join("Cargo.toml")).parse().unwrap();
    let named = manifest["dependencies"].as_table().expect("it has some");
    named.keys().cloned().collect()
}

#[test]
fn policies_depend_on_no_device_no_image_and_not_on_the_root() {
    let found = dependencies("policies");
    for forbidden in ["wgpu", "image", "rayon", "densify", "densify-scenegen"] {
        assert!(!found.iter().any(|name| name == forbidden), "densify-policies names {forbidden}");
    }
}

#[test]
fn scenegen_depends_on_neither_of_the_others() {
    let found = dependencies("scenegen");
    for forbidden in ["densify", "densify-policies", "wgpu"] {
        assert!(!found.iter().any(|name| name == forbidden), "densify-scenegen names {forbidden}");
    }
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
