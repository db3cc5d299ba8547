//! Tests of edits, room and refusals, and of random plans against a plain vector.

use super::*;
use proptest::prelude::*;

fn detailed() -> Needs {
    Needs { detailed_edits: true, ..Needs::default() }
}

fn family(children: u32, parent: ParentFate) -> Offspring {
    Offspring {
        children,
        parent,
        placement: Placement::Sampled,
        scale: ScaleRule::Uniform(0.625),
        turn: NO_ROTATION,
        opacity: OpacityRule::Same,
    }
}

const SEED: Seed = Seed::round([0.0; 3], [0.5; 3], 1.0, 0.1);

#[test]
fn a_row_has_one_edit() {
    let mut plan = EditPlan::new(4, 8).allowing(&detailed());
    plan.prune(0).unwrap();
    plan.grow(1, family(1, ParentFate::Stays)).unwrap();
    plan.update(2, Update::NONE).unwrap();
    for row in 0..3 {
        assert!(!plan.is_free(row));
        assert_eq!(plan.prune(row), Err(Refused::Taken));
        assert_eq!(plan.grow(row, family(1, ParentFate::Stays)), Err(Refused::Taken));
        assert_eq!(plan.update(row, Update::NONE), Err(Refused::Taken));
    }
    assert!(plan.is_free(3) && !plan.is_free(4));
    assert_eq!(plan.prune(4), Err(Refused::NoSuchRow));
    assert_eq!(plan.grow(4, family(1, ParentFate::Stays)), Err(Refused::NoSuchRow));
    assert_eq!(plan.update(u32::MAX, Update::NONE), Err(Refused::NoSuchRow));
    assert_eq!(plan.room(), 4);
    let counts = EditCounts { removed: 1, added: 1, updated: 1, denied: 12 };
    assert_eq!(plan.compile().counts, counts);
}

#[test]
fn a_refused_value_changes_nothing() {
    let mut plan = EditPlan::new(2, 8).allowing(&detailed());
    let childless = Offspring { children: 0, ..family(1, ParentFate::Stays) };
    assert_eq!(plan.grow(0, childless), Err(Refused::BadValue("children")));
    let nowhere = Update { position: Some([0.0, f32::NAN, 0.0]), ..Update::NONE };
    assert_eq!(plan.update(0, nowhere), Err(Refused::BadValue("position")));
    assert_eq!(plan.append(Seed { opacity: 1.0, ..SEED }), Err(Refused::BadValue("opacity")));
    assert_eq!(plan.clamp_opacity(0.0), Err(Refused::BadValue("max")));
    assert!(plan.is_free(0) && plan.room() == 6);
    let ops = plan.compile();
    assert!(ops.is_empty());
    assert_eq!(ops.counts.denied, 4);
}

/// Undeclared edits take no memory, and declared ones are allocated once.
#[test]
fn detailed_edits_must_be_declared_and_are_preallocated() {
    assert_eq!([Needs::default(), detailed()].map(|needs| bytes_per_row(&needs)), [29, 65]);
    let plain = family(1, ParentFate::BecomesChild);
    let by_axis = Offspring { scale: ScaleRule::Axes([1.0, 0.5, 2.0]), ..plain };
    let turned = Offspring { turn: [0.0, 0.0, 0.0, 2.0], ..plain };
    let mut plan = EditPlan::new(8, 16);
    for refused in [plan.grow(0, by_axis), plan.grow(0, turned), plan.update(0, Update::NONE)] {
        assert_eq!(refused, Err(Refused::Undeclared));
    }
    plan.grow(0, plain).unwrap();
    assert_eq!(plan.compile().counts.denied, 3);
    let mut plan = EditPlan::new(8, 16).allowing(&detailed());
    let offspring = [plain, by_axis, turned, by_axis];
    for (row, offspring) in (0..).zip(offspring) {
        plan.grow(row, offspring).unwrap();
    }
    for row in 4..8 {
        plan.update(row, Update::NONE).unwrap();
    }
    let ops = plan.compile();
    assert_eq!((ops.families.capacity(), ops.shapes.capacity(), ops.updates.capacity()), (8, 7, 4));
    assert!(ops.families.iter().map(|family| ops.offspring(family)).eq(offspring));
}

