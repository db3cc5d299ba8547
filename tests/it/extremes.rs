//! Numerical extremes: the cases of the [selftest](densify::selftest) on every backend, and a table of the tests
//! of each extreme.
//!
//! Backends are compared with the float64 reference, which `central.rs` checks by central differences.
//! `docs/studies/selftest.tsv` lists all tolerances. Pixels near a threshold of the renderer get a wider tolerance (see
//! `compare.rs`). `properties.rs` tests properties of arbitrary scenes.
//!
//! | extreme | tested in |
//! |---|---|
//! | 1 no row | selftest; `src/train/init/tests.rs: impossible_requests_are_errors`; `src/data/models/tests/round_trips.rs: formats_in_f32_keep_every_bit`; `policies/src/conformance/tests.rs: every_registered_policy_conforms` |
//! | 2 one row | selftest; `src/train/init/tests.rs: one_to_three_points_have_the_expected_scales` |
//! | 3 duplicates | selftest; `src/train/init/tests.rs: duplicate_and_non_finite_points_are_dropped_and_counted` |
//! | 4 a budget below the points | `src/train/init/tests.rs: the_budget_is_kept_by_a_seeded_subsample`; `tests/it/cli/training.rs: points_beyond_the_budget_are_subsampled_and_reported`; `tests/it/cli/training.rs: a_budget_of_one_row_trains`; `tests/it/cli/faults.rs: flags_out_of_range_are_refused` |
//! | 5 log-scales | selftest; `src/data/models/ply/tests.rs: damaged_rows_are_dropped_up_to_one_percent` |
//! | 6 quaternions | selftest; `src/data/models/ply/tests.rs: damaged_rows_are_dropped_up_to_one_percent` |
//! | 7 needles | selftest |
//! | 8 the near plane | selftest |
//! | 9 a camera inside a row | selftest |
//! | 10 beside the frustum | selftest |
//! | 11 rows as large as the image | selftest, in full with `--long`; `tests/it/sameness.rs: bands_change_nothing`; `tests/it/sameness.rs: running_twice_changes_nothing` |
//! | 12 opacities at the thresholds | selftest |
//! | 13 layers | selftest |
//! | 14 behind an opaque row | selftest; opacity is capped at 0.99 always |
//! | 15 equal depths | selftest; `tests/it/sameness.rs: threads_change_nothing` |
//! | 16 depths one bit apart | selftest |
//! | 17 opacity logits | selftest |
//! | 18 colours | selftest; `src/train/init/tests.rs: rows_start_as_in_the_original_code` |
//! | 19 a camera at a mean | selftest |
//! | 20 distant, tiny, huge | selftest; `src/data/dataset/normalise.rs: powers_of_two_change_no_bit_of_the_scene`; `src/data/dataset/normalise.rs: models_go_to_the_world_and_back`; `src/data/dataset/tests/formats.rs: a_far_off_scene_keeps_its_precision` |
//! | 21 image sizes | selftest; `src/data/dataset/images.rs: broken_and_oversized_files_are_errors_that_name_them` |
//! | 22 lenses | selftest; `src/data/dataset/pose.rs: fields_of_view_that_no_pinhole_has_are_refused` |
//! | 23 plain photographs | selftest; `src/data/dataset/images.rs: every_colour_type_packs_to_eight_bits`; `policies/src/taming/score.rs: terms_are_relative_to_the_median_of_the_positive_values`; `policies/src/conformance/tests.rs: every_registered_policy_conforms` |
//! | 24 similarity | selftest; `src/train/metrics/ssim.rs: nearly_equal_flat_images_do_not_exceed_one`; `src/train/metrics/ssim.rs: agrees_with_the_textbook_pixel_by_pixel_at_every_size` |
//! | 25 the optimiser | selftest; `tests/it/declared.rs: steps_use_the_gradients_accumulated_since_the_last_step`; `tests/it/agreement.rs: training_steps_match_the_native_backend` |
//! | 26 poisoned rows | selftest; `tests/it/quarantine.rs: every_non_finite_value_is_found`; `src/train/trainer/tests/nonfinite.rs: nonfinite_rows_are_removed_before_the_policy_plans` |
//! | 27 all faint, all prunable | selftest; `policies/src/adc.rs: one_row_is_spared`; `policies/src/conformance/tests.rs: every_registered_policy_conforms`; `policies/src/mcmc/tests.rs: nothing_happens_if_no_row_is_alive` |
//! | 28 antialiasing, half precision | selftest; `src/render/cpu/narrow/tests.rs: f16_numbers_are_those_of_the_standard`; `src/render/cpu/narrow/tests.rs: f16_rounding_is_fair_and_stays_between_the_neighbours`; `tests/it/quarantine.rs: every_non_finite_value_is_found` |
//! | 29 whole numbers | `src/render/cpu/tiles.rs: bands_are_cut_without_overflow`; `src/render/cpu/budget.rs: sizes_of_huge_budgets_do_not_overflow_and_the_largest_is_refused`; `src/render/gpu/adapter.rs: the_best_adapter_that_matches_is_taken`; `src/train/checkpoint/tests.rs: headers_with_excessive_sizes_are_refused_without_allocation` |
//! | 30 a long run | selftest, in full with `--long`; `src/train/trainer/edit.rs: rows_written_before_the_moves_count_for_the_peak`; `tests/it/edits/mod.rs: random_plans_match_the_plain_vector` |

