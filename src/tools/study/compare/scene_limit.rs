//! `--budget` and `--memory` of a comparison: limits for all scenes, or for one.

use std::fmt;

use crate::Limit;
use densify_core::numbers;
use densify_run::failure::Failure;

/// A limit for all scenes, or for one.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct SceneLimit {
    /// Label of the scene, if the limit is for one scene only.
    pub scene: Option<String>,
    /// The limit.
    pub limit: Limit,
}

impl fmt::Display for SceneLimit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = self.limit.word();
        match &self.scene {
            Some(scene) => write!(f, "{scene}={word}"),
            None => f.write_str(&word),
        }
    }
}

impl SceneLimit {
    /// Reads `ROWS`, or `SCENE=ROWS` with the label of a scene.
    pub(super) fn rows(text: &str) -> Result<Self, String> {
        Self::parse(text, |text| numbers::rows(text).map(Limit::Rows))
    }

    /// Reads `BYTES`, or `SCENE=BYTES` with the label of a scene.
    pub(super) fn memory(text: &str) -> Result<Self, String> {
        Self::parse(text, |text| numbers::bytes(text).map(Limit::Memory))
    }

    fn parse(text: &str, limit: impl Fn(&str) -> Result<Limit, String>) -> Result<Self, String> {
        let (scene, number) = match text.rsplit_once('=') {
            Some((scene, number)) => (Some(scene.to_owned()), number),
            None => (None, text),
        };
        Ok(Self { scene, limit: limit(number)? })
    }
}

/// The limits of each scene: of each option the scene's own, or else those for all scenes.
pub(super) fn limits_of_scenes(
    budgets: &[SceneLimit],
    memory: &[SceneLimit],
    labels: &[String],
) -> Result<Vec<Vec<Limit>>, Failure> {
    for (flag, given) in [("--budget", budgets), ("--memory", memory)] {
        let unknown = given.iter().find(|b| b.scene.as_ref().is_some_and(|s| !labels.contains(s)));
        if let Some(unknown) = unknown {
            return Err(Failure::input(format!(
                "{flag} {unknown} is for none of the scenes; they are called {}",
                labels.join(", ")
            )));
        }
    }
    let limits_of = |label: &String| {
        let limits: Vec<Limit> =
            [budgets, memory].into_iter().flat_map(|given| own_or_general(given, label)).collect();
        if limits.is_empty() {
            return Err(Failure::input(format!(
                "--budget gives no budget for {label}; add {label}=ROWS, or ROWS for all scenes, or \
                 --memory"
            )));
        }
        Ok(limits)
    };
    labels.iter().map(limits_of).collect()
}

/// The limits of an option for a scene.
fn own_or_general(given: &[SceneLimit], label: &String) -> Vec<Limit> {
    let limits_for = |scene: Option<&String>| -> Vec<Limit> {
        given.iter().filter(|b| b.scene.as_ref() == scene).map(|b| b.limit).collect()
    };
    let own = limits_for(Some(label));
    if own.is_empty() { limits_for(None) } else { own }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_with_limits_of_its_own_takes_no_others_of_that_kind() {
        let labels = ["room".to_owned(), "cup".to_owned()];
        let limits = |budgets: &str, memory: &str| {
            let all = |text: &str, parse: fn(&str) -> Result<SceneLimit, String>| {
                let parts = text.split(',').filter(|part| !part.is_empty());
                parts.map(parse).collect::<Result<Vec<_>, _>>().expect("they parse")
            };
            let [budgets, memory] =
                [all(budgets, SceneLimit::rows), all(memory, SceneLimit::memory)];
            limits_of_scenes(&budgets, &memory, &labels).map_err(|failure| failure.to_string())
        };
        let [rows, memory] = [Limit::Rows, |mib: usize| Limit::Memory((mib as u64) << 20)];
        assert_eq!(limits("30k", ""), Ok(vec![vec![rows(30_000)]; 2]));
        assert_eq!(
            limits("30k,room=28k,room=1k", ""),
            Ok(vec![vec![rows(28_000), rows(1_000)], vec![rows(30_000)]])
        );
        assert_eq!(
            limits("30k", "1GiB,cup=512MiB"),
            Ok(vec![vec![rows(30_000), memory(1024)], vec![rows(30_000), memory(512)]])
        );
        assert_eq!(limits("", "1GiB"), Ok(vec![vec![memory(1024)]; 2]));
        assert!(limits("room=28k", "").is_err_and(|m| m.contains("cup=ROWS")));
        let wrong = limits("30k,rom=28k", "");
        assert!(wrong.is_err_and(|m| m.contains("--budget rom=28000") && m.contains("room")));
        assert!(limits("", "rom=1GiB").is_err_and(|m| m.contains("--memory rom=1024MiB")));
        for text in ["room=", "=", "room=x"] {
            assert!(SceneLimit::rows(text).is_err() && SceneLimit::memory(text).is_err(), "{text}");
        }
    }
}
