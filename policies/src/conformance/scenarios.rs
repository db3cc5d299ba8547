//! The scripted runs of the suite: models, budgets and statistics.

use std::fmt;

use super::synthetic::{PATTERNS, Pattern};
use crate::policy::SceneInfo;

/// One scripted run.
#[derive(Debug, Clone)]
pub(super) struct Scenario {
    name: &'static str,
    pub(super) scene: SceneInfo,
    /// True if plans refuse all growth, regardless of the scene's budget.
    refuses_growth: bool,
    pattern: Pattern,
}

/// Maximum number of events of a run, which bounds the time of policies that are due at every step.
const MAX_EVENTS: usize = 400;
/// Maximum number of events of a run with a large model.
const MAX_EVENTS_IF_LARGE: usize = 40;
/// Number of rows of a large model, in which a small fraction is still several rows.
const LARGE_MODEL_ROWS: usize = 5_000;

impl Scenario {
    /// Maximum number of events of this run.
    pub(super) fn max_events(&self) -> usize {
        if self.scene.initial_rows >= LARGE_MODEL_ROWS { MAX_EVENTS_IF_LARGE } else { MAX_EVENTS }
    }

    /// The budget of the plan for a model of `rows` rows.
    pub(super) fn budget(&self, rows: usize) -> usize {
        if self.refuses_growth { rows } else { self.scene.budget }
    }

    /// The pattern of the statistics at a step.
    pub(super) fn pattern_at(&self, step: u32) -> Pattern {
        match self.pattern {
            // Every pattern but the last, which is `Changing` itself.
            Pattern::Changing => PATTERNS[step as usize % (PATTERNS.len() - 1)],
            pattern => pattern,
        }
    }
}

impl fmt::Display for Scenario {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}, statistics {:?}, {} steps", self.name, self.pattern, self.scene.iterations)
    }
}

/// A scene for a run of a fiftieth of the reference length.
pub(super) fn scene(initial_rows: usize, budget: usize) -> SceneInfo {
    SceneInfo {
        extent: 3.0,
        train_views: 7,
        budget,
        initial_rows,
        iterations: 600,
        white_background: true,
    }
}

/// All runs that a policy must pass.
pub(super) fn scenarios() -> Vec<Scenario> {
    let models = [
        ("an empty model", scene(0, 8), false),
        ("one row and a budget of one", scene(1, 1), false),
        ("one row", scene(1, 16), false),
        ("a full model", scene(24, 24), false),
        ("a model with room", scene(30, 300), false),
        ("a single view", SceneInfo { train_views: 1, ..scene(30, 300) }, false),
        ("plans that refuse growth", scene(20, 200), true),
        ("full length", SceneInfo { iterations: 30_000, ..scene(20, 60) }, false),
    ];
    let runs = models.into_iter().flat_map(|(name, scene, refuses_growth)| {
        PATTERNS.map(|pattern| Scenario { name, scene: scene.clone(), refuses_growth, pattern })
    });
    let large = [Pattern::Plausible, Pattern::Mixture].map(|pattern| Scenario {
        name: "thousands of rows",
        scene: scene(LARGE_MODEL_ROWS, LARGE_MODEL_ROWS + LARGE_MODEL_ROWS / 2),
        refuses_growth: false,
        pattern,
    });
    runs.chain(large).collect()
}