#[test]
fn more_children_than_slots_are_refused() {
    let mut plan = EditPlan::new(1, usize::MAX);
    let many = family(u32::MAX, ParentFate::Stays);
    assert_eq!(plan.grow(0, many), Err(Refused::NoRoom));
    assert_eq!(plan.room(), u32::MAX as usize - 1);
}

#[test]
fn the_lowest_opacity_limit_applies_and_causes_are_joined() {
    let mut plan = EditPlan::new(1, 1);
    plan.clamp_opacity(0.01).unwrap();
    plan.clamp_opacity(0.5).unwrap();
    plan.reset(Reset::Candidates);
    for tag in ["grow", "reset", "grow", ""] {
        plan.cause(tag);
    }
    let ops = plan.compile();
    assert_eq!(ops.clamp_opacity, Some(0.01));
    assert_eq!(ops.cause, "grow+reset");
    assert!(ops.reset_candidates && ops.reset_signals.is_empty() && !ops.is_empty());
}

#[derive(Debug, Clone, Copy)]
enum Call {
    Prune(u32),
    Grow(u32, u32, bool),
    Update(u32),
    Append,
}

fn calls() -> impl Strategy<Value = (usize, usize, Vec<Call>)> {
    (0..40_usize, 0..60_usize).prop_flat_map(|(rows, budget)| {
        let row = 0..rows as u32 + 2;
        let call = prop_oneof![
            4 => row.clone().prop_map(Call::Prune),
            3 => (row.clone(), 0..4_u32, any::<bool>()).prop_map(|(r, n, b)| Call::Grow(r, n, b)),
            1 => row.prop_map(Call::Update),
            2 => Just(Call::Append),
        ];
        (Just(rows), Just(budget), prop::collection::vec(call, 0..80))
    })
}

/// The content of a slot in the plain vector.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Occupant {
    Row(u32),
    Child { parent: u32, number: u32 },
    Seed(usize),
}

/// Executes `ops` on a plain vector, checking every sub-step, and returns the resulting slots.
fn execute(ops: &RowOps, pruned: &[u32], budget: usize) -> Vec<Occupant> {
    let slots = ops.rows_before.max(budget);
    let mut model: Vec<Option<Occupant>> = (0..slots)
        .map(|slot| (slot < ops.rows_before).then_some(Occupant::Row(slot as u32)))
        .collect();
    for &row in pruned {
        assert_eq!(model[row as usize].take(), Some(Occupant::Row(row)));
    }
    let mut live = ops.rows_before - pruned.len();
    let mut add = |model: &mut [Option<Occupant>], slot: u32, occupant: Occupant| {
        assert!((slot as usize) < budget, "slot {slot} is beyond the budget {budget}");
        assert_eq!(model[slot as usize].replace(occupant), None, "slot {slot} was not free");
        live += 1;
        assert!(live <= budget, "{live} rows, budget {budget}");
    };
    for family in &ops.families {
        assert_eq!(model[family.parent as usize], Some(Occupant::Row(family.parent)));
        for (number, &slot) in (1..).zip(ops.children(family)) {
            add(&mut model, slot, Occupant::Child { parent: family.parent, number });
        }
    }
    for (row, _) in &ops.updates {
        assert_eq!(model[*row as usize], Some(Occupant::Row(*row)));
    }
    for (index, (slot, _)) in ops.seeds.iter().enumerate() {
        add(&mut model, *slot, Occupant::Seed(index));
    }
    for &(from, to) in &ops.moves {
        let row = model[from as usize].take();
        assert!(row.is_some() && model[to as usize].is_none());
        model[to as usize] = row;
    }
    assert!(model[ops.rows_after..].iter().all(Option::is_none), "rows beyond the last");
    model[..ops.rows_after].iter().map(|slot| slot.expect("rows are dense")).collect()
}

