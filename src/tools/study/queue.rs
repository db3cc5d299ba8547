//! The order of a study's runs, and which of them fit the time that is left.

use super::distinct;
use super::planned_run::PlannedRun;

/// A run to do, with its estimated time `[s]`.
pub(super) type Timed = (PlannedRun, f64);

/// Runs that are compared with each other, and are therefore started together or not at all.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Set {
    pub(super) runs: Vec<Timed>,
}

impl Set {
    /// Time of its runs one after another `[s]`.
    pub(super) fn seconds(&self) -> f64 {
        self.runs.iter().map(|(_, seconds)| seconds).sum()
    }

    /// Name of the set, as `room, 9,000 rows`, without the seed.
    pub(super) fn title(&self) -> &str {
        self.runs.first().map_or("", |(run, _)| &run.set)
    }

    pub(super) fn seed(&self) -> u32 {
        self.runs.first().map_or(0, |(run, _)| run.seed)
    }
}

/// The runs in the order of training: seed after seed, so that an interrupted study is fair; within a seed the set with
/// the longest run first, so that several runs at once end together, and within a set the longest run first. Runs of
/// equal time keep their order.
pub(super) fn in_order(runs: Vec<Timed>) -> Vec<Set> {
    let key = |run: &PlannedRun| (run.seed, run.set.clone());
    let keys = distinct(runs.iter().map(|(run, _)| key(run)));
    let mut sets: Vec<Set> = keys.iter().map(|_| Set { runs: Vec::new() }).collect();
    for timed in runs {
        if let Some(at) = keys.iter().position(|other| *other == key(&timed.0)) {
            sets[at].runs.push(timed);
        }
    }
    for set in &mut sets {
        set.runs.sort_by(|(_, a), (_, b)| b.total_cmp(a));
    }
    let longest = |set: &Set| set.runs.first().map_or(0.0, |(_, seconds)| *seconds);
    sets.sort_by(|a, b| a.seed().cmp(&b.seed()).then(longest(b).total_cmp(&longest(a))));
    sets
}

/// Time of sets with so many runs at once, each started as soon as another ends `[s]`.
pub(super) fn total_seconds(sets: &[Set], at_once: usize) -> f64 {
    let mut ends = vec![0.0; at_once.max(1)];
    sets.iter().for_each(|set| add(&mut ends, set));
    ends.into_iter().fold(0.0, f64::max)
}

/// Divides sets into those that fit the time `[s]` and those that do not. A set that does not fit leaves its time to
/// shorter ones after it.
pub(super) fn divide(sets: Vec<Set>, seconds: f64, at_once: usize) -> (Vec<Set>, Vec<Set>) {
    let mut ends = vec![0.0; at_once.max(1)];
    sets.into_iter().partition(|set| {
        let mut with_set = ends.clone();
        add(&mut with_set, set);
        let fits = with_set.iter().all(|end| *end <= seconds);
        if fits {
            ends = with_set;
        }
        fits
    })
}

/// Adds the runs of a set to the times at which the slots become free.
fn add(ends: &mut [f64], set: &Set) {
    for (_, seconds) in &set.runs {
        if let Some(first_free) = ends.iter_mut().min_by(|a, b| a.total_cmp(b)) {
            *first_free += seconds;
        }
    }
}

/// Names sets by title with their seeds: `room, 9,000 rows (seeds 0, 1); cup, 9,000 rows (seed 0)`.
pub(super) fn names(sets: &[Set]) -> String {
    let titles = distinct(sets.iter().map(Set::title));
    let name = |title: &&str| {
        let seeds = sets.iter().filter(|set| set.title() == *title).map(Set::seed);
        let mut seeds: Vec<u32> = seeds.collect();
        seeds.sort_unstable();
        let seeds: Vec<String> = seeds.iter().map(u32::to_string).collect();
        let word = if seeds.len() == 1 { "seed" } else { "seeds" };
        format!("{title} ({word} {})", seeds.join(", "))
    };
    titles.iter().map(name).collect::<Vec<_>>().join("; ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn runs(all: &[(&str, u32, f64)]) -> Vec<Timed> {
        let timed = |&(set, seed, seconds): &(&str, u32, f64)| {
            (PlannedRun { set: set.into(), seed, ..PlannedRun::default() }, seconds)
        };
        all.iter().map(timed).collect()
    }

    #[test]
    fn the_longest_run_of_a_seed_is_first_and_its_set_stays_together() {
        let sets = in_order(runs(&[
            ("cup", 0, 2.0),
            ("cup", 0, 3.0),
            ("room", 0, 1.0),
            ("room", 0, 9.0),
            ("cup", 1, 99.0),
        ]));
        let order = |sets: &[Set]| -> Vec<f64> {
            sets.iter().flat_map(|set| set.runs.iter().map(|(_, seconds)| *seconds)).collect()
        };
        assert_eq!(order(&sets), [9.0, 1.0, 3.0, 2.0, 99.0]);
        assert_eq!(names(&sets), "room (seed 0); cup (seeds 0, 1)");
        assert_eq!(names(&[sets[2].clone(), sets[1].clone()]), "cup (seeds 0, 1)");
        // Two at once: 9 and 1 + 3 + 2, then 99 after the 6.
        assert!((total_seconds(&sets, 2) - 105.0).abs() < 1e-9);
        assert!((total_seconds(&sets, 1) - 114.0).abs() < 1e-9);
    }

    #[test]
    fn a_set_fits_as_a_whole_or_not_at_all() {
        let sets =
            in_order(runs(&[("room", 0, 6.0), ("room", 0, 6.0), ("cup", 0, 2.0), ("cup", 1, 2.0)]));
        let titles = |sets: &[Set]| names(sets);
        let (fit, left) = divide(sets.clone(), 11.9, 1);
        assert_eq!(
            (titles(&fit).as_str(), titles(&left).as_str()),
            ("cup (seeds 0, 1)", "room (seed 0)")
        );
        let (fit, left) = divide(sets.clone(), 14.0, 1);
        assert_eq!(
            (titles(&fit).as_str(), titles(&left).as_str()),
            ("room (seed 0); cup (seed 0)", "cup (seed 1)")
        );
        let (_, left) = divide(sets, 8.0, 2);
        assert_eq!(left, []);
    }
}
