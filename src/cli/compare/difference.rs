//! Paired differences of a policy from another.

use super::Record;
use crate::cli::study::Difference;

/// Of the records of `policy` from those of `base` with the same scene, budget and seed. `None`
/// where there is no pair. Runs that broke their budget make no pair.
pub(super) fn between(
    records: &[&Record],
    policy: &str,
    base: &str,
    score: impl Fn(&Record) -> f64,
) -> Option<Difference> {
    let bounded = |name: &str| {
        let name = name.to_owned();
        records.iter().filter(move |r| r.policy == name && r.is_bounded())
    };
    let same =
        |a: &Record, b: &Record| (&a.scene, a.budget, a.seed) == (&b.scene, b.budget, b.seed);
    let pairs = bounded(policy).filter_map(|record| {
        let other = bounded(base).find(|other| same(record, other))?;
        Some(score(record) - score(other))
    });
    Difference::of(&pairs.collect::<Vec<f64>>())
}