proptest! {
    #[test]
    fn any_plan_agrees_with_a_plain_vector((rows, budget, calls) in calls()) {
        let mut plan = EditPlan::new(rows, budget).allowing(&detailed());
        let mut pruned = Vec::new();
        let mut expected: Vec<Occupant> = (0..rows as u32).map(Occupant::Row).collect();
        let mut denied = 0;
        let mut seeds = 0;
        for call in calls {
            let room = plan.room();
            let result = match call {
                Call::Prune(row) => plan.prune(row).map(|()| {
                    pruned.push(row);
                    expected.retain(|&occupant| occupant != Occupant::Row(row));
                }),
                Call::Grow(row, children, stays) => {
                    let parent = if stays { ParentFate::Stays } else { ParentFate::BecomesChild };
                    plan.grow(row, family(children, parent)).map(|()| {
                        expected.extend((1..=children).map(|number| Occupant::Child { parent: row, number }));
                    })
                }
                Call::Update(row) => plan.update(row, Update::NONE),
                Call::Append => plan.append(SEED).map(|()| {
                    expected.push(Occupant::Seed(seeds));
                    seeds += 1;
                }),
            };
            if result.is_err() {
                denied += 1;
                prop_assert_eq!(plan.room(), room);
            }
            prop_assert!(expected.len() <= budget.max(rows - pruned.len()));
            prop_assert_eq!(plan.room(), budget.saturating_sub(expected.len()));
        }
        let ops = plan.compile();
        prop_assert_eq!(ops.check(), Ok(()));
        prop_assert_eq!(ops.counts.denied, denied);
        prop_assert!(ops.rows_after <= budget.max(rows));
        let mut occupants = execute(&ops, &pruned, budget);
        let order = ops.order();
        if !order.is_empty() {
            occupants = order.iter().map(|&slot| occupants[slot as usize]).collect();
        }
        expected.sort_by_key(|occupant| match *occupant {
            Occupant::Row(row) => (0, row, 0),
            Occupant::Child { parent, number } => (0, parent, number),
            Occupant::Seed(seed) => (1, seed as u32, 0),
        });
        prop_assert_eq!(occupants, expected);
    }
}

#[test]
fn signals_are_reset_alone_or_all_together() {
    let reset = |resets: &[Reset]| {
        let mut plan = EditPlan::new(1, 1);
        for &each in resets {
            plan.reset(each);
        }
        plan.compile().reset_signals
    };
    let only = |signals: &[Signal]| Reset::Only(signals.iter().copied().collect());
    let two = reset(&[only(&[Signal::WeightSum]), only(&[Signal::VisibleCount])]);
    assert_eq!(two, SignalSet::from([Signal::VisibleCount, Signal::WeightSum]));
    // Signals of the current state and signals kept per epoch are not reset.
    assert!(reset(&[only(&[Signal::Opacity, Signal::WeightMax])]).is_empty());
    let all = reset(&[only(&[Signal::WeightSum]), Reset::Signals]);
    let resettable: SignalSet =
        Signal::ALL.into_iter().filter(|signal| signal.is_resettable()).collect();
    assert_eq!(all, resettable);
    assert!(all.contains(Signal::ScreenGradient) && !all.contains(Signal::Age));
}

#[test]
fn a_decay_of_seen_rows_needs_the_visible_count() {
    let decay = Decay { opacity: 0.1, scale: 0.2, seen_only: true };
    let mut plan = EditPlan::new(1, 1).allowing(&detailed());
    assert_eq!(plan.decay(decay), Err(Refused::Undeclared));
    assert!(plan.was_undeclared() && plan.decay(Decay { seen_only: false, ..decay }).is_ok());
    let signals = SignalSet::from([Signal::VisibleCount]);
    let mut plan = EditPlan::new(1, 1).allowing(&Needs { signals, ..Needs::default() });
    assert_eq!(plan.decay(decay), Ok(()));
    assert_eq!(plan.decay(Decay { scale: 1.0, ..decay }), Err(Refused::BadValue("scale")));
    let ops = plan.compile();
    assert!(ops.decay == Some(decay) && ops.edits_rows());
}
