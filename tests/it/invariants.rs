//! Architecture tests: dependency rules that the compiler does not enforce.

use std::collections::BTreeSet;
use std::path::Path;

use densify_policies::registry::policies;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

/// All files below a folder, as paths from the root with `/`.
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

/// Lines below `src`, without comments and unit tests, that contain one of these words. Paths for which `allowed` holds
/// are skipped.
fn lines_with(words: &[String], allowed: impl Fn(&str) -> bool) -> Vec<String> {
    let mut found = Vec::new();
    for path in files("src") {
        if !path.ends_with(".rs") || path.ends_with("tests.rs") || allowed(&path) {
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
    let found = lines_with(&wgpu, |path| path.starts_with("src/render/gpu"));
    assert!(found.is_empty(), "{found:#?}");
    assert!(!lines_with(&wgpu, |_| false).is_empty(), "the search is broken");
}

#[test]
fn the_trainer_names_no_policy() {
    let all = policies().expect("the registry is sound");
    let words = |name: &str| [format!("\"{name}\""), format!("densify_policies::{name}")];
    let words: Vec<String> = all.iter().flat_map(|entry| words(entry.name)).collect();
    let found = lines_with(&words, |path| !path.starts_with("src/train/trainer"));
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
    // Code shared by stages.
    shaders.retain(|name| !name.starts_with("shared/"));
    // A stage with two variants has one native file.
    for stage in ["rasterize_bwd", "observe"] {
        assert!(shaders.contains(stage) && shaders.remove(&format!("{stage}_atomic")), "{stage}");
    }
    assert!(shaders.len() >= 9, "{shaders:?}");
    let native = names("src/render/cpu", ".rs");
    assert!(shaders.is_subset(&native), "no native counterpart: {:?}", shaders.difference(&native));
}

/// The packages of the workspace, lowest layer first. A package may depend only on lower layers.
const LAYERS: [&[(&str, &str)]; 9] = [
    &[
        ("densify-core", "src/core"),
        ("densify-policies", "policies"),
        ("densify-scenegen", "scenegen"),
        ("densify-shaders", "shaders"),
    ],
    &[("densify-data", "src/data"), ("densify-render", "src/render")],
    &[("densify-train", "src/train")],
    &[("densify-run", "src/run"), ("densify-selftest", "src/tools/selftest")],
    &[
        ("densify-clean", "src/tools/clean"),
        ("densify-compress", "src/tools/compress"),
        ("densify-html", "src/tools/html"),
        ("densify-inspect", "src/tools/inspect"),
        ("densify-launch", "src/tools/launch"),
        ("densify-mesh", "src/tools/mesh"),
        ("densify-poses", "src/tools/poses"),
    ],
    &[
        ("densify-blocks", "src/tools/blocks"),
        ("densify-study", "src/tools/study"),
        ("densify-view", "src/tools/view"),
    ],
    &[("densify-report", "src/tools/report")],
    &[("densify-cli", "src/cli")],
    &[("densify", "."), ("densify-python", "python")],
];

/// The workspace packages that a package depends on directly.
fn dependencies(folder: &str) -> Vec<String> {
    let manifest: toml::Table = read(&root().join(folder).join("Cargo.toml")).parse().unwrap();
    let named = manifest.get("dependencies").and_then(toml::Value::as_table);
    named.map_or_else(Vec::new, |named| named.keys().cloned().collect())
}

#[test]
fn packages_depend_only_on_lower_layers() {
    let mut below: BTreeSet<&str> = BTreeSet::new();
    let mut named = 0;
    for layer in LAYERS {
        for (package, folder) in layer {
            for name in dependencies(folder).iter().filter(|name| name.starts_with("densify")) {
                assert!(
                    below.contains(&**name),
                    "{package} depends on {name}, which is not in a lower layer"
                );
                named += 1;
            }
        }
        below.extend(layer.iter().map(|(package, _)| *package));
    }
    assert!(named > 50, "only {named} dependencies were found");
    let workspace: toml::Table = read(&root().join("Cargo.toml")).parse().unwrap();
    let members = workspace["workspace"]["members"].as_array().unwrap().iter();
    let listed: BTreeSet<&str> = LAYERS.iter().flat_map(|l| l.iter().map(|(_, f)| *f)).collect();
    for member in members.filter_map(toml::Value::as_str).filter(|m| !m.starts_with("tests/")) {
        assert!(listed.contains(member), "{member} has no layer");
    }
}

#[test]
fn lower_layers_do_not_depend_on_excluded_crates() {
    for (folder, forbidden) in [
        ("policies", &["wgpu", "image", "rayon"][..]),
        ("scenegen", &["wgpu"]),
        ("src/core", &["wgpu", "image", "rayon", "clap"]),
        ("src/data", &["wgpu"]),
        ("src/render", &["image", "gltf"]),
    ] {
        let found = dependencies(folder);
        let bad = found.iter().find(|name| forbidden.contains(&name.as_str()));
        assert!(bad.is_none(), "{folder} names {bad:?}");
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

/// The modules of the larger packages, lowest first. A module may use only earlier ones.
const MODULES: [(&str, &[&str]); 5] = [
    (
        "src/core",
        &[
            "antialiasing",
            "budget",
            "camera",
            "colour",
            "curve",
            "files",
            "image",
            "linear",
            "numbers",
            "memory",
            "pieces",
            "pose",
            "similarity",
            "sh",
            "gaussians",
            "spelling",
            "spline",
            "vignette",
            "camera_path",
        ],
    ),
    (
        "src/data",
        &[
            "error",
            "picture_file",
            "ply",
            "meshes",
            "models",
            "points",
            "las",
            "dataset",
            "track_colours",
            "track_poses",
            "views",
        ],
    ),
    (
        "src/render",
        &[
            "adapter",
            "audit",
            "candidates",
            "depth",
            "error",
            "inspect",
            "pixel_map",
            "signals",
            "cpu",
            "differentiable",
            "gpu",
            "choice",
            "setup",
            "state",
            "without_gpu",
        ],
    ),
    (
        "src/train",
        &[
            "adam",
            "exposure",
            "vignette",
            "poses",
            "metrics",
            "evaluate",
            "importance",
            "in_front",
            "pictures",
            "schedule",
            "init",
            "trainer",
            "output",
            "checkpoint",
        ],
    ),
    (
        "src/run",
        &[
            "companion",
            "device",
            "failure",
            "observer",
            "coordinate_check",
            "models",
            "process",
            "host",
            "spec",
            "near_plane",
            "position_rates",
            "resolved",
            "finished",
            "session",
            "refining",
        ],
    ),
];

/// The top-level modules that a text names through `crate::`, including groups in braces.
fn named_modules(code: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    for rest in code.split("crate::").skip(1) {
        let names = match rest.strip_prefix('{') {
            None => rest,
            Some(group) => group.split(';').next().unwrap_or_default(),
        };
        let parts = if rest.starts_with('{') { names.split(',').collect() } else { vec![names] };
        for part in parts {
            let part = part.trim_start();
            let end = part.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(part.len());
            found.insert(part[..end].to_owned());
        }
    }
    found
}

#[test]
fn modules_use_only_earlier_modules() {
    let mut checked = 0;
    for (folder, order) in MODULES {
        let place = |name: &str| order.iter().position(|module| *module == name);
        for path in files(folder).into_iter().filter(|path| path.ends_with(".rs")) {
            let inside = path.strip_prefix(folder).unwrap().trim_start_matches('/');
            let module = inside.split('/').next().unwrap().trim_end_matches(".rs");
            if ["lib", "tests"].contains(&module) || path.contains("/tests") {
                continue;
            }
            let here = place(module).unwrap_or_else(|| panic!("{path}: `{module}` is not listed"));
            let text = read(&root().join(&path));
            let code = text.split("#[cfg(test)]\nmod tests {").next().unwrap_or_default();
            let code: Vec<&str> =
                code.lines().filter(|line| !line.trim_start().starts_with("//")).collect();
            for name in named_modules(&code.join("\n")) {
                if let Some(there) = place(&name) {
                    assert!(there <= here, "{path} uses {name}, which is listed after {module}");
                    checked += usize::from(there < here);
                }
            }
        }
    }
    assert!(checked > 100, "only {checked} uses were found");
}
