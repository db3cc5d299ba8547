//! The rules by which Gaussians are removed.

use densify_core::gaussians::Gaussians;
use glam::DVec3;

use super::isolated;
use densify_train::in_front::RowWeights;

/// A rule. Each Gaussian counts for the first one that removes it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rule {
    /// Outside of the given box.
    OutsideBox,
    /// No training view shows it.
    Unseen,
    /// Over half of its weight is in front of the surface.
    InFront,
    /// In a small group far from all others.
    Isolated,
}

impl Rule {
    /// All rules, in their order.
    pub const ALL: [Self; 4] = [Self::OutsideBox, Self::Unseen, Self::InFront, Self::Isolated];
}

/// The rules to apply.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rules {
    /// Smallest and largest coordinates of the box to keep, in those of the dataset.
    pub keep_box: Option<(DVec3, DVec3)>,
    /// Remove Gaussians that no training view shows.
    pub unseen: bool,
    /// Remove Gaussians with over half of their weight in front of the surface.
    pub in_front: bool,
    /// Distance from the surface above which a Gaussian is in front of it, as a fraction of the surface's depth, in
    /// `0..1`.
    pub margin: f64,
    /// Remove groups with less than this share of the weight of all Gaussians; 0: none.
    pub isolated: f64,
}

/// What a rule removed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Removed {
    /// The rule.
    pub rule: Rule,
    /// Number of Gaussians.
    pub rows: usize,
    /// Their share of the weight of all Gaussians.
    pub weight: f64,
}

/// Applies the rules once. Returns the rows to keep, and what each rule removes.
pub(super) fn apply(
    model: &Gaussians,
    weights: &[RowWeights],
    rules: &Rules,
) -> (Vec<usize>, Vec<Removed>) {
    let mut broken: Vec<Option<Rule>> = (0..model.len())
        .map(|row| {
            let is_outside = rules.keep_box.is_some_and(|(low, high)| {
                let place = DVec3::from(model.position(row));
                !(place.cmpge(low).all() && place.cmple(high).all())
            });
            if is_outside {
                Some(Rule::OutsideBox)
            } else if rules.unseen && weights[row].whole <= 0.0 {
                Some(Rule::Unseen)
            } else if rules.in_front && weights[row].is_floater() {
                Some(Rule::InFront)
            } else {
                None
            }
        })
        .collect();
    let total: f64 = weights.iter().map(|weights| weights.whole).sum();
    if rules.isolated > 0.0 {
        let rest: Vec<usize> = (0..model.len()).filter(|&row| broken[row].is_none()).collect();
        for row in isolated::find(model, &rest, weights, rules.isolated * total) {
            broken[row] = Some(Rule::Isolated);
        }
    }
    let removed = Rule::ALL.into_iter().map(|rule| {
        let rows = || (0..model.len()).filter(|&row| broken[row] == Some(rule));
        let weight: f64 = rows().map(|row| weights[row].whole).sum();
        let weight = if total > 0.0 { weight / total } else { 0.0 };
        Removed { rule, rows: rows().count(), weight }
    });
    let removed = removed.filter(|removed| removed.rows > 0).collect();
    ((0..model.len()).filter(|&row| broken[row].is_none()).collect(), removed)
}

#[cfg(test)]
mod tests {
    use super::*;

    const RULES: Rules =
        Rules { keep_box: None, unseen: true, in_front: true, margin: 0.05, isolated: 0.01 };

    /// A row of small Gaussians at distance 0.01 along x, and three at (0, 5, 0).
    fn model() -> Gaussians {
        let mut model = Gaussians::zeros(103, 0);
        for row in 0..103 {
            let x = row as f32 * 0.01;
            model.means[row] = if row < 100 { [x, 0.0, 0.0] } else { [0.0, 5.0, 0.0] };
            model.log_scales[row] = [-6.0; 3];
            model.quats[row] = [1.0, 0.0, 0.0, 0.0];
        }
        model
    }

    fn removed(rules: &Rules, change: impl Fn(&mut Vec<RowWeights>)) -> (Vec<usize>, Vec<Removed>) {
        let mut weights = vec![RowWeights { in_front: 0.0, whole: 1.0 }; 103];
        weights[100..].fill(RowWeights { in_front: 0.0, whole: 0.2 });
        change(&mut weights);
        apply(&model(), &weights, rules)
    }

    #[test]
    fn each_rule_removes_its_own() {
        let (kept, gone) = removed(&RULES, |weights| {
            weights[3] = RowWeights { in_front: 0.6, whole: 1.0 };
            weights[4] = RowWeights { in_front: 0.5, whole: 1.0 };
            weights[7] = RowWeights::default();
        });
        let total = 99.0 + 0.6;
        let share = |rule: Rule| {
            let removed = gone.iter().find(|removed| removed.rule == rule);
            removed.map_or((0, 0.0), |removed| (removed.rows, removed.weight))
        };
        assert_eq!(share(Rule::InFront), (1, 1.0 / total));
        assert_eq!(share(Rule::Unseen), (1, 0.0));
        assert_eq!(share(Rule::OutsideBox), (0, 0.0));
        assert_eq!(share(Rule::Isolated).0, 3);
        assert!((share(Rule::Isolated).1 - 0.6 / total).abs() < 1e-12);
        assert_eq!(kept.len(), 98);
        assert!(!kept.contains(&3) && kept.contains(&4) && !kept.contains(&7));
    }

    #[test]
    fn rules_are_off_unless_asked_for() {
        let off = Rules { unseen: false, in_front: false, isolated: 0.0, ..RULES };
        let (kept, gone) = removed(&off, |weights| {
            weights[3].in_front = 1.0;
            weights[7] = RowWeights::default();
        });
        assert_eq!((kept.len(), gone.len()), (103, 0));
        let keep_box = Some((DVec3::new(0.105, -1.0, -1.0), DVec3::new(0.205, 1.0, 1.0)));
        let (kept, gone) = removed(&Rules { keep_box, ..off }, |_| ());
        assert_eq!(kept, (11..=20).collect::<Vec<_>>());
        assert_eq!(
            (gone.len(), gone[0].rule, gone[0].rows),
            (1, Rule::OutsideBox, 103 - kept.len())
        );
        // A group with more weight than the limit stays.
        let (kept, _) = removed(&Rules { isolated: 0.004, ..off }, |_| ());
        assert_eq!(kept.len(), 103);
    }
}
