//! Removes floaters during training: at the first three tenths of the run, Gaussians with most of their weight in front
//! of the surface are pruned, while the policy still grows others in their place.

use super::{EditEvent, TrainError, TrainOptions, Trainer};
use crate::in_front::{self, MARGIN, RowWeights};
use densify_data::views::ViewSource;
use densify_policies::policy::AuxRequest;

/// Number of equal parts of the run, and the last one after which floaters are removed: in the built-in room, removing
/// them up to half or seven tenths of the run costs 0.3 or 0.9 dB.
const PARTS: u64 = 10;
const LAST: u64 = 3;
/// Maximum number of views in which weights are measured at a time.
const VIEWS: usize = 100;

/// The measurements that the removal needs from the backend.
pub fn floater_request() -> AuxRequest {
    in_front::request(MARGIN)
}

/// Memory of the removal on the host, in addition to a view's measurements `[bytes per row]`.
pub const FLOATER_BYTES: usize = size_of::<RowWeights>() + size_of::<u32>();

/// True if floaters are removed after this step of `iterations`.
fn is_due(step: u32, iterations: u32) -> bool {
    let part = |step: u32| PARTS * u64::from(step) / u64::from(iterations.max(1));
    part(step) > part(step - 1) && part(step) <= LAST
}

impl<V: ViewSource> Trainer<V> {
    /// Removes floaters after `step`, if it is enabled and due.
    pub(super) fn remove_floaters(&mut self, step: u32) -> Result<Option<EditEvent>, TrainError> {
        let TrainOptions { removes_floaters, iterations, .. } = self.options;
        if !removes_floaters || !is_due(step, iterations) {
            return Ok(None);
        }
        let request = floater_request();
        let (rows, _) = self.trained_rows_and_budget();
        let mut weights = vec![RowWeights::default(); rows];
        for view in self.sample_scored_views(VIEWS, step) {
            in_front::add(&mut weights, &self.observe_view(step, view, &request)?);
        }
        let floaters = (0..).zip(&weights).filter(|(_, weights)| weights.is_floater());
        let floaters: Vec<u32> = floaters.map(|(row, _)| row).collect();
        if floaters.len() == rows {
            return Ok(None);
        }
        let mut plan = self.new_plan();
        plan.cause("in front of the surface");
        plan.prune_all(floaters);
        self.execute(step, plan)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn floaters_are_removed_at_three_tenths_of_any_run() {
        for iterations in [10, 95, 3000, u32::MAX / 4] {
            let near = |tenth: u32| (u64::from(tenth) * u64::from(iterations)).div_ceil(10) as u32;
            for tenth in 1..=9 {
                let step = near(tenth);
                assert_eq!(is_due(step, iterations), tenth <= 3, "{step} of {iterations}");
                assert!(iterations == 10 || !is_due(step + 1, iterations));
            }
        }
        assert!(!is_due(1, 1) && is_due(1, 3) && !is_due(2, 3));
    }
}
