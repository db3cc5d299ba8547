//! The memory of the native backend: the ledger, and the reservation before training.

use std::ops::Range;

use super::ROWS_PER_TASK;
use super::adam::BiasCorrection;
use super::blended::BlendedBatch;
use super::blocks::{Blocks, planes};
use super::loss::LossBuffers;
use super::mask::Masks;
use super::moments::Moments;
use super::observe;
use super::parameters::Parameters;
use super::project::Splat;
use super::rasterize::TileCanvas;
use super::rasterize_bwd::TileGradient;
use super::signals::Accumulators;
use super::simd::WIDTH;
use super::summed::GradientSums;
use super::tiles::{Grid, TileLists};
use crate::candidates::Candidates;
use crate::signals::{Field, counts_dominant};
use crate::{BackendError, Setup};
use densify_core::budget::RowBudget;
use densify_core::memory::{Ledger, Section};

/// Maximum number of (row, tile) pairs in memory at a time; at least the budget, as a tile's list has each row at most
/// once.
pub(super) fn tile_cap(options: &Setup) -> usize {
    let rows = options.budget.total;
    let cap = options.tile_cap.unwrap_or(rows.saturating_mul(16));
    cap.max(rows).max(1).min(u32::MAX as usize)
}

/// Maximum number of gradient records in memory at a time; at most the number of pairs.
pub(super) fn record_cap(options: &Setup) -> usize {
    if options.only_renders { 1 } else { options.record_cap.clamp(1, tile_cap(options)) }
}

/// The rows of the optimiser's tasks that have trainable rows. Earlier rows are frozen and need memory only for
/// rendering.
pub(super) fn trained(options: &Setup) -> Range<usize> {
    if options.only_renders {
        return 0..0;
    }
    let RowBudget { total, frozen } = options.row_budget();
    frozen.min(total) / ROWS_PER_TASK * ROWS_PER_TASK..total
}

/// Number of rows in the buffer of summed records, including frozen rows.
pub(super) fn summed_rows(options: &Setup) -> usize {
    if options.only_renders { 0 } else { options.row_budget().total.next_multiple_of(WIDTH) }
}

/// The ledger of a backend with these options.
pub(super) fn ledger(sh_degree: u8, options: &Setup, threads: usize) -> Ledger {
    let budget = options.row_budget().total;
    let cap = tile_cap(options) as u64;
    let needs = &options.needs;
    let signals = Accumulators::new(0..1, needs, options.depth);
    let stride = signals.layout().stride();
    let per_row = planes(sh_degree);
    let padded = budget.next_multiple_of(WIDTH) as u64;
    let trained = trained(options);
    let (width, height) = options.largest_image;
    let grid = Grid::new(width, height);
    let float = size_of::<f32>() as u64;
    let mut ledger = Ledger::default();
    let parameters = Parameters::bytes(budget, per_row, options.storage.parameters);
    ledger.add_to(Section::Model, "parameters", parameters);
    let moments = Moments::bytes(trained.clone(), per_row, options.storage.moments);
    ledger.add_to(Section::Model, "optimiser moments", moments);
    ledger.add_to(
        Section::Model,
        "optimiser ages and bias tables",
        Blocks::<u16>::bytes(trained.clone(), 1) + BiasCorrection::bytes(),
    );
    if GradientSums::is_needed(needs.cadence) {
        let bytes = GradientSums::bytes(trained.clone(), per_row, needs.cadence);
        ledger.add_to(Section::Gradients, "gradients summed between steps", bytes);
    }
    if let Some(request) = &needs.aux {
        let bytes = observe::bytes(request, grid.width * grid.height);
        ledger.add_to(Section::Policy, "auxiliary views", bytes);
    }
    ledger.add_to(Section::Policy, "signals", Accumulators::bytes(trained.clone(), needs));
    if needs.mask.is_some() {
        ledger.add_to(Section::Policy, "masks", Masks::bytes(trained));
    }
    if counts_dominant(needs) {
        ledger.add_to(Section::Policy, "dominated pixels", 4 * budget as u64);
    }
    ledger.add_to(
        Section::Policy,
        "candidates",
        Candidates::bytes(needs.candidates, grid.width * grid.height),
    );
    ledger.add_to(
        Section::Renderer,
        "projected splats",
        budget as u64 * size_of::<Splat>() as u64 + padded / WIDTH as u64 * 2,
    );
    let sums = (summed_rows(options) * signals.sum_width()) as u64 * float;
    ledger.add_to(Section::Gradients, "splat gradients, signals at events", sums);
    ledger.add_to(Section::Tiles, "entries", TileLists::bytes(budget, cap as usize, grid.tiles()));
    let records = record_cap(options) as u64 * stride as u64 * float;
    ledger.add_to(Section::Tiles, "gradients per entry", records);
    let for_rows = signals.layout().has(Field::Error).then_some(needs.error_score);
    let loss = LossBuffers::bytes(grid.width, grid.height, threads, for_rows);
    let per_tile = size_of::<TileCanvas>() + size_of::<TileGradient>();
    ledger.add_to(Section::Renderer, "image and image gradient", (grid.tiles() * per_tile) as u64);
    let loss_and_backward = loss + (threads * size_of::<BlendedBatch>()) as u64;
    let what = format!("loss and backward pass, for up to {threads} threads");
    ledger.add_to(Section::Renderer, what, loss_and_backward);
    ledger
}

