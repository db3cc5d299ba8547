//! Re-initialisation: the whole model is replaced by surface points seen in the training views.
//!
//! *Mini-Splatting*, Fang and Wang 2024, "depth reinitialization", as the published code of diet does
//! it.

use super::Diet;
use super::quota::rows_of_share;
use crate::neighbours::Neighbours;
use crate::plan::{EditPlan, Reset, Seed};
use crate::policy::{Candidate, SceneInfo};

/// Smallest size of a point, in extents: nearer points sample the surface at the same place (as in the
/// initialisation).
const LEAST_DISTANCE: f64 = 2e-4;
/// Size of a point without neighbours, in extents.
const LONE_SIZE: f64 = 0.02;

impl Diet {
    /// Whether the model is replaced at `step`.
    pub(super) fn is_reinit(&self, step: u32) -> bool {
        step > 0 && step == self.params.reinit_at
    }

    /// How many surface points of a view to measure, if the model is ever replaced.
    pub(super) fn surface_points(&self, scene: &SceneInfo) -> u32 {
        if self.params.reinit_at == 0 {
            return 0;
        }
        let most = rows_of_share(self.params.reinit_share, scene.budget);
        let per_view = (most / scene.train_views.max(1) as usize).max(1);
        u32::try_from(per_view).unwrap_or(u32::MAX)
    }

    /// Prunes all rows and appends the surface points instead. Without any point the model is kept.
    pub(super) fn reinit(&mut self, extent: f32, plan: &mut EditPlan) {
        let opacity = self.params.newborn_opacity as f32;
        // A valid size until the neighbours are known.
        let seed = |c: &Candidate| Seed::round(c.position, c.colour, 1.0, opacity);
        let surface = std::mem::take(&mut self.surface);
        let mut seeds: Vec<Seed> =
            surface.iter().map(seed).filter(|s| s.bad_field().is_none()).collect();
        seeds.truncate(rows_of_share(self.params.reinit_share, plan.budget()));
        if seeds.is_empty() {
            return;
        }
        let positions: Vec<_> = seeds.iter().map(|seed| seed.position.map(f64::from)).collect();
        let neighbours = Neighbours::new(&positions);
        let extent = f64::from(extent);
        let least = LEAST_DISTANCE * extent;
        let alone = seeds.len() == 1;
        for (index, seed) in seeds.iter_mut().enumerate() {
            let distance = neighbours.mean_square_distance(index).sqrt();
            let size = if alone { LONE_SIZE * extent } else { distance.max(least) };
            seed.scales = [size as f32; 3];
        }
        plan.cause("reinit");
        plan.prune_all(0..plan.rows() as u32);
        for seed in seeds {
            // A refusal is counted by the plan.
            let _ = plan.append(seed);
        }
        plan.reset(Reset::Signals);
        plan.reset(Reset::Candidates);
    }
}
