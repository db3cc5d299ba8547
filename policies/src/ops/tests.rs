//! Tests of compiled plans, valid and corrupt.

use super::*;
use crate::needs::Needs;
use crate::plan::EditPlan;

const SPLIT: Offspring = Offspring {
    children: 1,
    parent: ParentFate::BecomesChild,
    placement: Placement::Sampled,
    scale: ScaleRule::Uniform(0.5),
    turn: NO_ROTATION,
    opacity: OpacityRule::Same,
};
const SEED: Seed = Seed::round([0.0; 3], [0.5; 3], 1.0, 0.1);
const UPDATE: Update =
    Update { scale: ScaleRule::Uniform(2.0), keep_moments: false, ..Update::NONE };

/// Ten rows: 1, 2, 3, 5 and 8 pruned, 9 split, 7 updated, one seed.
fn shrinking() -> RowOps {
    let needs = Needs { detailed_edits: true, ..Needs::default() };
    let mut plan = EditPlan::new(10, 10).allowing(&needs);
    for row in [1, 2, 3, 5, 8] {
        plan.prune(row).unwrap();
    }
    plan.grow(9, SPLIT).unwrap();
    plan.update(7, UPDATE).unwrap();
    plan.append(SEED).unwrap();
    plan.compile()
}

#[test]
fn a_valid_plan_passes() {
    let ops = shrinking();
    assert_eq!(ops.rows_after, 7);
    assert_eq!(ops.child_slots, [1]);
    assert_eq!(ops.children(&ops.families[0]), [1]);
    assert_eq!(ops.seeds[0].0, 2);
    assert_eq!(ops.moves, [(7, 3), (9, 5)]);
    assert_eq!(ops.check(), Ok(()));
}

