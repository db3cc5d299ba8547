//! Groups runs by scene, and within a scene by settings, so that the runs of a group differ only in their seed.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use toml::Table;

use super::options::flatten;
use super::runs::RunRecord;
use densify_core::files;
use densify_data::dataset::builtin;
use densify_run::failure::Failure;
use densify_run::finished::name_of;
use densify_run::{DataSpec, OnResume, Partial, RunOption};

/// Runs of the same photographs, read with the same options, so that their pictures are comparable.
pub(super) struct Scene {
    pub(super) label: String,
    /// The dataset's path when the first of the runs was started.
    pub(super) path: PathBuf,
    pub(super) data: DataSpec,
    pub(super) groups: Vec<Group>,
}

/// Runs that differ only in their seed.
pub(super) struct Group {
    /// The settings that distinguish it from other groups.
    pub(super) label: String,
    /// Indices of the runs, ordered by seed.
    pub(super) runs: Vec<usize>,
}

impl Scene {
    /// The runs that represent their groups in pictures: those with the smallest seed.
    pub(super) fn representatives(&self) -> impl Iterator<Item = usize> {
        self.groups.iter().filter_map(|group| group.runs.first().copied())
    }
}

/// The name of a scene, without its parent folders.
pub(super) fn scene_name(path: &Path) -> String {
    files::one_line(&builtin::name(path).map_or_else(|| name_of(path), str::to_owned))
}

/// Groups all runs by scene and settings.
pub(super) fn group(runs: &[RunRecord]) -> Result<Vec<Scene>, Failure> {
    // Each scene with the canonical path of its dataset, and the settings of its groups.
    let mut scenes: Vec<(Scene, PathBuf, Vec<Table>)> = Vec::new();
    for (number, run) in runs.iter().enumerate() {
        let path = run.config.scene_path();
        let real_path = path.canonicalize().unwrap_or_else(|_| path.clone());
        let data = DataSpec { no_cache: false, ..run.config.spec.data.clone() };
        let settings = settings(run)?;
        let index = scenes
            .iter()
            .position(|(scene, other, _)| *other == real_path && scene.data == data)
            .unwrap_or_else(|| {
                let label = scene_name(&path);
                let earlier = scenes.iter().filter(|(_, other, _)| *other == real_path).count();
                let is_taken = scenes.iter().any(|(scene, ..)| scene.label == label);
                let label = match earlier {
                    0 if is_taken => files::one_line(&path.display().to_string()),
                    0 => label,
                    count => format!("{label}, read with other options ({})", count + 1),
                };
                let scene = Scene { label, path, data, groups: Vec::new() };
                scenes.push((scene, real_path, Vec::new()));
                scenes.len() - 1
            });
        let (scene, _, group_settings) = &mut scenes[index];
        match group_settings.iter().position(|other| *other == settings) {
            Some(at) => scene.groups[at].runs.push(number),
            None => {
                group_settings.push(settings);
                scene.groups.push(Group { label: String::new(), runs: vec![number] });
            }
        }
    }
    let finish = |(mut scene, _, group_settings): (Scene, PathBuf, Vec<Table>)| {
        for (group, label) in scene.groups.iter_mut().zip(labels(&group_settings)) {
            group.runs.sort_by_key(|&run| runs[run].config.spec.schedule.seed);
            group.label = label;
        }
        scene
    };
    Ok(scenes.into_iter().map(finish).collect())
}

/// The settings that determine the result of a run, except scene and seed.
fn settings(run: &RunRecord) -> Result<Table, Failure> {
    let mut all = Partial::all(&run.config.spec)?.into_table();
    let determines_result = |name: &str| {
        name != "seed"
            && RunOption::find(name).is_some_and(|option| option.on_resume != OnResume::Free)
    };
    all.retain(|name, _| determines_result(name));
    all.insert("densify".into(), run.config.densify.clone().into());
    all.insert("model of iteration".into(), run.iteration.into());
    let adapter = run.config.resolved.adapter.as_deref().unwrap_or("processor");
    all.insert("computed on".into(), adapter.into());
    Ok(all)
}

/// Labels for groups: the policy, and those options that all groups have and that differ between them.
fn labels(group_settings: &[Table]) -> Vec<String> {
    const MAX_OPTIONS: usize = 3;
    let all: Vec<_> = group_settings.iter().map(flatten).collect();
    let Some((first, others)) = all.split_first() else { return Vec::new() };
    let differs = |name: &&String| {
        name.as_str() != "policy"
            && others.iter().any(|other| other.get(*name) != first.get(*name))
            && others.iter().all(|other| other.contains_key(*name))
    };
    let differing: Vec<&String> = first.keys().filter(differs).collect();
    let label = |(number, options): (usize, &BTreeMap<String, String>)| {
        let policy = options.get("policy").cloned().unwrap_or_default();
        let shown = differing.iter().take(MAX_OPTIONS);
        let shown = shown.map(|name| format!(", {name} {}", options[*name])).collect::<String>();
        let mut label = format!("{policy}{shown}");
        if differing.len() > MAX_OPTIONS {
            label += &format!(" … ({})", number + 1);
        }
        files::one_line(&label)
    };
    all.iter().enumerate().map(label).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_are_labelled_by_their_differences() {
        let labels_of = |tables: &[&str]| {
            labels(&tables.iter().map(|text| text.parse().unwrap()).collect::<Vec<Table>>())
        };
        assert_eq!(labels_of(&["policy = 'diet'\nbudget = 9"]), ["diet"]);
        assert_eq!(
            labels_of(&["policy = 'diet'\nbudget = 9", "policy = 'mcmc'\nbudget = 9"]),
            ["diet", "mcmc"]
        );
        assert_eq!(
            labels_of(&[
                "policy = 'a'\nbudget = 9\nknob.x = '1/9'",
                "policy = 'a'\nbudget = 8\nknob.x = '1/8'"
            ]),
            ["a, budget 9, knob.x 1/9", "a, budget 8, knob.x 1/8"]
        );
        let many = |n: u32| format!("policy = 'a'\nb = {n}\nc = {n}\nd = {n}\ne = {n}");
        assert_eq!(labels_of(&[&many(1), &many(2)])[1], "a, b 2, c 2, d 2 … (2)");
        // An option that only one group has is not a difference.
        assert_eq!(labels_of(&["policy = 'a'\np.x = 1", "policy = 'b'\np.y = 1"]), ["a", "b"]);
    }
}
