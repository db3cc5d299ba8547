//! Compensation: new rows at pixels with large errors.

use super::{Diet, NewbornSize};
use crate::adc::Window;
use crate::plan::{EditPlan, Seed};
use crate::policy::{CandidateRequest, PolicyResult, SceneInfo, Signal, Snapshot};
use crate::quota::event_quota;
use crate::sample::top_k;

impl Diet {
    /// The pixels to collect; `None` if compensation is off.
    pub(super) fn candidate_request(&self, scene: &SceneInfo) -> Option<CandidateRequest> {
        let Window { from, until, every } = self.insert;
        if every == 0 || from >= until {
            return None;
        }
        // The number of pixels collected in one interval if the model is at the budget, but at most one per row of
        // the budget.
        let steps = every.min(until - from) as usize;
        let per_step = (scene.budget / self.params.rows_per_candidate as usize).max(1);
        let capacity = steps.saturating_mul(per_step).min(scene.budget).max(1);
        Some(CandidateRequest {
            from,
            until,
            rows_per_candidate: self.params.rows_per_candidate,
            capacity,
            error: self.params.error,
            depth: self.params.depth,
            min_alpha: self.params.min_alpha as f32,
            spaced: self.params.nms,
        })
    }

    /// Appends rows at the candidates with the largest errors, evicting rows that are not `exempt` to make room.
    pub(super) fn insert(
        &self,
        now: &Snapshot<'_>,
        plan: &mut EditPlan,
        importance: &[f32],
        exempt: &dyn Fn(u32) -> bool,
    ) -> PolicyResult {
        let size_as_published = match self.params.newborn_size {
            NewbornSize::Pixel => None,
            NewbornSize::Code => Some(squared_geometric_mean(now.signal(Signal::ScaleMax)?)),
        };
        let seeds = now.candidates.iter().map(|candidate| {
            let size_in_pixels = self.params.size_pixels as f32 * candidate.pixel_size;
            let scale = size_as_published.unwrap_or(size_in_pixels);
            let opacity = self.params.newborn_opacity as f32;
            let seed = Seed::round(candidate.position, candidate.colour, scale, opacity);
            (candidate.error, seed)
        });
        let (valid, invalid): (Vec<_>, Vec<_>) =
            seeds.partition(|(_, seed)| seed.bad_field().is_none());
        // The plan refuses and counts these; no row is evicted for them.
        for (_, seed) in invalid {
            let _ = plan.append(seed);
        }
        let errors: Vec<f32> = valid.iter().map(|(error, _)| *error).collect();
        let quota = event_quota(self.params.rho_c, self.insert, now.step, plan.budget());
        let worst = top_k(&errors, quota);
        let missing = worst.len().saturating_sub(plan.room());
        self.evict(now, plan, importance, (missing, exempt))?;
        for index in worst {
            let _ = plan.append(valid[index as usize].1);
        }
        Ok(())
    }
}

/// The squared geometric mean of the positive, finite values; NaN if there are none.
fn squared_geometric_mean(values: &[f32]) -> f32 {
    let logs = values.iter().filter(|v| v.is_finite() && **v > 0.0).map(|v| f64::from(*v).ln());
    let (count, sum) = logs.fold((0.0, 0.0), |(count, sum), log| (count + 1.0, sum + log));
    (2.0 * sum / count).exp() as f32
}