use std::path::Path;

use densify::selftest::{Subject, cases, table};

use crate::subject::others;

/// Cases that take a minute or more on software drivers and without SIMD. `densify selftest --gpu NAME 11 13 21 30`
/// runs them. `gpu/long_lists.rs` tests long lists on every device.
const SLOW: [u8; 4] = [11, 13, 21, 30];

/// Runs the selftest except for the cases in `skipped`; fails with the lines of all failed cases.
fn check(subject: &Subject, skipped: &[u8]) {
    let mut failed = Vec::new();
    for case in cases().iter().filter(|case| !skipped.contains(&case.number)) {
        let findings = case.run(subject, false);
        if !findings.iter().all(densify::selftest::Finding::passes) {
            failed.push(table(case, &findings));
        }
    }
    assert!(failed.is_empty(), "on {}:\n{}", subject.name(), failed.join("\n"));
}

#[test]
fn every_case_passes_on_the_native_backend() {
    check(&Subject::NATIVE, &[]);
}

/// Uses accumulation in slots, because some cases compare two runs bit by bit. `agreement` and `oracle` test
/// accumulation by atomics.
#[test]
#[ignore = "takes minutes: run by .ci/run"]
fn every_case_passes_with_other_instruction_sets_and_on_every_device() {
    for subject in others().iter().filter(|subject| subject.is_deterministic()) {
        check(subject, &SLOW);
    }
}

/// Each row of the table starts with `selftest` if there is a case of this number, and names existing tests.
#[test]
fn the_table_names_existing_tests() {
    let rows = include_str!("extremes.rs").lines().filter_map(|line| line.strip_prefix("//! | "));
    let rows: Vec<(&str, &str)> = rows.filter_map(|row| row.split_once(" | ")).skip(1).collect();
    assert_eq!(rows.len(), 30);
    for (number, (extreme, place)) in (1_u8..).zip(rows) {
        assert!(extreme.starts_with(&format!("{number} ")), "{extreme}");
        let is_case = cases().iter().any(|case| case.number == number);
        assert_eq!(is_case, place.starts_with("selftest"), "{extreme}");
        for test in place.split('`').skip(1).step_by(2).filter(|test| test.contains(": ")) {
            let (path, name) = test.split_once(": ").expect("a colon");
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join(path);
            let text = std::fs::read_to_string(&path).unwrap_or_default();
            assert!(
                text.contains(&format!("fn {name}(")),
                "{extreme}: no {name} in {}",
                path.display()
            );
        }
    }
}
