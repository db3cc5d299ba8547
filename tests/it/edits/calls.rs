//! Proptest strategies for calls of an edit plan, valid or not.

use densify_policies::plan::{
    Decay, EditPlan, NO_ROTATION, Offspring, OpacityRule, ParentFate, Placement, Reset, ScaleRule,
    Seed, Update,
};
use densify_policies::policy::SignalSet;
use proptest::prelude::*;

use super::{ROWS, SIGNALS};

/// One call of an edit plan.
#[derive(Debug, Clone)]
pub(super) enum Call {
    Prune(u32),
    Grow(u32, Offspring),
    Update(u32, Update),
    Append(Seed),
    Decay(Decay),
    Clamp(f32),
    /// Resets all signals or some.
    Reset(Option<SignalSet>),
}

fn opacity_rule() -> impl Strategy<Value = OpacityRule> {
    prop_oneof![
        Just(OpacityRule::Same),
        (0.01_f32..0.99).prop_map(OpacityRule::Set),
        (0.2_f32..=1.0).prop_map(OpacityRule::Scaled),
        Just(OpacityRule::Conserved),
    ]
}

fn scale_rule() -> impl Strategy<Value = ScaleRule> {
    let factor = || 0.4_f32..1.6;
    prop_oneof![
        factor().prop_map(ScaleRule::Uniform),
        (factor(), factor()).prop_map(|(long, other)| ScaleRule::LongAxis { long, other }),
        prop::array::uniform3(factor()).prop_map(ScaleRule::Axes),
        (0.01_f32..0.3).prop_map(ScaleRule::Set),
    ]
}

fn quaternion() -> impl Strategy<Value = [f32; 4]> {
    let any = (0.2_f32..2.0, prop::array::uniform3(-1.0_f32..1.0));
    prop_oneof![Just(NO_ROTATION), any.prop_map(|(w, [x, y, z])| [w, x, y, z])]
}

fn offspring() -> impl Strategy<Value = Offspring> {
    let placement = prop_oneof![
        prop::array::uniform3(-0.3_f32..0.3).prop_map(Placement::Offset),
        Just(Placement::Sampled),
        (0.0_f32..2.0).prop_map(|sigmas| Placement::LongAxis { sigmas }),
        prop::array::uniform3(-1.5_f32..1.5).prop_map(Placement::Axes),
    ];
    let parent = prop_oneof![Just(ParentFate::Stays), Just(ParentFate::BecomesChild)];
    (0..4_u32, parent, placement, scale_rule(), quaternion(), opacity_rule()).prop_map(
        |(children, parent, placement, scale, turn, opacity)| Offspring {
            children,
            parent,
            placement,
            scale,
            turn,
            opacity,
        },
    )
}

/// Any operation of an edit.
pub(super) fn call() -> impl Strategy<Value = Call> {
    // Some rows are out of range for any number of rows.
    let row = || 0..ROWS as u32 + 12;
    let maybe = || prop::option::of(prop::array::uniform3(-0.5_f32..1.5));
    let degree = prop::option::of(0..2_u8);
    let update = (opacity_rule(), scale_rule(), maybe(), maybe(), degree, any::<bool>()).prop_map(
        |(opacity, scale, position, colour, sh_degree, keep_moments)| Update {
            opacity,
            scale,
            position,
            colour,
            sh_degree,
            keep_moments,
        },
    );
    let restart = (0.01_f32..0.3, 0.01_f32..0.99);
    let restart = restart.prop_map(|(scale, opacity)| Update::restart(scale, opacity));
    let update = prop_oneof![3 => update, 1 => restart];
    let decay = (0.0_f32..0.3, 0.0_f32..0.3, any::<bool>());
    let decay = decay.prop_map(|(opacity, scale, seen_only)| Decay { opacity, scale, seen_only });
    let some_signals = prop::sample::subsequence(SIGNALS.to_vec(), 0..=SIGNALS.len());
    let some_signals = some_signals.prop_map(|signals| Some(signals.into_iter().collect()));
    let reset = prop_oneof![Just(None), some_signals].prop_map(Call::Reset);
    let unit = || prop::array::uniform3(0.0_f32..1.0);
    let scales = prop::array::uniform3(0.01_f32..0.3);
    let seed = (unit(), unit(), scales, quaternion(), 0.01_f32..0.99).prop_map(
        |(position, colour, scales, orientation, opacity)| Seed {
            position,
            colour,
            scales,
            orientation,
            opacity,
        },
    );
    prop_oneof![
        8 => row().prop_map(Call::Prune),
        8 => (row(), offspring()).prop_map(|(row, how)| Call::Grow(row, how)),
        4 => (row(), update).prop_map(|(row, how)| Call::Update(row, how)),
        4 => seed.prop_map(Call::Append),
        1 => decay.prop_map(Call::Decay),
        1 => (0.05_f32..0.9).prop_map(Call::Clamp),
        2 => reset,
    ]
}

/// Makes a call; returns true if the plan accepted it.
pub(super) fn make_call(plan: &mut EditPlan, call: &Call) -> bool {
    let done = match *call {
        Call::Prune(row) => plan.prune(row),
        Call::Grow(row, how) => plan.grow(row, how),
        Call::Update(row, how) => plan.update(row, how),
        Call::Append(seed) => plan.append(seed),
        Call::Decay(how) => plan.decay(how),
        Call::Clamp(max) => plan.clamp_opacity(max),
        Call::Reset(signals) => {
            plan.reset(signals.map_or(Reset::Signals, Reset::Only));
            Ok(())
        }
    };
    done.is_ok()
}