/// Allocates the ledger's total at once and frees it, so that a lack of memory is an error before
/// training instead of an abort during it.
pub(super) fn reserve(ledger: &Ledger) -> Result<(), BackendError> {
    let bytes = ledger.total();
    let failed = BackendError::OutOfMemory { what: "the training buffers", bytes };
    let Ok(size) = usize::try_from(bytes) else {
        return Err(failed);
    };
    Vec::<u8>::new().try_reserve_exact(size).map_err(|_| failed)
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};

    use super::*;
    use crate::cpu::CpuBackend;
    use crate::{Backend, MomentStorage, ParameterStorage, Storage};
    use densify_core::antialiasing::Antialiasing;
    use densify_core::camera::Camera;
    use densify_core::gaussians::Gaussians;

    #[test]
    fn allocated_bytes_are_those_of_the_ledger() {
        let formats = [
            (ParameterStorage::F32, MomentStorage::F32, 59 * 4, 2 * 59 * 4),
            (ParameterStorage::F16, MomentStorage::Both8, 3 * 4 + 56 * 2, 2 * 59),
        ];
        let both = formats.into_iter().flat_map(|format| [(format, false, 9), (format, true, 10)]);
        for ((parameters, moments, of_parameters, of_moments), depth, numbers) in both {
            let options = Setup {
                storage: Storage { parameters, moments },
                tile_cap: Some(300),
                record_cap: 70,
                threads: Some(1),
                depth,
                ..Setup::new(110)
            };
            let model = Gaussians { sh_degree: 3, ..Gaussians::default() };
            let backend = CpuBackend::new(&model, &options).unwrap();
            let line = |what: &str| {
                let line = backend.ledger.lines.iter().find(|line| line.what == what);
                line.map(|line| line.bytes)
            };
            // 110 rows are seven blocks of sixteen.
            assert_eq!(line("parameters"), Some(112 * of_parameters), "{parameters:?}");
            assert_eq!(line("optimiser moments"), Some(112 * of_moments), "{moments:?}");
            assert_eq!(line("gradients per entry"), Some(70 * numbers * 4));
            let CpuBackend { params, moments, records, sums, splats, visible, .. } = &backend;
            assert_eq!(line("parameters"), Some(params.allocated_bytes()));
            assert_eq!(line("optimiser moments"), Some(moments.allocated_bytes()));
            let bytes = |size: usize| Some(size as u64);
            assert_eq!(line("gradients per entry"), bytes(size_of_val(&records[..])));
            assert_eq!(line("splat gradients, signals at events"), bytes(size_of_val(&sums[..])));
            let seen = size_of_val(&visible[..]);
            assert_eq!(line("projected splats"), bytes(size_of_val(&splats[..]) + seen));
        }
    }

    #[test]
    fn renderings_are_the_same_without_memory_for_training() {
        let model = Gaussians {
            sh_degree: 0,
            origin: [0.0; 3],
            antialiasing: Antialiasing::None,
            means: vec![[0.0, 0.1, 2.0], [0.3, 0.0, 3.0]],
            log_scales: vec![[-1.5; 3]; 2],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; 2],
            opacity_logits: vec![2.0; 2],
            sh: vec![0.5, 0.1, -0.4, -0.2, 0.9, 0.3],
        };
        let camera = Camera::centred((40, 30), (30.0, 30.0), DMat3::IDENTITY, DVec3::ZERO);
        let results = [false, true].map(|only_renders| {
            let options = Setup { only_renders, threads: Some(1), ..Setup::new(2) };
            let mut backend = CpuBackend::new(&model, &options).unwrap();
            let bytes = backend.moments.allocated_bytes() as usize
                + backend.ages.allocated_bytes() as usize
                + size_of_val(&backend.sums[..])
                + size_of_val(&backend.records[..]);
            (bytes, backend.ledger.total(), backend.render(&camera, [0.1; 3], 0).unwrap())
        });
        let [(full, full_planned, expected), (bytes, planned, rendering)] = results;
        assert!(bytes < 64 && full - bytes == (full_planned - planned) as usize, "{bytes}, {full}");
        assert!(rendering == expected);
    }

    /// Budgets around 2³¹ and 2³² rows, and one of 2⁴⁰, which needs more memory than the address space has.
    #[test]
    fn sizes_of_huge_budgets_do_not_overflow_and_the_largest_is_refused() {
        let model = Gaussians { sh_degree: 3, ..Gaussians::default() };
        for budget in [1 << 31, (1_usize << 32) - 1, 1 << 32, 1 << 40] {
            let options = Setup { threads: Some(1), ..Setup::new(budget) };
            let ledger = ledger(3, &options, 1);
            // Parameters and moments: 59 numbers of four bytes, three times.
            let model_bytes = 3 * 59 * 4 * budget as u128;
            assert!(u128::from(ledger.total()) >= model_bytes, "{budget} rows");
            assert!(tile_cap(&options) <= u32::MAX as usize, "pairs are numbered by u32");
        }
        // More than the address space: refused before anything is allocated.
        let options = Setup { threads: Some(1), ..Setup::new(1 << 40) };
        let refused = CpuBackend::new(&model, &options).expect_err("a petabyte");
        assert!(matches!(refused, BackendError::OutOfMemory { .. }), "{refused}");
    }
}
