//! # steady — prune the faintest, split where gradients are large
//!
//! Every `grow_every` steps until `grow_until`, faint Gaussians are pruned and the 5 % with the
//! largest screen gradients are split.
//!
//! | name | default | range | unit | meaning |
//! |---|---|---|---|---|
//! | grow_every | 100 | >= 1 | steps | interval |
//! | grow_until | 15000 | >= 0 | step | end (exclusive) |

use densify_policies::parameters::StepParameter::{self, Interval, Step};
use densify_policies::{adc, parameters::in_range, plan::*, policy::*, rng::PolicyRng, sample};

densify_policies::register_policy!("steady", Steady, summary: "splits where gradients are large",
    source: "an example", doc: include_str!("lib.rs"));

/// The policy, which holds nothing but its parameters.
#[derive(serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Steady {
    grow_every: u32,
    grow_until: u32,
}

impl Default for Steady {
    fn default() -> Self {
        Self { grow_every: 100, grow_until: 15_000 }
    }
}

impl densify_policies::registry::ConfiguredPolicy for Steady {
    type Params = Self;
    const STEP_PARAMETERS: &'static [StepParameter] = &[Interval("grow_every"), Step("grow_until")];
    fn new(params: Self, _: &SceneInfo) -> Result<Self, PolicyError> {
        in_range("grow_every", f64::from(params.grow_every), 1.0..)?;
        Ok(params)
    }
}

#[rustfmt::skip] // Short answers on one line.
impl DensityPolicy for Steady {
    fn needs(&self, _: &SceneInfo) -> Needs {
        let signals = [Signal::Opacity, Signal::ScreenGradient, Signal::VisibleCount];
        Needs { signals: SignalSet::from(signals), ..Needs::default() }
    }
    fn is_due(&self, step: u32) -> bool { step < self.grow_until && step.is_multiple_of(self.grow_every) }
    fn plan(&mut self, now: &Snapshot, _: &PolicyRng, plan: &mut EditPlan) -> Result<(), PolicyError> {
        let (opacity, sum) = (now.signal(Signal::Opacity)?, now.signal(Signal::ScreenGradient)?);
        let mut faint: Vec<u32> = (0..now.rows() as u32).filter(|&r| opacity[r as usize] < 0.005).collect();
        adc::spare_one(&mut faint, opacity); // A model without rows could never grow again.
        plan.prune_all(faint);
        let mean = adc::mean_over_views(sum, now.signal(Signal::VisibleCount)?);
        for row in sample::top_k(&mean, now.rows() / 20) { let _ = plan.grow(row, adc::split_by(1.6)); } // The plan counts what it refuses.
        plan.reset(Reset::Signals); // The sums start from zero again.
        plan.cause("steady");
        Ok(())
    }
}