#[test]
fn every_corruption_is_found() {
    type Corruption = (&'static str, fn(&mut RowOps));
    let corruptions: &[Corruption] = &[
        ("over budget", |ops| ops.budget = 6),
        ("a row too many", |ops| ops.rows_after += 1),
        ("a row too few", |ops| ops.rows_after -= 1),
        ("removed miscounted", |ops| ops.counts.removed += 1),
        ("added miscounted", |ops| ops.counts.added -= 1),
        ("updated miscounted", |ops| ops.counts.updated -= 1),
        ("opacity bound of one", |ops| ops.clamp_opacity = Some(1.0)),
        ("opacity bound not a number", |ops| {
            ops.clamp_opacity = Some(f32::NAN);
        }),
        ("parent beyond the model", |ops| ops.families[0].parent = 10),
        ("parent is updated too", |ops| ops.families[0].parent = 7),
        ("parent in the tail is not moved", |ops| ops.families[0].parent = 8),
        ("bad offspring", |ops| {
            ops.families[0].shape = Shape::Uniform(-1.0);
        }),
        ("bad listed shape", |ops| {
            ops.families[0].shape = Shape::Listed(0);
            ops.shapes = vec![(ScaleRule::Axes([1.0, 0.0, 1.0]), NO_ROTATION)];
        }),
        ("a shape that is not listed", |ops| {
            ops.families[0].shape = Shape::Listed(0);
        }),
        ("first child slot is wrong", |ops| ops.families[0].first_child = 1),
        ("a child without a slot", |ops| {
            ops.families[0].children = 2;
        }),
        ("child in the parent's slot", |ops| ops.child_slots[0] = 9),
        ("child in a seed's slot", |ops| ops.child_slots[0] = 2),
        ("child beyond the model", |ops| ops.child_slots[0] = 8),
        ("updated row does not exist", |ops| ops.updates[0].0 = 12),
        ("updated row in the tail is not moved", |ops| ops.updates[0].0 = 8),
        ("bad update", |ops| {
            ops.updates[0].1.opacity = OpacityRule::Set(0.0);
        }),
        ("seed in a child's slot", |ops| ops.seeds[0].0 = 1),
        ("seed in a slot that a row moves to", |ops| ops.seeds[0].0 = 3),
        ("bad seed", |ops| ops.seeds[0].1.scales[1] = f32::NAN),
        ("move from before the tail", |ops| ops.moves[0].0 = 4),
        ("move from beyond the model", |ops| ops.moves[0].0 = 10),
        ("a row moved twice", |ops| ops.moves[0].0 = 9),
        ("move to a child's slot", |ops| ops.moves[0].1 = 1),
        ("move to beyond the model", |ops| ops.moves[0].1 = 8),
        ("move missing", |ops| ops.moves.truncate(1)),
    ];
    let passed: Vec<&str> = corruptions
        .iter()
        .filter(|(_, corrupt)| {
            let mut ops = shrinking();
            corrupt(&mut ops);
            ops.check().is_ok()
        })
        .map(|(name, _)| *name)
        .collect();
    assert!(passed.is_empty(), "not found: {passed:?}");
}

#[test]
fn frozen_rows_are_out_of_reach() {
    let shifted = || shrinking().after_frozen(4);
    let ops = shifted();
    assert_eq!(ops.check(), Ok(()));
    assert_eq!((ops.first_row, ops.rows_before, ops.rows_after, ops.budget), (4, 14, 11, 14));
    assert_eq!((ops.families[0].parent, ops.updates[0].0, ops.seeds[0].0), (13, 11, 6));
    assert_eq!((&ops.child_slots[..], &ops.moves[..]), (&[5][..], &[(11, 7), (13, 9)][..]));
    assert_eq!(ops.order()[..4], [0, 1, 2, 3]);
    type Corruption = (&'static str, fn(&mut RowOps));
    let corruptions: &[Corruption] = &[
        ("a parent", |ops| ops.families[0].parent = 2),
        ("a child", |ops| ops.child_slots[0] = 2),
        ("an update", |ops| ops.updates[0].0 = 2),
        ("a seed", |ops| ops.seeds[0].0 = 2),
        ("a move", |ops| ops.moves[0].1 = 2),
        ("all removed", |ops| {
            *ops = RowOps { first_row: 4, rows_before: 4, ..RowOps::default() };
            ops.counts.removed = 4;
        }),
    ];
    for (name, corrupt) in corruptions {
        let mut ops = shifted();
        corrupt(&mut ops);
        assert!(ops.check().is_err(), "{name} is not found");
    }
}

#[test]
fn an_empty_slot_at_the_end_is_found() {
    let mut plan = EditPlan::new(3, 5);
    plan.prune(0).unwrap();
    plan.append(SEED).unwrap();
    plan.append(SEED).unwrap();
    let mut ops = plan.compile();
    assert_eq!(ops.rows_after, 4);
    assert_eq!(ops.seeds.iter().map(|s| s.0).collect::<Vec<_>>(), [0, 3]);
    ops.seeds[1].0 = 2;
    assert!(ops.check().is_err());
}

#[test]
#[should_panic(expected = "broken row operations: 7 rows after, budget 6")]
fn a_broken_plan_stops_the_run() {
    let mut ops = shrinking();
    ops.budget = 6;
    ops.assert_valid();
}

#[test]
fn a_plan_is_empty_only_if_it_changes_nothing() {
    let empty = || EditPlan::new(3, 3);
    let mut refused = empty();
    refused.append(SEED).unwrap_err();
    let refused = refused.compile();
    assert!(refused.is_empty() && refused.counts.denied == 1);
    let mut pruned_tail = empty();
    pruned_tail.prune(2).unwrap();
    assert!(!pruned_tail.compile().is_empty());
    let mut clamped = empty();
    clamped.clamp_opacity(0.5).unwrap();
    assert!(!clamped.compile().is_empty());
    let mut reset = empty();
    reset.reset(crate::edit::Reset::Signals);
    let reset = reset.compile();
    assert!(!reset.is_empty() && !reset.edits_rows());
}
